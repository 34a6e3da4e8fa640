"""Stereo motion from point pairs: 3-D to 3-D against 3-D to 2-D, and covariances against scalar weights.

Claims (Scaramuzza & Fraundorfer 2011; Maimone, Cheng & Matthies 2007; Matthies & Shafer 1987): motion from 3-D to 2-D
is more accurate than from 3-D to 3-D because the depth of triangulated points is their worst coordinate; weighting by
full covariances beats scalar weights; and where depth is many baselines the pair degenerates to a single camera.

python benchmarks/study_stereo_motion.py [--figure FILE]
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine

from vojax.ba import refine_absolute_pose
from vojax.cameras import Pinhole, RectifiedStereo
from vojax.geometry import triangulate_rectified
from vojax.lie import SE3
from vojax.solvers import procrustes, procrustes_anisotropic

TRIALS, POINTS, SIGMA_PX = 2000, 50, 0.5
RATIOS = (5, 10, 20, 40, 80)  # depth over baseline
STEREO = RectifiedStereo(Pinhole(fx=700.0, fy=700.0, cx=600.0, cy=180.0), baseline=0.5)
TRUTH = SE3.exp(jnp.array([0.1, 0.02, -0.6, 0.01, 0.03, -0.005]))  # frame1_from_frame0: 0.6 m ahead and 1.8 degrees


def draw(key, ratio):
    """Stereo measurements of both frames."""
    keys = jax.random.split(key, 4)
    pixels = jax.random.uniform(keys[0], (POINTS, 2)) * jnp.array([1200.0, 360.0])[None]
    depth = ratio * 0.5 * jax.random.uniform(keys[1], (POINTS, 1), minval=0.6, maxval=1.4)
    points = STEREO.camera.unproject(pixels)
    points = points / points[:, 2:] * depth
    first, second = STEREO.project(points), STEREO.project(TRUTH.apply(points))
    noise = [SIGMA_PX * jax.random.normal(k, (POINTS, 3)) for k in keys[2:]]
    return first + noise[0], second + noise[1]


def motions(key, ratio):
    """The motion by every method."""
    first, second = draw(key, ratio)
    points0, cov0 = jax.vmap(lambda m: triangulate_rectified(m, STEREO, SIGMA_PX))(first)
    points1, cov1 = jax.vmap(lambda m: triangulate_rectified(m, STEREO, SIGMA_PX))(second)
    rigid = procrustes(points0, points1).models
    start = SE3(rigid.wxyz_xyz[0])
    # Variance of the depth grows with its fourth power.
    scalar = procrustes(points0, points1, points1[:, 2] ** -4).models
    full = procrustes_anisotropic(points0, points1, cov0, cov1, 30)
    mono = refine_absolute_pose(start, points0, second[:, :2], STEREO.camera, sigma_px=SIGMA_PX)
    # The noise of the points, brought to the second image, is part of that of the measurement.
    jacobian = jax.vmap(jax.jacfwd(lambda x: STEREO.project(start.apply(x))))(points0)
    spread = SIGMA_PX**2 * jnp.eye(3)[None] + jnp.einsum("nij,njk,nlk->nil", jacobian, cov0, jacobian)
    both = refine_absolute_pose(start, points0, second, STEREO, sigma_px=spread)
    poses = jnp.stack(
        [
            rigid.wxyz_xyz[0],
            scalar.wxyz_xyz[0],
            full.models.wxyz_xyz[0],
            mono.model.wxyz_xyz,
            both.model.wxyz_xyz,
        ]
    )
    return poses, full.valid[0]


NAMES = (
    "3-D to 3-D, equal weights",
    "3-D to 3-D, scalar weights 1/z⁴",
    "3-D to 3-D, covariances",
    "3-D to 2-D, left image, points exact",
    "3-D to 2-D, both images, covariances",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--figure", help="write a picture of the table here")
    figure = parser.parse_args().figure
    jax.config.update("jax_enable_x64", True)
    print(describe_machine(), f"· {TRIALS} trials of {POINTS} points, {SIGMA_PX} px")
    solve = jax.jit(jax.vmap(motions, in_axes=(0, None)))
    table = []
    for ratio in RATIOS:
        poses, valid = solve(jax.random.split(jax.random.key(ratio), TRIALS), jnp.float64(ratio))
        errors = jax.vmap(jax.vmap(lambda p: (SE3(p) @ TRUTH.inverse()).log()))(poses)
        squares = np.sum(np.asarray(errors)[..., :3] ** 2, axis=-1)[np.asarray(valid)]
        # Percentiles of the mean over resampled trials: a 95 % interval of the root mean square.
        rng = np.random.default_rng(0)
        means = np.stack([squares[rng.integers(0, len(squares), len(squares))].mean(axis=0) for _ in range(500)])
        interval = np.sqrt(np.quantile(means, [0.025, 0.975], axis=0))
        table.append((np.sqrt(squares.mean(axis=0)), interval, np.mean(valid)))
    print("| root mean square of the translation, mm | " + " | ".join(f"z = {r} b" for r in RATIOS) + " |")
    print("|---" * (len(RATIOS) + 1) + "|")
    for i, name in enumerate(NAMES):
        cells = [f"{1e3 * rms[i]:.1f} ({1e3 * low[i]:.1f}–{1e3 * high[i]:.1f})" for rms, (low, high), _ in table]
        print(f"| {name} | " + " | ".join(cells) + " |")
    print("share of trials whose weighted alignment converged:", [round(float(share), 4) for *_, share in table])
    if figure:
        draw_figure(table, figure)


def draw_figure(table, path) -> None:
    from vojax.viz import save_figure
    from vojax.viz._figure import new_figure, quiet_axes

    picture = new_figure(6.4, 4.2)
    axes = picture.add_subplot()
    quiet_axes(axes)
    for i, name in enumerate(NAMES):
        axes.loglog(RATIOS, [1e3 * rms[i] for rms, *_ in table], marker="o", markersize=3, label=name)
    axes.set(xlabel="depth / baseline", ylabel="translation error, mm (rms)", title="Stereo motion from 50 point pairs")
    axes.legend(frameon=False, fontsize=8)
    save_figure(picture, path)


if __name__ == "__main__":
    main()
