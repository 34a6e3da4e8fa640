"""Sequences laid out as the TUM RGB-D benchmark lays them out."""

import os
import pathlib
import re

import numpy as np
from jaxtyping import Float32, Float64

from vojax.cameras import BrownConrady, Camera, Pinhole
from vojax.features import read_image

from ._pictures import check_index, check_size, read_depth
from ._poses import check_quaternions, pose_matrices
from ._text import check_increasing, numbers, text_lines

_SIZE = (640, 480)
# Depths as published are already corrected by the factors of the calibration.
_DEPTH_UNIT = 5000.0
_PUBLISHED = {
    "1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "3": (535.4, 539.2, 320.1, 247.6),
}


class TumSequence:
    """One sequence of the TUM RGB-D benchmark; images are read when asked for.

    The layout is a folder with `rgb.txt` and `depth.txt` (rows `time file`), the images they name, and
    `groundtruth.txt` (`time tx ty tz qx qy qz qw`) where the true trajectory is known. A colour image takes the depth
    image nearest in time, each used at most once; without one near enough the colour image is left out. Depth is
    registered to colour, as published. Everything but the images is read and checked at once.

    Args:
        root: The folder of the sequence.
        camera: The colour camera. None takes the published calibration of Freiburg 1, 2 or 3, whichever the folder's
            name tells ("…freiburg2_desk", "fr2_desk").
        depth: False to open the colour images alone, all of them.
        max_difference_s: How far apart the times of a colour image and its depth or its true pose may be.

    Attributes:
        name: Name of the folder.
        camera: The colour camera, for depths too.
        size: Width and height that the calibration is for; None with a camera of your own.
        times: Seconds, one per frame, of the colour images (of the epoch, as published).
        poses: `world_from_cam` as `[n, 3, 4]`, metres, nearest in time; NaN where there is none near enough; None
            without `groundtruth.txt`.
        frame_names: Names of the colour files without suffix, in order.

    Raises:
        FileNotFoundError: A folder, list or image file is missing.
        ValueError: A file does not hold what the layout asks for, nothing matches in time, or the camera is not known.

    References:
        Sturm, Engelhard, Endres, Burgard & Cremers, A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012.
    """

    name: str
    camera: Camera
    size: tuple[int, int] | None
    times: Float64[np.ndarray, "n"]
    poses: Float64[np.ndarray, "n 3 4"] | None
    frame_names: list[str]

    def __init__(
        self,
        root: str | os.PathLike[str],
        camera: Camera | None = None,
        *,
        depth: bool = True,
        max_difference_s: float = 0.02,
    ):
        if not max_difference_s >= 0:
            raise ValueError(f"max_difference_s is {max_difference_s}: expected seconds, 0 or more")
        root = pathlib.Path(root)
        if not root.is_dir():
            raise FileNotFoundError(f"TUM folder {root} not found: expected a folder that holds rgb.txt")
        self.name = root.resolve().name
        self.camera, self.size = (_published(self.name), _SIZE) if camera is None else (camera, None)
        self.times, self._color = _image_list(root / "rgb.txt")
        self._depth = None
        if depth:
            depth_times, files = _image_list(root / "depth.txt")
            partner = _nearest(self.times, depth_times, max_difference_s, once=True)
            self._depth = [files[i] for i in partner if i >= 0]
            if not self._depth:
                raise ValueError(
                    f"{root}: no depth image within {max_difference_s:g} s of a colour one (rgb.txt from "
                    f"{self.times[0]} s, depth.txt from {depth_times[0]} s): expected times of one clock"
                )
            self._color = [file for file, i in zip(self._color, partner, strict=True) if i >= 0]
            self.times = self.times[partner >= 0]
        self.frame_names = [path.stem for path in self._color]
        self.poses = _poses(root / "groundtruth.txt", self.times, max_difference_s)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._color)

    def images(self, k: int) -> tuple[np.ndarray, None]:
        """Read the colour image of frame `k`.

        Args:
            k: Index from 0 (negative ones count from the end).

        Returns:
            The image, RGB, and None in place of a right one.

        Raises:
            IndexError: There is no such frame.
            ValueError: The image is damaged, or not of the size that the calibration is for.
        """
        path = self._color[check_index(k, len(self), self.name)]
        image = read_image(path)
        check_size(image, path, self.camera, self.size)
        return image, None

    def depth(self, k: int) -> Float32[np.ndarray, "h w"]:
        """Read the depth image of frame `k`.

        Args:
            k: Index from 0 (negative ones count from the end).

        Returns:
            Camera z in metres; 0 where there is none.

        Raises:
            IndexError: There is no such frame.
            ValueError: The image is damaged, holds no 16-bit depths or is not of the size that the calibration is for;
                or the sequence was opened with `depth=False`.
        """
        k = check_index(k, len(self), self.name)
        if self._depth is None:
            raise ValueError(f"sequence {self.name} was opened with depth=False: expected depth=True for its depths")
        return read_depth(self._depth[k], _DEPTH_UNIT, (0,), self.camera, self.size)


