"""Sets of tracked features without images: GTSAM's stereo tracks and Sapienza's planar robot."""

import dataclasses
import os
import pathlib

import numpy as np
from jaxtyping import Float64, Int64

from vojax.cameras import Pinhole, RectifiedStereo

from ._pictures import check_index
from ._poses import check_rotations, compose
from ._text import numbers, text_lines, whole_number

_APPEARANCE = 10


@dataclasses.dataclass(frozen=True, eq=False)
class StereoTracks:
    """Measurements of a rectified stereo pair, by frame and then by track; each track once a frame.

    Attributes:
        stereo: The pair, baseline in metres.
        frame_index: Frame of every measurement, not decreasing.
        track_index: Track of every measurement, from 0 without gaps.
        measurements: `(u_left, v, u_right)` in pixels, as `RectifiedStereo.project` gives them.
        points_cam: What the set's maker triangulated: points in the left camera's frame, metres.
        track_names: The number that the file gives each track.
        initial_poses: `world_from_cam` of each frame, metres: an initial estimate, not the truth.
    """

    stereo: RectifiedStereo
    frame_index: Int64[np.ndarray, "o"]
    track_index: Int64[np.ndarray, "o"]
    measurements: Float64[np.ndarray, "o 3"]
    points_cam: Float64[np.ndarray, "o 3"]
    track_names: Int64[np.ndarray, "tracks"]
    initial_poses: Float64[np.ndarray, "n 3 4"]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.initial_poses)

    def frame(self, k: int) -> slice:
        """The measurements of frame `k`, as a slice of the arrays."""
        return _rows_of_frame(self.frame_index, k, len(self))


@dataclasses.dataclass(frozen=True, eq=False)
class PlanarTracks:
    """What the camera of a robot sees that drives on a plane, by frame; each landmark at most once a frame.

    Attributes:
        camera: The camera, without distortion.
        size: Width and height of its images, pixels.
        depth_range: The depths between which it sees, metres.
        robot_from_cam: Where the camera stands on the robot, metres.
        frame_index: Frame of every measurement, not decreasing.
        track_index: Landmark of every measurement: its row in `landmarks`.
        pixels: Measurements (u, v).
        appearance: What each measurement looks like, for a matching of your own.
        odometry: Poses `(x, y, θ)` of the robot by its wheels, metres and radians.
        robot_poses: The true ones.
        poses: The true `world_from_cam`, metres.
        landmarks: The true points in the world frame, metres.
        landmark_appearance: What each of them looks like.
    """

    camera: Pinhole
    size: tuple[int, int]
    depth_range: tuple[float, float]
    robot_from_cam: Float64[np.ndarray, "3 4"]
    frame_index: Int64[np.ndarray, "o"]
    track_index: Int64[np.ndarray, "o"]
    pixels: Float64[np.ndarray, "o 2"]
    appearance: Float64[np.ndarray, "o 10"]
    odometry: Float64[np.ndarray, "n 3"]
    robot_poses: Float64[np.ndarray, "n 3"]
    poses: Float64[np.ndarray, "n 3 4"]
    landmarks: Float64[np.ndarray, "p 3"]
    landmark_appearance: Float64[np.ndarray, "p 10"]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.poses)

    def frame(self, k: int) -> slice:
        """The measurements of frame `k`, as a slice of the arrays."""
        return _rows_of_frame(self.frame_index, k, len(self))


def read_stereo_tracks(folder: str | os.PathLike[str]) -> StereoTracks:
    """Read stereo tracks as GTSAM's examples hold them.

    Args:
        folder: It holds one `VO_calibration*.txt` (`fx fy skew cx cy baseline`), one `VO_stereo_factors*.txt` (`frame
            track u_left u_right v x y z`) and one `VO_camera_poses*.txt` (`frame` and a 4×4 pose, row by row).

    Returns:
        The measurements, sorted by frame and track.

    Raises:
        FileNotFoundError: The folder or a file is missing.
        ValueError: A file does not hold what it should, or there are several of a kind.
    """
    folder = pathlib.Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} not found: expected a folder that holds VO_stereo_factors*.txt")
    calibration, factors, trajectory = (
        _only_file(folder, f"VO_{part}*.txt") for part in ("calibration", "stereo_factors", "camera_poses")
    )
    stereo = _stereo(calibration)
    poses = _numbered_poses(trajectory)
    expected = "rows 'frame track u_left u_right v x y z'"
    lines = text_lines(factors, expected)
    if not lines:
        raise ValueError(f"{factors} holds no measurements: expected {expected}")
    frames, tracks, rows = [], [], []
    for number, line in lines:
        words, where = line.split(), f"{factors}, line {number},"
        if len(words) != 8:
            raise ValueError(f"{where} has {len(words)} columns: expected 'frame track u_left u_right v x y z'")
        frames.append(whole_number(words[0], "frame", where))
        tracks.append(whole_number(words[1], "track", where))
        rows.append(numbers(words[2:], 6, f"{where} from column 3 on,"))
        if frames[-1] >= len(poses):
            raise ValueError(f"{where} is of frame {frames[-1]}: expected 0 to {len(poses) - 1}, as in {trajectory}")
    frame_index, names, values = np.array(frames), np.array(tracks), np.stack(rows)
    order = np.lexsort((names, frame_index))
    twice = np.flatnonzero((np.diff(frame_index[order]) == 0) & (np.diff(names[order]) == 0))
    if len(twice):
        # The sort is stable: of the two, this one comes later in the file.
        i = int(order[twice[0] + 1])
        raise ValueError(
            f"{factors}, line {lines[i][0]}: frame {frames[i]} has track {tracks[i]} already: expected each once"
        )
    track_names, track_index = np.unique(names[order], return_inverse=True)
    values = values[order]
    return StereoTracks(
        stereo=stereo,
        frame_index=frame_index[order],
        track_index=track_index,
        measurements=values[:, [0, 2, 1]],
        points_cam=values[:, 3:],
        track_names=track_names,
        initial_poses=poses,
    )


