"""Several models in one set of observations, one after the other: the motions, or the planes, of a scene.

The estimator finds the model with most supporters, these are set aside, and it looks again at the rest, until what it
finds is no more than chance would give. Then each observation goes to the model that it agrees with best, as an early
model may have taken some that belong to a later one.

References: P. Torr, D. Murray. Outlier detection and motion segmentation. SPIE 1993; L. Moisan, B. Stival. A
probabilistic criterion to detect rigid point matches between two images. IJCV 2004.
"""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._result import Result
from vojax._types import Array, ArrayLike, Bool, Int, PRNGKeyArray

from ._estimate import Estimate
from ._hypotheses import squared_errors
from ._kinds import kind_of
from ._options import RansacOptions


class SeveralEstimates(eqx.Module):
    """Models of one set of observations.

    Attributes:
        estimates: With a leading axis for the models, in the order in which they were found, those with a consensus
            first; their inliers are those at the time.
        labels: For each observation the position of its model, −1 where it agrees with none.
        num_models: Estimates with a consensus.
    """

    estimates: Estimate[Any]
    labels: Int[Array, " n"]
    num_models: Int[Array, ""]


def estimate_several(
    estimator: Callable[..., Estimate[Any]],
    *observations: Any,
    key: PRNGKeyArray | Array,
    max_models: int = 2,
    options: RansacOptions | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
    gate: float = 2.0,
    **settings: Any,
) -> SeveralEstimates:
    """Estimate several models of one kind one after the other, and which observation belongs to which.

    Args:
        estimator: One of the `estimate_*` functions.
        observations: What it takes before its keyword arguments, in the same order.
        key: Random key; the same key gives the same answer, bit for bit.
        max_models: Most models looked for.
        options: Of each search; the estimator's own default where left out.
        mask: False for padding.
        gate: Observations within so many thresholds of a model belong to it: they are labelled, and the next search
            does not see them. At 1 what noise puts beyond the threshold would stay and could look like another model.
        settings: Further keyword arguments of the estimator: `quality`, `sigma_px` or `sigma`.

    Returns:
        The models and a label for each observation. Under `jit` the number of models searched is fixed; `num_models`
        says how many there are.

    Degenerate input: as of the estimator; the first search that ends without a consensus ends them all. Models that
        share a direction, as two motions along the same epipolar lines, can come out as one.
    Differentiability: the estimates as those of the estimator; labels are constant.

    Raises:
        ValueError: If the function is no estimator, numbers are out of range or shapes do not fit.
    References: see the module.
    """
    kind = kind_of(estimator)
    if max_models < 1:
        raise ValueError(f"max_models is {max_models}: expected at least 1")
    if not gate >= 1:
        raise ValueError(f"gate is {gate}: expected at least 1 threshold")
    judge = kind.judge(*observations)
    if mask is not None and jnp.shape(mask) != judge.mask.shape:
        raise ValueError(f"mask has shape {jnp.shape(mask)}: expected one entry for each of {len(judge.mask)} rows")
    chosen: RansacOptions = inspect.signature(estimator).parameters["options"].default if options is None else options
    counts = judge.mask if mask is None else judge.mask & jnp.asarray(mask)
    return _several(estimator, observations, key, max_models, chosen, counts, float(gate), settings)


@eqx.filter_jit
def _several(
    estimator: Callable[..., Estimate[Any]],
    observations: tuple[Any, ...],
    key: Any,
    max_models: int,
    options: RansacOptions,
    mask: Array,
    gate: float,
    settings: dict[str, Any],
) -> SeveralEstimates:
    limit = (gate * getattr(options, kind_of(estimator).threshold)) ** 2

    def search(remaining: Array, key: Any) -> tuple[Array, tuple[Estimate[Any], Array]]:
        found = estimator(*observations, key=key, options=options, mask=remaining, **settings)
        usable = (found.result == Result.success) | (found.result == Result.not_converged)
        error = jax.lax.stop_gradient(squared_errors(estimator, found.model, *observations))
        error = jnp.where(usable & mask, error, jnp.inf)
        # After a failure nothing remains, and the searches that are left end at once.
        return remaining & usable & (error > limit), (found, error)

    _, (estimates, errors) = jax.lax.scan(search, mask, jax.random.split(key, max_models))
    nearest = jnp.argmin(errors, axis=0)
    labels = jnp.where(jnp.min(errors, axis=0) <= limit, nearest, -1)
    usable = (estimates.result == Result.success) | (estimates.result == Result.not_converged)
    return SeveralEstimates(estimates, labels, jnp.sum(usable))
