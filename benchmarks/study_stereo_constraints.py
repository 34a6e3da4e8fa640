"""Motion of a stereo pair from pixels alone, without a triangulated point, against methods that have one.

Comport, Malis & Rives (2007) estimate the motion from constraints on the four images of a point. Here two ways to do
without the point: the epipolar constraints left–left, left–right and right–left between the two frames, whitened
together by the noise of the six coordinates that they share; and the reprojection errors with the point optimised out,
which is the bundle of two frames (`adjust_window`).

python benchmarks/study_stereo_constraints.py [--trials 1000]

50 points at depths of 0.6 to 1.4 z, 0.5 px of noise in all coordinates, f = 700 px, b = 0.5 m, float64. The epipolar
constraints start from 3-D to 3-D, the other iterations from the truth. Intervals are 95 % bootstrap intervals over
trials, which all methods share.
"""

import argparse
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine
from jax import Array

from vojax.ba import LMOptions, Squared, adjust_window, refine_absolute_pose, refine_model, whitening
from vojax.ba._whitening import whiten
from vojax.cameras import Pinhole, RectifiedStereo
from vojax.geometry import triangulate_rectified
from vojax.lie import SE3
from vojax.solvers import procrustes_anisotropic

POINTS, SIGMA_PX, BASELINE = 50, 0.5, 0.5
RATIOS = (5, 10, 20, 40, 80)  # depth over baseline
MOTIONS = {
    "ahead": (0.0, 0.0, -0.6, 0.01, 0.03, -0.005),
    "ahead and up": (0.1, 0.3, -0.5, 0.01, 0.03, -0.005),
}  # logarithms of cam1_from_cam0
OPTIONS = LMOptions(max_steps=30, tolerance=1e-9)
METHODS = (
    "3-D to 3-D, covariances",
    "3-D to 2-D, both images, covariances",
    "epipolar constraints",
    "two-frame bundle",
)


def rig() -> RectifiedStereo:
    """The stereo pair."""
    return RectifiedStereo(Pinhole(fx=700.0, fy=700.0, cx=600.0, cy=180.0), baseline=BASELINE)


def constraints(z: Array, motion: SE3) -> Array:
    """r1ᵀ [R c0 + t − c1]× R r0 for cameras at c0 and c1 in their frames: left–left, left–right, right–left."""
    camera = rig().camera
    left = jnp.zeros(3)
    right = left.at[0].set(BASELINE)
    pixels = jnp.stack([z[jnp.array(rows)] for rows in ((0, 1), (2, 1), (3, 4), (5, 4))])
    left0, right0, left1, right1 = camera.unproject(pixels)
    values = []
    for ray0, center0, ray1, center1 in (
        (left0, left, left1, left),
        (left0, left, right1, right),
        (right0, right, left1, left),
    ):
        turned = motion.rotation().apply(ray0)
        values.append(jnp.dot(ray1, jnp.cross(motion.apply(center0) - center1, turned)))
    return jnp.stack(values)


class StereoEpipolarProblem(eqx.Module):
    """`cam1_from_cam0` against measurements of both frames; the tangent is in camera 1."""

    measurements: Array  # [n, 6]: u_left, v, u_right of frame 0 and of frame 1
    tangent_dim: ClassVar[int] = 6

    @staticmethod
    def retract(model: SE3, tangent: Array) -> SE3:
        """exp(−ξ) @ cam1_from_cam0."""
        return SE3.exp(-tangent) @ model

    def residual(self, model: SE3) -> tuple[Array, ...]:
        """L⁻¹ e with L Lᵀ = σ² G Gᵀ and G the derivative of e by the six coordinates."""

        def slopes(z: Array) -> Array:
            return jax.jacfwd(constraints)(z, model)

        slope = jax.vmap(slopes)(self.measurements)
        spread = SIGMA_PX**2 * jnp.einsum("nij,nkj->nik", slope, slope)
        errors = jax.vmap(lambda z: constraints(z, model))(self.measurements)
        return whiten(whitening(spread, errors.shape[:1], 3, errors.dtype), tuple(errors.T))


