"""The noise of the inliers from errors that have outliers among them: profile likelihood of a mixture.

Errors e of d components are Gaussian with standard deviation σ with probability γ, else uniform in a ball of volume V:

    p(e) = γ (2πσ²)^(−d/2) exp(−|e|²/2σ²) + (1 − γ) / V.                                                         (1)

Expectation–maximisation from a grid of scales finds the likelihood's highest maximum over all errors. Wrong
observations are uniform at best near the model, so the last steps look at a ball of a dozen deviations only, where
those that are in it say how dense they are.

References: Torr & Zisserman, "MLESAC", 2000, section 4; Dempster, Laird & Rubin, "Maximum likelihood from incomplete
data via the EM algorithm", 1977.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import safe_sqrt, tiny
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.solvers import Candidates, implicit

_STARTS = 32
_STEPS = 24  # of each start
_FINAL_STEPS = 48
_WINDOW = 12.0  # deviations around the model in which wrong observations are taken for uniform


class NoiseScale(eqx.Module):
    """The noise of inliers.

    Attributes:
        sigma: Standard deviation of each component of the error, in its unit; 0 where no error counts.
        inlier_share: Of the errors that count, infinite ones included.
    """

    sigma: Float[Array, ""]
    inlier_share: Float[Array, ""]


def noise_scale(
    squared_errors: Float[ArrayLike, " n"],
    *,
    dimension: int,
    model_dof: int = 0,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> NoiseScale:
    """Estimate the noise of the inliers from the errors of a model, outliers among them.

    `vojax.ba.mad_scale` does that for signed residuals of which less than half are wrong; this also where most are.

    Args:
        squared_errors: Of all observations at a model that is about right, as from `vojax.robust.squared_errors`.
        dimension: Components d of an error: 1 for distances from epipolar lines, 2 for pixels (reprojections,
            homographies), 3 for points.
        model_dof: Degrees of freedom of the model if it was fitted to these observations, which made their errors
            smaller: σ² is multiplied by N d / (N d − dof) for N inliers.
        mask: False for padding.

    Returns:
        Standard deviation and share of the inliers.

    Degenerate input: errors that are NaN do not count, infinite ones are outliers; without any finite error σ is 0.
        With more than a tenth of the errors exactly zero it is 0 or next to it.
    Differentiability: both modes, in the errors, by the implicit function theorem; the window of the last steps is
        constant, which leaves out less than a thousandth.

    Raises:
        ValueError: If shapes or numbers do not fit.
    References: see the module.

    Example:
        >>> import jax
        >>> errors = 0.7 * jax.random.normal(jax.random.key(0), (1000,))
        >>> errors = errors.at[:600].set(jax.random.uniform(jax.random.key(1), (600,), minval=-500.0, maxval=500.0))
        >>> found = noise_scale(errors**2, dimension=1)
        >>> bool(abs(found.sigma - 0.7) < 0.05), bool(abs(found.inlier_share - 0.4) < 0.02)
        (True, True)
    """
    squared = jnp.asarray(squared_errors)
    if squared.ndim != 1 or squared.shape[0] == 0:
        raise ValueError(f"squared_errors has shape {squared.shape}: expected one for each observation, (n,)")
    if dimension < 1 or model_dof < 0:
        raise ValueError(f"dimension is {dimension} and model_dof {model_dof}: expected at least 1 and at least 0")
    counted = ~jnp.isnan(squared)
    if mask is not None:
        if jnp.shape(mask) != squared.shape:
            raise ValueError(f"mask has shape {jnp.shape(mask)}: expected that of squared_errors, {squared.shape}")
        counted = counted & jnp.asarray(mask)
    return _noise_scale(squared, counted, dimension, model_dof)


@eqx.filter_jit
def _noise_scale(squared: Array, counted: Array, dimension: int, model_dof: int) -> NoiseScale:
    d = dimension
    finite = counted & jnp.isfinite(squared)
    squared = jnp.where(finite, jnp.maximum(squared, 0.0), 0.0)
    constant = jax.lax.stop_gradient(squared)
    rough = _highest_maximum(constant, finite, d)
    found = rough > 0
    unit = jnp.where(found, rough, 1.0)
    near = finite & (constant <= (_WINDOW * unit) ** 2)
    scaled = jnp.where(near, squared / (unit * unit), 0.0)
    weights = near.astype(squared.dtype)
    data = (scaled, weights, _ball(jnp.full_like(unit, _WINDOW), d))
    log_sigma, logit = _maximum(d)(data).models[0]
    total = jnp.sum(weights) * jax.nn.sigmoid(logit)
    share = total / jnp.maximum(jnp.sum(counted), 1)
    freedom = total * d
    factor = freedom / jnp.maximum(freedom - model_dof, 1.0)
    sigma = jnp.where(found, unit * jnp.exp(log_sigma) * safe_sqrt(factor), 0.0)
    return NoiseScale(sigma, jnp.where(found, share, jnp.where(jnp.any(finite), 1.0, 0.0).astype(share.dtype)))


def _ball(radius: Array, d: int) -> Array:
    """Volume."""
    return math.pi ** (0.5 * d) / math.gamma(0.5 * d + 1.0) * radius**d


def _log_odds(squared: Array, variance: Array, share: Array, volume: Array, d: int) -> Array:
    """Logarithm of how much more likely an error is an inlier's than not."""
    log_density = -0.5 * (squared / variance + d * jnp.log(2.0 * math.pi * variance))
    return log_density + jnp.log(share) - jnp.log1p(-share) + jnp.log(volume)


