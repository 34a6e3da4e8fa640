"""Judging given models: errors of every observation, and scores of many models at once."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float

from ._kinds import kind_of, lanes_of
from ._scoring import Score, sum_losses


def squared_errors(estimator: Callable[..., Any], model: Any, *observations: Any) -> Float[Array, " n"]:
    """Evaluate the error that an estimator judges observations by, squared.

    Args:
        estimator: One of the `estimate_*` functions.
        model: A model of the kind that it returns, at any scale where scale has no meaning; for
            `estimate_relative_pose` a pose or an essential matrix.
        observations: What the estimator takes before its keyword arguments, in the same order.

    Returns:
        Squared errors: px² of reprojections or Sampson distances, or the square of the unit of the points. Infinite
        where a point is behind its camera or an observation is not finite.

    Differentiability: both modes, in model and observations; zero where the error is infinite.

    Raises:
        ValueError: If the function is no estimator or shapes do not fit.

    Example:
        >>> import vojax
        >>> points = jnp.zeros((4, 3)).at[:, 0].set(jnp.arange(4.0))
        >>> [float(e) for e in squared_errors(vojax.estimate_rigid, vojax.SE3.identity(), points, points + 1.0)]
        [3.0, 3.0, 3.0, 3.0]
    """
    kind = kind_of(estimator)
    judge = kind.judge(*observations)
    error = judge.squared_error(kind.entries(model)[:, None], judge.observations)
    return jnp.where(judge.mask & ~jnp.isnan(error), error, jnp.inf)


def score_hypotheses(
    estimator: Callable[..., Any],
    models: Any,
    *observations: Any,
    score: Score,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Float[Array, " k"]:
    """Score many models against the observations of an estimator, models in the lanes.

    Args:
        estimator: One of the `estimate_*` functions.
        models: Models of the kind that it returns with a leading axis k; see `squared_errors`.
        observations: What the estimator takes before its keyword arguments, in the same order.
        score: `Msac(threshold)`, `InlierCount(threshold)`, `GaussianUniformScore(sigma)`, or anything with a `loss`.
        mask: False for padding.

    Returns:
        Σ of the score's loss over the observations that count, of each model: lower is better. (`softmax_weights` and
        its like take the negative.)

    Degenerate input: rows that are not finite count as masked; a model that is not finite scores as if every
        observation were infinitely wrong.
    Differentiability: both modes, in models and observations, as far as the score is.

    Raises:
        ValueError: If the function is no estimator or shapes do not fit.

    Example:
        >>> import jax
        >>> import vojax
        >>> from vojax.robust import InlierCount
        >>> points = jax.random.normal(jax.random.key(0), (50, 3))
        >>> shifts = jnp.zeros((3, 6)).at[:, 0].set(jnp.array([0.0, 0.04, 0.06]))
        >>> motions = jax.vmap(vojax.SE3.exp)(shifts)
        >>> [int(s) for s in score_hypotheses(vojax.estimate_rigid, motions, points, points, score=InlierCount(0.05))]
        [-50, -50, 0]
    """
    kind = kind_of(estimator)
    judge = kind.judge(*observations)
    if mask is not None and jnp.shape(mask) != judge.mask.shape:
        raise ValueError(f"mask has shape {jnp.shape(mask)}: expected one entry for each of {len(judge.mask)} rows")
    return _scores(kind, models, observations, score, mask)


@eqx.filter_jit
def _scores(kind: Any, models: Any, observations: tuple[Any, ...], score: Score, mask: Any) -> Array:
    judge = kind.judge(*observations)
    counts = judge.mask if mask is None else judge.mask & jnp.asarray(mask)
    entries = lanes_of(kind, models)
    dtype = jnp.result_type(entries, judge.observations[0])
    entries = entries.astype(dtype)
    usable = jnp.all(jnp.isfinite(entries), axis=0)

    def loss(error: Array) -> Array:
        error = jnp.where(jnp.isnan(error), jnp.inf, error).astype(dtype)
        return score.loss(jnp.where(usable, error, jnp.inf)).astype(dtype)

    entries = jnp.where(usable[None], entries, 0.0)
    return sum_losses(loss, judge.squared_error, entries, judge.observations, counts.astype(dtype))