def trial(key: Array, poses: Array, ratio: Array) -> Array:
    """Error of the motion `[methods, 6]`, in camera 1."""
    stereo, truth = rig(), SE3(poses[1]).inverse()
    keys = jax.random.split(key, 3)
    pixels = jax.random.uniform(keys[0], (POINTS, 2)) * jnp.array([1200.0, 360.0])
    rays = stereo.camera.unproject(pixels)
    depth = ratio * BASELINE * jax.random.uniform(keys[1], (POINTS, 1), minval=0.6, maxval=1.4)
    points = rays / rays[:, 2:] * depth
    exact = jnp.stack([stereo.project(points), stereo.project(truth.apply(points))])
    first, second = noisy = exact + SIGMA_PX * jax.random.normal(keys[2], exact.shape)
    points0, cov0 = jax.vmap(lambda m: triangulate_rectified(m, stereo, SIGMA_PX))(first)
    points1, cov1 = jax.vmap(lambda m: triangulate_rectified(m, stereo, SIGMA_PX))(second)
    full = procrustes_anisotropic(points0, points1, cov0, cov1, 30).models.wxyz_xyz[0]
    # The noise of the points, brought to the second frame's images, is part of that of the measurement.
    jacobian = jax.vmap(jax.jacfwd(lambda x: stereo.project(truth.apply(x))))(points0)
    spread = SIGMA_PX**2 * jnp.eye(3) + jnp.einsum("nij,njk,nlk->nil", jacobian, cov0, jacobian)
    pose = refine_absolute_pose(truth, points0, second, stereo, sigma_px=spread, options=OPTIONS).model.wxyz_xyz
    pairs = StereoEpipolarProblem(jnp.concatenate([first, second], axis=1))
    epipolar = refine_model(SE3(full), pairs, options=OPTIONS).model.wxyz_xyz
    settings: dict[str, Any] = {"sigma_px": SIGMA_PX, "loss": Squared(), "options": OPTIONS}
    bundle = adjust_window(SE3(poses), points0, noisy, jnp.ones((2, POINTS), bool), stereo, **settings)
    found = SE3(jnp.stack([full, pose, epipolar, SE3(bundle.world_from_cam.wxyz_xyz[1]).inverse().wxyz_xyz]))
    return (found @ truth.inverse()).log()


def interval(values: np.ndarray, statistic: Any) -> str:
    """A statistic of the trials with its 95 % interval."""
    rng, n = np.random.default_rng(0), len(values)
    low, high = np.quantile([statistic(values[rng.integers(0, n, n)]) for _ in range(500)], [0.025, 0.975])
    return f"{statistic(values):.3g} ({low:.3g}–{high:.3g})"


def rms(errors: np.ndarray) -> float:
    """Root mean square of the lengths of the rows."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1))))


def main() -> None:
    """Print a table for each motion."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=1000)
    trials = parser.parse_args().trials
    jax.config.update("jax_enable_x64", True)
    print(describe_machine(), f"· {trials} trials")
    solve = jax.jit(jax.vmap(trial, in_axes=(0, 0, None)))
    for name, motion in MOTIONS.items():
        poses = SE3.exp(jnp.stack([jnp.zeros(6), -jnp.array(motion)])).wxyz_xyz
        poses = jnp.broadcast_to(poses, (trials, 2, 7))
        keys = jax.random.split(jax.random.key(0), trials)
        errors = [np.asarray(solve(keys, poses, jnp.float64(ratio))) for ratio in RATIOS]
        print(f"\n| {name}: translation, mm | " + " | ".join(f"z = {r} b" for r in RATIOS) + " |")
        print("|---" * (len(RATIOS) + 1) + "|")
        for m, method in enumerate(METHODS):
            cells = [interval(1e3 * e[:, m, :3], rms) for e in errors]
            print(f"| {method} | " + " | ".join(cells) + " |")
        for m, method in enumerate(METHODS[:3]):
            cells = [interval(e[:, :, :3], lambda x, m=m: rms(x[:, m]) / rms(x[:, 3])) for e in errors]
            print(f"| {method}, over the bundle | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