def _expectation_maximisation(
    start: Array, squared: Array, weights: Array, volume: Array, floor: Array, d: int, steps: int
) -> tuple[Array, Array]:
    """Variance and share from a start of the variance.

    One inlier and one outlier are counted in advance, the prior γ(1 − γ), so that neither share is ever 0.
    """
    count = jnp.sum(weights)

    def step(_: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        variance, share = state
        inlier = weights * jax.nn.sigmoid(_log_odds(squared, variance, share, volume, d))
        total = jnp.sum(inlier)
        spread = jnp.sum(inlier * squared) / (d * jnp.maximum(total, tiny(squared)))
        return jnp.maximum(spread, floor), (total + 1.0) / (count + 2.0)

    return jax.lax.fori_loop(0, steps, step, (start, jnp.full_like(start, 0.5)))


def _log_posterior(parameters: Array, squared: Array, weights: Array, volume: Array, d: int) -> Array:
    log_sigma, logit = parameters
    share = jax.nn.sigmoid(logit)
    odds = _log_odds(squared, jnp.exp(2.0 * log_sigma), share, volume, d)
    # The density of outliers is a constant factor: log((1 − γ)/V) + log(1 + odds).
    outlier = jax.nn.log_sigmoid(-logit) - jnp.log(volume)
    prior = jax.nn.log_sigmoid(logit) + jax.nn.log_sigmoid(-logit)
    return jnp.sum(weights * (outlier + jax.nn.softplus(odds))) + prior


def _highest_maximum(squared: Array, counted: Array, d: int) -> Float[Array, ""]:
    """Scale of the highest of the likelihood's maxima over all errors."""
    largest = jnp.max(squared)
    unit = jnp.where(largest > 0, largest, 1.0)
    scaled = squared / unit
    weights = counted.astype(squared.dtype)
    # The likelihood is infinite at a scale of zero around any error that is zero: no smaller than a tenth of what the
    # smallest tenth of the errors has.
    ordered = jnp.sort(jnp.where(counted, scaled, jnp.inf))
    tenth = ordered[jnp.clip(jnp.sum(counted) // 10, 0, squared.shape[0] - 1)]
    eps = float(jnp.finfo(squared.dtype).eps)
    floor = jnp.maximum(0.01 * jnp.where(jnp.isfinite(tenth), tenth, 1.0), eps**2)
    starts = jnp.exp(jnp.log(floor) * (1.0 - jnp.linspace(0.0, 1.0, _STARTS, dtype=squared.dtype)))
    volume = _ball(jnp.ones((), squared.dtype), d)

    def climb(start: Array) -> tuple[Array, Array]:
        variance, share = _expectation_maximisation(start, scaled, weights, volume, floor, d, _STEPS)
        parameters = jnp.stack([0.5 * jnp.log(variance), jnp.log(share) - jnp.log1p(-share)])
        return variance, _log_posterior(parameters, scaled, weights, volume, d)

    variances, heights = jax.vmap(climb)(starts)
    best = variances[jnp.argmax(heights)]
    return jnp.where(largest > 0, jnp.sqrt(best * unit), 0.0)


def _maximum(d: int) -> Any:
    """The maximum of the windowed likelihood about unit scale, with its derivative in the errors."""

    def solve(data: tuple[Array, Array, Array]) -> Candidates[Array]:
        squared, weights, volume = data
        one = jnp.ones((), squared.dtype)
        floor = jnp.asarray(1e-4, squared.dtype)
        variance, share = _expectation_maximisation(one, squared, weights, volume, floor, d, _FINAL_STEPS)
        model = jnp.stack([0.5 * jnp.log(variance), jnp.log(share) - jnp.log1p(-share)])
        return Candidates(model[None], (jnp.sum(weights) > 0)[None])

    def stationarity(model: Array, data: tuple[Array, Array, Array]) -> Array:
        squared, weights, volume = data
        volume = jnp.where(volume > 0, volume, 1.0)  # zero stands in for what is not valid
        return jax.grad(_log_posterior)(model, squared, weights, volume, d)

    return implicit(solve, stationarity, lambda model, tangent: model + tangent, 2)
