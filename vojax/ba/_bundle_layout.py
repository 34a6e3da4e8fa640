"""How the observations of a bundle lie in memory, worked out once on the host.

The sums of bundle adjustment run over three groupings, and none of them is a scatter of single observations:

- over a landmark: observations are stored in slots [degree, landmark], landmarks of equal degree together, so that a
  sum is a reduction along an axis and a landmark's value is broadcast to its observations;
- over a camera: its observations are cut into chunks of equal size, one small matrix product each;
- over a pair of cameras: the pairs of observations of common landmarks likewise.

Only the chunks' few results are added by index. On Ladybug-49 (31,843 observations, 123,086 pairs, 9 parameters a
camera, float64) products of pairs in chunks take 10-13 ms; products in lanes with a sorted segment sum take 73 ms, one
row a pair 85 ms.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from vojax._types import Array, Float, Int

# Landmarks of up to these degrees share a block of slots; beyond, each is a third larger than the one before.
_DEGREES = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32)
_CAMERA_CHUNK = 32
_PAIR_CHUNK = 8


class BundleLayout(eqx.Module):
    """Indices of slots, chunks and unknowns.

    Attributes:
        slot_observation: The observation in each slot; their number where the slot is padding.
        slot_camera: Its camera.
        landmark_order: The landmarks that are seen, in the order of the slots.
        camera_slots: Slots of each chunk of a camera's observations; the number of slots where it is padding.
        chunk_camera: The camera of each chunk, ascending.
        pair_slots: Slots (first, second) of each chunk of pairs, `camera(first) <= camera(second)`.
        chunk_block: The block of each chunk of pairs, ascending.
        block_cameras: The cameras of each block.
        columns: The unknown that each parameter of each camera is; their number where it is fixed.
        camera_group: The group of cameras with common intrinsics that each camera belongs to.
        pose: The pose of each camera, or of the rig that it is in.
        mount: Its pose in the rig; None without rigs.
        group_columns: The unknown that each free intrinsic of each group is.
        group_camera: One camera of each group; their number where it has none.
        pose_columns: The unknowns of each pose.
        factor_poses: The poses of every factor, by kinds.
        factor_columns: Their unknowns.
        landmark_free: 0 for landmarks that stay where they are, else 1.
        buckets: Degree and number of landmarks of every block of slots.
        unknowns: Of the reduced system, shared ones last.
        frames: Number of poses that are not those of cameras in a rig.
        has_pairs: Whether pairs of slots were listed, for a reduced system that is formed.
        sharding: How slots lie over devices; None: all on one.

    With rigs a camera here is one camera of the rig at one pose of the rig: both poses are shared with others.
    """

    slot_observation: Int[Array, " s"]
    slot_camera: Int[Array, " s"]
    landmark_order: Int[Array, " l"]
    camera_slots: Int[Array, "a q"]
    chunk_camera: Int[Array, " a"]
    pair_slots: tuple[Int[Array, "b r"], Int[Array, "b r"]]
    chunk_block: Int[Array, " b"]
    block_cameras: tuple[Int[Array, " n"], Int[Array, " n"]]
    columns: Int[Array, "c k"]
    camera_group: Int[Array, " c"]
    pose: Int[Array, " c"]
    mount: Int[Array, " c"] | None
    group_columns: Int[Array, "g m"]
    group_camera: Int[Array, " g"]
    pose_columns: Int[Array, "t 6"]
    factor_poses: tuple[Int[Array, "_ _"], ...]
    factor_columns: tuple[Int[Array, "_ _"], ...]
    landmark_free: Int[Array, " l"]
    buckets: tuple[tuple[int, int], ...] = eqx.field(static=True)
    unknowns: int = eqx.field(static=True)
    frames: int = eqx.field(static=True)
    has_pairs: bool = eqx.field(static=True)
    sharding: NamedSharding | None = eqx.field(static=True, default=None)

    @property
    def slots(self) -> int:
        """Number of slots, padding included."""
        return sum(degree * count for degree, count in self.buckets)

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return self.columns.shape[0]

    def take(self, unknowns: Float[Array, " u"], columns: Int[Array, "..."]) -> Float[Array, "..."]:
        """Entries of a vector of unknowns; 0 where a parameter is fixed."""
        if not self.unknowns:  # XLA takes nothing from nothing
            return jnp.zeros(columns.shape, unknowns.dtype)
        return unknowns.at[columns].get(mode="fill", fill_value=0)

    def expand(self, unknowns: Float[Array, " u"]) -> Float[Array, "c k"]:
        """Every camera's share of a vector of unknowns."""
        return self.take(unknowns, self.columns)

    def expand_poses(self, unknowns: Float[Array, " u"]) -> Float[Array, "t 6"]:
        """Every pose's share of a vector of unknowns."""
        return self.take(unknowns, self.pose_columns)

    def expand_groups(self, unknowns: Float[Array, " u"]) -> Float[Array, "g m"]:
        """The free intrinsics' share of a vector of unknowns."""
        return self.take(unknowns, self.group_columns)

    def collapse(self, values: Float[Array, "c k"], factors: Sequence[Float[Array, "_ _"]] = ()) -> Float[Array, " u"]:
        """Add up what cameras, and factors, say about each unknown; the transpose of `expand`."""
        total = jnp.zeros((self.unknowns,), values.dtype).at[self.columns].add(values, mode="drop")
        for columns, part in zip(self.factor_columns, factors, strict=False):
            total = total.at[columns].add(part, mode="drop")
        return total

    def sum_cameras(self, rows: Float[Array, "s k"]) -> Float[Array, "c k"]:
        """Add up the slots of every camera."""
        chunks = jnp.sum(rows.at[self.camera_slots].get(mode="fill", fill_value=0), axis=1)
        return jax.ops.segment_sum(chunks, self.chunk_camera, self.cameras, indices_are_sorted=True)

    def shard(self, values: Array) -> Array:
        """Lay the last axis, of slots, over the devices."""
        if self.sharding is None:
            return values
        spec = PartitionSpec(*[None] * (values.ndim - 1), *self.sharding.spec)
        return jax.lax.with_sharding_constraint(values, NamedSharding(self.sharding.mesh, spec))

    def spread(self, values: Array) -> Array:
        """Give every slot the value of its landmark: `[..., l]` to `[..., s]`."""
        parts, start = [], 0
        for degree, count in self.buckets:
            part = values[..., None, start : start + count]
            parts.append(jnp.broadcast_to(part, (*values.shape[:-1], degree, count)).reshape(*values.shape[:-1], -1))
            start += count
        return self.shard(jnp.concatenate(parts, axis=-1))

    def sum_landmarks(self, values: Array) -> Array:
        """Add up the slots of every landmark: `[..., s]` to `[..., l]`."""
        parts, start = [], 0
        for degree, count in self.buckets:
            part = values[..., start : start + degree * count].reshape(*values.shape[:-1], degree, count)
            parts.append(jnp.sum(part, axis=-2))
            start += degree * count
        return jnp.concatenate(parts, axis=-1)