def read_planar_tracks(folder: str | os.PathLike[str]) -> PlanarTracks:
    """Read the visual odometry data set of Sapienza's course on probabilistic robotics.

    Args:
        folder: It holds `camera.dat`, `trajectory.dat` (`frame`, odometry `x y θ`, truth `x y θ`), `world.dat`
            (`landmark x y z` and ten numbers of appearance) and `meas-00000.dat` and so on, one per frame (`point
            number landmark u v` and ten numbers of appearance).

    Returns:
        The measurements, in the files' order.

    Raises:
        FileNotFoundError: The folder or a file is missing.
        ValueError: A file does not hold what it should.
    """
    folder = pathlib.Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} not found: expected a folder that holds camera.dat and meas-00000.dat, …")
    camera, robot_from_cam, depth_range, size = _planar_camera(folder / "camera.dat")
    trajectory = _numbered_rows(folder / "trajectory.dat", 6, "rows 'frame' and x y θ by odometry and in truth")
    world = _numbered_rows(folder / "world.dat", 3 + _APPEARANCE, "rows 'landmark x y z' and ten of appearance")
    found = sorted(folder.glob("meas-*.dat"))
    if len(found) != len(trajectory):
        raise ValueError(
            f"{folder} has {len(found)} files meas-*.dat and trajectory.dat {len(trajectory)} poses: expected one file "
            "per pose"
        )
    seen = [_measurements(folder / f"meas-{k:05d}.dat", k, len(world)) for k in range(len(trajectory))]
    values = np.concatenate([rows for _, rows in seen])
    return PlanarTracks(
        camera=camera,
        size=size,
        depth_range=depth_range,
        robot_from_cam=robot_from_cam,
        frame_index=np.repeat(np.arange(len(seen)), [len(landmarks) for landmarks, _ in seen]),
        track_index=np.concatenate([landmarks for landmarks, _ in seen]),
        pixels=values[:, :2],
        appearance=values[:, 2:],
        odometry=trajectory[:, :3],
        robot_poses=trajectory[:, 3:],
        poses=compose(_on_the_plane(trajectory[:, 3:]), robot_from_cam),
        landmarks=world[:, :3],
        landmark_appearance=world[:, 3:],
    )


def _rows_of_frame(frame_index: np.ndarray, k: int, frames: int) -> slice:
    k = check_index(k, frames, "of tracks")
    return slice(*np.searchsorted(frame_index, (k, k + 1)).tolist())


def _only_file(folder: pathlib.Path, pattern: str) -> pathlib.Path:
    found = sorted(folder.glob(pattern))
    if not found:
        raise FileNotFoundError(f"{folder} has no {pattern}: expected one")
    if len(found) > 1:
        raise ValueError(f"{folder} has {', '.join(path.name for path in found)}: expected one {pattern}")
    return found[0]


def _stereo(path: pathlib.Path) -> RectifiedStereo:
    expected = "one row 'fx fy skew cx cy baseline'"
    lines = text_lines(path, expected)
    if len(lines) != 1:
        raise ValueError(f"{path} has {len(lines)} rows: expected {expected}")
    fx, fy, skew, cx, cy, baseline = numbers(lines[0][1].split(), 6, f"{path}, line {lines[0][0]},").tolist()
    if min(fx, fy, baseline) <= 0:
        raise ValueError(f"{path}: fx, fy and baseline are {fx:g}, {fy:g} and {baseline:g}: expected more than 0")
    return RectifiedStereo(Pinhole(fx=fx, fy=fy, cx=cx, cy=cy, skew=skew), baseline)


