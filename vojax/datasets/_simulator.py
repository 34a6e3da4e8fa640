"""Seeded problems with known answers: correspondences, stereo windows and the motion of a virtual robot."""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vojax._types import Array, Bool, Float, PRNGKeyArray
from vojax.cameras import Pinhole, RectifiedStereo
from vojax.lie import SE3, SO3

from ._motion import Motion, Scalar, float_dtype, motion_profile

ImageSize = tuple[int, int]

# One compilation each: run operation by operation they take seconds on the first call.
_static = ("image_size", "depth_range", "outlier_fraction", "dtype")


class AbsolutePoseProblem(NamedTuple):
    """Points in the world, where one camera saw them, and the pose that explains it.

    Attributes:
        points_world: World points.
        pixels: Measured pixels; outliers are uniform over the image.
        camera: The camera model.
        cam_from_world: True pose.
        inliers: False for the correspondences that were replaced by outliers.
    """

    points_world: Float[Array, "*batch n 3"]
    pixels: Float[Array, "*batch n 2"]
    camera: Any
    cam_from_world: SE3
    inliers: Bool[Array, "*batch n"]


class RelativePoseProblem(NamedTuple):
    """Pixels matched between two views of a scene, and the motion between them.

    Attributes:
        pixels0: Measured pixels in view 0.
        pixels1: Measured pixels in view 1; outliers are uniform over the image.
        camera: The camera model of both views.
        cam1_from_cam0: True relative pose with a translation of length 1; depths are in units of it.
        points_cam0: True points in the frame of view 0.
        inliers: False for the correspondences that were replaced by outliers.
    """

    pixels0: Float[Array, "*batch n 2"]
    pixels1: Float[Array, "*batch n 2"]
    camera: Any
    cam1_from_cam0: SE3
    points_cam0: Float[Array, "*batch n 3"]
    inliers: Bool[Array, "*batch n"]


class RigidProblem(NamedTuple):
    """The same points in two frames, and the motion that takes one set to the other.

    Attributes:
        points0: Points in frame 0, free of noise.
        points1: Measured points in frame 1, with noise.
        cam1_from_cam0: True rigid motion.
        scale: Factor between the frames, 1 for a rigid motion: `points1 = scale * R @ points0 + t`.
        inliers: False for the points that were replaced by outliers.
    """

    points0: Float[Array, "*batch n 3"]
    points1: Float[Array, "*batch n 3"]
    cam1_from_cam0: SE3
    scale: Float[Array, "*batch"]
    inliers: Bool[Array, "*batch n"]


class StereoWindow(NamedTuple):
    """What a stereo rig saw of static landmarks along a path.

    Attributes:
        observations: Measurements `(u_left, v, u_right)`, pixels; zero where not visible.
        visible: True where the landmark is inside both images and the range of depths.
        inliers: True where the observation is visible and was not replaced by an outlier.
        stereo: The rig.
        world_from_cam: True poses of the left camera, one per frame; the first is the identity.
        landmarks_world: True landmarks.
    """

    observations: Float[Array, "*batch f p 3"]
    visible: Bool[Array, "*batch f p"]
    inliers: Bool[Array, "*batch f p"]
    stereo: RectifiedStereo
    world_from_cam: SE3
    landmarks_world: Float[Array, "*batch p 3"]


