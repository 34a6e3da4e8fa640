"""Minimal samples: which observations each hypothesis is made from."""

import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray


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
    """Indices of the valid observations, best first when their quality is known, then the rest.

    Raises:
        ValueError: If the quality does not fit the mask.
    """
    if quality is not None and jnp.shape(quality) != mask.shape:
        raise ValueError(f"quality has shape {jnp.shape(quality)}: expected one number for each of {len(mask)} rows")
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
    return jnp.where(drawn % 4 == 3, count, _grown_pool(drawn, count, sample_size))


def _grown_pool(drawn: Array, count: Array, sample_size: int) -> Array:
    share = jnp.clip((drawn + 1) / _GUIDED_SAMPLES, 0.0, 1.0) ** (1.0 / sample_size)
    return jnp.clip(jnp.ceil(share * count).astype(jnp.int32), jnp.minimum(sample_size + 1, count), count)


def required_guided_hypotheses(
    inliers: Bool[Array, " n"],
    order: Int[Array, " n"],
    drawn: Int[Array, ""],
    count: Int[Array, ""],
    sample_size: int,
    confidence: float,
) -> Float[Array, ""]:
    """As `required_hypotheses`, for samples drawn from the best observations first.

    Three of four samples so far came from the pool of the best, so it is the share of inliers among these that counts:
    with 30 % in all and 80 % in the pool 24 samples of five are enough, and not 2,840. A small pool may agree with a
    wrong model by what made it: the pool is taken for four samples' worth of observations at least.

    Args:
        inliers: Of the best model, among all observations.
        order: The observations, best first.
        drawn: Samples so far.
        count: Observations that count.
        sample_size: Observations in each.
        confidence: Probability that one was free of outliers.

    References: Chum & Matas, "Matching with PROSAC", CVPR 2005, section 2.2.
    """
    pool = jnp.maximum(_grown_pool(drawn, count, sample_size), jnp.minimum(4 * sample_size, count))
    best = jnp.sum(inliers[order] & (jnp.arange(inliers.shape[0]) < pool))
    return required_hypotheses(best / jnp.maximum(pool, 1), sample_size, confidence) * (4.0 / 3.0)


def random_uniform(key: Array, chunk: Int[Array, ""], shape: tuple[int, int]) -> Float[Array, "m k"]:
    """The random numbers of one chunk: they depend on the key and the chunk alone."""
    return jax.random.uniform(jax.random.fold_in(key, chunk), shape, jnp.float32)


def draw_minimal_samples(
    key: PRNGKeyArray | Array,
    n: int,
    *,
    num_samples: int,
    sample_size: int,
    quality: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Int[Array, "k m"]:
    """Draw minimal samples as the estimators do: uniformly, or guided by quality in the order of PROSAC.

    Args:
        key: Random key; the same key gives the same samples.
        n: Number of observations.
        num_samples: Samples k. Guided ones widen from the best observations to all of them as their number grows, and
            every fourth is drawn from all.
        sample_size: Observations m in each, all different.
        quality: Of each observation, higher is better; None draws uniformly.
        mask: False for padding, which is not drawn.

    Returns:
        Indices of observations.

    Degenerate input: with fewer usable observations than a sample needs the last is repeated.
    Differentiability: none; `draw_gumbel_samples` has learnable logits.

    Raises:
        ValueError: If a sample is larger than the data or shapes do not fit.
    References: Chum & Matas, "Matching with PROSAC", CVPR 2005.

    Example:
        >>> import functools
        >>> draw = functools.partial(draw_minimal_samples, jax.random.key(0), 100, num_samples=8, sample_size=3)
        >>> draw().shape, int(draw(quality=-jnp.arange(100.0))[:3].max())
        ((8, 3), 3)
    """
    if not 1 <= sample_size <= n or num_samples < 1:
        raise ValueError(f"{num_samples} samples of {sample_size} out of {n}: expected at least one, of 1 to {n}")
    for name, value in (("quality", quality), ("mask", mask)):
        if value is not None and jnp.shape(value) != (n,):
            raise ValueError(f"{name} has shape {jnp.shape(value)}: expected one entry for each observation, ({n},)")
    mask = jnp.ones((n,), bool) if mask is None else jnp.asarray(mask)
    quality = None if quality is None else jnp.asarray(quality)
    count = jnp.sum(mask).astype(jnp.int32)
    pool = count if quality is None else guided_pool(jnp.arange(num_samples), count, sample_size)
    uniform = jax.random.uniform(key, (sample_size, num_samples), jnp.float32)
    return draw_samples(uniform, sampling_order(mask, quality), pool).T


def match_quality(
    detector_score: Float[ArrayLike, " n"],
    matcher_score: Float[ArrayLike, " n"],
    *,
    detector_weight: float = 0.5,
    matcher_weight: float = 0.5,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Float[Array, " n"]:
    """Combine the scores of detector and matcher into the quality that guides sampling, τ = w_ξ ξ + w_ρ ρ.

    Args:
        detector_score: How distinct the points of each match are, higher is better, in any unit (the response of a
            corner detector, of the weaker point of the two).
        matcher_score: How good each match is, higher is better, in any unit (a correlation, or minus a distance).
        detector_weight: w_ξ, not negative.
        matcher_weight: w_ρ, not negative.
        mask: False for padding.

    Returns:
        `quality` for the estimators. Both scores are replaced by their rank among the matches that count, from 0 for
        the worst to 1 for the best, since units and tails of detectors differ; so τ lies between 0 and w_ξ + w_ρ.
        Padding and scores that are NaN have 0.

    Degenerate input: equal scores have equal ranks.
    Differentiability: none: ranks are constant.

    Raises:
        ValueError: If shapes do not fit or a weight is negative.

    Example:
        >>> response, distance = jnp.array([9e3, 10.0, 400.0]), jnp.array([20.0, 60.0, 10.0])
        >>> match_quality(response, -distance, matcher_weight=1.0).tolist()
        [1.0, 0.0, 1.25]
    """
    scores = jnp.asarray(detector_score), jnp.asarray(matcher_score)
    if scores[0].ndim != 1 or scores[0].shape != scores[1].shape:
        raise ValueError(
            f"detector_score has shape {scores[0].shape} and matcher_score {scores[1].shape}: expected (n,) both"
        )
    if detector_weight < 0 or matcher_weight < 0:
        raise ValueError(f"weights are {detector_weight} and {matcher_weight}: expected none below 0")
    usable = ~(jnp.isnan(scores[0]) | jnp.isnan(scores[1]))
    if mask is not None:
        if jnp.shape(mask) != scores[0].shape:
            raise ValueError(f"mask has shape {jnp.shape(mask)}: expected {scores[0].shape}")
        usable = usable & jnp.asarray(mask)
    dtype = jnp.result_type(*scores, jnp.float32)
    count = jnp.sum(usable)

    def rank(score: Array) -> Array:
        ordered = jnp.sort(jnp.where(usable, score, jnp.inf))
        # Halfway between the first and the last of equals.
        first = jnp.searchsorted(ordered, score, side="left")
        last = jnp.minimum(jnp.searchsorted(ordered, score, side="right"), count) - 1
        return (0.5 * (first + last) / jnp.maximum(count - 1, 1)).astype(dtype)

    combined = detector_weight * rank(scores[0]) + matcher_weight * rank(scores[1])
    return jnp.where(usable, combined, 0.0)
