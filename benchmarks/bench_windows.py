"""Windows of bundle adjustment: a thousand small ones beside Ceres (through pycolmap), and a large one share by share.

python benchmarks/bench_windows.py [--windows 1000] [--ceres 200] [--float32]

The small windows are 6 keyframes × 60 landmarks in pixels, two keyframes fixed, in one call that is divided over two
virtual devices; Ceres solves the same ones, each on one
thread, and the sum of its own times (its summary's "total", preprocessing included) is compared. Both minimise Σr²; the
costs are printed beside each other. The large window has 10 keyframes, 1,000 landmarks and about 5,000 stereo
measurements; its shares are timed as functions of their own.
"""

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("NPROC", "4")  # as many threads as devices can wait for one another for ever

import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine, time_calls

from vojax.ba import LMOptions, Squared, adjust_window
from vojax.ba import _window as window_module
from vojax.ba._window_residual import linearize
from vojax.ba._window_schur import normal_equations, reduce, solve
from vojax.cameras import RectifiedStereo
from vojax.datasets import simulate_stereo_window
from vojax.lie import SE3


def simulate(seed: int, c: int, p: int, windows: int, dtype: Any) -> tuple[tuple[Any, ...], RectifiedStereo]:
    """Windows started beside the truth: poses, landmarks, measurements, mask; landmarks seen once are left out."""
    keys = jax.random.split(jax.random.key(seed), windows)
    drawn = jax.vmap(
        lambda key: simulate_stereo_window(key, c, p, sigma_px=0.5, depth_range=(4.0, 20.0), step=0.5, dtype=dtype)
    )(keys)
    rng = np.random.default_rng(seed)
    xi = 0.03 * rng.normal(size=(windows, c, 6)) * np.array([1, 1, 1, 0.2, 0.2, 0.2])
    xi[:, :2] = 0  # the fixed ones
    points = drawn.landmarks_world + jnp.asarray(0.05 * rng.normal(size=(windows, p, 3)), dtype)
    mask = drawn.visible & (jnp.sum(drawn.visible, axis=1, keepdims=True) >= 2)
    poses = drawn.world_from_cam @ SE3.exp(jnp.asarray(xi, dtype))
    return (poses, points, drawn.observations, mask), jax.tree.map(lambda leaf: leaf[0], drawn.stereo)


def small_windows(windows: int, ceres_windows: int, dtype: Any) -> None:
    data, stereo = simulate(0, 6, 60, windows, dtype)
    poses, points, measurements, mask = data
    fixed = jnp.arange(6) < 2

    @jax.vmap
    def adjust_each(poses: SE3, points: Any, measurements: Any, mask: Any) -> Any:
        options = LMOptions(tolerance=1e-6)  # Ceres' own
        found = adjust_window(
            poses, points, measurements, mask, stereo.camera, fixed=fixed, loss=Squared(), options=options
        )
        return found.cost, found.iterations, found.world_from_cam

    # Half of the windows on each of two devices: one device a core.
    mesh = jax.make_mesh((2,), ("window",))
    along = jax.sharding.PartitionSpec("window")
    adjust = jax.jit(jax.shard_map(adjust_each, mesh=mesh, in_specs=along, out_specs=along, check_vma=False))
    arguments = (poses, points, measurements[..., :2], mask)
    arguments = jax.device_put(arguments, jax.sharding.NamedSharding(mesh, along))
    start = time.perf_counter()
    cost, iterations, _ = jax.block_until_ready(adjust(*arguments))
    first = time.perf_counter() - start
    median, best = time_calls(lambda: jax.block_until_ready(adjust(*arguments)))
    before = time.process_time()
    jax.block_until_ready(adjust(*arguments))
    processor = time.process_time() - before
    cost, iterations = np.asarray(cost, float), np.asarray(iterations)
    print(
        f"{windows} windows of 6 keyframes × 60 landmarks, {np.mean(np.sum(mask, axis=(1, 2))):.0f} observations each: "
        f"median {median / windows * 1e6:.0f} µs a window, best {best / windows * 1e6:.0f} µs, "
        f"processor {processor / windows * 1e6:.0f} µs, "
        f"{iterations.mean():.1f} iterations (most {iterations.max()}), first call {first:.1f} s",
        flush=True,
    )
    seconds, costs = ceres(data, stereo, min(ceres_windows, windows))
    if len(seconds):
        ours = cost[: len(costs)]
        print(
            f"Ceres, one thread, on {len(seconds)} of them: {seconds.mean() * 1e6:.0f} µs a window "
            f"(median {np.median(seconds) * 1e6:.0f}), {seconds.mean() / (median / windows):.1f} times as long; "
            f"mean cost {costs.mean():.4f}, ours {ours.mean():.4f}, "
            f"largest relative difference {np.max(np.abs(ours - costs) / costs):.1e}",
            flush=True,
        )