class Unknowns(NamedTuple):
    """The reduced system's unknowns, poses first and intrinsics last; see `BundleLayout`."""

    columns: np.ndarray
    camera_group: np.ndarray
    pose: np.ndarray
    mount: np.ndarray | None
    pose_columns: np.ndarray
    group_columns: np.ndarray
    count: int


def number_unknowns(
    free_pose: np.ndarray,
    free_intrinsics: np.ndarray,
    camera_group: np.ndarray,
    pose: np.ndarray,
    mount: np.ndarray | None,
) -> Unknowns:
    """Number the parameters that are free.

    Args:
        free_pose: For each pose and each of the six coordinates of its tangent.
        free_intrinsics: For each group and each free attribute of its camera.
        camera_group: The group of each camera.
        pose: The pose of each camera.
        mount: The pose of each camera in its rig, if there are rigs.
    """
    free = np.concatenate([free_pose.ravel(), free_intrinsics.ravel()])
    count = int(free.sum())
    number = np.where(free, np.cumsum(free) - 1, count)
    poses = number[: free_pose.size].reshape(free_pose.shape)
    groups = number[free_pose.size :].reshape(free_intrinsics.shape)
    chain = [poses[pose]] if mount is None else [poses[pose], poses[mount]]
    return Unknowns(
        np.concatenate([*chain, groups[camera_group]], axis=1), camera_group, pose, mount, poses, groups, count
    )


