"""Geometric estimation in JAX: batched, differentiable, with covariances.

The groups stand here; each folder is a public namespace of its own: `vojax.cameras`, `vojax.solvers`, `vojax.ba` …
What needs an extra (`vojax.features`, `vojax.viz`, `vojax.cli`) is imported by name only.
"""

from . import _jax_version as _jax_version  # first: it refuses a jaxlib that computes wrong results
from ._version import __version__ as __version__
from .lie import SE3 as SE3
from .lie import SO3 as SO3
from .lie import Sim3 as Sim3
