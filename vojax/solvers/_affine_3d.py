"""Affine map between two point sets.

Minimises sum_i w_i |y_i - A x_i - b|^2, twelve unknowns and linear: about the weighted means,

    A = (sum_i w_i y_i x_iᵀ) (sum_i w_i x_i x_iᵀ)⁻¹,      b = ȳ - A x̄.                                           (1)

The normal equations square the condition number, so A is corrected once by (1) on the residuals: in float32 that gives
what an orthogonal decomposition would.

Precondition: four points of set 0 that do not lie on a plane.

References: R. Hartley, A. Zisserman. Multiple View Geometry, 2nd edition, section 4.4 (the affine case).
"""

import jax.numpy as jnp

from vojax._numerics import safe_divide, symmetric_inverse
from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._components import Components, Rows3
from ._implicit import implicit
from ._lanes import lanes_last
from ._weighted_points import (
    Correspondences,
    centred_components,
    corresponding_points,
    largest_coordinate,
    normal_weights,
)


def _regression(y: Components, x: Components, weights: Array, inverse: Array) -> Rows3:
    """(1) by components [n, *lanes], rows of A by components [*lanes]."""
    cross = [[jnp.sum(weights * y[i] * x[j], axis=0) for j in range(3)] for i in range(3)]
    row0, row1, row2 = (
        tuple(sum((cross[i][k] * inverse[k, j] for k in range(1, 3)), cross[i][0] * inverse[0, j]) for j in range(3))
        for i in range(3)
    )
    return row0, row1, row2


def _kernel(points0: Array, points1: Array, weights: Array) -> tuple[Array, Array]:
    """Arrays [n, 3, *lanes] and weights [n, *lanes]: matrices [1, 3, 4, *lanes] and validity [1, *lanes]."""
    weights, ok = normal_weights(weights, points0, points1)
    x, mean0 = centred_components(points0, weights, ok)
    y, mean1 = centred_components(points1, weights, ok)
    size = jnp.max(jnp.abs(jnp.stack(x)), axis=(0, 1))
    ok = ok & (size > 0) & jnp.isfinite(size)
    size = jnp.where(ok, size, 1.0)
    x = tuple(jnp.where(ok[None], c, 0.0) / size[None] for c in x)
    moments = [[jnp.sum(weights * x[i] * x[j], axis=0) for j in range(3)] for i in range(3)]
    inverse, regular = symmetric_inverse(jnp.stack([jnp.stack(row) for row in moments]))
    # The least spread has to be more than rounding of the coordinates, too.
    rounding = 16.0 * float(jnp.finfo(size.dtype).eps) * largest_coordinate(points0, ok) / size
    spread2 = 1.0 / jnp.where(regular, inverse[0, 0] + inverse[1, 1] + inverse[2, 2], 1.0)
    ok = ok & regular & (spread2 > rounding * rounding)
    rows = _regression(y, x, weights, inverse)
    left = tuple(y[i] - sum((rows[i][j][None] * x[j] for j in range(1, 3)), rows[i][0][None] * x[0]) for i in range(3))
    correction = _regression(left, x, weights, inverse)
    matrix = [[(rows[i][j] + correction[i][j]) / size for j in range(3)] for i in range(3)]
    offset = [mean1[i] - sum((matrix[i][j] * mean0[j] for j in range(1, 3)), matrix[i][0] * mean0[0]) for i in range(3)]
    model = jnp.stack([jnp.stack([*matrix[i], offset[i]]) for i in range(3)])
    ok = ok & jnp.all(jnp.isfinite(model), axis=(0, 1))
    identity = jnp.eye(3, 4, dtype=model.dtype).reshape(3, 4, *(1,) * ok.ndim)
    return jnp.where(ok[None, None], model, identity)[None], ok[None]


_solve = lanes_last(_kernel)


def _candidates(data: Correspondences) -> Candidates[Array]:
    models, valid = _solve(*data)
    return Candidates(models=models, valid=valid)


def _stationarity(model: Array, data: Correspondences) -> Array:
    """Twelve equations: the mean residual, and its correlation with the points about their mean."""
    points0, points1, weights = data
    weights = safe_divide(weights, jnp.broadcast_to(jnp.sum(weights), weights.shape))[:, None]
    error = points0 @ model[:, :3].T + model[None, :, 3] - points1
    mean = jnp.sum(weights * error, axis=0)
    centred = points0 - jnp.sum(weights * points0, axis=0)[None]
    return jnp.concatenate([((weights * error).T @ centred).reshape(9), mean])


_affine_3d = implicit(_candidates, _stationarity, lambda model, tangent: model + tangent.reshape(3, 4), 12)


def affine_3d(
    points0: Float[ArrayLike, "n 3"], points1: Float[ArrayLike, "n 3"], weights: Float[ArrayLike, "n"] | None = None
) -> Candidates[Array]:
    """Find the affine map that takes `points0` to `points1` in the least-squares sense.

    Args:
        points0: Points in frame 0, one per row, at least four that are not on a plane.
        points1: The same points in frame 1; they may lie anywhere.
        weights: One non-negative weight per point, as 1 / σ²; their common scale does not matter. All equal by default.

    Returns:
        One slot: the matrix [A, b] [3, 4], `points1 ≈ points0 @ A.T + b`. A may be singular or mirror.

    Degenerate input: points of frame 0 on a plane to rounding (in float32, thinner than about 2e-3 of their extent),
        negative weights and anything not finite leave the slot invalid with [I, 0] in it.
    Differentiability: both modes, any order, in points and weights, by the implicit function theorem; zero for an
        invalid slot.

    Raises:
        ValueError: If there are fewer than four points or the arrays do not match.
    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        >>> candidates = affine_3d(points, 3.0 * points + 1.0)
        >>> bool(jnp.allclose(candidates.models[0, :, 3], 1.0, atol=1e-5))
        True
    """
    return _affine_3d(corresponding_points(points0, points1, weights, fewest=4))
