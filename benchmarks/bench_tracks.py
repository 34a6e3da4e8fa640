"""Odometry from tracks without images: GTSAM's stereo tracks of KITTI 00, Sapienza's planar robot.

    VOJAX_DATA=... python benchmarks/bench_tracks.py

Rates are over the steps after the first ten frames. The robot sees as few as 14 landmarks, so ten inliers are enough
there.
"""

import os
import pathlib
import time

import numpy as np
from _timing import describe_machine

from vojax.datasets import read_planar_tracks, read_stereo_tracks
from vojax.metrics import Trajectory, evaluate
from vojax.odometry import MonoOdometry, MonoOdometryOptions, RigidMotionOptions, StereoOdometry, StereoOdometryOptions

_WARM = 10


def run(name, pipeline, step, frames, truth, alignment):
    """Take all frames and print a row."""
    poses, seconds, bridged = [], [], 0
    for k in range(frames):
        start = time.perf_counter()
        estimate = step(k)
        seconds.append(time.perf_counter() - start)
        bridged += estimate.bridged
        if not estimate.pending:
            poses += [*estimate.earlier, estimate.world_from_cam]
    times = np.arange(len(poses), dtype=float)
    path, true = Trajectory(times, np.stack(poses)), Trajectory(times, truth[: len(poses)])
    metrics, aligned = evaluate(path, true, alignment), evaluate(path, true, "se3" if alignment == "none" else "sim3")
    print(
        f"| {name} | {pipeline} | {alignment} | {metrics.ate_rmse_m:.3f} | {aligned.ate_rmse_m:.3f} | "
        f"{metrics.drift_percent:.2f} | {metrics.rpe_rot_deg:.3f} | {1.0 / np.mean(seconds[_WARM:]):.0f} | "
        f"{len(poses)}/{frames} | {bridged} |",
        flush=True,
    )


def homogeneous(poses):
    """[n, 3, 4] as [n, 4, 4]."""
    full = np.tile(np.eye(4), (len(poses), 1, 1))
    full[:, :3] = poses
    return full


def main() -> None:
    """Print the table."""
    data = pathlib.Path(os.environ["VOJAX_DATA"])
    print(describe_machine())
    print("| tracks | pipeline | alignment | ATE m | ATE aligned m | drift % | RPE ° | Hz | posed | bridged |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    stereo = read_stereo_tracks(data / "kitti00_stereo_tracks")
    truth = homogeneous(np.loadtxt(data / "trajectories" / "KITTI_00_gt.txt").reshape(-1, 3, 4)[: len(stereo)])
    for pipeline, motion in (("stereo-3d2d", None), ("stereo-3d3d", RigidMotionOptions())):
        options = StereoOdometryOptions() if motion is None else StereoOdometryOptions(motion=motion)
        odometry = StereoOdometry(stereo.stereo, options)

        def pair(k, odometry=odometry):
            rows = stereo.frame(k)
            return odometry.step_tracks(stereo.track_index[rows], stereo.measurements[rows])

        run("KITTI 00, 77 frames", pipeline, pair, len(stereo), truth, "none")

    def left(k, odometry):
        rows = stereo.frame(k)
        return odometry.step_tracks(stereo.track_index[rows], stereo.measurements[rows, :2])

    for pipeline, motion in (("mono-3d2d", "absolute"), ("mono-2d2d", "relative")):
        odometry = MonoOdometry(stereo.stereo.camera, MonoOdometryOptions(motion=motion))
        run("KITTI 00, left", pipeline, lambda k, o=odometry: left(k, o), len(stereo), truth, "sim3")

    planar = read_planar_tracks(data / "sapienza_pr_vo")
    for pipeline, motion in (("mono-3d2d", "absolute"), ("mono-2d2d", "relative"), ("planar-1pt", "planar")):
        odometry = MonoOdometry(planar.camera, MonoOdometryOptions(motion=motion, min_inliers=10))

        def view(k, odometry=odometry):
            rows = planar.frame(k)
            return odometry.step_tracks(planar.track_index[rows], planar.pixels[rows])

        run("Sapienza robot", pipeline, view, len(planar), homogeneous(planar.poses), "sim3")


if __name__ == "__main__":
    main()
