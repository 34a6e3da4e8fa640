"""Singular value decomposition of 3×3 matrices, component by component.

One-sided Jacobi: plane rotations from the right make the columns of A V orthogonal, and their lengths are the singular
values. It keeps small singular values accurate, needs no special cases for repeated ones, and vectorises.

References: G. Golub, C. Van Loan. Matrix Computations, 4th edition, section 8.6.3.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from vojax._numerics import Vector3, cross3, dot3
from vojax._types import Array

from ._components import Rows3, complement, floor, sign, squared


def svd3(matrix: Sequence[Sequence[Array]]) -> tuple[Rows3, tuple[Array, Array, Array], Rows3]:
    """Decompose A = U diag(s) Vᵀ with rotations U and V.

    Args:
        matrix: Rows of A by components: arrays of any one shape.

    Returns:
        The columns of U; s with s0 >= s1 >= |s2|, where s2 has the sign of det A; the columns of V. U and V are
        proper rotations, so U Vᵀ is the rotation nearest to A, with no reflection to correct.

    Degenerate input: any matrix is fine; where singular values are equal or zero the vectors are some valid choice.
        Entries that are not finite give results that are not.
    """
    largest = jnp.zeros_like(matrix[0][0])
    for row in matrix:
        for entry in row:
            largest = jnp.maximum(largest, jnp.abs(entry))
    scale = jnp.where(largest > 0, largest, 1.0)
    one, zero = jnp.ones_like(scale), jnp.zeros_like(scale)
    a = tuple((matrix[0][j] / scale, matrix[1][j] / scale, matrix[2][j] / scale) for j in range(3))
    v = ((one, zero, zero), (zero, one, zero), (zero, zero, one))

    # Which column is longer must be one decision for all that follows from it. Computed after the loop it would be
    # compiled once for each use, with roundings of its own: of columns of equal length, as a rotation has, two could
    # both end up in one place. What a loop carries is stored, and the same for all.
    def sweep(_: object, state: tuple[Rows3, Rows3, Vector3]) -> tuple[Rows3, Rows3, Vector3]:
        a, v = (list(c) for c in state[:2])
        for p, q in ((0, 1), (0, 2), (1, 2)):
            gamma = 2.0 * dot3(a[p], a[q])
            delta = squared(a[q]) - squared(a[p])
            denominator = jnp.abs(delta) + jnp.sqrt(delta * delta + gamma * gamma)
            usable = denominator > floor(denominator) ** 3
            tangent = jnp.where(usable, sign(delta) * gamma / jnp.where(usable, denominator, 1.0), 0.0)
            cosine = 1.0 / jnp.sqrt(1.0 + tangent * tangent)
            sine = tangent * cosine
            for c in (a, v):
                c[p], c[q] = _mix(cosine, c[p], -sine, c[q]), _mix(sine, c[p], cosine, c[q])
        return (a[0], a[1], a[2]), (v[0], v[1], v[2]), (squared(a[0]), squared(a[1]), squared(a[2]))

    sweeps = 6 if scale.dtype == jnp.float64 else 5
    a, v, lengths = jax.lax.fori_loop(0, sweeps, sweep, (a, v, (zero, zero, zero)))

    # Longest first; an exchange negates one of the two columns, so that V stays a rotation.
    a, v, lengths = list(a), list(v), list(lengths)
    for p, q in ((0, 1), (0, 2), (1, 2)):
        exchange = lengths[p] < lengths[q]
        lengths[p], lengths[q] = jnp.maximum(lengths[p], lengths[q]), jnp.minimum(lengths[p], lengths[q])
        for c in (a, v):
            c[p], c[q] = (
                _where(exchange, c[q], c[p]),
                _where(exchange, (-c[p][0], -c[p][1], -c[p][2]), c[q]),
            )

    u0, s0 = _direction(a[0], (one, zero, zero))
    along = dot3(a[1], u0)
    u1, s1 = _direction((a[1][0] - along * u0[0], a[1][1] - along * u0[1], a[1][2] - along * u0[2]), complement(u0)[0])
    u2 = cross3(u0, u1)
    s2 = dot3(a[2], u2)
    return (u0, u1, u2), (s0 * scale, s1 * scale, s2 * scale), (v[0], v[1], v[2])


def _mix(a: Array, x: Vector3, b: Array, y: Vector3) -> Vector3:
    return (a * x[0] + b * y[0], a * x[1] + b * y[1], a * x[2] + b * y[2])


def _where(condition: Array, a: Vector3, b: Vector3) -> Vector3:
    return (jnp.where(condition, a[0], b[0]), jnp.where(condition, a[1], b[1]), jnp.where(condition, a[2], b[2]))


def _direction(a: Vector3, fallback: Vector3) -> tuple[Vector3, Array]:
    """Unit vector and length of a vector that may be zero."""
    length = jnp.sqrt(squared(a))
    usable = length > floor(length) ** 2
    safe = jnp.where(usable, length, 1.0)
    return _where(usable, (a[0] / safe, a[1] / safe, a[2] / safe), fallback), length