def _numbered_rows(path: pathlib.Path, count: int, expected: str) -> np.ndarray:
    """Rows of a number from 0 on, one more each, and `count` values."""
    lines = text_lines(path, expected)
    if not lines:
        raise ValueError(f"{path} is empty: expected {expected}")
    rows = []
    for k, (number, line) in enumerate(lines):
        row = numbers(line.split(), 1 + count, f"{path}, line {number},")
        if row[0] != k:
            raise ValueError(f"{path}, line {number}, starts with {row[0]:g}: expected {k}, rows counted from 0")
        rows.append(row[1:])
    return np.stack(rows)


def _numbered_poses(path: pathlib.Path) -> np.ndarray:
    matrices = _numbered_rows(path, 16, "rows 'frame' and a 4×4 pose").reshape(-1, 4, 4)
    expected = "a 4×4 pose, world from camera, row by row"
    wrong = np.flatnonzero(np.abs(matrices[:, 3] - [0, 0, 0, 1]).max(axis=1) > 1e-6)
    if len(wrong):
        raise ValueError(f"{path}: pose {wrong[0]} ends in {matrices[wrong[0], 3].tolist()}: expected {expected}")
    check_rotations(matrices[:, :3, :3], lambda i: f"{path}, pose {i}", expected)
    return matrices[:, :3]


def _planar_camera(path: pathlib.Path) -> tuple[Pinhole, np.ndarray, tuple[float, float], tuple[int, int]]:
    """Camera, robot_from_cam, range of depths and image size."""
    # As many numbers a row as rows.
    rows = {"camera matrix": 3, "cam_transform": 4, "z_near": 1, "z_far": 1, "width": 1, "height": 1}
    parts: dict[str, list[np.ndarray]] = {}
    key = ""
    for number, line in text_lines(path, f"{', '.join(rows)}, each 'name: value'"):
        name, colon, value = line.rpartition(":")
        if colon:
            key = name.strip()
            parts[key] = []
        if key not in rows:
            raise ValueError(f"{path}, line {number}: found {line[:40]!r}: expected one of {', '.join(rows)}")
        if value.strip():
            parts[key].append(numbers(value.split(), rows[key], f"{path}, line {number},"))
    for key, count in rows.items():
        if len(parts.get(key, [])) != count:
            raise ValueError(f"{path} has {len(parts.get(key, []))} rows of '{key}:': expected {count}")
    matrix, robot_from_cam = np.stack(parts["camera matrix"]), np.stack(parts["cam_transform"])[None]
    near, far, width, height = (float(parts[key][0][0]) for key in ("z_near", "z_far", "width", "height"))
    (fx, skew, cx), (below, fy, cy) = matrix[:2].tolist()
    if fx <= 0 or fy <= 0 or below != 0 or not np.allclose(matrix[2], (0, 0, 1)):
        raise ValueError(f"{path} has no camera matrix with positive focal lengths: got {matrix.tolist()}")
    check_rotations(robot_from_cam[:, :3, :3], lambda _: f"{path}, cam_transform", "[R | t], robot from camera")
    if not (width >= 1 and height >= 1 and width.is_integer() and height.is_integer()):
        raise ValueError(f"{path}: width and height are {width:g} and {height:g}: expected pixels, 1 or more")
    camera = Pinhole(fx=fx, fy=fy, cx=cx, cy=cy, skew=skew)
    return camera, robot_from_cam[0, :3], (near, far), (int(width), int(height))


def _measurements(path: pathlib.Path, k: int, landmarks: int) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks that frame `k` sees; their pixels and appearance."""
    index, rows = [], []
    for number, line in text_lines(path, "'seq: …' and rows 'point number landmark u v …'"):
        words, where = line.split(), f"{path}, line {number},"
        if words[0] == "seq:" and numbers(words[1:], 1, where)[0] != k:
            raise ValueError(f"{where} is of frame {words[1]}: expected {k}")
        # The poses beside the measurements are those of trajectory.dat.
        if words[0] in ("seq:", "gt_pose:", "odom_pose:"):
            continue
        if words[0] != "point" or len(words) != 5 + _APPEARANCE:
            raise ValueError(
                f"{where} has {len(words)} columns: expected 'point number landmark u v' and {_APPEARANCE} more"
            )
        index.append(whole_number(words[2], "landmark", where))
        rows.append(numbers(words[3:], 2 + _APPEARANCE, f"{where} from column 4 on,"))
        if index[-1] >= landmarks:
            raise ValueError(f"{where} is of landmark {index[-1]}: expected 0 to {landmarks - 1}, as in world.dat")
        if index[-1] in index[:-1]:
            raise ValueError(f"{where} is of landmark {index[-1]} again: expected each once a frame")
    return np.array(index, np.int64), np.array(rows).reshape(-1, 2 + _APPEARANCE)


def _on_the_plane(xytheta: np.ndarray) -> np.ndarray:
    """`[n, 3, 4]` of planar poses, z up."""
    x, y, theta = xytheta.T
    zero, one, c, s = np.zeros_like(x), np.ones_like(x), np.cos(theta), np.sin(theta)
    return np.array([[c, -s, zero, x], [s, c, zero, y], [zero, zero, one, zero]]).transpose(2, 0, 1)
