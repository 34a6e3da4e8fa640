"""Scoring hypotheses: a sum over observations of a truncated or saturating loss, lower is better.

References: Torr & Zisserman, "MLESAC", 2000, sections 3 and 4; Fischler & Bolles, "Random sample consensus", 1981.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, Float
from vojax.ba import GaussianUniform

# Observations judged per pass over the models: 1.3 G residuals/s with one, 3.0 with eight, 2.5 with sixteen
# (jax 0.10.1).
_UNROLL = 8
_FEW_MODELS = 32

# squared_error(models, observation) -> [*lanes], elementwise over models [d, *lanes] and one observation's components.
SquaredError = Callable[[Array, tuple[Array, ...]], Array]


@runtime_checkable
class Score(Protocol):
    """What one observation adds to the score of a model; frozen, and a pytree."""

    def loss(self, squared_error: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Loss of a squared error, elementwise; lower is better, finite for an infinite error."""
        ...


def _check_positive(**values: Any) -> None:
    for name, value in values.items():
        if isinstance(value, (int, float)) and not value > 0:
            raise ValueError(f"{name} is {value}: expected a positive number")


class InlierCount(eqx.Module):
    """Minus one for each error within the threshold: RANSAC's own score. Its derivative is zero."""

    threshold: Float[Array, ""] | float

    def __check_init__(self) -> None:
        _check_positive(threshold=self.threshold)

    def loss(self, squared_error: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """−1 for an inlier, 0 for an outlier."""
        return jnp.where(squared_error <= self.threshold**2, -1.0, 0.0).astype(squared_error.dtype)


class Msac(eqx.Module):
    """Squared errors in units of the threshold, truncated there: 0 for a perfect observation, 1 for an outlier."""

    threshold: Float[Array, ""] | float

    def __check_init__(self) -> None:
        _check_positive(threshold=self.threshold)

    def loss(self, squared_error: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """min(e²/threshold², 1)."""
        return jnp.minimum(squared_error * (1.0 / self.threshold**2), 1.0)


class GaussianUniformScore(eqx.Module):
    """Minus the log-likelihood of Gaussian inliers among uniform outliers, 0 for a perfect observation.

    Smooth, and nearly what marginalising the scale gives (MAGSAC++). See `vojax.ba.GaussianUniform`.

    Attributes:
        sigma: Standard deviation of the error of an inlier, per component; `noise_scale` finds it.
        cut: Error in standard deviations at which an observation is as likely an outlier as an inlier.
    """

    sigma: Float[Array, ""] | float
    cut: Float[Array, ""] | float = 3.0

    def __check_init__(self) -> None:
        _check_positive(sigma=self.sigma, cut=self.cut)

    def loss(self, squared_error: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """½ρ(e²/σ²)."""
        return 0.5 * GaussianUniform(self.cut).rho(squared_error / self.sigma**2)


def sum_losses(
    loss: Callable[[Array], Array],
    squared_error: SquaredError,
    models: Float[Array, "d k"],
    observations: Any,
    weights: Float[Array, " n"],
) -> Float[Array, " k"]:
    """Score models in the lanes, one observation after the other.

    A scan over observations with the models innermost: the running sums stay in the cache, and nothing of the size
    models times observations is ever written.

    Args:
        loss: Of a squared error, elementwise.
        squared_error: Of models against one observation.
        models: Hypotheses in the lanes.
        observations: Tuple of component arrays `[n]`.
        weights: 1 for observations that count, 0 for padding.

    Returns:
        Σ w loss(e²).
    """

    def add(total: Array, observation: Any) -> tuple[Array, None]:
        *components, weight = observation
        return total + weight * loss(squared_error(models, tuple(components))), None

    start = jnp.zeros(models.shape[1:], models.dtype)
    total, _ = jax.lax.scan(add, start, (*observations, weights), unroll=_UNROLL)
    return total


def msac_scores(
    squared_error: SquaredError,
    models: Float[Array, "d k"],
    observations: Any,
    weights: Float[Array, " n"],
    limit: float,
) -> Float[Array, " k"]:
    """Score models in the lanes by Σ w min(e²/limit, 1): 0 for a perfect model, Σ w for a useless one.

    Args:
        squared_error: Of models against one observation.
        models: Hypotheses in the lanes.
        observations: Tuple of component arrays `[n]`.
        weights: 1 for observations that count, 0 for padding.
        limit: Squared threshold at which the error is truncated.
    """

    def loss(error: Array) -> Array:
        return jnp.minimum(error * (1.0 / limit), 1.0)

    if models.shape[1] <= _FEW_MODELS:
        # With the observations in the lanes instead: less to compile.
        errors = squared_error(models[:, :, None], tuple(component[None] for component in observations))
        return jnp.sum(weights[None] * loss(errors), axis=1)
    return sum_losses(loss, squared_error, models, observations, weights)
