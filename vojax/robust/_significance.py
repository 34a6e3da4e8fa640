"""Whether a consensus could be chance: the expected number of models that pure noise would support as well.

With n observations that agree with any model by chance with probability p, the expected number of minimal models with k
supporters is at most

    NFA = (n − m) C(n, k) C(k, m) p^(k − m),

the count of all choices of k supporters and of a sample of m among them. A consensus means something when NFA is
small, for any n, k and p, where a fixed least number of supporters is right for one.

References: Moisan & Stival, "A probabilistic criterion to detect rigid point matches", IJCV 2004, eq. (11).
"""

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln

from vojax._types import Array, Bool, Float, Int

SQRT_TAU = 2.5066282746310002  # √(2π)


def is_significant(
    num_inliers: Int[Array, ""], count: Int[Array, ""], sample_size: int, chance: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether fewer than one model of pure noise is expected to have as many supporters.

    Args:
        num_inliers: Supporters k, those of the sample included.
        count: Observations n.
        sample_size: Observations m that determine a model.
        chance: Probability p that an observation that has nothing to do with a model agrees with it.
    """
    n, k, m = count.astype(chance.dtype), num_inliers.astype(chance.dtype), float(sample_size)
    enough = num_inliers > sample_size
    k = jnp.where(enough, k, m + 1.0)
    n = jnp.maximum(n, k)
    log_choices = gammaln(n + 1) - gammaln(n - k + 1) - gammaln(k - m + 1) - gammaln(m + 1)  # C(n, k) C(k, m)
    log_alarms = jnp.log(n - m) + log_choices + (k - m) * jnp.log(jnp.clip(chance, 1e-30, 1.0))
    return enough & (log_alarms < 0)


def chance_in_image(
    pixels: Float[Array, "n 2"], mask: Bool[Array, " n"], threshold_px: Float[Array, ""] | float
) -> Float[Array, ""]:
    """Probability that a random pixel lies within the threshold of another; pixels fill their bounding box."""
    return jnp.minimum(jnp.pi * threshold_px**2 / jnp.prod(_box(pixels, mask, threshold_px)), 1.0)


def chance_near_line(
    pixels: Float[Array, "n 2"], mask: Bool[Array, " n"], threshold_px: Float[Array, ""] | float
) -> Float[Array, ""]:
    """Probability that a random pixel lies within the threshold of a line; pixels fill their bounding box.

    A line crosses the box along its diagonal at most.
    """
    size = _box(pixels, mask, threshold_px)
    return jnp.minimum(2.0 * threshold_px * jnp.sqrt(jnp.sum(size**2)) / jnp.prod(size), 1.0)


def chance_in_box(points: Float[Array, "n 3"], mask: Bool[Array, " n"], threshold: float) -> Float[Array, ""]:
    """Probability that a random point lies within the threshold of another; points fill their bounding box."""
    return jnp.minimum(4.0 / 3.0 * jnp.pi * threshold**3 / jnp.prod(_box(points, mask, threshold)), 1.0)


def _box(
    points: Float[Array, "n d"], mask: Bool[Array, " n"], threshold: Float[Array, ""] | float
) -> Float[Array, "d"]:
    """Size of the bounding box; one thinner than a disc of the threshold counts with the disc's width."""
    low = jnp.min(jnp.where(mask[:, None], points, jnp.inf), axis=0)
    high = jnp.max(jnp.where(mask[:, None], points, -jnp.inf), axis=0)
    return jnp.maximum(jnp.where(jnp.isfinite(high - low), high - low, 0.0), 2.0 * threshold)


def even_odds(
    num_inliers: Int[Array, ""],
    count: Int[Array, ""],
    inlier_density: Float[Array, ""],
    outlier_density: Float[Array, ""],
) -> Float[Array, ""]:
    """Error in standard deviations at which an observation is as likely an outlier as an inlier.

    Args:
        num_inliers: Supporters of the model.
        count: Observations.
        inlier_density: Of the errors of inliers at zero: 1/(σ√2π) in one dimension, 1/(2πσ²) in two.
        outlier_density: Of the errors of outliers, in the same unit.

    References: Torr & Zisserman, "MLESAC", 2000.
    """
    share = num_inliers.astype(inlier_density.dtype) / jnp.maximum(count, 1)
    share = jnp.clip(share, 0.01, 0.99)
    odds = share * inlier_density / jnp.maximum((1.0 - share) * outlier_density, 1e-30)
    return jax.lax.stop_gradient(jnp.sqrt(2.0 * jnp.log(jnp.clip(odds, 1.7, 1e8))))


def even_odds_in_pixels(
    inliers: Bool[Array, " n"],
    mask: Bool[Array, " n"],
    sigma_px: Float[Array, ""],
    chance: Float[Array, ""],
    threshold_px: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """`even_odds` of errors in an image, in two dimensions.

    Args:
        inliers: Supporters of the model.
        mask: Observations that count.
        sigma_px: Standard deviation of a pixel's coordinates.
        chance: That an outlier is within the threshold, see `chance_in_image`.
        threshold_px: The threshold.
    """
    density = chance / (jnp.pi * threshold_px**2)
    return even_odds(jnp.sum(inliers), jnp.sum(mask), 1.0 / (SQRT_TAU * sigma_px) ** 2, density)