@functools.partial(jax.jit, static_argnames=("n", *_static))
def simulate_absolute_pose(
    key: PRNGKeyArray,
    n: int,
    *,
    outlier_fraction: float = 0.0,
    sigma_px: Scalar = 1.0,
    camera: Any = None,
    image_size: ImageSize = (1280, 960),
    depth_range: tuple[float, float] = (2.0, 20.0),
    dtype: Any = None,
) -> AbsolutePoseProblem:
    """Draw a camera somewhere in a random scene, and what it measures.

    Args:
        key: Fixes everything. The function may be vmapped over keys.
        n: Number of correspondences.
        outlier_fraction: Share of the correspondences, rounded to a whole number, whose pixel is drawn anew from the
            whole image.
        sigma_px: Standard deviation of the noise on each pixel coordinate.
        camera: A camera model; a pinhole with a focal length of 800 px at the centre of the image where it is None.
        image_size: Width and height, pixels.
        depth_range: Smallest and largest range of the points from the camera, metres (drawn uniformly).
        dtype: Floating type; JAX's default where it is None.

    Returns:
        The problem with its truth. The camera is up to 10 m from the origin along each axis, in any orientation.

    Example:
        >>> import jax
        >>> problem = simulate_absolute_pose(jax.random.key(0), 10, outlier_fraction=0.2)
        >>> int(problem.inliers.sum())
        8
    """
    dtype = float_dtype(dtype)
    camera = _default_camera(image_size, dtype) if camera is None else camera
    few, draw = _draws(key, n, 7, dtype)
    cam_from_world = _random_pose(few, 10.0)
    true_pixels = _pixels(draw[:, 0:2], image_size)
    points_cam = camera.unproject(true_pixels) * _between(draw[:, 2], depth_range)[:, None]
    inliers = _inlier_mask(few[6], n, outlier_fraction)
    noisy = true_pixels + sigma_px * _normal(draw[:, 3:5])
    pixels = jnp.where(inliers[:, None], noisy, _pixels(draw[:, 5:7], image_size))
    points_world = cam_from_world.inverse().apply(points_cam)
    return AbsolutePoseProblem(points_world, pixels, camera, cam_from_world, inliers)


@functools.partial(jax.jit, static_argnames=("n", *_static))
def simulate_relative_pose(
    key: PRNGKeyArray,
    n: int,
    *,
    outlier_fraction: float = 0.0,
    sigma_px: Scalar = 1.0,
    camera: Any = None,
    image_size: ImageSize = (1280, 960),
    depth_range: tuple[float, float] = (4.0, 20.0),
    max_angle: Scalar = 0.3,
    dtype: Any = None,
) -> RelativePoseProblem:
    """Draw two views of a random scene.

    Args:
        key: Fixes everything. The function may be vmapped over keys.
        n: Number of correspondences.
        outlier_fraction: Share of the correspondences, rounded, whose pixel in view 1 is drawn anew.
        sigma_px: Standard deviation of the noise on each pixel coordinate, in both views.
        camera: A camera model for both views; a pinhole with a focal length of 800 px where it is None.
        image_size: Width and height, pixels. Points may leave the image of view 1.
        depth_range: Smallest and largest range of the points from view 0, in units of the baseline.
        max_angle: Largest rotation between the views, radians.
        dtype: Floating type; JAX's default where it is None.

    Returns:
        The problem with its truth; the baseline has length 1 and any direction.
    """
    dtype = float_dtype(dtype)
    camera = _default_camera(image_size, dtype) if camera is None else camera
    few, draw = _draws(key, n, 9, dtype)
    rotation = SO3.exp(_direction(few[0:2]) * (max_angle * few[2]))
    cam1_from_cam0 = SE3.from_rotation_and_translation(rotation, _direction(few[3:5]))
    true0 = _pixels(draw[:, 0:2], image_size)
    points_cam0 = camera.unproject(true0) * _between(draw[:, 2], depth_range)[:, None]
    true1 = camera.project(cam1_from_cam0.apply(points_cam0))
    inliers = _inlier_mask(few[6], n, outlier_fraction)
    pixels0 = true0 + sigma_px * _normal(draw[:, 3:5])
    noisy1 = true1 + sigma_px * _normal(draw[:, 5:7])
    pixels1 = jnp.where(inliers[:, None], noisy1, _pixels(draw[:, 7:9], image_size))
    return RelativePoseProblem(pixels0, pixels1, camera, cam1_from_cam0, points_cam0, inliers)


