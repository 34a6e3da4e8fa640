"""Least-squares alignment of two images' points by a motion of the plane; `_plane_motions` has the equations.

One function per family, from the stiffest to the most flexible. The residuals are those of the transfer into image 1,
with a weight or a covariance per point there.

References:
    R. Szeliski. Computer Vision: Algorithms and Applications, 2nd edition, section 8.1.
"""

from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._plane_motions import plane_motion


def align_2d_translation(
    points0: Float[ArrayLike, "n 2"],
    points1: Float[ArrayLike, "n 2"],
    weights: Float[ArrayLike, "n"] | None = None,
    covariance1: Float[ArrayLike, "n 2 2"] | None = None,
) -> Candidates[Array]:
    """Find the translation of least transfer error from image 0 to image 1.

    Linear.

    Args:
        points0: Points of image 0, one per row, at least one.
        points1: The same points in image 1.
        weights: One non-negative weight per point, as 1 / σ²; their common scale does not matter. All equal by default.
        covariance1: Covariances of `points1`, divided by the weights if both are given. Isotropic by default.

    Returns:
        One slot: the matrix [3, 3] [[1, 0, tx], [0, 1, ty], [0, 0, 1]]. `align_2d_covariance` has the covariance of its
        parameters.

    Degenerate input: no weight at all, negative weights, covariances that are not positive definite and anything not
        finite leave the slot invalid with the identity in it.
    Differentiability: both modes, any order, in points, weights and covariances, by the implicit function theorem; zero
        for an invalid slot.

    Raises:
        ValueError: If there are too few points or the arrays do not match.
    References: see the module.

    Example:
        >>> import jax.numpy as jnp
        >>> points = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 2.0]])
        >>> candidates = align_2d_translation(points, points + 3.0)
        >>> bool(jnp.allclose(candidates.models[0, :2, 2], 3.0, atol=1e-4))
        True
    """
    return plane_motion("translation", points0, points1, weights, covariance1)


def align_2d_euclidean(
    points0: Float[ArrayLike, "n 2"],
    points1: Float[ArrayLike, "n 2"],
    weights: Float[ArrayLike, "n"] | None = None,
    covariance1: Float[ArrayLike, "n 2 2"] | None = None,
) -> Candidates[Array]:
    """Find the rotation and translation of least transfer error from image 0 to image 1.

    In closed form for equal or scalar weights, then damped Gauss-Newton steps.

    Args:
        points0: Points of image 0, one per row, at least two.
        points1: The same points in image 1.
        weights: One non-negative weight per point, as 1 / σ²; their common scale does not matter. All equal by default.
        covariance1: Covariances of `points1`, divided by the weights if both are given. Isotropic by default.

    Returns:
        One slot: the matrix [3, 3] [[c, -s, tx], [s, c, ty], [0, 0, 1]]. `align_2d_covariance` has the covariance of
        its parameters.

    Degenerate input: coincident points in either image, sets whose best rotation is not unique, negative weights,
        covariances that are not positive definite and anything not finite leave the slot invalid with the identity in
        it.
    Differentiability: both modes, any order, in points, weights and covariances, by the implicit function theorem; zero
        for an invalid slot.

    Raises:
        ValueError: If there are too few points or the arrays do not match.
    References: see the module.

    Example:
        >>> import jax.numpy as jnp
        >>> points = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 2.0]])
        >>> candidates = align_2d_euclidean(points, points @ jnp.array([[0.0, 1.0], [-1.0, 0.0]]))
        >>> bool(jnp.allclose(candidates.models[0, 1, 0], 1.0, atol=1e-4))
        True
    """
    return plane_motion("euclidean", points0, points1, weights, covariance1)


