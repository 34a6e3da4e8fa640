"""A bundle adjustment problem: what was seen by whom, what may move, and what the data cannot tell."""

from collections.abc import Callable, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax._types import Array, ArrayLike, Bool, Float, Int
from vojax.lie import SE3

from ._bundle_layout import BundleLayout, bundle_layout, number_unknowns
from ._bundle_residual import BundlePriors, Tied, get_attribute
from ._whitening import whitening

Gauge = Literal["free", "first_camera", "two_cameras"]


class BundleProblem(eqx.Module):
    """A problem, made by `bundle_problem`.

    Values may be exchanged (`eqx.tree_at`) and differentiated; what was seen by whom may not.

    Attributes:
        cam_from_world: Poses of the cameras.
        landmarks: Points in the world frame.
        camera: Camera model; its parameters are scalars, or one for each group of cameras.
        measurements: Observed pixels, or what else the camera or the residual predicts.
        sigma_px: Standard deviations or covariances of the measurements.
        weights: Non-negative factors on the observations' losses; 0 for those that the mask left out.
        priors: Beliefs about single variables.
        camera_index: Camera of every observation.
        landmark_index: Landmark of every observation.
        unconstrained_cameras: True for free cameras that the observations cannot place: with too few observations of
            well-seen landmarks, or in a part of the problem that nothing connects to the rest.
        unconstrained_landmarks: True for free landmarks that nobody saw, or that too few cameras saw to have a depth,
            or in such a part.
        parts: A number for each connected part of the problem, by cameras; 0 is the largest.
        duplicates: Observations of a landmark by a camera that has observed it before; each counts.
        layout: How observations lie in memory.
        free_intrinsics: Names of the camera's free parameters.
        residual: A residual that takes the place of the reprojection error.
        gauge_free: Whether no pose, landmark or prior fixes where the world is.
    """

    cam_from_world: SE3
    landmarks: Float[Array, "p 3"]
    camera: Any
    measurements: Float[Array, "o d"]
    sigma_px: Float[Array, "..."]
    weights: Float[Array, " o"]
    priors: BundlePriors
    camera_index: Int[Array, " o"]
    landmark_index: Int[Array, " o"]
    unconstrained_cameras: Bool[Array, " c"]
    unconstrained_landmarks: Bool[Array, " p"]
    parts: Int[Array, " c"]
    duplicates: Int[Array, ""]
    layout: BundleLayout
    free_intrinsics: tuple[Tied, ...] = eqx.field(static=True)
    residual: Callable[..., Array] | None = eqx.field(static=True)
    gauge_free: bool = eqx.field(static=True)


