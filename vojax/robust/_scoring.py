"""Scoring hypotheses: the sum over observations of a truncated squared error (MSAC), lower is better.

References: Torr & Zisserman, "MLESAC", 2000, section 3.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from vojax._types import Array, Float

# Observations judged per pass over the models: 1.3 G residuals/s with one, 3.0 with eight, 2.5 with sixteen
# (jax 0.10.1).
_UNROLL = 8

# squared_error(models, observation) -> [*lanes], elementwise over models [d, *lanes] and one observation's components.
SquaredError = Callable[[Array, tuple[Array, ...]], Array]


def msac_scores(
    squared_error: SquaredError,
    models: Float[Array, "d k"],
    observations: Any,
    weights: Float[Array, " n"],
    limit: float,
) -> Float[Array, " k"]:
    """Score models in the lanes, one observation after the other.

    A scan over observations with the models innermost is the layout that is fast on every jax version measured; a
    broadcast [models, observations] is up to ten times slower on some (benchmarks/RESULTS.md).

    Args:
        squared_error: Of models against one observation.
        models: Hypotheses in the lanes.
        observations: Tuple of component arrays `[n]`.
        weights: 1 for observations that count, 0 for padding.
        limit: Squared threshold at which the error is truncated.

    Returns:
        Σ w min(e²/limit, 1): 0 for a perfect model, the number of observations for a useless one.
    """

    def add(total: Array, observation: Any) -> tuple[Array, None]:
        *components, weight = observation
        error = squared_error(models, tuple(components))
        return total + weight * jnp.minimum(error * (1.0 / limit), 1.0), None

    start = jnp.zeros(models.shape[1:], models.dtype)
    total, _ = jax.lax.scan(add, start, (*observations, weights), unroll=_UNROLL)
    return total
