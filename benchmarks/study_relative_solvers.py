"""Relative pose from noisy correspondences: five against six, seven and eight points, and five and eight together.

Claims: the five-point algorithm beats the others when measurements are noisy (Rodehorst, Heinrichs & Hellwich,
"Evaluation of relative pose estimation methods for multi-camera setups", 2008); the eight-point algorithm and the
five-point algorithm together are better than either (Brückner, Bajramovic & Denzler, "Experimental evaluation of
relative pose estimation algorithms", 2008).

Every trial has 100 correspondences, none of them wrong. A method proposes essential matrices, from as few of them as it
can or from all; of its proposals that with the smallest mean Sampson error over all correspondences counts. A trial is
won by the method whose translation is nearest to the true direction.

python benchmarks/study_relative_solvers.py [--trials N] [--figure FILE]
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine

from vojax.geometry import pose_from_essential, sampson_error
from vojax.lie import SE3, SO3
from vojax.solvers import eight_point, five_point, project_to_essential, seven_point, six_point

POINTS, FOCAL = 100, 700.0  # pixels; images of 900 pixels, 65 degrees
SIGMAS = (0.1, 0.5, 1.0, 2.0, 4.0)
SCENES = ("sideways", "forward", "sideways, plane")
METHODS = ("5 points", "6 points", "7 points", "8 points", "8-point, all points", "5 points and 8-point of all")
CHUNK = 500


def draw(key, sigma, scene):
    """Unit bearings of both views and the motion."""
    keys = jax.random.split(key, 6)
    image = jax.random.uniform(keys[0], (POINTS, 2), minval=-450.0, maxval=450.0) / FOCAL
    slope = jax.random.uniform(keys[1], (2,), minval=-0.5, maxval=0.5)
    depth = jax.random.uniform(keys[2], (POINTS,), minval=4.0, maxval=12.0)
    if scene.endswith("plane"):
        depth = 8.0 / (1.0 + image @ slope)
    points = jnp.concatenate([image, jnp.ones((POINTS, 1))], axis=1) * depth[:, None]
    direction = jnp.array([0.0, 0.0, -1.0] if scene == "forward" else [-1.0, 0.0, 0.0])
    direction = direction + 0.2 * jax.random.normal(keys[3], (3,))
    rotation = SO3.exp(0.1 * jax.random.normal(keys[4], (3,)))
    motion = SE3.from_rotation_and_translation(rotation, direction / jnp.linalg.norm(direction))
    moved = motion.apply(points)
    noise = sigma / FOCAL * jax.random.normal(keys[5], (2, POINTS, 2))
    plane0, plane1 = image + noise[0], moved[:, :2] / moved[:, 2:] + noise[1]
    return plane0, plane1, motion


def bearings(plane):
    rays = jnp.concatenate([plane, jnp.ones_like(plane[:, :1])], axis=1)
    return rays / jnp.linalg.norm(rays, axis=1, keepdims=True)


def trial(key, sigma, scene):
    """Errors of translation and rotation of every method, degrees."""
    plane0, plane1, motion = draw(key, sigma, scene)
    rays0, rays1 = bearings(plane0), bearings(plane1)
    five, six = five_point(rays0[:5], rays1[:5]), six_point(rays0[:6], rays1[:6])
    seven = seven_point(plane0[:7], plane1[:7])
    # In coordinates of the image plane a fundamental matrix is an essential one but for its singular values.
    seven = (jax.vmap(project_to_essential)(seven.models), seven.valid)
    eight, all_points = eight_point(rays0[:8], rays1[:8]), eight_point(rays0, rays1)
    both = (jnp.concatenate([five.models, all_points.models]), jnp.concatenate([five.valid, all_points.valid]))
    proposals = (
        (five.models, five.valid),
        (six.models, six.valid),
        seven,
        (eight.models, eight.valid),
        (all_points.models, all_points.valid),
        both,
    )
    errors = []
    for models, valid in proposals:
        error = jax.vmap(lambda e: jnp.mean(sampson_error(e, plane0, plane1)))(models)
        best = jnp.argmin(jnp.where(valid, error, jnp.inf))
        pose, _ = pose_from_essential(models[best], rays0, rays1)
        cosine = jnp.dot(pose.translation(), motion.translation()) / jnp.linalg.norm(pose.translation() + 1e-30)
        turn = (pose.rotation() @ motion.rotation().inverse()).log()
        translation = jnp.where(valid.any(), jnp.arccos(jnp.clip(cosine, -1.0, 1.0)), jnp.pi)
        errors.append(jnp.stack([translation, jnp.where(valid.any(), jnp.linalg.norm(turn), jnp.pi)]))
    return jnp.rad2deg(jnp.stack(errors))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=100_000, help="per scene and noise")
    parser.add_argument("--figure", help="write a picture of the table here")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    chunks = max(1, arguments.trials // CHUNK)
    print(
        describe_machine(), f"· {chunks * CHUNK} trials a cell, {POINTS} correspondences, focal length {FOCAL:.0f} px"
    )
    table = {}
    solve = jax.jit(
        lambda keys, sigma, scene: jax.lax.map(jax.vmap(lambda key: trial(key, sigma, scene)), keys), static_argnums=2
    )
    for scene in SCENES:
        for sigma in SIGMAS:
            keys = jax.random.split(jax.random.key(0), chunks * CHUNK).reshape(chunks, CHUNK)
            table[scene, sigma] = np.asarray(solve(keys, sigma, scene)).reshape(-1, len(METHODS), 2)
    for scene in SCENES:
        print(f"\n{scene}: median error of the translation in degrees (95 % interval), of the rotation, trials won\n")
        print("| | " + " | ".join(f"{sigma} px" for sigma in SIGMAS) + " |\n" + "|---" * (len(SIGMAS) + 1) + "|")
        for i, method in enumerate(METHODS):
            cells = []
            for sigma in SIGMAS:
                errors = table[scene, sigma]
                low, high = median_interval(errors[:, i, 0])
                # The combination is no rival of its parts.
                won = np.mean(errors[:, i, 0] <= errors[:, :5, 0].min(axis=1))
                middle = np.median(errors[:, i], axis=0)
                cells.append(f"{middle[0]:.3g} ({low:.3g}–{high:.3g}); {middle[1]:.2g}; {100 * won:.0f} %")
            print(f"| {method} | " + " | ".join(cells) + " |")
    if arguments.figure:
        draw_figure(table, arguments.figure)


def median_interval(errors):
    """95 % interval of a median, by order statistics."""
    ordered, n = np.sort(errors), len(errors)
    half = 0.98 * np.sqrt(n)
    return ordered[max(0, int(0.5 * n - half))], ordered[min(n - 1, int(0.5 * n + half))]


def draw_figure(table, path) -> None:
    from vojax.viz import save_figure
    from vojax.viz._figure import new_figure, quiet_axes

    picture = new_figure(9.6, 3.6)
    for k, scene in enumerate(SCENES):
        axes = picture.add_subplot(1, len(SCENES), k + 1)
        quiet_axes(axes)
        for i, method in enumerate(METHODS):
            medians = [np.median(table[scene, sigma][:, i, 0]) for sigma in SIGMAS]
            axes.loglog(SIGMAS, medians, marker="o", markersize=3, label=method)
        axes.set(xlabel="noise, px", title=scene)
        if k == 0:
            axes.set_ylabel("median error of the translation, degrees")
            axes.legend(frameon=False, fontsize=7)
    save_figure(picture, path)


if __name__ == "__main__":
    main()
