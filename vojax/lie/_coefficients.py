"""Scalar functions behind exp, log and the Jacobians, accurate and differentiable to any order at every angle.

Rotations need Stumpff's functions of u = θ²: c_n(u) = Σ_k (−u)^k / (2k+n)!, so that c_0 = cos θ, c_1 = sin θ / θ,
c_2 = (1 − cos θ) / θ², c_3 = (θ − sin θ) / θ³, and c_n = 1/n! − u c_{n+2} throughout.

Similarities need φ₁(z) = (e^z − 1) / z at z = σ + iθ, an eigenvalue of σI + φ^.

References: Stiefel & Scheifele, "Linear and Regular Celestial Mechanics", section 11; Eade, "Lie Groups for 2D and 3D
Transformations", section 7.
"""

import math

import jax.numpy as jnp

from vojax._numerics import safe_divide
from vojax._types import Array, Float

# The closed forms divide by u (or |z|²) up to twice and cancel below 4, the series cancel above. With the branch at 4,
# float32 errors are at most 17 ulp of c_5(0), 5 of c_4(0) and 3 of the others (measured); half that for derivatives.
_SERIES_LIMIT = 4.0


def _series_length(dtype: jnp.dtype, ratio: float, step: int, offset: int) -> int:
    """Terms of Σ ratio^k / (step k + offset)! that matter in the precision of `dtype`."""
    first_dropped = 1
    threshold = float(jnp.finfo(dtype).eps) / 8 / math.factorial(offset)
    while ratio**first_dropped / math.factorial(step * first_dropped + offset) > threshold:
        first_dropped += 1
    return first_dropped


def stumpff(u: Float[Array, "*shape"]) -> tuple[Float[Array, "*shape"], ...]:
    """Stumpff's functions (c_0, …, c_5) of the squared angle u ≥ 0, elementwise.

    Differentiability: any order, at u = 0 as well, where the series is a polynomial.
    """
    small = u < _SERIES_LIMIT
    # Double where: each branch sees only arguments it can handle, so no gradient of the other one leaks a NaN. The
    # guards overlap: XLA may evaluate u twice with different rounding (fused multiply-add), and at the limit one copy
    # selects a branch that the other has switched off. With touching guards slopes were wrong by 8 % at u = 4.
    u_small = jnp.where(u < 1.1 * _SERIES_LIMIT, u, 0.0)
    u_large = jnp.where(u > 0.9 * _SERIES_LIMIT, u, _SERIES_LIMIT)

    s4 = s5 = jnp.zeros_like(u)
    for k in reversed(range(_series_length(u.dtype, 1.1 * _SERIES_LIMIT, 2, 4))):
        s4 = 1.0 / math.factorial(2 * k + 4) - u_small * s4
        s5 = 1.0 / math.factorial(2 * k + 5) - u_small * s5
    s2, s3 = 1.0 / 2.0 - u_small * s4, 1.0 / 6.0 - u_small * s5
    s0, s1 = 1.0 - u_small * s2, 1.0 - u_small * s3

    angle = jnp.sqrt(u_large)
    l0, l1 = jnp.cos(angle), jnp.sin(angle) / angle
    l2, l3 = (1.0 - l0) / u_large, (1.0 - l1) / u_large
    l4, l5 = (1.0 / 2.0 - l2) / u_large, (1.0 / 6.0 - l3) / u_large

    series, closed = (s0, s1, s2, s3, s4, s5), (l0, l1, l2, l3, l4, l5)
    return tuple(jnp.where(small, s, c) for s, c in zip(series, closed, strict=True))


