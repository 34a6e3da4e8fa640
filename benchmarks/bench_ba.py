"""Bundle adjustment: Ladybug-49 beside Ceres (through pycolmap), and time and memory per observation by size.

python benchmarks/bench_ba.py [--sizes 10000,100000,1000000] [--float32]
"""

import argparse
import os
import pathlib
import resource
import tempfile
import time

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
from vojax.datasets._colmap import ColmapImage, ColmapModel, write_colmap
from vojax.lie import SE3


def run(name: str, problem: BundleProblem, options: LMOptions, repeats: int = 5, solver: str = "dense") -> None:
    """Compile, solve some times, print the median."""
    start = time.perf_counter()
    compiled = eqx.filter_jit(adjust_bundle).lower(problem, options=options, solver=solver).compile()
    compile_seconds = time.perf_counter() - start
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        found = jax.block_until_ready(compiled(problem, options=options, solver=solver))
        times.append(time.perf_counter() - start)
    iterations = int(found.iterations)
    print(
        f"{name}: ½Σr² {float(found.initial_cost):.2f} to {float(found.cost):.2f}, {iterations} iterations, "
        f"median {np.median(times):.3f} s, best {min(times):.3f} s, {np.median(times) / iterations * 1e3:.1f} ms an "
        f"iteration, compile {compile_seconds:.1f} s",
        flush=True,
    )


def ladybug(bal: BalProblem) -> BundleProblem:
    return bundle_problem(
        SE3(jnp.asarray(bal.cam_from_world)), bal.landmarks, bal.pixels, bal.camera_index, bal.landmark_index,
        bal.camera(), free_intrinsics=("focal", "k1", "k2"),
    )  # fmt: skip


def ceres(bal: BalProblem) -> None:
    """The same problem by COLMAP's bundle adjustment; it leaves out what is behind a camera."""
    try:
        import pycolmap
    except ImportError:
        print("Ceres: pycolmap is not installed")
        return
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
    model = ColmapModel(
        cameras, images, np.arange(1, p + 1), bal.landmarks, np.zeros((p, 3), np.uint8), np.zeros(p),
        [np.array(track) for track in tracks],
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        write_colmap(folder, model)
        reconstruction = pycolmap.Reconstruction(folder)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = True
    # Ceres' own defaults, not COLMAP's, which stop later.
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.solver_options.num_threads = 2
    start = time.perf_counter()
    pycolmap.bundle_adjustment(reconstruction, options)
    print(
        f"Ceres through pycolmap {pycolmap.__version__}, 2 threads: {time.perf_counter() - start:.2f} s in all",
        flush=True,
    )


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


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--sizes", default="10000,100000")
    parser.add_argument("--float32", action="store_true")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", not arguments.float32)
    print(describe_machine(), f"load {os.getloadavg()[0]:.1f}")
    root = os.environ.get("VOJAX_DATA")
    if root:
        bal = read_bal(pathlib.Path(root) / "bal" / "problem-49-7776-pre.txt")
        run("Ladybug-49", ladybug(bal), LMOptions(max_steps=50))
        run("Ladybug-49, conjugate gradients", ladybug(bal), LMOptions(max_steps=50), solver="iterative")
        ceres(bal)
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
