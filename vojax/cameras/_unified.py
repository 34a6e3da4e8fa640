"""The unified camera: onto the unit sphere, then a pinhole ξ behind its centre, with a lens where there is one.

    (x, y, z) / |(x, y, z)| = (a, b, c),      m = (a, b) / (c + ξ),      (u, v) = (fx, fy) distort(m) + (cx, cy)

ξ = 0 is a pinhole, ξ = 1 the parabolic mirror; the lens is `BrownConrady`'s with k3 = 0. Without a lens the inverse is
exact; with one it costs `BrownConrady`'s Newton steps.
"""

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float

from ._brown_conrady import Coefficients, clip_radius, distort, invertible, undistort
from ._components import (
    MAX_RADIUS,
    as_parameter,
    direction,
    edge_sqrt,
    epsilon,
    has_direction,
    positive,
    within_radius,
)
from ._protocol import WideCamera


class Unified(WideCamera):
    """A central catadioptric or wide camera (Kalibr's `omni`, with `radtan` distortion or none; OpenCV's `omnidir`).

    Args:
        fx: Focal length along u, in pixels: (1 + ξ) times the pixels per radian on the axis.
        fy: Focal length along v.
        cx: Principal point, u in pixels (integer pixel centres).
        cy: Principal point, v in pixels.
        xi: Distance ξ ≥ 0 of the pinhole from the centre of the sphere.
        k1: Radial coefficient of r².
        k2: Radial coefficient of r⁴.
        p1: Decentring coefficient of 2xy in x.
        p2: Decentring coefficient of r² + 2x² in x.

    Points up to acos(-ξ) (ξ ≤ 1) or acos(-1/ξ) (ξ > 1) from the axis are imaged, those behind the camera too, unless
    the lens folds back before. In float32 the pixel of a pixel's bearing is off by less than 1e-3 px.

    Degenerate input: projections are finite everywhere; outside `in_domain` they mean nothing. A pixel farther out than
    any ray gets a bearing on the rim of the domain.

    Differentiability: both modes, with respect to points, pixels and parameters, and of any order.

    References: Geyer & Daniilidis, "A unifying theory for central panoramic systems", 2000; Mei & Rives, "Single view
    point omnidirectional camera calibration from planar grids", 2007.
    """

    fx: Float[Array, ""] = eqx.field(converter=as_parameter)
    fy: Float[Array, ""] = eqx.field(converter=as_parameter)
    cx: Float[Array, ""] = eqx.field(converter=as_parameter)
    cy: Float[Array, ""] = eqx.field(converter=as_parameter)
    xi: Float[Array, ""] = eqx.field(converter=as_parameter)
    k1: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)
    k2: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)
    p1: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)
    p2: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)

    def _coefficients(self) -> Coefficients:
        return self.k1, self.k2, self.p1, self.p2, jnp.zeros_like(self.k2)

    def project_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Project points given by components, elementwise."""
        x, y, z = direction(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z))
        inverse = 1.0 / positive(z + self.xi)
        xd, yd = distort(self._coefficients(), *clip_radius(x * inverse, y * inverse, MAX_RADIUS))
        return self.fx * xd + self.cx, self.fy * yd + self.cy

    def in_domain_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> Bool[Array, "*shape"]:
        """Mask of the points that the sphere and the lens can image, elementwise."""
        x, y, z = jnp.asarray(x), jnp.asarray(y), jnp.asarray(z)
        proper = has_direction(x, y, z)
        x, y, z = direction(x, y, z)
        edge = jnp.where(self.xi > 1.0, 1.0 / jnp.maximum(self.xi, 1.0), self.xi)
        inverse = 1.0 / positive(z + self.xi)
        lens = invertible(self._coefficients(), x * inverse, y * inverse)
        return proper & (z > epsilon(z) - edge) & lens

    def unproject_uv(
        self, u: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Unit bearings of pixels given by components, elementwise."""
        x, y = undistort(
            self._coefficients(), (jnp.asarray(u) - self.cx) / self.fx, (jnp.asarray(v) - self.cy) / self.fy
        )
        curvature = self.xi * self.xi - 1.0
        x, y, radius2 = within_radius(x, y, curvature)
        scale = (self.xi + edge_sqrt(1.0 - curvature * radius2)) / (1.0 + radius2)
        return x * scale, y * scale, scale - self.xi
