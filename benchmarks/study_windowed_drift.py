"""Drift over ten kilometres: frame to frame, windows that forget, and windows that marginalise.

python benchmarks/study_windowed_drift.py [--seeds 20] [--length 10000] [--step 2] [--track 5] [--float32-too]

A stereo rig (400 px, 0.54 m, 640 × 240) drives past landmarks at 4 to 40 m. In every keyframe 20 landmarks begin; they
are seen in it and the next four (`--track` keyframes in all) while in the image, with 0.5 px of noise on each
coordinate. "Points as exact" is what odometries did when windows were first compared with them: triangulate in one
keyframe, minimise the reprojection in the next. "Frame to frame" is the best estimate from two keyframes at a time,
landmarks adjusted too; the windows have a keyframe more than a track and start from it.
Drift is the end position's error over the length of the path. Intervals are 95 % bootstrap intervals over drives, which
all methods share; of float32 only the solves are, on the same measurements.

Windows live in the frame of their oldest keyframe, and relative poses are chained in float64: nothing in float32 knows
how long the path is.
"""

import argparse
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from vojax.ba import LMOptions, Squared, WindowPrior, adjust_window, marginalize_oldest, refine_absolute_pose
from vojax.cameras import Pinhole, RectifiedStereo
from vojax.datasets import motion_profile
from vojax.lie import SE3

NEW = 20  # landmarks that begin in a keyframe
SIZE, DEPTHS, SIGMA_PX = (640, 240), (4.0, 40.0), 0.5
OPTIONS = LMOptions(max_steps=8, tolerance=1e-5)


class Drive(NamedTuple):
    """A path and what was seen: group f begins in keyframe f, entry t is its view from keyframe f + t."""

    world_from_cam: SE3
    measurements: Array  # [frames, track, NEW, 3]
    visible: Array  # [frames, track, NEW]


def rig(dtype: Any) -> RectifiedStereo:
    focal, cx, cy, baseline = (jnp.asarray(v, dtype) for v in (400.0, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2, 0.54))
    stereo = RectifiedStereo(Pinhole(fx=focal, fy=focal, cx=cx, cy=cy), baseline)
    return jax.tree.map(lambda leaf: leaf.astype(dtype), stereo)  # the skew is of the default precision


def simulate(seed: int, frames: int, step: float, track: int) -> Drive:
    """A drive, in float64."""
    rng, stereo = np.random.default_rng(seed), rig(jnp.float64)
    # Poses beyond the end, so that every group has all its views.
    poses = motion_profile(frames + track, key=jax.random.key(seed), step=step, dtype=jnp.float64)
    depth = rng.uniform(*DEPTHS, (frames, NEW))
    disparity = float(stereo.camera.fx * stereo.baseline) / depth
    u = disparity + rng.uniform(size=depth.shape) * (SIZE[0] - 1 - disparity)
    v = rng.uniform(0, SIZE[1] - 1, depth.shape)
    local = stereo.unproject(jnp.asarray(np.stack([u, v, u - disparity], axis=-1)))
    later = np.arange(frames)[:, None] + np.arange(track)
    cam_from_first = SE3(poses.wxyz_xyz[later]).inverse() @ SE3(poses.wxyz_xyz[:frames, None])
    points = SE3(cam_from_first.wxyz_xyz[:, :, None]).apply(local[:, None])
    exact = np.asarray(stereo.project(points))
    inside = (exact >= 0) & (exact <= np.array([SIZE[0] - 1, SIZE[1] - 1, SIZE[0] - 1]))
    visible = np.all(inside, axis=-1) & (np.asarray(points)[..., 2] > 1.0)
    noisy = exact + SIGMA_PX * rng.normal(size=exact.shape)
    measurements = np.where(visible[..., None], noisy, 0.0)
    return Drive(SE3(poses.wxyz_xyz[:frames]), jnp.asarray(measurements), jnp.asarray(visible))


