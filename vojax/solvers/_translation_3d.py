"""Translation between two point sets whose orientation is known.

Minimises sum_i w_i |y_i - x_i - t|^2: t is the weighted mean of the differences. What is left of `procrustes` when a
gyroscope or a vanishing point has told the rotation.
"""

import jax.numpy as jnp

from vojax._numerics import safe_divide
from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._implicit import implicit
from ._lanes import lanes_last
from ._weighted_points import Correspondences, corresponding_points, normal_weights


def _kernel(points0: Array, points1: Array, weights: Array) -> tuple[Array, Array]:
    """Arrays [n, 3, *lanes] and weights [n, *lanes]: translation [1, 3, *lanes] and validity [1, *lanes]."""
    weights, ok = normal_weights(weights, points0, points1)
    difference = jnp.where(ok[None, None], points1 - points0, 0.0)
    # Relative to one of them first, so that a long way rounds once.
    relative = difference - difference[:1]
    translation = difference[0] + jnp.sum(weights[:, None] * relative, axis=0)
    ok = ok & jnp.all(jnp.isfinite(translation), axis=0)
    return jnp.where(ok[None], translation, 0.0)[None], ok[None]


_solve = lanes_last(_kernel)


def _candidates(data: Correspondences) -> Candidates[Array]:
    models, valid = _solve(*data)
    return Candidates(models=models, valid=valid)


def _stationarity(translation: Array, data: Correspondences) -> Array:
    """Three equations: the mean residual."""
    points0, points1, weights = data
    weights = safe_divide(weights, jnp.broadcast_to(jnp.sum(weights), weights.shape))
    return jnp.sum(weights[:, None] * (points0 + translation[None] - points1), axis=0)


_translation_3d = implicit(_candidates, _stationarity, lambda model, tangent: model + tangent, 3)


def translation_3d(
    points0: Float[ArrayLike, "n 3"], points1: Float[ArrayLike, "n 3"], weights: Float[ArrayLike, "n"] | None = None
) -> Candidates[Array]:
    """Find the translation that takes `points0` to `points1` in the least-squares sense, without rotation.

    Args:
        points0: Points in frame 0, one per row, at least one.
        points1: The same points in frame 1, which has the same orientation.
        weights: One non-negative weight per point, as 1 / σ²; their common scale does not matter. All equal by default.

    Returns:
        One slot: the translation [3], `points1 ≈ points0 + model`.

    Degenerate input: negative weights, none at all, and anything not finite leave the slot invalid with zeros in it.
    Differentiability: both modes, any order, in points and weights; zero for an invalid slot.

    Raises:
        ValueError: If there is no point or the arrays do not match.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> bool(jnp.allclose(translation_3d(points, points + 2.0).models[0], 2.0))
        True
    """
    return _translation_3d(corresponding_points(points0, points1, weights, fewest=1))