def bundle_problem(
    cam_from_world: SE3,
    landmarks: Float[ArrayLike, "p 3"],
    measurements: Float[ArrayLike, "o d"],
    camera_index: Int[ArrayLike, " o"],
    landmark_index: Int[ArrayLike, " o"],
    camera: Any,
    *,
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    weights: Float[ArrayLike, " o"] | None = None,
    mask: Bool[ArrayLike, " o"] | None = None,
    camera_group: Int[ArrayLike, " c"] | None = None,
    free_intrinsics: Sequence[str | Tied] = (),
    fixed_cameras: Bool[ArrayLike, " c"] | None = None,
    fixed_landmarks: Bool[ArrayLike, " p"] | None = None,
    gauge: Gauge = "free",
    priors: BundlePriors = BundlePriors(),
    residual: Callable[..., Array] | None = None,
) -> BundleProblem:
    """Check a problem and arrange it for `adjust_bundle`. Runs on the host, on concrete arrays.

    Args:
        cam_from_world: Poses of the cameras `[c]`.
        landmarks: Points in the world frame.
        measurements: Pixels `(u, v)`, or `(u_left, v, u_right)` with a `RectifiedStereo`.
        camera_index: Camera of every observation.
        landmark_index: Landmark of every observation.
        camera: A camera of `vojax.cameras` (anything with `project_xyz`). Scalar parameters are shared by all cameras;
            array parameters hold one value for each camera, or for each group.
        sigma_px: Standard deviation of the measurements in pixels, one for all or one per observation, or covariances
            `[o, d, d]`.
        weights: Non-negative factor on each observation's loss.
        mask: False for observations to leave out; they may hold anything.
        camera_group: The group of cameras with common intrinsics that each camera belongs to. None: one for all where
            all parameters are scalars, else one a camera.
        free_intrinsics: Names of the camera's attributes to solve for (dotted inside a rig: "camera.fx"); a tuple of
            names is one unknown, ("fx", "fy"). They come last in the reduced system.
        fixed_cameras: True for poses that stay.
        fixed_landmarks: True for landmarks that stay.
        gauge: What holds the world in place. "free": nothing but damping; the cost is the same, covariances do not
            exist. "first_camera": the first pose stays, which with a stereo pair is all. "two_cameras": also the
            translation along one axis of the camera farthest from the first, which sets the scale.
        priors: Gaussian beliefs about single variables.
        residual: A residual `(cam_from_world, landmark, camera, measurement) -> [r]` of one observation, before
            whitening, to take the place of `camera.project - measurement`.

    Returns:
        The problem. Nothing is dropped: landmarks seen once, cameras without observations, parts that nothing connects
        and duplicates stay, and are named in it.

    Raises:
        ValueError: Arrays do not fit together, an index is out of range, a number is not finite, or a deviation or
            weight is not positive.
    """
    dtype = jnp.result_type(jnp.asarray(landmarks), jnp.asarray(measurements))
    poses = np.asarray(cam_from_world.wxyz_xyz)
    points, pixels = np.asarray(landmarks), np.asarray(measurements)
    cameras, seen = np.asarray(camera_index), np.asarray(landmark_index)
    if poses.ndim != 2 or len(cameras) != len(pixels) or len(seen) != len(pixels):
        raise ValueError(
            f"bundle shapes do not fit: poses {poses.shape[:-1]}, measurements {pixels.shape}, camera_index "
            f"{cameras.shape}, landmark_index {seen.shape}; expected (c,), (o, d), (o,), (o,)"
        )
    c, p, (o, d) = len(poses), len(points), pixels.shape
    used = np.ones(o, bool) if mask is None else np.asarray(mask)
    weight = np.ones(o) if weights is None else np.asarray(weights)
    _check_values(poses, points, pixels, cameras, seen, used, weight)
    sigma = np.asarray(sigma_px, float)
    whitening(jnp.asarray(sigma), (o,), d, dtype)  # raises where the shape is wrong
    _check_sigma(sigma, used)
    free = tuple((names,) if isinstance(names, str) else tuple(names) for names in free_intrinsics)
    group, groups = _groups(camera, camera_group, free, c)

    fixed_pose = np.zeros((c, 6), bool)
    if fixed_cameras is not None:
        fixed_pose[_flags("fixed_cameras", fixed_cameras, c)] = True
    still = np.zeros(p, bool) if fixed_landmarks is None else _flags("fixed_landmarks", fixed_landmarks, p)
    has_priors = priors.cam_from_world is not None or priors.landmarks is not None
    loose = gauge == "free" and not fixed_pose.any() and still.sum() < 3 and not has_priors
    _fix_gauge(fixed_pose, gauge, poses)
    enough = _constrained(cameras, seen, used, d, np.asarray(fixed_pose.all(axis=1)), still, c, p)
    loose_cameras, loose_landmarks, parts = enough
    if priors.cam_root is not None:
        loose_cameras &= ~_informed(priors.cam_root)
    if priors.landmark_root is not None:
        loose_landmarks &= ~_informed(priors.landmark_root)
    in_use = np.isin(np.arange(groups), group[np.unique(cameras[used])]) if o else np.zeros(groups, bool)
    numbered = number_unknowns(~fixed_pose, group, np.repeat(in_use[:, None], len(free), axis=1))
    layout = bundle_layout(cameras, seen, used, still, numbered)
    _, first = np.unique(np.stack([cameras[used], seen[used]]), axis=1, return_index=True)
    as_array = lambda values: jnp.asarray(values, dtype)  # noqa: E731
    return BundleProblem(
        cam_from_world=SE3(as_array(poses)).normalize(),
        landmarks=as_array(points),
        camera=jax.tree.map(as_array, camera),
        measurements=as_array(np.where(used[:, None], pixels, 0.0)),
        sigma_px=as_array(sigma),
        weights=as_array(np.where(used, weight, 0.0)),
        priors=jax.tree.map(as_array, priors),
        camera_index=jnp.asarray(cameras, jnp.int32),
        landmark_index=jnp.asarray(seen, jnp.int32),
        unconstrained_cameras=jnp.asarray(loose_cameras),
        unconstrained_landmarks=jnp.asarray(loose_landmarks),
        parts=jnp.asarray(parts, jnp.int32),
        duplicates=jnp.asarray(int(used.sum()) - len(first), jnp.int32),
        layout=layout,
        free_intrinsics=free,
        residual=residual,
        gauge_free=bool(loose),
    )


