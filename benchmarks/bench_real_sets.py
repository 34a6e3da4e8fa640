"""Robust estimators on real correspondences, beside PoseLib, OpenCV and COLMAP: accuracy and time over many keys.

VOJAX_DATA=/data python benchmarks/bench_real_sets.py [--parts fundamental homography …] [--keys 20]

fundamental   28 pairs. 14 have validation points, which no method sees: the error is their median Sampson distance. The
              others have labelled structures: the error is the median Sampson distance of the best one. AUC@2 px.
              "noise measured" is vojax twice, the second time with the noise that the first estimate leaves.
homography    16 pairs with 8 validation points, the error is their median transfer distance. AUC@5 px.
essential     the fountain, its two cameras: matches within 1.5 px.
rigid         4,138 pairs of points, 9 % of them right: in how many keys the given motion is found (2°, 10 cm),
              and how many pairs lie within 5 cm: of the given motion 375, so it is not the best.
stereo        76 pairs of stereo frames: pose of the left camera from points and pixels, and of the rig from both
              images' pixels, against the truth.
checkerboard  210 views of 12 corners: RMS in pixels.

All with the same thresholds: 1.5 px (epipolar), 3 px (pixels), 0.05 m (rigid). Times are medians of one call after
compilation. PoseLib and COLMAP are given the key as their seed; OpenCV's generator is seeded with it.
"""

import argparse
import os
import pathlib
import time
from collections.abc import Callable
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pycolmap
from _timing import describe_machine

from vojax import robust
from vojax.cameras import Pinhole, Rig
from vojax.datasets import read_stereo_tracks
from vojax.geometry import sampson_error
from vojax.lie import SE3

PEERS = ("vojax", "PoseLib", "OpenCV", "COLMAP")
Methods = dict[str, Callable[..., np.ndarray | None]]


def folder(*parts: str) -> pathlib.Path:
    root = os.environ.get("VOJAX_DATA")
    if not root:
        raise SystemExit("bench_real_sets: set VOJAX_DATA to the folder of the data sets")
    return pathlib.Path(root, *parts)


def compare(methods: Methods, data: tuple[Any, ...], keys: int, error: Callable[[np.ndarray], float]) -> dict[str, Any]:
    """Errors of the keys, and the median milliseconds; a first call of each method is not counted."""
    outcome = {}
    for name, method in methods.items():
        method(*data, 0)
        errors, times = [], []
        for k in range(keys):
            begin = time.perf_counter()
            found = method(*data, k)
            times.append(1e3 * (time.perf_counter() - begin))
            found = as_matrix(found)
            errors.append(np.inf if found is None or not np.all(np.isfinite(found)) else error(found))
        outcome[name] = (np.array(errors), float(np.median(times)))
    return outcome


def table(outcomes: dict[str, dict[str, Any]], reach: float, unit: str) -> None:
    """A line for each set and one for all of them."""
    names = list(next(iter(outcomes.values())))
    print(f"| set | median error, {unit}: {' | '.join(names)} | ms: {' | '.join(names)} |")
    print("|---" * (1 + 2 * len(names)) + "|")
    for label, outcome in outcomes.items():
        cells = [*(f"{np.median(e):.2f}" for e, _ in outcome.values()), *(f"{t:.1f}" for _, t in outcome.values())]
        print(f"| {label} | " + " | ".join(cells) + " |")
    area = {
        name: np.concatenate([np.clip(1 - outcome[name][0] / reach, 0, 1) for outcome in outcomes.values()])
        for name in names
    }
    times = [np.mean([outcome[name][1] for outcome in outcomes.values()]) for name in names]
    cells = [*(f"{a.mean():.3f}" for a in area.values()), *(f"{t:.1f}" for t in times)]
    print(f"| **AUC@{reach:g} {unit}, mean ms** | " + " | ".join(cells) + " |")
    rng = np.random.default_rng(0)
    print()
    for name in [name for name in ("vojax", "noise measured") if name in names]:
        difference = area[name] - area["PoseLib"]
        means = [difference[rng.integers(0, len(difference), len(difference))].mean() for _ in range(2000)]
        interval = np.quantile(means, [0.025, 0.975]).round(4)
        print(f"{name} − PoseLib over {len(difference)} pairs and keys: {interval}\n")


