"""Scaramuzza's omnidirectional camera: the ray of an image point is a polynomial of its radius.

    (u, v) = A m + (cx, cy),   A = [[c, d], [e, 1]],   ray = (m, a0 + a2 ρ² + a3 ρ³ + …),   ρ = |m| in pixels

So unprojection is exact. Projection finds ρ by a fixed number of bracketed Newton steps on the ratio w of ρ / a0 to
the sine of the ray's angle θ, which is smooth on the axis; with the coefficients scaled by powers of a0,

    1 + Σ a_i (w sin θ)^i − w cos θ = 0.                                                                           (1)

Its derivative comes from the implicit function theorem.
"""

import equinox as eqx
import jax.numpy as jnp

from vojax._numerics import safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float

from ._components import MAX_RADIUS, angle_over_sine, as_parameter, direction, epsilon, has_direction, within_radius
from ._inversion import bracketed_newton, first_sign_change, implicit_root
from ._protocol import WideCamera

# Ten reach float64 rounding up to 157 degrees from the axis, 16 up to 180.
NEWTON_STEPS = 16

# a2, a3, …, scaled such that a0 is one.
Polynomial = tuple[Array, ...]


def _height(polynomial: Polynomial, radius: Array) -> Array:
    """The ray's z where its x and y have this radius."""
    total = jnp.zeros_like(radius)
    for coefficient in reversed(polynomial):
        total = coefficient + radius * total
    return 1.0 + radius * radius * total


def _largest_radius(polynomial: Polynomial) -> Array:
    """Where the angle from the axis stops growing with the radius, in units of a0; of the shape of the coefficients."""

    def slope(t: Array) -> Array:
        radius = t / (1.0 - t)
        total = jnp.zeros_like(radius)
        for i, coefficient in reversed(list(enumerate(polynomial, start=1))):
            total = i * coefficient + radius * total
        return 1.0 - radius * radius * total

    shape = jnp.broadcast_shapes(*(a.shape for a in polynomial))
    t = first_sign_change(slope, MAX_RADIUS / (1.0 + MAX_RADIUS), shape, jnp.result_type(*polynomial))
    return t / (1.0 - t)


def _residual(ratio: Array, data: tuple[Polynomial, Array, Array]) -> Array:
    polynomial, sine, cosine = data
    return ratio * cosine - _height(polynomial, ratio * sine)


def _solve(data: tuple[Polynomial, Array, Array]) -> Array:
    polynomial, sine, cosine = data
    upper = _largest_radius(polynomial) / jnp.maximum(sine, epsilon(sine))
    start = angle_over_sine(sine * sine, cosine)
    return bracketed_newton(lambda ratio: _residual(ratio, data), jnp.zeros_like(upper), upper, start, NEWTON_STEPS)


_radius_ratio = implicit_root(_residual, _solve)


class Scaramuzza(WideCamera):
    """An omnidirectional camera with a polynomial for its mirror or lens (OCamCalib; MATLAB's `fisheyeIntrinsics`).

    Args:
        cx: Centre of distortion, u in pixels (integer pixel centres).
        cy: Centre of distortion, v in pixels.
        a0: Constant term, in pixels: the focal length on the axis, > 0.
        a2: Coefficient of ρ², in 1/pixel; there is no linear term.
        a3: Coefficient of ρ³, in 1/pixel².
        a4: Coefficient of ρ⁴, in 1/pixel³.
        c: Stretch of u against v.
        d: Shear of u by v: misalignment of lens and sensor.
        e: Shear of v by u.
        higher: Coefficients of ρ⁵, ρ⁶, …

    Rays look along +z, so a0 is positive and a2 of a fisheye or mirror negative; OCamCalib's files have the opposite
    signs, and rows before columns. Points behind the camera are imaged up to the angle where it stops growing with the
    radius: `in_domain` says so. In float32 the pixel of a pixel's bearing is off by less than 1e-3 px.

    Degenerate input: projections are finite everywhere; outside `in_domain` they mean nothing. A pixel farther out than
    any ray gets a bearing at the largest angle.

    Differentiability: both modes, with respect to points, pixels and parameters; `project` by the implicit function
    theorem, with no gradient by the angle for points outside the domain.

    References: Scaramuzza, Martinelli & Siegwart, "A flexible technique for accurate omnidirectional camera calibration
    and structure from motion", 2006; Scaramuzza & Fraundorfer, "Visual Odometry Part I", 2011, eq. (3).
    """

    cx: Float[Array, ""] = eqx.field(converter=as_parameter)
    cy: Float[Array, ""] = eqx.field(converter=as_parameter)
    a0: Float[Array, ""] = eqx.field(converter=as_parameter)
    a2: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)
    a3: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)
    a4: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)
    c: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)
    d: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)
    e: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.0)
    higher: tuple[Float[Array, ""], ...] = eqx.field(
        converter=lambda values: tuple(as_parameter(value) for value in values), default=()
    )

    def _polynomial(self) -> Polynomial:
        scaled, power = [], self.a0
        for coefficient in (self.a2, self.a3, self.a4, *self.higher):
            scaled.append(coefficient * power)
            power = power * self.a0
        return tuple(scaled)

    def project_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Project points given by components, elementwise."""
        x, y, z = direction(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z))
        scale = self.a0 * _radius_ratio((self._polynomial(), safe_sqrt(x * x + y * y), z))
        x, y = x * scale, y * scale
        return self.c * x + self.d * y + self.cx, self.e * x + y + self.cy

    def in_domain_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> Bool[Array, "*shape"]:
        """Mask of the points within the largest angle, elementwise."""
        x, y, z = jnp.asarray(x), jnp.asarray(y), jnp.asarray(z)
        polynomial = self._polynomial()
        radius = _largest_radius(polynomial)
        largest = jnp.arctan2(radius, _height(polynomial, radius))
        return has_direction(x, y, z) & (jnp.arctan2(safe_sqrt(x * x + y * y), z) < largest)

    def unproject_uv(
        self, u: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Unit bearings of pixels given by components, elementwise."""
        du, dv = jnp.asarray(u) - self.cx, jnp.asarray(v) - self.cy
        scale = 1.0 / (self.a0 * (self.c - self.d * self.e))
        x, y = (du - self.d * dv) * scale, (self.c * dv - self.e * du) * scale
        polynomial = self._polynomial()
        limit = _largest_radius(polynomial)
        x, y, radius2 = within_radius(x, y, 1.0 / (limit * limit))
        z = _height(polynomial, safe_sqrt(radius2))
        inverse = 1.0 / jnp.sqrt(radius2 + z * z)
        return x * inverse, y * inverse, z * inverse
