"""Seeded problems with known answers: correspondences, stereo windows and the motion of a virtual robot."""

import functools
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float, PRNGKeyArray
from vojax.cameras import Pinhole, RectifiedStereo
from vojax.lie import SE3, SO3

Motion = Literal["forward", "turning", "sideways", "random"]
ImageSize = tuple[int, int]
Scalar = float | ArrayLike

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
        points1: Measured points in frame 1, `cam1_from_cam0 @ points0` (times `scale`, about the origin of frame 1) plus noise.
        cam1_from_cam0: True rigid motion.
        scale: Factor between the frames: `points1 = scale * R @ points0 + t` (1 for a rigid problem).
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


@functools.partial(jax.jit, static_argnames=("frames", "motion", "dtype"))
def motion_profile(
    frames: int,
    *,
    key: PRNGKeyArray,
    motion: Motion = "turning",
    step: Scalar = 1.0,
    dtype: Any = None,
) -> SE3:
    """Drive a virtual robot for a number of frames.

    The motion is made of velocities in the camera's own frame (+z forward, +y down), so consecutive poses differ by
    about `step` whatever the path looks like from above.

    Args:
        frames: Number of poses, at least 1.
        key: Fixes the phase of the wobble, and the whole path of `"random"`.
        motion: `"forward"` (straight on, with a gentle sway and heave), `"turning"` (the same with bends of up to 4° a
            frame), `"sideways"` (along +x) or `"random"` (independent steps in all six degrees of freedom).
        step: Distance between consecutive positions, metres.
        dtype: Floating type; JAX's default where it is None.

    Returns:
        Poses `world_from_cam` with a leading frame axis; the first is the identity.

    Raises:
        ValueError: fewer than one frame, or a motion of another name.

    Example:
        >>> import jax
        >>> motion_profile(5, key=jax.random.key(0)).wxyz_xyz.shape
        (5, 7)
    """
    if frames < 1:
        raise ValueError(f"frames is {frames}; a path needs at least 1")
    if motion not in ("forward", "turning", "sideways", "random"):
        raise ValueError(f"motion is {motion!r}; expected 'forward', 'turning', 'sideways' or 'random'")
    dtype = _float_dtype(dtype)
    phase_key, step_key = jax.random.split(key)
    if motion == "random":
        velocity = jax.random.normal(step_key, (frames - 1, 6), dtype)
        velocity = velocity * _columns([0.58 * step] * 3 + [0.05] * 3, dtype)
    else:
        phase = 2 * jnp.pi * jax.random.uniform(phase_key, (1, 6), dtype)
        period = jnp.array([[9.0, 7.0, 23.0, 11.0, 17.0, 13.0]], dtype)
        angle = 2 * jnp.pi * jnp.arange(frames - 1, dtype=dtype)[:, None] / period + phase
        amplitude = _columns([0.02 * step, 0.02 * step, 0.1 * step, 0.004, 0.004, 0.004], dtype)
        velocity = amplitude * jnp.sin(angle)
        along = 0 if motion == "sideways" else 2
        velocity = velocity.at[:, along].add(step)
        if motion == "turning":
            # Squared, so that straight stretches lie between the bends; the sign alternates.
            bend = jnp.sin(2 * jnp.pi * jnp.arange(frames - 1, dtype=dtype) / 60 + phase[0, 4])
            velocity = velocity.at[:, 4].add(0.07 * bend * jnp.abs(bend))

    def move(pose: SE3, tangent: Array) -> tuple[SE3, SE3]:
        pose = (pose @ SE3.exp(tangent)).normalize()
        return pose, pose

    first = SE3.identity(dtype=dtype)
    _, later = jax.lax.scan(move, first, velocity)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, later)


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
    dtype = _float_dtype(dtype)
    camera = _default_camera(image_size, dtype) if camera is None else camera
    keys = jax.random.split(key, 6)
    cam_from_world = _random_pose(keys[0], 10.0, dtype)
    true_pixels = _uniform_pixels(keys[1], n, image_size, dtype)
    points_cam = camera.unproject(true_pixels) * _uniform_depths(keys[2], n, depth_range, dtype)[:, None]
    inliers = _inlier_mask(keys[3], n, outlier_fraction)
    noisy = true_pixels + sigma_px * jax.random.normal(keys[4], (n, 2), dtype)
    pixels = jnp.where(inliers[:, None], noisy, _uniform_pixels(keys[5], n, image_size, dtype))
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
    dtype = _float_dtype(dtype)
    camera = _default_camera(image_size, dtype) if camera is None else camera
    keys = jax.random.split(key, 9)
    axis = _unit(jax.random.normal(keys[0], (3,), dtype))
    angle = max_angle * jax.random.uniform(keys[1], (), dtype)
    direction = _unit(jax.random.normal(keys[2], (3,), dtype))
    cam1_from_cam0 = SE3.from_rotation_and_translation(SO3.exp(axis * angle), direction)
    true0 = _uniform_pixels(keys[3], n, image_size, dtype)
    points_cam0 = camera.unproject(true0) * _uniform_depths(keys[4], n, depth_range, dtype)[:, None]
    true1 = camera.project(cam1_from_cam0.apply(points_cam0))
    inliers = _inlier_mask(keys[5], n, outlier_fraction)
    pixels0 = true0 + sigma_px * jax.random.normal(keys[6], (n, 2), dtype)
    noisy1 = true1 + sigma_px * jax.random.normal(keys[7], (n, 2), dtype)
    pixels1 = jnp.where(inliers[:, None], noisy1, _uniform_pixels(keys[8], n, image_size, dtype))
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
    dtype = _float_dtype(dtype)
    keys = jax.random.split(key, 5)
    cam1_from_cam0 = _random_pose(keys[0], extent, dtype)

    def move(points: Array) -> Array:
        return scale * cam1_from_cam0.rotation().apply(points) + cam1_from_cam0.translation()[None]

    points0 = jax.random.uniform(keys[1], (n, 3), dtype, -extent, extent)
    elsewhere = jax.random.uniform(keys[2], (n, 3), dtype, -extent, extent)
    inliers = _inlier_mask(keys[3], n, outlier_fraction)
    noisy = move(points0) + sigma * jax.random.normal(keys[4], (n, 3), dtype)
    points1 = jnp.where(inliers[:, None], noisy, move(elsewhere))
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
    dtype = _float_dtype(dtype)
    if stereo is None:
        stereo = RectifiedStereo(_default_camera(image_size, dtype, focal=400.0), jnp.asarray(0.54, dtype))
    keys = jax.random.split(key, 8)
    world_from_cam = motion_profile(frames, key=keys[0], motion=motion, step=step, dtype=dtype)
    seen_from = jax.random.randint(keys[1], (landmarks,), 0, frames)
    width, height = image_size
    depths = _uniform_depths(keys[3], landmarks, depth_range, dtype)
    # Left of its disparity a pixel has no partner in the right image.
    disparity = stereo.camera.fx * stereo.baseline / depths
    share = jax.random.uniform(keys[2], (landmarks, 2), dtype)
    pixels = jnp.stack([disparity + share[:, 0] * (width - 1 - disparity), share[:, 1] * (height - 1)], axis=-1)
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
    noisy = true + sigma_px * jax.random.normal(keys[4], true.shape, dtype)
    high = jnp.array([width - 1, height - 1, width - 1], dtype)
    wrong = jax.random.uniform(keys[5], true.shape, dtype) * high[None, None]
    replaced = jax.random.uniform(keys[6], visible.shape, dtype) < outlier_fraction
    observations = jnp.where(replaced[..., None], wrong, noisy)
    observations = jnp.where(visible[..., None], observations, 0.0)
    return StereoWindow(observations, visible, visible & ~replaced, stereo, world_from_cam, landmarks_world)


