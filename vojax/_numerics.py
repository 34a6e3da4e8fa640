"""Scalars that stay finite, in value and in gradient, and small closed-form linear algebra for the lanes.

Everything here is elementwise over arrays of any equal shape, so the same code runs for one problem and for a batch on
the last axis.
"""

from collections.abc import Sequence

import jax.numpy as jnp

from ._types import Array, Float


def tiny(x: Float[Array, "..."]) -> float:
    """Smallest magnitude that is still safe to divide by and to square-root in the dtype of `x`."""
    return float(jnp.finfo(x.dtype).tiny) ** 0.5


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root that is 0 with gradient 0 for `x <= 0`."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_divide(numerator: Float[Array, "*shape"], denominator: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Quotient that is 0 with gradient 0 where the denominator vanishes."""
    usable = jnp.abs(denominator) > tiny(denominator)
    return jnp.where(usable, numerator / jnp.where(usable, denominator, 1.0), 0.0)


def safe_norm(x: Float[Array, "*batch d"]) -> Float[Array, "*batch"]:
    """Euclidean norm over the last axis; 0 with gradient 0 at the origin."""
    return safe_sqrt(jnp.sum(x * x, axis=-1))


def normalize(x: Float[Array, "*batch d"]) -> Float[Array, "*batch d"]:
    """Scale vectors to unit length; the zero vector stays zero, with gradient 0."""
    norm = safe_norm(x)[..., None]
    usable = norm > 0
    return jnp.where(usable, x / jnp.where(usable, norm, 1.0), 0.0)


Vector3 = Sequence[Array]


def dot3(a: Vector3, b: Vector3) -> Array:
    """Scalar product of two vectors given by components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross3(a: Vector3, b: Vector3) -> Vector3:
    """Vector product of two vectors given by components."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def cholesky_factor(matrix: Sequence[Sequence[Array]]) -> tuple[list[list[Array]], list[Array], Array]:
    """Factor a small positive semidefinite matrix M = L Lᵀ, unrolled.

    Args:
        matrix: Entries `matrix[i][j]`; only the lower triangle (j <= i) is read.

    Returns:
        The rows of L; the inverses of its diagonal; and a mask that is False where M is singular to working precision.
        There the offending pivots and their inverses are 0, so that solutions stay finite and have no component along
        directions without information.
    """
    size = len(matrix)
    rows: list[list[Array]] = []
    inverse_pivots: list[Array] = []
    regular = jnp.isfinite(matrix[0][0])
    for i in range(size):
        row: list[Array] = []
        for j in range(i):
            entry = matrix[i][j]
            for k in range(j):
                entry = entry - row[k] * rows[j][k]
            row.append(entry * inverse_pivots[j])
        pivot = matrix[i][i]
        for k in range(i):
            pivot = pivot - row[k] * row[k]
        # Below the rounding error of the diagonal entry that it came from, a pivot is noise.
        positive = pivot > 2 * size * float(jnp.finfo(pivot.dtype).eps) * jnp.abs(matrix[i][i])
        root = jnp.sqrt(jnp.where(positive, pivot, 1.0))
        row.append(jnp.where(positive, root, 0.0))
        rows.append(row)
        inverse_pivots.append(jnp.where(positive, 1.0 / root, 0.0))
        regular = regular & positive
    return rows, inverse_pivots, regular


def cholesky_solve(matrix: Sequence[Sequence[Array]], *right_hand_sides: Sequence[Array]) -> tuple[list[Array], ...]:
    """Solve a small symmetric positive definite system for one or more right-hand sides, unrolled.

    Args:
        matrix: Entries `matrix[i][j]`; only the lower triangle (j <= i) is read.
        right_hand_sides: Entries of each right-hand side.

    Returns:
        One solution for each right-hand side, then the mask of `cholesky_factor` as the last element.
    """
    rows, inverse_pivots, regular = cholesky_factor(matrix)
    size = len(rows)
    solutions: list[list[Array]] = []
    for rhs in right_hand_sides:
        forward: list[Array] = []
        for i in range(size):
            entry = rhs[i]
            for k in range(i):
                entry = entry - rows[i][k] * forward[k]
            forward.append(entry * inverse_pivots[i])
        solution = list(forward)
        for i in reversed(range(size)):
            entry = forward[i]
            for k in range(i + 1, size):
                entry = entry - rows[k][i] * solution[k]
            solution[i] = entry * inverse_pivots[i]
        solutions.append(solution)
    return (*solutions, regular)  # type: ignore[return-value]


def symmetric_inverse(matrix: Sequence[Sequence[Array]]) -> tuple[Float[Array, "d d *shape"], Array]:
    """Invert a small positive definite matrix given by its lower triangle, and say whether it could be inverted."""
    size = len(matrix)
    one, zero = jnp.ones_like(matrix[0][0]), jnp.zeros_like(matrix[0][0])
    units = [[one if i == j else zero for i in range(size)] for j in range(size)]
    *columns, regular = cholesky_solve(matrix, *units)
    return jnp.stack([jnp.stack(column) for column in columns]), regular  # type: ignore[arg-type]
