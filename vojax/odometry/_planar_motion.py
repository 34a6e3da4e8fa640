"""Motion of a camera on a wheeled vehicle: one angle tells which tracks to trust, and these tell the motion.

A vehicle that cannot slip sideways moves along an arc, and a single track determines its angle (the one-point solver).
All tracks vote for the angle. The arc is only nearly right, as vehicles pitch, and cameras are mounted ahead of the
axle: the tracks that agree with it then determine all five degrees of freedom.
"""

import dataclasses
from typing import Literal

import equinox as eqx
import jax.numpy as jnp

from vojax._result import Result
from vojax._types import Array, Bool, Float
from vojax.ba import GemanMcClure, LMOptions, RelativePoseProblem, pixel_rays, refine_model
from vojax.cameras import Camera
from vojax.lie import SE3
from vojax.solvers import arc_motion, one_point_histogram

from ._relative_motion import RelativeMotion, scaled_motion


@dataclasses.dataclass(frozen=True)
class PlanarMotionOptions:
    """How the vehicle moves, and the noise of its tracks.

    Attributes:
        forward: Direction of travel in the camera's frame.
        up: Normal of the floor in the camera's frame.
        sigma_px: Standard deviation of a tracked position.
        threshold_rad: Largest angle by which a track may miss the arc; for the vehicle's pitch and the camera's
            mounting as much as for noise.
        max_turn_rad: Largest turn between two keyframes.
        refine: Determine all five degrees of freedom by the tracks that fit; False keeps to the arc.
        statistic: How the ratios of distances are combined: "median" or "mean".
    """

    forward: tuple[float, float, float] = (0.0, 0.0, 1.0)
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    sigma_px: float = 0.5
    threshold_rad: float = 0.005
    max_turn_rad: float = 0.5
    refine: bool = True
    statistic: Literal["median", "mean"] = "median"


@eqx.filter_jit
def planar_motion(
    pixels0: Float[Array, "n 2"],
    pixels1: Float[Array, "n 2"],
    usable: Bool[Array, " n"],
    points0: Float[Array, "n 3"],
    std0: Float[Array, " n"],
    known: Bool[Array, " n"],
    camera: Camera,
    options: PlanarMotionOptions,
) -> RelativeMotion:
    """Estimate the motion between two views of a vehicle on a floor, and its length from known points.

    Args:
        pixels0: In the newest keyframe.
        pixels1: In the new frame.
        usable: False for padding.
        points0: Landmarks in the keyframe's frame.
        std0: Their standard deviation along the worst direction.
        known: Which pairs have a landmark.
        camera: Of `vojax.cameras`.
        options: The vehicle and the noise.

    References: D. Scaramuzza, F. Fraundorfer, R. Siegwart. Real-time monocular visual odometry for on-road vehicles
        with 1-point RANSAC. ICRA 2009.
    """
    forward, up = jnp.array(options.forward, pixels0.dtype), jnp.array(options.up, pixels0.dtype)
    vote = one_point_histogram(
        camera.unproject(pixels0),
        camera.unproject(pixels1),
        forward,
        up,
        threshold=options.threshold_rad,
        max_turn=options.max_turn_rad,
        mask=usable,
    )
    pose, inliers = arc_motion(vote.theta, forward, up), vote.inliers & vote.valid
    if options.refine:
        noise = jnp.broadcast_to(options.sigma_px * jnp.eye(2, dtype=pixels0.dtype), (*usable.shape, 2, 2))
        problem = RelativePoseProblem(*(pixel_rays(camera, pixels).scaled(noise) for pixels in (pixels0, pixels1)))
        refined = refine_model(
            pose,
            problem,
            weight=inliers.astype(pixels0.dtype),
            loss=GemanMcClure(2.0),
            options=LMOptions(max_steps=20),
        )
        better = (refined.result == Result.success) | (refined.result == Result.not_converged)
        pose = SE3(jnp.where(better, refined.model.wxyz_xyz, pose.wxyz_xyz))
        (distance,) = problem.residual(pose)
        inliers = inliers & (jnp.abs(distance) < 4.0)
    return scaled_motion(
        pose, inliers, pixels0, pixels1, points0, std0, known, camera, options.sigma_px, options.statistic
    )