def half_angle_over_sine(
    squared_sine: Float[Array, "*shape"], cosine: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Factor f = 2 atan2(n, w) / n that turns a quaternion's vector part (|v| = n) into its rotation vector, for w ≥ 0.

    Args:
        squared_sine: n² = |v|², of any common scale with `cosine`.
        cosine: Scalar part w ≥ 0.

    Degenerate input: 0 for the zero quaternion.
    """
    # atan's series in n/w costs a division by n² in the derivative of the closed form: below n/w = 0.2 (half-angle
    # 0.2 rad) eight or seventeen terms hold full precision and the closed form's derivative loses at most 25 eps.
    squared_cosine = cosine * cosine
    small = squared_sine < 0.04 * squared_cosine
    near = squared_sine < 0.05 * squared_cosine
    w = jnp.where(near, cosine, 1.0)
    ratio = jnp.where(near, squared_sine, 0.0) / (w * w)
    terms = next(k for k in range(1, 64) if 0.05**k / (2 * k + 1) < float(jnp.finfo(cosine.dtype).eps) / 8)
    series = jnp.zeros_like(cosine)
    for k in reversed(range(terms)):
        series = 1.0 / (2 * k + 1) - ratio * series

    usable = (squared_sine > 0.03 * squared_cosine) & (squared_sine > 0)
    n = jnp.sqrt(jnp.where(usable, squared_sine, 1.0))
    closed = 2.0 * jnp.arctan2(n, jnp.where(usable, cosine, 1.0)) / n
    return jnp.where(small, 2.0 * series / w, jnp.where(usable, closed, 0.0))


def similarity_coefficients(
    sigma: Float[Array, "*shape"], u: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Coefficients (a, b, c) of V = ∫₀¹ exp(τ(σI + φ^)) dτ = a I + b φ^ + c φ^², elementwise in σ and u = |φ|².

    φ₁ at the eigenvalues gives a = φ₁(σ) on the axis and a − c u ± iθ b = φ₁(σ ± iθ) across it.

    Differentiability: any order, also at σ = 0 and u = 0 in every combination.
    """
    squared_modulus = sigma * sigma + u
    small = squared_modulus < _SERIES_LIMIT
    near = squared_modulus < 1.1 * _SERIES_LIMIT
    sigma_small, u_small = jnp.where(near, sigma, 0.0), jnp.where(near, u, 0.0)
    axis_limit = math.sqrt(_SERIES_LIMIT)
    axis_small = jnp.abs(sigma) < axis_limit
    sigma_axis = jnp.where(jnp.abs(sigma) < 1.1 * axis_limit, sigma, 0.0)

    # Powers z^k = p + iθ q and (σ^k − p) / u = r, summed with weights 1/(k+1)!; nothing is divided by σ or u.
    a = jnp.ones_like(sigma)
    b = c = jnp.zeros_like(sigma)
    power, p = jnp.ones_like(sigma), jnp.ones_like(sigma)
    q = r = jnp.zeros_like(sigma)
    for k in range(1, _series_length(sigma.dtype, 1.1 * math.sqrt(_SERIES_LIMIT), 1, 1) + 2):
        power = power * sigma_axis
        p, q, r = sigma_small * p - u_small * q, p + sigma_small * q, sigma_small * r + q
        weight = 1.0 / math.factorial(k + 1)
        a, b, c = a + weight * power, b + weight * q, c + weight * r

    sigma_far = jnp.where(jnp.abs(sigma) > 0.9 * axis_limit, sigma, axis_limit)
    a = jnp.where(axis_small, a, jnp.expm1(sigma_far) / sigma_far)
    far = squared_modulus > 0.9 * _SERIES_LIMIT
    modulus_far = jnp.where(far, squared_modulus, _SERIES_LIMIT)
    growth = jnp.exp(jnp.where(far, sigma, 0.0))
    c0, c1, c2, *_ = stumpff(u)
    b_far = (1.0 - growth * (c0 - sigma * c1)) / modulus_far
    c_far = (a - growth * (c1 - sigma * c2)) / modulus_far
    return a, jnp.where(small, b, b_far), jnp.where(small, c, c_far)


def inverse_coefficients(
    a: Float[Array, "*shape"], b: Float[Array, "*shape"], c: Float[Array, "*shape"], u: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Coefficients of (a I + b φ^ + c φ^²)⁻¹ in the same basis, by inverting a and a − c u ± iθ b.

    Degenerate input: a zero eigenvalue (an angle of 2π without scale) gives finite numbers that are no inverse.
    """
    across = a - c * u
    squared_modulus = across * across + u * b * b
    one = jnp.ones_like(a)
    inverse_a = safe_divide(one, a)
    inverse_modulus = safe_divide(one, squared_modulus)
    return inverse_a, -b * inverse_modulus, (b * b - c * across) * inverse_a * inverse_modulus
