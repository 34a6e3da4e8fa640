"""Statistics over many estimates: area under the recall curve, normalised squared error."""

import jax.numpy as jnp

from vojax._numerics import cholesky_solve
from vojax._types import Array, ArrayLike, Float


def pose_auc(errors: Float[ArrayLike, "*batch n"], thresholds: Float[ArrayLike, "t"]) -> Float[Array, "*batch t"]:
    """Compute the exact area under the recall curve up to each threshold, divided by the threshold.

    Recall as a function of the error is taken as piecewise linear: it runs from 0 at error 0 through i/n at the i-th
    smallest error, and stays level from the last error below the threshold on.

    Args:
        errors: One error per problem. Failures count as infinite: give them `inf` or NaN.
        thresholds: Positive, in the unit of the errors.

    Returns:
        Areas between 0 and 1.

    Degenerate input: failures only give 0.

    Differentiability: both modes, almost everywhere.

    Example:
        >>> import jax.numpy as jnp
        >>> [round(float(a), 3) for a in pose_auc(jnp.array([1.0, 3.0, jnp.inf, jnp.inf]), jnp.array([5.0, 10.0]))]
        [0.375, 0.438]
    """
    errors, thresholds = jnp.asarray(errors), jnp.asarray(thresholds, jnp.asarray(errors).dtype)
    n = errors.shape[-1]
    lead = (1,) * (errors.ndim - 1)
    limit = thresholds.reshape(*lead, -1, 1)
    ordered = jnp.sort(jnp.where(jnp.isfinite(errors), errors, jnp.inf), axis=-1)[..., None, :]
    inside = ordered < limit
    reached = jnp.where(inside, ordered, 0.0)
    before = jnp.concatenate([jnp.zeros_like(reached[..., :1]), reached[..., :-1]], axis=-1)
    middle_recall = ((jnp.arange(n, dtype=errors.dtype) + 0.5) / n).reshape(*lead, 1, n)
    rising = jnp.sum(jnp.where(inside, (reached - before) * middle_recall, 0.0), axis=-1)
    recall = jnp.sum(inside, axis=-1).astype(errors.dtype) / n
    level = (limit[..., 0] - jnp.max(reached, axis=-1)) * recall
    return (rising + level) / limit[..., 0]


def nees(error: Float[ArrayLike, "*batch d"], covariance: Float[ArrayLike, "*batch d d"]) -> Float[Array, "*batch"]:
    """Compute the normalised estimation error squared, eᵀ Σ⁻¹ e.

    If errors are Gaussian and Σ is their covariance, it follows the χ² distribution with d degrees of freedom, mean d.

    Args:
        error: Errors, in the same coordinates as the covariance (for poses: the tangent ξ of `T @ exp(ξ)`).
        covariance: Claimed covariances; the lower triangle is read.

    Returns:
        One value per error.

    Degenerate input: where Σ is not positive definite to working precision, the largest finite number.

    Differentiability: both modes.

    Example:
        >>> import jax.numpy as jnp
        >>> float(nees(jnp.array([3.0, 1.0]), jnp.array([[9.0, 0.0], [0.0, 1.0]])))
        2.0
    """
    error, covariance = jnp.asarray(error), jnp.asarray(covariance)
    solution, ok = cholesky_solve(jnp.moveaxis(covariance, (-2, -1), (0, 1)), jnp.moveaxis(error, -1, 0)[:, None])
    value = jnp.sum(error * jnp.moveaxis(solution[:, 0], 0, -1), axis=-1)
    return jnp.where(ok, value, jnp.finfo(value.dtype).max)
