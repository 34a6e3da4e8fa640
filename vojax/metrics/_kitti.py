"""Relative errors over stretches of road, as the KITTI odometry benchmark counts them."""

import dataclasses

import numpy as np

from vojax._types import ArrayLike, Float

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)


@dataclasses.dataclass(frozen=True, eq=False)
class KittiErrors:
    """Relative errors of every stretch, each divided by its length.

    Attributes:
        lengths_m: Nominal length of each stretch.
        first_frames: Index of the pose at which it starts.
        translation: Translation error per metre (1 is 100 %).
        rotation_rad_per_m: Rotation error per metre.
    """

    lengths_m: Float[np.ndarray, "segments"]
    first_frames: np.ndarray
    translation: Float[np.ndarray, "segments"]
    rotation_rad_per_m: Float[np.ndarray, "segments"]

    @property
    def t_rel_percent(self) -> float | None:
        """Mean translation error over all stretches in percent; None where the path is too short for one."""
        return float(100.0 * self.translation.mean()) if self.translation.size else None

    @property
    def r_rel_deg_per_100m(self) -> float | None:
        """Mean rotation error over all stretches in degrees per 100 m; None where the path is too short for one."""
        return float(100.0 * np.degrees(self.rotation_rad_per_m.mean())) if self.translation.size else None


def kitti_errors(
    estimate: Float[ArrayLike, "n 4 4"],
    truth: Float[ArrayLike, "n 4 4"],
    lengths_m: tuple[float, ...] = KITTI_LENGTHS_M,
    step: int = 10,
) -> KittiErrors:
    """Compare relative motions over stretches of 100 to 800 m, starting at every tenth frame.

    A stretch ends at the first frame that lies more than its length further along the true path. Its error is the
    motion that is left between the true and the estimated end pose, both seen from the start; as in the development
    kit it is divided by the nominal length.

    Args:
        estimate: Poses `world_from_cam`, metres; frame i belongs to frame i of `truth`.
        truth: True poses, metres.
        lengths_m: Lengths of the stretches in metres.
        step: Frames between two starts.

    Returns:
        The errors of all stretches, with their means in the benchmark's units.

    Degenerate input: a path shorter than the shortest length has no stretches; its means are None.

    References: Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?", CVPR 2012, and the benchmark's
    development kit (which rounds distances along the path to single precision; this does not).
    """
    estimate = np.asarray(estimate, dtype=np.float64)
    truth = np.asarray(truth, dtype=np.float64)
    steps = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate([np.zeros(1), np.cumsum(steps)])
    starts = np.arange(0, len(truth), step)
    first = np.repeat(starts, len(lengths_m))
    length = np.tile(np.asarray(lengths_m, dtype=np.float64), len(starts))
    last = np.searchsorted(distance, distance[first] + length, side="right")
    complete = last < len(truth)
    first, length, last = first[complete], length[complete], last[complete]

    def motion(poses: np.ndarray) -> np.ndarray:
        return np.linalg.solve(poses[first], poses[last])

    error = np.linalg.solve(motion(estimate), motion(truth))
    cosine = np.clip(0.5 * (np.trace(error[:, :3, :3], axis1=1, axis2=2) - 1.0), -1.0, 1.0)
    return KittiErrors(
        lengths_m=length,
        first_frames=first,
        translation=np.linalg.norm(error[:, :3, 3], axis=1) / length,
        rotation_rad_per_m=np.arccos(cosine) / length,
    )
