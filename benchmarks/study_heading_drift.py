"""How drift grows with distance, with and without a sensor of absolute orientation.

Claim: errors of orientation make the position error grow faster than the distance; with an absolute orientation it
grows no faster than it (Olson, Matthies, Schoppers & Maimone, "Rover navigation using stereo ego-motion", 2003).

A camera goes straight on, a metre a step. Every relative pose has Gaussian noise in its camera-frame tangent; the prior
is an absolute orientation with white noise and a constant error of its mounting, fused by a Kalman gain in its steady
state. The position error over trials is fitted by c · distance^p between 50 and 1,000 steps.

    python benchmarks/study_heading_drift.py [--trials N] [--figure FILE]
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine

from vojax.lie import SE3, SO3

STEPS = 1000
TRANSLATION, ROTATION = 0.005, 0.05  # deviations of a step, metres and degrees: what the stereo pipeline has on KITTI
CASES = {  # white noise and mounting error of the orientation sensor, degrees
    "no absolute orientation": None,
    "white noise of 1°": (1.0, 0.0),
    "white noise of 1°, mounted 0.1° off": (1.0, 0.1),
    "white noise of 0.1°": (0.1, 0.0),
}


def gain(noise: float) -> float:
    """Of the steady state of a random walk of `ROTATION` a step, observed with `noise`."""
    ratio = (ROTATION / noise) ** 2
    return float((-ratio + np.sqrt(ratio**2 + 4 * ratio)) / 2)


def drive(key, sensor) -> jax.Array:
    """Position errors along one path, `[STEPS]`; the true orientation is the identity."""
    keys = jax.random.split(key, 3)
    deviation = jnp.concatenate([jnp.full(3, TRANSLATION), jnp.full(3, np.deg2rad(ROTATION))])
    noise = deviation[None] * jax.random.normal(keys[0], (STEPS, 6))
    forward = SE3.exp(jnp.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    if sensor is None:
        weight, readings = 0.0, jnp.zeros((STEPS, 3))
    else:
        weight = gain(sensor[0])
        offset = np.deg2rad(sensor[1]) * jax.random.normal(keys[2], (1, 3))
        readings = np.deg2rad(sensor[0]) * jax.random.normal(keys[1], (STEPS, 3)) + offset

    def step(world_from_cam, inputs):
        noise, reading = inputs
        moved = world_from_cam @ forward @ SE3.exp(noise)
        # Towards the measured orientation, by the gain.
        measured = SO3.exp(reading)
        rotation = moved.rotation()
        rotation = rotation @ SO3.exp(weight * (rotation.inverse() @ measured).log())
        moved = SE3.from_rotation_and_translation(rotation, moved.translation())
        return moved, moved.translation()

    _, positions = jax.lax.scan(step, SE3.identity(), (noise, readings))
    straight = jnp.arange(1, STEPS + 1)[:, None] * jnp.array([0.0, 0.0, 1.0])[None]
    return jnp.linalg.norm(positions - straight, axis=-1)


def main() -> None:
    """Print the table and draw it, if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--figure", metavar="FILE")
    arguments = parser.parse_args()
    print(describe_machine())
    print("| sensor | exponent | error after 100 m | after 1000 m |\n|---|---:|---:|---:|")
    distance, curves = np.arange(1, STEPS + 1), {}
    for name, sensor in CASES.items():
        keys = jax.random.split(jax.random.key(0), arguments.trials)
        errors = np.asarray(jax.jit(jax.vmap(lambda key, sensor=sensor: drive(key, sensor)))(keys), float)
        curves[name] = rms = np.sqrt(np.mean(errors**2, axis=0))
        exponent, _ = np.polyfit(np.log(distance[49:]), np.log(rms[49:]), 1)
        print(f"| {name} | {exponent:.2f} | {rms[99]:.2f} m | {rms[-1]:.2f} m |", flush=True)
    if arguments.figure:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
        for name, rms in curves.items():
            axes.loglog(distance, rms, label=name)
        axes.set(xlabel="distance, m", ylabel="root mean square position error, m")
        axes.legend(frameon=False)
        figure.savefig(arguments.figure, dpi=130)


if __name__ == "__main__":
    main()