def _check_values(
    poses: np.ndarray,
    points: np.ndarray,
    pixels: np.ndarray,
    cameras: np.ndarray,
    seen: np.ndarray,
    used: np.ndarray,
    weight: np.ndarray,
) -> None:
    if used.shape != (len(pixels),) or used.dtype != bool:
        raise ValueError(f"mask has shape {used.shape} and dtype {used.dtype}: expected booleans ({len(pixels)},)")
    if weight.shape != (len(pixels),):
        raise ValueError(f"weights has shape {weight.shape}: expected ({len(pixels)},)")
    for name, index, size, of in (
        ("camera_index", cameras, len(poses), "cameras"),
        ("landmark_index", seen, len(points), "landmarks"),
    ):
        wrong = np.flatnonzero((index < 0) | (index >= size))
        if len(wrong):
            raise ValueError(
                f"{name}[{wrong[0]}] is {index[wrong[0]]}: expected 0 to {size - 1}, there are {size} {of} "
                f"({len(wrong)} indices are out of range)"
            )
    for name, values, hint in (
        ("cam_from_world", poses, ""),
        ("landmarks", points, ""),
        ("measurements", np.where(used[:, None], pixels, 0.0), "; mask out what was not seen"),
        ("weights", weight, ""),
    ):
        bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
        if len(bad):
            raise ValueError(f"{name}[{bad[0]}] is not finite ({len(bad)} such rows): expected numbers{hint}")
    if (weight < 0).any():
        raise ValueError(f"weights[{np.argmax(weight < 0)}] is negative: expected 0 or more")
    if not np.abs(poses[:, :4]).sum(axis=1).all():
        raise ValueError(f"cam_from_world[{np.argmin(np.abs(poses[:, :4]).sum(axis=1))}] has a zero quaternion")


def _check_sigma(sigma: np.ndarray, used: np.ndarray) -> None:
    values = np.diagonal(sigma, axis1=-2, axis2=-1).min(axis=-1) if sigma.ndim == 3 else sigma
    values = np.where(used, values, 1.0)
    bad = ~(np.isfinite(values) & (values > 0))
    if bad.any():
        raise ValueError(f"sigma_px has {int(bad.sum())} entries that are not positive numbers: expected pixels > 0")


def _flags(name: str, values: Any, size: int) -> np.ndarray:
    flags = np.asarray(values)
    if flags.shape != (size,) or flags.dtype != bool:
        raise ValueError(f"{name} has shape {flags.shape} and dtype {flags.dtype}: expected booleans ({size},)")
    return flags


