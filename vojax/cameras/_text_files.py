"""Calibration files of one line per camera: KITTI's `calib.txt` and COLMAP's `cameras.txt`.

COLMAP puts the centre of the first pixel at (0.5, 0.5), vojax at (0, 0): principal points move by half a pixel on the
way in, and back on the way out.
"""

import math
import pathlib
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from vojax.lie import SE3

from ._brown_conrady import BrownConrady
from ._camera_set import CameraSet
from ._extended_unified import ExtendedUnified
from ._kannala_brandt import KannalaBrandt
from ._pinhole import Pinhole
from ._protocol import Camera
from ._spherical import Spherical
from ._yaml import check_focal_lengths, numbers, plain

_FOCAL = ("fx", "fy", "cx", "cy")
_ONE_FOCAL = ("f", "cx", "cy")
_FULL = (*_FOCAL, "k1", "k2", "p1", "p2", "k3")
_SHAPE = (*_FOCAL, "alpha", "beta")
_FISHEYE = (*_FOCAL, "k1", "k2", "k3", "k4")
# By COLMAP's names: ours, and the order of its parameters; f stands for fx and fy.
_COLMAP: dict[str, tuple[Callable[..., Any], tuple[str, ...]]] = {
    "PINHOLE": (Pinhole, _FOCAL),
    "OPENCV": (BrownConrady, _FULL[:8]),
    "FULL_OPENCV": (BrownConrady, (*_FULL, "k4", "k5", "k6")),
    "OPENCV_FISHEYE": (KannalaBrandt, _FISHEYE),
    "EUCM": (ExtendedUnified, _SHAPE),
    "EQUIRECTANGULAR": (Spherical.from_size, ("width", "height")),
    "SIMPLE_PINHOLE": (Pinhole, _ONE_FOCAL),
    "SIMPLE_RADIAL": (BrownConrady, (*_ONE_FOCAL, "k1")),
    "RADIAL": (BrownConrady, (*_ONE_FOCAL, "k1", "k2")),
    "SIMPLE_FISHEYE": (KannalaBrandt, _ONE_FOCAL),
    "SIMPLE_RADIAL_FISHEYE": (KannalaBrandt, (*_ONE_FOCAL, "k1")),
    "RADIAL_FISHEYE": (KannalaBrandt, (*_ONE_FOCAL, "k1", "k2")),
}


def read_colmap(path: pathlib.Path, text: str) -> CameraSet:
    """Cameras by their identifiers."""
    cameras, sizes = {}, {}
    for i, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}, line {i},"
        if len(words) < 5 or words[1] not in _COLMAP:
            raise ValueError(f"{where} is not 'id MODEL width height …' with a model of {', '.join(_COLMAP)}")
        identifier, model, *rest = words
        if not identifier.isdigit() or identifier in cameras:
            raise ValueError(f"{where} has identifier {identifier!r}: expected a number that no other camera has")
        if not all(word.isdigit() for word in rest[:2]):
            raise ValueError(f"{where} has size {' '.join(rest[:2])}: expected width and height in pixels")
        build, order = _COLMAP[model]
        values = dict(zip(order, numbers(list(rest[2:]), f"{where} parameters", (len(order),)), strict=True))
        check_focal_lengths(values, where)
        sizes[identifier] = (int(rest[0]), int(rest[1]))
        cameras[identifier] = _from_colmap(build, values, where)
    return CameraSet(cameras, sizes)


def _from_colmap(build: Callable[..., Any], values: dict[str, float], where: str) -> Camera:
    if "width" in values:
        return Spherical.from_size(int(values["width"]), int(values["height"]))
    if "f" in values:
        values["fx"] = values["fy"] = values.pop("f")
    if build is BrownConrady and any(values.pop(key, 0.0) for key in ("k4", "k5", "k6")):
        raise ValueError(f"{where} has the rational terms k4, k5, k6: expected zeros")
    return build(**values | {"cx": values["cx"] - 0.5, "cy": values["cy"] - 0.5})


