"""What a run knows so far, frame by frame, and the files that hold it."""

import dataclasses
import pathlib

import numpy as np

from vojax.metrics import TrajectoryWriter
from vojax.odometry import FrameEstimate

from ._timing import seconds_since_process_start

# An earlier run's numbers and pictures must not stand beside another trajectory.
_RESULTS = ("metrics.json", "trajectory.png", "drift.png", "timings.png", "view.png")


class TrajectoryFiles:
    """`trajectory.txt` (TUM) and `trajectory_kitti.txt`, a line per pose as soon as it is known.

    They replace those of an earlier run with the first pose, and are whole lines at any time.
    """

    def __init__(self, out: pathlib.Path, times: np.ndarray):
        self._out, self._times = out, times
        self._written = 0
        self._tum: TrajectoryWriter | None = None
        self._kitti: TrajectoryWriter | None = None

    def append(self, pose: np.ndarray) -> None:
        """Write the next pose.

        Raises:
            ValueError: It is not finite or not rigid; the files stay as they are.
        """
        if self._tum is None or self._kitti is None:
            for name in _RESULTS:
                (self._out / name).unlink(missing_ok=True)
            self._tum = TrajectoryWriter(self._out / "trajectory.txt", "tum")
            self._kitti = TrajectoryWriter(self._out / "trajectory_kitti.txt", "kitti")
        self._tum.append(pose, float(self._times[self._written]))
        self._kitti.append(pose)
        self._written += 1

    def close(self) -> None:
        """Close both files."""
        for writer in (self._tum, self._kitti):
            if writer is not None:
                writer.close()


@dataclasses.dataclass
class RunLog:
    """Estimates in the order of the frames; poses that a monocular pipeline finds later are put where they belong.

    Attributes:
        files: Where a pose is written before it counts as known.
        poses: `[4, 4]` of the first frames; fewer than were taken while some are pending.
        inliers: Of the frames after the first that were not pending.
        flags: Frames by what was said of them.
        keyframes: How many there were.
        lost: Frames whose pose nobody found; they have that of the last frame before them.
        unreadable: What was wrong with a frame's images, by frame.
        current: The frame that is being taken.
        first_pose_seconds: From the start of the process to the first motion.
        view: The image to draw tracks in, and what was found there.
    """

    files: TrajectoryFiles
    poses: list[np.ndarray] = dataclasses.field(default_factory=list)
    inliers: list[int] = dataclasses.field(default_factory=list)
    flags: dict[str, list[int]] = dataclasses.field(default_factory=dict)
    keyframes: int = 0
    lost: list[int] = dataclasses.field(default_factory=list)
    unreadable: dict[int, Exception] = dataclasses.field(default_factory=dict)
    current: int = 0
    first_pose_seconds: float | None = None
    view: tuple[np.ndarray, FrameEstimate] | None = None
    _frames: int = 0
    _bridged: set[int] = dataclasses.field(default_factory=set)

    @property
    def bridged(self) -> list[int]:
        """Frames whose pose is a guess: not tracked, not read, or lost."""
        return sorted(self._bridged.union(self.lost))

    def add(self, estimate: FrameEstimate) -> list[np.ndarray]:
        """Take the next frame's estimate.

        Returns:
            The poses that are known now, of the frames that follow those known before.
        """
        frame, pending, known = self._frames, self._frames - len(self.poses), []
        if not estimate.pending:
            late = list(np.asarray(estimate.earlier, np.float64))[:pending]
            known = self._repeated(pending - len(late)) + late + [np.asarray(estimate.world_from_cam, np.float64)]
            self._know(known)
            if frame:
                self.inliers.append(int(estimate.num_inliers))
            if frame and not estimate.bridged and self.first_pose_seconds is None:
                self.first_pose_seconds = seconds_since_process_start()
        if estimate.bridged:
            self._bridged.add(frame)
        for flag in estimate.flags:
            self.flags.setdefault(str(flag), []).append(frame)
        self.keyframes += bool(estimate.keyframe)
        self._frames += 1
        return known

    def finish(self) -> list[np.ndarray]:
        """Give the frames that are still pending the last pose that is known, and return these poses."""
        return self._know(self._repeated(self._frames - len(self.poses)))

    def _repeated(self, count: int) -> list[np.ndarray]:
        """Stand-ins for the next poses, which nobody will find."""
        known = len(self.poses)
        self.lost += range(known, known + count)
        return [self.poses[-1] if self.poses else np.eye(4)] * count

    def _know(self, poses: list[np.ndarray]) -> list[np.ndarray]:
        for pose in poses:
            self.files.append(pose)
            self.poses.append(pose)
        return poses
