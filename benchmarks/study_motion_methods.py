"""Motion from 2-D to 2-D, 3-D to 2-D and 3-D to 3-D in one simulated world, before and after a window adjustment.

Claims (Scaramuzza & Fraundorfer 2011): after bundle adjustment the method of motion matters less; with one camera 2-D
to 2-D is preferable and 3-D to 2-D the faster; a stereo pair far from what it sees is a single camera. With them goes
how the deviation of a triangulated depth grows with depth and baseline.

python benchmarks/study_motion_methods.py [--trials 1000]

All in float64, without outliers unless said. Intervals are 95 % bootstrap intervals over trials, which all methods
share.
"""

import argparse
import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine
from jax import Array

from vojax.ba import (
    LMOptions,
    RelativePoseProblem,
    Squared,
    adjust_window,
    pixel_rays,
    refine_absolute_pose,
    refine_model,
)
from vojax.cameras import Pinhole, RectifiedStereo
from vojax.datasets import simulate_stereo_window
from vojax.geometry import triangulate_rectified
from vojax.lie import SE3
from vojax.odometry._relative_motion import scaled_motion, triangulate_pairs
from vojax.robust import RansacOptions, estimate_absolute_pose, estimate_relative_pose, weighted_alignment
from vojax.solvers import procrustes

SIGMA_PX = 0.5
EXACT = LMOptions(max_steps=30, tolerance=1e-9)


def rms(values: np.ndarray) -> float:
    """Root mean square of errors."""
    return float(np.sqrt(np.mean(values**2)))


def bootstrap(statistic: Any, *values: np.ndarray, digits: int = 3) -> str:
    """A statistic of the trials with its 95 % interval."""
    rng, n = np.random.default_rng(0), len(values[0])
    draws = [statistic(*(v[rows] for v in values)) for rows in (rng.integers(0, n, n) for _ in range(500))]
    low, high = np.quantile(draws, [0.025, 0.975])
    middle, low, high = (f"{x:#.{digits}g}".rstrip(".") for x in (statistic(*values), low, high))
    return f"{middle} ({low}–{high})"


def angle_deg(a: Array, b: Array) -> Array:
    """Angle between vectors, degrees."""
    cross = jnp.linalg.norm(jnp.cross(a, b), axis=-1)
    return jnp.degrees(jnp.arctan2(cross, jnp.sum(a * b, axis=-1)))


def turn_deg(a: SE3, b: SE3) -> Array:
    """Angle between rotations, degrees."""
    return jnp.degrees(jnp.linalg.norm((a.rotation().inverse() @ b.rotation()).log(), axis=-1))


# ---- 1. Three methods, then the same window

FRAMES, LANDMARKS = 6, 120
METHODS = (
    "2-D to 2-D, length by stereo points",
    "3-D to 2-D, points exact",
    "3-D to 3-D, equal weights",
    "3-D to 3-D, covariances",
)
SCENES = {"4 to 15 m (7 to 28 b)": (4.0, 15.0), "15 to 60 m (28 to 111 b)": (15.0, 60.0)}
# Instead of what was not seen: any pixels with a disparity.
ANYWHERE = (320.0, 120.0, 300.0)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, 0, 0, None))
def pair_motions(first: Array, second: Array, both: Array, stereo: RectifiedStereo) -> Array:
    """cam0_from_cam1 of two frames by every method `[4, 7]`."""
    first, second = (jnp.where(both[:, None], m, jnp.array(ANYWHERE)) for m in (first, second))
    points0, cov0 = jax.vmap(lambda m: triangulate_rectified(m, stereo, SIGMA_PX))(first)
    points1, cov1 = jax.vmap(lambda m: triangulate_rectified(m, stereo, SIGMA_PX))(second)
    weights = both.astype(first.dtype)
    equal = SE3(procrustes(points0, points1, weights).models.wxyz_xyz[0])
    full, _ = weighted_alignment(points0, points1, cov0, cov1, weights, 30)
    camera, left0, left1 = stereo.camera, first[:, :2], second[:, :2]
    pose = refine_absolute_pose(full, points0, left1, camera, sigma_px=SIGMA_PX, mask=both, options=EXACT).model
    # The least Sampson distances, found from a motion that is nearly right: there are no outliers to search among.
    t = full.translation()
    unit = SE3.from_rotation_and_translation(full.rotation(), t / jnp.linalg.norm(t))
    epipolar = RelativePoseProblem(pixel_rays(camera, left0), pixel_rays(camera, left1))
    unit = refine_model(unit, epipolar, weight=weights, options=EXACT).model
    std0 = jnp.sqrt(jnp.trace(cov0, axis1=1, axis2=2))
    pairs = scaled_motion(unit, both, left0, left1, points0, std0, both, camera, SIGMA_PX, "median").cam1_from_cam0
    return SE3(jnp.stack([m.wxyz_xyz for m in (pairs, pose, equal, full)])).inverse().wxyz_xyz


