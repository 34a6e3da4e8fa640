"""Trajectory files: TUM (`t x y z qx qy qz qw`) and KITTI (the top three rows of the pose, row by row)."""

import os
import pathlib
from typing import Literal, TextIO

import numpy as np

from vojax._types import ArrayLike, Float

from ._trajectory import Trajectory, first_fault, quaternion_from_rotation, rotation_from_quaternion

TrajectoryFormat = Literal["tum", "kitti"]

_COLUMNS = {"tum": (8, "t x y z qx qy qz qw"), "kitti": (12, "the 3x4 pose matrix, row by row")}


def _check_format(format: str) -> None:
    if format not in _COLUMNS:
        raise ValueError(f"unknown trajectory format {format!r}; expected 'tum' or 'kitti'")


def _read_lines(path: pathlib.Path) -> list[str]:
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such trajectory file")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; expected a trajectory file")
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path}: is not a text file; expected a trajectory") from None


def _read_rows(path: pathlib.Path, format: TrajectoryFormat) -> tuple[np.ndarray, list[int]]:
    columns, meaning = _COLUMNS[format]
    rows: list[list[float]] = []
    line_numbers: list[int] = []
    for number, line in enumerate(_read_lines(path), start=1):
        fields = line.split("#", 1)[0].split()
        if not fields:
            continue
        if len(fields) != columns:
            raise ValueError(
                f"{path}:{number}: found {len(fields)} columns, expected {columns} ({meaning}) in a {format} file"
            )
        try:
            row = [float(field) for field in fields]
        except ValueError as error:
            raise ValueError(f"{path}:{number}: {error}; expected {columns} numbers") from None
        if not np.all(np.isfinite(row)):
            raise ValueError(f"{path}:{number}: found a number that is not finite; expected {meaning}")
        rows.append(row)
        line_numbers.append(number)
    if not rows:
        raise ValueError(f"{path}: holds no poses; expected one line per pose: {meaning}")
    return np.array(rows), line_numbers


def read_trajectory(
    path: str | os.PathLike, format: TrajectoryFormat = "tum", times: Float[ArrayLike, "n"] | None = None
) -> Trajectory:
    """Read a trajectory of `world_from_cam` poses.

    Args:
        path: Text file; empty lines and everything after `#` are skipped.
        format: `"tum"` (`t x y z qx qy qz qw`) or `"kitti"` (the 3x4 pose, row by row).
        times: For KITTI files, which hold none: seconds of each pose. Without it poses are numbered 0, 1, 2, …

    Returns:
        The trajectory. Quaternions are scaled to length 1; KITTI matrices are kept as they are.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not such a trajectory; the message names the line.
    """
    _check_format(format)
    path = pathlib.Path(path)
    if times is not None and format == "tum":
        raise ValueError("a tum file holds its own times; leave out times=")
    rows, line_numbers = _read_rows(path, format)
    poses = np.tile(np.eye(4)[None], (len(rows), 1, 1))
    if format == "tum":
        lengths = np.linalg.norm(rows[:, 4:], axis=1)
        for number, length in zip(line_numbers, lengths, strict=True):
            if abs(length - 1.0) > 1e-2:
                raise ValueError(f"{path}:{number}: the quaternion has length {length:.4g}, expected 1")
        poses[:, :3, :3] = rotation_from_quaternion(np.roll(rows[:, 4:], 1, axis=1))
        poses[:, :3, 3] = rows[:, 1:4]
        timestamps = rows[:, 0]
    else:
        poses[:, :3] = rows.reshape(-1, 3, 4)
        fault = first_fault(poses)
        if fault is not None:
            raise ValueError(f"{path}:{line_numbers[fault[0]]}: not a camera pose: {fault[1]}")
        timestamps = np.arange(len(rows), dtype=np.float64) if times is None else np.asarray(times, np.float64)
        if timestamps.shape != (len(rows),):
            raise ValueError(f"{path}: holds {len(rows)} poses, but {timestamps.size} times were given")
    late = np.flatnonzero(np.diff(timestamps) < 0)
    if late.size:
        i = int(late[0])
        raise ValueError(
            f"{path}:{line_numbers[i + 1]}: time {float(timestamps[i + 1])!r} lies before "
            f"{float(timestamps[i])!r} of the line above; expected times in order"
        )
    return Trajectory(timestamps, poses)


class TrajectoryWriter:
    r"""Append poses to a trajectory file, one whole line at a time.

    Every line reaches the operating system before `append` returns, so a run that is killed leaves a valid file.
    Values keep 12 significant digits and times all of theirs.

    Example:
        >>> import pathlib, tempfile
        >>> import numpy as np
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "trajectory.txt"
        >>> with TrajectoryWriter(path, format="tum") as writer:
        ...     writer.append(np.eye(4), timestamp=0.5)
        >>> path.read_text()
        '0.5 0 0 0 0 0 0 1\n'
    """

    def __init__(self, path: str | os.PathLike, format: TrajectoryFormat = "tum"):
        """Create the file, replacing one that exists.

        Args:
            path: File to write; its folder must exist.
            format: `"tum"` or `"kitti"`.

        Raises:
            FileNotFoundError: The folder does not exist.
        """
        _check_format(format)
        self._path = pathlib.Path(path)
        if not self._path.parent.is_dir():
            raise FileNotFoundError(f"{self._path.parent}: no such folder to write {self._path.name} in")
        self._format = format
        self._last_timestamp = -np.inf
        self._file: TextIO | None = self._path.open("w", encoding="utf-8", newline="\n")

    def append(self, world_from_cam: Float[ArrayLike, "4 4"], timestamp: float | None = None) -> None:
        """Write one pose.

        Args:
            world_from_cam: Rigid transform.
            timestamp: Seconds, not before those of the last pose. Required by TUM, ignored by KITTI.

        Raises:
            ValueError: The writer is closed, the pose is not rigid, or the time is missing or goes backwards.
        """
        if self._file is None:
            raise ValueError(f"{self._path}: the writer is closed")
        pose = np.asarray(world_from_cam, dtype=np.float64)
        fault = first_fault(pose[None])
        if fault is not None:
            raise ValueError(f"{self._path}: refused a pose: {fault[1]}")
        # Adding 0 turns the -0.0 that rounding leaves behind into 0.
        if self._format == "kitti":
            line = " ".join(f"{value + 0.0:.12g}" for value in pose[:3].ravel())
        else:
            if timestamp is None or not np.isfinite(timestamp) or timestamp < self._last_timestamp:
                raise ValueError(
                    f"{self._path}: a tum pose needs a time from {float(self._last_timestamp)!r} on; found {timestamp}"
                )
            self._last_timestamp = float(timestamp)
            w, x, y, z = quaternion_from_rotation(pose[:3, :3])
            values = (*pose[:3, 3], x, y, z, w)
            line = " ".join([repr(self._last_timestamp), *(f"{value + 0.0:.12g}" for value in values)])
        self._file.write(line + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file; closing twice does no harm."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> "TrajectoryWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def write_trajectory(path: str | os.PathLike, trajectory: Trajectory, format: TrajectoryFormat = "tum") -> None:
    """Write a trajectory; `read_trajectory` gives it back to 12 significant digits.

    Args:
        path: File to write; its folder must exist.
        trajectory: Poses `world_from_cam`.
        format: `"tum"` or `"kitti"` (which drops the times).

    Raises:
        FileNotFoundError: The folder does not exist.
    """
    with TrajectoryWriter(path, format) as writer:
        for timestamp, pose in zip(trajectory.timestamps, trajectory.world_from_cam, strict=True):
            writer.append(pose, float(timestamp))
