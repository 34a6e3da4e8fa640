"""The extended unified camera (EUCM): onto an ellipsoid of revolution, then a pinhole.

    d = √(β (x² + y²) + z²),        (u, v) = (fx, fy) (x, y) / (α d + (1 − α) z) + (cx, cy)

Both directions are closed forms.
"""

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float

from ._components import as_parameter, direction, edge_sqrt, epsilon, has_direction, positive, within_radius
from ._protocol import WideCamera


class ExtendedUnified(WideCamera):
    """A wide camera with two shape parameters (EUCM; Kalibr's `eucm`, COLMAP's `EUCM`).

    Args:
        fx: Focal length along u, in pixels per radian on the axis.
        fy: Focal length along v.
        cx: Principal point, u in pixels (integer pixel centres).
        cy: Principal point, v in pixels.
        alpha: Blend α in [0, 1] between a pinhole (0) and a sphere's projection (1).
        beta: Shape β > 0 of the ellipsoid; with β = 1 the camera is `Unified` with ξ = α / (1 − α).

    Points behind the camera are imaged where α > 0, up to the cone z > −w d with w = min(α, 1 − α) / max(α, 1 − α). In
    float32 the pixel of a pixel's bearing is off by less than 1e-3 px.

    Degenerate input: projections are finite everywhere; outside `in_domain` they mean nothing. A pixel farther out than
    any ray gets a bearing on the rim of the domain.

    Differentiability: both modes, with respect to points, pixels and parameters, and of any order.

    References: Khomutenko, Garcia & Martinet, "An enhanced unified camera model", 2016.
    """

    fx: Float[Array, ""] = eqx.field(converter=as_parameter)
    fy: Float[Array, ""] = eqx.field(converter=as_parameter)
    cx: Float[Array, ""] = eqx.field(converter=as_parameter)
    cy: Float[Array, ""] = eqx.field(converter=as_parameter)
    alpha: Float[Array, ""] = eqx.field(converter=as_parameter)
    beta: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)

    def _distance(self, x: Array, y: Array, z: Array) -> Array:
        return jnp.sqrt(positive(self.beta * (x * x + y * y) + z * z))

    def project_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Project points given by components, elementwise."""
        x, y, z = direction(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z))
        inverse = 1.0 / positive(self.alpha * self._distance(x, y, z) + (1.0 - self.alpha) * z)
        return self.fx * (x * inverse) + self.cx, self.fy * (y * inverse) + self.cy

    def in_domain_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> Bool[Array, "*shape"]:
        """Mask of the points on the imaged side of the ellipsoid, elementwise."""
        x, y, z = jnp.asarray(x), jnp.asarray(y), jnp.asarray(z)
        proper = has_direction(x, y, z)
        x, y, z = direction(x, y, z)
        w = jnp.minimum(self.alpha, 1.0 - self.alpha) / jnp.maximum(self.alpha, 1.0 - self.alpha)
        return proper & (z > epsilon(z) - w * self._distance(x, y, z))

    def unproject_uv(
        self, u: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Unit bearings of pixels given by components, elementwise."""
        x, y = (jnp.asarray(u) - self.cx) / self.fx, (jnp.asarray(v) - self.cy) / self.fy
        bend = (2.0 * self.alpha - 1.0) * self.beta
        x, y, radius2 = within_radius(x, y, bend)
        depth = 1.0 - self.beta * self.alpha * self.alpha * radius2
        z = depth / (self.alpha * edge_sqrt(1.0 - bend * radius2) + (1.0 - self.alpha))
        inverse = 1.0 / jnp.sqrt(radius2 + z * z)
        return x * inverse, y * inverse, z * inverse
