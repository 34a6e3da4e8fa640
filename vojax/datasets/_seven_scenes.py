"""Sequences laid out as the Microsoft 7-Scenes data set lays them out."""

import os
import pathlib
import re

import numpy as np
from jaxtyping import Float32, Float64

from vojax.cameras import Camera, Pinhole
from vojax.features import read_image

from ._pictures import check_index, check_size, read_depth
from ._poses import check_rotations
from ._text import numbers, text_lines

_SIZE = (640, 480)
_PUBLISHED = (585.0, 585.0, 320.0, 240.0)
_RATE_HZ = 30.0


class SevenScenesSequence:
    """One sequence of 7-Scenes; images are read when asked for.

    The layout is a folder of `frame-000000.color.png` (or `.jpg`), `frame-000000.depth.png` and, where the true
    trajectory is known, `frame-000000.pose.txt` (4×4, world from camera, good to about 1° and 4 cm), with
    `camera-intrinsics.txt` (3×3) in some copies. The intrinsics are those of the depth camera; colour is not registered
    to depth in the data set, and is off by some pixels. Everything but the images is read and checked at once.

    Args:
        root: The folder of the sequence, such as `chess/seq-01`.
        camera: Intrinsics. None takes `camera-intrinsics.txt`, or where there is none the published ones.
        depth: False to open the colour images alone.

    Attributes:
        name: Name of the folder.
        camera: The camera.
        size: Width and height that the calibration is for; None with a camera of your own.
        times: Seconds, one per frame: the number of the frame over the Kinect's 30 Hz, as the data set tells none.
        poses: `world_from_cam` as `[n, 3, 4]`, metres; None where there is no pose file at all.
        frame_names: "frame-000000" and so on, in order.

    Raises:
        FileNotFoundError: The folder has no frames, or a frame lacks its depth or its pose.
        ValueError: A file does not hold what the layout asks for.

    References:
        Shotton et al., Scene coordinate regression forests for camera relocalization in RGB-D images, CVPR 2013.
    """

    name: str
    camera: Camera
    size: tuple[int, int] | None
    times: Float64[np.ndarray, "n"]
    poses: Float64[np.ndarray, "n 3 4"] | None
    frame_names: list[str]

    def __init__(self, root: str | os.PathLike[str], camera: Camera | None = None, *, depth: bool = True):
        root = pathlib.Path(root)
        if not root.is_dir():
            raise FileNotFoundError(f"7-Scenes folder {root} not found: expected a folder of frame-000000.color.png, …")
        self.name = root.resolve().name
        color = _color_files(root)
        self._color = [color[number] for number in sorted(color)]
        self.frame_names = [path.name.split(".")[0] for path in self._color]
        self.times = np.array(sorted(color)) / _RATE_HZ
        self.camera, self.size = (_intrinsics(root), _SIZE) if camera is None else (camera, None)
        self._depth = None
        if depth:
            self._depth = [root / f"{name}.depth.png" for name in self.frame_names]
            for path in self._depth:
                if not path.is_file():
                    raise FileNotFoundError(f"{path} not found: expected a depth for each colour image, or depth=False")
        self.poses = _poses(root, self.frame_names)

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
            Camera z in metres; 0 where there is none (stored as 0 or 65535).

        Raises:
            IndexError: There is no such frame.
            ValueError: The image is damaged, holds no 16-bit depths or is not of the size that the calibration is for;
                or the sequence was opened with `depth=False`.
        """
        k = check_index(k, len(self), self.name)
        if self._depth is None:
            raise ValueError(f"sequence {self.name} was opened with depth=False: expected depth=True for its depths")
        return read_depth(self._depth[k], 1000.0, (0, 65535), self.camera, self.size)


def _color_files(root: pathlib.Path) -> dict[int, pathlib.Path]:
    """Colour images by the number of their frame."""
    files: dict[int, pathlib.Path] = {}
    for path in sorted(root.iterdir()):
        found = re.fullmatch(r"frame-([0-9]+)\.color\.(png|jpg|jpeg)", path.name)
        if found is None:
            continue
        number = int(found[1])
        if number in files:
            raise ValueError(f"{root} has {files[number].name} and {path.name}: expected one colour image per frame")
        files[number] = path
    if not files:
        raise FileNotFoundError(f"{root} holds no colour images: expected frame-000000.color.png (or .jpg), …")
    return files


def _intrinsics(root: pathlib.Path) -> Pinhole:
    path = root / "camera-intrinsics.txt"
    if not path.is_file():
        return Pinhole(*_PUBLISHED)
    matrix = _matrix(path, (3, 3), "a 3×3 camera matrix")
    (fx, skew, cx), (below, fy, cy) = matrix[:2]
    if fx <= 0 or fy <= 0 or below != 0 or not np.allclose(matrix[2], (0, 0, 1)):
        raise ValueError(f"{path} is no camera matrix with positive focal lengths: got {matrix.tolist()}")
    return Pinhole(fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy), skew=float(skew))


def _matrix(path: pathlib.Path, shape: tuple[int, int], expected: str) -> np.ndarray:
    lines = text_lines(path, expected)
    if len(lines) != shape[0]:
        raise ValueError(f"{path} has {len(lines)} rows: expected {expected}")
    return np.stack([numbers(line.split(), shape[1], f"{path}, line {number},") for number, line in lines])


def _poses(root: pathlib.Path, names: list[str]) -> np.ndarray | None:
    paths = [root / f"{name}.pose.txt" for name in names]
    present = [path.is_file() for path in paths]
    if not any(present):
        return None
    if not all(present):
        missing = paths[present.index(False)]
        raise FileNotFoundError(f"{missing} not found: expected a pose for each colour image, or for none")
    poses = np.stack([_matrix(path, (4, 4), "a 4×4 pose, world from camera") for path in paths])
    wrong = np.flatnonzero(np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1) > 1e-6)
    if len(wrong):
        raise ValueError(f"{paths[wrong[0]]}: the last row is {poses[wrong[0], 3].tolist()}: expected 0 0 0 1")
    # Rotations as published are off by up to 1.4e-4.
    check_rotations(poses[:, :3, :3], lambda i: str(paths[i]), "[R | t], world from camera", tolerance=1e-3)
    return poses[:, :3]
