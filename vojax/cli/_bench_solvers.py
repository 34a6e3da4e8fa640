"""`vojax bench solvers`: nanoseconds per solve of every solver in a batch, compile time apart.

Peer figures are published ones of PoseLib's own C++ benchmark (version 3.0, AVX2 build, one core, float64): other
machines, another precision and one core, so they are a landmark and not a race.
"""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from vojax import solvers

BATCH = 100_000
COLUMNS = (
    "solver",
    "dtype",
    "ns per solve",
    "split over devices",
    "fastest",
    "compile s",
    "PoseLib C++, published",
)


class Problem(NamedTuple):
    """A solver, what it is called on, and what its peer needs.

    Attributes:
        solver: Called on one problem.
        arguments: Makes the arrays of a batch, which is their first axis.
        poselib_ns: Published nanoseconds per solve, or None.
    """

    solver: Callable[..., Any]
    arguments: Callable[[], tuple[np.ndarray, ...]]
    poselib_ns: float | None = None


class Row(NamedTuple):
    """Measured times of one solver.

    Attributes:
        name: Of the solver and its sample.
        dtype: Of the arrays.
        nanoseconds: Per solve in one call on one device, median of the repeats.
        sharded: Per solve with the batch split over the devices, median; None where there is only one.
        best: Per solve, the fastest repeat.
        compile_seconds: Tracing and compilation.
        poselib_ns: Published nanoseconds per solve of the peer, or None.
    """

    name: str
    dtype: str
    nanoseconds: float
    sharded: float | None
    best: float
    compile_seconds: float
    poselib_ns: float | None

    def cells(self) -> tuple[str, ...]:
        """What the table shows."""
        peer = "" if self.poselib_ns is None else f"{self.poselib_ns:.0f}"
        sharded = "" if self.sharded is None else f"{self.sharded:.0f}"
        times = f"{self.nanoseconds:.0f}", sharded, f"{self.best:.0f}", f"{self.compile_seconds:.1f}"
        return self.name, self.dtype, *times, peer


def tasks(batch: int) -> dict[str, Callable[[], Row]]:
    """Each measures one row."""
    return {
        f"{name}, {dtype}": functools.partial(measure, name, problem, dtype)
        for name, problem in problems(batch).items()
        for dtype in ("float32", "float64")
    }


