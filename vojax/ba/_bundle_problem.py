"""A bundle adjustment problem: what was seen by whom, what may move, and what the data cannot tell."""

from collections.abc import Callable, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax._types import Array, ArrayLike, Bool, Float, Int
from vojax.lie import SE3

from ._bundle_arrange import (
    Gauge,
    chain_cameras,
    check_priors,
    fix_gauge,
    group_cameras,
    informed,
    link_poses,
    place_landmarks,
    residual_size,
)
from ._bundle_checks import check_sigma, check_values, find_loose, flags, pose_flags
from ._bundle_factors import PoseFactors, pose_prior
from ._bundle_layout import BundleLayout, bundle_layout, number_unknowns
from ._bundle_state import BundlePriors, Tied
from ._whitening import whitening

Solver = Literal["auto", "dense", "iterative"]

# More unknowns of cameras than these are solved for by conjugate gradients, where the choice is left to us.
_MOST_DENSE = 3000


class BundleProblem(eqx.Module):
    """A problem, made by `bundle_problem`.

    Values may be exchanged (`eqx.tree_at`) and differentiated; what was seen by whom may not.

    Attributes:
        cam_from_world: Poses of the cameras, or of the rigs.
        cam_from_rig: Poses of the cameras in the rig; None without rigs.
        landmarks: Points in the world frame, or homogeneous points `[p, 4]` of unit length.
        camera: Camera model; its parameters are scalars, or one for each group of cameras.
        measurements: Observed pixels, or what else the camera or the residual predicts.
        sigma_px: Standard deviations or covariances of the measurements.
        weights: Non-negative factors on the observations' losses; 0 for those that the mask left out.
        priors: Beliefs about single variables.
        factors: Residuals of several poses.
        anchors: The pose in whose frame each landmark has an inverse depth; None for other landmarks.
        camera_index: Camera, or rig, of every observation.
        rig_index: Camera in the rig of every observation; None without rigs.
        landmark_index: Landmark of every observation.
        unconstrained_cameras: True for free cameras that the observations cannot place: with too few observations of
            well-seen landmarks, or in a part of the problem that nothing connects to the rest.
        unconstrained_extrinsics: True for free cameras in the rig with too few observations.
        unconstrained_landmarks: True for free landmarks that nobody saw, or that too few cameras saw to have a depth,
            or in such a part.
        parts: A number for each connected part of the problem, by cameras; 0 is the largest.
        duplicates: Observations of a landmark by a camera that has observed it before; each counts.
        layout: How observations lie in memory.
        free_intrinsics: Names of the camera's free parameters.
        residual: A residual that takes the place of the reprojection error.
        gauge_free: Whether no pose, landmark or prior fixes where the world is, or where the rig's frame is.
    """

    cam_from_world: SE3
    cam_from_rig: SE3 | None
    landmarks: Float[Array, "p h"]
    camera: Any
    measurements: Float[Array, "o d"]
    sigma_px: Float[Array, "..."]
    weights: Float[Array, " o"]
    priors: BundlePriors
    factors: tuple[PoseFactors, ...]
    anchors: SE3 | None
    camera_index: Int[Array, " o"]
    rig_index: Int[Array, " o"] | None
    landmark_index: Int[Array, " o"]
    unconstrained_cameras: Bool[Array, " c"]
    unconstrained_extrinsics: Bool[Array, " r"]
    unconstrained_landmarks: Bool[Array, " p"]
    parts: Int[Array, " c"]
    duplicates: Int[Array, ""]
    layout: BundleLayout
    free_intrinsics: tuple[Tied, ...] = eqx.field(static=True)
    residual: Callable[..., Array] | None = eqx.field(static=True)
    gauge_free: bool = eqx.field(static=True)


