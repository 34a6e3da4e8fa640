"""What more stereo pairs on one rig are worth: the drift of simulated drives by what the rig looks at.

python benchmarks/study_rig.py [--seeds 8] [--frames 120]

A street 24 m wide with points on its fronts and on the ground, 0.8 m a frame on an arc of 60 m, 640×480 px with a
focal length of 400 px, a baseline of 0.5 m, and pixels good to 0.25 px in every image. At most 300 features a pair,
followed as long as they are seen. The disparities are right, so that self-calibration has nothing to find.
"""

import argparse

import jax.numpy as jnp
import numpy as np
from _timing import describe_machine

from vojax.cameras import Pinhole, RectifiedStereo
from vojax.lie import SE3, SO3
from vojax.metrics import Trajectory, evaluate
from vojax.odometry import MotionOptions, RigOdometry, StereoOdometryOptions

PAIR = RectifiedStereo(Pinhole(fx=400.0, fy=400.0, cx=319.5, cy=239.5), baseline=0.5)
SIZE = np.array([640, 480])
NOISE_PX = 0.25
HEADINGS_DEG = {
    "ahead": [0.0],
    "ahead, the same pair twice": [0.0, 0.0],
    "ahead and back": [0.0, 180.0],
    "ahead and right": [0.0, 90.0],
    "ahead, right, back and left": [0.0, 90.0, 180.0, 270.0],
}


def drive(frames: int) -> np.ndarray:
    step = np.asarray(SE3.exp(jnp.array([0.0, 0.0, 0.8, 0.0, 0.8 / 60.0, 0.0])).as_matrix(), np.float64)
    poses = [np.eye(4)]
    for _ in range(frames - 1):
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def street(truth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points beside and below the path, and where it would go on."""
    n = 120 * len(truth)
    local = np.stack(
        [
            rng.choice([-12.0, 12.0], n) + rng.normal(0, 0.5, n),
            rng.uniform(-6.0, 1.6, n),
            rng.uniform(-8.0, 8.0, n),
        ],
        axis=1,
    )
    ground = rng.uniform(size=n) < 0.2
    local[ground] = np.stack([rng.uniform(-10, 10, ground.sum()), np.full(ground.sum(), 1.6), local[ground, 2]], 1)
    ahead = [truth[-1] @ np.linalg.matrix_power(np.linalg.inv(truth[0]) @ truth[1], k) for k in range(0, 60, 8)]
    places = np.concatenate([truth, ahead])[rng.integers(0, len(truth) + len(ahead), n)]
    return np.einsum("nij,nj->ni", places[:, :3, :3], local) + places[:, :3, 3]


def measure(points: np.ndarray, left_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    local = points @ left_from_world[:3, :3].T + left_from_world[:3, 3]
    rows = np.flatnonzero((local[:, 2] > 2.0) & (local[:, 2] < 60.0))
    x, y, z = local[rows].T
    measured = np.stack([400 * x / z + 319.5, 400 * y / z + 239.5, 400 * (x - 0.5) / z + 319.5], axis=1)
    inside = np.all((measured[:, :2] > 0) & (measured[:, :2] < SIZE), axis=1) & (measured[:, 2] > 0)
    return rows[inside], measured[inside]


def run(headings: list[float], frames: int, seed: int, self_calibrate: bool) -> tuple[float, float]:
    rng = np.random.default_rng(seed)
    truth = drive(frames)
    points = street(truth, rng)
    turns = SO3.exp(jnp.array([[0.0, -np.radians(a), 0.0] for a in headings]))
    left_from_rig = SE3.from_rotation_and_translation(turns, jnp.zeros((len(headings), 3)))
    mounts = np.asarray(left_from_rig.as_matrix(), np.float64)
    options = StereoOdometryOptions(motion=MotionOptions(self_calibrate=self_calibrate))
    odometry = RigOdometry([PAIR] * len(headings), left_from_rig, options, seed=seed)
    followed: list[set[int]] = [set() for _ in headings]
    poses = []
    for pose in truth:
        ids, measurements = [], []
        for k, mount in enumerate(mounts):
            rows, exact = measure(points, mount @ np.linalg.inv(pose))
            old = np.array([r in followed[k] for r in rows], bool)
            order = np.concatenate([np.flatnonzero(old), rng.permutation(np.flatnonzero(~old))])[:300]
            followed[k] = set(rows[order].tolist())
            ids.append(rows[order])
            measurements.append(exact[order] + NOISE_PX * rng.normal(size=(len(order), 3)))
        poses.append(odometry.step_tracks(ids, measurements, NOISE_PX * 2**0.5).world_from_cam)
    times = np.arange(frames, dtype=float)
    metrics = evaluate(Trajectory(times, np.stack(poses)), Trajectory(times, truth))
    return metrics.drift_percent, metrics.rpe_rot_deg


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--frames", type=int, default=120)
    arguments = parser.parse_args()
    print(describe_machine(), "\n")
    print("Drift at the end in %: median (least to most); rotation from frame to frame in degrees.\n")
    print("| pairs look | drift | rotation | drift, self-calibrated | rotation |\n|---|---|---|---|---|")
    for name, headings in HEADINGS_DEG.items():
        cells = []
        for self_calibrate in (False, True):
            seeds = range(arguments.seeds)
            drift, turn = np.transpose([run(headings, arguments.frames, seed, self_calibrate) for seed in seeds])
            cells.append(f"{np.median(drift):.3f} ({drift.min():.3f}–{drift.max():.3f}) | {np.median(turn):.4f}")
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
