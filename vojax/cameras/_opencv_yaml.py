"""OpenCV's calibration YAML (its `FileStorage`), and the `camera_info` YAML of ROS, which has the same keys."""

import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from ._brown_conrady import BrownConrady
from ._camera_set import CameraSet, matrices_of, poses_of
from ._kannala_brandt import KannalaBrandt
from ._pinhole import Pinhole
from ._protocol import Camera
from ._yaml import image_size, numbers, plain, rigid_matrix

# What people call them; OpenCV's own samples disagree.
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "M")
_LENS = ("distortion_coefficients", "Distortion_Coefficients", "dist_coeffs", "distCoeffs", "D")
_WIDTH, _HEIGHT = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")
_FISHEYE = ("fisheye", "equidistant", "kannala_brandt")
_PINHOLE = ("plumb_bob", "radtan", "rational_polynomial", "pinhole", "opencv", "none")
# OpenCV gives 4, 5, 8, 12 or 14 coefficients; the first five are the ones that BrownConrady has.
_LENGTHS = (0, 4, 5, 8, 12, 14)
_FIVE = ("k1", "k2", "p1", "p2", "k3")


def _named(value: Mapping[str, Any], names: tuple[str, ...], suffix: str = "") -> str | None:
    """The name that is there."""
    return next((name + suffix for name in names if value.get(name + suffix) is not None), None)


def is_opencv(value: Mapping[str, Any]) -> bool:
    """Whether a mapping is one of these files."""
    return _named(value, _MATRIX) is not None or _named(value, _MATRIX, "1") is not None