def problems(batch: int, seed: int = 0) -> dict[str, Problem]:
    """One batch of problems for every solver: noise-free, in front of the cameras, well conditioned."""
    rng = np.random.default_rng(seed)
    rotation = _rotations(rng, batch)
    turn = _rotations(rng, batch, largest=0.3)
    translation = rng.normal(size=(batch, 3))
    translation /= np.linalg.norm(translation, axis=-1, keepdims=True)

    def absolute(n: int) -> tuple[np.ndarray, np.ndarray]:
        points_cam = _rays(rng, batch, n) * rng.uniform(2.0, 10.0, (batch, n, 1))
        return np.einsum("bji,bnj->bni", rotation, points_cam - translation[:, None]), points_cam

    def relative(n: int) -> tuple[np.ndarray, np.ndarray]:
        points0 = _rays(rng, batch, n) * rng.uniform(2.5, 10.0, (batch, n, 1))
        return points0, np.einsum("bij,bnj->bni", turn, points0) + translation[:, None]

    def pixels(points: np.ndarray) -> np.ndarray:
        return 800.0 * points[..., :2] / points[..., 2:] + np.array([640.0, 480.0])

    def planar(n: int) -> tuple[np.ndarray, np.ndarray]:
        rays = _rays(rng, batch, n)
        points0 = 5.0 * rays / np.sum(rays * np.array([0.1, -0.2, 1.0]), axis=-1, keepdims=True)
        return pixels(points0), pixels(np.einsum("bij,bnj->bni", turn, points0) + translation[:, None])

    def upright(n: int) -> tuple[np.ndarray, np.ndarray]:
        points0 = _rays(rng, batch, n) * rng.uniform(2.5, 10.0, (batch, n, 1))
        about_y = _about_y(rng.uniform(-0.3, 0.3, batch))
        level = translation * np.array([1.0, 0.0, 1.0])
        return points0, np.einsum("bij,bnj->bni", about_y, points0) + level[:, None]

    def bearings(*points: np.ndarray) -> tuple[np.ndarray, ...]:
        return tuple(x / np.linalg.norm(x, axis=-1, keepdims=True) for x in points)

    def pose(n: int) -> tuple[np.ndarray, ...]:
        world, cam = absolute(n)
        return world, *bearings(cam)

    def rig(n: int) -> tuple[np.ndarray, ...]:
        world, cam = absolute(n)
        centers = rng.uniform(-0.5, 0.5, (batch, n, 3))
        return world, centers, *bearings(cam - centers)

    def rig_motion(n: int) -> tuple[np.ndarray, ...]:
        points0, points1 = relative(n)
        centers0, centers1 = (rng.uniform(-0.5, 0.5, (batch, n, 3)) for _ in range(2))
        return *bearings(points0 - centers0, points1 - centers1), centers0, centers1

    def unknown_focal(n: int) -> tuple[np.ndarray, ...]:
        world, cam = absolute(n)
        return world, rng.uniform(400.0, 2000.0, (batch, 1, 1)) * cam[..., :2] / cam[..., 2:]

    def lines(n: int) -> tuple[np.ndarray, ...]:
        world, cam = absolute(2 * n)
        cam = cam.reshape(batch, n, 2, 3)
        return world.reshape(batch, n, 2, 3), np.cross(cam[..., 0, :], cam[..., 1, :])

    table = {
        "p3p": (solvers.p3p, lambda: pose(3), 237.0),
        "p3p_grunert": (solvers.p3p_grunert, lambda: pose(3), None),
        "up2p": (solvers.up2p, lambda: pose(2), 112.0),
        "epnp, 10 points": (solvers.epnp, lambda: pose(10), None),
        "dlt_pnp_calibrated, 10 points": (solvers.dlt_pnp_calibrated, lambda: pose(10), None),
        "five_point": (solvers.five_point, lambda: bearings(*relative(5)), 5455.0),
        "five_point_action_matrix": (solvers.five_point_action_matrix, lambda: bearings(*relative(5)), 5455.0),
        "six_point": (solvers.six_point, lambda: bearings(*relative(6)), None),
        "seven_point": (solvers.seven_point, lambda: tuple(map(pixels, relative(7))), None),
        "eight_point": (solvers.eight_point, lambda: bearings(*relative(8)), 2460.0),
        "eight_point, 100 points": (solvers.eight_point, lambda: bearings(*relative(100)), 7440.0),
        "fundamental_eight_point": (solvers.fundamental_eight_point, lambda: tuple(map(pixels, relative(8))), None),
        "upright_three_point": (solvers.upright_three_point, lambda: bearings(*upright(3)), 272.0),
        "planar_two_point": (solvers.planar_two_point, lambda: bearings(*upright(2)), 262.0),
        "one_point": (solvers.one_point, lambda: tuple(x[:, 0] for x in bearings(*upright(1))), None),
        "homography_four_point": (solvers.homography_four_point, lambda: planar(4), 35.0),
        "homography_dlt, 10 points": (solvers.homography_dlt, lambda: planar(10), None),
        "rotation_from_rays, 2 rays": (solvers.rotation_from_rays, lambda: bearings(*relative(2)), None),
        "rigid_three_point": (solvers.rigid_three_point, lambda: relative(3), None),
        "procrustes, 3 points": (solvers.procrustes, lambda: relative(3), None),
        "procrustes_quaternion, 3 points": (solvers.procrustes_quaternion, lambda: relative(3), None),
        "affine_3d, 10 points": (solvers.affine_3d, lambda: relative(10), None),
        "gp3p": (solvers.gp3p, lambda: rig(3), 1750.0),
        "gpnp, 10 points": (solvers.gpnp, lambda: rig(10), None),
        "generalized_relative_pose, 17 points": (solvers.generalized_relative_pose, lambda: rig_motion(17), None),
        "p4pf": (solvers.p4pf, lambda: unknown_focal(4), 2485.0),
        "p4pfr": (solvers.p4pfr, lambda: unknown_focal(4), None),
        "p5pfr": (solvers.p5pfr, lambda: unknown_focal(5), 1460.0),
        "p3l": (solvers.p3l, lambda: lines(3), None),
        "p2p1l": (solvers.p2p1l, lambda: (*pose(2), *lines(1)), None),
        "p1p2l": (solvers.p1p2l, lambda: (*pose(1), *lines(2)), None),
    }
    return {name: Problem(*entry) for name, entry in table.items()}


