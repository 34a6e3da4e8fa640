"""The spherical camera: columns are longitudes, rows are latitudes (an equirectangular panorama).

u = fx atan2(x, z) + cx,        v = fy atan2(y, √(x² + z²)) + cy
"""

import math

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float

from ._components import as_parameter, direction, epsilon, has_direction
from ._protocol import WideCamera


class Spherical(WideCamera):
    """An equirectangular panorama (COLMAP's `EQUIRECTANGULAR`); it sees in every direction.

    Args:
        fx: Pixels per radian of longitude.
        fy: Pixels per radian of latitude.
        cx: Column of the forward direction, in pixels (integer pixel centres).
        cy: Row of the horizon, in pixels.

    Longitudes are in (-π, π]: the residual of a point behind the camera may have to be taken modulo 2π fx. In float32
    the pixel of a pixel's bearing is off by less than 1e-3 px in a panorama of 2,048 columns.

    Degenerate input: the directions straight up and down (to rounding) get the column of the forward direction, with
    bounded gradients; `in_domain` leaves them out.

    Differentiability: both modes, with respect to points, pixels and parameters, and of any order.

    Example:
        >>> import jax.numpy as jnp
        >>> camera = Spherical.from_size(2048, 1024)
        >>> camera.project(jnp.array([1.0, 0.0, 0.0])).tolist()
        [1535.5, 511.5]
    """

    fx: Float[Array, ""] = eqx.field(converter=as_parameter)
    fy: Float[Array, ""] = eqx.field(converter=as_parameter)
    cx: Float[Array, ""] = eqx.field(converter=as_parameter)
    cy: Float[Array, ""] = eqx.field(converter=as_parameter)

    @classmethod
    def from_size(cls, width: int, height: int) -> "Spherical":
        """The panorama of this many columns and rows that covers the whole sphere."""
        return cls(fx=width / (2.0 * math.pi), fy=height / math.pi, cx=0.5 * (width - 1.0), cy=0.5 * (height - 1.0))

    def project_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Project points given by components, elementwise."""
        x, y, z = direction(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z))
        horizontal2 = x * x + z * z
        usable = horizontal2 > epsilon(z) ** 2
        longitude = jnp.arctan2(jnp.where(usable, x, 0.0), jnp.where(usable, z, 1.0))
        latitude = jnp.arctan2(y, jnp.sqrt(jnp.where(usable, horizontal2, epsilon(z) ** 2)))
        return self.fx * longitude + self.cx, self.fy * latitude + self.cy

    def in_domain_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> Bool[Array, "*shape"]:
        """Mask of the points that have a longitude, elementwise."""
        x, y, z = jnp.asarray(x), jnp.asarray(y), jnp.asarray(z)
        proper = has_direction(x, y, z)
        x, y, z = direction(x, y, z)
        return proper & (x * x + z * z > epsilon(z) ** 2)

    def unproject_uv(
        self, u: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Unit bearings of pixels given by components, elementwise."""
        longitude, latitude = (jnp.asarray(u) - self.cx) / self.fx, (jnp.asarray(v) - self.cy) / self.fy
        horizontal = jnp.cos(latitude)
        return jnp.sin(longitude) * horizontal, jnp.sin(latitude), jnp.cos(longitude) * horizontal
