"""Pipelines on a sequence in KITTI's layout or on the rendered lap: accuracy, frames per second, losses, memory.

    VOJAX_DATA=... python benchmarks/bench_sequences.py --windows on off  # one camera, KITTI 00
    VOJAX_DATA=... python benchmarks/bench_sequences.py --sequence 06 --pipelines stereo-3d2d --features orb
    python benchmarks/bench_sequences.py --lap 500 --pipelines stereo-3d2d stereo-3d3d     # blur, lighting, a car ahead
    python benchmarks/bench_sequences.py --lap 500 --frames 10000 --pipelines stereo-3d2d  # back and forth

Rates are over the steps after the first thirty frames, image reading left out; every pipeline runs in this one process,
with the compiled programs of those before it.
"""

import argparse
import functools
import os
import pathlib
import time

import numpy as np
from _timing import describe_machine

from vojax.cli._timing import peak_memory_mb
from vojax.datasets import KittiSequence, SyntheticStereoSequence
from vojax.features import DescriptorOptions
from vojax.metrics import Trajectory, evaluate
from vojax.odometry import PIPELINES, Flag

_WARM = 30


def run(sequence, order, name, window, features, seed) -> str:
    """Run a pipeline over the frames in that order and make a row of it."""
    pipeline = PIPELINES[name]
    settings = {} if window == "auto" else {"window": window == "on"}
    if features != "corners":
        settings["detector"] = DescriptorOptions(kind=features)
    pair = pipeline.images == "pair"
    options = pipeline.options(**settings)
    odometry = pipeline.odometry(sequence.stereo if pair else sequence.camera, options, seed=seed)
    poses, seconds, bridged, restarts, early = [], [], 0, 0, 0.0
    for count, k in enumerate(order):
        images = sequence.images(k)
        start = time.perf_counter()
        estimate = odometry.step(*images) if pair else odometry.step(images[0])
        seconds.append(time.perf_counter() - start)
        bridged += estimate.bridged
        restarts += Flag.restarted in estimate.flags
        if not estimate.pending:
            poses += [*estimate.earlier, estimate.world_from_cam]
        if count == len(order) // 10:
            early = peak_memory_mb() or np.nan
    truth = np.tile(np.eye(4), (len(poses), 1, 1))
    truth[:, :3] = sequence.poses[order[: len(poses)]]
    times = np.arange(len(poses), dtype=float)
    metrics = evaluate(
        Trajectory(times, np.stack(poses)), Trajectory(times, truth), "none" if pipeline.scale else "sim3"
    )
    return (
        f"| {sequence.name} | {name} | {features} | {'on' if options.window else 'off'} | {metrics.alignment} | "
        f"{metrics.ate_rmse_m:.2f} | {metrics.drift_percent:.2f} | {metrics.rpe_rot_deg:.3f} | "
        f"{1.0 / np.mean(seconds[_WARM:]):.0f} | {len(poses)}/{len(order)} | {bridged} | {restarts} | "
        f"{early:.0f}, {peak_memory_mb() or np.nan:.0f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequence", default="00", help="of KITTI")
    parser.add_argument("--lap", type=int, metavar="FRAMES", help="the rendered lap instead")
    parser.add_argument("--frames", type=int, help="back and forth where there are fewer")
    parser.add_argument("--pipelines", nargs="+", default=["mono-3d2d", "mono-2d2d", "planar-1pt"])
    parser.add_argument("--windows", nargs="+", default=["auto"], choices=["auto", "on", "off"])
    parser.add_argument("--features", nargs="+", default=["corners"])
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.lap:
        sequence = SyntheticStereoSequence(
            frames=arguments.lap, lap=True, shutter=0.3, lighting_amplitude=0.5, moving_cars=1
        )
        sequence.images = functools.cache(sequence.images)  # rendering takes longer than everything else
    else:
        root = os.environ.get("VOJAX_DATA")
        if root is None:
            parser.error("VOJAX_DATA is not set: expected the folder that holds kitti/")
        stereo = any(PIPELINES[name].images == "pair" for name in arguments.pipelines)
        sequence = KittiSequence(pathlib.Path(root) / "kitti", arguments.sequence, stereo=stereo)
    count, last = arguments.frames or len(sequence), len(sequence) - 1
    steps = np.arange(count)
    order = np.where(steps // last % 2 == 0, steps % last, last - steps % last) if count > len(sequence) else steps
    print(describe_machine())
    print(
        "| sequence | pipeline | features | window | alignment | ATE m | drift % | RPE ° | frames/s | poses | bridged "
        "| new starts | MB after a tenth, at the end |"
    )
    print("|---|---|---|---|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name in arguments.pipelines:
        for window in arguments.windows:
            for features in arguments.features:
                print(run(sequence, order, name, window, features, arguments.seed), flush=True)


if __name__ == "__main__":
    main()
