"""Kalibr's `camchain.yaml` and EuRoC's `sensor.yaml`, which names the same models."""

import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ._brown_conrady import BrownConrady
from ._camera_set import CameraSet, matrices_of, poses_of
from ._double_sphere import DoubleSphere
from ._extended_unified import ExtendedUnified
from ._kannala_brandt import KannalaBrandt
from ._pinhole import Pinhole
from ._protocol import Camera
from ._unified import Unified
from ._yaml import check_focal_lengths, entry, image_size, numbers, plain, rigid_matrix

_FOCAL = ("fx", "fy", "cx", "cy")
_RADTAN = ("k1", "k2", "p1", "p2")
_EQUI = ("k1", "k2", "k3", "k4")
_NAMES = {"radial-tangential": "radtan", "equi": "equidistant", "": "none"}
# Kalibr's camera and distortion model: ours, and the order of its numbers.
_MODELS: dict[tuple[str, str], tuple[Callable[..., Any], tuple[str, ...], tuple[str, ...]]] = {
    ("pinhole", "none"): (Pinhole, _FOCAL, ()),
    ("pinhole", "radtan"): (BrownConrady, _FOCAL, _RADTAN),
    ("pinhole", "equidistant"): (KannalaBrandt, _FOCAL, _EQUI),
    ("omni", "none"): (Unified, ("xi", *_FOCAL), ()),
    ("omni", "radtan"): (Unified, ("xi", *_FOCAL), _RADTAN),
    ("eucm", "none"): (ExtendedUnified, ("alpha", "beta", *_FOCAL), ()),
    ("ds", "none"): (DoubleSphere, ("xi", "alpha", *_FOCAL), ()),
}


def _camera(value: Mapping[str, Any], distortion_key: str, where: str) -> Camera:
    model = str(entry(value, "camera_model", where)).lower()
    lens = str(value.get("distortion_model") or "none").lower()
    lens = _NAMES.get(lens, lens)
    if (model, lens) not in _MODELS:
        known = ", ".join(f"{a} with {b}" for a, b in _MODELS)
        raise ValueError(f"{where}: camera model {model!r} with distortion {lens!r}: expected one of {known}")
    build, order, lens_order = _MODELS[model, lens]
    values = numbers(entry(value, "intrinsics", where), f"{where}, intrinsics", (len(order),))
    if lens_order:
        coefficients = entry(value, distortion_key, where)
        values = values + numbers(coefficients, f"{where}, {distortion_key}", (len(lens_order),))
    parameters = dict(zip((*order, *lens_order), values, strict=True))
    check_focal_lengths(parameters, where)
    return build(**parameters)


def read_kalibr(path: pathlib.Path, value: dict[str, Any]) -> CameraSet:
    """A camera chain. The rig's frame is the first camera's, or the IMU's where only `T_cam_imu` is given."""
    names = sorted(key for key, part in value.items() if isinstance(part, dict) and "camera_model" in part)
    cameras, sizes, chain, from_imu = {}, {}, [np.eye(4)], []
    for i, name in enumerate(names):
        part, where = value[name], f"{path}, {name}"
        cameras[name] = _camera(part, "distortion_coeffs", where)
        if "resolution" in part:
            sizes[name] = image_size(part["resolution"], f"{where}, resolution")
        if "T_cam_imu" in part:
            from_imu.append(rigid_matrix(part["T_cam_imu"], f"{where}, T_cam_imu"))
        if i > 0 and "T_cn_cnm1" in part and len(chain) == i:
            chain.append(rigid_matrix(part["T_cn_cnm1"], f"{where}, T_cn_cnm1") @ chain[-1])
    poses = None
    if len(names) > 1 and len(chain) == len(names):
        poses = chain
    elif len(from_imu) == len(names):
        poses = from_imu
    return CameraSet(cameras, sizes, None if poses is None else poses_of(poses))


def read_euroc(path: pathlib.Path, value: dict[str, Any]) -> CameraSet:
    """One camera of EuRoC's layout, named by its folder; the rig's frame is the body's."""
    where, name = str(path), path.parent.name or "cam0"
    camera = _camera(value, "distortion_coefficients", where)
    sizes = {name: image_size(value["resolution"], f"{where}, resolution")} if "resolution" in value else {}
    pose = None
    if "T_BS" in value:
        pose = poses_of([np.linalg.inv(rigid_matrix(value["T_BS"], f"{where}, T_BS"))])
    return CameraSet({name: camera}, sizes, pose)


def _lens_and_values(camera: Camera, name: str, purpose: str) -> tuple[str, str, list[float], list[float]]:
    """Kalibr's names of a camera's models, its intrinsics and its coefficients."""
    for (model, lens), (build, order, lens_order) in _MODELS.items():
        if type(camera) is not build:
            continue
        left = [key for key in vars(camera) if key not in (*order, *lens_order) and np.any(getattr(camera, key) != 0)]
        if left and lens == "none" and model == "omni":
            continue  # the same model with distortion
        if left:
            raise ValueError(f"camera {name!r} has {', '.join(left)}, which {purpose} cannot hold: use format='vojax'")
        values = [[plain(getattr(camera, key)) for key in keys] for keys in (order, lens_order)]
        return model, lens, values[0], values[1]
    raise ValueError(f"camera {name!r} is a {type(camera).__name__}, which {purpose} cannot hold: use format='vojax'")


def kalibr_of(cameras: CameraSet) -> dict[str, Any]:
    """A camera chain; names become cam0, cam1, …, as Kalibr wants them."""
    value: dict[str, Any] = {}
    matrices = None if cameras.cam_from_rig is None else matrices_of(cameras.cam_from_rig)
    for i, (name, camera) in enumerate(cameras.cameras.items()):
        model, lens, intrinsics, coefficients = _lens_and_values(camera, name, "a Kalibr file")
        part: dict[str, Any] = {"camera_model": model, "intrinsics": intrinsics, "distortion_model": lens}
        part["distortion_coeffs"] = coefficients
        if name in cameras.sizes:
            part["resolution"] = list(cameras.sizes[name])
        if matrices is not None and i > 0:
            part["T_cn_cnm1"] = (matrices[i] @ np.linalg.inv(matrices[i - 1])).tolist()
        value[f"cam{i}"] = part
    return value


def euroc_of(cameras: CameraSet) -> dict[str, Any]:
    """One camera as EuRoC's `sensor.yaml`."""
    if len(cameras.cameras) != 1:
        raise ValueError(f"{len(cameras.cameras)} cameras: a sensor.yaml holds one; write each to its own folder")
    ((name, camera),) = cameras.cameras.items()
    model, lens, intrinsics, coefficients = _lens_and_values(camera, name, "a sensor.yaml")
    value: dict[str, Any] = {"sensor_type": "camera", "comment": name}
    if cameras.cam_from_rig is not None:
        matrix = np.linalg.inv(matrices_of(cameras.cam_from_rig)[0])
        value["T_BS"] = {"cols": 4, "rows": 4, "data": plain(matrix.reshape(-1))}
    if name in cameras.sizes:
        value["resolution"] = list(cameras.sizes[name])
    value["camera_model"], value["intrinsics"] = model, intrinsics
    value["distortion_model"] = "radial-tangential" if lens == "radtan" else lens
    value["distortion_coefficients"] = coefficients
    return value