def colmap_text(cameras: CameraSet) -> str:
    """COLMAP's cameras, numbered from 1 where their names are not numbers."""
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    own_numbers = all(name.isdigit() for name in cameras.cameras)
    for i, (name, camera) in enumerate(cameras.cameras.items(), start=1):
        if name not in cameras.sizes:
            raise ValueError(f"camera {name!r} has no image size: COLMAP needs one")
        width, height = cameras.sizes[name]
        model, values = _to_colmap(camera, name, (width, height))
        # Digits of the parameters' own precision, half a pixel further on.
        lines.append(" ".join([name if own_numbers else str(i), model, str(width), str(height), *map(repr, values)]))
    return "\n".join(lines) + "\n"


def _to_colmap(camera: Camera, name: str, size: tuple[int, int]) -> tuple[str, list[float]]:
    if isinstance(camera, Spherical):
        whole = Spherical.from_size(*size)
        if any(not math.isclose(plain(a), plain(b), rel_tol=1e-5) for a, b in _pairs(camera, whole)):
            raise ValueError(f"camera {name!r} is a panorama that does not cover the sphere: COLMAP knows no other")
        return "EQUIRECTANGULAR", [float(value) for value in size]
    for model, (build, order) in _COLMAP.items():
        if type(camera) is not build:
            continue
        held = {key: plain(getattr(camera, key, 0.0)) for key in order}
        left = [key for key in vars(camera) if key not in held and plain(getattr(camera, key)) != 0]
        if left and model == "OPENCV":
            continue  # the same model with k3
        if left:
            raise ValueError(f"camera {name!r} has {', '.join(left)}, which COLMAP's {model} cannot hold")
        return model, [value + 0.5 if key in ("cx", "cy") else value for key, value in held.items()]
    raise ValueError(f"camera {name!r} is a {type(camera).__name__}, which COLMAP does not have: use format='vojax'")


def _pairs(one: Spherical, other: Spherical) -> list[tuple[Any, Any]]:
    return [(getattr(one, key), getattr(other, key)) for key in _FOCAL]


def read_kitti(path: pathlib.Path, text: str) -> CameraSet:
    """Rectified cameras of the rows P0, P1, …; the rig's frame is that of a camera with P = K [I | 0]."""
    cameras, poses = {}, []
    for i, line in enumerate(text.splitlines(), start=1):
        key, colon, values = line.partition(":")
        key = key.strip()
        if not (colon and len(key) > 1 and key[0] == "P" and key[1:].isdigit()):
            continue
        where = f"{path}, line {i} ({key}),"
        p = np.array(numbers(list(values.split()), where, (12,))).reshape(3, 4)
        if p[0, 0] <= 0 or p[1, 1] <= 0 or not np.allclose([p[1, 0], *p[2, :3]], (0, 0, 0, 1), atol=1e-6):
            raise ValueError(f"{where} is not a projection K [I | t] with positive focal lengths")
        if key in cameras:
            raise ValueError(f"{where} comes twice")
        cameras[key] = Pinhole(fx=p[0, 0], fy=p[1, 1], cx=p[0, 2], cy=p[1, 2], skew=p[0, 1])
        poses.append([1.0, 0.0, 0.0, 0.0, *np.linalg.solve(p[:, :3], p[:, 3])])
    if not cameras:
        raise ValueError(f"{path} has no row 'P0:': expected 'P0:', 'P1:', … with 12 numbers each")
    return CameraSet(cameras, {}, SE3(jnp.asarray(np.array(poses))))


def kitti_text(cameras: CameraSet) -> str:
    """Rows P0, P1, … of distortion-free cameras that all look the same way."""
    lines = []
    for i, (name, camera) in enumerate(cameras.cameras.items()):
        if not isinstance(camera, Pinhole):
            raise ValueError(f"camera {name!r} is a {type(camera).__name__}: KITTI's calib.txt holds Pinhole only")
        pose = cameras.pose(name)
        t = np.zeros(3)
        if pose is not None:
            if np.abs(np.asarray(pose.wxyz_xyz)[1:4]).max() > 1e-6:
                raise ValueError(f"camera {name!r} is turned: KITTI's calib.txt holds rectified cameras only")
            t = np.asarray(pose.translation(), np.float64)
        k = np.array(plain(camera.matrix()))
        row = np.concatenate([k, (k @ t)[:, None]], axis=1).reshape(-1)
        lines.append(f"P{i}: " + " ".join(f"{value:.12e}" for value in row))
    return "\n".join(lines) + "\n"
