"""Symmetric matrices of middling size in the lanes, by loops over whole arrays.

Unrolled, the factorisation of a 12 x 12 matrix takes a compiler seconds; as a loop it takes a tenth of one.

References:
    D. Beaton. The use of special matrix operators in statistical calculus. 1964 (the sweep operator).
    G. Golub, C. Van Loan. Matrix Computations, 4th edition, section 8.2.4 (orthogonal iteration).
"""

import jax
import jax.numpy as jnp

from vojax._types import Array, Bool, Float

from ._components import floor


def diagonal_sum(matrix: Float[Array, "d d *lanes"]) -> Float[Array, "*lanes"]:
    """The trace."""
    return jnp.sum(jnp.stack([matrix[i, i] for i in range(matrix.shape[0])]), axis=0)


def swept_inverse(matrix: Float[Array, "d d *lanes"]) -> tuple[Float[Array, "d d *lanes"], Bool[Array, "*lanes"]]:
    """Invert positive definite matrices, and say which could be inverted.

    A matrix is singular to working precision when, scaled to unit diagonal, its condition number exceeds 1/(32 eps).

    Degenerate input: pivots below rounding are skipped, as if the coordinate were held; results are finite for finite
        matrices. Diagonal entries that are not positive are taken for zero.
    """
    d = matrix.shape[0]
    eps = float(jnp.finfo(matrix.dtype).eps)
    axes = (1,) * (matrix.ndim - 2)
    diagonal = jnp.stack([matrix[i, i] for i in range(d)])
    positive = diagonal > floor(diagonal) ** 2
    scale = jnp.where(positive, 1.0 / jnp.sqrt(jnp.where(positive, diagonal, 1.0)), 0.0)
    index = jnp.arange(d)

    def sweep(k: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        m, regular = state
        column = m[k]
        pivot = column[k]
        usable = pivot > 2.0 * d * eps
        inverse = jnp.where(usable, 1.0 / jnp.where(usable, pivot, 1.0), 0.0)
        scaled = column * inverse[None]
        at_k = (index == k).reshape(d, 1, *axes)
        swept = m - column[:, None] * scaled[None]
        swept = jnp.where(at_k, scaled[None], jnp.where(jnp.swapaxes(at_k, 0, 1), scaled[:, None], swept))
        swept = jnp.where(at_k & jnp.swapaxes(at_k, 0, 1), -inverse[None, None], swept)
        return swept, regular & usable

    finite = jnp.all(jnp.isfinite(matrix), axis=(0, 1))
    start = jnp.where(finite[None, None], matrix * scale[:, None] * scale[None], 0.0)
    swept, regular = jax.lax.fori_loop(0, d, sweep, (start, finite & jnp.all(positive, axis=0)))
    # The trace of the scaled inverse bounds its largest eigenvalue.
    trace = -diagonal_sum(swept)
    return -swept * scale[:, None] * scale[None], regular & (trace < 1.0 / (32.0 * eps))


def least_eigenvectors(gram: Float[Array, "d d *lanes"], count: int, steps: int = 8) -> Float[Array, "count d *lanes"]:
    """Orthonormal eigenvectors of the least eigenvalues of positive semidefinite matrices, least first.

    Args:
        gram: Matrices AᵀA.
        count: How many.
        steps: Iterations; the angle to the true vector falls by the ratio of the neighbouring eigenvalues in each.

    Degenerate input: of a repeated eigenvalue some basis; of a zero matrix some orthonormal vectors.
    """
    d = gram.shape[0]
    lanes = gram.shape[2:]
    trace = jnp.maximum(diagonal_sum(gram), floor(gram) ** 2)
    # A shift at rounding makes the inverse safe and leaves the vectors as they are.
    shift = 8.0 * d * float(jnp.finfo(gram.dtype).eps)
    identity = jnp.eye(d, dtype=gram.dtype).reshape(d, d, *(1,) * len(lanes))
    inverse, _ = swept_inverse(gram / trace[None, None] + shift * identity)

    def iterate(_: object, x: Array) -> Array:
        # The factor keeps the numbers near one, where there is a null space.
        y = shift * jnp.sum(inverse[None] * x[:, None], axis=2)
        vectors: list[Array] = []
        for k in range(count):
            v = y[k]
            for _ in range(2):  # twice is enough
                for u in vectors:
                    v = v - u * jnp.sum(u * v, axis=0)[None]
                norm = jnp.sqrt(jnp.sum(v * v, axis=0))
                v = v / jnp.where(norm > 0, norm, 1.0)[None]
            vectors.append(v)
        return jnp.stack(vectors)

    # Irregular, so that no vector is orthogonal to the eigenvectors of symmetric configurations.
    start = jnp.sin(jnp.arange(1.0, count * d + 1.0, dtype=gram.dtype) ** 2).reshape(count, d, *(1,) * len(lanes))
    return jax.lax.fori_loop(0, steps, iterate, jnp.broadcast_to(start, (count, d, *lanes)))
