"""Constraints on structure and motion, as residuals of bundle adjustment.

A plane or a line is a pose like a camera's, and "sees" its landmarks: one on a plane has z = 0 in the plane's frame,
one on a line x = y = 0 in the line's, whose direction is z. Landmarks are eliminated as ever, planes and lines are
solved for, and what only moves them within themselves stays fixed. Relations between frames are pose factors.

References: Szeliski, "Computer Vision", 2nd ed., section 11.4.7 (constrained structure and motion); Scaramuzza,
Fraundorfer & Siegwart, "Real-time monocular visual odometry for on-road vehicles with 1-point RANSAC", ICRA 2009;
Scaramuzza & Fraundorfer, "Visual odometry, part I", 2011 (relative scale from three views).
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from vojax._numerics import safe_divide, safe_sqrt
from vojax._types import Array, ArrayLike, Float, Int
from vojax.lie import SE3

from ._bundle_factors import PoseFactors

# Poses of each factor, `[f, n]`.
Frames = Int[ArrayLike, "f n"] | Sequence[Sequence[int]]

PIXEL, ON_PLANE, ON_LINE = 0.0, 1.0, 2.0
# Coordinates of a frame's tangent that leave its plane, or its line, where it is: rows for `fixed_cameras`.
PLANE_FIXED = np.array([True, True, False, False, False, True])
LINE_FIXED = np.array([False, False, True, False, False, True])


def structure_residual(
    cam_from_world: SE3, landmark: Float[Array, "3"], camera: Any, measurement: Float[Array, "3"]
) -> Float[Array, "2"]:
    """Residual of pixels, of points on planes and of points on lines, for `bundle_problem(residual=...)`.

    Args:
        cam_from_world: Of the camera, or of the plane's or the line's frame.
        landmark: Point in the world frame.
        camera: Camera model.
        measurement: `(u, v, PIXEL)`, `(0, 0, ON_PLANE)` or `(0, 0, ON_LINE)`. The deviation of the last two is a
            distance.

    Returns:
        Reprojection error; (z, 0) in the plane's frame; (x, y) in the line's frame.
    """
    local, kind = cam_from_world.apply(landmark), measurement[2]
    seen = kind == PIXEL
    # What is on a plane has no depth: the camera gets a point in front of it instead.
    pixel = camera.project(jnp.where(seen, local, jnp.array([0.0, 0.0, 1.0], local.dtype))) - measurement[:2]
    on_plane = jnp.stack([local[2], jnp.zeros_like(local[2])])
    return jnp.where(seen, pixel, jnp.where(kind == ON_PLANE, on_plane, local[:2]))


def plane_frame(points: Float[ArrayLike, "n 3"]) -> Float[np.ndarray, "7"]:
    """Pose `plane_from_world` of the plane nearest to three or more points, to start from; on the host."""
    return _frame(np.asarray(points), 2)


def line_frame(points: Float[ArrayLike, "n 3"]) -> Float[np.ndarray, "7"]:
    """Pose `line_from_world` of the line nearest to two or more points, to start from; on the host."""
    return _frame(np.asarray(points), 0)


def _frame(points: np.ndarray, axis: int) -> np.ndarray:
    centre = points.mean(axis=0)
    rows = np.linalg.svd(points - centre)[2]
    z = rows[axis]
    x = rows[(axis + 1) % 3]
    rotation = np.stack([x, np.cross(z, x), z])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ centre
    return np.array(SE3.from_matrix(jnp.asarray(matrix)).wxyz_xyz)


def parallel_axes(frames: Frames, sigma_rad: float) -> PoseFactors:
    """The z axes of two frames are parallel: directions of lines, normals of planes."""
    return _factors(_parallel, frames, sigma_rad)


def perpendicular_axes(frames: Frames, sigma_rad: float) -> PoseFactors:
    """The z axes of two frames are at right angles."""
    return _factors(_perpendicular, frames, sigma_rad)


def circular_motion(frames: Frames, sigma: float, sigma_rad: float) -> PoseFactors:
    """A vehicle moves along a circular arc in its plane: it heads along the chord half way through its turn.

    Args:
        frames: Poses before and after, `vehicle_from_world`: the origin on the axle that does not steer, x to the
            right, y down, z ahead. A camera elsewhere is a rig of one.
        sigma: Standard deviation of the position beside the arc and above the plane, in scene units.
        sigma_rad: Standard deviation of roll and pitch.
    """
    index = jnp.asarray(frames)
    return PoseFactors(_circular, index, jnp.tile(jnp.array([sigma, sigma_rad]), (index.shape[0], 1)))


def turntable(frames: Frames, sigma: float) -> PoseFactors:
    """Three poses in sequence turn about one axis by equal angles: both motions are the same pure rotation.

    Args:
        frames: Consecutive poses, of the camera in the frame of the table.
        sigma: Standard deviation of the differences, in scene units and radians.
    """
    return _factors(_turntable, frames, sigma)


def trifocal_scale(frames: Frames, bearings: Float[ArrayLike, "f 3 3"], sigma: float) -> PoseFactors:
    """A point seen by three cameras has one distance from the first, whichever other camera tells it.

    It ties the lengths of two baselines without a landmark.

    Args:
        frames: Three cameras for each point.
        bearings: Unit rays of the point in their frames.
        sigma: Standard deviation of the relative difference of the two distances.
    """
    index = jnp.asarray(frames)
    rays = jnp.asarray(bearings)
    return PoseFactors(_trifocal, index, (rays, jnp.full(index.shape[0], sigma, rays.dtype)))


def _factors(residual: Any, frames: Frames, sigma: float) -> PoseFactors:
    index = jnp.asarray(frames)
    return PoseFactors(residual, index, jnp.full(index.shape[0], float(sigma)))


def _relative(poses: SE3, i: int, j: int) -> SE3:
    """Pose of frame j in frame i, `i_from_j`."""
    return SE3(poses.wxyz_xyz[i]) @ SE3(poses.wxyz_xyz[j]).inverse()


def _parallel(poses: SE3, sigma: Array) -> Array:
    return _relative(poses, 0, 1).rotation().as_matrix()[:2, 2] / sigma


def _perpendicular(poses: SE3, sigma: Array) -> Array:
    return _relative(poses, 0, 1).rotation().as_matrix()[2:, 2] / sigma


def _circular(poses: SE3, sigma: Array) -> Array:
    motion = _relative(poses, 0, 1)
    x, y, z = motion.translation()
    pitch, turn, roll = motion.rotation().log()
    beside = x * jnp.cos(0.5 * turn) - z * jnp.sin(0.5 * turn)
    return jnp.concatenate([jnp.stack([beside, y]) / sigma[0], jnp.stack([pitch, roll]) / sigma[1]])


def _turntable(poses: SE3, sigma: Array) -> Array:
    first, second = _relative(poses, 1, 0).log(), _relative(poses, 2, 1).log()
    # A screw along the axis would be ρ · φ.
    return jnp.concatenate([first - second, jnp.sum(first[:3] * first[3:])[None]]) / sigma


def _trifocal(poses: SE3, data: tuple[Array, Array]) -> Array:
    (ray, *others), sigma = data
    one, other = (_distance(ray, rays, _relative(poses, i, 0)) for i, rays in ((1, others[0]), (2, others[1])))
    return safe_divide(one - other, safe_sqrt(0.5 * (one * one + other * other)))[None] / sigma


def _distance(ray0: Array, ray1: Array, cam1_from_cam0: SE3) -> Array:
    """λ with λ R ray0 + t nearest, as seen from ray1, to parallel: ray1 × (λ R ray0 + t) = 0."""
    turned = jnp.cross(ray1, cam1_from_cam0.rotation().apply(ray0))
    return safe_divide(-jnp.sum(turned * jnp.cross(ray1, cam1_from_cam0.translation())), jnp.sum(turned * turned))
