"""Geometric estimation in JAX: batched, differentiable, with covariances.

The groups and the robust estimators stand here; each folder is a public namespace of its own: `vojax.cameras`,
`vojax.solvers`, `vojax.ba` … What needs an extra (`vojax.features`, `vojax.datasets`, `vojax.odometry`, `vojax.viz`,
`vojax.cli`) is imported by name only.
"""

from . import _jax_version as _jax_version  # isort: skip - first: it refuses a jaxlib that computes wrong results
from . import ba as ba
from . import cameras as cameras
from . import geometry as geometry
from . import lie as lie
from . import robust as robust
from . import solvers as solvers
from ._result import Result as Result
from ._version import __version__ as __version__
from .lie import SE3 as SE3
from .lie import SO3 as SO3
from .lie import Sim3 as Sim3
from .robust import Estimate as Estimate
from .robust import RansacOptions as RansacOptions
from .robust import estimate_absolute_pose as estimate_absolute_pose
