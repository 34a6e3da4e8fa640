"""Bundle adjustment: Ladybug-49 beside Ceres (through pycolmap), and time and memory per observation by size.

python benchmarks/bench_ba.py                                          # Ladybug-49 and Ceres in turns
python benchmarks/bench_ba.py --sizes 10000,100000,1000000             # time and memory too
python benchmarks/bench_ba.py --float32
python benchmarks/bench_ba.py --scaling 10000,30000,100000,300000,1000000   # docs/images/ba_scaling.png
"""

import argparse
import os
import pathlib
import resource
import tempfile
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine

from vojax.ba import LMOptions
from vojax.ba._bundle import adjust_bundle
from vojax.ba._bundle_problem import BundleProblem, bundle_problem
from vojax.cameras import Pinhole
from vojax.datasets._bal import BalProblem, read_bal
from vojax.datasets._colmap import ColmapBundle, ColmapImage, ColmapModel, read_colmap, write_colmap
from vojax.lie import SE3


def run(name: str, problem: BundleProblem, options: LMOptions, repeats: int = 5) -> None:
    """Compile, solve some times, print the median."""
    start = time.perf_counter()
    compiled = eqx.filter_jit(adjust_bundle).lower(problem, options=options).compile()
    compile_seconds = time.perf_counter() - start
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        found = jax.block_until_ready(compiled(problem, options=options))
        times.append(time.perf_counter() - start)
    iterations = int(found.iterations)
    print(
        f"{name}: ½Σr² {float(found.initial_cost):.2f} to {float(found.cost):.2f}, {iterations} iterations, "
        f"median {np.median(times):.3f} s, best {min(times):.3f} s, {np.median(times) / iterations * 1e3:.1f} ms an "
        f"iteration, compile {compile_seconds:.1f} s",
        flush=True,
    )


def ladybug(bal: BalProblem, solver: str = "auto") -> BundleProblem:
    return bundle_problem(
        SE3(jnp.asarray(bal.cam_from_world)), bal.landmarks, bal.pixels, bal.camera_index, bal.landmark_index,
        bal.camera(), free_intrinsics=("focal", "k1", "k2"), solver=solver,
    )  # fmt: skip


def colmap_model(bal: BalProblem) -> ColmapModel:
    """The problem as COLMAP has it; principal points at its (0.5, 0.5) are our zero."""
    images, tracks = [], [[] for _ in bal.landmarks]
    for k, pose in enumerate(bal.cam_from_world):
        mine = bal.camera_index == k
        seen = bal.landmark_index[mine] + 1
        images.append(ColmapImage(k + 1, pose, k + 1, f"{k}", bal.pixels[mine] + 0.5, seen))
        for index, number in enumerate(seen):
            tracks[number - 1].append((k + 1, index))
    cameras = {
        k + 1: ("RADIAL", 1000, 1000, np.array([f, 0.5, 0.5, k1, k2])) for k, (f, k1, k2) in enumerate(bal.intrinsics)
    }
    p = len(tracks)
    return ColmapModel(
        cameras, images, np.arange(1, p + 1), bal.landmarks, np.zeros((p, 3), np.uint8), np.zeros(p),
        [np.array(track) for track in tracks],
    )  # fmt: skip


def cost_in_front(bundle: ColmapBundle | BalProblem, camera: Any, group: np.ndarray) -> tuple[float, int]:
    """½Σr² over the observations in front of their camera, and how many are not."""
    points = SE3(jnp.asarray(bundle.cam_from_world)[bundle.camera_index]).apply(
        jnp.asarray(bundle.landmarks)[bundle.landmark_index]
    )
    own = jax.tree.map(lambda leaf: leaf[group[bundle.camera_index]] if jnp.ndim(leaf) else leaf, camera)
    error = own.project(points) - bundle.pixels
    front = points[:, 2] > 0
    return 0.5 * float(jnp.sum(jnp.where(front[:, None], error, 0.0) ** 2)), int(jnp.sum(~front))


def ceres(bal: BalProblem, tolerance: float, repeats: int) -> list[float]:
    """Solve the same problem by COLMAP's bundle adjustment, two threads; it leaves out what is behind a camera."""
    import pycolmap

    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        write_colmap(folder, colmap_model(bal))
        for _ in range(repeats):
            reconstruction = pycolmap.Reconstruction(folder)
            options = pycolmap.BundleAdjustmentOptions()
            options.print_summary = False
            options.ceres.solver_options.function_tolerance = tolerance
            options.ceres.solver_options.num_threads = 2
            options.ceres.min_num_residuals_for_cpu_multi_threading = 0
            config = pycolmap.BundleAdjustmentConfig()
            for number in reconstruction.images:
                config.add_image(number)
            adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
            start = time.perf_counter()
            summary = adjuster.solve()
            seconds.append(time.perf_counter() - start)
        reconstruction.write(folder)
        bundle = read_colmap(folder).bundle()
    cost, behind = cost_in_front(bundle, bundle.camera, bundle.camera_group)
    print(
        f"Ceres through pycolmap {pycolmap.__version__}, 2 threads, function tolerance {tolerance:g}: ½Σr² {cost:.2f} "
        f"in front ({behind} behind), median {np.median(seconds):.3f} s, best {min(seconds):.3f} s; "
        f"{summary.num_residuals} residuals",
        flush=True,
    )
    return seconds


