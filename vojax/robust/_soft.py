"""Soft selection: RANSAC whose outcome has a derivative, for what learns from it.

RANSAC draws minimal samples h₁ … h_k, solves and scores them and keeps one. Its expected loss

    L(h₁ … h_k) = Σ_j w_j ℓ(h_j),    w = softmax or sparsemax of the scores,                                     (1)

has derivatives in everything that solvers, scores and losses depend on. What guides the sampling (logits θ of the
observations) acts through probabilities, so its derivative is that of an expectation, by the score function:

    ∇ E[L] = E[ Σ_j (L − L₋ⱼ) ∇ log P(h_j; θ) ],                                                                (2)

where L₋ⱼ is the loss of the pool without sample j. It does not depend on h_j, so it is a baseline that leaves the
expectation as it is, and it gives each sample credit for just the difference it made.

References: E. Brachmann et al. DSAC – differentiable RANSAC for camera localization. CVPR 2017. E. Brachmann &
C. Rother. Neural-guided RANSAC. ICCV 2019. W. Kool, H. van Hoof & M. Welling. Buy 4 REINFORCE samples, get a baseline
for free! ICLR workshop 2019. A. Martins & R. Astudillo. From softmax to sparsemax. ICML 2016.
"""

import warnings
from collections.abc import Callable
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray
from vojax.solvers import Candidates

from ._soft_sampling import draw_gumbel_samples, sample_log_probability

Model = TypeVar("Model")
# How much each hypothesis counts: (scores [h], valid [h]) -> weights [h] that sum to 1, or all 0 if nothing is valid.
Selection = Callable[..., Array]


class Hypotheses(eqx.Module, Generic[Model]):
    """The models of k samples, s slots each.

    Attributes:
        models: Pytree with leading axes `[k, s]`; slots without a solution hold finite placeholders.
        valid: Which slots hold a solution.
        samples: Observations that each was made from, in ascending order.
        log_probability: Of drawing each sample; carries the derivative in the logits.
    """

    models: Model
    valid: Bool[Array, "k s"]
    samples: Int[Array, "k m"]
    log_probability: Float[Array, " k"]

    def map(self, function: Callable[..., Array], *arrays: ArrayLike) -> Array:
        """Evaluate errors or losses of all models: `function(model, *arrays)` with leading axes `[k, s]`.

        What has a derivative goes through `arrays`, not through a closure: slots that are not valid give no derivative
        to them, whatever the function does at a placeholder. 0 times NaN would reach all of them otherwise.
        """

        def one(model: Model, valid: Array) -> Array:
            return function(model, *(jnp.where(valid, x, jax.lax.stop_gradient(x)) for x in map(jnp.asarray, arrays)))

        return jax.vmap(jax.vmap(one))(self.models, self.valid)