def bundle_layout(
    camera_index: np.ndarray,
    landmark_index: np.ndarray,
    used: np.ndarray,
    fixed_landmarks: np.ndarray,
    unknowns: Unknowns,
    frames: int,
    factor_poses: Sequence[np.ndarray],
    with_pairs: bool,
) -> BundleLayout:
    """Arrange observations.

    Args:
        camera_index: Camera of every observation.
        landmark_index: Landmark of every observation.
        used: False for observations that get no slot.
        fixed_landmarks: True for landmarks that stay.
        unknowns: What the cameras' parameters are.
        frames: Number of poses that are not those of cameras in a rig.
        factor_poses: The poses `[f, n]` of every kind of factor.
        with_pairs: Whether to list pairs of observations: far more than observations where landmarks are seen often.
    """
    observations = np.flatnonzero(used)
    # Within a landmark by camera: equal input in another order gives equal slots.
    order = observations[np.lexsort((camera_index[observations], landmark_index[observations]))]
    seen, degree = np.unique(landmark_index[order], return_counts=True)
    first = np.cumsum(degree) - degree
    capacity = _capacity(degree)
    slots, landmarks, buckets = [], [], []
    for size in np.unique(capacity):
        members = np.flatnonzero(capacity == size)
        position = np.arange(size)[:, None]
        filled = position < degree[members]
        rows = np.where(filled, order[np.minimum(first[members] + position, len(order) - 1)], -1)
        slots.append(rows.ravel())
        landmarks.append(seen[members])
        buckets.append((int(size), len(members)))
    observation = np.concatenate(slots) if slots else np.zeros(0, int)
    landmark_order = np.concatenate(landmarks) if landmarks else np.zeros(0, int)
    padding = observation < 0
    camera = np.where(padding, 0, camera_index[np.where(padding, 0, observation)]) if len(observation) else observation
    real = np.flatnonzero(~padding)
    camera_slots, chunk_camera = _chunks(real, camera[real], _CAMERA_CHUNK, len(observation))
    one, other = _pairs(buckets if with_pairs else [], padding, camera)
    blocks, block = np.unique(camera[one] * len(unknowns.columns) + camera[other], return_inverse=True)
    left, chunk_block = _chunks(one, block, _PAIR_CHUNK, len(observation))
    right, _ = _chunks(other, block, _PAIR_CHUNK, len(observation))
    return BundleLayout(
        slot_observation=_as_index(np.where(padding, len(camera_index), observation)),
        slot_camera=_as_index(camera),
        landmark_order=_as_index(landmark_order),
        camera_slots=_as_index(camera_slots),
        chunk_camera=_as_index(chunk_camera),
        pair_slots=(_as_index(left), _as_index(right)),
        chunk_block=_as_index(chunk_block),
        block_cameras=(_as_index(blocks // len(unknowns.columns)), _as_index(blocks % len(unknowns.columns))),
        columns=_as_index(unknowns.columns),
        camera_group=_as_index(unknowns.camera_group),
        pose=_as_index(unknowns.pose),
        mount=None if unknowns.mount is None else _as_index(unknowns.mount),
        pose_columns=_as_index(unknowns.pose_columns),
        factor_poses=tuple(_as_index(i) for i in factor_poses),
        factor_columns=tuple(_as_index(unknowns.pose_columns[i].reshape(len(i), -1)) for i in factor_poses),
        group_columns=_as_index(unknowns.group_columns),
        group_camera=_as_index(_first_of_each(unknowns.camera_group, len(unknowns.group_columns))),
        landmark_free=_as_index(~fixed_landmarks[landmark_order]),
        buckets=tuple(buckets),
        unknowns=unknowns.count,
        frames=frames,
        has_pairs=with_pairs,
    )


def _capacity(degree: np.ndarray) -> np.ndarray:
    """The number of slots that a landmark of each degree gets."""
    sizes: list[int] = list(_DEGREES)
    while sizes[-1] < degree.max(initial=1):
        sizes.append(sizes[-1] * 4 // 3)
    table = np.array(sizes)
    return table[np.searchsorted(table, degree)]


def _pairs(buckets: list[tuple[int, int]], padding: np.ndarray, camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ordered pairs of slots of one landmark whose cameras ascend; a slot is a pair with itself."""
    ones, others, start = [], [], 0
    for degree, count in buckets:
        slots = start + np.arange(degree * count).reshape(degree, count)
        start += degree * count
        for i, j in itertools.product(range(degree), repeat=2):
            one, other = slots[i], slots[j]
            keep = ~padding[one] & ~padding[other] & (camera[one] <= camera[other])
            ones.append(one[keep])
            others.append(other[keep])
    if not ones:
        return np.zeros(0, int), np.zeros(0, int)
    return np.concatenate(ones), np.concatenate(others)


def _chunks(values: np.ndarray, group: np.ndarray, size: int, fill: int) -> tuple[np.ndarray, np.ndarray]:
    """Cut the values of every group into rows of `size`; the rows, and the group of each, ascending."""
    order = np.argsort(group, kind="stable")
    groups, counts = np.unique(group, return_counts=True)
    chunks = -(-counts // size)
    rows = np.full((int(chunks.sum()), size), fill)
    within = np.arange(len(values)) - np.repeat(np.cumsum(counts) - counts, counts)
    rows.reshape(-1)[np.repeat(np.cumsum(chunks) - chunks, counts) * size + within] = values[order]
    return rows, np.repeat(groups, chunks)


def _first_of_each(group: np.ndarray, groups: int) -> np.ndarray:
    """The first member of every group; the number of members where there is none."""
    first = np.full(groups, len(group))
    found, index = np.unique(group, return_index=True)
    first[found] = index
    return first


def _as_index(values: np.ndarray) -> Array:
    return jnp.asarray(values, jnp.int32)
