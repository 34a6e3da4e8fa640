"""Absolute pose by EPnP over the number of points and the noise: errors and time.

Claims of Aufderheide, Krybus & Edwards 2012, figure 5, for 0 to 100 points and noise of 0 to 10 px: errors of
translation and of reprojection rise with the noise and fall with the number of points; a solution takes no more than
0.01 s; the error of rotation, the mean angle of the three axes, is 0.69 to 0.72 everywhere (panel b).

The source says nothing of its scene. Ours: 640 x 480 pixels, f = 600 px, points at depths of 4 to 12 m all over the
image, a camera up to 10 m from the origin in any orientation. Rotation errors are the angle between the rotations
(geodesic) and the mean of the angles between their axes. The error of reprojection is the root mean square distance to
the measured pixels. EPnP with vojax' Gauss-Newton steps, and without any as it was published.

Panel (b) is then evaluated by slips: on the true rotation of 30° about the vertical axis, and on any rotation, the
estimate is compared with the transpose, or with the truth turned by a fixed angle.

python benchmarks/study_epnp.py [--trials N]
"""

import argparse
import functools

import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine, time_jitted

from vojax.lie import SE3, SO3
from vojax.metrics import axis_rotation_error_deg, reprojection_rmse, rotation_error_deg, translation_error
from vojax.solvers import epnp

FOCAL, HALF_IMAGE = 600.0, np.array([320.0, 240.0])
FIXED = np.radians(30.0)  # a pose that gives the plateau of panel (b); there are others
NUMBERS = (4, 5, 6, 8, 10, 15, 20, 40, 70, 100)
SIGMAS = (0.0, 0.1, 0.5, 1.0, 2.0, 4.0, 7.0, 10.0)
CHUNK, TIMED = 500, (4, 10, 40, 100)
ERRORS = ("translation, m", "rotation, °", "mean axis angle, °", "reprojection, px")
SLIPS = ("none", "transposed", "truth turned by 60° about y", "radians read as degrees", "dot product for angle")


def draw(key, sigma, points):
    """Points in the camera, their measured places on the plane z = 1, and a place for the camera."""
    keys = jax.random.split(key, 4)
    half = jnp.asarray(HALF_IMAGE) / FOCAL
    plane = half[None] * jax.random.uniform(keys[0], (points, 2), minval=-1.0)
    depth = jax.random.uniform(keys[1], (points, 1), minval=4.0, maxval=12.0)
    noisy = plane + sigma / FOCAL * jax.random.normal(keys[2], (points, 2))
    position = jax.random.uniform(keys[3], (3,), minval=-10.0, maxval=10.0)
    return homogeneous(plane) * depth, noisy, position


def homogeneous(plane):
    return jnp.concatenate([plane, jnp.ones_like(plane[:, :1])], axis=1)


def solved(key, sigma, count, rotation, padded, steps):
    """The estimate, the truth and what was seen: `count` of `padded` points, so that one compilation serves many."""
    seen, noisy, position = draw(key, sigma, padded)
    true = SE3.from_rotation_and_translation(rotation, -rotation.apply(position))
    world = true.inverse().apply(seen)
    counted = jnp.arange(padded) < count
    found = epnp(world, homogeneous(noisy), 1.0 * counted, gauss_newton_steps=steps)
    return SE3(found.models.parameters()[0]), true, world, noisy, counted, found.valid[0]


def trial(key, sigma, count, fixed, padded, steps):
    """The four errors, and the slips; NaN where there is no solution. `fixed` takes the rotation that does not vary."""
    key_rotation, key = jax.random.split(key)
    any_rotation = SO3.sample_uniform(key_rotation).parameters()
    rotation = SO3(jnp.where(fixed, SO3.exp(about_y(FIXED)).parameters(), any_rotation))
    pose, true, world, noisy, counted, valid = solved(key, sigma, count, rotation, padded, steps)
    found, moved = pose.rotation(), pose.apply(world)
    errors = (
        translation_error(pose.translation(), true.translation()),
        rotation_error_deg(found, rotation),
        axis_rotation_error_deg(found, rotation),
        reprojection_rmse(FOCAL * moved[:, :2] / moved[:, 2:], FOCAL * noisy, counted),
    )
    right = jnp.deg2rad(errors[2])
    slips = (
        right,
        jnp.deg2rad(axis_rotation_error_deg(found.inverse(), rotation)),
        jnp.deg2rad(axis_rotation_error_deg(found, SO3.exp(about_y(2.0 * FIXED)) @ rotation)),
        jnp.deg2rad(right),
        jnp.trace((rotation.inverse() @ found).as_matrix()) / 3.0,
    )
    return jnp.where(valid, jnp.stack([*errors, *slips]), jnp.nan)