def rows_of(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows = np.loadtxt(path)
    return rows[:, :2], rows[:, 3:5], rows[:, 6].astype(int)


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(2 * np.degrees(np.arcsin(min(np.linalg.norm(a - b) / 8**0.5, 1.0))))


def model_of(estimate: Any) -> Any:
    return jax.block_until_ready(estimate).model


def as_matrix(found: Any) -> np.ndarray | None:
    """What a method found as a matrix, outside of what is timed: vojax's poses are objects."""
    return np.asarray(found.as_matrix())[:3] if hasattr(found, "as_matrix") else found


# Fundamental matrices and homographies.


def fundamental_methods() -> Methods:
    def ours(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
        return model_of(robust.estimate_fundamental(a.astype("f4"), b.astype("f4"), key=jax.random.key(k)))

    def noise_measured(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
        """Estimated for 1 px, and again with the noise that the first estimate leaves."""
        a, b, key = a.astype("f4"), b.astype("f4"), jax.random.key(k)
        first = robust.estimate_fundamental(a, b, key=key, sigma_px=np.float32(1.0)).model
        sigma = robust.noise_scale(sampson_error(first, a, b), dimension=1, model_dof=7).sigma
        return model_of(robust.estimate_fundamental(a, b, key=key, sigma_px=sigma))

    def poselib_(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
        return np.asarray(poselib.estimate_fundamental(a, b, {"max_epipolar_error": 1.5, "seed": k}, {})[0])

    def opencv(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray | None:
        cv2.setRNGSeed(k)
        found, _ = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, 1.5, 0.9999, 10_000)
        return found if found is not None and found.shape == (3, 3) else None

    def colmap(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray | None:
        found = pycolmap.estimate_fundamental_matrix(a, b, ransac(1.5, k))
        return None if found is None else found["F"]

    return {**dict(zip(PEERS, (ours, poselib_, opencv, colmap), strict=True)), "noise measured": noise_measured}


def homography_methods() -> Methods:
    def ours(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
        return model_of(robust.estimate_homography(a.astype("f4"), b.astype("f4"), key=jax.random.key(k)))

    def poselib_(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
        return np.asarray(poselib.estimate_homography(a, b, {"max_reproj_error": 3.0, "seed": k}, {})[0])

    def opencv(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray | None:
        cv2.setRNGSeed(k)
        return cv2.findHomography(a, b, cv2.USAC_MAGSAC, 3.0, maxIters=10_000, confidence=0.9999)[0]

    def colmap(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray | None:
        found = pycolmap.estimate_homography_matrix(a, b, ransac(3.0, k))
        return None if found is None else found["H"]

    return dict(zip(PEERS, (ours, poselib_, opencv, colmap), strict=True))


def ransac(threshold: float, seed: int) -> Any:
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = threshold, seed
    return options


def sampson(f: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    squared = sampson_error(f / max(np.linalg.norm(f), 1e-30), a, b)
    return np.sqrt(np.asarray(squared))


def transfer(h: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    moved = a @ h[:, :2].T + h[:, 2]
    return np.linalg.norm(moved[:, :2] / moved[:, 2:] - b, axis=1)


def two_view(kind: str, keys: int) -> None:
    methods = {"fundamental": fundamental_methods, "homography": homography_methods}[kind]()
    residual, reach = {"fundamental": (sampson, 2.0), "homography": (transfer, 5.0)}[kind]
    outcomes = {}
    for path in sorted(folder("two_view", kind).glob("*_pts.txt")):
        a, b, label = rows_of(path)
        # So few ones are hand-made validation points, and zeros then are without label.
        validated = label.max() == 1 and (label == 1).sum() <= 14
        seen = (label == 0) if validated else np.ones(len(a), bool)
        groups = [label == j for j in range(1, label.max() + 1)]

        def error(found: np.ndarray, a: np.ndarray = a, b: np.ndarray = b, groups: list = groups) -> float:
            return min(float(np.median(residual(found, a[g], b[g]))) for g in groups if g.sum() >= 7)

        name = f"{path.stem.removesuffix('_pts')} ({seen.sum()}{', validated' if validated else ''})"
        outcomes[name] = compare(methods, (a[seen], b[seen]), keys, error)
    table(outcomes, reach, "px")


# Essential matrix.


def essential(keys: int) -> None:
    first, second = (np.loadtxt(folder("two_view", "essential", f"fountain{i}.K")) for i in (1, 2))
    rows = np.loadtxt(folder("two_view", "essential", "fountain_pts.txt"), skiprows=1)
    a, b = rows[:, :2], rows[:, 2:]
    cameras = [Pinhole(fx=k[0, 0], fy=k[1, 1], cx=k[0, 2], cy=k[1, 2]) for k in (first, second)]
    theirs = [
        {"model": "PINHOLE", "width": 3072, "height": 2048, "params": [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]}
        for k in (first, second)
    ]
    colmap_cameras = [pycolmap.Camera(**camera) for camera in theirs]

    def ours(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
        options = robust.RansacOptions(threshold_px=1.5)
        key = jax.random.key(k)
        estimate = robust.estimate_relative_pose(a.astype("f4"), b.astype("f4"), *cameras, key=key, options=options)
        return model_of(estimate)

    def poselib_(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
        pose, _ = poselib.estimate_relative_pose(a, b, *theirs, {"max_epipolar_error": 1.5, "seed": k}, {})
        return np.column_stack([pose.R, pose.t / np.linalg.norm(pose.t)])

    def opencv(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
        cv2.setRNGSeed(k)
        x, y = ((p - [m[0, 2], m[1, 2]]) / [m[0, 0], m[1, 1]] for p, m in ((a, first), (b, second)))
        found, mask = cv2.findEssentialMat(x, y, np.eye(3), cv2.USAC_MAGSAC, 0.9999, 1.5 / first[0, 0], 10_000)
        _, rotation, translation, _ = cv2.recoverPose(found, x, y, np.eye(3), mask=mask)
        return np.column_stack([rotation, translation])

    def colmap(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
        return pycolmap.estimate_essential_matrix(a, b, *colmap_cameras, ransac(1.5, k))["cam2_from_cam1"].matrix()

    poses: dict[str, list[np.ndarray]] = {name: [] for name in PEERS}
    times = {}
    for name, method in zip(PEERS, (ours, poselib_, opencv, colmap), strict=True):
        found = compare({name: method}, (a, b), keys, lambda pose, name=name: poses[name].append(pose) or 0.0)
        times[name] = found[name][1]
    print("| | matches within 1.5 px, of 270 | least to most over the keys | ms |\n|---|---|---|---|")
    for name in PEERS:
        tx = np.array([np.cross(np.eye(3), pose[:, 3]) @ pose[:, :3] for pose in poses[name]])
        inverses = [np.linalg.inv(k) for k in (second, first)]
        within = [np.sum(sampson(inverses[0].T @ e @ inverses[1], a, b) < 1.5) for e in tx]
        print(f"| {name} | {np.mean(within):.1f} | {np.min(within)} to {np.max(within)} | {times[name]:.1f} |")
    print()


# Rigid motion.


def rigid(keys: int) -> None:
    rows = np.loadtxt(folder("rigid3d", "rigid_pose_example_points.txt"))
    truth = np.loadtxt(folder("rigid3d", "rigid_pose_example_gt.txt"))
    truth = truth if truth.shape == (4, 4) else truth.reshape(4, 4)
    a, b = rows[:, :3], rows[:, 3:6]

    def ours(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
        estimate = robust.estimate_rigid(a.astype("f4"), b.astype("f4"), key=jax.random.key(k))
        return model_of(estimate)

    def colmap(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray | None:
        found = pycolmap.estimate_rigid3d_robust(a, b, ransac(0.05, k))
        return None if found is None else found["tgt_from_src"].matrix()

    orient, _, turn = np.linalg.svd(truth[:3, :3])
    rotation = orient @ turn

    within: list[int] = []

    def wrong(found: np.ndarray) -> float:
        angle = angle_deg(found[:, :3], rotation)
        middle = a[np.linalg.norm(a @ rotation.T + truth[:3, 3] - b, axis=1) < 0.05].mean(0)
        shift = np.linalg.norm(found[:, :3] @ middle + found[:, 3] - rotation @ middle - truth[:3, 3])
        within.append(np.sum(np.linalg.norm(a @ found[:, :3].T + found[:, 3] - b, axis=1) < 0.05))
        return float(angle > 2.0 or shift > 0.1)

    print("| | motion found | pairs within 5 cm | ms |\n|---|---|---|---|")
    for name, method in (("vojax", ours), ("COLMAP", colmap)):
        within.clear()
        errors, ms = compare({name: method}, (a, b), keys, wrong)[name]
        print(f"| {name} | {int(np.sum(errors == 0))} of {keys} keys | {np.mean(within):.0f} | {ms:.1f} |")
    print()


# Poses from points.


def absolute_methods(camera: Pinhole, size: tuple[int, int]) -> Methods:
    params = [float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy)]
    theirs = {"model": "PINHOLE", "width": size[0], "height": size[1], "params": params}
    colmap_camera, matrix = pycolmap.Camera(**theirs), np.asarray(camera.matrix(), float)

    def ours(x: np.ndarray, u: np.ndarray, k: int) -> np.ndarray:
        estimate = robust.estimate_absolute_pose(x.astype("f4"), u.astype("f4"), camera, key=jax.random.key(k))
        return model_of(estimate)

    def poselib_(x: np.ndarray, u: np.ndarray, k: int) -> np.ndarray:
        pose, _ = poselib.estimate_absolute_pose(u, x, theirs, {"max_reproj_error": 3.0, "seed": k}, {})
        return np.column_stack([pose.R, pose.t])

    def opencv(x: np.ndarray, u: np.ndarray, k: int) -> np.ndarray | None:
        cv2.setRNGSeed(k)
        found, turn, shift, inliers = cv2.solvePnPRansac(
            x, u, matrix, None, flags=cv2.SOLVEPNP_AP3P, reprojectionError=3.0, confidence=0.9999,
            iterationsCount=10_000,
        )  # fmt: skip
        if not found or inliers is None:
            return None
        chosen = inliers.ravel()
        turn, shift = cv2.solvePnPRefineLM(x[chosen], u[chosen], matrix, None, turn, shift)
        return np.column_stack([cv2.Rodrigues(turn)[0], shift])

    def colmap(x: np.ndarray, u: np.ndarray, k: int) -> np.ndarray | None:
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error, options.ransac.random_seed = 3.0, k
        found = pycolmap.estimate_and_refine_absolute_pose(u, x, colmap_camera, options)
        return None if found is None else found["cam_from_world"].matrix()

    return dict(zip(PEERS, (ours, poselib_, opencv, colmap), strict=True))


def stereo(keys: int) -> None:
    """Frame to frame; each pair of frames has a key of its own, so `keys` is not used."""
    del keys
    tracks = read_stereo_tracks(folder("kitti00_stereo_tracks"))
    truth = np.loadtxt(folder("trajectories", "KITTI_00_gt.txt")).reshape(-1, 3, 4)
    camera, baseline = tracks.stereo.camera, float(tracks.stereo.baseline)
    methods = absolute_methods(camera, (1241, 376))
    rig = Rig((camera, camera), SE3(jnp.array([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, -baseline, 0, 0]])))
    params = [float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy)]
    theirs = [{"model": "PINHOLE", "width": 1241, "height": 376, "params": params}] * 2
    places = [poselib.CameraPose(), poselib.CameraPose()]
    places[1].t = np.array([-baseline, 0.0, 0.0])

    def both(x: np.ndarray, u: np.ndarray, right: np.ndarray, k: int) -> np.ndarray:
        found = robust.estimate_generalized_pose(
            np.concatenate([x, x]).astype("f4"), np.concatenate([u, right]).astype("f4"),
            np.repeat(np.arange(2), len(x)), rig, key=jax.random.key(k),
        )  # fmt: skip
        return model_of(found)

    def poselib_both(x: np.ndarray, u: np.ndarray, right: np.ndarray, k: int) -> np.ndarray:
        options = {"max_reproj_error": 3.0, "seed": k}
        pose, _ = poselib.estimate_generalized_absolute_pose([u, right], [x, x], places, theirs, options, {})
        return np.column_stack([pose.R, pose.t])

    def left(method: Callable[..., Any]) -> Callable[..., Any]:
        return lambda x, u, right, k: method(x, u, k)

    named = {f"{name}, left image": left(method) for name, method in methods.items()}
    named |= {"vojax, both images": both, "PoseLib, both images": poselib_both}
    turns: dict[str, list[float]] = {name: [] for name in named}
    shifts: dict[str, list[float]] = {name: [] for name in named}
    times: dict[str, list[float]] = {name: [] for name in named}
    for k in range(len(tracks) - 1):
        a, b = tracks.frame(k), tracks.frame(k + 1)
        _, i, j = np.intersect1d(tracks.track_index[a], tracks.track_index[b], return_indices=True)
        seen = tracks.measurements[b][j]
        u, right = seen[:, [0, 1]], seen[:, [2, 1]]  # (u, v) in the left image and in the right one
        before, after = (np.vstack([truth[m], [0, 0, 0, 1]]) for m in (k, k + 1))
        true = np.linalg.inv(after) @ before

        for name, method in named.items():
            arguments = (tracks.points_cam[a][i], u, right, k)
            method(*arguments)  # compiles where the size is new
            begin = time.perf_counter()
            found = method(*arguments)
            times[name].append(1e3 * (time.perf_counter() - begin))
            found = as_matrix(found)
            turns[name].append(angle_deg(found[:, :3], true[:3, :3]))
            shifts[name].append(100 * float(np.linalg.norm(found[:, 3] - true[:3, 3])))
    print("| | rotation, degrees | translation, cm | ms |\n|---|---|---|---|")
    for name in named:
        values = (np.median(turns[name]), np.median(shifts[name]), np.median(times[name]))
        print(f"| {name} | {values[0]:.4f} | {values[1]:.2f} | {values[2]:.1f} |")
    print("\nMedians over 76 steps.\n")


def checkerboard(keys: int) -> None:
    """Each view has a key of its own, so `keys` is not used."""
    del keys
    data = folder("pnp_checkerboard")
    k = np.loadtxt(data / "K.txt")
    points = np.loadtxt(data / "p_W_corners.txt", delimiter=",") / 100.0
    views = np.loadtxt(data / "detected_corners.txt").reshape(-1, len(points), 2)
    camera = Pinhole(fx=k[0, 0], fy=k[1, 1], cx=k[0, 2], cy=k[1, 2])
    print("| | RMS, px: median of 210 views | worst | ms |\n|---|---|---|---|")
    for name, method in absolute_methods(camera, (752, 480)).items():
        errors, times = [], []
        for view in views:

            def error(found: np.ndarray, view: np.ndarray = view) -> float:
                moved = (points @ found[:, :3].T + found[:, 3]) @ k.T
                return float(np.sqrt(np.mean(np.sum((moved[:, :2] / moved[:, 2:] - view) ** 2, axis=1))))

            outcome = compare({name: method}, (points, view), 1, error)
            errors.append(outcome[name][0][0])
            times.append(outcome[name][1])
        print(f"| {name} | {np.median(errors):.3f} | {np.max(errors):.3f} | {np.median(times):.2f} |")
    print()


PARTS: dict[str, Callable[[int], None]] = {
    "fundamental": lambda keys: two_view("fundamental", keys),
    "homography": lambda keys: two_view("homography", keys),
    "essential": essential,
    "rigid": rigid,
    "stereo": stereo,
    "checkerboard": checkerboard,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--keys", type=int, default=20)
    arguments = parser.parse_args()
    print(describe_machine(), f"· {arguments.keys} keys\n")
    for part in arguments.parts:
        print(f"{part}\n")
        PARTS[part](arguments.keys)


if __name__ == "__main__":
    main()
