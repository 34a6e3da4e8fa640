"""Batched RANSAC: thousands of hypotheses at once, on any estimator.

Draw a chunk of minimal samples, solve them in the lanes, judge all on a subset of the observations and the survivors on
all of them, polish the best few and keep the best; stop when confident. Everything here sees constants only:
derivatives belong to the last refinement, which is the caller's.

References: Fischler & Bolles, "Random sample consensus", 1981; Chum, Matas & Kittler, "Locally optimized RANSAC", 2003.
"""

from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from vojax._types import Array, Bool, Float, Int

from ._options import RansacOptions
from ._sampling import (
    draw_samples,
    guided_pool,
    random_uniform,
    required_guided_hypotheses,
    required_hypotheses,
    sampling_order,
)
from ._scoring import msac_scores

# Local optimisation is for chunks whose best sample explains this share of what the best sample so far explains. With
# 1.0 (only a new best) relative poses with 70 % of outliers lose 0.04 of AUC@5°, with 0.8 nothing.
_PROMISING = 0.8


@runtime_checkable
class Estimator(Protocol):
    """A kind of model, a vector of `model_size` numbers, with the observations it is estimated from; a pytree."""

    model_size: int
    sample_size: int
    chunk_size: int
    limit: float

    @property
    def observations(self) -> tuple[Array, ...]:
        """Components of the observations, `[n]` each."""
        ...

    def hypothesize(self, sample: Int[Array, "m k"]) -> tuple[Float[Array, "d ks"], Bool[Array, " ks"]]:
        """Solve minimal samples; the solutions of one sample stand in different lanes."""
        ...

    def squared_error(self, models: Float[Array, "d *lanes"], observation: tuple[Array, ...]) -> Array:
        """Squared error of models against observations, elementwise; infinite or large where impossible."""
        ...

    def polish(self, model: Float[Array, " d"], mask: Bool[Array, " n"]) -> Float[Array, " d"]:
        """Improve one model on what agrees with it among the observations that count."""
        ...


class Consensus(eqx.Module):
    """The best model of a search."""

    model: Float[Array, " d"]
    inliers: Bool[Array, " n"]
    score: Float[Array, ""]
    num_hypotheses: Int[Array, ""]


class _State(eqx.Module):
    chunk: Int[Array, ""]
    model: Float[Array, " d"]
    score: Float[Array, ""]
    sampled: Float[Array, ""]  # the lowest score of a sample
    required: Float[Array, ""]


def search(
    estimator: Estimator,
    mask: Bool[Array, " n"],
    quality: Float[Array, " n"] | None,
    key: Any,
    options: RansacOptions,
) -> Consensus:
    """Find the model with the lowest truncated error; for a batch on a CPU one problem after the other.

    In lock-step every problem would take the samples of the hardest, and the branch of the local optimisation always.
    One solve of a chunk fills the lanes of a core; cores are for `jax.shard_map`. A GPU takes the batch at once.

    Args:
        estimator: What is estimated from what.
        mask: Observations that count.
        quality: Higher is better; samples are then drawn from the best observations first.
        key: Random key. The same key gives the same answer, bit for bit.
        options: Settings.

    Returns:
        The polished consensus. Without any valid hypothesis the model is zero and nothing is an inlier.
    """

    def alone(arguments: Any) -> Consensus:
        estimator, mask, quality, key = arguments
        return _search(estimator, mask, quality, key, options)

    one = custom_vmap(alone)

    @one.def_vmap
    def _(axis_size: int, batched: list[Any], arguments: Any) -> tuple[Consensus, Any]:
        def problem(i: Array) -> Any:
            return jax.tree.map(lambda x, is_batched: x[i] if is_batched else x, arguments, batched[0])

        if jax.default_backend() == "cpu":
            found = jax.lax.map(lambda i: one(problem(i)), jnp.arange(axis_size))
        else:
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched[0])
            found = jax.vmap(alone, in_axes=(axes,))(arguments)
        return found, jax.tree.map(lambda _: True, found)

    return one((estimator, mask, quality, key))


