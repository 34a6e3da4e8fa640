"""Camera trajectories on the host: timestamps and `world_from_cam` poses, in float64."""

import dataclasses

import numpy as np

from vojax._types import Float

# Rotations in text files carry as few as four digits; anything rougher is another kind of matrix.
ROTATION_TOLERANCE = 1e-3


def first_fault(world_from_cam: Float[np.ndarray, "n 4 4"]) -> tuple[int, str] | None:
    """Find the first matrix that is not a rigid transform, and say what keeps it from being one."""
    finite = np.all(np.isfinite(world_from_cam), axis=(1, 2))
    poses = np.where(finite[:, None, None], world_from_cam, np.eye(4)[None])
    rotations = poses[:, :3, :3]
    gap = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)[None]).max(axis=(1, 2))
    last_row_off = np.abs(poses[:, 3] - np.array([[0.0, 0.0, 0.0, 1.0]])).max(axis=1) > 1e-6
    reflected = np.linalg.det(rotations) < 0
    faulty = ~finite | (gap > ROTATION_TOLERANCE) | reflected | last_row_off
    if not faulty.any():
        return None
    i = int(np.argmax(faulty))
    if not finite[i]:
        return i, "it has entries that are not finite numbers"
    if gap[i] > ROTATION_TOLERANCE:
        return i, f"its 3x3 part is not a rotation: R Rᵀ differs from the identity by {gap[i]:.2g}"
    if reflected[i]:
        return i, "its 3x3 part is a reflection (determinant -1), not a rotation"
    return i, "its last row is not 0 0 0 1"


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """Timestamped camera poses.

    Attributes:
        timestamps: Seconds, never decreasing (real truth files hold equal ones); frame numbers where a format has none.
        world_from_cam: Rigid transforms from the camera's frame to the world's; translations in metres.

    Raises:
        ValueError: No poses, lengths that differ, times that go backwards, or matrices that are not rigid.
    """

    timestamps: Float[np.ndarray, "n"]
    world_from_cam: Float[np.ndarray, "n 4 4"]

    def __post_init__(self):
        timestamps = np.array(self.timestamps, dtype=np.float64)
        poses = np.array(self.world_from_cam, dtype=np.float64)
        if timestamps.ndim != 1 or poses.ndim != 3 or poses.shape != (timestamps.size, 4, 4):
            raise ValueError(
                f"a trajectory needs timestamps [n] and world_from_cam [n, 4, 4]; found shapes "
                f"{timestamps.shape} and {poses.shape}"
            )
        if timestamps.size == 0:
            raise ValueError("a trajectory needs at least one pose; found none")
        if not np.all(np.isfinite(timestamps)):
            raise ValueError(f"timestamp {int(np.argmin(np.isfinite(timestamps)))} is not a finite number")
        late = np.flatnonzero(np.diff(timestamps) < 0)
        if late.size:
            i = int(late[0])
            raise ValueError(
                f"timestamps must not go backwards; number {i + 1} ({float(timestamps[i + 1])!r}) comes before "
                f"number {i} ({float(timestamps[i])!r})"
            )
        fault = first_fault(poses)
        if fault is not None:
            raise ValueError(f"pose {fault[0]} is not a rigid transform: {fault[1]}")
        timestamps.setflags(write=False)
        poses.setflags(write=False)
        object.__setattr__(self, "timestamps", timestamps)
        object.__setattr__(self, "world_from_cam", poses)

    def __len__(self) -> int:
        return self.timestamps.size

    @property
    def positions(self) -> Float[np.ndarray, "n 3"]:
        """Camera centres in the world's frame, in metres."""
        return self.world_from_cam[:, :3, 3]

    @property
    def distances(self) -> Float[np.ndarray, "n"]:
        """Metres travelled up to each pose."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return np.concatenate([np.zeros(1), np.cumsum(steps)])

    @property
    def path_length(self) -> float:
        """Metres travelled from the first pose to the last."""
        return float(self.distances[-1])

    def select(self, indices: np.ndarray) -> "Trajectory":
        """Keep the poses with these indices (increasing)."""
        return Trajectory(self.timestamps[indices], self.world_from_cam[indices])

    def from_origin(self) -> "Trajectory":
        """Express the poses in the frame of the first one, which becomes the identity (to the digits of its matrix)."""
        first = np.array(self.world_from_cam[:1])
        # The nearest rotation: inverting a matrix of seven digits would scale a long path.
        left, _, right = np.linalg.svd(first[0, :3, :3])
        first[0, :3, :3] = left @ right
        return Trajectory(self.timestamps, rigid_inverse(first) @ self.world_from_cam)


def rigid_inverse(transforms: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Invert rigid transforms by transposing their rotations."""
    inverse = np.zeros_like(transforms)
    rotations = transforms[:, :3, :3].transpose(0, 2, 1)
    inverse[:, :3, :3] = rotations
    inverse[:, :3, 3] = -np.einsum("nij,nj->ni", rotations, transforms[:, :3, 3])
    inverse[:, 3, 3] = 1.0
    return inverse


def rotation_angles(rotations: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n"]:
    """Geodesic angles in radians, accurate from 0 to π."""
    axis = np.stack(
        [
            rotations[:, 2, 1] - rotations[:, 1, 2],
            rotations[:, 0, 2] - rotations[:, 2, 0],
            rotations[:, 1, 0] - rotations[:, 0, 1],
        ],
        axis=1,
    )
    return np.arctan2(np.linalg.norm(axis, axis=1), np.trace(rotations, axis1=1, axis2=2) - 1.0)


def rotation_from_quaternion(wxyz: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotation matrices of quaternions, which need not have length 1."""
    w, x, y, z = (wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )


def quaternion_from_rotation(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Unit quaternion wxyz with w >= 0.

    The matrix below is 4 q qᵀ, so each of its rows is a multiple of q; the row with the largest diagonal entry is
    the one that rounding hurts least.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation
    outer = np.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    row = outer[int(np.argmax(np.diag(outer)))]
    wxyz = row / np.linalg.norm(row)
    return -wxyz if wxyz[0] < 0 else wxyz
