"""Sequences laid out as the EuRoC MAV data set lays them out (and TUM-VI, which follows it)."""

import os
import pathlib

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from vojax.cameras import Camera, CameraSet, read_cameras
from vojax.features import read_image
from vojax.lie import SE3

from ._pictures import check_index, check_size
from ._poses import (
    check_quaternions,
    compose,
    invert,
    multiply_quaternions,
    pose_matrices,
    slerp,
)
from ._text import check_increasing, numbers, text_lines, whole_number

# Both cameras have one trigger; stamps of other recorders in this layout differ by their rounding.
_PAIR_TOLERANCE_NS = 1_000_000


class EurocSequence:
    """One sequence of EuRoC; images are read when asked for, as they were taken: not rectified.

    The layout is `mav0` with `cam0` and `cam1`, each a `sensor.yaml`, a `data.csv` (`nanoseconds,file`) and a folder
    `data` of images, and `state_groundtruth_estimate0/data.csv` (`nanoseconds, position, quaternion wxyz, …` of the
    body) where the true trajectory is known. Everything but the images is read and checked at once.

    Args:
        root: The folder that holds `mav0`, or `mav0` itself.
        stereo: False to open the left camera alone.
        truth: A file of body poses to use instead of `state_groundtruth_estimate0/data.csv`, of 8 columns or 17.
        max_gap_s: A frame between two true poses further apart than this has no truth.

    Attributes:
        name: Name of the folder that holds `mav0`.
        camera: cam0, distortion included.
        cameras: cam0, or cam0 and cam1.
        cam1_from_cam0: Pose of the right camera, translation in metres; None when opened with `stereo=False`. With
            `cameras` and `size` it is what `vojax.cameras.rectification_maps` asks for.
        size: Width and height of the images; None where `sensor.yaml` does not tell.
        times: Seconds, one per frame (of the epoch, as published).
        poses: `world_from_cam` of cam0 as `[n, 3, 4]`, metres: the body's, interpolated to the frame's time, times its
            `T_BS`; NaN where the truth does not reach; None without a truth.
        frame_names: File names of the left images without suffix, in order.

    Raises:
        FileNotFoundError: A folder or file of the layout is missing.
        ValueError: A file does not hold what the layout asks for, or left and right images are not synchronised.
        ImportError: PyYAML is not installed.

    References:
        Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 2016.
    """

    name: str
    camera: Camera
    cameras: tuple[Camera, ...]
    cam1_from_cam0: SE3 | None
    size: tuple[int, int] | None
    times: Float64[np.ndarray, "n"]
    poses: Float64[np.ndarray, "n 3 4"] | None
    frame_names: list[str]

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        stereo: bool = True,
        truth: str | os.PathLike[str] | None = None,
        max_gap_s: float = 0.2,
    ):
        mav = _mav_folder(pathlib.Path(root))
        self.name = mav.resolve().parent.name if mav.name == "mav0" else mav.resolve().name
        if stereo and not (mav / "cam1").is_dir():
            raise FileNotFoundError(
                f"{mav} has no cam1: expected the right camera there; open it with stereo=False or choose a monocular "
                "pipeline"
            )
        stamps, self._left = _image_list(mav / "cam0")
        self._right = None
        if stereo:
            right_stamps, self._right = _image_list(mav / "cam1")
            _check_pairs(mav, stamps, right_stamps)
        sets = [read_cameras(mav / name / "sensor.yaml") for name in (("cam0", "cam1") if stereo else ("cam0",))]
        self.cameras = tuple(camera for one in sets for camera in one.cameras.values())
        self._sizes = [next(iter(one.sizes.values()), None) for one in sets]
        self.camera, self.size = self.cameras[0], self._sizes[0]
        self.cam1_from_cam0 = None
        if stereo:
            left, right = (_cam_from_body(one, mav / f"cam{i}") for i, one in enumerate(sets))
            self.cam1_from_cam0 = _relative(left, right)
        self.times = stamps * 1e-9
        self.frame_names = [path.stem for path in self._left]
        path = mav / "state_groundtruth_estimate0" / "data.csv" if truth is None else pathlib.Path(truth)
        self.poses = None
        if truth is not None or path.is_file():
            cam_from_body = _cam_from_body(sets[0], mav / "cam0")[None]
            body_from_cam = invert(pose_matrices(cam_from_body[:, :4], cam_from_body[:, 4:]))
            self.poses = compose(_body_poses(path, stamps, max_gap_s), body_from_cam)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._left)

    def images(self, k: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Read frame `k`.

        Args:
            k: Index from 0 (negative ones count from the end).

        Returns:
            The left image and the right one (None when opened with `stereo=False`), not rectified.

        Raises:
            IndexError: There is no such frame.
            ValueError: An image is damaged, or not of the size that its calibration is for.
        """
        k = check_index(k, len(self), self.name)
        images = []
        for files, camera, size in zip((self._left, self._right), self.cameras, self._sizes, strict=False):
            assert files is not None
            images.append(read_image(files[k]))
            check_size(images[-1], files[k], camera, size)
        return images[0], images[1] if len(images) == 2 else None


def _mav_folder(root: pathlib.Path) -> pathlib.Path:
    if not root.is_dir():
        raise FileNotFoundError(f"EuRoC folder {root} not found: expected a folder that holds mav0")
    for folder in (root / "mav0", root):
        if (folder / "cam0").is_dir():
            return folder
    raise FileNotFoundError(f"{root} has no mav0/cam0: expected a folder that holds mav0, or mav0 itself")


def _image_list(folder: pathlib.Path) -> tuple[np.ndarray, list[pathlib.Path]]:
    """Nanoseconds and files of a camera; all files exist."""
    path = folder / "data.csv"
    lines = text_lines(path, "rows 'nanoseconds,file'")
    if not lines:
        raise ValueError(f"{path} lists no images: expected rows 'nanoseconds,file'")
    stamps, files = [], []
    for number, line in lines:
        words = line.split(",")
        if len(words) != 2:
            raise ValueError(f"{path}, line {number}, has {len(words)} columns: expected 'nanoseconds,file'")
        stamps.append(whole_number(words[0], "time", f"{path}, line {number},"))
        files.append(folder / "data" / words[1].strip())
        if not files[-1].is_file():
            raise FileNotFoundError(f"{files[-1]} not found: expected it from {path}, line {number}")
    check_increasing(np.array(stamps), [number for number, _ in lines], path, "ns")
    return np.array(stamps), files


def _check_pairs(mav: pathlib.Path, left: np.ndarray, right: np.ndarray) -> None:
    if len(left) != len(right):
        raise ValueError(
            f"{mav} has {len(left)} images of cam0 and {len(right)} of cam1: expected one right image for each left "
            "one; remove those without a partner from data.csv"
        )
    apart = np.flatnonzero(np.abs(left - right) > _PAIR_TOLERANCE_NS)
    if len(apart):
        i = int(apart[0])
        raise ValueError(
            f"{mav}: image {i} is of {left[i]} ns in cam0 and of {right[i]} ns in cam1: expected both at one time, to "
            f"{_PAIR_TOLERANCE_NS * 1e-6:g} ms"
        )


def _cam_from_body(cameras: CameraSet, folder: pathlib.Path) -> np.ndarray:
    """wxyz_xyz of a camera."""
    if cameras.cam_from_rig is None:
        raise ValueError(f"{folder / 'sensor.yaml'} has no T_BS: expected the camera's pose on the body")
    return np.asarray(cameras.cam_from_rig.wxyz_xyz, np.float64)[0]


def _relative(left: np.ndarray, right: np.ndarray) -> SE3:
    """cam1_from_cam0 of both cameras' poses cam_from_body."""
    wxyz = multiply_quaternions(right[:4], left[:4] * [1, -1, -1, -1])
    matrix = pose_matrices(wxyz[None], np.zeros((1, 3)))[0, :, :3]
    return SE3(jnp.asarray(np.concatenate([wxyz / np.linalg.norm(wxyz), right[4:] - matrix @ left[4:]])))


def _body_poses(path: pathlib.Path, stamps: np.ndarray, max_gap_s: float) -> np.ndarray:
    """`world_from_body` at the frames' times, NaN where the truth does not reach."""
    expected = "rows 'nanoseconds,px,py,pz,qw,qx,qy,qz[,…]'"
    lines = text_lines(path, expected)
    truth_stamps, rows = [], []
    for number, line in lines:
        words = line.split(",")
        if len(words) not in (8, 17):
            raise ValueError(f"{path}, line {number}, has {len(words)} columns: expected 8 or 17, {expected}")
        truth_stamps.append(whole_number(words[0], "time", f"{path}, line {number},"))
        rows.append(numbers(words[1:8], 7, f"{path}, line {number}, from column 2 on,"))
    if not rows:
        raise ValueError(f"{path} holds no poses: expected {expected}")
    truth, body = np.array(truth_stamps), np.stack(rows)
    check_increasing(truth, [number for number, _ in lines], path, "ns")
    check_quaternions(body[:, 3:], lambda i: f"{path}, line {lines[i][0]}", "qw qx qy qz")
    # A frame at the very time of a true pose needs no second one, so the gap counts from it on.
    after = np.clip(np.searchsorted(truth, stamps), 0, len(truth) - 1)
    before = np.where(truth[after] == stamps, after, np.maximum(after - 1, 0))
    gap = truth[after] - truth[before]
    known = (truth[before] <= stamps) & (stamps <= truth[after]) & (gap <= max_gap_s * 1e9)
    if not known.any():
        raise ValueError(
            f"{path} covers no image (poses from {truth[0]} to {truth[-1]} ns, images from {stamps[0]} to "
            f"{stamps[-1]} ns): expected times of one clock"
        )
    fraction = (stamps - truth[before]) / np.maximum(gap, 1)
    position = body[before, :3] + fraction[:, None] * (body[after, :3] - body[before, :3])
    quaternion = body[:, 3:] / np.linalg.norm(body[:, 3:], axis=1, keepdims=True)
    poses = pose_matrices(slerp(quaternion[before], quaternion[after], fraction), position)
    poses[~known] = np.nan
    return poses
