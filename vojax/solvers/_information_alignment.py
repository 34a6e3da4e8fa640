"""Gauss-Newton steps of rigid alignment with a 3x3 information matrix per point; shared by its solvers and by ICP.

With e_i = y_i - (R x_i + t) and u_i = A_i e_i, a small motion (ρ, φ), R x + t -> R x + t + ρ + φ x p_i, satisfies

    sum_i w_i [A_i, B_iᵀ; B_i, D_i] (ρ, φ) = sum_i w_i (u_i, p_i x u_i),    B_i = [p_i]x A_i,  D_i = B_i [p_i]xᵀ.   (1)

p_i is R x_i, without t: the turn is about the point that t moves, which the callers put in the middle of the set.
"""

import jax.numpy as jnp

from vojax._numerics import Vector3, cholesky_solve, cross3, dot3
from vojax._types import Array, Bool, Float

from ._components import Components, Rows3
from ._symmetric import diagonal_sum, swept_inverse

# Rows and columns of the upper triangle, for symmetric matrices by components.
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def rotation_rows(wxyz: Components) -> Rows3:
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = wxyz
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def symmetric_rows(matrices: Float[Array, "n 3 3 *lanes"]) -> Rows3:
    """Rows by components [n, *lanes]; the lower triangle is not read."""
    m = {(i, j): matrices[:, i, j] for i, j in _PAIRS}
    return ((m[0, 0], m[0, 1], m[0, 2]), (m[0, 1], m[1, 1], m[1, 2]), (m[0, 2], m[1, 2], m[2, 2]))


def times(matrix: Rows3, x: Vector3) -> Vector3:
    """Matrix times vector."""
    return (dot3(matrix[0], x), dot3(matrix[1], x), dot3(matrix[2], x))


def turned(rotation: Rows3, covariance: Rows3) -> Rows3:
    """R C Rᵀ of a symmetric C."""
    half = tuple(times(covariance, row) for row in rotation)  # rows of R C, for C = Cᵀ
    m = {(i, j): dot3(half[i], rotation[j]) for i, j in _PAIRS}
    return ((m[0, 0], m[0, 1], m[0, 2]), (m[0, 1], m[1, 1], m[1, 2]), (m[0, 2], m[1, 2], m[2, 2]))


def total(a: Rows3, b: Rows3) -> Rows3:
    """Sum of two matrices."""
    (a0, a1, a2), (b0, b1, b2) = a, b
    return (
        (a0[0] + b0[0], a0[1] + b0[1], a0[2] + b0[2]),
        (a1[0] + b1[0], a1[1] + b1[1], a1[2] + b1[2]),
        (a2[0] + b2[0], a2[1] + b2[1], a2[2] + b2[2]),
    )


def information(covariance: Rows3) -> tuple[Rows3, Bool[Array, "n *lanes"]]:
    """Inverses of covariances, by square roots so that thin ones keep their digits, and which are positive definite."""
    (c00, c01, c02), (_, c11, c12), (_, _, c22) = covariance
    # Rounding of what was turned before, hence relative to the whole and not to the entry.
    rounding = 16.0 * float(jnp.finfo(c00.dtype).eps) * (c00 + c11 + c22)
    ok = c00 > rounding
    p0 = jnp.where(ok, c00, 1.0)
    l10, l20 = c01 / p0, c02 / p0
    p1 = c11 - l10 * c01
    ok = ok & (p1 > rounding)
    p1 = jnp.where(ok, p1, 1.0)
    r21 = c12 - l10 * c02
    l21 = r21 / p1
    p2 = c22 - l20 * c02 - l21 * r21
    ok = ok & (p2 > rounding) & jnp.isfinite(p2)
    p0, p1, p2 = (jnp.where(ok, p, 1.0) for p in (p0, p1, p2))
    l10, l20, l21 = (jnp.where(ok, c, 0.0) for c in (l10, l20, l21))
    # Rows of L⁻¹ for the unit triangle L; the inverse is L⁻ᵀ diag(1 / p) L⁻¹.
    k20 = l10 * l21 - l20
    i0, i1, i2 = (jnp.where(ok, 1.0 / p, 0.0) for p in (p0, p1, p2))
    a00 = i0 + l10 * l10 * i1 + k20 * k20 * i2
    a01 = -l10 * i1 - k20 * l21 * i2
    a02, a12 = k20 * i2, -l21 * i2
    a11 = i1 + l21 * l21 * i2
    return ((a00, a01, a02), (a01, a11, a12), (a02, a12, i2)), ok