def adjuster(images: str, steps: int) -> Any:
    """A window adjustment of many drives at once: last poses `[drives, 7]`."""

    def adjust(poses: Array, observations: Array, seen: Array, stereo: RectifiedStereo) -> Array:
        begin = jnp.argmax(seen, axis=0)
        measured = jnp.take_along_axis(observations, begin[None, :, None], axis=0)[0]
        measured = jnp.where(jnp.any(seen, axis=0)[:, None], measured, jnp.array(ANYWHERE))
        points = SE3(poses[begin]).apply(stereo.unproject(measured))
        settings: dict[str, Any] = {"sigma_px": SIGMA_PX, "loss": Squared()}
        settings["options"] = LMOptions(max_steps=steps, tolerance=1e-9)
        if images == "both":
            found = adjust_window(SE3(poses), points, observations, seen, stereo, **settings)
        else:
            # The first motion stays and gives the scale.
            seen = seen & (jnp.sum(seen, axis=0) >= 2)[None]
            settings["fixed"] = jnp.arange(FRAMES) < 2
            found = adjust_window(SE3(poses), points, observations[..., :2], seen, stereo.camera, **settings)
        return found.world_from_cam.wxyz_xyz[-1]

    return jax.jit(jax.vmap(adjust, in_axes=(0, 0, 0, None)))


def study_windows(trials: int) -> None:
    """Table of methods by adjustments."""
    adjustments = {
        "both images, one step": adjuster("both", 2),
        "both images": adjuster("both", 30),
        "left image": adjuster("left", 30),
    }
    names = ("none", *adjustments)
    for scene, depths in SCENES.items():
        worlds = jax.vmap(
            lambda key, d=depths: simulate_stereo_window(
                key, FRAMES, LANDMARKS, sigma_px=SIGMA_PX, depth_range=d, dtype=jnp.float64
            )
        )(jax.random.split(jax.random.key(1), trials))
        seen, observed = worlds.visible, worlds.observations
        stereo = jax.tree.map(lambda leaf: leaf[0], worlds.stereo)
        both = seen[:, :-1] & seen[:, 1:]
        flat = [x.reshape(-1, *x.shape[2:]) for x in (observed[:, :-1], observed[:, 1:], both)]
        motions = pair_motions(*flat, stereo).reshape(trials, FRAMES - 1, len(METHODS), 7)
        poses = [SE3.identity((trials, len(METHODS)), dtype=jnp.float64)]
        for k in range(FRAMES - 1):
            poses.append(poses[-1] @ SE3(motions[:, k]))
        chain = jnp.stack([pose.wxyz_xyz for pose in poses], axis=2)  # [trials, methods, frames, 7]
        last = [chain[:, :, -1]]
        for adjust in adjustments.values():
            found = [adjust(chain[:, m], observed, seen, stereo) for m in range(len(METHODS))]
            last.append(jnp.stack(found, axis=1))
        truth = SE3(worlds.world_from_cam.wxyz_xyz[:, None, -1])
        # Where the methods' windows end apart, one of them has not found the optimum.
        apart = np.linalg.norm(last[2][..., 4:] - last[2][:, -1:, 4:], axis=-1) > 1e-3
        print(f"\nDepths {scene}, {trials} drives of {FRAMES} frames, {np.sum(both, axis=2).mean():.0f} points a pair")
        print("windows of both images that end more than 1 mm from the last method's:", *apart.mean(axis=0).round(4))
        position = [100 * np.linalg.norm(p[..., 4:] - truth.translation(), axis=-1) for p in last]
        turn = [100 * np.asarray(turn_deg(SE3(p), truth)) for p in last]
        for what, errors in (("position, cm", position), ("rotation, 0.01°", turn)):
            print(f"| median {what} | " + " | ".join(names) + " |\n" + "|---" * (len(names) + 1) + "|")
            for m, method in enumerate(METHODS):
                print(f"| {method} | " + " | ".join(bootstrap(np.median, e[:, m]) for e in errors) + " |")
            # All errors of a drive stand in one row: the interval is paired.
            print("| worst over best | " + " | ".join(bootstrap(worst_over_best, e) for e in errors) + " |", flush=True)