def two_frame_motions(drive: Drive, step: float, adjust_points: bool) -> SE3:
    """cam_k_from_cam_{k+1} of all consecutive pairs."""
    (frames, track, _), dtype = drive.visible.shape, drive.measurements.dtype
    ages = jnp.arange(track - 1)  # of a group in the first frame of a pair

    def motion(k: Array) -> Array:
        group = jnp.maximum(k - ages, 0)
        pairs = jnp.stack([drive.measurements[group, ages], drive.measurements[group, ages + 1]])
        seen = drive.visible[group, ages] & drive.visible[group, ages + 1] & (k >= ages)[:, None]
        pairs, seen = pairs.reshape(2, -1, 3), seen.reshape(-1)
        start = jnp.zeros((2, 7), dtype).at[:, 0].set(1.0).at[1, 6].set(step)
        points, settings = rig(dtype).unproject(pairs[0]), {"sigma_px": SIGMA_PX, "options": OPTIONS}
        if not adjust_points:
            posed = refine_absolute_pose(SE3(start[1]).inverse(), points, pairs[1], rig(dtype), mask=seen, **settings)
            return posed.model.inverse().wxyz_xyz
        both = jnp.broadcast_to(seen[None], (2, seen.shape[0]))
        found = adjust_window(SE3(start), points, pairs, both, rig(dtype), loss=Squared(), **settings)
        return found.world_from_cam.wxyz_xyz[1]

    return SE3(jax.vmap(motion)(jnp.arange(frames - 1)))


def windowed_motions(drive: Drive, motions: SE3, remember: bool) -> SE3:
    """The same from sliding windows, each motion as it is when its first keyframe leaves."""
    (frames, track, _), dtype = drive.visible.shape, drive.measurements.dtype
    window, stereo = track + 1, rig(dtype)
    age = np.arange(window)[:, None] - np.arange(window)[None]  # of a group in a keyframe
    there = jnp.asarray((age >= 0) & (age < track))
    age = jnp.asarray(np.clip(age, 0, track - 1))
    groups = jnp.arange(window)[None]

    def chain(pose: Array, motion: Array) -> tuple[Array, Array]:
        return (SE3(pose) @ SE3(motion)).wxyz_xyz, pose

    last, before = jax.lax.scan(chain, SE3.identity(dtype=dtype).wxyz_xyz, motions.wxyz_xyz[: window - 1])
    poses = jnp.concatenate([before, last[None]])
    points = SE3(poses[:, None]).apply(stereo.unproject(drive.measurements[:window, 0]))

    def advance(carry: tuple[Array, Array, WindowPrior], k: Array) -> tuple[Any, Array]:
        poses, points, prior = carry
        measured = jax.lax.dynamic_slice_in_dim(drive.measurements, k, window)[groups, age]
        seen = jax.lax.dynamic_slice_in_dim(drive.visible, k, window)[groups, age] & there[..., None]
        data = (measured.reshape(window, -1, 3), seen.reshape(window, -1), stereo)
        settings = {"sigma_px": SIGMA_PX, "prior": prior, "loss": Squared()}
        found = adjust_window(SE3(poses), points.reshape(-1, 3), *data, options=OPTIONS, **settings)
        estimate = found.world_from_cam
        first, second = SE3(estimate.wxyz_xyz[0]), SE3(estimate.wxyz_xyz[1])
        # Everything moves into the frame of the next window's oldest keyframe.
        onward = second.inverse()
        if remember:
            prior = marginalize_oldest(estimate, found.points_world, *data, **settings).moved(onward)
        new_motion = jax.lax.dynamic_index_in_dim(motions.wxyz_xyz, k + window - 1, keepdims=False)
        newest = (onward @ SE3(estimate.wxyz_xyz[-1]) @ SE3(new_motion)).normalize()
        new_group = jax.lax.dynamic_index_in_dim(drive.measurements, k + window, keepdims=False)[0]
        poses = jnp.concatenate([(onward @ SE3(estimate.wxyz_xyz[1:])).wxyz_xyz, newest.wxyz_xyz[None]])
        kept = onward.apply(found.points_world.reshape(window, NEW, 3)[1:])
        points = jnp.concatenate([kept, newest.apply(stereo.unproject(new_group))[None]])
        return (poses, points, prior), (first.inverse() @ second).wxyz_xyz

    start = (poses, points, WindowPrior.none(SE3(poses)))
    (poses, _, _), found = jax.lax.scan(advance, start, jnp.arange(frames - window))
    rest = SE3(poses[:-1]).inverse() @ SE3(poses[1:])
    return SE3(jnp.concatenate([found, rest.wxyz_xyz]))


