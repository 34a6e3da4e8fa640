"""Motion of one camera from pairs of pixels: an essential matrix for its direction, known points for its length.

The essential matrix of the newest keyframe and the new frame leaves the length of the translation open. It follows from
the tracks that are landmarks already: triangulated again by the new pair, they stand in its unit.
"""

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._result import Result
from vojax._types import Array, Bool, Float, Int
from vojax.cameras import Camera
from vojax.geometry import TriangulationOptions, triangulate_rays, triangulate_refine
from vojax.lie import SE3
from vojax.robust import RansacOptions, estimate_relative_pose

from ._relative_scale import relative_scale


@dataclasses.dataclass(frozen=True)
class RelativeMotionOptions:
    """Noise and thresholds of a pose from pairs of pixels.

    Attributes:
        sigma_px: Standard deviation of a tracked position.
        ransac: The search for an essential matrix.
        statistic: How the ratios of distances are combined: "median" or "mean".
    """

    sigma_px: float = 0.5
    ransac: RansacOptions = RansacOptions(threshold_px=1.0, max_hypotheses=1024, chunk_size=128)
    statistic: Literal["median", "mean"] = "median"


class RelativeMotion(eqx.Module):
    """A camera's motion since the newest keyframe.

    Attributes:
        cam1_from_cam0: The pose, in the unit of the landmarks.
        inliers: Pairs that agree.
        num_inliers: How many.
        scale: Length of the translation; 0 where no landmark tells it.
        scale_std: Its relative standard deviation, one pair of points.
    """

    cam1_from_cam0: SE3
    inliers: Bool[Array, " n"]
    num_inliers: Int[Array, ""]
    scale: Float[Array, ""]
    scale_std: Float[Array, ""]


def relative_motion(
    pixels0: Float[Array, "n 2"],
    pixels1: Float[Array, "n 2"],
    usable: Bool[Array, " n"],
    points0: Float[Array, "n 3"],
    std0: Float[Array, " n"],
    known: Bool[Array, " n"],
    quality: Float[Array, " n"] | None,
    camera: Camera,
    key: Array,
    options: RelativeMotionOptions,
) -> RelativeMotion:
    """Estimate the motion between two views by the essential matrix, and its length from known points.

    Args:
        pixels0: In the newest keyframe.
        pixels1: In the new frame.
        usable: False for padding.
        points0: Landmarks in the keyframe's frame.
        std0: Their standard deviation along the worst direction.
        known: Which pairs have a landmark.
        quality: Of the tracks, guides the sampling; None samples uniformly.
        camera: Of `vojax.cameras`.
        key: Random key.
        options: Noise and thresholds.
    """
    estimate = estimate_relative_pose(
        pixels0, pixels1, camera, camera,
        key=key, options=options.ransac, sigma_px=options.sigma_px, quality=quality, mask=usable,
    )  # fmt: skip
    good = (estimate.result == Result.success) | (estimate.result == Result.not_converged)
    inliers = estimate.inliers & good
    return scaled_motion(
        estimate.model, inliers, pixels0, pixels1, points0, std0, known, camera, options.sigma_px, options.statistic
    )


@eqx.filter_jit
def scaled_motion(
    cam1_from_cam0: SE3,
    inliers: Bool[Array, " n"],
    pixels0: Float[Array, "n 2"],
    pixels1: Float[Array, "n 2"],
    points0: Float[Array, "n 3"],
    std0: Float[Array, " n"],
    known: Bool[Array, " n"],
    camera: Camera,
    sigma_px: float,
    statistic: Literal["median", "mean"],
) -> RelativeMotion:
    """Give a motion with |t| = 1 its length from points that are known: see `relative_motion` for the arguments."""
    views = SE3(jnp.stack([SE3.identity(dtype=pixels0.dtype).wxyz_xyz, cam1_from_cam0.wxyz_xyz]))
    again, covariance, valid = triangulate_pairs(pixels0, pixels1, views, camera, sigma_px)
    std1 = jnp.sqrt(jnp.maximum(covariance[:, 0, 0] + covariance[:, 1, 1] + covariance[:, 2, 2], 0.0))
    scale, spread = relative_scale(points0, again, std0, std1, inliers & known & valid, statistic)
    scaled = SE3.from_rotation_and_translation(cam1_from_cam0.rotation(), scale * cam1_from_cam0.translation())
    return RelativeMotion(scaled, inliers, jnp.sum(inliers), scale, spread)


def triangulate_pairs(
    pixels0: Float[Array, "n 2"], pixels1: Float[Array, "n 2"], views: SE3, camera: Camera, sigma_px: float
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"], Bool[Array, " n"]]:
    """Points of two views in the frame of the first, their covariances, and which of them to trust.

    Args:
        pixels0: In view 0.
        pixels1: In view 1.
        views: Poses `cam_from_cam0` of both, batch axis `[2]`.
        camera: Of `vojax.cameras`.
        sigma_px: Standard deviation of the pixels.
    """
    pixels = jnp.stack([pixels0, pixels1], axis=1)  # [n, 2, 2]
    cam0_from_view = views.inverse()
    bearings = SE3(cam0_from_view.wxyz_xyz[None]).rotation().apply(camera.unproject(pixels))
    start = jax.vmap(triangulate_rays, in_axes=(None, 0))(cam0_from_view.translation(), bearings)
    options = TriangulationOptions(steps=3, max_relative_std=0.3)
    found = jax.vmap(lambda point, z: triangulate_refine(point, z, camera, views, sigma_px, options=options))(
        start, pixels
    )
    return found.point, found.covariance, found.valid
