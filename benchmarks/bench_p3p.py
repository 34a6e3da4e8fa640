"""Time the P3P solver: nanoseconds per solve in a batch, beside PoseLib called once per problem.

    python benchmarks/bench_p3p.py --batch 100000 --repeats 30

Compile time is apart. The median counts on a quiet machine; on a busy one the minimum is an indication. `cpu` is the
processor time of all threads per solve, which a busy machine distorts less than wall time.
"""

import argparse
import statistics
import time

import jax
import numpy as np

from vojax.solvers import p3p


def problems(count, seed=0):
    """Points and unit bearings [count, 3, 3]: depths 1 to 10, a field of view of 70 degrees."""
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-0.7, 0.7, (count, 3, 2)), np.ones((count, 3, 1))], axis=-1)
    bearings = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    points_cam = bearings * rng.uniform(1.0, 10.0, (count, 3, 1))
    rotation, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    rotation *= np.linalg.det(rotation)[:, None, None]
    translation = rng.normal(size=(count, 1, 3))
    return np.einsum("bji,bnj->bni", rotation, points_cam - translation), bearings


def measure(function, arguments, repeats):
    """Compile seconds, then median and minimum wall seconds and minimum processor seconds of a call."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_seconds = time.perf_counter() - start
    jax.block_until_ready(compiled(*arguments))
    wall, processor = [], []
    for _ in range(repeats):
        start, start_processor = time.perf_counter(), time.process_time()
        jax.block_until_ready(compiled(*arguments))
        wall.append(time.perf_counter() - start)
        processor.append(time.process_time() - start_processor)
    return compile_seconds, statistics.median(wall), min(wall), min(processor)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=100_000, help="problems per call")
    parser.add_argument("--repeats", type=int, default=30, help="timed calls")
    options = parser.parse_args()
    points, bearings = problems(options.batch)
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}, batch {options.batch}, {options.repeats} repeats")
    print(f"{'':28s}{'median':>9s}{'min':>9s}{'cpu':>9s}  ns per solve{'compile':>12s}")
    for dtype in (np.float32, np.float64):
        for axis in (-1, 0):
            with jax.enable_x64(dtype is np.float64):
                arguments = [
                    jax.device_put(np.ascontiguousarray(np.moveaxis(x, 0, axis).astype(dtype)))
                    for x in (points, bearings)
                ]
                function = jax.vmap(p3p, in_axes=axis, out_axes=axis)
                compile_seconds, median, fastest, processor = measure(function, arguments, options.repeats)
            row = "".join(f"{x / options.batch * 1e9:9.0f}" for x in (median, fastest, processor))
            where = "last" if axis == -1 else "first"
            print(f"{f'vojax {dtype.__name__}, batch {where}':28s}{row}{'':14s}{compile_seconds:10.1f} s")
    try:
        import poselib
    except ImportError:
        print("PoseLib is not installed: no peer")
        return
    count = min(options.batch, 5000)
    pairs = [(list(f), list(x)) for f, x in zip(bearings[:count], points[:count], strict=True)]
    wall = []
    for _ in range(5):
        start = time.perf_counter()
        for f, x in pairs:
            poselib.p3p(f, x)
        wall.append((time.perf_counter() - start) / count * 1e9)
    print(f"{'PoseLib from Python':28s}{statistics.median(wall):9.0f}{min(wall):9.0f}")


if __name__ == "__main__":
    main()
