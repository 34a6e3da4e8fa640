"""What a bundle solves for, what it is given, and both brought to the slots, one observation a lane.

An observation sees its landmark through a chain of poses: that of the camera, or that of the rig and then the camera's
in the rig. Every pose T moves in its own frame, exp(−ξ) @ T with ξ = (ρ, φ).
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax._types import Array, Float
from vojax.cameras import RectifiedStereo
from vojax.lie import SE3

from ._bundle_factors import PoseFactors
from ._bundle_layout import BundleLayout
from ._intrinsics import Tied, add_to_camera, get_attribute


class BundleState(eqx.Module):
    """What is solved for.

    Attributes:
        poses: Of the cameras or rigs, then those of the cameras in the rig.
        intrinsics: Increments of the free intrinsics of each group.
        landmarks: In the order of the slots; four rows where they are homogeneous.
    """

    poses: SE3
    intrinsics: Float[Array, "g m"]
    landmarks: Float[Array, "h l"]


class BundlePriors(eqx.Module):
    """Gaussian beliefs about single variables, each a mean and a square root L of its information, cost ½‖L δ‖².

    None leaves a kind out; a zero L leaves a variable out.

    Attributes:
        cam_from_world: Means of the poses; δ = log(mean @ cam_from_world⁻¹), the camera-frame tangent (ρ, φ).
        cam_root: Their L.
        landmarks: Means of the landmarks; δ = landmark − mean.
        landmark_root: Their L.
        intrinsics: Means of the free intrinsics of every group of cameras, in their order; δ = value − mean.
        intrinsics_root: Reciprocal standard deviations.
    """

    cam_from_world: SE3 | None = None
    cam_root: Float[Array, "c 6 6"] | None = None
    landmarks: Float[Array, "p 3"] | None = None
    landmark_root: Float[Array, "p 3 3"] | None = None
    intrinsics: Float[Array, "g m"] | None = None
    intrinsics_root: Float[Array, "g m"] | None = None


class BundleData(eqx.Module):
    """What is not solved for, by slots; `basis` spans the moves of inverse-depth landmarks."""

    measured: tuple[Float[Array, " s"], ...]
    whitening: tuple[Array, ...]
    weight: Float[Array, " s"]
    camera: Any
    priors: BundlePriors
    factors: tuple[PoseFactors, ...]
    basis: Float[Array, "4 3 l"] | None
    free: tuple[Tied, ...] = eqx.field(static=True)
    residual: Callable[..., Array] | None = eqx.field(static=True)


Components = tuple[Array, ...]


class Motion(eqx.Module):
    """A pose a slot, by components of [R | t]."""

    rotation: tuple[Components, ...]
    translation: Components

    def apply(self, point: Sequence[Array], w: Array | None) -> Components:
        """R x + w t, w = 1 where it is None."""
        x, y, z = point[:3]
        shifts = self.translation if w is None else tuple(t * w for t in self.translation)
        return tuple(a * x + b * y + c * z + t for (a, b, c), t in zip(self.rotation, shifts, strict=True))

    def pull(self, row: Sequence[Array]) -> Components:
        """A derivative by the moved point made one by the point: row R."""
        a, b, c = row
        return tuple(a * x + b * y + c * z for x, y, z in zip(*self.rotation, strict=True))


class View(eqx.Module):
    """What each slot sees: the chain of poses from the world to its camera, its landmark, its camera.

    Attributes:
        motions: The chain by components.
        groups: The same as group elements; only for residuals of the user.
        landmark: Three components, or four with `basis`, the columns that it moves along.
        camera: Parameters a slot, or scalars.
    """

    motions: tuple[Motion, ...]
    groups: tuple[SE3, ...]
    landmark: Components
    basis: tuple[Components, ...] | None
    camera: Any

    @property
    def w(self) -> Array | None:
        """Last homogeneous coordinate; None for Euclidean landmarks."""
        return None if self.basis is None else self.landmark[3]

    def chain(self) -> list[Components]:
        """Landmarks in the frame of every pose of the chain, the camera's last."""
        points: list[Components] = [self.landmark[:3]]
        for motion in self.motions:
            points.append(motion.apply(points[-1], self.w))
        return points[1:]