def _groups(camera: Any, camera_group: Any, free: tuple[Tied, ...], c: int) -> tuple[np.ndarray, int]:
    """The group of each camera, and how many there are."""
    sizes = {np.shape(leaf) for leaf in jax.tree.leaves(camera)}
    arrays = sizes - {()}
    if camera_group is not None:
        group = np.asarray(camera_group)
        if group.shape != (c,) or (group < 0).any():
            raise ValueError(
                f"camera_group has shape {group.shape}: expected a group number, 0 or more, for {c} cameras"
            )
    else:
        group = np.arange(c) if arrays else np.zeros(c, int)
    groups = int(group.max(initial=0)) + 1
    if camera_group is not None and len(arrays) == 1:
        groups = max(
            groups, *(shape[0] if len(shape) == 1 else 0 for shape in arrays), 1
        )  # some may be without cameras
    if arrays - {(groups,)}:
        raise ValueError(
            f"the camera's parameters have shapes {sorted(arrays)}: expected scalars or ({groups},), one for each "
            f"{'group of cameras' if camera_group is not None else 'camera'}"
        )
    for name in (name for tied in free for name in tied):
        try:
            get_attribute(camera, name)
        except AttributeError:
            known = ", ".join(vars(camera)) if hasattr(camera, "__dict__") else "none"
            raise ValueError(f"the camera has no parameter {name!r} to solve for: choose from {known}") from None
        if groups > 1 and np.shape(get_attribute(camera, name)) != (groups,):
            raise ValueError(f"{name} is free and differs between {groups} groups: give it as an array ({groups},)")
    return group, groups


def _fix_gauge(fixed: np.ndarray, gauge: Gauge, poses: np.ndarray) -> None:
    if gauge == "free" or not len(fixed):
        return
    if gauge not in ("first_camera", "two_cameras"):
        raise ValueError(f"gauge is {gauge!r}: expected 'free', 'first_camera' or 'two_cameras'")
    fixed[0] = True
    if gauge == "two_cameras" and len(poses) > 1:
        with jax.enable_x64(True):
            world_from_cam = SE3(jnp.asarray(poses, jnp.float64)).normalize().inverse()
            baselines = np.asarray(world_from_cam.translation() - world_from_cam.translation()[:1])
            far = int(np.argmax(np.sum(baselines**2, axis=1)))
            along = np.asarray(world_from_cam.rotation().inverse().apply(baselines))[far]
        fixed[far, int(np.argmax(np.abs(along)))] = True


def _informed(roots: Any) -> np.ndarray:
    roots = np.asarray(roots)
    return np.linalg.matrix_rank(roots) == roots.shape[-1]


def _constrained(
    cameras: np.ndarray,
    seen: np.ndarray,
    used: np.ndarray,
    d: int,
    fixed_cameras: np.ndarray,
    fixed_landmarks: np.ndarray,
    c: int,
    p: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Count equations and follow connections: which cameras and landmarks are loose, and each camera's part."""
    pairs = np.unique(np.stack([cameras[used], seen[used]]), axis=1)
    views = np.bincount(pairs[1], minlength=p)
    loose_landmarks = ~fixed_landmarks & (d * views < 3)
    useful = pairs[:, ~loose_landmarks[pairs[1]]]
    loose_cameras = ~fixed_cameras & (d * np.bincount(useful[0], minlength=c) < 6)
    part, landmark_part = _parts(useful, c, p)
    _, part = np.unique(part, return_inverse=True)
    landmark_part = np.where(landmark_part < c, part[np.minimum(landmark_part, c - 1)], -1)
    sizes = np.bincount(part)
    rank = np.argsort(np.argsort(-sizes, kind="stable"), kind="stable")
    part, landmark_part = rank[part], np.where(landmark_part >= 0, rank[landmark_part], -1)
    held = np.unique(part[fixed_cameras])
    held = np.union1d(held, landmark_part[fixed_landmarks & (landmark_part >= 0)])
    held = held if len(held) else np.zeros(1, int)  # nothing is fixed: the largest part is where the world is
    loose_cameras |= ~fixed_cameras & ~np.isin(part, held)
    loose_landmarks |= ~fixed_landmarks & ~np.isin(landmark_part, held)
    return loose_cameras, loose_landmarks, part


def _parts(pairs: np.ndarray, c: int, p: int) -> tuple[np.ndarray, np.ndarray]:
    """The lowest camera that each camera and each landmark is connected to; `c` for landmarks nobody saw."""
    camera, landmark = np.arange(c), np.full(p, c)
    while True:
        before = camera.copy()
        np.minimum.at(landmark, pairs[1], camera[pairs[0]])
        np.minimum.at(camera, pairs[0], landmark[pairs[1]])
        camera = camera[camera]  # jump along the chain
        if np.array_equal(before, camera):
            return camera, landmark
