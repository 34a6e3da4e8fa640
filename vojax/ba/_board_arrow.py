"""Normal equations of a board's views: shared unknowns, and a board pose for every view.

    [ A   W_1  W_2 … ]
    [ W_1ᵀ V_1       ],     S = A − Σ W_v V_v⁻¹ W_vᵀ,                                                              (1)
    [ W_2ᵀ     V_2   ]

Board poses are eliminated view by view. A tangent of ones in one pose coordinate of all views at once gives that column
of every W_v and V_v.

References: Triggs, McLauchlan, Hartley & Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, Float
from vojax.solvers._symmetric import swept_inverse

from ._board_residual import Tangent, places_of
from ._bundle_cholesky import cholesky


class ArrowSystem(eqx.Module):
    """Blocks of (1), the gradient, and the largest derivative of a residual by each shared unknown."""

    shared: Float[Array, "d d"]
    shared_gradient: Float[Array, " d"]
    cross: Float[Array, "v d 6"]
    board: Float[Array, "v 6 6"]
    board_gradient: Float[Array, "v 6"]
    largest: Float[Array, " d"]


def normal_equations(
    derivative: Any, residual: tuple[Array, Array], like: Tangent, layout: tuple[int, int, int]
) -> ArrowSystem:
    """The blocks of JᵀJ, and Jᵀr.

    A corner depends on its own camera and view alone, so a tangent of ones in one unknown of all cameras, or of all
    boards, gives the derivatives of all corners by their own.
    """
    places = jnp.asarray(places_of(layout), like.shared.dtype)
    s = places.shape[1]
    shared = jnp.concatenate([jnp.sum(places, axis=0), jnp.zeros((6, layout[2]), places.dtype)])
    boards = jnp.concatenate([jnp.zeros((s, 6), places.dtype), jnp.eye(6, dtype=places.dtype)])
    boards = jnp.broadcast_to(boards[:, None], (s + 6, *like.boards.shape))
    columns = jax.vmap(lambda shared, boards: derivative(Tangent(shared, boards)))(shared, boards)
    rows = [jnp.concatenate([part, value[None]]) for part, value in zip(columns, residual, strict=True)]
    both = jnp.moveaxis(jnp.concatenate(rows, axis=-1), 0, 2)  # [c, v, s + 7, 2 n]
    moments = jnp.matmul(both, jnp.swapaxes(both, 2, 3), precision="highest")
    largest = jnp.max(jnp.abs(both[:, :, :s]), axis=(1, 3))
    return ArrowSystem(
        shared=jnp.einsum("csd,cst,cte->de", places, jnp.sum(moments[:, :, :s, :s], axis=1), places),
        shared_gradient=jnp.einsum("csd,cs->d", places, jnp.sum(moments[:, :, :s, -1], axis=1)),
        cross=jnp.einsum("csd,cvst->vdt", places, moments[:, :, :s, s:-1]),
        board=jnp.sum(moments[:, :, s:-1, s:-1], axis=0),
        board_gradient=jnp.sum(moments[:, :, s:-1, -1], axis=0),
        largest=jnp.einsum("csd,cs->d", places, largest),
    )


def _inverse_root(diagonal: Array) -> Array:
    """Scales to a unit diagonal; 1 where there is no information."""
    held = jax.lax.stop_gradient(diagonal)
    return jnp.where(held > 0, jax.lax.rsqrt(jnp.where(held > 0, held, 1.0)), 1.0)


class Eliminated(NamedTuple):
    """(1) scaled to unit diagonals, with board poses eliminated."""

    shared_scale: Float[Array, " d"]
    board_scale: Float[Array, "v 6"]
    inverse_cross: Float[Array, "6 d v"]
    inverse_gradient: Float[Array, "6 v"]
    reduced: Float[Array, "d d"]
    reduced_gradient: Float[Array, " d"]


def eliminate(system: ArrowSystem, damping: Array | float) -> Eliminated:
    d = system.shared.shape[0]
    shared_scale = _inverse_root(jnp.diagonal(system.shared))
    board_scale = _inverse_root(jnp.diagonal(system.board, axis1=1, axis2=2))
    dtype = system.shared.dtype
    # A shared unknown without any information gets the diagonal 1, and no step.
    shared = system.shared * shared_scale[:, None] * shared_scale[None]
    shared = shared + jnp.diag(jnp.where(jnp.diagonal(system.shared) > 0, damping, 1.0).astype(dtype))
    board = system.board * board_scale[:, :, None] * board_scale[:, None] + damping * jnp.eye(6, dtype=dtype)[None]
    cross = system.cross * shared_scale[None, :, None] * board_scale[:, None]
    inverse, _ = swept_inverse(jnp.moveaxis(board, 0, -1))
    inverse = jnp.moveaxis(inverse, -1, 0)
    # Apart from one another: a derivative is linear in the gradient alone.
    solved = jnp.matmul(inverse, jnp.swapaxes(cross, 1, 2), precision="highest")
    gradient = jnp.sum(inverse * (system.board_gradient * board_scale)[:, None], axis=-1)
    lanes = jnp.moveaxis(cross, 1, 0).reshape(d, -1)
    product = jnp.matmul(lanes, solved.reshape(lanes.shape[1], d), precision="highest")
    return Eliminated(
        shared_scale, board_scale, jnp.moveaxis(solved, 0, -1), gradient.T, shared - product,
        system.shared_gradient * shared_scale - jnp.sum(lanes * gradient.reshape(1, -1), axis=1),
    )  # fmt: skip


def solve_arrow(system: ArrowSystem, damping: Array | float = 0.0) -> Tangent:
    """The increment −M⁻¹g of a damped system; directions without information stay still."""
    parts = eliminate(system, damping)
    shared = -cholesky(parts.reduced).solve(parts.reduced_gradient[:, None])[:, 0]
    boards = -parts.inverse_gradient - jnp.sum(parts.inverse_cross * shared[None, :, None], axis=1)
    return Tangent(shared * parts.shared_scale, boards.T * parts.board_scale)
