"""A fundamental matrix from the homographies of two planes: by their equations, by virtual points, or from the points.

Claim: F from two or more homographies is poor, and virtual points do better (a course on plane-based geometry). A
homography H of a plane leaves Hᵀ F + Fᵀ H = 0, six equations linear in F; two planes determine it. Or each homography
moves a grid of virtual points, and the eight-point algorithm takes those. Both see only what two homographies hold of
their 50 points each; the eight-point algorithm on the points themselves sees everything.

Judged by the RMS Sampson distance, in pixels, of 200 points without noise all over the scene.

python benchmarks/study_plane_fundamental.py [--trials 20000]
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine

from vojax.geometry import sampson_error
from vojax.lie import SE3, SO3
from vojax.solvers import fundamental_eight_point, homography_dlt

FOCAL, SIZE, PER_PLANE, CHECKED = 700.0, 900.0, 50, 200
SIGMAS = (0.1, 0.3, 1.0, 3.0)
METHODS = ("equations of the homographies", "virtual points", "the points themselves")
CHUNK = 500


def project(points):
    return FOCAL * points[:, :2] / points[:, 2:] + 0.5 * SIZE


def draw(key):
    """Points of two planes that meet in a wall's corner, points all over, and the motion."""
    keys = jax.random.split(key, 6)
    image = jax.random.uniform(keys[0], (2, PER_PLANE, 2), minval=-0.5, maxval=0.5) * SIZE / FOCAL
    # The left half of the image sees one plane, the right half the other.
    half = 0.25 * SIZE / FOCAL
    image = image.at[..., 0].set(0.5 * image[..., 0] + jnp.array([-half, half])[:, None])
    slope = jnp.array([-0.8, 0.8])[:, None] + 0.2 * jax.random.normal(keys[1], (2, 1))
    planes = 8.0 / (1.0 + slope * image[..., 0])
    everywhere = jax.random.uniform(keys[2], (CHECKED, 3), minval=-1.0)
    everywhere = everywhere * jnp.array([2.5, 2.5, 3.0])[None] + jnp.array([0.0, 0.0, 8.0])[None]
    direction = jnp.array([-1.0, 0.0, 0.0]) + 0.3 * jax.random.normal(keys[3], (3,))
    rotation = SO3.exp(0.1 * jax.random.normal(keys[4], (3,)))
    motion = SE3.from_rotation_and_translation(rotation, direction / jnp.linalg.norm(direction))
    points = jnp.concatenate([image, jnp.ones_like(image[..., :1])], axis=-1) * planes[..., None]
    return points.reshape(-1, 3), everywhere, motion, keys[5]


def of_homographies(homographies):
    """The F of norm one that fits Hᵀ F + Fᵀ H = 0 best for all H, in coordinates of order one."""
    rows = []
    for h in homographies:
        for i in range(3):
            for j in range(i, 3):
                row = jnp.zeros((3, 3)).at[:, j].add(h[:, i]).at[:, i].add(h[:, j])
                rows.append(row.reshape(9))
    matrix = jnp.stack(rows)
    matrix = matrix / jnp.linalg.norm(matrix, axis=1, keepdims=True)
    u, s, vt = jnp.linalg.svd(jnp.linalg.svd(matrix)[2][-1].reshape(3, 3))
    return u @ jnp.diag(s.at[2].set(0.0)) @ vt


def trial(key, sigma):
    """RMS distances of every method, pixels."""
    points, everywhere, motion, key = draw(key)
    noise = sigma * jax.random.normal(key, (2, len(points), 2))
    pixels0, pixels1 = project(points) + noise[0], project(motion.apply(points)) + noise[1]
    # In units of half the image about its centre.
    to_unit = jnp.array([[2 / SIZE, 0, -1.0], [0, 2 / SIZE, -1.0], [0, 0, 1.0]])
    unit0, unit1 = (2.0 * pixels / SIZE - 1.0 for pixels in (pixels0, pixels1))
    planes = [slice(0, PER_PLANE), slice(PER_PLANE, None)]
    homographies = [homography_dlt(unit0[part], unit1[part]).models[0] for part in planes]
    virtual0, virtual1 = [], []
    steps = jnp.stack(jnp.meshgrid(jnp.linspace(-1.0, 0.0, 5), jnp.linspace(-1.0, 1.0, 10)), axis=-1).reshape(-1, 2)
    for homography, shift in zip(homographies, (0.0, 1.0), strict=True):
        grid = steps + jnp.array([shift, 0.0])[None]
        moved = grid @ homography[:, :2].T + homography[:, 2][None]
        virtual0.append(grid)
        virtual1.append(moved[:, :2] / moved[:, 2:])
    found = (
        of_homographies(homographies),
        fundamental_eight_point(jnp.concatenate(virtual0), jnp.concatenate(virtual1)).models[0],
        fundamental_eight_point(unit0, unit1).models[0],
    )
    checks = project(everywhere), project(motion.apply(everywhere))
    errors = []
    for f in found:
        f = to_unit.T @ f @ to_unit
        errors.append(jnp.sqrt(jnp.mean(sampson_error(f / jnp.linalg.norm(f), *checks))))
    return jnp.stack(errors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=20_000, help="per noise")
    chunks = max(1, parser.parse_args().trials // CHUNK)
    jax.config.update("jax_enable_x64", True)
    print(describe_machine(), f"· {chunks * CHUNK} trials a cell; median RMS distance, px (95 % interval)\n")
    solve = jax.jit(lambda keys, sigma: jax.lax.map(jax.vmap(lambda key: trial(key, sigma)), keys))
    errors = {}
    for sigma in SIGMAS:
        keys = jax.random.split(jax.random.key(0), chunks * CHUNK).reshape(chunks, CHUNK)
        errors[sigma] = np.asarray(solve(keys, sigma)).reshape(-1, len(METHODS))
    print("| | " + " | ".join(f"{sigma} px" for sigma in SIGMAS) + " |\n" + "|---" * (len(SIGMAS) + 1) + "|")
    for i, method in enumerate(METHODS):
        cells = []
        for sigma in SIGMAS:
            ordered = np.sort(errors[sigma][:, i])
            half = 0.98 * np.sqrt(len(ordered))
            low, middle, high = ordered[(0.5 * len(ordered) + np.array([-half, 0, half])).astype(int)]
            cells.append(f"{middle:.3g} ({low:.3g}–{high:.3g})")
        print(f"| {method} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
