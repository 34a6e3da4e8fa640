"""Relative pose, one problem at a time: accuracy and time beside PoseLib on the same problems.

f = 800 px, 1280×960, 1 px of noise, uniform outliers, threshold 1.5 px, float32; PoseLib in float64 with its defaults.

python benchmarks/bench_robust.py [--problems 200]
"""

import argparse
import time

import jax
import numpy as np
import poselib
from _timing import describe_machine

from vojax import estimate_relative_pose
from vojax.datasets import simulate_relative_pose

THRESHOLD_PX = 1.5


def errors_deg(rotations, translations, truth):
    """The larger of the angular errors of rotation and translation."""
    chord = np.linalg.norm(rotations - truth[:, :3, :3], axis=(1, 2)) / 8**0.5
    direction = truth[:, :3, 3] / np.linalg.norm(truth[:, :3, 3], axis=1, keepdims=True)
    cosine = np.sum(direction * translations, axis=1) / np.linalg.norm(translations, axis=1)
    return np.degrees(np.maximum(2 * np.arcsin(np.clip(chord, 0, 1)), np.arccos(np.clip(cosine, -1, 1))))


def areas(errors):
    """Area under the recall curve up to five degrees, of each problem."""
    return np.clip(1.0 - errors / 5.0, 0.0, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=200)
    count = parser.parse_args().problems
    print(describe_machine())
    print("| n, outliers | vojax AUC@5° | PoseLib | difference (95 %) | vojax, ms | PoseLib, ms | compile, s |")
    print("|---|---|---|---|---|---|---|")
    for n in (200, 1000):
        for share in (0.3, 0.5, 0.7):
            row(n, share, count)


def row(n: int, share: float, count: int) -> None:
    """Print one line of the table."""
    keys = jax.random.split(jax.random.key(int(100 * share) + n), count)
    problems = jax.jit(jax.vmap(lambda key: simulate_relative_pose(key, n, outlier_fraction=share, sigma_px=1.0)))(keys)
    camera = simulate_relative_pose(keys[0], n).camera
    solve = jax.jit(lambda a, b, key: estimate_relative_pose(a, b, camera, camera, key=key))
    start = time.perf_counter()
    compiled = solve.lower(problems.pixels0[0], problems.pixels1[0], keys[0]).compile()
    compile_seconds = time.perf_counter() - start
    size = {"model": "PINHOLE", "width": 1280, "height": 960, "params": [800.0, 800.0, 639.5, 479.5]}
    poses, peers, ours_ms, theirs_ms = [], [], [], []
    for i in range(count):
        pixels0, pixels1 = problems.pixels0[i], problems.pixels1[i]
        start = time.perf_counter()
        found = jax.block_until_ready(compiled(pixels0, pixels1, keys[i]))
        ours_ms.append(1e3 * (time.perf_counter() - start))
        poses.append(np.asarray(found.model.as_matrix(), float))
        first, second = np.asarray(pixels0, float), np.asarray(pixels1, float)
        start = time.perf_counter()
        pose, _ = poselib.estimate_relative_pose(first, second, size, size, {"max_epipolar_error": THRESHOLD_PX}, {})
        theirs_ms.append(1e3 * (time.perf_counter() - start))
        peers.append(pose)
    truth = np.asarray(problems.cam1_from_cam0.as_matrix(), float)
    stacked = np.stack(poses)
    ours = areas(errors_deg(stacked[:, :3, :3], stacked[:, :3, 3], truth))
    theirs = areas(errors_deg(np.stack([p.R for p in peers]), np.stack([p.t for p in peers]), truth))
    rng = np.random.default_rng(0)
    paired = [(ours - theirs)[rng.integers(0, count, count)].mean() for _ in range(1000)]
    low, high = np.quantile(paired, [0.025, 0.975])
    print(
        f"| {n}, {share:.0%} | {ours.mean():.4f} | {theirs.mean():.4f} | {low:+.4f} to {high:+.4f} "
        f"| {np.median(ours_ms):.1f} | {np.median(theirs_ms):.1f} | {compile_seconds:.1f} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