def _columns(values: list, dtype: Any) -> Array:
    return jnp.stack([jnp.asarray(value, dtype) for value in values])[None]


def _float_dtype(dtype: Any) -> Any:
    return jnp.zeros(()).dtype if dtype is None else jnp.dtype(dtype)


def _default_camera(image_size: ImageSize, dtype: Any, focal: float = 800.0) -> Pinhole:
    width, height = image_size
    fx, cx, cy = (jnp.asarray(value, dtype) for value in (focal, (width - 1) / 2, (height - 1) / 2))
    return Pinhole(fx=fx, fy=fx, cx=cx, cy=cy)


def _random_pose(key: PRNGKeyArray, extent: float, dtype: Any) -> SE3:
    """Uniform rotation, and a position of the frame's origin uniform in a cube."""
    rotation_key, position_key = jax.random.split(key)
    rotation = SO3.exp(SO3.sample_uniform(rotation_key).log().astype(dtype))
    position = jax.random.uniform(position_key, (3,), dtype, -extent, extent)
    return SE3.from_rotation_and_translation(rotation, -rotation.apply(position))


def _uniform_pixels(key: PRNGKeyArray, n: int, image_size: ImageSize, dtype: Any) -> Array:
    high = jnp.array([image_size[0] - 1, image_size[1] - 1], dtype)
    return jax.random.uniform(key, (n, 2), dtype) * high[None]


def _uniform_depths(key: PRNGKeyArray, n: int, depth_range: tuple[float, float], dtype: Any) -> Array:
    return jax.random.uniform(key, (n,), dtype, depth_range[0], depth_range[1])


def _inlier_mask(key: PRNGKeyArray, n: int, outlier_fraction: float) -> Array:
    if not 0 <= outlier_fraction <= 1:
        raise ValueError(f"outlier_fraction is {outlier_fraction}; expected a share between 0 and 1")
    return jax.random.permutation(key, jnp.arange(n) >= round(outlier_fraction * n))


def _unit(vector: Array) -> Array:
    return vector / jnp.linalg.norm(vector)
