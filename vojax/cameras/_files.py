"""Calibration files: which format a file has, reading and writing."""

import os
import pathlib
from collections.abc import Mapping

import jax.numpy as jnp

from vojax.lie import SE3

from ._camera_set import CameraSet
from ._kalibr import euroc_of, kalibr_of, read_euroc, read_kalibr
from ._opencv_yaml import is_opencv, opencv_text, read_opencv
from ._own_yaml import own_of, read_own
from ._protocol import Camera
from ._text_files import colmap_text, kitti_text, read_colmap, read_kitti
from ._yaml import dump_yaml, load_yaml, text_of

FORMATS = ("vojax", "opencv", "kalibr", "euroc", "kitti", "colmap")


def read_cameras(path: str | os.PathLike[str]) -> CameraSet:
    """Read a calibration file, of whichever format it is.

    Args:
        path: OpenCV's YAML (a camera matrix, or a stereo pair M1, D1, M2, D2, R, T), ROS' `camera_info` YAML, Kalibr's
            `camchain.yaml`, EuRoC's `sensor.yaml` or the folder of several (`mav0`), KITTI's `calib.txt`, COLMAP's
            `cameras.txt`, or what `write_cameras` wrote.

    Returns:
        The cameras by name, sizes and poses where the file has them. Principal points are of integer pixel centres,
        translations in the file's unit. Parameters have JAX's default precision.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is of none of these formats, a part is missing or is not what it must be, or a camera is of a
            model that vojax does not have. The message names file and line or key.
        ImportError: It is YAML, and PyYAML is not installed.
    """
    path = pathlib.Path(path)
    if path.is_dir():
        return _read_folder(path)
    text = text_of(path)
    if path.suffix.lower() in (".yaml", ".yml") or text.lstrip("\ufeff").startswith("%YAML"):
        value = load_yaml(path, text)
        if "intrinsics" in value:
            return read_euroc(path, value)
        parts = [part for part in value.values() if isinstance(part, Mapping)]
        if any("camera_model" in part for part in parts):
            return read_kalibr(path, value)
        if parts and all("model" in part and "parameters" in part for part in parts) and len(parts) == len(value):
            return read_own(path, value)
        if is_opencv(value):
            return read_opencv(path, value)
        raise ValueError(
            f"{path} is YAML, but none of OpenCV's (no camera_matrix), Kalibr's (no camera_model) or EuRoC's (no "
            f"intrinsics): it has the keys {', '.join(list(value)[:8])}"
        )
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if any(line.split(":")[0].strip() == "P0" for line in lines):
        return read_kitti(path, text)
    if lines and len(lines[0].split()) >= 4 and lines[0].split()[0].isdigit():
        return read_colmap(path, text)
    raise ValueError(f"{path} is no calibration file: expected YAML, KITTI's 'P0: …' or COLMAP's 'id MODEL width …'")


def _read_folder(path: pathlib.Path) -> CameraSet:
    """EuRoC's cameras beside one another."""
    files = sorted(path.glob("cam*/sensor.yaml"))
    if not files:
        raise ValueError(f"{path} is a folder without cam0/sensor.yaml: give a calibration file, or EuRoC's mav0")
    each = [read_cameras(file) for file in files]
    poses = [one.cam_from_rig.wxyz_xyz for one in each if one.cam_from_rig is not None]
    return CameraSet(
        {name: camera for one in each for name, camera in one.cameras.items()},
        {name: size for one in each for name, size in one.sizes.items()},
        SE3(jnp.concatenate(poses)) if len(poses) == len(each) else None,
    )


def write_cameras(
    path: str | os.PathLike[str], cameras: CameraSet | Mapping[str, Camera] | Camera, *, format: str = "vojax"
) -> None:
    """Write a calibration file that `read_cameras` reads again.

    Args:
        path: Where to; an existing file is replaced.
        cameras: A set, cameras by name, or one alone.
        format: "vojax" holds every model, with poses and sizes. "opencv" holds one or two of Pinhole, BrownConrady and
            KannalaBrandt; "kalibr" (and "euroc", one camera) holds Pinhole without skew, BrownConrady without k3,
            KannalaBrandt, Unified, ExtendedUnified and DoubleSphere; "kitti" holds Pinhole, not turned; "colmap" holds
            Pinhole without skew, BrownConrady, KannalaBrandt, ExtendedUnified and whole Spherical panoramas, without
            poses.

    Raises:
        ValueError: The format cannot hold what is given, without loss, or is unknown.
        ImportError: It is YAML, and PyYAML is not installed.
    """
    if format not in FORMATS:
        raise ValueError(f"format {format!r}: expected one of {', '.join(FORMATS)}")
    if isinstance(cameras, Camera):
        cameras = {"camera": cameras}
    if not isinstance(cameras, CameraSet):
        cameras = CameraSet(dict(cameras))
    if format == "opencv":
        text = opencv_text(cameras)
    elif format == "kitti":
        text = kitti_text(cameras)
    elif format == "colmap":
        text = colmap_text(cameras)
    else:
        # The header is for OpenCV, with which EuRoC's own tools read their files.
        text = "%YAML:1.0\n" if format == "euroc" else ""
        text += dump_yaml({"kalibr": kalibr_of, "euroc": euroc_of, "vojax": own_of}[format](cameras))
    pathlib.Path(path).write_text(text, encoding="utf-8")
