"""Marginalisation: what a keyframe that leaves a window, and landmarks that leave with it, say about the others.

Everything works on rows of the Jacobian, never on JᵀJ: landmarks go by projecting their rows onto what they cannot
explain, the keyframe by a QR factorisation of what remains. So nothing is squared, and float32 keeps its digits.
"""

from typing import Any

import jax
import jax.numpy as jnp

from vojax._numerics import safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SE3

from ._losses import Huber, Loss, Squared
from ._window import anchored
from ._window_prior import WindowPrior
from ._window_residual import WindowData, WindowState, cross, linearize, observed, points_in_cameras


def marginalize_oldest(
    world_from_cam: SE3,
    points_world: Float[ArrayLike, "p 3"],
    measurements: Float[ArrayLike, "c p d"],
    mask: Bool[ArrayLike, "c p"],
    camera: Any,
    *,
    leaving: Bool[ArrayLike, " p"] | None = None,
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    prior: WindowPrior | None = None,
    loss: Loss = Huber(),
) -> WindowPrior:
    """Turn the oldest keyframe of an adjusted window, and the landmarks that leave with it, into a prior on the rest.

    Derivatives in poses that have a prior already are taken at its linearisation point, their first estimate: all that
    is ever said about a keyframe has then the same null space, and the prior does not come to know where the world
    begins or how it is turned, which no measurement tells. So also pass windows whose oldest keyframe is held fixed as
    they are: it is free here, and fixing the next one loses nothing.

    Args:
        world_from_cam: Adjusted poses, oldest first `[c]`.
        points_world: Adjusted landmarks.
        measurements: As in `adjust_window`.
        mask: True where a landmark was measured.
        camera: As in `adjust_window`.
        leaving: Landmarks that leave with all their measurements; do not use them in later windows. None takes those
            that the oldest keyframe saw and the newest did not. Of all others the oldest keyframe's measurements are
            forgotten, which loses information and counts none twice.
        sigma_px: As in `adjust_window`.
        prior: The prior of the window.
        loss: Measurements are weighted by ρ′ at the adjusted values.

    Returns:
        The prior of the next window: keyframe i is the former i + 1, the last one is new and not in it.

    Degenerate input: what landmarks without enough measurements cannot say is left out; without measurements the prior
        is empty.
    Differentiability: none; the result is a constant to derivatives.
    References: Demmel, Schubert, Sommer, Cremers & Usenko, "Square root marginalization for sliding-window bundle
        adjustment", ICCV 2021; Huang, Mourikis & Roumeliotis, "Observability-based rules for designing consistent EKF
        SLAM estimators", 2010 (first estimates).
    """
    points_world, measurements, mask = jnp.asarray(points_world), jnp.asarray(measurements), jnp.asarray(mask)
    leaving = mask[0] & ~mask[-1] if leaving is None else jnp.asarray(leaving)
    if leaving.shape != mask.shape[1:]:
        raise ValueError(f"leaving has shape {leaving.shape}; expected one entry a landmark, {mask.shape[1:]}")
    c = mask.shape[0]
    state, data = anchored(
        world_from_cam, points_world, measurements, mask & leaving[None], camera, sigma_px, jnp.zeros((c,), bool), prior
    )
    state, data, loss = jax.lax.stop_gradient((state, data, loss))
    belief = WindowPrior.none(state.poses) if data.prior is None else data.prior
    first = SE3(jnp.where(belief.active[:, None], belief.world_from_cam.wxyz_xyz, state.poses.wxyz_xyz))
    by_pose, residual = _without_landmarks(*_rows(state, first, data, loss))
    # Linear about the first estimates: what the residual would be there.
    residual = residual - jnp.matmul(belief.tangents(state.poses).reshape(-1), by_pose, precision="highest")
    known = jnp.concatenate([belief.factor.reshape(-1, 6 * c), belief.residual[:, None]], axis=1)
    kept = _keyframe_out(jnp.concatenate([known, jnp.concatenate([by_pose, residual[None]]).T]))
    fill = ((0, 6), (0, 6))
    active = jnp.any(data.weight > 0, axis=1) | belief.active
    anchor = jax.lax.stop_gradient(SE3(world_from_cam.wxyz_xyz[0]))
    shifted = SE3(jnp.concatenate([first.wxyz_xyz[1:], state.poses.wxyz_xyz[-1:]]))
    return WindowPrior(
        jnp.pad(kept[:, :-1], fill).reshape(6 * c, c, 6),
        jnp.pad(kept[:, -1], fill[0]),
        anchor @ shifted,
        jnp.pad(active[1:], (0, 1)),
    )


def _rows(state: WindowState, first: SE3, data: WindowData, loss: Loss) -> tuple[Array, Array, Array]:
    """Weighted rows of the Jacobian [6 | 3, d, c, p] at the first estimates, and residuals [d, c, p] as they are."""
    point, _ = points_in_cameras(state)
    residual = jnp.stack(observed(point[0], point[1], point[2], data, Squared()))
    weight = safe_sqrt(loss.weight(jnp.sum(residual**2, axis=0)))[None]
    blocks = linearize(WindowState(first, state.points), data, Squared())
    a = jnp.moveaxis(blocks.by_point, 1, 0) * weight[None]
    by_landmark = jnp.sum(a[:, None] * blocks.rotation[:, :, None, :, None], axis=0)
    return jnp.concatenate([-a, cross(a, blocks.point[:, None])]), by_landmark, residual * weight


def _without_landmarks(by_pose: Array, by_landmark: Array, residual: Array) -> tuple[Array, Array]:
    """Rows [6c, d·c·p] and residuals [d·c·p] without what a shift of their landmark explains."""
    _, d, c, p = by_pose.shape
    eps = float(jnp.finfo(residual.dtype).eps)
    basis: list[Array] = []  # orthonormal columns of every landmark's rows
    for column in by_landmark:
        rest = column
        for _ in range(2):  # once more, for orthogonality to working precision
            for q in basis:
                rest = rest - q * jnp.sum(q * rest, axis=(0, 1), keepdims=True)
        square = jnp.sum(rest * rest, axis=(0, 1), keepdims=True)
        informed = square > (16 * eps) ** 2 * jnp.sum(column * column, axis=(0, 1), keepdims=True)
        basis.append(jnp.where(informed, rest * jax.lax.rsqrt(jnp.where(informed, square, 1.0)), 0.0))
    own = jnp.eye(c, dtype=residual.dtype)[:, None, None, :, None]  # a row belongs to one keyframe
    rows = by_pose[None] * own  # [c, 6, d, c, p]
    for q in basis:
        explained = jnp.sum(q[None] * by_pose, axis=1)  # [6, c, p]
        rows = rows - q[None, None] * jnp.moveaxis(explained, 1, 0)[:, :, None, None]
        residual = residual - q * jnp.sum(q * residual, axis=(0, 1), keepdims=True)
    return rows.reshape(6 * c, d * c * p), residual.reshape(-1)


def _keyframe_out(rows: Float[Array, "m n"]) -> Float[Array, "k n_minus_6"]:
    """Square root of what rows say about all but their first six unknowns, right-hand side in the last column."""
    n = rows.shape[1]
    # A keyframe that nothing is known about would pass the first rows of the others for its own.
    weak = float(jnp.finfo(rows.dtype).eps) * jnp.max(jnp.abs(rows)) + float(jnp.finfo(rows.dtype).tiny) ** 0.5
    triangle = jnp.linalg.qr(jnp.concatenate([weak * jnp.eye(6, n, dtype=rows.dtype), rows]), mode="r")
    return triangle[6 : n - 1, 6:]
