"""What a calibration says of itself, for one camera and for rigs alike."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vojax._result import Result
from vojax._types import Array, Bool, Float, Int
from vojax.ba import LMOptions, Loss, Squared, mad_scale
from vojax.ba._board_residual import BoardData, BoardState, cost, errors, zero_tangent
from vojax.ba._calibration import adjust_board
from vojax.lie import SO3

# A parameter whose standard deviation moves an observed corner by more than this share of the image's diagonal is
# reported as not constrained.
UNCERTAIN_SHARE = 0.01
# Boards within this angle of one another, radians, count as parallel: they give the constraints of one view.
PARALLEL_ANGLE = 0.05


class Solution(NamedTuple):
    """An optimum and its statistics; see `Calibration` for the fields."""

    state: BoardState
    residuals: Float[Array, "c v n 2"]
    sigma_px: Float[Array, ""]
    covariance: Float[Array, "d d"]
    board_covariance: Float[Array, "v 6 6"]
    unconstrained: Bool[Array, " d"]
    view_angle: Float[Array, ""]
    cost: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Result


def solve(
    start: BoardState,
    data: BoardData,
    valid: Bool[Array, " v"],
    sigma_given: bool,
    image_size: tuple[int, int],
    options: LMOptions,
    several: bool = True,
) -> Solution:
    """Adjust, then measure the noise and what it does to the unknowns; of `several` boards two must not be parallel."""
    state, covariances, iterations, converged = adjust_board(start, data, options)
    fixed, held = jax.lax.stop_gradient((state, data))
    residuals = errors(state, data)
    tangent = zero_tangent(fixed, data.free)
    unknowns = tangent.shared.shape[0] + 6 * jnp.sum(valid)
    counted = 2 * jnp.sum(held.weight > 0)
    freedom = counted - unknowns
    sigma = noise(jax.lax.stop_gradient(residuals), held, freedom)
    scale = jnp.ones_like(sigma) if sigma_given else sigma / jnp.max(held.sigma_px)
    shared = covariances.shared * scale**2
    pixels = covariances.largest * jnp.max(held.sigma_px) * jnp.sqrt(jnp.diagonal(shared))
    diagonal = float(image_size[0] ** 2 + image_size[1] ** 2) ** 0.5
    uncertain = covariances.unconstrained | (pixels > UNCERTAIN_SHARE * diagonal)
    angle = largest_angle(fixed.rig_from_board.rotation(), valid)
    value = cost(state, data)
    result = Result.where(converged, Result.success, Result.not_converged)
    lost = jnp.any(covariances.unconstrained) | ~jnp.isfinite(value)
    if several and data.free:
        lost = lost | (angle < PARALLEL_ANGLE)
    result = Result.where(lost, Result.degenerate, result)
    result = Result.where(freedom < 0, Result.too_few, result)
    return Solution(
        state, residuals, jnp.max(held.sigma_px) if sigma_given else sigma, shared, covariances.boards * scale**2,
        uncertain, angle, value, iterations, result,
    )  # fmt: skip


def noise(residuals: Array, data: BoardData, freedom: Array) -> Float[Array, ""]:
    """Standard deviation of a pixel coordinate: r.m.s. for the squared loss, by the median for robust ones."""
    counted = data.weight > 0
    number = 2 * jnp.sum(counted)
    share = jnp.maximum(freedom, 1) / jnp.maximum(number, 1)
    if isinstance(data.loss, Squared):
        squares = jnp.sum(data.weight[..., None] * residuals**2) / jnp.maximum(2 * jnp.sum(data.weight), 1e-12)
    else:
        both = jnp.broadcast_to(counted[..., None], residuals.shape)
        squares = mad_scale(residuals.reshape(-1), both.reshape(-1)) ** 2
    return jnp.sqrt(squares / share)


def largest_angle(rotation: SO3, valid: Bool[Array, " v"]) -> Float[Array, ""]:
    """Largest angle between the normals of two boards, radians."""
    normals = rotation.as_matrix()[:, :, 2]
    sines = jnp.linalg.norm(jnp.cross(normals[:, None], normals[None]), axis=-1)
    angles = jnp.arctan2(sines, jnp.sum(normals[:, None] * normals[None], axis=-1))
    return jnp.max(jnp.where(valid[:, None] & valid[None], angles, 0.0))


def rms(residuals: Array, weight: Array, axes: tuple[int, ...]) -> Array:
    """Root mean square length of residuals, as OpenCV reports it."""
    counted = weight > 0
    squares = jnp.sum(jnp.where(counted, jnp.sum(residuals**2, axis=-1), 0.0), axis=axes)
    mean = squares / jnp.maximum(jnp.sum(counted, axis=axes), 1)
    return jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1.0)), 0.0)


def check_loss(loss: object) -> None:
    """Refuse what is no loss."""
    if not isinstance(loss, Loss):
        raise ValueError(f"loss is {loss!r}: expected one of vojax.ba, such as Cauchy()")