def ceres(data: tuple[Any, ...], stereo: RectifiedStereo, windows: int) -> tuple[np.ndarray, np.ndarray]:
    """Seconds and final costs of Ceres, window by window."""
    try:
        import pycolmap
    except ImportError:
        print("Ceres: pycolmap is not installed")
        return np.zeros(0), np.zeros(0)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.ceres.auto_select_solver_type = False
    solver = options.ceres.solver_options
    # Ceres' own defaults, not COLMAP's, which stop later.
    solver.function_tolerance, solver.num_threads, solver.max_num_iterations = 1e-6, 1, 50
    solver.linear_solver_type = type(solver.linear_solver_type).DENSE_SCHUR
    solver.minimizer_progress_to_stdout = False
    poses, points, measurements, mask = (np.asarray(leaf, float) for leaf in jax.tree.leaves(data))
    pinhole = [float(value) for value in (stereo.camera.fx, stereo.camera.fy, stereo.camera.cx, stereo.camera.cy)]
    seconds, costs, processor = [], [], 0.0
    for k in range(windows):
        model = reconstruction(poses[k], points[k], measurements[k, ..., :2], mask[k] > 0, pinhole)
        config = pycolmap.BundleAdjustmentConfig()
        for image in model.images:
            config.add_image(image)
        for frame in (1, 2):
            config.set_constant_rig_from_world_pose(frame)
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
        before = time.process_time()
        summary: Any = adjuster.solve()
        summary = summary.ceres_summary
        processor += time.process_time() - before
        seconds.append(summary.total_time_in_seconds)
        costs.append(summary.final_cost + summary.fixed_cost)
    print(f"Ceres' processor time, with COLMAP's reading of it: {processor / windows * 1e6:.0f} µs a window")
    return np.array(seconds), np.array(costs)


def reconstruction(poses: np.ndarray, points: np.ndarray, pixels: np.ndarray, mask: np.ndarray, pinhole: list) -> Any:
    """A window as a COLMAP model."""
    import pycolmap

    model = pycolmap.Reconstruction()
    fx, fy, cx, cy = pinhole
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=240, params=[fx, fy, cx + 0.5, cy + 0.5], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for i, (pose, seen) in enumerate(zip(poses, mask, strict=True)):
        world_from_cam = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[[1, 2, 3, 0]]), pose[4:])
        keypoints = pixels[i, seen] + 0.5
        image = pycolmap.Image(name=f"{i}", keypoints=keypoints, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, world_from_cam.inverse())
    for j in np.flatnonzero(mask.any(0)):
        track = pycolmap.Track()
        for i in np.flatnonzero(mask[:, j]):
            track.add_element(int(i) + 1, int(mask[i, :j].sum()))
        model.add_point3D(points[j], track)
    return model


def large_window(dtype: Any) -> None:
    data, stereo = simulate(1, 10, 1000, 1, dtype)
    poses, points, measurements, mask = jax.tree.map(lambda leaf: leaf[0], data)
    # Five of the ten keyframes for every landmark, on average.
    kept = np.random.default_rng(0).uniform(size=mask.shape) < 5000 / float(jnp.sum(mask))
    mask = mask & jnp.asarray(kept)
    options = LMOptions(max_steps=6, tolerance=0.0)  # the first evaluation is the start: five steps

    def adjust(poses: SE3, points: Any, measurements: Any, mask: Any) -> Any:
        found = adjust_window(poses, points, measurements, mask, stereo, loss=Squared(), options=options)
        return found.world_from_cam, found.points_world, found.pose_covariances, found.cost

    print(f"10 keyframes × 1000 landmarks, {int(jnp.sum(mask))} stereo measurements, {jnp.dtype(dtype).name}:")
    report("five iterations of adjust_window, covariances included", adjust, poses, points, measurements, mask)
    anchored = jax.jit(
        lambda *data: window_module.anchored(*data, stereo, sigma_px=1.0, fixed=None, prior=None)  # type: ignore[misc]
    )
    state, window_data = anchored(poses, points, measurements, mask)
    blocks = report("  residuals and derivatives", lambda s, d: linearize(s, d, Squared()), state, window_data)
    system = report("  normal equations", normal_equations, blocks)
    report("  elimination and Cholesky", reduce, system)
    report("  the same and back substitution", solve, system)


def report(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    compiled = jax.jit(function)
    start = time.perf_counter()
    result = jax.block_until_ready(compiled(*arguments))
    first = time.perf_counter() - start
    median, best = time_calls(lambda: jax.block_until_ready(compiled(*arguments)), seconds=1.0)
    print(f"{name}: median {median * 1e3:.2f} ms, best {best * 1e3:.2f} ms, first call {first:.1f} s", flush=True)
    return result


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--windows", type=int, default=1000)
    parser.add_argument("--ceres", type=int, default=200)
    parser.add_argument("--float32", action="store_true")
    arguments = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", 2)
    jax.config.update("jax_enable_x64", True)
    print(describe_machine())
    dtype = jnp.float32 if arguments.float32 else jnp.float64
    small_windows(arguments.windows, arguments.ceres, dtype)
    large_window(dtype)


if __name__ == "__main__":
    main()
