"""Geometric estimation in JAX: batched, differentiable, with covariances.

The groups and the robust estimators stand here; each folder is a public namespace of its own: `vojax.cameras`,
`vojax.solvers`, `vojax.ba` … What needs an extra (`vojax.features`, `vojax.datasets`, `vojax.odometry`, `vojax.viz`,
`vojax.cli`) is imported by name only.

Names are loaded when first used, so that `vojax --help` does not wait for JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

from . import _jax_version as _jax_version  # isort: skip - first: it refuses a jaxlib that computes wrong results
from ._version import __version__ as __version__

if TYPE_CHECKING:
    from . import ba as ba
    from . import calibration as calibration
    from . import cameras as cameras
    from . import geometry as geometry
    from . import lie as lie
    from . import robust as robust
    from . import solvers as solvers
    from ._result import Result as Result
    from .lie import SE3 as SE3
    from .lie import SO3 as SO3
    from .lie import Sim3 as Sim3
    from .robust import Estimate as Estimate
    from .robust import RansacOptions as RansacOptions
    from .robust import estimate_absolute_pose as estimate_absolute_pose
    from .robust import estimate_fundamental as estimate_fundamental
    from .robust import estimate_generalized_pose as estimate_generalized_pose
    from .robust import estimate_homography as estimate_homography
    from .robust import estimate_relative_pose as estimate_relative_pose
    from .robust import estimate_rigid as estimate_rigid
    from .robust import estimate_similarity as estimate_similarity

_FOLDERS = ("ba", "calibration", "cameras", "geometry", "lie", "robust", "solvers")
_HOMES = {
    "Result": "_result",
    "SE3": "lie",
    "SO3": "lie",
    "Sim3": "lie",
    "Estimate": "robust",
    "RansacOptions": "robust",
    "estimate_absolute_pose": "robust",
    "estimate_fundamental": "robust",
    "estimate_generalized_pose": "robust",
    "estimate_homography": "robust",
    "estimate_relative_pose": "robust",
    "estimate_rigid": "robust",
    "estimate_similarity": "robust",
}


def __getattr__(name: str) -> Any:
    if name in _FOLDERS:
        return importlib.import_module(f"{__name__}.{name}")
    if name in _HOMES:
        value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(("__version__", *_FOLDERS, *_HOMES))
