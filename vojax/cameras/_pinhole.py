"""The pinhole camera: u = fx X/Z + skew Y/Z + cx, v = fy Y/Z + cy."""

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float

from ._components import as_parameter, epsilon, onto_plane
from ._protocol import PlaneCamera


class Pinhole(PlaneCamera):
    """A pinhole camera without distortion.

    Args:
        fx: Focal length along u, in pixels.
        fy: Focal length along v, in pixels.
        cx: Principal point, u in pixels (integer pixel centres).
        cy: Principal point, v in pixels.
        skew: Shear of the u axis, in pixels per unit of Y/Z; 0 for every ordinary sensor.

    Degenerate input: a point on the plane z = 0 (to rounding) projects to a far, finite pixel; a point behind the
    camera projects through the centre. Both are the caller's to mask, by z > 0 or by `in_domain`.

    Differentiability: both modes, with respect to points, pixels and parameters; finite everywhere.

    References: Scaramuzza & Fraundorfer, "Visual Odometry Part I", 2011, eq. (1).

    Example:
        >>> import jax.numpy as jnp
        >>> camera = Pinhole(fx=500.0, fy=500.0, cx=320.0, cy=240.0)
        >>> camera.project(jnp.array([1.0, 0.0, 2.0])).tolist()
        [570.0, 240.0]
    """

    fx: Float[Array, ""] = eqx.field(converter=as_parameter)
    fy: Float[Array, ""] = eqx.field(converter=as_parameter)
    cx: Float[Array, ""] = eqx.field(converter=as_parameter)
    cy: Float[Array, ""] = eqx.field(converter=as_parameter)
    skew: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)

    def project_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Project points given by components, elementwise."""
        xn, yn = onto_plane(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z))
        return self.fx * xn + self.skew * yn + self.cx, self.fy * yn + self.cy

    def in_domain_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> Bool[Array, "*shape"]:
        """Mask of the points in front of the camera, elementwise."""
        z = jnp.asarray(z)
        return z > epsilon(z)

    def normalized_xy(
        self, u: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Coordinates on the plane z = 1 of pixels given by components, elementwise."""
        y = (jnp.asarray(v) - self.cy) / self.fy
        return (jnp.asarray(u) - self.cx - self.skew * y) / self.fx, y

    def matrix(self) -> Float[Array, "3 3"]:
        """The upper triangular calibration matrix K."""
        zero, one = jnp.zeros_like(self.fx), jnp.ones_like(self.fx)
        rows = [[self.fx, self.skew, self.cx], [zero, self.fy, self.cy], [zero, zero, one]]
        return jnp.stack([jnp.stack(row) for row in rows])
