"""How many correspondences, absolute or relative pose, which motion, and what keyframes and outlier handling do.

Claims of Aufderheide, Krybus & Edwards 2012: more than 40 correspondences are adequate; absolute pose is more accurate
than relative pose; the pattern of motion dominates the error of relative pose; keyframes and the handling of outliers
are mandatory.

Scenes as in `study_five_point_motion.py`: 640 x 480 pixels, f = 600 px, depths of 4 to 20 baselines, 1 px of noise,
sideways motion, 100 correspondences, where nothing else is said. Relative pose is `estimate_relative_pose`, beside it
the eight-point algorithm on all correspondences. Absolute pose is EPnP of view 1 in the frame of view 0, its points
exact, or triangulated from view 0 and a view one baseline to the side of it, with the same noise in all views. Outliers
are anywhere in image 1. Counted are runs with less than 10° of error in the direction of translation and 2° in
rotation.

python benchmarks/study_correspondences.py [--trials N]
"""

import argparse
import functools

import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine
from study_five_point_motion import (
    HALF_IMAGE,
    PATTERNS,
    SIGMAS,
    Setting,
    in_gate,
    measure,
    rays_of,
    scene,
    share_interval,
)

from vojax import RansacOptions, estimate_relative_pose
from vojax.cameras import Pinhole
from vojax.geometry import pose_from_essential, triangulate_rays
from vojax.lie import SE3
from vojax.metrics import rotation_error_deg, translation_direction_error_deg
from vojax.solvers import eight_point, epnp

PADDED, CHUNK = 200, 100  # counts are padded, so that one compilation serves all
BESIDE = np.array([1.0, 0.0, 0.0])  # where the third view stands in the frame of view 0
NUMBERS = (6, 10, 15, 20, 30, 40, 60, 80, 120, 200)
METHODS = (
    "relative pose",
    "eight-point algorithm",
    "absolute pose, points exact",
    "absolute pose, points triangulated",
)


def draw(key, pattern, sigma, setting, outliers):
    """Planes z = 1 of view 0, view 1 and a view beside view 0, points in the frame of view 0, the motion."""
    keys = jax.random.split(key, 5)
    points, motion = scene(keys[0], pattern, setting, PADDED)
    views = points, motion.apply(points), points - BESIDE[None]
    planes = [measure(keys[1 + i], view, sigma, setting) for i, view in enumerate(views)]
    draws = jax.random.uniform(keys[4], (PADDED, 3))
    anywhere = jnp.asarray(HALF_IMAGE)[None] / setting.focal * (2.0 * draws[:, :2] - 1.0)
    planes[1] = jnp.where(draws[:, 2:] < outliers, anywhere, planes[1])
    return planes, points, motion


def errors_of(pose, motion):
    turn = rotation_error_deg(pose.rotation(), motion.rotation())
    return jnp.stack([translation_direction_error_deg(pose.translation(), motion.translation()), turn])


def robust(key, pattern, sigma, setting, count, outliers):
    """Errors of `estimate_relative_pose`, degrees: direction of translation, rotation."""
    (plane0, plane1, _), _, motion = draw(key, pattern, sigma, setting, outliers)
    # Pixels in units of the noise, so that the threshold of three deviations is static.
    scale = setting.focal / sigma
    camera = Pinhole(fx=scale, fy=scale, cx=0.0 * scale, cy=0.0 * scale)
    mask, options = jnp.arange(PADDED) < count, RansacOptions(threshold_px=3.0)
    found = estimate_relative_pose(scale * plane0, scale * plane1, camera, camera, key=key, options=options, mask=mask)
    return errors_of(found.model, motion)[None]


def direct(key, pattern, sigma, setting, count, outliers):
    """Errors of the methods that take all correspondences as they are."""
    (plane0, plane1, beside), points, motion = draw(key, pattern, sigma, setting, outliers)
    rays0, rays1, weights = rays_of(plane0), rays_of(plane1), 1.0 * (jnp.arange(PADDED) < count)
    centers = jnp.stack([jnp.zeros(3), BESIDE])
    measured = jax.vmap(lambda a, b: triangulate_rays(centers, jnp.stack([a, b])))(rays0, rays_of(beside))
    essential = eight_point(rays0, rays1, weights).models[0]
    absolute = jax.vmap(lambda p: epnp(p, rays1, weights).models.parameters()[0])(jnp.stack([points, measured]))
    poses = (pose_from_essential(essential, rays0, rays1, weights)[0], SE3(absolute[0]), SE3(absolute[1]))
    return jnp.stack([errors_of(pose, motion) for pose in poses])


@functools.partial(jax.jit, static_argnums=0)
def solve(method, keys, arguments):
    return jax.vmap(lambda key: method(key, *arguments))(keys)