def bundle_problem(
    cam_from_world: SE3,
    landmarks: Float[ArrayLike, "p h"],
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
    cam_from_rig: SE3 | None = None,
    rig_index: Int[ArrayLike, " o"] | None = None,
    fixed_cameras: Bool[ArrayLike, "..."] | None = None,
    fixed_extrinsics: Bool[ArrayLike, "..."] | None = None,
    fixed_landmarks: Bool[ArrayLike, " p"] | None = None,
    anchor_index: Int[ArrayLike, " p"] | None = None,
    gauge: Gauge = "free",
    priors: BundlePriors = BundlePriors(),
    factors: Sequence[PoseFactors] = (),
    residual: Callable[..., Array] | None = None,
    solver: Solver = "auto",
) -> BundleProblem:
    """Check a problem and arrange it for `adjust_bundle`. Runs on the host, on concrete arrays.

    Args:
        cam_from_world: Poses of the cameras `[c]`; with rigs, `rig_from_world` of every pose of the rig.
        landmarks: Points in the world frame, or homogeneous ones `[p, 4]`, which may be as far as infinity; these move
            on the unit sphere.
        measurements: Pixels `(u, v)`, or `(u_left, v, u_right)` with a `RectifiedStereo`.
        camera_index: Camera, or pose of the rig, of every observation.
        landmark_index: Landmark of every observation.
        camera: A camera of `vojax.cameras` (anything with `project_xyz`). Scalar parameters are shared by all cameras;
            array parameters hold one value for each camera (of the rig, where there is one), or for each group.
        sigma_px: Standard deviation of the measurements in pixels, one for all or one per observation, or covariances
            `[o, d, d]` (`[o, r, r]` with a residual of r components).
        weights: Non-negative factor on each observation's loss.
        mask: False for observations to leave out; they may hold anything.
        camera_group: The group of cameras with common intrinsics that each camera (of the rig) belongs to. None: one
            for all where all parameters are scalars, else one a camera.
        free_intrinsics: Names of the camera's attributes to solve for (dotted inside a rig: "camera.fx"); a tuple of
            names is one unknown, ("fx", "fy"). They come last in the reduced system.
        cam_from_rig: Poses `[r]` of the cameras in the rig.
        rig_index: Camera in the rig of every observation.
        fixed_cameras: True for poses that stay `[c]`, or for coordinates (ρ, φ) of their tangents that do `[c, 6]`.
        fixed_extrinsics: The same for the cameras in the rig. None: all stay. Without one that stays, or a prior, the
            frame of the rig is free.
        fixed_landmarks: True for landmarks that stay.
        anchor_index: Gives each landmark an inverse depth in the frame of this camera (or rig), as it is posed at the
            start: homogeneous (x, y, 1, 1/z), of which the first, second and fourth move.
        gauge: What holds the world in place. "free": nothing but damping; the cost is the same, covariances do not
            exist. "first_camera": the first pose stays, which with a stereo pair is all. "two_cameras": also the
            translation along one axis of the camera farthest from the first, which sets the scale; each step keeps that
            coordinate of its tangent, so the scale ends within the square of how far this camera turned. Fix two
            cameras where it is to be exact, or derivatives are of it.
        priors: Gaussian beliefs about single variables.
        factors: Residuals of several poses.
        residual: A residual `(cam_from_world, landmark, camera, measurement) -> [r]` of one observation, before
            whitening, to take the place of `camera.project - measurement`. With rigs `cam_from_world` is that of the
            camera, composed of both poses.
        solver: What `adjust_bundle` solves the reduced system with. "dense" factors it, for up to a few hundred
            cameras; "iterative" takes conjugate gradients and lists no pairs of observations. "auto" takes the second
            beyond 3,000 unknowns.

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
    if poses.ndim != 2 or pixels.ndim != 2 or not cameras.shape == seen.shape == pixels.shape[:1]:
        raise ValueError(
            f"bundle shapes do not fit: poses {poses.shape[:-1]}, measurements {pixels.shape}, camera_index "
            f"{cameras.shape}, landmark_index {seen.shape}; expected (c,), (o, d), (o,), (o,)"
        )
    if points.ndim != 2 or points.shape[1] not in (3, 4):
        raise ValueError(f"landmarks has shape {points.shape}: expected (p, 3), or (p, 4) of homogeneous points")
    if (cam_from_rig is None) != (rig_index is None):
        raise ValueError("a rig takes both cam_from_rig and rig_index: one of them is missing")
    c, p, (o, d) = len(poses), len(points), pixels.shape
    mounts = np.zeros((0, 7)) if cam_from_rig is None else np.asarray(cam_from_rig.wxyz_xyz)
    r = len(mounts)
    used = np.ones(o, bool) if mask is None else np.asarray(mask)
    weight = np.ones(o) if weights is None else np.asarray(weights)
    indices = [("camera_index", cameras, c, "cameras"), ("landmark_index", seen, p, "landmarks")]
    if rig_index is not None:
        indices.append(("rig_index", np.asarray(rig_index), r, "cameras in the rig"))
    check_values(np.concatenate([poses, mounts]), points, pixels, indices, used, weight)
    if solver not in ("auto", "dense", "iterative"):
        raise ValueError(f"solver is {solver!r}: expected 'auto', 'dense' or 'iterative'")
    free = tuple((names,) if isinstance(names, str) else tuple(names) for names in free_intrinsics)
    of_camera, groups = group_cameras(camera, camera_group, free, r if r else c)
    rows = residual_size(residual, points.shape[1], camera, d)
    sigma = np.asarray(sigma_px, float)
    whitening(jnp.asarray(sigma), (o,), rows, dtype)  # raises where the shape is wrong
    check_sigma(sigma, used)

    fixed_pose = np.zeros((c + r, 6), bool)
    if fixed_cameras is not None:
        fixed_pose[:c] = pose_flags("fixed_cameras", fixed_cameras, c)
    fix_gauge(fixed_pose[:c], gauge, poses)
    fixed_pose[c:] = True if fixed_extrinsics is None else pose_flags("fixed_extrinsics", fixed_extrinsics, r)
    still = np.zeros(p, bool) if fixed_landmarks is None else flags("fixed_landmarks", fixed_landmarks, p)
    check_priors(priors, c, points, groups, len(free))
    has_priors = priors.cam_from_world is not None or priors.landmarks is not None
    held = fixed_pose[:c].all(axis=1).any() or still.sum() >= 3 or has_priors
    loose_rig = r > 0 and not fixed_pose[c:].all(axis=1).any()
    chains = chain_cameras(cameras, None if rig_index is None else np.asarray(rig_index), used, c, r, of_camera)

    links = [link_poses(factor, c + r, SE3(jnp.asarray(np.concatenate([poses, mounts])))) for factor in factors]
    views = np.unique(np.stack([chains.index[used], seen[used]]), axis=1)
    own = [(members, size) for members, size in links if members.size and members.max() < c]
    free_count = (~fixed_pose).sum(axis=1)
    loose = find_loose(np.stack([chains.pose[views[0]], views[1]]), rows, own, free_count[:c], still)
    loose_cameras, loose_landmarks, parts = loose
    loose_mounts = np.zeros(r, bool)
    if r and chains.mount is not None:
        loose_mounts = rows * np.bincount(chains.mount[views[0]] - c, minlength=r) < free_count[c:]
    if priors.cam_root is not None:
        loose_cameras &= ~informed(priors.cam_root)
    if priors.landmark_root is not None:
        loose_landmarks &= ~informed(priors.landmark_root)

    in_use = np.isin(np.arange(groups), chains.group[np.unique(chains.index[used])])
    numbered = number_unknowns(
        ~fixed_pose, np.repeat(in_use[:, None], len(free), axis=1), chains.group, chains.pose, chains.mount
    )
    members = [np.asarray(factor.cameras) for factor in factors]
    if priors.cam_from_world is not None:
        members.append(np.arange(c)[:, None])
    dense = solver == "dense" or (solver == "auto" and numbered.count <= _MOST_DENSE)
    layout = bundle_layout(chains.index, seen, used, still, numbered, c, members, dense)
    points, anchors = place_landmarks(points, anchor_index, poses)
    as_array = lambda values: jnp.asarray(values, dtype)  # noqa: E731
    is_float = lambda leaf: jnp.issubdtype(jnp.result_type(leaf), jnp.floating)  # noqa: E731
    return BundleProblem(
        cam_from_world=SE3(as_array(poses)).normalize(),
        cam_from_rig=None if cam_from_rig is None else SE3(as_array(mounts)).normalize(),
        landmarks=as_array(points),
        camera=jax.tree.map(as_array, camera),
        measurements=as_array(np.where(used[:, None], pixels, 0.0)),
        sigma_px=as_array(sigma),
        weights=as_array(np.where(used, weight, 0.0)),
        priors=jax.tree.map(as_array, priors),
        factors=jax.tree.map(lambda leaf: as_array(leaf) if is_float(leaf) else jnp.asarray(leaf), tuple(factors)),
        anchors=None if anchors is None else SE3(as_array(anchors)).normalize(),
        camera_index=jnp.asarray(cameras, jnp.int32),
        rig_index=None if rig_index is None else jnp.asarray(rig_index, jnp.int32),
        landmark_index=jnp.asarray(seen, jnp.int32),
        unconstrained_cameras=jnp.asarray(loose_cameras),
        unconstrained_extrinsics=jnp.asarray(loose_mounts),
        unconstrained_landmarks=jnp.asarray(loose_landmarks),
        parts=jnp.asarray(parts, jnp.int32),
        duplicates=jnp.asarray(int(used.sum()) - views.shape[1], jnp.int32),
        layout=layout,
        free_intrinsics=free,
        residual=residual,
        gauge_free=bool(not held or loose_rig),
    )


def all_factors(problem: BundleProblem) -> tuple[PoseFactors, ...]:
    """The factors of a problem, those that its priors are among them, in the order of its layout."""
    priors = problem.priors
    if priors.cam_from_world is None or priors.cam_root is None:
        return problem.factors
    return *problem.factors, pose_prior(priors.cam_from_world, priors.cam_root)