def view(state: BundleState, data: BundleData, layout: BundleLayout) -> View:
    """Bring cameras and landmarks to the slots: one gather of a table of all that a camera has."""
    chain = [layout.pose] if layout.mount is None else [layout.pose, layout.mount]
    # Without rigs poses are in the order of the cameras already.
    pick = lambda values, index: values if layout.mount is None else values[index]  # noqa: E731
    matrix = state.poses.as_matrix()[:, :3].reshape(-1, 12)
    rows = [pick(matrix, index).T for index in chain]
    if data.residual is not None:
        rows += [pick(state.poses.wxyz_xyz, index).T for index in chain]
    shared = state.intrinsics.shape[0] == 1
    theta = [state.intrinsics[0, j] if shared else state.intrinsics[:, j] for j in range(len(data.free))]
    camera = add_to_camera(data.camera, data.free, theta)
    leaves, tree = jax.tree.flatten(camera)
    own = [leaf[layout.camera_group][None] for leaf in leaves if leaf.ndim]
    table = layout.shard(jnp.concatenate([*rows, *own]).at[:, layout.slot_camera].get(mode="clip"))
    motions = []
    for i in range(len(chain)):
        part = table[12 * i : 12 * i + 12]
        motions.append(
            Motion(tuple((part[4 * j], part[4 * j + 1], part[4 * j + 2]) for j in range(3)), tuple(part[3::4]))
        )
    table = table[12 * len(chain) :]
    groups = []
    if data.residual is not None:
        groups = [SE3(table[7 * i : 7 * i + 7].T) for i in range(len(chain))]
        table = table[7 * len(chain) :]
    values = iter(table)
    camera = jax.tree.unflatten(tree, [next(values) if leaf.ndim else leaf for leaf in leaves])
    landmark, basis = layout.spread(state.landmarks), None
    if len(landmark) == 4:
        spread = layout.spread(landmark_basis(state.landmarks, data))
        basis = tuple(tuple(spread[j, i] for j in range(4)) for i in range(3))
    return View(tuple(motions), tuple(groups), tuple(landmark), basis, camera)


def landmark_basis(landmarks: Float[Array, "4 l"], data: BundleData) -> Float[Array, "4 3 l"]:
    """The directions that homogeneous landmarks move along: their anchor's chart, or the tangent of the sphere."""
    if data.basis is not None:
        return data.basis
    # The reflection that takes the landmark to the last axis, but for its sign, takes the other axes to its tangent.
    v = landmarks.at[3].add(jnp.where(landmarks[3] < 0, -1.0, 1.0))
    scale = 2.0 / jnp.sum(v * v, axis=0)
    return jnp.eye(4, 3, dtype=v.dtype)[:, :, None] - scale[None, None] * v[:, None] * v[None, :3]


def move_landmarks(landmarks: Float[Array, "h l"], step: Float[Array, "3 l"], data: BundleData) -> Float[Array, "h l"]:
    """Landmarks after a step of their tangents."""
    if len(landmarks) == 3:
        return landmarks + step
    moved = landmarks + jnp.sum(landmark_basis(landmarks, data) * step[None], axis=1)
    # An anchored landmark keeps its depth of one in its anchor.
    return moved if data.basis is not None else moved * jax.lax.rsqrt(jnp.sum(moved * moved, axis=0))[None]


def project(camera: Any, point: Sequence[Array], w: Array | None) -> tuple[Array, ...]:
    """Project points of the camera frame, homogeneous ones by their direction."""
    if w is not None and isinstance(camera, RectifiedStereo):
        # Seen from the point scaled by w, the second camera stands at w times the baseline.
        camera = eqx.tree_at(lambda camera: camera.baseline, camera, camera.baseline * w)
    return tuple(camera.project_xyz(*point))


def retract(
    state: BundleState, unknowns: Float[Array, " u"], landmarks: Array, data: BundleData, layout: BundleLayout
) -> BundleState:
    """Move a state along a step; fixed poses stay what they are, to the bit."""
    moved = (SE3.exp(-layout.expand_poses(unknowns)) @ state.poses).normalize()
    fixed = jnp.all(layout.pose_columns >= layout.unknowns, axis=-1, keepdims=True)
    return BundleState(
        SE3(jnp.where(fixed, state.poses.wxyz_xyz, moved.wxyz_xyz)),
        state.intrinsics + layout.expand_groups(unknowns),
        move_landmarks(state.landmarks, landmarks, data),
    )


def intrinsics_values(increments: Float[Array, "g m"], data: BundleData) -> Float[Array, "g m"]:
    """Values of the free intrinsics of each group, of tied ones the first."""
    groups = increments.shape[:1]
    start = [jnp.broadcast_to(get_attribute(data.camera, tied[0]), groups) for tied in data.free]
    return increments + jnp.stack(start, axis=-1) if start else increments


def zero_like_unknowns(layout: BundleLayout, dtype: np.dtype | type) -> tuple[Array, Array]:
    """A step of length zero: unknowns of the reduced system and moves of the landmarks."""
    return jnp.zeros((layout.unknowns,), dtype), jnp.zeros((3, layout.landmark_order.shape[0]), dtype)