def end_errors(drives: Drive, step: float, dtype: Any) -> np.ndarray:
    """Distance of the estimated end of each drive from the true one, by method [4, drives]."""
    measured = Drive(drives.world_from_cam, drives.measurements.astype(dtype), drives.visible)
    axes = (Drive(None, 0, 0),)  # type: ignore[arg-type]

    @jax.jit
    def estimate(measured: Drive) -> list[Array]:
        exact, motions = (
            jax.vmap(functools.partial(two_frame_motions, step=step, adjust_points=adjust), in_axes=axes)(measured)
            for adjust in (False, True)
        )
        windows = [
            jax.vmap(lambda drive, motions, r=r: windowed_motions(drive, motions, r), in_axes=(*axes, 0))(
                measured, motions
            )
            for r in (False, True)
        ]
        return [found.wxyz_xyz for found in (exact, motions, *windows)]

    truth = np.asarray(drives.world_from_cam.wxyz_xyz[:, -1, 4:])
    return np.stack([np.linalg.norm(end_positions(np.asarray(m, float)) - truth, axis=1) for m in estimate(measured)])


def end_positions(motions: np.ndarray) -> np.ndarray:
    """Positions at the end of chained motions [drives, frames, 7], in float64."""
    matrices = np.asarray(SE3(jnp.asarray(motions)).normalize().as_matrix(), float)
    poses = np.tile(np.eye(4), (len(motions), 1, 1))
    for k in range(matrices.shape[1]):
        poses = poses @ matrices[:, k]
    return poses[:, :3, 3]


def draw(seeds: int, frames: int, step: float, track: int = 5) -> Drive:
    """Drives with consecutive seeds, stacked."""
    return jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(simulate(seed, frames, step, track) for seed in range(seeds))
    )


def interval(values: np.ndarray, statistic: Any) -> tuple[float, float]:
    """95 % bootstrap interval over the last axis."""
    rng = np.random.default_rng(0)
    n = values.shape[-1]
    low, high = np.quantile([statistic(values[..., rng.integers(0, n, n)]) for _ in range(2000)], [0.025, 0.975])
    return float(low), float(high)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--length", type=float, default=10000.0, help="metres")
    parser.add_argument("--step", type=float, default=2.0, help="metres between keyframes")
    parser.add_argument("--track", type=int, default=5, help="keyframes that may see a landmark")
    parser.add_argument("--float32-too", action="store_true")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    frames = int(arguments.length / arguments.step) + 1
    drives = draw(arguments.seeds, frames, arguments.step, arguments.track)
    errors = end_errors(drives, arguments.step, jnp.float64)
    print(f"{arguments.seeds} drives of {frames - 1} keyframes, {arguments.length:.0f} m, tracks of {arguments.track}")
    print("| | drift, % of the path (rms over drives) | points as exact are so many times as far off |\n|---|---|---|")
    methods = ("points as exact", "frame to frame", "window that forgets", "window with prior")
    for name, error in zip(methods, errors, strict=True):
        low, high = interval(error, rms)
        pair = np.stack([errors[0], error])
        below, above = interval(pair, lambda both: rms(both[0]) / rms(both[1]))
        scale = 100.0 / arguments.length
        print(
            f"| {name} | {scale * rms(error):.3f} ({scale * low:.3f}–{scale * high:.3f}) | "
            f"{rms(errors[0]) / rms(error):.2f} ({below:.2f}–{above:.2f}) |"
        )
    if arguments.float32_too:
        single = end_errors(drives, arguments.step, jnp.float32)
        shares = [f"{100 * (rms(one) / rms(two) - 1):+.2f} %" for one, two in zip(single, errors, strict=True)]
        print("float32 against float64, rms error of each method:", ", ".join(shares))


if __name__ == "__main__":
    main()
