"""Null spaces and linear systems in the lanes.

`null_space` completes the rows of a wide matrix to an orthonormal basis by Householder reflections, one row after the
other: what is left over is the null space, to rounding, whatever the rows' conditioning. `eliminate` solves square
systems with many right-hand sides.

References: G. Golub, C. Van Loan. Matrix Computations, 4th edition, sections 3.4 and 5.1.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import lane_sum
from vojax._types import Array, Bool, Float

from ._components import floor, sign


def null_space(rows: Float[Array, "m n *lanes"]) -> Float[Array, "q n *lanes"]:
    """Orthonormal basis of the vectors that m < n rows annihilate, q = n - m of them; see `null_space_and_rank`."""
    return null_space_and_rank(rows)[0]


def null_space_and_rank(
    rows: Float[Array, "m n *lanes"],
) -> tuple[Float[Array, "q n *lanes"], Bool[Array, "*lanes"]]:
    """Orthonormal basis of the vectors that m < n rows annihilate, q = n - m of them.

    Args:
        rows: Matrices with independent rows; scale the rows sensibly.

    Returns:
        The basis, one vector per row, and True where the rows are independent in working precision.

    Degenerate input: dependent rows give q vectors of the larger null space. A zero row is skipped the same way.
    """
    m, n = rows.shape[:2]
    reflectors: list[tuple[Array, Array]] = []
    rest = rows
    largest = jnp.max(lane_sum(rows * rows, axis=1), axis=0)
    independent = jnp.isfinite(largest)
    rounding = (16.0 * float(jnp.finfo(rows.dtype).eps)) ** 2
    for k in range(m):
        x = rest[0]
        length2 = lane_sum(x * x, axis=0)
        usable = length2 > floor(length2) ** 2
        independent = independent & usable & (length2 > rounding * largest)
        alpha = -sign(x[0]) * jnp.sqrt(jnp.where(usable, length2, 1.0))
        v = jnp.concatenate([(x[0] - alpha)[None], x[1:]])
        # I - beta v vᵀ takes x to alpha e1; v.v / 2 = |x|² - alpha x0.
        beta = jnp.where(usable, 1.0 / (jnp.where(usable, length2, 1.0) - alpha * x[0]), 0.0)
        reflectors.append((v, beta))
        if k < m - 1:
            rest = rest[1:]
            along = lane_sum(rest * v[None], axis=1) * beta[None]
            rest = (rest - along[:, None] * v[None])[:, 1:]
    q = n - m
    lanes = rows.shape[2:]
    basis = jnp.broadcast_to(jnp.eye(q, dtype=rows.dtype).reshape(q, q, *(1,) * len(lanes)), (q, q, *lanes))
    for v, beta in reversed(reflectors):
        basis = jnp.concatenate([jnp.zeros_like(basis[:, :1]), basis], axis=1)
        along = lane_sum(basis * v[None], axis=1) * beta[None]
        basis = basis - along[:, None] * v[None]
    return basis, independent


def eliminate(rows: Float[Array, "m n *lanes"]) -> Float[Array, "m q *lanes"]:
    """Reduce rows [A | B] to A⁻¹ B by Gauss-Jordan elimination with partial pivoting.

    A loop over whole arrays: unrolled, every step would be computed again in all that use it.

    Degenerate input: where A is singular a pivot is replaced by a tiny number, and the result is large or meaningless.
    """
    m = rows.shape[0]
    index = jnp.arange(m).reshape((m,) + (1,) * (rows.ndim - 2))

    def step(k: Array, rows: Array) -> Array:
        column = jax.lax.dynamic_index_in_dim(rows, k, 1, keepdims=False)
        best = jnp.argmax(jnp.where(index >= k, jnp.abs(column), -1.0), axis=0)
        chosen = index == best[None]
        row = lane_sum(jnp.where(chosen[:, None], rows, 0.0), axis=0)
        pivot = lane_sum(jnp.where(chosen, column, 0.0), axis=0)
        row = row / jnp.where(jnp.abs(pivot) > floor(pivot), pivot, floor(pivot))[None]
        displaced = jax.lax.dynamic_index_in_dim(rows, k, 0, keepdims=False)
        factor = jnp.where(chosen, jax.lax.dynamic_index_in_dim(column, k, 0), column)
        rows = jnp.where(chosen[:, None], displaced[None], rows) - factor[:, None] * row[None]
        return jax.lax.dynamic_update_index_in_dim(rows, row, k, 0)

    return jax.lax.fori_loop(0, m, step, rows)[:, m:]
