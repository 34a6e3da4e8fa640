"""Motion of one camera from landmarks: 3-D points of the frame before, and where the new frame sees them."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import propagated
from vojax._types import Array, Bool, Float, Int
from vojax.ba import GemanMcClure, LMOptions, refine_absolute_pose
from vojax.cameras import Camera
from vojax.lie import SE3
from vojax.robust import RansacOptions, search_absolute_pose


@dataclasses.dataclass(frozen=True)
class AbsoluteMotionOptions:
    """Noise and thresholds of a pose from landmarks.

    Attributes:
        sigma_px: Standard deviation of a tracked position.
        max_mahalanobis: Largest whitened residual of an inlier, standard deviations.
        ransac: The search.
    """

    sigma_px: float = 0.5
    max_mahalanobis: float = 4.0
    ransac: RansacOptions = RansacOptions(threshold_px=2.0, max_hypotheses=1024, chunk_size=128)


class AbsoluteMotion(eqx.Module):
    """A camera's motion since the frame before.

    Attributes:
        cam1_from_cam0: The pose; in the unit of the landmarks.
        covariance: Of its camera-frame tangent.
        inliers: Landmarks that agree.
        num_inliers: How many.
    """

    cam1_from_cam0: SE3
    covariance: Float[Array, "6 6"]
    inliers: Bool[Array, " n"]
    num_inliers: Int[Array, ""]


@eqx.filter_jit
def absolute_motion(
    points0: Float[Array, "n 3"],
    covariances0: Float[Array, "n 3 3"],
    pixels1: Float[Array, "n 2"],
    usable: Bool[Array, " n"],
    quality: Float[Array, " n"] | None,
    guess: SE3,
    camera: Camera,
    key: Array,
    options: AbsoluteMotionOptions,
) -> AbsoluteMotion:
    """Estimate the motion from landmarks to pixels, each weighted by the uncertainty of both.

    Args:
        points0: Landmarks in the frame before.
        covariances0: Of the landmarks.
        pixels1: Where the new frame sees them.
        usable: False for padding.
        quality: Of the tracks, guides the sampling; None samples uniformly.
        guess: The motion before, kept where the search fails.
        camera: Of `vojax.cameras`.
        key: Random key.
        options: Noise and thresholds.
    """
    rough, consensus = search_absolute_pose(points0, pixels1, camera, usable, quality, key, options.ransac)
    found = jnp.sum(consensus.inliers) > 3
    pose = SE3(jnp.where(found, rough.wxyz_xyz, guess.wxyz_xyz))

    def noise(pose: SE3) -> Array:
        """Covariance of the pixels, that of the landmarks carried into the image."""
        project = jax.jacfwd(lambda point: camera.project(pose.apply(point)))
        jacobian = jax.vmap(project)(points0)  # [n, 2, 3]
        carried = propagated(jacobian, covariances0)
        return carried + options.sigma_px**2 * jnp.eye(2, dtype=carried.dtype)[None]

    def refine(pose: SE3, _: None) -> tuple[SE3, Array]:
        refined = refine_absolute_pose(
            pose,
            points0,
            pixels1,
            camera,
            sigma_px=noise(pose),
            mask=usable & (pose.apply(points0)[:, 2] > 0),
            loss=GemanMcClure(2.0),
            options=LMOptions(max_steps=10),
        )
        return refined.model, refined.covariance

    # The covariances depend on the pose a little: twice is enough.
    pose, covariances = jax.lax.scan(refine, pose, None, length=2)
    (a, b), (_, d) = jnp.moveaxis(noise(pose), 0, -1)
    points1 = pose.apply(points0)
    x, y = jnp.moveaxis(camera.project(points1) - pixels1, 1, 0)
    squared = (d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b)
    inliers = usable & found & (squared < options.max_mahalanobis**2) & (points1[:, 2] > 0)
    return AbsoluteMotion(pose, covariances[-1], inliers, jnp.sum(inliers))
