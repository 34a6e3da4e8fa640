"""The monocular pipelines on a sequence in KITTI's layout: accuracy after a similarity, frames per second, losses.

    VOJAX_DATA=... python benchmarks/bench_mono.py
    python benchmarks/bench_mono.py --lap 500       # the rendered lap with blur, exposure changes and a car ahead

Rates are over the steps after the first thirty frames, image reading left out; every pipeline runs in this one process,
with the compiled programs of those before it.
"""

import argparse
import os
import pathlib
import time

import jax
import numpy as np

import vojax
from vojax.datasets import KittiSequence, SyntheticStereoSequence
from vojax.metrics import Trajectory, evaluate
from vojax.odometry import PIPELINES

_WARM = 30


def run(sequence, name: str, window: bool, frames: int, seed: int) -> str:
    """Run a pipeline and make a row of it."""
    odometry = PIPELINES[name].odometry(sequence.camera, PIPELINES[name].options(window=window), seed=seed)
    poses, seconds, bridged, restarts = [], [], 0, 0
    for k in range(frames):
        image, _ = sequence.images(k)
        start = time.perf_counter()
        estimate = odometry.step(image)
        seconds.append(time.perf_counter() - start)
        bridged += estimate.bridged
        restarts += vojax.odometry.Flag.restarted in estimate.flags
        if not estimate.pending:
            poses += [*estimate.earlier, estimate.world_from_cam]
    truth = np.tile(np.eye(4), (len(poses), 1, 1))
    truth[:, :3] = sequence.poses[: len(poses)]
    times = sequence.times[: len(poses)]
    metrics = evaluate(Trajectory(times, np.stack(poses)), Trajectory(times, truth), "sim3")
    rate = 1.0 / np.mean(seconds[_WARM:])
    return (
        f"| {sequence.name} | {name} | {'on' if window else 'off'} | {metrics.ate_rmse_m:.2f} | "
        f"{metrics.drift_percent:.1f} | {metrics.rpe_rot_deg:.3f} | {rate:.0f} | {len(poses)}/{frames} | {bridged} | "
        f"{restarts} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--lap", type=int, metavar="FRAMES", help="the rendered lap instead of the KITTI 00 clip")
    parser.add_argument("--pipelines", nargs="+", default=["mono-3d2d", "mono-2d2d", "planar-1pt"])
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.lap:
        sequence = SyntheticStereoSequence(
            frames=arguments.lap, lap=True, shutter=0.3, lighting_amplitude=0.5, moving_cars=1
        )
    else:
        root = os.environ.get("VOJAX_DATA")
        if root is None:
            parser.error("VOJAX_DATA is not set: expected the folder that holds kitti/")
        sequence = KittiSequence(pathlib.Path(root) / "kitti", "00", stereo=False)
    print(f"vojax {vojax.__version__}, jax {jax.__version__}, {jax.default_backend()}, {os.cpu_count()} cores\n")
    print(
        "| sequence | pipeline | window | ATE after Sim3, m | drift, % | RPE rotation, ° | frames/s | poses | bridged "
        "| new starts |"
    )
    print("|---|---|---|---:|---:|---:|---:|---:|---:|---:|")
    for name in arguments.pipelines:
        for window in (True, False):
            print(run(sequence, name, window, len(sequence), arguments.seed), flush=True)


if __name__ == "__main__":
    main()