@functools.partial(jax.jit, static_argnames=("n", "outlier_fraction", "extent", "dtype"))
def simulate_rigid(
    key: PRNGKeyArray,
    n: int,
    *,
    outlier_fraction: float = 0.0,
    sigma: Scalar = 0.01,
    scale: Scalar = 1.0,
    extent: float = 5.0,
    dtype: Any = None,
) -> RigidProblem:
    """Draw points in a cube and the same points after a motion.

    Args:
        key: Fixes everything. The function may be vmapped over keys.
        n: Number of correspondences.
        outlier_fraction: Share of the points, rounded, that are drawn anew from the moved cube.
        sigma: Standard deviation of the noise on each coordinate of `points1`, metres.
        scale: Factor between the frames; 1 is a rigid motion.
        extent: Half the side of the cube, metres; the translation is up to as much along each axis.
        dtype: Floating type; JAX's default where it is None.

    Returns:
        The problem with its truth, `points1 = scale * R @ points0 + t` on the inliers up to noise.
    """
    dtype = float_dtype(dtype)
    few, draw = _draws(key, n, 9, dtype)
    cam1_from_cam0 = _random_pose(few, extent)

    def move(points: Array) -> Array:
        return jnp.asarray(scale) * cam1_from_cam0.rotation().apply(points) + cam1_from_cam0.translation()[None]

    points0 = _between(draw[:, 0:3], (-extent, extent))
    inliers = _inlier_mask(few[6], n, outlier_fraction)
    noisy = move(points0) + sigma * _normal(draw[:, 3:6])
    points1 = jnp.where(inliers[:, None], noisy, move(_between(draw[:, 6:9], (-extent, extent))))
    return RigidProblem(points0, points1, cam1_from_cam0, jnp.asarray(scale, dtype), inliers)


@functools.partial(jax.jit, static_argnames=("frames", "landmarks", "motion", *_static))
def simulate_stereo_window(
    key: PRNGKeyArray,
    frames: int,
    landmarks: int,
    *,
    outlier_fraction: float = 0.0,
    sigma_px: Scalar = 1.0,
    stereo: RectifiedStereo | None = None,
    image_size: ImageSize = (640, 240),
    depth_range: tuple[float, float] = (4.0, 40.0),
    motion: Motion = "turning",
    step: Scalar = 1.0,
    dtype: Any = None,
) -> StereoWindow:
    """Drive a stereo rig past random landmarks.

    Every landmark lies in the view of one frame drawn at random, so tracks begin and end along the path.

    Args:
        key: Fixes everything. The function may be vmapped over keys.
        frames: Number of frames.
        landmarks: Number of landmarks.
        outlier_fraction: Expected share of the visible observations that are drawn anew from the image.
        sigma_px: Standard deviation of the noise on `u_left`, `v` and `u_right`.
        stereo: The rig; focal length 400 px, baseline 0.54 m where it is None.
        image_size: Width and height, pixels.
        depth_range: Smallest and largest depth at which a landmark is seen, metres.
        motion: As in `motion_profile`.
        step: Distance between consecutive frames, metres.
        dtype: Floating type; JAX's default where it is None.

    Returns:
        Observations, masks and truth.

    Example:
        >>> import jax
        >>> window = simulate_stereo_window(jax.random.key(0), 4, 30)
        >>> window.observations.shape
        (4, 30, 3)
    """
    dtype = float_dtype(dtype)
    if stereo is None:
        stereo = RectifiedStereo(_default_camera(image_size, dtype, focal=400.0), jnp.asarray(0.54, dtype))
    world_from_cam = motion_profile(frames, key=key, motion=motion, step=step, dtype=dtype)
    _, draw = _draws(jax.random.fold_in(key, 1), landmarks, 4 + 7 * frames, dtype)
    seen_from = jnp.minimum((draw[:, 0] * frames).astype(jnp.int32), frames - 1)
    width, height = image_size
    depths = _between(draw[:, 1], depth_range)
    # Left of its disparity a pixel has no partner in the right image.
    disparity = stereo.camera.fx * stereo.baseline / depths
    pixels = jnp.stack([disparity + draw[:, 2] * (width - 1 - disparity), draw[:, 3] * (height - 1)], axis=-1)
    bearings = stereo.camera.unproject(pixels)
    points_cam = bearings / bearings[:, 2:] * depths[:, None]
    anchor = jax.tree.map(lambda leaf: leaf[seen_from], world_from_cam)
    landmarks_world = anchor.apply(points_cam)

    cam_from_world = world_from_cam.inverse()
    points = jax.vmap(lambda pose: pose.apply(landmarks_world))(cam_from_world)
    true = stereo.project(points)
    u_left, v, u_right, z = true[..., 0], true[..., 1], true[..., 2], points[..., 2]
    visible = (z >= 0.99 * depth_range[0]) & (z <= 1.01 * depth_range[1]) & (v >= 0) & (v <= height - 1)
    visible = visible & (u_left >= 0) & (u_left <= width - 1) & (u_right >= 0) & (u_right <= width - 1)
    draw = jnp.moveaxis(draw[:, 4:].reshape(landmarks, frames, 7), 0, 1)
    noisy = true + sigma_px * _normal(draw[..., 0:3])
    wrong = draw[..., 3:6] * jnp.array([width - 1, height - 1, width - 1], dtype)[None, None]
    _check_share(outlier_fraction)
    replaced = draw[..., 6] < outlier_fraction
    observations = jnp.where(replaced[..., None], wrong, noisy)
    observations = jnp.where(visible[..., None], observations, 0.0)
    return StereoWindow(observations, visible, visible & ~replaced, stereo, world_from_cam, landmarks_world)