def worst_over_best(errors: np.ndarray) -> float:
    """Of the medians of the columns."""
    of_methods = np.median(errors, axis=0)
    return float(of_methods.max() / of_methods.min())


# ---- 2. From stereo to one camera

RATIOS = (10, 40, 160, 640, 2560)
DEPTH, SIZE, FOCAL = 20.0, (1200.0, 360.0), 700.0
MOTION = (0.3, 0.02, -0.9, 0.005, 0.02, -0.004)  # cam1_from_cam0, its logarithm


def rig(baseline: Any) -> RectifiedStereo:
    """Of that baseline."""
    camera = Pinhole(fx=FOCAL, fy=FOCAL, cx=SIZE[0] / 2, cy=SIZE[1] / 2)
    return RectifiedStereo(camera, baseline=baseline)


def two_frames(key: Array, poses: Array, ratio: Array) -> tuple[Array, ...]:
    """Errors of the direction (°), the rotation (°) of stereo and of one camera, and the relative error of length."""
    stereo, truth = rig(DEPTH / ratio), SE3.exp(jnp.array(MOTION))
    keys = jax.random.split(key, 3)
    pixels = jax.random.uniform(keys[0], (50, 2)) * jnp.array(SIZE)
    rays = stereo.camera.unproject(pixels)
    points = rays / rays[:, 2:] * DEPTH * jax.random.uniform(keys[1], (50, 1), minval=0.6, maxval=1.4)
    exact = jnp.stack([stereo.project(points), stereo.project(truth.apply(points))])
    noisy = exact + SIGMA_PX * jax.random.normal(keys[2], exact.shape)
    window = adjust_window(
        SE3(poses), points, noisy, jnp.ones((2, 50), bool), stereo, sigma_px=SIGMA_PX, loss=Squared(), options=EXACT
    )
    found = SE3(window.world_from_cam.wxyz_xyz[1]).inverse()
    t = truth.translation()
    unit = SE3.from_rotation_and_translation(truth.rotation(), t / jnp.linalg.norm(t))
    views = [pixel_rays(stereo.camera, noisy[k, :, :2]) for k in range(2)]
    mono = refine_model(unit, RelativePoseProblem(*views), options=EXACT).model
    length = jnp.linalg.norm(found.translation()) / jnp.linalg.norm(t) - 1.0
    return (
        angle_deg(found.translation(), t), turn_deg(found, truth),
        angle_deg(mono.translation(), t), turn_deg(mono, truth), length,
    )  # fmt: skip


def exponent(xs: Any, errors: list[np.ndarray]) -> str:
    """Slope of log rms error over log x."""
    return bootstrap(lambda *e: np.polyfit(np.log(xs), np.log([rms(one) for one in e]), 1)[0], *errors, digits=4)