def measure(name: str, problem: Problem, dtype: str, seconds: float = 1.0) -> Row:
    """Compile a batched solver and time it."""
    devices = jax.devices()
    with jax.enable_x64(dtype == "float64"):
        lanes = [np.ascontiguousarray(np.moveaxis(x, 0, -1).astype(dtype)) for x in problem.arguments()]
        batch = lanes[0].shape[-1]
        batched = jax.vmap(problem.solver, in_axes=-1, out_axes=-1)
        times, compile_seconds = _times(batched, [jax.device_put(x) for x in lanes], seconds)
        sharded = None
        if len(devices) > 1:
            whole = batch - batch % len(devices)
            shared, _ = _times(*_split(batched, [x[..., :whole] for x in lanes]), seconds)
            sharded = float(np.median(shared)) * 1e9 / whole
    nanoseconds, best = float(np.median(times)) * 1e9 / batch, min(times) * 1e9 / batch
    return Row(name, dtype, nanoseconds, sharded, best, compile_seconds, problem.poselib_ns)


def _times(function: Callable[..., Any], arguments: list[Any], seconds: float) -> tuple[list[float], float]:
    """Times of repeated calls, and that of tracing and compilation."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_seconds = time.perf_counter() - start
    call = functools.partial(compiled, *arguments)
    jax.block_until_ready(call())
    times: list[float] = []
    begin = time.perf_counter()
    while len(times) < 5 or time.perf_counter() - begin < seconds:
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return times, compile_seconds


def _split(batched: Callable[..., Any], lanes: list[np.ndarray]) -> tuple[Callable[..., Any], list[Any]]:
    """The function on all devices, each with its part of the last axis, and its arguments put there."""
    mesh = Mesh(np.asarray(jax.devices()), ("lanes",))

    def last_axis(x: Any) -> PartitionSpec:
        return PartitionSpec(*(None,) * (x.ndim - 1), "lanes")

    results = jax.tree.map(last_axis, jax.eval_shape(batched, *lanes))
    specs = tuple(map(last_axis, lanes))
    function = jax.shard_map(batched, mesh=mesh, in_specs=specs, out_specs=results, check_vma=False)
    return function, [jax.device_put(x, NamedSharding(mesh, spec)) for x, spec in zip(lanes, specs, strict=True)]


def _rotations(rng: np.random.Generator, count: int, largest: float = np.pi) -> np.ndarray:
    """Rotation matrices about random axes, by Rodrigues' formula."""
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = rng.uniform(0.0, largest, (count, 1, 1))
    cross = np.cross(np.eye(3), axis[:, None, :]).transpose(0, 2, 1)
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)


def _about_y(angle: np.ndarray) -> np.ndarray:
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([c, zero, s, zero, one, zero, -s, zero, c], axis=-1).reshape(-1, 3, 3)


def _rays(rng: np.random.Generator, count: int, n: int) -> np.ndarray:
    """Rays with z = 1 within a field of view of 70°."""
    return np.concatenate([rng.uniform(-0.7, 0.7, (count, n, 2)), np.ones((count, n, 1))], axis=-1)