def normal_equations(
    p: Vector3, u: Vector3, a: Rows3, weights: Float[Array, "n *lanes"]
) -> tuple[Float[Array, "6 6 *lanes"], Float[Array, "6 *lanes"]]:
    """Both sides of (1): components [n, *lanes] in."""
    columns = (a[0], a[1], a[2])  # symmetric
    moved = tuple(cross3(p, c) for c in columns)  # columns of B
    b = tuple((moved[0][i], moved[1][i], moved[2][i]) for i in range(3))  # rows of B
    d = tuple(cross3(p, row) for row in b)
    entries: dict[tuple[int, int], Array] = {}
    for i in range(3):
        for j in range(i, 3):
            entries[i, j] = jnp.sum(weights * a[i][j], axis=0)
            entries[3 + i, 3 + j] = jnp.sum(weights * d[i][j], axis=0)
        for j in range(3):
            entries[j, 3 + i] = jnp.sum(weights * b[i][j], axis=0)
    normal = jnp.stack([jnp.stack([entries[min(i, j), max(i, j)] for j in range(6)]) for i in range(6)])
    torque = cross3(p, u)
    rhs = jnp.stack([jnp.sum(weights * c, axis=0) for c in (*u, *torque)])
    return normal, rhs


def solve_step(
    normal: Float[Array, "6 6 *lanes"], rhs: Float[Array, "6 *lanes"]
) -> tuple[Float[Array, "6 *lanes"], Bool[Array, "*lanes"]]:
    """The motion (ρ, φ); directions without information are not moved along, and make it irregular."""
    step, regular = cholesky_solve(normal, rhs[:, None])
    finite = jnp.all(jnp.isfinite(step[:, 0]), axis=0)
    return jnp.where(finite[None], step[:, 0], 0.0), regular & finite


def damped_step(normal: Float[Array, "6 6"], rhs: Float[Array, "6"]) -> tuple[Float[Array, "6"], Bool[Array, ""]]:
    """The motion (ρ, φ) for matches that may leave directions free: rounding of long sums does not move along them.

    False where a direction has less than 256 eps of the mean information of the shifts, or of the turns.
    """
    eps = float(jnp.finfo(normal.dtype).eps)
    diagonal = jnp.stack([normal[i, i] for i in range(6)])
    # By unit, not by entry: along an axis that all lines follow, an entry is a difference of ones.
    mean = jnp.concatenate([jnp.broadcast_to(jnp.mean(part), 3) for part in (diagonal[:3], diagonal[3:])])
    identity = jnp.eye(6, dtype=normal.dtype)
    inverse, _ = swept_inverse(normal + 64.0 * eps * mean[None] * identity)
    step = jnp.sum(inverse * rhs[None], axis=1)
    trace = diagonal_sum(mean[None] * inverse * identity)
    finite = jnp.all(jnp.isfinite(step))
    return jnp.where(finite, step, 0.0), finite & jnp.all(mean > 0) & (trace < 1.0 / (256.0 * eps))


def turn(wxyz: Components, phi: Vector3) -> Components:
    """exp(φ) q to second order, of unit length: never more than half a turn, whatever φ."""
    w, x, y, z = wxyz
    a, b, c = 0.5 * phi[0], 0.5 * phi[1], 0.5 * phi[2]
    q = (w - a * x - b * y - c * z, x + a * w + b * z - c * y, y + b * w + c * x - a * z, z + c * w + a * y - b * x)
    # Quotients, not products with a reciprocal, which XLA would recompute.
    norm = jnp.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return tuple(x / norm for x in q)
