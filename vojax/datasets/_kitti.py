"""Sequences laid out as the KITTI odometry benchmark lays them out."""

import os
import pathlib

import numpy as np
from jaxtyping import Float64

from vojax.cameras import Pinhole, RectifiedStereo
from vojax.features import read_image

from ._pictures import check_index, check_size, image_files
from ._poses import check_rotations
from ._text import numbers, read_times, text_lines


class KittiSequence:
    """One sequence of the KITTI odometry benchmark; images are read when asked for.

    The layout is `sequences/<name>/` with `calib.txt` (rows `P0:` and `P1:` of 12 numbers), `times.txt`, `image_0`
    (left) and `image_1` (right), and `poses/<name>.txt` where the true trajectory is known. Everything but the images
    is read and checked at once.

    Args:
        root: The folder that holds `sequences` and, if there is a ground truth, `poses`.
        sequence: Name of the sequence, such as "06".
        stereo: False to open the left camera alone, where there is no `image_1`.

    Attributes:
        name: Name of the sequence.
        camera: The left camera, distortion-free.
        stereo: The rectified pair, baseline in metres; None when opened with `stereo=False`.
        times: Seconds, one per frame.
        poses: `world_from_cam` of the left camera as `[n, 3, 4]`, metres; None where there is no ground truth.
        frame_names: File names without suffix, in order.

    Raises:
        FileNotFoundError: A folder or file of the layout is missing.
        ValueError: A file does not hold what the layout asks for, or counts differ.

    References:
        Geiger, Lenz & Urtasun, Are we ready for autonomous driving?, CVPR 2012.
    """

    name: str
    camera: Pinhole
    stereo: RectifiedStereo | None
    times: Float64[np.ndarray, "n"]
    poses: Float64[np.ndarray, "n 3 4"] | None
    frame_names: list[str]

    def __init__(self, root: str | os.PathLike[str], sequence: str, stereo: bool = True):
        root = pathlib.Path(root)
        self.name = str(sequence)
        folder = _sequence_folder(root, self.name)
        self._left = image_files(folder / "image_0")
        self._right = None
        if stereo:
            if not (folder / "image_1").is_dir():
                raise FileNotFoundError(
                    f"{folder} has no image_1: expected the right images there; open it with stereo=False or choose a "
                    "monocular pipeline"
                )
            self._right = image_files(folder / "image_1")
            _check_pairs(folder, self._left, self._right)
        self.frame_names = [path.stem for path in self._left]
        self.camera, self.stereo = _calibration(folder / "calib.txt", stereo)
        self.times = read_times(folder / "times.txt", len(self))
        self.poses = _poses(root / "poses" / f"{self.name}.txt", len(self))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._left)

    def images(self, k: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Read frame `k`.

        Args:
            k: Index from 0 (negative ones count from the end).

        Returns:
            The left image and the right one (None when opened with `stereo=False`).

        Raises:
            IndexError: There is no such frame.
            ValueError: An image is damaged, is not of the size that the calibration is for, or left and right differ in
                size.
        """
        k = check_index(k, len(self), self.name)
        left = read_image(self._left[k])
        check_size(left, self._left[k], self.camera)
        if self._right is None:
            return left, None
        right = read_image(self._right[k])
        if left.shape != right.shape:
            raise ValueError(
                f"{self._left[k]} has shape {left.shape} and {self._right[k]} {right.shape}: expected one size"
            )
        return left, right


def _sequence_folder(root: pathlib.Path, name: str) -> pathlib.Path:
    if not root.is_dir():
        raise FileNotFoundError(f"KITTI folder {root} not found: expected a folder that holds 'sequences'")
    sequences = root / "sequences"
    if not sequences.is_dir():
        raise FileNotFoundError(f"{root} has no folder 'sequences': give the folder that holds 'sequences' and 'poses'")
    folder = sequences / name
    if not name or folder.parent != sequences or name in (".", "..") or not folder.is_dir():
        existing = ", ".join(sorted(path.name for path in sequences.iterdir() if path.is_dir())) or "none"
        raise FileNotFoundError(f"sequence {name!r} not found in {sequences}: choose one of those there ({existing})")
    return folder


def _check_pairs(folder: pathlib.Path, left: list[pathlib.Path], right: list[pathlib.Path]) -> None:
    if len(left) != len(right):
        raise ValueError(
            f"{folder} has {len(left)} images in image_0 and {len(right)} in image_1: expected one right image for "
            "each left one; copy the missing files"
        )
    for one, other in zip(left, right, strict=True):
        if one.stem != other.stem:
            raise ValueError(f"{folder}: image_0 has {one.name} where image_1 has {other.name}: expected equal names")


def _calibration(path: pathlib.Path, stereo: bool) -> tuple[Pinhole, RectifiedStereo | None]:
    needed = ("P0", "P1") if stereo else ("P0",)
    rows: dict[str, np.ndarray] = {}
    for _, line in text_lines(path, "rows 'P0:' and 'P1:' of 12 numbers each"):
        key, _, values = line.partition(":")
        if key.strip() in needed:
            rows[key.strip()] = numbers(values.split(), 12, f"{path}, row {key.strip()},").reshape(3, 4)
    for key in needed:
        if key not in rows:
            raise ValueError(f"{path} has no row '{key}:': expected 'P0:' and 'P1:' with 12 numbers each")
    p0 = rows["P0"]
    fx, fy, cx, cy, skew = p0[0, 0], p0[1, 1], p0[0, 2], p0[1, 2], p0[0, 1]
    if fx <= 0 or fy <= 0 or not np.allclose(p0[2, :3], (0, 0, 1)) or not np.allclose(p0[1, 0], 0):
        raise ValueError(
            f"{path}, row P0, is not a projection K [I | t] with positive focal lengths: got {p0.tolist()}"
        )
    camera = Pinhole(fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy), skew=float(skew))
    if not stereo:
        return camera, None
    p1 = rows["P1"]
    if not np.allclose(p0[:, :3], p1[:, :3], rtol=1e-6):
        raise ValueError(
            f"{path}: P0 and P1 have different intrinsics (fx {fx:g} and {p1[0, 0]:g}, cx {cx:g} and {p1[0, 2]:g}): "
            "expected a rectified pair"
        )
    baseline = (p0[0, 3] - p1[0, 3]) / fx
    if baseline <= 0:
        raise ValueError(f"{path}: the baseline is {baseline:g} m: expected P1[0, 3] = -fx · baseline, baseline > 0")
    return camera, RectifiedStereo(camera, float(baseline))


def _poses(path: pathlib.Path, frames: int) -> np.ndarray | None:
    if not path.is_file():
        return None
    lines = text_lines(path, "12 numbers per frame")
    rows = [numbers(line.split(), 12, f"{path}, line {number},") for number, line in lines]
    if len(rows) != frames:
        raise ValueError(f"{path} has {len(rows)} poses for {frames} images: expected one per frame")
    poses = np.stack(rows).reshape(-1, 3, 4)
    # The published poses carry seven digits.
    check_rotations(
        poses[:, :, :3], lambda i: f"{path}, line {lines[i][0]}", "rows of [R | t], world from camera", tolerance=1e-4
    )
    return poses