def study_far(trials: int) -> None:
    """Baselines that shrink before the same scene, and the deviation of depths."""
    solve, table = jax.jit(jax.vmap(two_frames, in_axes=(0, 0, None))), []
    poses = SE3.exp(jnp.stack([jnp.zeros(6), -jnp.array(MOTION)])).wxyz_xyz  # the optimum is sought from the truth
    poses = jnp.broadcast_to(poses, (trials, 2, 7))
    keys = jax.random.split(jax.random.key(2), trials)
    for ratio in RATIOS:
        table.append([np.asarray(e) for e in solve(keys, poses, jnp.float64(ratio))])
    print(f"\nTwo frames, 50 points at {DEPTH:.0f} m ± 40 %, a motion of 0.95 m; {trials} trials")
    print("| | " + " | ".join(f"z = {r} b" for r in RATIOS) + " |\n" + "|---" * (len(RATIOS) + 1) + "|")
    rows = (
        ("direction: stereo, °", lambda e: bootstrap(rms, e[0])),
        ("direction: one camera, °", lambda e: bootstrap(rms, e[2])),
        ("direction: stereo over one camera", lambda e: bootstrap(lambda a, b: rms(a) / rms(b), e[0], e[2])),
        ("rotation: stereo over one camera", lambda e: bootstrap(lambda a, b: rms(a) / rms(b), e[1], e[3])),
        ("length: stereo, %", lambda e: bootstrap(rms, 100 * e[4])),
    )
    for name, cell in rows:
        print(f"| {name} | " + " | ".join(cell(errors) for errors in table) + " |")
    far = [i for i, ratio in enumerate(RATIOS) if ratio >= 160]
    print(
        "exponent of the length's error in z/b from 160:",
        exponent([RATIOS[i] for i in far], [table[i][4] for i in far]),
    )

    def depth_errors(key: Array, z: Any, baseline: Any) -> np.ndarray:
        stereo = rig(baseline)
        keys = jax.random.split(key)
        pixels = jax.random.uniform(keys[0], (20 * trials, 2)) * jnp.array(SIZE)
        rays = stereo.camera.unproject(pixels)
        points = rays / rays[:, 2:] * z
        noisy = stereo.project(points) + SIGMA_PX * jax.random.normal(keys[1], points.shape)
        return np.asarray(jax.vmap(lambda m: triangulate_rectified(m, stereo, SIGMA_PX))(noisy)[0][:, 2] - z)

    for least, limit in ((2, 20), (20, 80)):  # beyond, noise of 0.7 px is much of the disparity
        xs = np.geomspace(least, limit, 5)
        by_depth = [depth_errors(jax.random.key(3), 0.5 * x, 0.5) for x in xs]
        by_baseline = [depth_errors(jax.random.key(4), DEPTH, DEPTH / x) for x in xs]
        print(
            f"deviation of a depth, z/b from {least} to {limit}: exponent {exponent(xs, by_depth)} in z at a baseline "
            f"of 0.5 m, {exponent(1 / xs, by_baseline)} in b at 20 m"
        )


# ---- 3. One camera

POINTS, OUTLIERS = 200, 0.3


def camera() -> Pinhole:
    """The left one."""
    return rig(1.0).camera


def three_views(key: Array, baseline: Array) -> tuple[Array, Array, Array]:
    """Pixels of three views, the second and third one and two baselines (a unit each) on; true poses cam_from_cam0."""
    keys = jax.random.split(key, 5)
    turns = 0.02 * jax.random.normal(keys[0], (2, 3))
    shift = jax.random.normal(keys[1], (3,)) * jnp.array([1.0, 0.3, 1.0])
    shift = jnp.broadcast_to(shift / jnp.linalg.norm(shift), (2, 3))
    step = SE3.exp(jnp.concatenate([-shift, turns], axis=1))
    poses = SE3(jnp.stack([step.wxyz_xyz[0], (SE3(step.wxyz_xyz[1]) @ SE3(step.wxyz_xyz[0])).wxyz_xyz]))
    pixels = jax.random.uniform(keys[2], (POINTS, 2)) * jnp.array(SIZE)
    rays = camera().unproject(pixels)
    depth = jax.random.uniform(keys[3], (POINTS, 1), minval=0.6, maxval=1.4) / baseline
    points = rays / rays[:, 2:] * depth
    seen = jnp.stack([camera().project(x) for x in (points, *SE3(poses.wxyz_xyz[:, None]).apply(points[None]))])
    noise, wrong = jax.random.split(keys[4])
    seen = seen + SIGMA_PX * jax.random.normal(noise, seen.shape)
    # A track that is lost goes on somewhere else in the third view.
    lost = jnp.arange(POINTS) < OUTLIERS * POINTS
    seen = seen.at[2].set(jnp.where(lost[:, None], jax.random.uniform(wrong, (POINTS, 2)) * jnp.array(SIZE), seen[2]))
    return seen, poses.wxyz_xyz, lost


SEARCH = RansacOptions(threshold_px=2.0)
MONO = ("2-D to 2-D", "3-D to 2-D, points exact", "3-D to 2-D, covariances")


@jax.jit
def map_of(pixels: Array, cam1_from_cam0: SE3) -> tuple[Array, Array, Array, Array]:
    """Points of the first two views in view 1, their covariances and deviations, and which to trust."""
    views = SE3(jnp.stack([SE3.identity(dtype=pixels.dtype).wxyz_xyz, cam1_from_cam0.inverse().wxyz_xyz]))
    points, covariance, valid = triangulate_pairs(pixels[1], pixels[0], views, camera(), SIGMA_PX)
    return points, covariance, jnp.sqrt(jnp.maximum(jnp.trace(covariance, axis1=1, axis2=2), 0.0)), valid


