"""Self-calibration of a focal length from two images of anything."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float, PRNGKeyArray
from vojax.ba import FundamentalProblem
from vojax.robust import Estimate, RansacOptions, estimate_fundamental
from vojax.solvers import shared_focal_from_fundamental


class SharedFocal(NamedTuple):
    """The focal length that two images share.

    Attributes:
        focal: In pixels; 1 where it is not valid.
        standard_deviation: By first-order propagation of the covariance of F.
        valid: False where the motion leaves the focal length open, or no consensus was found.
        fundamental: The robust estimate behind it.
    """

    focal: Float[Array, ""]
    standard_deviation: Float[Array, ""]
    valid: Bool[Array, ""]
    fundamental: Estimate[Array]


def estimate_shared_focal(
    pixels0: Float[ArrayLike, "n 2"],
    pixels1: Float[ArrayLike, "n 2"],
    principal_point0: Float[ArrayLike, "2"],
    principal_point1: Float[ArrayLike, "2"],
    *,
    key: PRNGKeyArray | Array,
    options: RansacOptions = RansacOptions(threshold_px=1.5),
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> SharedFocal:
    """Estimate the focal length of a camera from two of its images, some of whose matches are wrong.

    Args:
        pixels0: Pixels of image 0, without distortion; square pixels.
        pixels1: The matching pixels of image 1.
        principal_point0: Of image 0, in pixels; the middle of the image, as a rule.
        principal_point1: Of image 1.
        key: Of the random sampling.
        options: Of the robust estimation of the fundamental matrix.
        sigma_px: Standard deviation of a pixel coordinate.
        mask: True for matches that count.

    Returns:
        The focal length with its standard deviation. Read both: close to the degenerate motions (parallel optical axes,
        and axes that meet at equal distances) the focal length is hardly determined.

    Differentiability: both modes, through the last refinement of F and the implicit derivative of Kruppa's equation.

    Raises:
        ValueError: As `estimate_fundamental`.

    References: Sturm, "On focal length calibration from two views", CVPR 2001; Hartley & Zisserman, section 19.3.
    """
    estimate = estimate_fundamental(pixels0, pixels1, key=key, options=options, sigma_px=sigma_px, mask=mask)
    model = estimate.model
    c0, c1 = jnp.asarray(principal_point0, model.dtype), jnp.asarray(principal_point1, model.dtype)
    candidates = shared_focal_from_fundamental(model, c0, c1)
    zero = jnp.zeros((FundamentalProblem.tangent_dim,), model.dtype)
    held = jax.lax.stop_gradient(model)
    slope = jax.jacfwd(lambda y: shared_focal_from_fundamental(FundamentalProblem.retract(held, y), c0, c1).models[0])(
        zero
    )
    variance = slope @ jax.lax.stop_gradient(estimate.covariance) @ slope
    # The second slot is valid only where nothing decides between two.
    valid = candidates.valid[0] & ~candidates.valid[1] & (estimate.num_inliers >= 8)
    return SharedFocal(
        jnp.where(valid, candidates.models[0], 1.0),
        jnp.where(valid & (variance > 0), jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0),
        valid,
        estimate,
    )