def draw_hypotheses(
    key: PRNGKeyArray | Array,
    logits: Float[ArrayLike, " n"],
    solver: Callable[..., Candidates[Model]],
    *observations: ArrayLike,
    num_samples: int,
    sample_size: int,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Hypotheses[Model]:
    """Draw minimal samples by their logits and solve them.

    Args:
        key: Random key; the same key gives the same samples.
        logits: Of the observations: the probability of being drawn next is their softmax over what is left.
        solver: A minimal solver, such as those of `vojax.solvers`, called with `sample_size` rows of each of the
            observations.
        observations: Arrays `[n, ...]`, one row for each observation.
        num_samples: Samples k.
        sample_size: Observations m that the solver takes.
        mask: False for padding, which is not drawn and not read.

    Returns:
        Models, validity, samples and their log-probabilities.

    Degenerate input: with fewer usable observations than a sample needs no slot is valid, and nothing is NaN.

    Differentiability: models in the observations, as far as the solver has derivatives (those of `vojax.solvers` do);
        zero for slots that are not valid, whatever derivative comes back to them. `log_probability` in the logits.

    Raises:
        ValueError: If observations do not fit the logits, or the sample is larger than the data.

    References: see the module.

    Example:
        >>> from vojax.solvers import homography_four_point
        >>> pixels = jax.random.uniform(jax.random.key(0), (20, 2))
        >>> hypotheses = draw_hypotheses(
        ...     jax.random.key(1), jnp.zeros(20), homography_four_point, pixels, pixels, num_samples=8, sample_size=4
        ... )
        >>> hypotheses.models.shape, bool(hypotheses.valid.all())
        ((8, 1, 3, 3), True)
        >>> hypotheses.map(lambda model, x: (x @ model[:, :2].T)[:, 2], pixels).shape
        (8, 1, 20)
    """
    arrays = [jnp.asarray(x) for x in observations]
    n = jnp.asarray(logits).shape[0]
    for x in arrays:
        if x.shape[:1] != (n,):
            raise ValueError(f"observations of shape {x.shape} and {n} logits; expected a logit for each row")
    samples, drawn = draw_gumbel_samples(key, logits, num_samples=num_samples, sample_size=sample_size, mask=mask)
    if mask is not None:
        rows = jnp.asarray(mask)
        arrays = [jnp.where(rows.reshape(n, *(1,) * (x.ndim - 1)), x, jnp.zeros_like(x)) for x in arrays]
    # Samples in the lanes: the fast layout of the solvers.
    lanes = [jnp.moveaxis(x[samples], 0, -1) for x in arrays]
    candidates = jax.vmap(solver, in_axes=-1, out_axes=0)(*lanes)
    valid = candidates.valid & drawn[:, None]

    def without_derivative(x: Array) -> Array:
        # A loss may have a NaN for derivative at a placeholder, and 0 · NaN would reach the observations.
        return jnp.where(valid.reshape(*valid.shape, *(1,) * (x.ndim - 2)), x, jax.lax.stop_gradient(x))

    models = jax.tree.map(without_derivative, candidates.models)
    return Hypotheses(models, valid, samples, sample_log_probability(logits, samples, mask=mask))


def soft_inlier_count(
    squared_errors: Float[ArrayLike, "*batch n"],
    threshold: Float[ArrayLike, ""] | float,
    *,
    sharpness: Float[ArrayLike, ""] | float = 5.0,
    weights: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Float[Array, "*batch"]:
    """Count inliers softly: Σ w sigmoid(sharpness (1 − e/threshold)).

    Args:
        squared_errors: Of models against observations, e².
        threshold: Error that counts one half, in the unit of e.
        sharpness: The larger, the nearer to the count of errors below the threshold.
        weights: Of the observations; 1 where left out.
        mask: False for padding.

    Returns:
        Scores, higher is better.

    Degenerate input: errors that are infinite or NaN count nothing, with gradient 0.

    Differentiability: both modes, in errors, threshold, sharpness and weights; gradient 0 at an error of 0.

    References: E. Brachmann & C. Rother. Learning less is more – 6D camera localization via 3D surface regression.
    CVPR 2018.

    Example:
        >>> float(soft_inlier_count(jnp.array([0.0, 1.0, 1e6, jnp.inf]), 1.0, sharpness=100.0))
        1.5
    """
    squared_errors = jnp.asarray(squared_errors)
    counted = jnp.isfinite(squared_errors)
    lead = (1,) * (squared_errors.ndim - 1)
    if mask is not None:
        counted = counted & jnp.asarray(mask).reshape(*lead, -1)
    error = safe_sqrt(jnp.where(counted, squared_errors, 0.0))
    soft = jax.nn.sigmoid(sharpness * (1.0 - error / threshold))
    if weights is not None:
        soft = soft * jnp.asarray(weights).reshape(*lead, -1)
    return jnp.sum(jnp.where(counted, soft, 0.0), axis=-1)


def softmax_weights(
    scores: Float[ArrayLike, " h"],
    valid: Bool[ArrayLike, " h"] | None = None,
    *,
    temperature: Float[ArrayLike, ""] | float = 1.0,
) -> Float[Array, " h"]:
    """Weigh hypotheses by exp(score/temperature): all have a share, and a gradient.

    Args:
        scores: Of the hypotheses, higher is better.
        valid: False for those that are none; nor are those whose score is not finite.
        temperature: Difference of scores that makes a factor e.

    Returns:
        Weights that sum to 1; all 0 where nothing is valid.

    Differentiability: both modes.

    Example:
        >>> [round(float(w), 3) for w in softmax_weights(jnp.log(jnp.array([1.0, 2.0, 7.0])))]
        [0.1, 0.2, 0.7]
    """
    below, valid = _below_best(scores, valid, temperature)
    share = jnp.where(valid, jnp.exp(below), 0.0)
    return share / jnp.maximum(jnp.sum(share), 1.0)  # the best has 1


def sparsemax_weights(
    scores: Float[ArrayLike, " h"],
    valid: Bool[ArrayLike, " h"] | None = None,
    *,
    temperature: Float[ArrayLike, ""] | float = 1.0,
) -> Float[Array, " h"]:
    """Weigh hypotheses by the point of the simplex nearest to score/temperature: only the best few have a share.

    Args:
        scores: Of the hypotheses, higher is better.
        valid: False for those that are none; nor are those whose score is not finite.
        temperature: Difference of scores that gives one hypothesis all the weight against one other.

    Returns:
        Weights that sum to 1; all 0 where nothing is valid.

    Differentiability: both modes, almost everywhere; hypotheses with weight 0 have gradient 0.

    References: Martins & Astudillo 2016.

    Example:
        >>> [round(float(w), 3) for w in sparsemax_weights(jnp.array([1.0, 0.6, -3.0]))]
        [0.7, 0.3, 0.0]
    """
    below, valid = _below_best(scores, valid, temperature)
    # More than 1 below the best is outside the support; −2 keeps the sums of a float32 exact.
    weights = _project_to_simplex(jnp.where(valid, jnp.maximum(below, -2.0), -2.0))
    return jnp.where(valid, weights, 0.0)


def argmax_weights(scores: Float[ArrayLike, " h"], valid: Bool[ArrayLike, " h"] | None = None) -> Float[Array, " h"]:
    """All the weight for the best hypothesis, as RANSAC chooses: no gradient in the scores.

    Args:
        scores: Of the hypotheses, higher is better; the first of equals wins.
        valid: False for those that are none; nor are those whose score is not finite.

    Returns:
        A 1 among zeros; all 0 where nothing is valid.

    Differentiability: both modes; the derivative is zero.
    """
    below, valid = _below_best(scores, valid, 1.0)
    best = jnp.argmax(jnp.where(valid, jax.lax.stop_gradient(below), -jnp.inf))
    return (valid & (jnp.arange(below.shape[0]) == best)).astype(below.dtype)


def expected_loss(
    losses: Float[ArrayLike, "k s"],
    scores: Float[ArrayLike, "k s"],
    valid: Bool[ArrayLike, "k s"],
    log_probability: Float[ArrayLike, " k"] | None = None,
    *,
    failure_loss: Float[ArrayLike, ""] | float,
    select: Selection = softmax_weights,
) -> Float[Array, ""]:
    """Expected loss of the hypothesis that is chosen, equation (1), with the derivative of equation (2).

    Args:
        losses: Of the models of k samples with s slots each, against the truth that is learned from.
        scores: Of the same models, higher is better, without knowledge of the truth.
        valid: Which of them are models. Those whose loss or score is not finite are none either.
        log_probability: Of drawing each sample, from `draw_hypotheses`. The derivative then has the part of equation
            (2); leave it out where nothing guides the sampling.
        failure_loss: Loss where there is no model at all.
        select: Weights of the hypotheses: `softmax_weights` or `sparsemax_weights` (with another temperature by
            `functools.partial`), or `argmax_weights`, which is what RANSAC does.

    Returns:
        The loss of this pool. Its gradient is an unbiased estimate of that of the expectation over pools.

    Degenerate input: without any valid hypothesis the loss is `failure_loss`, with gradient 0; never NaN.

    Differentiability: first order, reverse and forward, in losses, scores and log-probabilities. The part of the score
        function is a surrogate: its second derivatives mean nothing. It weighs the pool k times, k² s in all.

    References: see the module.

    Example:
        >>> losses, scores = jnp.array([[1.0], [3.0]]), jnp.zeros((2, 1))
        >>> float(expected_loss(losses, scores, jnp.ones((2, 1), bool), failure_loss=10.0))
        2.0
        >>> float(expected_loss(losses, scores, jnp.zeros((2, 1), bool), failure_loss=10.0))
        10.0
    """
    losses, scores, valid = jnp.asarray(losses), jnp.asarray(scores), jnp.asarray(valid)
    if not losses.ndim == 2 or not losses.shape == scores.shape == valid.shape:
        raise ValueError(
            f"losses {losses.shape}, scores {scores.shape} and valid {valid.shape}; expected (k, s) for all three: "
            "k samples with s slots each"
        )
    usable = valid & jnp.isfinite(losses) & jnp.isfinite(scores)
    losses, scores = jnp.where(usable, losses, 0.0), jnp.where(usable, scores, 0.0)
    failure = jnp.asarray(failure_loss, losses.dtype)

    def pool_loss(losses: Array, scores: Array, usable: Array) -> Array:
        weights = select(scores.reshape(-1), usable.reshape(-1))
        return jnp.where(jnp.any(usable), jnp.sum(weights * losses.reshape(-1)), failure)

    loss = pool_loss(losses, scores, usable)
    if log_probability is None:
        return loss
    log_probability = jnp.asarray(log_probability)
    k = losses.shape[0]
    if log_probability.shape != (k,):
        raise ValueError(f"log_probability has shape {log_probability.shape}; expected one of each sample, ({k},)")
    fixed_losses, fixed_scores = jax.lax.stop_gradient((losses, scores))
    others = ~jnp.eye(k, dtype=bool)
    without = jax.vmap(lambda other: pool_loss(fixed_losses, fixed_scores, usable & other[:, None]))(others)
    credit = jax.lax.stop_gradient(loss - without)
    # Zero in value, the score function in the derivative.
    return loss + jnp.sum(credit * (log_probability - jax.lax.stop_gradient(log_probability)))


def _below_best(
    scores: ArrayLike, valid: ArrayLike | None, temperature: ArrayLike | float
) -> tuple[Float[Array, " h"], Bool[Array, " h"]]:
    """(score − best score)/temperature, 0 where not valid, and which are valid: finite too."""
    scores = jnp.asarray(scores)
    if scores.ndim != 1:
        raise ValueError(f"scores have shape {scores.shape}; expected one number for each hypothesis, (h,)")
    finite = jnp.isfinite(scores)
    valid = finite if valid is None else finite & jnp.asarray(valid)
    best = jax.lax.stop_gradient(jnp.max(jnp.where(valid, scores, -jnp.inf)))
    # Weights do not change with a constant on all scores, so the best need no derivative.
    return jnp.where(valid, scores - best, 0.0) / temperature, valid


def _project_to_simplex(x: Float[Array, " h"]) -> Float[Array, " h"]:
    """Jaxopt's projection, imported on first use: that warns of its retirement and takes a while."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
        from jaxopt.projection import projection_simplex
    return projection_simplex(x)
