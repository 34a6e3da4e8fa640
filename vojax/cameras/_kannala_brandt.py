"""The Kannala-Brandt fisheye: the radius in the image is an odd polynomial of the angle from the axis.

    θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸),        (u, v) = (fx, fy) θ_d (x, y) / √(x² + y²) + (cx, cy)

The inverse is a fixed number of bracketed Newton steps on the ratio t = θ / θ_d, which is smooth on the axis; its
derivative comes from the implicit function theorem.
"""

import math

import equinox as eqx
import jax.numpy as jnp

from vojax._numerics import safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie._coefficients import stumpff

from ._components import angle_over_sine, as_parameter, direction, epsilon, has_direction
from ._inversion import bracketed_newton, first_sign_change, implicit_root
from ._protocol import WideCamera

# Eight reach float64 rounding over the images of real lenses; more only near the largest angle.
NEWTON_STEPS = 10

Coefficients = tuple[Array, Array, Array, Array]


def _stretch(coefficients: Coefficients, angle2: Array) -> Array:
    """θ_d / θ."""
    k1, k2, k3, k4 = coefficients
    return 1.0 + angle2 * (k1 + angle2 * (k2 + angle2 * (k3 + angle2 * k4)))


def _largest_angle(coefficients: Coefficients) -> Array:
    """Where θ_d stops growing with θ, at most π; of the shape of the coefficients."""
    k1, k2, k3, k4 = coefficients

    def slope(angle: Array) -> Array:
        a = angle * angle
        return 1.0 + a * (3.0 * k1 + a * (5.0 * k2 + a * (7.0 * k3 + a * 9.0 * k4)))

    shape = jnp.broadcast_shapes(*(k.shape for k in coefficients))
    return first_sign_change(slope, math.pi, shape, jnp.result_type(*coefficients))


def _residual(ratio: Array, data: tuple[Coefficients, Array]) -> Array:
    coefficients, radius2 = data
    return ratio * _stretch(coefficients, ratio * ratio * radius2) - 1.0


def _solve(data: tuple[Coefficients, Array]) -> Array:
    coefficients, radius2 = data
    radius = jnp.sqrt(jnp.maximum(radius2, epsilon(radius2) ** 2))
    upper = _largest_angle(coefficients) / radius
    return bracketed_newton(
        lambda ratio: _residual(ratio, data), jnp.zeros_like(upper), upper, jnp.ones_like(upper), NEWTON_STEPS
    )


_angle_ratio = implicit_root(_residual, _solve)


class KannalaBrandt(WideCamera):
    """A fisheye camera with four coefficients (OpenCV's `fisheye`, Kalibr's `pinhole-equi`, COLMAP's `OPENCV_FISHEYE`).

    Args:
        fx: Focal length along u, in pixels per radian on the axis.
        fy: Focal length along v.
        cx: Principal point, u in pixels (integer pixel centres).
        cy: Principal point, v in pixels.
        k1: Coefficient of θ³.
        k2: Coefficient of θ⁵.
        k3: Coefficient of θ⁷.
        k4: Coefficient of θ⁹.

    Points behind the camera are imaged too, up to the angle where the polynomial stops growing or 180 degrees:
    `in_domain` says so. In float32 the pixel of a pixel's bearing is off by less than 1e-3 px.

    Degenerate input: projections are finite everywhere; one straight behind (to the square root of rounding) and the
    camera's own centre mean nothing. A pixel farther out than any ray gets a bearing at the largest angle.

    Differentiability: both modes, with respect to points, pixels and parameters, and of any order; `unproject` by the
    implicit function theorem, with no radial gradient for pixels farther out than any ray.

    References: Kannala & Brandt, "A generic camera model and calibration method for conventional, wide-angle, and
    fish-eye lenses", 2006.
    """

    fx: Float[Array, ""] = eqx.field(converter=as_parameter)
    fy: Float[Array, ""] = eqx.field(converter=as_parameter)
    cx: Float[Array, ""] = eqx.field(converter=as_parameter)
    cy: Float[Array, ""] = eqx.field(converter=as_parameter)
    k1: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)
    k2: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)
    k3: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)
    k4: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)

    def _coefficients(self) -> Coefficients:
        return self.k1, self.k2, self.k3, self.k4

    def project_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Project points given by components, elementwise."""
        x, y, z = direction(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z))
        sine2 = x * x + y * y
        ratio = angle_over_sine(sine2, z)
        scale = ratio * _stretch(self._coefficients(), ratio * ratio * sine2)
        return self.fx * (scale * x) + self.cx, self.fy * (scale * y) + self.cy

    def in_domain_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> Bool[Array, "*shape"]:
        """Mask of the points within the largest angle, elementwise."""
        x, y, z = jnp.asarray(x), jnp.asarray(y), jnp.asarray(z)
        sine = safe_sqrt(x * x + y * y)
        behind = (sine < epsilon(z) ** 0.5 * jnp.abs(z)) & (z < 0)
        return has_direction(x, y, z) & ~behind & (jnp.arctan2(sine, z) < _largest_angle(self._coefficients()))

    def unproject_uv(
        self, u: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Unit bearings of pixels given by components, elementwise."""
        x, y = (jnp.asarray(u) - self.cx) / self.fx, (jnp.asarray(v) - self.cy) / self.fy
        radius2 = x * x + y * y
        ratio = _angle_ratio((self._coefficients(), radius2))
        cosine, sine_over_angle, *_ = stumpff(ratio * ratio * radius2)
        scale = sine_over_angle * ratio
        return x * scale, y * scale, cosine
