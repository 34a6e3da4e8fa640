"""Null spaces and null vectors in the lanes.

`null_space` completes the rows of a wide matrix to an orthonormal basis by Householder reflections, one row after the
other: what is left over is the null space, to rounding, whatever the rows' conditioning. `null_vector_of_gram` finds
the least eigenvector of AᵀA for tall matrices.

References: G. Golub, C. Van Loan. Matrix Computations, 4th edition, sections 5.1 and 8.2.
"""

import jax
import jax.numpy as jnp

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
    largest = jnp.max(jnp.sum(rows * rows, axis=1), axis=0)
    independent = jnp.isfinite(largest)
    rounding = (16.0 * float(jnp.finfo(rows.dtype).eps)) ** 2
    for k in range(m):
        x = rest[0]
        length2 = jnp.sum(x * x, axis=0)
        usable = length2 > floor(length2) ** 2
        independent = independent & usable & (length2 > rounding * largest)
        alpha = -sign(x[0]) * jnp.sqrt(jnp.where(usable, length2, 1.0))
        v = jnp.concatenate([(x[0] - alpha)[None], x[1:]])
        # I - beta v vᵀ takes x to alpha e1; v.v / 2 = |x|² - alpha x0.
        beta = jnp.where(usable, 1.0 / (jnp.where(usable, length2, 1.0) - alpha * x[0]), 0.0)
        reflectors.append((v, beta))
        if k < m - 1:
            rest = rest[1:]
            along = jnp.sum(rest * v[None], axis=1) * beta[None]
            rest = (rest - along[:, None] * v[None])[:, 1:]
    q = n - m
    lanes = rows.shape[2:]
    basis = jnp.broadcast_to(jnp.eye(q, dtype=rows.dtype).reshape(q, q, *(1,) * len(lanes)), (q, q, *lanes))
    for v, beta in reversed(reflectors):
        basis = jnp.concatenate([jnp.zeros_like(basis[:, :1]), basis], axis=1)
        along = jnp.sum(basis * v[None], axis=1) * beta[None]
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
        row = jnp.sum(jnp.where(chosen[:, None], rows, 0.0), axis=0)
        pivot = jnp.sum(jnp.where(chosen, column, 0.0), axis=0)
        row = row / jnp.where(jnp.abs(pivot) > floor(pivot), pivot, floor(pivot))[None]
        displaced = jax.lax.dynamic_index_in_dim(rows, k, 0, keepdims=False)
        factor = jnp.where(chosen, jax.lax.dynamic_index_in_dim(column, k, 0), column)
        rows = jnp.where(chosen[:, None], displaced[None], rows) - factor[:, None] * row[None]
        return jax.lax.dynamic_update_index_in_dim(rows, row, k, 0)

    return jax.lax.fori_loop(0, m, step, rows)[:, m:]


def null_vector_of_gram(gram: Float[Array, "n n *lanes"], steps: int = 6) -> Float[Array, "n *lanes"]:
    """Unit eigenvector of the least eigenvalue of symmetric positive semidefinite matrices, by inverse iteration.

    Args:
        gram: Matrices AᵀA.
        steps: Solves; the error falls by the ratio of the two least eigenvalues in each.

    Degenerate input: where the least eigenvalue is repeated, some vector of its space; for a zero matrix a unit vector.
    """
    n = gram.shape[0]
    diagonal = jnp.stack([gram[i, i] for i in range(n)])
    size = jnp.maximum(jnp.sum(diagonal, axis=0), floor(gram) ** 2)
    # A shift at rounding makes the factorisation safe and leaves the vectors as they are.
    shift = n * float(jnp.finfo(gram.dtype).eps) * size
    identity = jnp.eye(n, dtype=gram.dtype).reshape(n, n, *(1,) * (gram.ndim - 2))
    rest = gram + identity * shift[None, None]
    columns: list[Array] = []
    pivots: list[Array] = []
    for _ in range(n):  # L D Lᵀ with unit L
        pivot = jnp.maximum(rest[0, 0], 0.25 * shift)
        column = rest[1:, 0] / pivot[None]
        rest = rest[1:, 1:] - column[:, None] * rest[0, 1:][None]
        columns.append(column)
        pivots.append(pivot)

    def solve(x: Array) -> Array:
        forward = []
        for column in columns:
            forward.append(x[0])
            x = x[1:] - column * x[0][None]
        back = jnp.zeros_like(x)
        for entry, pivot, column in zip(forward[::-1], pivots[::-1], columns[::-1], strict=True):
            entry = entry / pivot - jnp.sum(column * back, axis=0)
            back = jnp.concatenate([entry[None], back])
        return back

    def iterate(_: object, x: Array) -> Array:
        y = solve(x)
        y = y / jnp.max(jnp.abs(y), axis=0)[None]
        return y / jnp.sqrt(jnp.sum(y * y, axis=0))[None]

    # Irregular, so that it is not orthogonal to the eigenvectors of symmetric configurations.
    start = jnp.asarray([0.31, 0.83, -0.27, 0.52, -0.71, 0.19, 0.43, -0.64, 0.91, -0.36, 0.58, 0.77][:n], gram.dtype)
    start = jnp.broadcast_to(start.reshape((n,) + (1,) * (gram.ndim - 2)), gram.shape[1:])
    return jax.lax.fori_loop(0, steps, iterate, start)
