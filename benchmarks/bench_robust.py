"""Robust estimators beside PoseLib, OpenCV and COLMAP on the same problems: accuracy, one at a time, and 256 in a call.

f = 800 px, 1280×960, 1 px of noise, outliers uniform over the image; thresholds of 3 px for absolute poses and
homographies and 1.5 px for epipolar geometry, for all. vojax in float32; the peers in float64 with their own defaults
(OpenCV: USAC_MAGSAC, AP3P and refinement for absolute poses, 10,000 iterations at most). Accuracy is the area under the
recall curve of

    absolute     the angle of the rotation, up to 1°
    relative     the larger of the angles of rotation and translation, up to 5°
    fundamental  the RMS, over all true matches without noise, of the squared Sampson distance, up to 1 px²
    homography   the RMS transfer error of a grid over the image, up to 1 px

OpenCV and COLMAP are given the first 200 of the problems. "One call" is `jax.vmap` of the estimator over 256 problems,
half of them on each of two virtual devices.

python benchmarks/bench_robust.py [--kinds relative …] [--problems 1000]
"""

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pycolmap
from _timing import describe_machine

from vojax import robust
from vojax.cameras import Pinhole
from vojax.datasets import simulate_absolute_pose, simulate_relative_pose
from vojax.geometry import sampson_error

jax.config.update("jax_num_cpu_devices", 2)  # before JAX computes anything
BATCH, ITERATIONS, CONFIDENCE = 256, 10_000, 0.9999
K = np.array([[800.0, 0, 639.5], [0, 800.0, 479.5], [0, 0, 1.0]])
CAMERA = Pinhole(fx=800.0, fy=800.0, cx=639.5, cy=479.5)
SIZE = {"model": "PINHOLE", "width": 1280, "height": 960, "params": [800.0, 800.0, 639.5, 479.5]}
# COLMAP's pixels have their centres at halves; both points and principal point are taken as they are.
COLMAP = pycolmap.Camera(model="PINHOLE", width=1280, height=960, params=SIZE["params"])


class Kind(NamedTuple):
    """One estimator, its peers and how their answers are judged.

    Attributes:
        problems: Observations of a key, two arrays, and what the truth is.
        estimate: vojax, on observations and a key.
        peers: By name, on the observations as numpy arrays; None where nothing was found.
        error: Of an answer as a matrix, given the truth.
        reach: Where the recall curve ends.
    """

    problems: Callable[[Any, int, float], tuple[tuple[Any, Any], Any]]
    estimate: Callable[..., Any]
    peers: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray | None]]
    error: Callable[[np.ndarray, Any], float]
    reach: float


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b) / 8**0.5, 0, 1))))


def matrix(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    return np.column_stack([rotation, np.ravel(translation)])


def ransac(threshold: float) -> Any:
    options = pycolmap.RANSACOptions()
    options.max_error = threshold
    return options


# Absolute pose.


def absolute_problem(key, n, share):
    problem = simulate_absolute_pose(key, n, outlier_fraction=share)
    return (problem.points_world, problem.pixels), problem.cam_from_world.as_matrix()


def absolute_poselib(points, pixels):
    pose, _ = poselib.estimate_absolute_pose(pixels, points, SIZE, {"max_reproj_error": 3.0}, {})
    return matrix(pose.R, pose.t)


def absolute_opencv(points, pixels):
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points, pixels, K, None, flags=cv2.SOLVEPNP_AP3P, reprojectionError=3.0, confidence=CONFIDENCE,
        iterationsCount=ITERATIONS,
    )  # fmt: skip
    if not found or inliers is None:
        return None
    chosen = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(points[chosen], pixels[chosen], K, None, turn, shift)
    return matrix(cv2.Rodrigues(turn)[0], shift)


def absolute_colmap(points, pixels):
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = 3.0
    found = pycolmap.estimate_and_refine_absolute_pose(pixels, points, COLMAP, options)
    return None if found is None else found["cam_from_world"].matrix()


# Relative pose.


def relative_problem(key, n, share):
    problem = simulate_relative_pose(key, n, outlier_fraction=share)
    return (problem.pixels0, problem.pixels1), problem.cam1_from_cam0.as_matrix()


def relative_error(found, truth):
    a, b = found[:, 3], truth[:3, 3]
    cosine = a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-30)
    return max(angle_deg(found[:, :3], truth[:3, :3]), float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))


def relative_poselib(pixels0, pixels1):
    pose, _ = poselib.estimate_relative_pose(pixels0, pixels1, SIZE, SIZE, {"max_epipolar_error": 1.5}, {})
    return matrix(pose.R, pose.t)


