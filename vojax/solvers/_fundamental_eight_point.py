"""Fundamental matrix from eight or more pixels: pixel1ᵀ F pixel0 = 0 is linear in the nine entries of F.

In Hartley's coordinates (centroid 0, mean distance √2) the unit matrix N minimises the sum of w (pixel1ᵀ N pixel0)²;
eight equations are fulfilled. The matrix of rank 2 nearest to it there, F = N - s2 u2 v2ᵀ, goes back to pixels.

Precondition: the points are in general position and the camera moves; see `eight_point`.

The derivative is that of (F, μ): F + μ cof(F) is along N, which fulfils eight equations, and det F = 0.

References:
    R. Hartley. In defense of the eight-point algorithm. PAMI 1997.
    R. Hartley, A. Zisserman. Multiple View Geometry in Computer Vision, 2nd edition, algorithm 11.1.
"""

from typing import NamedTuple

import jax.numpy as jnp

from vojax._numerics import normalize
from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._essential_projection import without_least
from ._implicit import implicit
from ._lanes import lanes_last
from ._linear_epipolar import (
    algebraic_errors,
    centred_pixels,
    cofactors,
    congruent,
    dependent,
    epipolar_rows,
    least_vector_and_second,
    linear_stationarity,
    matrix_rows,
    normalised_from_pixel,
    normalised_fundamental,
    null_space_and_least,
    pixel_rounding,
    repeated,
    two_views,
    unit_points,
)
from ._matrix_models import perturb_unit_matrix, unit_matrix

Data = tuple[Array, Array, Array]


class _Model(NamedTuple):
    fundamental: Array
    correction: Array  # μ


def fundamental_eight_point(
    pixels0: Float[ArrayLike, "n 2"], pixels1: Float[ArrayLike, "n 2"], weights: Float[ArrayLike, "n"] | None = None
) -> Candidates[Float[Array, "1 3 3"]]:
    """Find the fundamental matrix of eight or more matching pixels by linear least squares.

    For a batch, `jax.vmap(fundamental_eight_point, in_axes=-1, out_axes=-1)` on arrays [n, 2, batch] is the fast layout
    on a CPU.

    Args:
        pixels0: Pixels of image 0, one per row, at least eight; without distortion.
        pixels1: The matching pixels of image 1.
        weights: One non-negative weight per correspondence, as 1 / σ²; their common scale does not matter. All equal by
            default. Weights take part in the normalisation too.

    Returns:
        One slot with F of rank 2, `pixel1ᵀ F pixel0 = 0`, Frobenius norm 1 and its largest entry positive.

    Degenerate input: points on a plane, a pure rotation, fewer than eight different correspondences with positive
        weight: the equations leave more than one matrix (the least singular value of eight equations is below 4 eps
        times the error of the pixels, or the second least one of more is below 64 eps of all together), and the slot is
        invalid with the zero matrix in it. With noise in the pixels such sets are no longer exactly degenerate and the
        result is meaningless. Pixels that coincide, negative weights and anything not finite are invalid.
    Differentiability: both modes, any order, in pixels and weights, by the implicit function theorem. Zero for an
        invalid slot.

    Raises:
        ValueError: If there are fewer than eight correspondences or the arrays do not match.
    References: see the module.

    Example:
        >>> import numpy as np
        >>> points = np.random.default_rng(0).uniform((-2, -2, 4), (2, 2, 8), (8, 3)).astype(np.float32)
        >>> pixels0 = 500.0 * points[:, :2] / points[:, 2:]
        >>> pixels1 = 500.0 * (points[:, :2] + np.array([[1.0, 0.0]], np.float32)) / points[:, 2:]
        >>> fundamental = fundamental_eight_point(pixels0, pixels1).models[0]
        >>> [[round(abs(float(x)), 2) for x in row] for row in fundamental]
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.71], [0.0, 0.71, 0.0]]
    """
    candidates = _fundamental_eight_point(two_views(pixels0, pixels1, weights, at_least=8))
    return Candidates(models=candidates.models.fundamental, valid=candidates.valid)


def _kernel(pixels0: Array, pixels1: Array, weights: Array) -> tuple[Array, Array, Array]:
    largest = jnp.max(weights, axis=0)
    proper = jnp.all(weights >= 0, axis=0) & jnp.isfinite(largest) & (largest > 0)
    weights = jnp.where(proper, weights / jnp.where(proper, largest, 1.0)[None], 0.0)
    x0, transform0, proper0 = centred_pixels(pixels0, weights)
    x1, transform1, proper1 = centred_pixels(pixels1, weights)
    if pixels0.shape[0] == 8:
        rounding = jnp.maximum(pixel_rounding(pixels0, transform0), pixel_rounding(pixels1, transform1))
        rows = epipolar_rows(unit_points(x0), unit_points(x1))
        basis, least = null_space_and_least(jnp.where((weights > 0)[:, None], rows, 0.0))
        certain = ~dependent(least, rounding)
        linear = basis[0]
    else:
        rows = epipolar_rows(x0, x1) * jnp.sqrt(weights)[:, None]
        linear, second = least_vector_and_second(rows, 10 if rows.dtype == jnp.float64 else 6)
        certain = ~repeated(second)
    proper = proper & proper0 & proper1 & certain
    nearest, _, s, unique = without_least(matrix_rows(jnp.where(proper, linear, 0.0)))
    # N = F̂ + μ cof(F̂) up to scale, with F̂ = F / |F|; μ changes sign with F.
    correction = s[2] * jnp.sqrt(s[0] * s[0] + s[1] * s[1]) / jnp.where(unique, s[0] * s[1], 1.0)
    rows3 = congruent(normalised_from_pixel(transform1), nearest, normalised_from_pixel(transform0))
    stacked = jnp.stack([jnp.stack(row) for row in rows3])
    fundamental, finite = unit_matrix(stacked)
    valid = proper & unique & finite
    flipped = jnp.sum(fundamental * stacked, axis=(0, 1)) < 0
    correction = jnp.where(valid, jnp.where(flipped, -correction, correction), 0.0)
    return jnp.where(valid, fundamental, 0.0)[None], correction[None], valid[None]


_solve = lanes_last(_kernel)


def _candidates(data: Data) -> Candidates[_Model]:
    fundamental, correction, valid = _solve(*data)
    return Candidates(models=_Model(fundamental, correction), valid=valid)


def _equations(model: _Model, data: Data) -> Array:
    """Eight equations of N = F + μ cof(F) in Hartley's coordinates, and det F = 0."""
    pixels0, pixels1, weights = data
    x0, transform0, _ = centred_pixels(pixels0, weights)
    x1, transform1, _ = centred_pixels(pixels1, weights)
    x0, x1 = jnp.stack(x0, axis=1), jnp.stack(x1, axis=1)
    f = normalised_fundamental(model.fundamental, transform0, transform1)
    cofactor = cofactors(f)
    n = normalize((f + model.correction * cofactor).reshape(9)).reshape(3, 3)
    linear = algebraic_errors(x0, x1, n) if pixels0.shape[0] == 8 else linear_stationarity(x0, x1, weights, n)
    return jnp.concatenate([linear, jnp.sum(f[0] * cofactor[0])[None]])


def _retract(model: _Model, tangent: Array) -> _Model:
    return _Model(perturb_unit_matrix(model.fundamental, tangent[:8]), model.correction + tangent[8])


_fundamental_eight_point = implicit(_candidates, _equations, _retract, 9)
