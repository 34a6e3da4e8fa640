"""A calibration file that holds every model: parameters by name, sizes and poses, in YAML.

    left:
      model: KannalaBrandt
      parameters: {fx: 190.9, fy: 190.9, cx: 254.9, cy: 256.8, k1: 0.0035, k2: 0.0007, k3: -0.002, k4: 0.0002}
      resolution: [512, 512]
      cam_from_rig: [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]

Poses are (w, x, y, z, tx, ty, tz).
"""

import pathlib
from typing import Any

import jax.numpy as jnp
import numpy as np

from vojax.lie import SE3

from ._brown_conrady import BrownConrady
from ._camera_set import CameraSet
from ._double_sphere import DoubleSphere
from ._extended_unified import ExtendedUnified
from ._kannala_brandt import KannalaBrandt
from ._pinhole import Pinhole
from ._scaramuzza import Scaramuzza
from ._spherical import Spherical
from ._unified import Unified
from ._yaml import check_focal_lengths, entry, image_size, numbers, plain

_MODELS = {
    model.__name__: model
    for model in (
        Pinhole,
        BrownConrady,
        KannalaBrandt,
        Unified,
        ExtendedUnified,
        DoubleSphere,
        Scaramuzza,
        Spherical,
    )
}


def read_own(path: pathlib.Path, value: dict[str, Any]) -> CameraSet:
    """Cameras by the names they have in the file."""
    cameras, sizes, poses = {}, {}, []
    for name, part in value.items():
        where = f"{path}, {name}"
        model, parameters = str(entry(part, "model", where)), entry(part, "parameters", where)
        if not isinstance(parameters, dict):
            raise ValueError(f"{where}, parameters is {parameters!r}: expected names and values")
        if model not in _MODELS:
            raise ValueError(f"{where} has model {model!r}: expected one of {', '.join(_MODELS)}")
        values: dict[str, Any] = {}
        for key in parameters:
            several = key == "higher"
            found = numbers(parameters[key], f"{where}, {key}", () if several else (1,))
            values[key] = tuple(found) if several else found[0]
        check_focal_lengths(values, where)
        try:
            cameras[name] = _MODELS[model](**values)
        except TypeError as error:
            raise ValueError(f"{where} does not have the parameters of {model}: {error}") from None
        if "resolution" in part:
            sizes[name] = image_size(part["resolution"], f"{where}, resolution")
        if "cam_from_rig" in part:
            pose = np.array(numbers(part["cam_from_rig"], f"{where}, cam_from_rig", (7,)))
            length = np.linalg.norm(pose[:4])
            if abs(length - 1.0) > 1e-3:
                raise ValueError(f"{where}, cam_from_rig has a quaternion of length {length:g}: expected 1")
            poses.append(np.concatenate([pose[:4] / length, pose[4:]]))
    return CameraSet(cameras, sizes, SE3(jnp.asarray(np.array(poses))) if len(poses) == len(cameras) else None)


def own_of(cameras: CameraSet) -> dict[str, Any]:
    """What `read_own` reads."""
    value: dict[str, Any] = {}
    for name, camera in cameras.cameras.items():
        if type(camera) not in _MODELS.values():
            raise ValueError(f"camera {name!r} is a {type(camera).__name__}: expected one of {', '.join(_MODELS)}")
        parameters = {
            key: [plain(one) for one in held] if isinstance(held, tuple) else plain(held)
            for key, held in vars(camera).items()
        }
        part: dict[str, Any] = {"model": type(camera).__name__, "parameters": parameters}
        if name in cameras.sizes:
            part["resolution"] = list(cameras.sizes[name])
        pose = cameras.pose(name)
        if pose is not None:
            part["cam_from_rig"] = plain(np.asarray(pose.wxyz_xyz))
        value[name] = part
    return value