def side_by_side(bal: BalProblem) -> None:
    """Ladybug-49 by vojax and by Ceres in turns, so that both see the same machine."""
    problem, options = ladybug(bal), LMOptions(max_steps=50)
    start = time.perf_counter()
    compiled = eqx.filter_jit(adjust_bundle).lower(problem, options=options).compile()
    print(f"compile {time.perf_counter() - start:.1f} s", flush=True)
    seconds: dict[str, list[float]] = {"vojax": [], "Ceres": []}
    for _ in range(3):
        for _ in range(2):
            start = time.perf_counter()
            found = jax.block_until_ready(compiled(problem, options=options))
            seconds["vojax"].append(time.perf_counter() - start)
        try:
            seconds["Ceres"] += ceres(bal, 1e-6, 1)  # Ceres' own default; COLMAP's goes on for longer
        except ImportError:
            print("Ceres: pycolmap is not installed")
            break
    after = bal.__class__(
        np.asarray(found.cam_from_world.wxyz_xyz), np.asarray(found.landmarks), bal.pixels, bal.camera_index,
        bal.landmark_index, bal.intrinsics,
    )  # fmt: skip
    cost, behind = cost_in_front(after, found.camera, np.arange(len(bal.cam_from_world)))
    vojax_median = np.median(seconds["vojax"])
    print(
        f"vojax, float64, {int(found.iterations)} iterations: ½Σr² {float(found.cost):.2f} over all, {cost:.2f} in "
        f"front ({behind} behind), median {vojax_median:.3f} s, best {min(seconds['vojax']):.3f} s",
        flush=True,
    )
    if seconds["Ceres"]:
        print(f"time of vojax over that of Ceres: {vojax_median / np.median(seconds['Ceres']):.2f}", flush=True)


def synthetic(observations: int) -> BundleProblem:
    """A drive past landmarks that six consecutive cameras see each; 50 cameras however many observations."""
    rng = np.random.default_rng(0)
    c, p = 50, observations // 6
    first = rng.integers(0, c - 5, size=p)
    landmarks = np.stack([first + rng.uniform(0, 5, p), rng.uniform(-3, 3, p), rng.uniform(5, 20, p)], axis=1)
    index, seen = (first[:, None] + np.arange(6)).ravel(), np.repeat(np.arange(p), 6)
    centres = np.stack([np.arange(c), np.zeros(c), np.zeros(c)], axis=1)
    local = landmarks[seen] - centres[index]
    pixels = 500 * local[:, :2] / local[:, 2:] + rng.normal(size=(len(seen), 2))
    poses = np.concatenate([np.tile([1.0, 0, 0, 0], (c, 1)), -centres + 0.02 * rng.normal(size=(c, 3))], axis=1)
    camera = Pinhole(fx=500.0, fy=500.0, cx=0.0, cy=0.0)
    start = landmarks + 0.05 * rng.normal(size=(p, 3))
    return bundle_problem(SE3(jnp.asarray(poses)), start, pixels, index, seen, camera, gauge="two_cameras")


def scaling(path: pathlib.Path, sizes: list[int]) -> None:
    """Time an iteration by the number of observations, and draw it beside a line of slope one."""
    from vojax.viz._figure import BLUE, INK, MUTED, new_figure, quiet_axes, save_figure

    options = LMOptions(max_steps=5, tolerance=0.0)
    rows = []
    for size in sizes:
        problem = synthetic(size)
        compiled = eqx.filter_jit(adjust_bundle).lower(problem, options=options).compile()
        times = []
        for _ in range(3):
            start = time.perf_counter()
            found = jax.block_until_ready(compiled(problem, options=options))
            times.append((time.perf_counter() - start) / int(found.iterations))
        rows.append((len(problem.measurements), 1e3 * min(times)))
        print(f"{rows[-1][0]} observations: {rows[-1][1]:.1f} ms an iteration", flush=True)
    x, y = np.array(rows).T
    slope = np.polyfit(np.log(x), np.log(y), 1)[0]
    figure = new_figure(5.0, 3.4)
    axes = figure.add_subplot()
    quiet_axes(axes)
    axes.loglog(x, y[-1] * x / x[-1], color=MUTED, linewidth=1.2, linestyle="--", label="proportional")
    axes.loglog(x, y, color=BLUE, marker="o", markersize=4, label=f"measured, exponent {slope:.2f}")
    axes.set_xlabel("observations (50 cameras)", color=INK)
    axes.set_ylabel("ms an iteration", color=INK)
    axes.legend(frameon=False)
    save_figure(figure, path)
    print(f"exponent {slope:.3f}; {path}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--sizes", default="")
    parser.add_argument("--float32", action="store_true")
    parser.add_argument("--scaling", default="", help="sizes to draw docs/images/ba_scaling.png for, '10000,...'")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("docs/images/ba_scaling.png"))
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", not arguments.float32)
    print(describe_machine(), f"load {os.getloadavg()[0]:.1f}")
    if arguments.scaling:
        scaling(arguments.out, [int(size) for size in arguments.scaling.split(",")])
        return
    root = os.environ.get("VOJAX_DATA")
    if root:
        bal = read_bal(pathlib.Path(root) / "bal" / "problem-49-7776-pre.txt")
        if not arguments.float32:
            side_by_side(bal)
        else:
            run("Ladybug-49", ladybug(bal), LMOptions(max_steps=50))
        run("Ladybug-49, conjugate gradients", ladybug(bal, "iterative"), LMOptions(max_steps=50))
    before = None
    for size in map(int, filter(None, arguments.sizes.split(","))):
        run(f"{size} observations", synthetic(size), LMOptions(max_steps=5, tolerance=0.0), repeats=3)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        if before is not None:
            print(
                f"  peak memory rose by {(peak - before[1]) / (size - before[0]):.0f} bytes an observation", flush=True
            )
        before = (size, peak)


if __name__ == "__main__":
    main()