def align_2d_similarity(
    points0: Float[ArrayLike, "n 2"],
    points1: Float[ArrayLike, "n 2"],
    weights: Float[ArrayLike, "n"] | None = None,
    covariance1: Float[ArrayLike, "n 2 2"] | None = None,
) -> Candidates[Array]:
    """Find the similarity (rotation, scale, translation) of least transfer error from image 0 to image 1.

    Linear.

    Args:
        points0: Points of image 0, one per row, at least two.
        points1: The same points in image 1.
        weights: One non-negative weight per point, as 1 / σ²; their common scale does not matter. All equal by default.
        covariance1: Covariances of `points1`, divided by the weights if both are given. Isotropic by default.

    Returns:
        One slot: the matrix [3, 3] [[a, -b, tx], [b, a, ty], [0, 0, 1]]. `align_2d_covariance` has the covariance of
        its parameters.

    Degenerate input: coincident points in image 0, negative weights, covariances that are not positive definite and
        anything not finite leave the slot invalid with the identity in it.
    Differentiability: both modes, any order, in points, weights and covariances, by the implicit function theorem; zero
        for an invalid slot.

    Raises:
        ValueError: If there are too few points or the arrays do not match.
    References: see the module.

    Example:
        >>> import jax.numpy as jnp
        >>> points = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 2.0]])
        >>> candidates = align_2d_similarity(points, 2.0 * points)
        >>> bool(jnp.allclose(candidates.models[0, 0, 0], 2.0, atol=1e-4))
        True
    """
    return plane_motion("similarity", points0, points1, weights, covariance1)


def align_2d_affine(
    points0: Float[ArrayLike, "n 2"],
    points1: Float[ArrayLike, "n 2"],
    weights: Float[ArrayLike, "n"] | None = None,
    covariance1: Float[ArrayLike, "n 2 2"] | None = None,
) -> Candidates[Array]:
    """Find the affine map of least transfer error from image 0 to image 1.

    Linear.

    Args:
        points0: Points of image 0, one per row, at least three.
        points1: The same points in image 1.
        weights: One non-negative weight per point, as 1 / σ²; their common scale does not matter. All equal by default.
        covariance1: Covariances of `points1`, divided by the weights if both are given. Isotropic by default.

    Returns:
        One slot: the matrix [3, 3] [[a00, a01, a02], [a10, a11, a12], [0, 0, 1]]. `align_2d_covariance` has the
        covariance of its parameters.

    Degenerate input: points of image 0 on a line (thinner than about 2e-3 of their length in float32), negative
        weights, covariances that are not positive definite and anything not finite leave the slot invalid with the
        identity in it.
    Differentiability: both modes, any order, in points, weights and covariances, by the implicit function theorem; zero
        for an invalid slot.

    Raises:
        ValueError: If there are too few points or the arrays do not match.
    References: see the module.

    Example:
        >>> import jax.numpy as jnp
        >>> points = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 2.0]])
        >>> candidates = align_2d_affine(points, points * jnp.array([[2.0, 3.0]]))
        >>> bool(jnp.allclose(candidates.models[0, 1, 1], 3.0, atol=1e-4))
        True
    """
    return plane_motion("affine", points0, points1, weights, covariance1)


def align_2d_projective(
    points0: Float[ArrayLike, "n 2"],
    points1: Float[ArrayLike, "n 2"],
    weights: Float[ArrayLike, "n"] | None = None,
    covariance1: Float[ArrayLike, "n 2 2"] | None = None,
) -> Candidates[Array]:
    """Find the homography of least transfer error from image 0 to image 1.

    From `homography_dlt` by damped Gauss-Newton steps.

    Args:
        points0: Points of image 0, one per row, at least four.
        points1: The same points in image 1.
        weights: One non-negative weight per point, as 1 / σ²; their common scale does not matter. All equal by default.
        covariance1: Covariances of `points1`, divided by the weights if both are given. Isotropic by default.

    Returns:
        One slot: the matrix [3, 3] H, of Frobenius norm 1 with the entry of largest magnitude positive.
        `align_2d_covariance` has the covariance of its parameters.

    Degenerate input: what leaves `homography_dlt` without an answer, an H that takes the centroid to infinity, negative
        weights, covariances that are not positive definite and anything not finite leave the slot invalid with zeros in
        it.
    Differentiability: both modes, any order, in points, weights and covariances, by the implicit function theorem; zero
        for an invalid slot.

    Raises:
        ValueError: If there are too few points or the arrays do not match.
    References: see the module.

    Example:
        >>> import jax.numpy as jnp
        >>> points = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 2.0]])
        >>> candidates = align_2d_projective(points, 2.0 * points)
        >>> bool(jnp.allclose(candidates.models[0, 0, 0] / candidates.models[0, 2, 2], 2.0, atol=1e-4))
        True
    """
    return plane_motion("projective", points0, points1, weights, covariance1)
