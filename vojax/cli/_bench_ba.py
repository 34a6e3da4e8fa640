"""`vojax bench ba`: milliseconds of refinement, windows and bundles; `benchmarks/` has them beside Ceres."""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax.ba import LMOptions, Squared, adjust_bundle, adjust_window, bundle_problem, refine_absolute_pose
from vojax.cameras import Pinhole
from vojax.datasets import simulate_absolute_pose, simulate_stereo_window
from vojax.lie import SE3

BATCH = 256
COLUMNS = ("problem", "dtype", "observations each", "in one call", "ms each", "iterations", "compile s")
_REPEATS = 5


class Row(NamedTuple):
    """Measured times of one kind of problem.

    Attributes:
        name: What is adjusted.
        dtype: Of the arrays.
        observations: Of one problem.
        batch: Problems in one call.
        milliseconds: Per problem, median.
        iterations: Mean over the problems.
        compile_seconds: Tracing and compilation.
    """

    name: str
    dtype: str
    observations: int
    batch: int
    milliseconds: float
    iterations: float
    compile_seconds: float

    def cells(self) -> tuple[str, ...]:
        """What the table shows."""
        numbers = f"{self.milliseconds:.3f}", f"{self.iterations:.1f}", f"{self.compile_seconds:.1f}"
        return self.name, self.dtype, f"{self.observations}", f"{self.batch}", *numbers


def tasks(batch: int) -> dict[str, Callable[[], Row]]:
    """Each measures one row."""
    return {
        "poses of 100 points": functools.partial(_poses, batch),
        "windows of 6 keyframes and 60 landmarks": functools.partial(_windows, batch, 6, 60),
        "stereo window of 10 keyframes and 1000 landmarks": functools.partial(_windows, 1, 10, 1000),
        "bundle of 50 cameras and 5000 landmarks": functools.partial(_bundle, 5000),
    }


def _poses(batch: int) -> Row:
    keys = jax.random.split(jax.random.key(0), batch)
    scenes = jax.vmap(lambda key: simulate_absolute_pose(key, 100))(keys)
    start = jax.vmap(lambda pose: pose @ SE3.exp(jnp.full(6, 0.01)))(scenes.cam_from_world)
    each = jax.vmap(refine_absolute_pose)
    arguments = (start, scenes.points_world, scenes.pixels, scenes.camera)
    return _measure("poses of 100 points", 100, batch, jax.jit(each), *arguments)


def _windows(batch: int, keyframes: int, landmarks: int) -> Row:
    keys = jax.random.split(jax.random.key(0), batch)
    drawn = jax.vmap(lambda key: simulate_stereo_window(key, keyframes, landmarks, sigma_px=0.5))(keys)
    stereo = jax.tree.map(lambda leaf: leaf[0], drawn.stereo)
    fixed = jnp.arange(keyframes) < 2
    turned = SE3.exp(0.01 * jax.random.normal(jax.random.key(1), (batch, keyframes, 6)))
    poses = SE3(jnp.where(fixed[:, None], drawn.world_from_cam.wxyz_xyz, (drawn.world_from_cam @ turned).wxyz_xyz))
    points = drawn.landmarks_world + 0.05 * jax.random.normal(jax.random.key(2), drawn.landmarks_world.shape)

    def adjust(poses: SE3, points: Any, measurements: Any, mask: Any) -> Any:
        return adjust_window(poses, points, measurements, mask, stereo, fixed=fixed, loss=Squared())

    arguments = (poses, points, drawn.observations, drawn.visible)
    observations = int(jnp.sum(drawn.visible)) // batch
    stated = f"{'stereo window' if batch == 1 else 'windows'} of {keyframes} keyframes and {landmarks} landmarks"
    return _measure(stated, observations, batch, jax.jit(jax.vmap(adjust)), *arguments)


def _bundle(landmarks: int) -> Row:
    """A drive past landmarks that six cameras in a row see each."""
    rng = np.random.default_rng(0)
    c, seen_by = 50, 6
    first = rng.integers(0, c - seen_by + 1, size=landmarks)
    points = np.stack(
        [first + rng.uniform(0, 5, landmarks), rng.uniform(-3, 3, landmarks), rng.uniform(5, 20, landmarks)], axis=1
    )
    camera_index = (first[:, None] + np.arange(seen_by)).ravel()
    landmark_index = np.repeat(np.arange(landmarks), seen_by)
    centres = np.stack([np.arange(c), np.zeros(c), np.zeros(c)], axis=1)
    local = points[landmark_index] - centres[camera_index]
    pixels = 500 * local[:, :2] / local[:, 2:] + rng.normal(size=(len(local), 2))
    poses = np.concatenate([np.tile([1.0, 0, 0, 0], (c, 1)), -centres + 0.02 * rng.normal(size=(c, 3))], axis=1)
    with jax.enable_x64(True):
        camera = Pinhole(fx=500.0, fy=500.0, cx=0.0, cy=0.0)
        start = points + 0.05 * rng.normal(size=points.shape)
        problem = bundle_problem(
            SE3(jnp.asarray(poses)), start, pixels, camera_index, landmark_index, camera, gauge="two_cameras"
        )
        adjust = eqx.filter_jit(functools.partial(adjust_bundle, options=LMOptions()))
        return _measure(f"bundle of {c} cameras and {landmarks} landmarks", len(pixels), 1, adjust, problem)


def _measure(name: str, observations: int, batch: int, function: Any, *arguments: Any) -> Row:
    start = time.perf_counter()
    compiled = function.lower(*arguments).compile()
    compile_seconds = time.perf_counter() - start
    found = jax.block_until_ready(compiled(*arguments))
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        times.append(time.perf_counter() - start)
    return Row(
        name,
        found.cost.dtype.name,
        observations,
        batch,
        1e3 * float(np.median(times)) / batch,
        float(np.mean(found.iterations)),
        compile_seconds,
    )
