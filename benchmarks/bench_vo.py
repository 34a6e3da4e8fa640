"""Stereo odometry on the KITTI 06 clip: accuracy, speed, where the time goes, with and without the window.

VOJAX_DATA=… python benchmarks/bench_vo.py
"""

import os
import statistics
import time

import numpy as np
from _timing import describe_machine

from vojax.datasets import KittiSequence
from vojax.features import DetectorOptions, detect, match_stereo_rows, track
from vojax.metrics import Trajectory, evaluate
from vojax.odometry import MotionOptions, StereoOdometry, StereoOdometryOptions

VARIANTS = {
    "default": StereoOdometryOptions(),
    "with window": StereoOdometryOptions(window=True),
    "without self-calibration": StereoOdometryOptions(motion=MotionOptions(self_calibrate=False)),
    "window, no calibration": StereoOdometryOptions(window=True, motion=MotionOptions(self_calibrate=False)),
}


def trajectory(times: np.ndarray, poses: np.ndarray) -> Trajectory:
    full = np.tile(np.eye(4), (len(poses), 1, 1))
    full[:, :3] = poses[:, :3]
    return Trajectory(times, full)


def main() -> None:
    sequence = KittiSequence(os.environ["VOJAX_DATA"] + "/kitti", "06")
    truth = trajectory(sequence.times, sequence.poses)
    print(describe_machine())
    print(f"{'variant':26s} drift %  ATE m   RPE m   RPE °   frames/s  inliers  bridged")
    for name, options in VARIANTS.items():
        odometry = StereoOdometry(sequence.stereo, options)
        poses, inliers, bridged, seconds = [], [], 0, []
        for k in range(len(sequence)):
            start = time.perf_counter()
            estimate = odometry.step(*sequence.images(k))
            seconds.append(time.perf_counter() - start)
            poses.append(estimate.world_from_cam)
            inliers.append(estimate.num_inliers)
            bridged += estimate.bridged
        m = evaluate(trajectory(sequence.times, np.array(poses)), truth)
        rate = (len(seconds) - 10) / sum(seconds[10:])
        print(
            f"{name:26s} {m.drift_percent:6.3f}  {m.ate_rmse_m:6.3f}  {m.rpe_trans_m:6.4f}  {m.rpe_rot_deg:6.4f}"
            f"  {rate:7.1f}  {statistics.mean(inliers[1:]):7.0f}  {bridged:6d}"
        )
    budget(sequence)


def budget(sequence: KittiSequence) -> None:
    """Time of each stage of the front end, on its own."""
    left, right = sequence.images(0)
    following, _ = sequence.images(1)
    options = StereoOdometryOptions()
    keypoints = detect(left, DetectorOptions(max_features=options.detector.max_features)).pixels
    stages = {
        "read a pair": lambda: sequence.images(0),
        "track": lambda: track(left, following, keypoints, options.tracker),
        "detect": lambda: detect(left, options.detector),
        "match stereo": lambda: match_stereo_rows(left, right, keypoints, options.matcher),
    }
    for name, stage in stages.items():
        stage()
        times = []
        for _ in range(9):
            start = time.perf_counter()
            stage()
            times.append(time.perf_counter() - start)
        print(f"{name:14s} {1e3 * statistics.median(times):6.1f} ms")


if __name__ == "__main__":
    main()
