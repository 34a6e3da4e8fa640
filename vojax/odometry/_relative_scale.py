"""Scale of a motion from one camera: distances between points that the motion before has triangulated too.

For two points X and Y seen in three views, the distance ‖X − Y‖ from the first two views over that from the last two
says how much longer the last baseline is (Scaramuzza & Fraundorfer 2011, eq. (8)). Every pair of points says it again,
and some are wrong: the mean does not stand up to that. Nor does the median of all pairs, as with 30 % of wrong points
half of the pairs are wrong, mostly in the same direction. The repeated median does (Siegel 1982): the median of each
point's ratios, and of these the median over the points.
"""

from typing import Literal

import jax.numpy as jnp

from vojax._numerics import safe_divide, safe_norm
from vojax._types import Array, ArrayLike, Bool, Float

# Partners of each point. With 30 % of wrong ones, 5 % of the good points have a median among wrong ratios.
_PARTNERS = 15
# Smallest relative variance of a ratio that weighs more than others: 1 %.
_FLOOR = 1e-4


def relative_scale(
    points0: Float[ArrayLike, "n 3"],
    points1: Float[ArrayLike, "n 3"],
    std0: Float[ArrayLike, " n"],
    std1: Float[ArrayLike, " n"],
    mask: Bool[ArrayLike, " n"],
    statistic: Literal["median", "mean"] = "median",
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How many units of `points1` make one of `points0`: ‖X0 − Y0‖ / ‖X1 − Y1‖ over pairs of points.

    Args:
        points0: Points in the unit that is wanted.
        points1: The same points by the new motion, in the unit of its baseline; any frame.
        std0: Standard deviation of each point of `points0`, along its worst direction.
        std1: The same of `points1`.
        mask: False for points to leave out.
        statistic: "median", repeated and weighted by the certainty of each ratio, or "mean" of all ratios.

    Returns:
        The factor for the new motion, and the relative standard deviation of one point's factor (for the mean, of the
        mean itself). Factor 0 and an infinite deviation without any pair.

    Differentiability: both modes for the mean; the median follows the pair it chooses.
    References: D. Scaramuzza, F. Fraundorfer. Visual odometry, part I. IEEE RAM 2011, eq. (8); A. Siegel. Robust
        regression using repeated medians. Biometrika 1982.
    """
    points0, points1, mask = jnp.asarray(points0), jnp.asarray(points1), jnp.asarray(mask)
    std0, std1 = jnp.asarray(std0), jnp.asarray(std1)
    n = points0.shape[0]
    # Usable points first, so that the partners a few rows on are usable too.
    order = jnp.argsort(~mask, stable=True)
    points0, points1, std0, std1 = points0[order], points1[order], std0[order], std1[order]
    count = jnp.sum(mask)
    row = jnp.arange(n)[None]
    # Spread over the image: rows next to each other are next to each other there.
    shift = 1 + (jnp.arange(_PARTNERS)[:, None] * jnp.maximum(count, 1)) // (_PARTNERS + 1)
    partner = jnp.where(row + shift < count, row + shift, row + shift - count)
    partner = jnp.clip(partner, 0, n - 1)
    usable = (row < count) & (partner != row)
    length0 = safe_norm(points0[None] - points0[partner])
    length1 = safe_norm(points1[None] - points1[partner])
    usable = usable & (length0 > 0) & (length1 > 0)
    ratio = jnp.where(usable, safe_divide(length0, length1), 1.0)
    if statistic == "mean":
        pairs = jnp.maximum(jnp.sum(usable), 1)
        mean = jnp.sum(jnp.where(usable, ratio, 0.0)) / pairs
        spread = jnp.sqrt(jnp.sum(jnp.where(usable, (ratio - mean) ** 2, 0.0)) / pairs)
        some = jnp.any(usable)
        return jnp.where(some, mean, 0.0), jnp.where(some, safe_divide(spread, mean) / jnp.sqrt(pairs), jnp.inf)
    # Lengths of the trusted points alone weigh: a wrong point is far from the others, and would look certain.
    rough = jnp.nanmedian(jnp.where(usable, ratio, jnp.nan))
    noise = std0**2 + jnp.where(jnp.isfinite(rough), rough, 1.0) ** 2 * std1**2
    variance = safe_divide(noise[None] + noise[partner], length0**2)
    weight = jnp.where(usable, 1.0 / (_FLOOR + variance), 0.0)
    logarithm = jnp.log(ratio)
    of_point, share = _weighted_median(logarithm, weight), jnp.sum(weight, axis=0)
    middle = _weighted_median(of_point[:, None], share[:, None])[0]
    # 1.4826 times the median absolute deviation is the standard deviation of a Gaussian.
    spread = 1.4826 * _weighted_median(jnp.abs(of_point - middle)[:, None], share[:, None])[0]
    some = jnp.any(usable)
    return jnp.where(some, jnp.exp(middle), 0.0), jnp.where(some, spread, jnp.inf)


def _weighted_median(values: Array, weights: Array) -> Array:
    """Along the first axis."""
    order = jnp.argsort(jnp.where(weights > 0, values, jnp.inf), axis=0)
    values, weights = (jnp.take_along_axis(x, order, axis=0) for x in (values, weights))
    sums = jnp.cumsum(weights, axis=0)
    chosen = jnp.argmax(sums >= 0.5 * sums[-1:], axis=0)
    return jnp.take_along_axis(values, chosen[None], axis=0)[0]
