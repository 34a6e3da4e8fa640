"""Ladybug-49 of "Bundle adjustment in the large" against its known optimum, 13,344.25 over all observations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3, Result
from vojax.ba._bundle import adjust_bundle
from vojax.ba._bundle_problem import bundle_problem
from vojax.datasets._bal import read_bal

OPTIMUM = 13_344.25


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(
    ("double", "solver", "share"),
    [(True, "dense", 4e-5), (True, "iterative", 4e-5), (False, "dense", 1e-3)],
    ids=["float64", "conjugate gradients", "float32"],
)
def test_ladybug_reaches_its_optimum(double, solver, share, data_root):
    bal = read_bal(data_root / "bal" / "problem-49-7776-pre.txt")
    with jax.enable_x64(double):
        problem = bundle_problem(
            SE3(jnp.asarray(bal.cam_from_world)),
            bal.landmarks.astype(np.float64 if double else np.float32),
            bal.pixels.astype(np.float64 if double else np.float32),
            bal.camera_index,
            bal.landmark_index,
            bal.camera(),
            free_intrinsics=("focal", "k1", "k2"),
        )
        assert problem.gauge_free
        found = eqx.filter_jit(adjust_bundle)(problem, solver=solver)
        assert found.result == Result.success
        assert float(found.initial_cost) == pytest.approx(850_912.46, rel=1e-7 if double else 1e-4)
        assert OPTIMUM * (1 - 1e-5) < float(found.cost) < OPTIMUM * (1 + share)
        assert int(found.iterations) <= 35
        for leaf in jax.tree.leaves((found.cam_from_world, found.landmarks, found.camera, found.trace)):
            assert np.all(np.isfinite(leaf))
