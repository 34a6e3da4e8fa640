"""Rotation from far points, then the position alone from near ones, against a pose from the near ones.

Tardif, Pavlidis & Daniilidis (2008) separate the two: points at infinity turn with the camera and do not see it move,
and with the rotation known two points make a hypothesis instead of three.

python benchmarks/study_rotation_first.py [--trials 1000]

A camera (800 px, 1280 × 960) moves 1 m and turns 2°. It has 40 near points at 4 to 20 m, known in 3-D, and 100 far ones
of which only the pixels are known, and believes the far ones to be at infinity. Noise is 1 px, the threshold 3 px; of
the far matches 30 % are wrong. Samples are taken sixteen at a time. Intervals are 95 % bootstrap intervals.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine
from jax import Array

from vojax import Result
from vojax.cameras import Pinhole
from vojax.lie import SE3
from vojax.metrics import nees
from vojax.robust import RansacOptions, estimate_absolute_pose, estimate_rotation, estimate_translation

NEAR, FAR, SIGMA_PX = 40, 100, 1.0
SIZE = (1280.0, 960.0)
CAMERA = {"fx": 800.0, "fy": 800.0, "cx": 640.0, "cy": 480.0}
OPTIONS = RansacOptions(threshold_px=3.0, chunk_size=16)
METHODS = ("pose from near points (P3P)", "rotation from far, position from near", "position, true rotation")


def seen(key: Array, n: int, depths: tuple[float, Array], cam1_from_cam0: SE3, wrong: float) -> tuple[Array, ...]:
    """Points in frame 0, their exact pixels there and their noisy pixels in frame 1, the first ones wrong."""
    keys, camera = jax.random.split(key, 4), Pinhole(**CAMERA)
    pixels0 = jax.random.uniform(keys[0], (n, 2)) * jnp.array(SIZE)
    rays = camera.unproject(pixels0)
    points = rays / rays[:, 2:] * jax.random.uniform(keys[1], (n, 1), minval=depths[0], maxval=depths[1])
    pixels1 = camera.project(cam1_from_cam0.apply(points)) + SIGMA_PX * jax.random.normal(keys[2], (n, 2))
    lost = (jnp.arange(n) < wrong * n)[:, None]
    return points, pixels0, jnp.where(lost, jax.random.uniform(keys[3], (n, 2)) * jnp.array(SIZE), pixels1)


def trial(key: Array, far: Array, wrong: Array) -> tuple[Array, Array, Array, Array]:
    """Of each method: errors of position (cm) and rotation (°), samples, success; NEES of the second."""
    keys, camera = jax.random.split(key, 8), Pinhole(**CAMERA)
    shift, axis = (jax.random.normal(k, (3,)) for k in keys[:2])
    xi = jnp.concatenate([shift / jnp.linalg.norm(shift), jnp.radians(2.0) * axis / jnp.linalg.norm(axis)])
    truth = SE3.exp(xi)
    points, _, pixels = seen(keys[2], NEAR, (4.0, jnp.float32(20.0)), truth, wrong)
    _, far0, far1 = seen(keys[3], FAR, (0.5 * far, 1.5 * far), truth, 0.3)
    far0 = far0 + SIGMA_PX * jax.random.normal(keys[4], far0.shape)
    settings = {"options": OPTIONS, "sigma_px": SIGMA_PX}
    pose = estimate_absolute_pose(points, pixels, camera, key=keys[5], **settings)
    turn = estimate_rotation(far0, far1, camera, camera, key=keys[6], **settings)
    position = [
        estimate_translation(points, pixels, camera, rotation, rotation_covariance=covariance, key=keys[7], **settings)
        for rotation, covariance in ((turn.model, turn.covariance), (truth.rotation(), jnp.zeros((3, 3))))
    ]
    found = [pose, *position]
    xi = jnp.stack([(e.model @ truth.inverse()).log() for e in found])
    errors = jnp.stack([100 * jnp.linalg.norm(xi[:, :3], axis=1), jnp.degrees(jnp.linalg.norm(xi[:, 3:], axis=1))])
    success = (
        jnp.stack([e.result == Result.success for e in found])
        .at[1]
        .set((position[0].result == Result.success) & (turn.result == Result.success))
    )
    samples = jnp.stack([e.num_hypotheses for e in found])
    # The identity where there is no covariance to divide by.
    covariance = jnp.where(success[1], position[0].covariance, jnp.eye(6))
    return errors, samples, success, nees(xi[1], covariance)


def median(values: np.ndarray) -> str:
    """With its 95 % interval."""
    rng, n = np.random.default_rng(0), len(values)
    low, high = np.quantile([np.median(values[rng.integers(0, n, n)]) for _ in range(500)], [0.025, 0.975])
    return f"{np.median(values):.3g} ({low:.3g}–{high:.3g})"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=1000)
    trials = parser.parse_args().trials
    print(describe_machine(), f"· {trials} trials")
    keys = jax.random.split(jax.random.key(0), trials)
    solve = jax.jit(jax.vmap(trial, in_axes=(0, None, None)))
    print("| far points, near matches wrong | | position, cm | rotation, 0.01° | mean samples | found | NEES / 6 |")
    print("|---|---|---|---|---|---|---|")
    for far in (100.0, 1000.0, 10000.0):
        for wrong in (0.3, 0.7):
            errors, samples, success, consistency = map(np.asarray, solve(keys, jnp.float32(far), jnp.float32(wrong)))
            good = success.all(axis=1)
            for m, method in enumerate(METHODS):
                turn = "0" if m == 2 else median(100 * errors[good, 1, m])
                place = f"{far:.0f} m, {wrong:.0%}" if m == 0 else ""
                share = f"{consistency[good].mean() / 6:.2f}" if m == 1 else ""
                print(
                    f"| {place} | {method} | {median(errors[good, 0, m])} | {turn} | "
                    f"{samples[:, m].mean():.0f} | {success[:, m].mean():.3f} | {share} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