def _published(name: str) -> Camera:
    found = re.search(r"(?:freiburg|(?<![a-z])fr)[ _-]?([123])(?![0-9])", name.lower())
    if found is None:
        raise ValueError(
            f"folder {name!r} does not tell which camera took it: expected 'freiburg1', 'freiburg2' or 'freiburg3' in "
            "its name, or give camera="
        )
    parameters = _PUBLISHED[found[1]]
    return Pinhole(*parameters) if len(parameters) == 4 else BrownConrady(*parameters)


def _image_list(path: pathlib.Path) -> tuple[np.ndarray, list[pathlib.Path]]:
    """Times and files of a list; all files exist."""
    lines = text_lines(path, "rows 'time file'")
    if not lines:
        raise ValueError(f"{path} lists no images: expected rows 'time file'")
    times, files = [], []
    for number, line in lines:
        words = line.split(maxsplit=1)
        if len(words) != 2:
            raise ValueError(f"{path}, line {number}, has {len(words)} columns: expected 'time file'")
        times.append(numbers(words[:1], 1, f"{path}, line {number}, column 1,")[0])
        files.append(path.parent / words[1].strip())
        if not files[-1].is_file():
            raise FileNotFoundError(f"{files[-1]} not found: expected it from {path}, line {number}")
    check_increasing(np.array(times), [number for number, _ in lines], path)
    return np.array(times), files


def _nearest(times: np.ndarray, others: np.ndarray, limit: float, once: bool = False) -> np.ndarray:
    """Index of the time in `others` nearest to each of `times`, −1 where none is within the limit.

    With `once`, of several that want the same one the nearest gets it.
    """
    middles = (others[1:] + others[:-1]) / 2
    index = np.searchsorted(middles, times)
    difference = np.abs(others[index] - times)
    index = np.where(difference <= limit, index, -1)
    if once:
        order = np.lexsort((difference, index))
        repeated = order[1:][index[order[1:]] == index[order[:-1]]]
        index[repeated] = -1
    return index


def _poses(path: pathlib.Path, times: np.ndarray, limit: float) -> np.ndarray | None:
    if not path.is_file():
        return None
    lines = text_lines(path, "rows 'time tx ty tz qx qy qz qw'")
    if not lines:
        raise ValueError(f"{path} holds no poses: expected rows 'time tx ty tz qx qy qz qw'")
    rows = np.stack([numbers(line.split(), 8, f"{path}, line {number},") for number, line in lines])
    # Truths as published repeat a time here and there.
    check_increasing(rows[:, 0], [number for number, _ in lines], path, equal=True)
    check_quaternions(rows[:, 4:], lambda i: f"{path}, line {lines[i][0]}", "qx qy qz qw")
    index = _nearest(times, rows[:, 0], limit)
    if np.all(index < 0):
        raise ValueError(
            f"{path} has no pose within {limit:g} s of an image (poses from {rows[0, 0]} to {rows[-1, 0]} s, images "
            f"from {times[0]} to {times[-1]} s): expected times of one clock"
        )
    poses = pose_matrices(np.roll(rows[:, 4:], 1, axis=1), rows[:, 1:4])[index]
    poses[index < 0] = np.nan
    return poses