def relative_opencv(pixels0, pixels1):
    essential, mask = cv2.findEssentialMat(
        pixels0, pixels1, K, method=cv2.USAC_MAGSAC, prob=CONFIDENCE, threshold=1.5, maxIters=ITERATIONS
    )
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, pixels0, pixels1, K, mask=mask)
    return matrix(rotation, translation)


def relative_colmap(pixels0, pixels1):
    found = pycolmap.estimate_essential_matrix(pixels0, pixels1, COLMAP, COLMAP, ransac(1.5))
    return None if found is None else found["cam2_from_cam1"].matrix()


# Fundamental matrix.


def fundamental_problem(key, n, share):
    problem = simulate_relative_pose(key, n, outlier_fraction=share)
    moved = problem.cam1_from_cam0.apply(problem.points_cam0)
    return (problem.pixels0, problem.pixels1), (CAMERA.project(problem.points_cam0), CAMERA.project(moved))


_sampson = jax.jit(lambda f, a, b: jnp.sqrt(jnp.mean(sampson_error(f, a, b) ** 2)))


def fundamental_error(found, truth):
    found = found / max(np.linalg.norm(found), 1e-30)
    return float(_sampson(found, *truth))


def fundamental_poselib(pixels0, pixels1):
    return np.asarray(poselib.estimate_fundamental(pixels0, pixels1, {"max_epipolar_error": 1.5}, {})[0])


def fundamental_opencv(pixels0, pixels1):
    found, _ = cv2.findFundamentalMat(pixels0, pixels1, cv2.USAC_MAGSAC, 1.5, CONFIDENCE, ITERATIONS)
    return found if found is not None and found.shape == (3, 3) else None


def fundamental_colmap(pixels0, pixels1):
    found = pycolmap.estimate_fundamental_matrix(pixels0, pixels1, ransac(1.5))
    return None if found is None else found["F"]


# Homography.


def homography_problem(key, n, share):
    keys = jax.random.split(key, 4)
    size = jnp.array([1280.0, 960.0])
    truth = jnp.eye(3) + jnp.array([[0.1, 0.1, 60.0], [0.1, 0.1, 60.0], [1e-4, 1e-4, 0.0]]) * (
        jax.random.uniform(keys[1], (3, 3), minval=-1.0)
    )
    ideal = jax.random.uniform(keys[0], (n, 2)) * size[None]
    noise = jax.random.normal(keys[2], (2, n, 2))
    wrong = jax.random.uniform(keys[3], (n, 2)) * size[None]
    pixels1 = jnp.where(jnp.arange(n)[:, None] < round(share * n), wrong, moved_by(truth, ideal) + noise[1])
    return (ideal + noise[0], pixels1), truth


def moved_by(homography, pixels):
    moved = pixels @ homography[:, :2].T + homography[:, 2][None]
    return moved[:, :2] / moved[:, 2:]


GRID = np.stack(np.meshgrid(np.linspace(0, 1279, 16), np.linspace(0, 959, 12)), axis=-1).reshape(-1, 2)


def homography_error(found, truth):
    return float(np.sqrt(np.mean(np.sum((moved_by(found, GRID) - moved_by(truth, GRID)) ** 2, axis=1))))


def homography_poselib(pixels0, pixels1):
    return np.asarray(poselib.estimate_homography(pixels0, pixels1, {"max_reproj_error": 3.0}, {})[0])


def homography_opencv(pixels0, pixels1):
    return cv2.findHomography(pixels0, pixels1, cv2.USAC_MAGSAC, 3.0, maxIters=ITERATIONS, confidence=CONFIDENCE)[0]


def homography_colmap(pixels0, pixels1):
    found = pycolmap.estimate_homography_matrix(pixels0, pixels1, ransac(3.0))
    return None if found is None else found["H"]


def peers(*functions: Any) -> dict[str, Any]:
    return dict(zip(("PoseLib", "OpenCV", "COLMAP"), functions, strict=True))