def _default_camera(image_size: ImageSize, dtype: Any, focal: float = 800.0) -> Pinhole:
    width, height = image_size
    fx, cx, cy = (jnp.asarray(value, dtype) for value in (focal, (width - 1) / 2, (height - 1) / 2))
    return Pinhole(fx=fx, fy=fx, cx=cx, cy=cy, skew=jnp.zeros((), dtype))


def _draws(key: PRNGKeyArray, n: int, columns: int, dtype: Any) -> tuple[Array, Array]:
    """Seven uniform numbers for the problem and a row for each of `n` items: one draw, as each is slow to compile."""
    draw = jax.random.uniform(key, (7 + n * columns,), dtype)
    return draw[:7], draw[7:].reshape(n, columns)


def _between(share: Array, limits: tuple[float, float]) -> Array:
    return limits[0] + (limits[1] - limits[0]) * share


def _pixels(share: Array, image_size: ImageSize) -> Array:
    return share * jnp.array([image_size[0] - 1, image_size[1] - 1], share.dtype)[None]


def _normal(share: Array) -> Array:
    limit = 1 - float(jnp.finfo(share.dtype).eps)
    return 2**0.5 * jax.scipy.special.erfinv(jnp.clip(2 * share - 1, -limit, limit))


def _direction(share: Array) -> Array:
    """Uniform on the sphere, from two numbers."""
    z, azimuth = 2 * share[0] - 1, 2 * jnp.pi * share[1]
    radius = jnp.sqrt(jnp.maximum(1 - z * z, 0.0))
    return jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), z])


def _random_pose(share: Array, extent: float) -> SE3:
    """Uniform rotation (Shoemake 1992), and a position of the frame's origin uniform in a cube, from six numbers."""
    a, b = 2 * jnp.pi * share[1], 2 * jnp.pi * share[2]
    low, high = jnp.sqrt(1 - share[0]), jnp.sqrt(share[0])
    rotation = SO3(jnp.stack([low * jnp.sin(a), low * jnp.cos(a), high * jnp.sin(b), high * jnp.cos(b)]))
    position = _between(share[3:6], (-extent, extent))
    return SE3.from_rotation_and_translation(rotation, -rotation.apply(position))


def _check_share(outlier_fraction: float) -> None:
    if not 0 <= outlier_fraction <= 1:
        raise ValueError(f"outlier_fraction is {outlier_fraction}; expected a share between 0 and 1")


def _inlier_mask(share: Array, n: int, outlier_fraction: float) -> Array:
    """An exact number of outliers, scattered over the indices: golden-ratio steps from a random start (no sort)."""
    _check_share(outlier_fraction)
    stride = max(round(0.618 * n), 1)
    while math.gcd(stride, n) != 1:
        stride += 1
    start = (share * n).astype(jnp.int32)
    place = (jnp.asarray(np.arange(n) * stride % max(n, 1), jnp.int32) + start) % n
    return place >= round(outlier_fraction * n)
