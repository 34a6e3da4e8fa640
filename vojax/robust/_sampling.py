"""Minimal samples: which observations each hypothesis is made from."""

import jax
import jax.numpy as jnp

from vojax._types import Array, Bool, Float, Int


def required_hypotheses(
    inlier_ratio: Float[Array, "*shape"] | float, sample_size: int, confidence: Float[Array, "*shape"] | float
) -> Float[Array, "*shape"]:
    """Number of samples after which one is free of outliers with the given confidence.

    N = log(1 − p) / log(1 − w^m): 5 points need many more samples than 3. At least 1; infinite where no observation is
    an inlier.

    Example:
        >>> [int(required_hypotheses(0.5, m, 0.99)) for m in (2, 3, 5, 8)]
        [17, 35, 146, 1177]
    """
    ratio = jnp.asarray(inlier_ratio)
    # A sample that is surely good or surely bad would take the logarithm of 0 or of 1.
    good = jnp.clip(ratio**sample_size, 0.0, 1.0)
    failure = jnp.log1p(-jnp.where(good < 1.0, good, 0.0))
    count = jnp.ceil(jnp.log1p(-jnp.asarray(confidence, ratio.dtype)) / jnp.where(failure < 0, failure, -1.0))
    return jnp.where(good >= 1.0, 1.0, jnp.where(failure < 0, jnp.maximum(count, 1.0), jnp.inf))


def sampling_order(mask: Bool[Array, " n"], quality: Float[Array, " n"] | None) -> Int[Array, " n"]:
    """Indices of the valid observations, best first when their quality is known, then the rest."""
    rank = jnp.where(mask, 0.0 if quality is None else -quality, jnp.inf)
    return jnp.argsort(rank, stable=True)


def draw_samples(
    uniform: Float[Array, "m k"], order: Int[Array, " n"], pool: Int[Array, " k"] | Int[Array, ""]
) -> Int[Array, "m k"]:
    """Draw m different observations for each hypothesis.

    Args:
        uniform: Random numbers in [0, 1).
        order: As from `sampling_order`.
        pool: How many of the first entries of `order` each hypothesis draws from.

    Returns:
        Indices of observations, hypotheses in the lanes.

    Degenerate input: a pool smaller than a sample repeats its last entry.
    """
    m = uniform.shape[0]
    pool = jnp.broadcast_to(pool, uniform.shape[1:])
    chosen: list[Array] = []  # ascending positions in `order`
    for i in range(m):
        remaining = jnp.maximum(pool - i, 1)
        draw = jnp.minimum((uniform[i] * remaining).astype(jnp.int32), remaining - 1)
        # The draw counts positions that are still free: step over the taken ones.
        for taken in chosen:
            draw = draw + (draw >= taken)
        chosen.append(draw)
        for j in range(i, 0, -1):
            low, high = jnp.minimum(chosen[j - 1], chosen[j]), jnp.maximum(chosen[j - 1], chosen[j])
            chosen[j - 1], chosen[j] = low, high
    positions = jnp.minimum(jnp.stack(chosen), jnp.maximum(pool - 1, 0)[None])
    return order[positions]


# Samples after which guided sampling draws from all observations alike: T_N of Chum & Matas.
_GUIDED_SAMPLES = 200_000


def guided_pool(drawn: Int[Array, " k"], count: Int[Array, ""], sample_size: int) -> Int[Array, " k"]:
    """Size of the pool of best observations for the t-th sample.

    The pool grows as PROSAC's: T_n / T_N = (n/N)^m gives n(t) = N (t/T_N)^(1/m). Every fourth sample draws from all, so
    that a quality that misleads costs a third more samples and not the answer.

    References: Chum & Matas, "Matching with PROSAC", CVPR 2005, eq. (3).
    """
    share = jnp.clip((drawn + 1) / _GUIDED_SAMPLES, 0.0, 1.0) ** (1.0 / sample_size)
    grown = jnp.clip(jnp.ceil(share * count).astype(jnp.int32), jnp.minimum(sample_size + 1, count), count)
    return jnp.where(drawn % 4 == 3, count, grown)


def random_uniform(key: Array, chunk: Int[Array, ""], shape: tuple[int, int]) -> Float[Array, "m k"]:
    """The random numbers of one chunk: they depend on the key and the chunk alone."""
    return jax.random.uniform(jax.random.fold_in(key, chunk), shape, jnp.float32)
