"""Similarity between two sets of corresponding points.

Minimises sum_i w_i |y_i - (s R x_i + t)|^2. R is that of the rigid problem (see `_procrustes`), and the best scale is
s = (s0 + s1 + s2) / sum_i w_i |x_i - x̄|^2 with the signed singular values of the correlation H.

References:
    S. Umeyama. Least-squares estimation of transformation parameters between two point patterns. PAMI 1991.
"""

import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Float
from vojax.lie import Sim3

from ._candidates import Candidates
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last
from ._procrustes import Correspondences, alignment_kernel, centred, correspondences


def umeyama(
    points0: Float[ArrayLike, "n 3"], points1: Float[ArrayLike, "n 3"], weights: Float[ArrayLike, "n"] | None = None
) -> Candidates[Sim3]:
    """Find the similarity (rotation, translation, scale) that takes `points0` to `points1` in the least-squares sense.

    The error is measured in frame 1; the inverse of the result is not the solution with the sets exchanged.

    Args:
        points0: Points in frame 0, one per row, at least three.
        points1: The same points in frame 1.
        weights: One non-negative weight per point; their common scale does not matter. All equal by default.

    Returns:
        One slot: `points1 ≈ model @ points0`. Its scale is positive and its rotation proper.

    Degenerate input: as `procrustes`; `points1` all coincident leave the slot invalid too, rather than scale zero.
    Differentiability: both modes, any order, in points and weights, by the implicit function theorem; exact where
        singular values coincide. Zero for an invalid slot.

    Raises:
        ValueError: If there are fewer than three points or the arrays do not match.
    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
        >>> candidates = umeyama(points, 3.0 * points)
        >>> bool(jnp.allclose(candidates.models.scale(), 3.0, atol=1e-5))
        True
    """
    return _umeyama(correspondences(points0, points1, weights))


def _stationarity(model: Sim3, data: Correspondences) -> Array:
    """Seven equations: torque, dilation and sum of the residuals."""
    x, y, mean0, mean1, weights = centred(data)
    rotated = model.rotation() @ x
    torque = jnp.sum(weights * jnp.cross(y, rotated), axis=0)
    dilation = jnp.sum(weights * rotated * (y - model.scale() * rotated))
    return jnp.concatenate([torque, model @ mean0 - mean1, dilation[None]])


_similarity = lanes_last(alignment_kernel(with_scale=True))


def _candidates(data: Correspondences) -> Candidates[Sim3]:
    models, valid = _similarity(*data)
    return Candidates(models=Sim3(models), valid=valid)


_umeyama = implicit(_candidates, _stationarity, perturb_camera, 7)
