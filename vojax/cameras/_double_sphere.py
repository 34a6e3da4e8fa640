"""The double sphere camera: onto a unit sphere, onto a second one shifted by ξ, then a pinhole shifted by α / (1 − α).

    d1 = √(x² + y² + z²),   d2 = √(x² + y² + (ξ d1 + z)²)
    (u, v) = (fx, fy) (x, y) / (α d2 + (1 − α) (ξ d1 + z)) + (cx, cy)

Both directions are closed forms.
"""

import equinox as eqx
import jax.numpy as jnp

from vojax._numerics import safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float

from ._components import as_parameter, direction, edge_sqrt, epsilon, has_direction, positive, within_radius
from ._protocol import WideCamera


class DoubleSphere(WideCamera):
    """A wide camera with two shape parameters (Kalibr's and basalt's `ds`).

    Args:
        fx: Focal length along u, in pixels: 1 + ξ times the pixels per radian on the axis.
        fy: Focal length along v.
        cx: Principal point, u in pixels (integer pixel centres).
        cy: Principal point, v in pixels.
        xi: Distance ξ in (-1, 1] of the second sphere's centre from the first's; fisheyes have about -0.3 to 0.3.
        alpha: Blend α in [0, 1]. With α = 0 the camera is `Unified` with the same ξ.

    Points behind the camera are imaged where α > 0 or ξ > 0, up to the cone z > −w2 d1 of the reference. In float32 the
    pixel of a pixel's bearing is off by less than 1e-3 px.

    Degenerate input: projections are finite everywhere; outside `in_domain` they mean nothing. A pixel farther out than
    any ray gets a bearing on the rim of the domain.

    Differentiability: both modes, with respect to points, pixels and parameters, and of any order.

    References: Usenko, Demmel & Cremers, "The double sphere camera model", 2018.
    """

    fx: Float[Array, ""] = eqx.field(converter=as_parameter)
    fy: Float[Array, ""] = eqx.field(converter=as_parameter)
    cx: Float[Array, ""] = eqx.field(converter=as_parameter)
    cy: Float[Array, ""] = eqx.field(converter=as_parameter)
    xi: Float[Array, ""] = eqx.field(converter=as_parameter)
    alpha: Float[Array, ""] = eqx.field(converter=as_parameter)

    def project_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Project points given by components, elementwise."""
        x, y, z = direction(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z))
        shifted = self.xi + z
        distance = safe_sqrt(x * x + y * y + shifted * shifted)
        inverse = 1.0 / positive(self.alpha * distance + (1.0 - self.alpha) * shifted)
        return self.fx * (x * inverse) + self.cx, self.fy * (y * inverse) + self.cy

    def in_domain_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> Bool[Array, "*shape"]:
        """Mask of the points on the imaged side of both spheres, elementwise."""
        x, y, z = jnp.asarray(x), jnp.asarray(y), jnp.asarray(z)
        proper = has_direction(x, y, z)
        x, y, z = direction(x, y, z)
        w1 = jnp.minimum(self.alpha, 1.0 - self.alpha) / jnp.maximum(self.alpha, 1.0 - self.alpha)
        w2 = (w1 + self.xi) / jnp.sqrt(positive(2.0 * w1 * self.xi + self.xi * self.xi + 1.0))
        return proper & (z > epsilon(z) - w2)

    def unproject_uv(
        self, u: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Unit bearings of pixels given by components, elementwise."""
        x, y = (jnp.asarray(u) - self.cx) / self.fx, (jnp.asarray(v) - self.cy) / self.fy
        bend = 2.0 * self.alpha - 1.0
        x, y, radius2 = within_radius(x, y, bend)
        depth = 1.0 - self.alpha * self.alpha * radius2
        z = depth / (self.alpha * edge_sqrt(1.0 - bend * radius2) + (1.0 - self.alpha))
        squared = z * z + radius2
        scale = (z * self.xi + edge_sqrt(squared - self.xi * self.xi * radius2)) / squared
        return x * scale, y * scale, z * scale - self.xi