def _camera(path: pathlib.Path, value: Mapping[str, Any], suffix: str, fisheye: bool) -> Camera:
    key = _named(value, _MATRIX, suffix)
    if key is None:
        raise ValueError(f"{path} has no camera matrix: expected one of {', '.join(n + suffix for n in _MATRIX)}")
    where = f"{path}, {key}"
    k = np.array(numbers(value[key], where, (9,))).reshape(3, 3)
    if k[0, 0] <= 0 or k[1, 1] <= 0 or not np.allclose([k[1, 0], *k[2]], (0, 0, 0, 1), atol=1e-9):
        raise ValueError(f"{where} is not [fx s cx; 0 fy cy; 0 0 1] with fx, fy > 0: got {k.tolist()}")
    focal = {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
    lens_key = _named(value, _LENS, suffix)
    where = f"{path}, {lens_key}"
    lens = [] if lens_key is None else numbers(value[lens_key], where)
    if k[0, 1] != 0 and any(lens):
        raise ValueError(f"{path}, {key} has skew {k[0, 1]:g}: expected 0 in a camera with distortion")
    if fisheye:
        if len(lens) not in (0, 4):
            raise ValueError(f"{where} has {len(lens)} numbers: expected the 4 of a fisheye")
        return KannalaBrandt(**focal, **dict(zip(("k1", "k2", "k3", "k4"), lens, strict=False)))
    if len(lens) not in _LENGTHS:
        raise ValueError(f"{where} has {len(lens)} numbers: expected {', '.join(str(n) for n in _LENGTHS)}")
    if any(lens[5:]):
        raise ValueError(f"{where} has rational, prism or tilt terms {lens[5:]}: expected zero after the first five")
    if not any(lens):
        return Pinhole(**focal, skew=k[0, 1])
    return BrownConrady(**focal, **dict(zip(_FIVE, lens, strict=False)))


def _is_fisheye(path: pathlib.Path, value: Mapping[str, Any]) -> bool:
    model = value.get("distortion_model") or value.get("camera_model")
    if model is not None:
        model = str(model).lower()
        if model not in _FISHEYE + _PINHOLE:
            raise ValueError(f"{path}: distortion model {model!r}: expected one of {', '.join(_PINHOLE + _FISHEYE)}")
        return model in _FISHEYE
    return bool(value.get("fisheye_model"))


def read_opencv(path: pathlib.Path, value: dict[str, Any]) -> CameraSet:
    """One camera ("camera", or as `camera_name` says), or a stereo pair of keys that end in 1 and 2, with R and T."""
    fisheye = _is_fisheye(path, value)
    size = None
    width, height = _named(value, _WIDTH), _named(value, _HEIGHT)
    if width is not None and height is not None:
        size = image_size([value[width], value[height]], f"{path}, {width} and {height}")
    elif "image_size" in value:
        size = image_size(value["image_size"], f"{path}, image_size")
    if _named(value, _MATRIX) is not None:
        cameras = {str(value.get("camera_name") or "camera"): _camera(path, value, "", fisheye)}
    else:
        cameras = {f"camera{i}": _camera(path, value, str(i), fisheye) for i in (1, 2)}
    poses = None
    if len(cameras) == 2 and "R" in value and "T" in value:
        matrix = np.eye(4)
        matrix[:3, :3] = np.array(numbers(value["R"], f"{path}, R", (9,))).reshape(3, 3)
        matrix[:3, 3] = numbers(value["T"], f"{path}, T", (3,))
        second = rigid_matrix(matrix.tolist(), f"{path}, R and T")
        poses = poses_of([np.eye(4), second])
    return CameraSet(cameras, {name: size for name in cameras} if size else {}, poses)


def opencv_text(cameras: CameraSet) -> str:
    """One camera, or a stereo pair whose second pose is relative to the first, as `FileStorage` reads them."""
    count = len(cameras.cameras)
    if count > 2:
        raise ValueError(f"{count} cameras: an OpenCV file holds one or two; use format='kalibr'")
    kinds = {type(camera) for camera in cameras.cameras.values()}
    if not (kinds <= {Pinhole, BrownConrady} or kinds == {KannalaBrandt}):
        names = ", ".join(sorted(kind.__name__ for kind in kinds))
        raise ValueError(
            f"cameras of {names}: an OpenCV file holds Pinhole and BrownConrady, or KannalaBrandt: use format='vojax'"
        )
    lines = ["%YAML:1.0", "---"]
    sizes = set(cameras.sizes.values())
    if len(sizes) == 1:
        ((width, height),) = sizes
        lines += [f"image_width: {width}", f"image_height: {height}"]
    if count == 1 and next(iter(cameras.cameras)) != "camera":
        lines.append(f'camera_name: "{next(iter(cameras.cameras))}"')
    fisheye = kinds == {KannalaBrandt}
    lines.append(f"fisheye_model: {int(fisheye)}")
    for i, camera in enumerate(cameras.cameras.values(), start=1):
        suffix = str(i) if count == 2 else ""
        fx, fy, cx, cy = (plain(getattr(camera, key)) for key in ("fx", "fy", "cx", "cy"))
        skew = plain(camera.skew) if isinstance(camera, Pinhole) else 0.0
        lens = ("k1", "k2", "k3", "k4") if fisheye else _FIVE if isinstance(camera, BrownConrady) else ()
        matrix = [[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        coefficients = [[plain(getattr(camera, key))] for key in lens] or [[0.0]] * 5
        lines += _matrix("camera_matrix" if count == 1 else f"M{suffix}", matrix)
        lines += _matrix("distortion_coefficients" if count == 1 else f"D{suffix}", coefficients)
    if count == 2 and cameras.cam_from_rig is not None:
        first, second = matrices_of(cameras.cam_from_rig)
        relative = second @ np.linalg.inv(first)
        lines += _matrix("R", relative[:3, :3].tolist()) + _matrix("T", relative[:3, 3:].tolist())
    return "\n".join(lines) + "\n"


def _matrix(name: str, rows: list[list[float]]) -> list[str]:
    data = ", ".join(repr(float(value)) for row in rows for value in row)
    head = [f"{name}: !!opencv-matrix", f"   rows: {len(rows)}", f"   cols: {len(rows[0])}", "   dt: d"]
    return [*head, f"   data: [ {data} ]"]
