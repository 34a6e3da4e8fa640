"""`vojax bench robust`: milliseconds per estimate of every robust estimator, one problem at a time and in a batch.

Problems have 1 px of noise (0.01 of rigid scenes), images of 1280 × 960 with a focal length of 800 px, and wrong
observations uniform over the image or the scene. `benchmarks/bench_robust.py` has the accuracy, beside other libraries.
"""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vojax import robust
from vojax._result import Result
from vojax.cameras import Pinhole, Rig
from vojax.datasets import simulate_absolute_pose, simulate_relative_pose, simulate_rigid
from vojax.lie import SE3

BATCH = 64
COLUMNS = ("estimator", "outliers", "ms, one problem", "ms each, in a batch", "success", "compile s")
SHARES = (0.3, 0.5, 0.7)
_POINTS = 200
_REPEATS = 20


class Row(NamedTuple):
    """Measured times of one estimator.

    Attributes:
        name: Of the estimator.
        outliers: Share of wrong observations.
        milliseconds: Of one problem in one call, median over problems.
        batched: Per problem of a batch in one call.
        success: Share of problems with the result `success`.
        compile_seconds: Tracing and compilation of the function of one problem.
    """

    name: str
    outliers: float
    milliseconds: float
    batched: float
    success: float
    compile_seconds: float

    def cells(self) -> tuple[str, ...]:
        """What the table shows."""
        times = f"{self.milliseconds:.2f}", f"{self.batched:.2f}"
        return self.name, f"{self.outliers:.0%}", *times, f"{self.success:.0%}", f"{self.compile_seconds:.1f}"


def _absolute(key: Any, n: int, share: float) -> tuple[Any, ...]:
    problem = simulate_absolute_pose(key, n, outlier_fraction=share)
    return problem.points_world, problem.pixels


def _two_views(key: Any, n: int, share: float) -> tuple[Any, ...]:
    problem = simulate_relative_pose(key, n, outlier_fraction=share)
    return problem.pixels0, problem.pixels1


def _plane(key: Any, n: int, share: float) -> tuple[Any, ...]:
    keys = jax.random.split(key, 4)
    pixels0 = jax.random.uniform(keys[0], (n, 2)) * jnp.array([1280.0, 960.0])[None]
    homography = jnp.eye(3) + jnp.array([[0.1, 0.1, 60.0], [0.1, 0.1, 60.0], [1e-4, 1e-4, 0.0]]) * (
        jax.random.uniform(keys[1], (3, 3), minval=-1.0)
    )
    moved = pixels0 @ homography[:, :2].T + homography[:, 2][None]
    pixels1 = moved[:, :2] / moved[:, 2:] + jax.random.normal(keys[2], (n, 2))
    wrong = jax.random.uniform(keys[3], (n, 2)) * jnp.array([1280.0, 960.0])[None]
    return pixels0, jnp.where(jnp.arange(n)[:, None] < share * n, wrong, pixels1)


def _rig(key: Any, n: int, share: float) -> tuple[Any, ...]:
    problem = simulate_absolute_pose(key, n, outlier_fraction=share)
    # The second half is seen from half a metre aside, in the same pixels.
    beside = jnp.arange(n) % 2
    centre = problem.cam_from_world.inverse().rotation().apply(jnp.array([0.5, 0.0, 0.0]))
    return problem.points_world + beside[:, None] * centre[None], problem.pixels, beside


def _points(key: Any, n: int, share: float) -> tuple[Any, ...]:
    problem = simulate_rigid(key, n, outlier_fraction=share)
    return problem.points0, problem.points1


class Estimator(NamedTuple):
    """An estimator as a function of observations and key, and how its problems are made."""

    estimate: Callable[..., Any]
    problem: Callable[[Any, int, float], tuple[Any, ...]]


def estimators() -> dict[str, Estimator]:
    """All robust estimators."""
    camera = Pinhole(fx=800.0, fy=800.0, cx=639.5, cy=479.5)
    rig = Rig((camera, camera), SE3(jnp.array([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, -0.5, 0, 0]])))
    return {
        "absolute_pose": Estimator(lambda x, u, key: robust.estimate_absolute_pose(x, u, camera, key=key), _absolute),
        "generalized_pose": Estimator(
            lambda x, u, index, key: robust.estimate_generalized_pose(x, u, index, rig, key=key), _rig
        ),
        "relative_pose": Estimator(
            lambda u, v, key: robust.estimate_relative_pose(u, v, camera, camera, key=key), _two_views
        ),
        "fundamental": Estimator(lambda u, v, key: robust.estimate_fundamental(u, v, key=key), _two_views),
        "homography": Estimator(lambda u, v, key: robust.estimate_homography(u, v, key=key), _plane),
        "rigid": Estimator(lambda x, y, key: robust.estimate_rigid(x, y, key=key), _points),
        "similarity": Estimator(lambda x, y, key: robust.estimate_similarity(x, y, key=key), _points),
    }


def tasks(batch: int) -> dict[str, Callable[[], Row]]:
    """Each measures one row."""
    return {
        f"{name}, {share:.0%}": functools.partial(measure, name, estimator, share, batch)
        for name, estimator in estimators().items()
        for share in SHARES
    }


def measure(name: str, estimator: Estimator, outliers: float, batch: int, points: int = _POINTS) -> Row:
    """Compile an estimator and time it on one problem after the other, and on a batch."""
    keys = jax.random.split(jax.random.key(0), batch)
    problems = jax.jit(jax.vmap(lambda key: estimator.problem(key, points, outliers)))(keys)
    arguments = (*problems, keys)
    first = [x[0] for x in arguments]
    start = time.perf_counter()
    one = jax.jit(estimator.estimate).lower(*first).compile()
    compile_seconds = time.perf_counter() - start
    times = []
    for i in range(min(batch, _REPEATS)):
        single = jax.block_until_ready([x[i] for x in arguments])
        start = time.perf_counter()
        jax.block_until_ready(one(*single))
        times.append(time.perf_counter() - start)
    many = jax.jit(jax.vmap(estimator.estimate)).lower(*arguments).compile()
    found = jax.block_until_ready(many(*arguments))
    start = time.perf_counter()
    jax.block_until_ready(many(*arguments))
    batched = (time.perf_counter() - start) / batch
    success = float(np.mean(np.asarray(found.result == Result.success)))
    return Row(name, outliers, 1e3 * float(np.median(times)), 1e3 * batched, success, compile_seconds)
