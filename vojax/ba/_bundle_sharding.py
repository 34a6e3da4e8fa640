"""Observations of a bundle over several devices."""

import dataclasses

import equinox as eqx
import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ._bundle_problem import BundleProblem


def shard_bundle(problem: BundleProblem, mesh: Mesh) -> BundleProblem:
    """Lay the observations of a problem over a mesh, for `adjust_bundle` under jit.

    Residuals, Jacobian blocks and sums over landmarks are split; cameras, the reduced system and its solution are on
    every device. The answer is that of one device, but for the order of sums.

    Args:
        problem: Of `bundle_problem`.
        mesh: With one axis.
    """
    (axis,) = mesh.axis_names
    everywhere = NamedSharding(mesh, PartitionSpec())
    arrays, static = eqx.partition(problem, eqx.is_array)
    placed = eqx.combine(jax.device_put(arrays, everywhere), static)
    layout = dataclasses.replace(placed.layout, sharding=NamedSharding(mesh, PartitionSpec(axis)))
    return eqx.tree_at(lambda problem: problem.layout, placed, layout)
