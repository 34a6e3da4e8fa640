"""The keyframe rule: a frame is one when its distance to the last is more than some share of the mean depth.

Scaramuzza & Fraundorfer (2011) take 10 to 20 %. Shares from 0 (every frame that moved) to 40 % here, on KITTI 00 with
one camera and KITTI 06 with two, whose window is on: without it keyframes do not enter the motion.

    VOJAX_DATA=... python benchmarks/study_keyframes.py [--shares 0 0.05 ...] [--seeds 2] [--cases mono stereo rendered]

Times are those of the steps after the first thirty, reading and compilation left out; two numbers are the least and
the most over seeds. A frame that sees fewer than `min_shared` (60) landmarks of the last keyframe is one too, whatever
the share.
"""

import argparse
import functools
import os
import pathlib
import time
from typing import Any

import numpy as np
from _timing import describe_machine

from vojax.datasets import KittiSequence, SyntheticStereoSequence
from vojax.metrics import Trajectory, evaluate
from vojax.odometry import PIPELINES, KeyframeOptions

_WARM = 30


def run(sequence: Any, name: str, share: float, seed: int) -> tuple[float, float, float, int, int, float]:
    """ATE in m, drift at the end in %, RPE in °, keyframes, frames bridged, seconds a frame."""
    pipeline = PIPELINES[name]
    pair = pipeline.images == "pair"
    options = pipeline.options(window=True, keyframes=KeyframeOptions(distance_over_depth=share))
    odometry = pipeline.odometry(sequence.stereo if pair else sequence.camera, options, seed=seed)
    poses, seconds, keyframes, bridged = [], [], 0, 0
    for k in range(len(sequence)):
        images = sequence.images(k)
        start = time.perf_counter()
        estimate = odometry.step(*images) if pair else odometry.step(images[0])
        seconds.append(time.perf_counter() - start)
        keyframes, bridged = keyframes + estimate.keyframe, bridged + estimate.bridged
        if not estimate.pending:
            poses += [*estimate.earlier, estimate.world_from_cam]
    truth = np.tile(np.eye(4), (len(poses), 1, 1))
    truth[:, :3] = sequence.poses[: len(poses)]
    times = np.arange(len(poses), dtype=float)
    found = evaluate(Trajectory(times, np.stack(poses)), Trajectory(times, truth), "none" if pipeline.scale else "sim3")
    return found.ate_rmse_m, found.drift_percent, found.rpe_rot_deg, keyframes, bridged, float(np.mean(seconds[_WARM:]))


def main() -> None:
    """Print a row for each share."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shares", nargs="+", type=float, default=[0.0, 0.05, 0.1, 0.2, 0.4])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--frames", type=int, default=150, help="of the rendered street")
    parser.add_argument("--cases", nargs="+", default=["mono", "stereo"], choices=["mono", "stereo", "rendered"])
    arguments = parser.parse_args()
    root = os.environ.get("VOJAX_DATA")
    if root is None and set(arguments.cases) - {"rendered"}:
        parser.error("VOJAX_DATA is not set: expected the folder that holds kitti/")
    print(describe_machine())
    print("| sequence | pipeline | distance / depth | keyframes | ATE m | drift % | RPE ° | bridged | ms a frame |")
    print("|---|---|---:|---:|---:|---:|---:|---:|---:|")
    for case in arguments.cases:
        if case == "rendered":
            sequence: Any = SyntheticStereoSequence(frames=arguments.frames)
            sequence.images = functools.cache(sequence.images)  # rendering takes longer than everything else
        else:
            sequence = KittiSequence(
                pathlib.Path(str(root)) / "kitti", "00" if case == "mono" else "06", stereo=case == "stereo"
            )
        name = "mono-3d2d" if case == "mono" else "stereo-3d2d"
        for share in arguments.shares:
            runs = np.array([run(sequence, name, share, seed) for seed in range(arguments.seeds)])
            ate, drift, turn, keyframes, bridged, seconds = (
                "–".join(dict.fromkeys(form.format(scale * x) for x in (column.min(), column.max())))
                for column, form, scale in zip(
                    runs.T,
                    ("{:.2f}", "{:.2f}", "{:.3f}", "{:.0f}", "{:.0f}", "{:.0f}"),
                    (1, 1, 1, 1, 1, 1e3),
                    strict=True,
                )
            )
            print(
                f"| {sequence.name} | {name} | {share} | {keyframes} | {ate} | {drift} | {turn} | {bridged} | "
                f"{seconds} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