def run(trials, pattern=0, sigma=1.0, setting=Setting(), count=100, outliers=0.0, methods=(robust, direct)):
    """Errors [trials, methods, 2]."""
    keys = jax.random.split(jax.random.key(0), -(-trials // CHUNK) * CHUNK).reshape(-1, CHUNK)
    arguments = (pattern, jnp.asarray(sigma), Setting(*map(jnp.asarray, setting)), count, jnp.asarray(outliers))
    return np.concatenate([np.concatenate([solve(m, k, arguments) for m in methods], axis=1) for k in keys])


def median_interval(errors):
    """Median and its 95 % interval, by order statistics."""
    ordered, n, half = np.sort(errors), len(errors), 0.98 * np.sqrt(len(errors))
    return ordered[np.clip((0.5 * n + np.array([0.0, -half, half])).astype(int), 0, n - 1)]


def show(errors):
    return "{:.3g} ({:.3g}–{:.3g})".format(*median_interval(errors))


def counted(errors):
    return "{:.1f} ({:.1f}–{:.1f})".format(*share_interval(in_gate(errors)))


def header(first, columns):
    return f"| {first} | " + " | ".join(columns) + " |\n" + "|---" * (len(columns) + 1) + "|"


def explained(cells):
    """Share of the variance of the logarithm of the error by each factor alone, by all their interplay, by chance."""
    logs = np.log(np.array(cells))  # [patterns, sigmas, numbers, trials]
    total, middle = logs.var(), logs.mean()
    shares = []
    for k in range(3):
        other = tuple(j for j in range(4) if j != k)
        shares.append(np.mean((logs.mean(axis=other) - middle) ** 2) / total)
    means = logs.mean(axis=3)
    shares.append(means.var() / total - sum(shares))
    return [*shares, 1.0 - sum(shares)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=400, help="per cell")
    trials = parser.parse_args().trials
    jax.config.update("jax_enable_x64", True)
    print(describe_machine(), f"· {trials} trials a cell, float64; 95 % intervals in brackets")

    print(
        "\nNumber of correspondences: median error of the direction of translation, of rotation, °; counted per 100\n"
    )
    print(header("", METHODS))
    medians = []
    for n in NUMBERS:
        errors = run(trials, count=n)
        cells = [
            f"{show(errors[:, k, 0])}; {show(errors[:, k, 1])}; {counted(errors[:, k])}" for k in range(len(METHODS))
        ]
        medians.append([np.median(errors[:, k, 0]) for k in range(len(METHODS))])
        print(f"| {n} | " + " | ".join(cells) + " |", flush=True)
    logs = np.log(np.array(medians))
    first = NUMBERS.index(40)
    for name, part in (("to 40", slice(None, first + 1)), ("from 40", slice(first, None))):
        slopes = np.polyfit(np.log(NUMBERS[part]), logs[part], 1)[0]
        print(f"| exponent {name} | " + " | ".join(f"{slope:.2f}" for slope in slopes) + " |")

    print(
        "\nAbsolute against relative pose, 50 correspondences: median errors, and where absolute is nearer, per cent\n"
    )
    print(header("", METHODS))
    for i, pattern in enumerate(PATTERNS):
        for sigma in SIGMAS:
            errors = run(trials, i, sigma, count=50)
            cells = []
            for k in range(len(METHODS)):
                wins = (100 * np.mean(errors[:, k, j] < errors[:, 0, j]) for j in (0, 1))
                won = "" if k == 0 else "; {:.0f}, {:.0f}".format(*wins)
                cells.append(f"{show(errors[:, k, 0])}; {show(errors[:, k, 1])}{won}")
            print(f"| {pattern}, {sigma} px | " + " | ".join(cells) + " |", flush=True)

    print("\nWhat explains the variance of the logarithm of the error of relative pose, per cent\n")
    print(header("", ["motion", "noise 0.5 to 2 px", "10 to 100 correspondences", "their interplay", "the rest"]))
    few = (10, 20, 50, 100)
    grid = [
        [[run(trials // 2, i, s, count=n, methods=(robust,))[:, 0] for n in few] for s in SIGMAS]
        for i in range(len(PATTERNS))
    ]
    for j, name in enumerate(("translation", "rotation")):
        shares = explained(np.array(grid)[..., j])
        print(f"| {name} | " + " | ".join(f"{100 * part:.1f}" for part in shares) + " |")

    print("\nOutliers: counted per 100\n")
    outliers = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    print(header("", [f"{100 * o:.0f} %" for o in outliers]))
    results = [run(trials, outliers=o) for o in outliers]
    for k, method in enumerate(METHODS):
        print(f"| {method} | " + " | ".join(counted(errors[:, k]) for errors in results) + " |")

    print("\nKeyframes: baseline over mean depth; median error of the direction, of rotation, °; counted per 100\n")
    lengths = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02)
    print(header("", [f"1 : {12 / length:.0f}" for length in lengths]))
    results = [run(trials, setting=Setting(near=4.0 / length, far=20.0 / length)) for length in lengths]
    for k, method in enumerate(METHODS[:2]):
        cells = [f"{show(e[:, k, 0])}; {show(e[:, k, 1])}; {counted(e[:, k])}" for e in results]
        print(f"| {method} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
