"""Least squares over views of one board: intrinsics and rig of the cameras, and a board pose for every view.

Minimises ½Σ ρ(‖r‖²) over the corners that the cameras of a rig see on a board which moves from view to view. Every
residual depends on the shared unknowns (intrinsics of all cameras, poses of all but the first in the rig) and on the
board pose of its view alone, so the normal matrix is an arrow (`_board_arrow.py`). The same elimination serves the
steps, the covariance and, with the exact Hessian in place of JᵀJ, the derivative of the optimum.

References: Zhang, "A flexible new technique for camera calibration", PAMI 2000.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from vojax._types import Array, Bool, Float, Int
from vojax.solvers._symmetric import swept_inverse

from ._board_arrow import ArrowSystem, eliminate, normal_equations, solve_arrow
from ._board_residual import (
    BoardData,
    BoardState,
    Tangent,
    cost,
    layout_of,
    recentring,
    residual_at,
    retract,
    zero_tangent,
)
from ._levenberg_marquardt import LMOptions, minimize


class BoardCovariance(eqx.Module):
    """Covariances under the data's `sigma_px`.

    Attributes:
        shared: Of the shared unknowns, zero along directions without information.
        boards: Of the board poses, in the tangent exp(−ξ) @ rig_from_board.
        unconstrained: Shared unknowns that take part in a direction without information.
        largest: Largest derivative of a whitened residual by each shared unknown.
    """

    shared: Float[Array, "d d"]
    boards: Float[Array, "v 6 6"]
    unconstrained: Bool[Array, " d"]
    largest: Float[Array, " d"]


class _ArrowDescent(optx.AbstractDescent):
    """The step of Levenberg–Marquardt by elimination of the board poses."""

    layout: tuple[int, int, int]

    def init(self, y: Any, f_info_struct: Any) -> ArrowSystem:
        """Zeros of the right shape."""
        del f_info_struct
        (d,), (v, _), dtype = y.shared.shape, y.boards.shape, y.shared.dtype
        zeros = lambda *shape: jnp.zeros(shape, dtype)  # noqa: E731
        return ArrowSystem(zeros(d, d), zeros(d), zeros(v, d, 6), zeros(v, 6, 6), zeros(v, 6), zeros(d))

    def query(self, y: Any, f_info: Any, state: ArrowSystem) -> ArrowSystem:
        """Form the blocks at a newly accepted point."""
        del state
        return normal_equations(f_info.jac.mv, f_info.residual, y, self.layout)

    def step(self, step_size: Any, state: ArrowSystem) -> tuple[Any, optx.RESULTS]:
        """Solve for the increment at damping 1/step_size."""
        return solve_arrow(state, 1.0 / step_size), optx.RESULTS.successful


def adjust_board(
    start: BoardState, data: BoardData, options: LMOptions
) -> tuple[BoardState, BoardCovariance, Int[Array, ""], Bool[Array, ""]]:
    """Bring the unknowns to the least cost.

    Returns:
        The optimum, with its derivative in `data` by the implicit function theorem (zero in `start`); covariances by
        the Gauss–Newton matrix, constants; evaluations of the residuals; whether it converged.
    """
    start, held = jax.lax.stop_gradient((start, data))
    layout = layout_of(data)
    solution = minimize(residual_at, zero_tangent(start, data.free), (start, held), _ArrowDescent(layout), options)
    y, system = jax.lax.stop_gradient((solution.value, solution.state.descent_state))
    found = jax.lax.stop_gradient(retract(start, y, data.free))
    return (
        _with_derivative(found, data),
        _covariance(system, y, layout),
        solution.stats["num_steps"],
        solution.result == optx.RESULTS.successful,
    )


@jax.custom_jvp
def _with_derivative(state: BoardState, data: BoardData) -> BoardState:
    del data
    return state


@_with_derivative.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[BoardState, BoardState]:
    state, data = primals
    system = _exact_system(state, data, tangents[1])
    zero = zero_tangent(state, data.free)
    moved = jax.jvp(lambda tangent: retract(state, tangent, data.free), (zero,), (solve_arrow(system),))[1]
    return state, moved


def _exact_system(state: BoardState, data: BoardData, change: Any) -> ArrowSystem:
    """The exact Hessian, and the change of the gradient along a change of the data."""
    zero = zero_tangent(state, data.free)
    d = zero.shared.shape[0]

    def view_cost(z: Array, board: Array, corners: Array, weight: Array, sigma_px: Array) -> Array:
        own = eqx.tree_at(
            lambda data: (data.corners, data.weight, data.sigma_px),
            data,
            (corners[:, None], weight[:, None], sigma_px[:, None]),
        )
        at = eqx.tree_at(lambda state: state.rig_from_board.wxyz_xyz, state, board[None])
        return cost(retract(at, Tangent(z[:d], z[None, d:]), data.free), own)

    sigma_px = jnp.broadcast_to(data.sigma_px, data.weight.shape)
    hessian = jax.vmap(jax.hessian(view_cost), (None, 0, 1, 1, 1))(
        jnp.zeros((d + 6,), zero.shared.dtype), state.rig_from_board.wxyz_xyz, data.corners, data.weight, sigma_px
    )
    gradient = lambda data: jax.grad(lambda y: cost(retract(state, y, data.free), data))(zero)  # noqa: E731
    _, moved = jax.jvp(gradient, (data,), (change,))
    return ArrowSystem(
        shared=jnp.sum(hessian[:, :d, :d], axis=0),
        shared_gradient=moved.shared,
        cross=hessian[:, :d, d:],
        board=hessian[:, d:, d:],
        board_gradient=moved.boards,
        largest=jnp.zeros((d,), hessian.dtype),
    )


def _covariance(system: ArrowSystem, y: Tangent, layout: tuple[int, int, int]) -> BoardCovariance:
    """Covariances at the point that the increments `y` have led to."""
    parts = eliminate(system, 0.0)
    count, k, d = layout
    dtype = y.shared.dtype
    # Eigenvalues of a matrix of unit diagonal: below the rounding of its entries there is no information.
    values, vectors = jnp.linalg.eigh(parts.reduced) if d > 0 else (jnp.zeros((0,), dtype), parts.reduced)
    blind = values <= 4 * max(d, 1) * float(jnp.finfo(dtype).eps)
    inverse = (vectors * jnp.where(blind, 0.0, 1.0 / jnp.where(blind, 1.0, values))[None]) @ vectors.T
    known = jnp.diagonal(system.shared) > 0
    inverse = jnp.where(known[:, None] & known[None], inverse, 0.0)
    unconstrained = ~known | (jnp.sum(jnp.where(blind[None], vectors * vectors, 0.0), axis=1) > 1e-2)
    # V⁻¹ + V⁻¹ Wᵀ S⁻¹ W V⁻¹, view by view.
    board = system.board * parts.board_scale[:, :, None] * parts.board_scale[:, None]
    own, seen = swept_inverse(jnp.moveaxis(board, 0, -1))
    cross = jnp.moveaxis(parts.inverse_cross, -1, 0)
    boards = jnp.moveaxis(own, -1, 0) + jnp.einsum("vid,de,vje->vij", cross, inverse, cross)
    boards = jnp.where(seen[:, None, None], boards, 0.0) * parts.board_scale[:, :, None] * parts.board_scale[:, None]
    shared = inverse * parts.shared_scale[:, None] * parts.shared_scale[None]
    # From increments of the start to increments about the optimum.
    about = recentring(y.boards)
    moves = recentring(y.shared[count * k :].reshape(-1, 6))
    whole = jnp.eye(d, dtype=dtype)
    for i in range(count - 1):
        at = count * k + 6 * i
        whole = whole.at[at : at + 6, at : at + 6].set(moves[i])
    return BoardCovariance(
        shared=whole @ shared @ whole.T,
        boards=about @ boards @ jnp.swapaxes(about, 1, 2),
        unconstrained=unconstrained,
        largest=system.largest,
    )
