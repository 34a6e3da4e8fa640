"""Right images that are taken late: what that does to the path, and how well the rows of the matches tell.

VOJAX_DATA=… python benchmarks/study_synchrony.py [--frames 39]

The rendered street, its right pictures late by a share of the time between frames, and KITTI 06 as it is (left out
without VOJAX_DATA).
"""

import argparse
import os
from typing import Any

import numpy as np
from bench_vo import trajectory

from vojax.datasets import KittiSequence, SyntheticStereoSequence
from vojax.metrics import evaluate
from vojax.odometry import Flag, StereoOdometry

DELAYS = (0.0, 0.02, 0.05, 0.1, 0.2)


def follow(name: str, sequence: Any) -> None:
    odometry = StereoOdometry(sequence.stereo)
    estimates = [odometry.step(*sequence.images(k)) for k in range(len(sequence))]
    late, deviation = odometry.right_late
    poses = np.stack([e.world_from_cam for e in estimates])
    found = evaluate(trajectory(sequence.times, poses), trajectory(sequence.times, sequence.poses))
    flagged = sum(Flag.unsynchronised in e.flags for e in estimates)
    told = f"{100 * late:.1f} ± {100 * deviation:.1f}"
    print(f"| {name} | {told} | {found.drift_percent:.2f} | {flagged} of {len(estimates)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=39)
    arguments = parser.parse_args()
    print("| late, % of the time between frames | found, % | drift, % | frames flagged |\n|---|---|---|---|")
    for delay in DELAYS:
        street = SyntheticStereoSequence(frames=arguments.frames, right_late=delay)
        follow(f"street, {100 * delay:g}", street)
    if "VOJAX_DATA" in os.environ:
        follow("KITTI 06, none meant", KittiSequence(os.environ["VOJAX_DATA"] + "/kitti", "06"))


if __name__ == "__main__":
    main()