def _search(
    estimator: Estimator,
    mask: Bool[Array, " n"],
    quality: Float[Array, " n"] | None,
    key: Any,
    options: RansacOptions,
) -> Consensus:
    n = mask.shape[0]
    m, k = estimator.sample_size, min(options.chunk_size or estimator.chunk_size, options.max_hypotheses)
    dtype = estimator.observations[0].dtype
    count = jnp.sum(mask).astype(jnp.int32)
    weights = mask.astype(dtype)
    order = sampling_order(mask, quality)
    key, subset_key = jax.random.split(key)
    # The coarse subset is one random choice among the observations that count.
    shuffled = jnp.argsort(jnp.where(mask, jax.random.uniform(subset_key, (n,)), jnp.inf))
    coarse = shuffled[: min(options.coarse_points, n)]
    coarse_observations = tuple(component[coarse] for component in estimator.observations)
    num_chunks = -(-options.max_hypotheses // k)

    def scores_of(models: Array, observations: Any, weights: Array) -> Array:
        return msac_scores(estimator.squared_error, models, observations, weights, estimator.limit)

    def body(state: _State) -> _State:
        drawn = state.chunk * k + jnp.arange(k)
        pool = count if quality is None else guided_pool(drawn, count, m)
        sample = draw_samples(random_uniform(key, state.chunk, (m, k)), order, pool)
        models, valid = estimator.hypothesize(sample)
        coarse_scores = scores_of(models, coarse_observations, weights[coarse])
        coarse_scores = jnp.where(valid, coarse_scores, jnp.inf)
        best, kept = jax.lax.top_k(-coarse_scores, min(options.survivors, models.shape[1]))
        survivors = models[:, kept]
        scores = jnp.where(jnp.isfinite(best), scores_of(survivors, estimator.observations, weights), jnp.inf)
        # Local optimisation of the best of a chunk.
        _, top = jax.lax.top_k(-scores, min(options.top_k, scores.shape[0]))
        sampled = jnp.minimum(state.sampled, scores[top[0]])

        def optimise() -> tuple[Array, Array]:
            polished = jax.vmap(lambda model: estimator.polish(model, mask), -1, -1)(survivors[:, top])
            polished_scores = scores_of(polished, estimator.observations, weights)
            return polished, jnp.where(jnp.isfinite(scores[top]), polished_scores, jnp.inf)

        def leave() -> tuple[Array, Array]:
            return survivors[:, top], scores[top]

        # Raw scores of good samples vary: what comes near the best one may be better once it is optimised.
        promising = count - scores[top[0]] > _PROMISING * (count - state.sampled)
        polished, polished_scores = jax.lax.cond(promising, optimise, leave)
        models = jnp.concatenate([state.model[:, None], survivors[:, top[:1]], polished], axis=1)
        scores = jnp.concatenate([state.score[None], scores[top[:1]], polished_scores])
        best = jnp.argmin(scores)
        inliers = _inliers(estimator, models[:, best], mask)
        ratio = jnp.sum(inliers) / jnp.maximum(count, 1)
        required = required_hypotheses(ratio.astype(dtype), m, options.confidence)
        if quality is not None:
            last = (state.chunk + 1) * k - 1
            guided = required_guided_hypotheses(inliers, order, last, count, m, options.confidence)
            required = jnp.minimum(required, guided.astype(dtype))
        required = jnp.where(jnp.isfinite(scores[best]), required, jnp.inf)
        return _State(state.chunk + 1, models[:, best], scores[best], sampled, required)

    def unfinished(state: _State) -> Array:
        return (state.chunk < num_chunks) & (state.chunk * k < state.required) & (count >= m)

    endless = jnp.asarray(jnp.inf, dtype)
    start = _State(jnp.zeros((), jnp.int32), jnp.zeros((estimator.model_size,), dtype), endless, endless, endless)
    state = jax.lax.while_loop(unfinished, body, start)
    found = jnp.isfinite(state.score)
    model = jnp.where(found, state.model, 0.0)
    inliers = _inliers(estimator, model, mask) & found
    return Consensus(model, inliers, jnp.where(found, state.score, count.astype(dtype)), state.chunk * k)


def _inliers(estimator: Estimator, model: Float[Array, " d"], mask: Bool[Array, " n"]) -> Bool[Array, " n"]:
    errors = estimator.squared_error(model[:, None], estimator.observations)
    return mask & (errors <= estimator.limit)
