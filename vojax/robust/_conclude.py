"""The end of every estimate: is the consensus meaningful, and what comes out if it is not."""

from typing import Any

import jax
import jax.numpy as jnp

from vojax._result import Result
from vojax._types import Array, Bool, Float, Int

from ._engine import Consensus
from ._estimate import Estimate
from ._significance import is_significant


def conclude(
    model: Any,
    covariance: Float[Array, "t t"],
    refined: Result,
    squared_error: Float[Array, " n"],
    *,
    placeholder: Any,
    consensus: Consensus,
    mask: Bool[Array, " n"],
    sample_size: int,
    chance: Float[Array, ""],
    limit: float,
) -> Estimate[Any]:
    """Put an estimate together.

    Args:
        model: After the last refinement.
        covariance: Of its tangent.
        refined: How the refinement ended.
        squared_error: Of the observations at the refined model; large where impossible.
        placeholder: What stands for the model where there is none.
        consensus: Of the search.
        mask: Observations that count.
        sample_size: Of a minimal sample.
        chance: Probability that an observation agrees with a model by chance.
        limit: Squared threshold.
    """
    squared_error = jax.lax.stop_gradient(squared_error)
    count = jnp.sum(mask)
    inliers = mask & (squared_error <= limit)
    score = jnp.sum(jnp.where(mask, jnp.minimum(squared_error / limit, 1.0), 0.0))
    num_inliers: Int[Array, ""] = jnp.sum(inliers)
    agreed = is_significant(num_inliers, count, sample_size, chance)
    result = Result.where(agreed, refined, Result.no_consensus)
    # Where not one sample could be solved, it is the observations that are at fault.
    result = Result.where(jnp.any(consensus.model != 0), result, Result.degenerate)
    result = Result.where(count > sample_size, result, Result.too_few)
    usable = (result == Result.success) | (result == Result.not_converged)
    return Estimate(
        jax.tree.map(lambda x, other: jnp.where(usable, x, other), model, placeholder),
        inliers & usable,
        jnp.where(usable, num_inliers, 0),
        jnp.where(usable, score, count.astype(score.dtype)),
        consensus.num_hypotheses,
        jnp.where(usable, covariance, 0.0),
        result,
    )