@jax.jit
def weighed(pose: SE3, points: Array, covariance: Array, pixels: Array, mask: Array) -> SE3:
    """A pose with the uncertainty of the points in their pixels."""
    jacobian = jax.vmap(jax.jacfwd(lambda x: camera().project(pose.apply(x))))(points)
    spread = SIGMA_PX**2 * jnp.eye(2) + jnp.einsum("nij,njk,nlk->nil", jacobian, covariance, jacobian)
    return refine_absolute_pose(pose, points, pixels, camera(), sigma_px=spread, mask=mask, options=EXACT).model


def third_pose(method: int, pixels: Array, made: tuple[Array, ...], key: Array) -> SE3:
    """View 2 from view 1."""
    points, covariance, std, known = made
    search = {"key": key, "options": SEARCH, "sigma_px": SIGMA_PX}
    if method == 0:
        found = estimate_relative_pose(pixels[1], pixels[2], camera(), camera(), **search)
        given = (found.model, found.inliers, pixels[1], pixels[2], points, std, known, camera(), SIGMA_PX, "median")
        return scaled_motion(*given).cam1_from_cam0
    found = estimate_absolute_pose(points, pixels[2], camera(), mask=known, **search)
    return found.model if method == 1 else weighed(found.model, points, covariance, pixels[2], found.inliers)


def study_one_camera(trials: int) -> None:
    """Accuracy and time of the third view of three."""

    def median(values: np.ndarray) -> float:
        return float(np.median(np.abs(values)))

    views = jax.jit(three_views)
    for share in (0.2, 0.05):
        errors, seconds = np.zeros((len(MONO), 3, trials)), np.zeros((len(MONO), trials))
        for trial, key in enumerate(jax.random.split(jax.random.key(5), trials)):
            pixels, poses, _ = views(key, share)
            truth = SE3(poses[1]) @ SE3(poses[0]).inverse()
            keys = jax.random.split(key)
            first = estimate_relative_pose(
                pixels[0], pixels[1], camera(), camera(), key=keys[0], options=SEARCH, sigma_px=SIGMA_PX
            )
            *made, valid = map_of(pixels, first.model)
            made = (*made, valid & first.inliers)
            for m in range(len(MONO)):
                if trial == 0:
                    third_pose(m, pixels, made, keys[1])  # compiles
                start = time.perf_counter()
                found = jax.block_until_ready(third_pose(m, pixels, made, keys[1]))
                seconds[m, trial] = time.perf_counter() - start
                errors[m, :, trial] = errors_of(found, truth)
        print(f"\nOne camera, {POINTS} points, {OUTLIERS:.0%} of the tracks lost in view 3, {trials} trials;")
        print(f"baselines of {share} of the depth")
        print("| median of | rotation, 0.01° | direction, ° | length, % | ms, one at a time |\n|---|---|---|---|---|")
        for name, error, times in zip(MONO, errors, seconds, strict=True):
            cells = [bootstrap(median, f * e) for f, e in zip((100, 1, 100), error, strict=True)]
            print(f"| {name} | " + " | ".join(cells) + f" | {1e3 * np.median(times):.1f} |")
        for m in (1, 2):
            ratios = [
                bootstrap(lambda a, b: median(a) / median(b), a, b) for a, b in zip(errors[0], errors[m], strict=True)
            ]
            times = bootstrap(lambda a, b: np.median(a) / np.median(b), seconds[0], seconds[m])
            print(f"| {MONO[0]} over {MONO[m]} | " + " | ".join(ratios) + f" | {times} |", flush=True)


@jax.jit
def errors_of(found: SE3, truth: SE3) -> Array:
    """Rotation and direction, degrees, and relative length."""
    t, true = found.translation(), truth.translation()
    length = jnp.linalg.norm(t) / jnp.linalg.norm(true) - 1.0
    return jnp.stack([turn_deg(found, truth), angle_deg(t, true), length])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--parts", nargs="+", default=["windows", "far", "one"], choices=["windows", "far", "one"])
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(describe_machine())
    for part, study in (("windows", study_windows), ("far", study_far), ("one", study_one_camera)):
        if part in arguments.parts:
            study(arguments.trials)


if __name__ == "__main__":
    main()