KINDS = {
    "relative": Kind(
        relative_problem,
        lambda a, b, key: robust.estimate_relative_pose(a, b, CAMERA, CAMERA, key=key),
        peers(relative_poselib, relative_opencv, relative_colmap),
        relative_error,
        5.0,
    ),
    "absolute": Kind(
        absolute_problem,
        lambda a, b, key: robust.estimate_absolute_pose(a, b, CAMERA, key=key),
        peers(absolute_poselib, absolute_opencv, absolute_colmap),
        lambda found, truth: angle_deg(found[:3, :3], truth[:3, :3]),
        1.0,
    ),
    "fundamental": Kind(
        fundamental_problem,
        lambda a, b, key: robust.estimate_fundamental(a, b, key=key),
        peers(fundamental_poselib, fundamental_opencv, fundamental_colmap),
        fundamental_error,
        1.0,
    ),
    "homography": Kind(
        homography_problem,
        lambda a, b, key: robust.estimate_homography(a, b, key=key),
        peers(homography_poselib, homography_opencv, homography_colmap),
        homography_error,
        1.0,
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--problems", type=int, default=1000)
    parser.add_argument("--others", type=int, default=200, help="problems that OpenCV and COLMAP are given")
    parser.add_argument("--points", type=int, nargs="+", default=[200, 1000])
    parser.add_argument("--shares", type=float, nargs="+", default=[0.3, 0.5, 0.7])
    arguments = parser.parse_args()
    print(describe_machine(), f"· {arguments.problems} problems a row, {BATCH} in one call")
    for name in arguments.kinds:
        kind = KINDS[name]
        print(f"\n{name}\n")
        names = list(kind.peers)
        print(f"| n, outliers | AUC: vojax | {' | '.join(names)} | vojax − PoseLib (95 %) | ms: vojax | ", end="")
        print(f"{' | '.join(names)} | ms in one call (PoseLib's over it) | compile, s |")
        print("|---" * (6 + 2 * len(names)) + "|")
        for n in arguments.points:
            for share in arguments.shares:
                row(kind, n, share, arguments.problems, arguments.others)


def row(kind: Kind, n: int, share: float, count: int, others: int) -> None:
    """Print one line of the table."""
    keys = jax.random.split(jax.random.key(int(100 * share) + n), count)
    (first, second), truth = jax.jit(jax.vmap(lambda key: kind.problems(key, n, share)))(keys)
    truths = [jax.tree.map(lambda x, i=i: np.asarray(x[i], float), truth) for i in range(count)]
    start = time.perf_counter()
    compiled = jax.jit(kind.estimate).lower(first[0], second[0], keys[0]).compile()
    compile_seconds = time.perf_counter() - start
    areas: dict[str, list[float]] = {name: [] for name in ("vojax", *kind.peers)}
    times: dict[str, list[float]] = {name: [] for name in ("vojax", *kind.peers)}

    def judge(name: str, call: Callable[[], Any], i: int) -> Any:
        begin = time.perf_counter()
        answer = call()
        times[name].append(1e3 * (time.perf_counter() - begin))
        found = answer
        if name == "vojax":
            found = answer.model.as_matrix()[:3] if hasattr(answer.model, "as_matrix") else answer.model
        error = np.inf if found is None else kind.error(np.asarray(found, float), truths[i])
        areas[name].append(float(np.clip(1.0 - error / kind.reach, 0.0, 1.0)))

    for i in range(count):
        ours = (first[i], second[i], keys[i])
        judge("vojax", lambda ours=ours: jax.block_until_ready(compiled(*ours)), i)
        theirs = [np.ascontiguousarray(x[i], float) for x in (first, second)]
        for name, peer in kind.peers.items() if i < others else (("PoseLib", kind.peers["PoseLib"]),):
            judge(name, lambda peer=peer, theirs=theirs: peer(*theirs), i)
    together = in_one_call(kind, first, second, keys)
    rng = np.random.default_rng(0)
    difference = np.array(areas["vojax"]) - np.array(areas["PoseLib"])
    low, high = np.quantile([difference[rng.integers(0, count, count)].mean() for _ in range(1000)], [0.025, 0.975])
    median = {name: float(np.median(t)) for name, t in times.items()}
    cells = [
        f"{n}, {share:.0%}",
        *(f"{np.mean(area):.4f}" for area in areas.values()),
        f"{low:+.4f} to {high:+.4f}",
        *(f"{value:.1f}" for value in median.values()),
        f"{together:.2f} ({np.mean(times['PoseLib']) / together:.1f})",
        f"{compile_seconds:.1f}",
    ]
    print("| " + " | ".join(cells) + " |", flush=True)


def in_one_call(kind: Kind, first: Any, second: Any, keys: Any) -> float:
    """Milliseconds per problem of 256 (or as many as there are) in one call, the best of three."""
    batch = min(BATCH, len(keys)) // 2 * 2
    mesh = jax.make_mesh((2,), ("problem",))
    along = jax.sharding.PartitionSpec("problem")
    arguments = jax.device_put((first[:batch], second[:batch], keys[:batch]), jax.sharding.NamedSharding(mesh, along))
    call = jax.jit(jax.shard_map(jax.vmap(kind.estimate), mesh=mesh, in_specs=along, out_specs=along, check_vma=False))
    jax.block_until_ready(call(*arguments))
    times = []
    for _ in range(3):
        start = time.perf_counter()
        jax.block_until_ready(call(*arguments))
        times.append(time.perf_counter() - start)
    return 1e3 * min(times) / batch


if __name__ == "__main__":
    main()
