"""What the truth of the KITTI 06 clip is worth at its start: rotations between frames by SIFT matches and an essential
matrix, which share nothing with the pipeline, against those of the truth and of `stereo-3d2d`.

    VOJAX_DATA=... python benchmarks/study_kitti06_truth.py
"""

import os
import pathlib

import jax
import numpy as np
from _timing import describe_machine
from scipy.spatial.transform import Rotation

from vojax import estimate_relative_pose
from vojax.datasets import KittiSequence
from vojax.features import DescriptorOptions, describe, match_descriptors, to_gray
from vojax.odometry import StereoOdometry

PAIRS = ((0, 5), (0, 10), (5, 10), (5, 15), (10, 20), (20, 30), (30, 40), (40, 50))
STARTS = (0, 2, 4, 6, 8, 10, 12, 15)


def homogeneous(poses):
    full = np.tile(np.eye(4), (len(poses), 1, 1))
    full[:, :3] = poses
    return full


def between(poses, a, b):
    return np.linalg.inv(poses[b]) @ poses[a]  # cam_b_from_cam_a


def main() -> None:
    """Print both tables."""
    sequence = KittiSequence(pathlib.Path(os.environ["VOJAX_DATA"]) / "kitti", "06")
    truth = homogeneous(sequence.poses)
    odometry = StereoOdometry(sequence.stereo)
    path = np.stack([odometry.step(*sequence.images(k)).world_from_cam for k in range(len(sequence))])
    options = DescriptorOptions(max_features=4000, max_ratio=0.75, radius_px=1e4)
    camera = sequence.stereo.camera
    print(describe_machine())
    print("Rotation of the truth, and of stereo-3d2d, after that of the essential matrix, degrees about x, y, z\n")
    print("| frames | matches that agree | truth | stereo-3d2d |\n|---|---:|---|---|")
    for a, b in PAIRS:
        first, second = (describe(to_gray(sequence.images(k)[0]), options) for k in (a, b))
        matches = match_descriptors(first, second, options)
        u, v = np.zeros((2048, 2), np.float32), np.zeros((2048, 2), np.float32)
        n = len(matches.rows0)
        u[:n], v[:n] = first.pixels[matches.rows0], second.pixels[matches.rows1]
        found = estimate_relative_pose(u, v, camera, camera, mask=np.arange(2048) < n, key=jax.random.key(0))
        rotation = np.asarray(found.model.rotation().as_matrix(), np.float64)
        cells = []
        for poses in (truth, path):
            difference = rotation.T @ between(poses, a, b)[:3, :3]
            cells.append(" ".join(f"{x:+.2f}" for x in Rotation.from_matrix(difference).as_rotvec(degrees=True)))
        print(f"| {a} to {b} | {int(found.num_inliers)} | {cells[0]} | {cells[1]} |", flush=True)
    print("\n| compared from frame | drift at the end % |\n|---|---:|")
    for a in STARTS:
        true, estimated = (np.linalg.inv(poses[a]) @ poses[a:] for poses in (truth, path))
        length = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
        print(f"| {a} | {100 * np.linalg.norm(true[-1, :3, 3] - estimated[-1, :3, 3]) / length:.2f} |")


if __name__ == "__main__":
    main()
