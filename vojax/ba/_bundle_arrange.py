"""Steps that turn what a user gives to `bundle_problem` into what the layout needs. On the host."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vojax._types import Array
from vojax.lie import SE3

from ._bundle_factors import PoseFactors
from ._bundle_state import BundlePriors
from ._intrinsics import Tied, get_attribute

Gauge = Literal["free", "first_camera", "two_cameras"]


class Chains(NamedTuple):
    """Cameras as the layout knows them: with rigs, every pair of a rig's pose and a camera in it that is used."""

    index: np.ndarray  # [o]
    pose: np.ndarray
    mount: np.ndarray | None
    group: np.ndarray


def chain_cameras(
    cameras: np.ndarray, in_rig: np.ndarray | None, used: np.ndarray, c: int, r: int, group: np.ndarray
) -> Chains:
    """Number the cameras: as they are, or with rigs by pairs."""
    if in_rig is None:
        return Chains(cameras, np.arange(c), None, group)
    # Every pose and every camera of the rig has a place, whether used or not.
    every = np.concatenate([cameras[used] * r + in_rig[used], np.arange(c) * r, np.arange(r) % max(r, 1)])
    keys = np.unique(every)
    index = np.searchsorted(keys, cameras * r + in_rig)
    return Chains(np.minimum(index, len(keys) - 1), keys // r, c + keys % r, group[keys % r])


def link_poses(factor: PoseFactors, count: int, poses: SE3) -> tuple[np.ndarray, int]:
    """The poses of factors, and the number of equations of each; refuses what does not fit."""
    members = np.asarray(factor.cameras)
    if members.ndim != 2 or not np.issubdtype(members.dtype, np.integer):
        raise ValueError(f"a factor's cameras have shape {members.shape}: expected integers (f, n)")
    if members.size and not (members.min() >= 0 and members.max() < count):
        wrong = members.min() if members.min() < 0 else members.max()
        raise ValueError(f"a factor names pose {wrong}: expected 0 to {count - 1}")
    value = jax.eval_shape(factor.at, poses)
    if value.ndim != 2:
        raise ValueError(f"a factor's residual has shape {value.shape[1:]}: expected (r,)")
    return members, value.shape[1]


def residual_size(residual: Callable[..., Array] | None, h: int, camera: Any, d: int) -> int:
    """Components of the residual of an observation."""
    if residual is None:
        return d
    one = jax.tree.map(lambda leaf: jnp.zeros((), jnp.result_type(leaf)), camera)
    value = jax.eval_shape(residual, SE3.identity(), jnp.zeros(h), one, jnp.zeros(d))
    if value.ndim != 1:
        raise ValueError(f"the residual of an observation has shape {value.shape}: expected (r,)")
    return value.shape[0]


def check_priors(priors: BundlePriors, c: int, points: np.ndarray, groups: int, free: int) -> None:
    """Refuse priors of the wrong shape or about what they cannot be."""
    p = len(points)
    for name, expected in (
        ("cam_root", (c, 6, 6)),
        ("landmarks", (p, 3)),
        ("landmark_root", (p, 3, 3)),
        ("intrinsics", (groups, free)),
        ("intrinsics_root", (groups, free)),
    ):
        value = getattr(priors, name)
        if value is not None and np.shape(value) != expected:
            raise ValueError(f"priors.{name} has shape {np.shape(value)}: expected {expected}")
    if priors.landmarks is not None and points.shape[1] == 4:
        raise ValueError("priors on landmarks are about Euclidean ones: give landmarks as (p, 3)")


def place_landmarks(points: np.ndarray, anchor_index: Any, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Landmarks as they are stored, and the poses of their anchors."""
    if anchor_index is None:
        return (points / np.linalg.norm(points, axis=1, keepdims=True) if points.shape[1] == 4 else points), None
    anchors = np.asarray(anchor_index)
    if anchors.shape != (len(points),) or (len(anchors) and not (anchors.min() >= 0 and anchors.max() < len(poses))):
        raise ValueError(
            f"anchor_index has shape {anchors.shape}: expected a camera, 0 to {len(poses) - 1}, for each landmark"
        )
    if points.shape[1] == 3:
        points = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    with jax.enable_x64(True):
        matrices = np.asarray(SE3(jnp.asarray(poses, jnp.float64)).normalize().as_matrix())[anchors]
    depth = np.einsum("pi,pi->p", matrices[:, 2], points)
    flat = np.flatnonzero(np.abs(depth) <= 1e-9 * np.linalg.norm(points, axis=1))
    if len(flat):
        raise ValueError(f"landmarks[{flat[0]}] has depth zero in its anchor: it has no inverse depth there")
    return points / depth[:, None], poses[anchors]


def group_cameras(camera: Any, camera_group: Any, free: tuple[Tied, ...], c: int) -> tuple[np.ndarray, int]:
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
        except (AttributeError, IndexError, TypeError):
            known = ", ".join(vars(camera)) if hasattr(camera, "__dict__") else "none"
            raise ValueError(f"the camera has no parameter {name!r} to solve for: choose from {known}") from None
        if groups > 1 and np.shape(get_attribute(camera, name)) != (groups,):
            raise ValueError(f"{name} is free and differs between {groups} groups: give it as an array ({groups},)")
    return group, groups


def fix_gauge(fixed: np.ndarray, gauge: Gauge, poses: np.ndarray) -> None:
    """Mark the coordinates that hold the world in place."""
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


def informed(roots: Any) -> np.ndarray:
    """Which square roots of information leave no direction out."""
    roots = np.asarray(roots)
    return np.linalg.matrix_rank(roots) == roots.shape[-1]