def about_y(angle):
    return jnp.array([0.0, 1.0, 0.0]) * angle


@functools.partial(jax.jit, static_argnums=(0, 3))
def solve(function, keys, arguments, options):
    return jax.vmap(lambda key: function(key, *arguments, *options))(keys)


def run(trials, sigma, count, fixed, options):
    """What `trial` gives for that many keys, rounded up to whole chunks."""
    keys = jax.random.split(jax.random.key(0), -(-trials // CHUNK) * CHUNK).reshape(-1, CHUNK)
    return np.concatenate([solve(trial, chunk, (sigma, count, fixed), options) for chunk in keys])


def surface(trials, steps, numbers=NUMBERS, sigmas=SIGMAS):
    """Errors [numbers, sigmas, trials, 4]."""
    # Below six points EPnP looks at several minima, so these have a shape of their own.
    options = {n: (5 if n < 6 else max(numbers), steps) for n in numbers}
    return np.array([[run(trials, sigma, n, False, options[n])[:, :4] for sigma in sigmas] for n in numbers])


def slip_table(trials, fixed, numbers=(6, 20, 100), sigmas=(0.1, 1.0, 10.0)):
    """Mean of each slip: [slips, numbers, sigmas]."""
    means = [[np.nanmean(run(trials, s, n, fixed, (max(numbers), 8))[:, 4:], axis=0) for s in sigmas] for n in numbers]
    return np.moveaxis(np.array(means), 2, 0)


def median_interval(errors):
    """Median and its 95 % interval, by order statistics, of the solved."""
    ordered = np.sort(errors[np.isfinite(errors)])
    n, half = len(ordered), 0.98 * np.sqrt(len(ordered))
    return ordered[np.clip((0.5 * n + np.array([0.0, -half, half])).astype(int), 0, n - 1)]


def header(columns):
    return "| | " + " | ".join(columns) + " |\n" + "|---" * (len(columns) + 1) + "|"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=2_000, help="per cell")
    trials = parser.parse_args().trials
    jax.config.update("jax_enable_x64", True)
    print(describe_machine(), f"· {trials} trials a cell, float64")
    for steps in (8, 0):
        errors = surface(trials, steps)
        unsolved = np.isnan(errors[..., 0]).mean()
        for k, name in enumerate(ERRORS):
            print(f"\n{name}: median (95 %), {steps} Gauss-Newton steps; without solution {100 * unsolved:.3f} %\n")
            print(header([f"{sigma:g} px" for sigma in SIGMAS]))
            for n, row in zip(NUMBERS, errors, strict=True):
                cells = [median_interval(cell[:, k]) for cell in row]
                print(f"| {n} | " + " | ".join("{:.3g} ({:.3g}–{:.3g})".format(*cell) for cell in cells) + " |")
    print("\nTime, ms: one problem a call; of 1,000 in one call, each\n")
    print(header([str(n) for n in TIMED]))
    single, batch = [], []
    for n in TIMED:
        seen, noisy, _ = jax.vmap(lambda key, n=n: draw(key, 1.0, n))(jax.random.split(jax.random.key(2), 1000))
        rays = jax.vmap(homogeneous)(noisy)
        single.append(time_jitted(epnp, seen[0], rays[0], seconds=0.5).best)
        batch.append(time_jitted(jax.vmap(epnp), seen, rays, seconds=0.5).best / 1000)
    for name, times in (("one", single), ("in a batch", batch)):
        print(f"| {name} | " + " | ".join(f"{1e3 * t:.3g}" for t in times) + " |")
    for name, fixed in (("30° about y", True), ("any rotation", False)):
        print(f"\nWhat panel (b) would show after a slip: mean axis angle, radians; the true pose is {name}\n")
        print(header([f"{n} points, {sigma:g} px" for n in (6, 20, 100) for sigma in (0.1, 1.0, 10.0)]))
        for slip, means in zip(SLIPS, slip_table(trials, fixed), strict=True):
            print(f"| {slip} | " + " | ".join(f"{mean:.3f}" for mean in means.ravel()) + " |")


if __name__ == "__main__":
    main()
