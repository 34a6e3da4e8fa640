"""Sliding-window bundle adjustment: poses and landmarks of a few keyframes together, against all their measurements.

Every window has the same shape [keyframes, landmarks] and says by a mask what was seen, so one compilation serves a
whole sequence. The solve is anchored: the origin moves to the oldest keyframe, and float32 never sees absolute
coordinates.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._result import Result
from vojax._types import Array, ArrayLike, Bool, Float, Int
from vojax.lie import SE3

from . import _window_schur
from ._levenberg_marquardt import LMOptions
from ._losses import Huber, Loss
from ._whitening import whitening
from ._window_gradient import with_derivative
from ._window_prior import WindowPrior
from ._window_residual import WindowData, WindowState, cost, linearize
from ._window_solver import optimise


class Window(eqx.Module):
    """An adjusted window.

    Attributes:
        world_from_cam: Poses of the keyframes.
        points_world: Landmarks; those without enough measurements are where they were.
        pose_covariances: Marginal covariances of the camera-frame tangents (translation first), given the fixed
            keyframes; zero for fixed keyframes and for degenerate windows.
        initial_cost: ½Σρ before.
        cost: ½Σρ after.
        iterations: Evaluations of the residuals.
        result: How it ended.
    """

    world_from_cam: SE3
    points_world: Float[Array, "p 3"]
    pose_covariances: Float[Array, "c 6 6"]
    initial_cost: Float[Array, ""]
    cost: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Result


def adjust_window(
    world_from_cam: SE3,
    points_world: Float[ArrayLike, "p 3"],
    measurements: Float[ArrayLike, "c p d"],
    mask: Bool[ArrayLike, "c p"],
    camera: Any,
    *,
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    fixed: Bool[ArrayLike, " c"] | None = None,
    prior: WindowPrior | None = None,
    loss: Loss = Huber(),
    options: LMOptions = LMOptions(),
) -> Window:
    """Adjust keyframe poses and landmarks by Levenberg–Marquardt with landmark elimination.

    Args:
        world_from_cam: Poses of the keyframes, oldest first `[c]`.
        points_world: Landmarks, in the world frame.
        measurements: Measured projections of every landmark in every keyframe: pixels `(u, v)`, or
            `(u_left, v, u_right)` with a `RectifiedStereo`. Entries that the mask excludes must be finite.
        mask: True where a landmark was measured.
        camera: A camera of `vojax.cameras`, the same for all keyframes.
        sigma_px: Standard deviation of a measurement's components in pixels: a scalar, `[c, p]`, or covariances
            `[c, p, d, d]`.
        fixed: Keyframes that stay. None fixes the first; with pixels only, fix two, or scale is free.
        prior: What earlier windows knew of these keyframes (`marginalize_oldest`), in the frame of `world_from_cam`.
        loss: Robust loss of the squared whitened residual.
        options: Of the optimiser.

    Returns:
        The adjusted window.

    Degenerate input: cameras and landmarks without information do not move. A window with a free keyframe that its
        measurements do not determine ends as `degenerate` with zero covariances: pad with fixed keyframes.
    Differentiability: both modes, in the measurements, their noise and the camera, by the implicit function theorem
        with the exact Hessian, solved by the same elimination. Starting values, fixed poses among them, have
        derivative zero.
    References: Szeliski, "Computer Vision", section 11.4; Triggs et al., "Bundle adjustment - a modern synthesis",
        2000.
    """
    points_world, measurements = jnp.asarray(points_world), jnp.asarray(measurements)
    mask = jnp.asarray(mask)
    state, data = anchored(world_from_cam, points_world, measurements, mask, camera, sigma_px, fixed, prior)
    anchor = SE3(jax.lax.stop_gradient(world_from_cam.wxyz_xyz[0]))
    found = optimise(*jax.lax.stop_gradient((state, data, loss)), options)
    state = with_derivative(found.state, (data, loss))

    blocks = linearize(state, data, loss)
    system = _window_schur.normal_equations(blocks)
    covariances, regular = _window_schur.camera_covariances(system)
    blind = (data.free > 0) & (system.camera_diagonal()[0] == 0)
    regular = regular & ~jnp.any(blind)
    result = Result.where(found.converged, Result.success, Result.not_converged)
    result = Result.where(regular, result, Result.degenerate)
    return Window(
        (anchor @ state.poses).normalize(),
        anchor.apply(state.points.T),
        jnp.where(regular, covariances, 0.0),
        found.initial_cost,
        cost((*blocks.residual, blocks.prior_residual)),
        found.iterations,
        result,
    )


def anchored(
    world_from_cam: SE3,
    points_world: Array,
    measurements: Array,
    mask: Array,
    camera: Any,
    sigma_px: Any,
    fixed: Any,
    prior: WindowPrior | None,
) -> tuple[WindowState, WindowData]:
    """A window in the frame of its oldest keyframe; poses, landmarks and where a prior was linearised are constants."""
    c, p, d = measurements.shape
    if mask.shape != (c, p) or points_world.shape != (p, 3) or world_from_cam.wxyz_xyz.shape != (c, 7):
        raise ValueError(
            f"window shapes do not fit: poses {world_from_cam.wxyz_xyz.shape[:-1]}, points {points_world.shape}, "
            f"measurements {measurements.shape}, mask {mask.shape}; expected (c,), (p, 3), (c, p, d), (c, p)"
        )
    if prior is not None and prior.factor.shape[1:] != (c, 6):
        raise ValueError(f"the prior is about {prior.factor.shape[1]} keyframes, the window has {c}")
    dtype = jnp.result_type(points_world, measurements)
    free = jnp.arange(c) > 0 if fixed is None else ~jnp.asarray(fixed)
    anchor = SE3(world_from_cam.wxyz_xyz[0])
    points = anchor.rotation().inverse().apply(points_world - anchor.translation()[None]).T
    start = WindowState(SE3(relative_poses(anchor, world_from_cam).wxyz_xyz.astype(dtype)), points.astype(dtype))
    if prior is not None:
        prior = eqx.tree_at(lambda p: p.world_from_cam, prior, relative_poses(anchor, prior.world_from_cam))
        floats, rest = eqx.partition(prior, eqx.is_inexact_array)
        prior = eqx.combine(jax.tree.map(lambda leaf: leaf.astype(dtype), floats), rest)
    data = WindowData(
        tuple(measurements[..., i].astype(dtype) for i in range(d)),
        whitening(sigma_px, (c, p), d, dtype),
        mask.astype(dtype),
        free.astype(dtype),
        camera,
        prior,
    )
    return jax.lax.stop_gradient(start), data


def relative_poses(anchor: SE3, world_from_cam: SE3) -> SE3:
    """`anchor⁻¹ world_from_cam`, positions subtracted first: R⁻¹p − R⁻¹a would lose their common digits in rounding."""
    anchor = SE3(anchor.wxyz_xyz[None])
    turn = anchor.rotation().inverse()
    offset = turn.apply(world_from_cam.translation() - anchor.translation())
    return SE3.from_rotation_and_translation(turn @ world_from_cam.rotation(), offset)
