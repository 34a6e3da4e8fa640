import os
import pathlib

import jax
import jax.numpy as jnp
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")

# Absolute tolerance for quantities of order one after a handful of operations, by dtype or by its name.
TOLERANCE = {jnp.float32: 2e-5, jnp.float64: 1e-10, "float32": 2e-5, "float64": 1e-10}


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Compile quickly, as compilation is most of the tests' time, except where the test says that many lanes run.

    Slow tests, doctests, notebooks and the command line run what users run.
    """
    users = not isinstance(item, pytest.Function) or any(map(item.get_closest_marker, ("slow", "optimized")))
    jax.config.update("jax_disable_most_optimizations", not users)


@pytest.fixture
def x64():
    """Double precision inside the test, and only there."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=[jnp.float32, jnp.float64], ids=["float32", "float64"])
def dtype(request):
    """Both precisions in turn; float64 is enabled inside the test only."""
    with jax.enable_x64(request.param is jnp.float64):
        yield request.param


@pytest.fixture
def tolerance(dtype) -> float:
    """What `TOLERANCE` allows in the test's `dtype`."""
    return TOLERANCE[dtype]


@pytest.fixture(scope="session")
def data_root() -> pathlib.Path:
    """The folder of real data sets, or a skip that says how to get one."""
    root = os.environ.get("VOJAX_DATA")
    if not root:
        pytest.skip("VOJAX_DATA is not set: point it at the folder of real data sets")
    path = pathlib.Path(root)
    if not path.is_dir():
        pytest.fail(f"VOJAX_DATA is {root!r}, which is not a folder")
    return path
