"""Essential matrices that satisfy five epipolar equations exactly: the last step of every five-point solver.

A candidate is taken apart into a motion (R, t), brought to the equations ray1ᵀ [t]× R ray0 = 0 by Newton's iteration on
SO3 × S², judged by what is left of them, and put together again. Whatever precision the candidate had, the answer has
that of the rays.

References: B. Horn. Recovering baseline and orientation from essential matrix. 1990.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from vojax._numerics import Vector3, cross3, dot3, lane_max, lane_sum
from vojax._types import Array, Bool, Float

from ._components import Components, complement, floor, quaternion_from_rotation, squared
from ._matrix_models import unit_matrix

# [z]×: any essential matrix keeps an empty slot finite.
_PLACEHOLDER = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
# Irregular, so that different matrices of a symmetric scene have different marks.
_WEIGHTS = (0.31, -0.83, 0.27, 0.52, 0.71, -0.19, -0.43, 0.64, 0.91)


def polish_essential(
    entries: Float[Array, "9 s *lanes"],
    valid: Bool[Array, "s *lanes"],
    rays0: Float[Array, "5 3 *lanes"],
    rays1: Float[Array, "5 3 *lanes"],
    steps: int,
) -> tuple[Float[Array, "s 3 3 *lanes"], Bool[Array, "s *lanes"]]:
    """Newton's iteration from candidates, one per slot.

    Args:
        entries: Matrices near essential ones, row by row, of any scale.
        valid: Slots that hold a candidate.
        rays0: Unit rays of the first view.
        rays1: Of the second.
        steps: Iterations.

    Returns:
        Essential matrices of norm 1, and which satisfy the equations to rounding and were not found in an earlier slot.
        Zeros elsewhere.
    """
    eps = float(jnp.finfo(entries.dtype).eps)
    size = jnp.sqrt(lane_sum(entries * entries, axis=0))
    valid = valid & jnp.isfinite(size) & (size > floor(size))
    entries = jnp.where(
        valid[None],
        entries / jnp.where(valid, size, 1.0)[None],
        jnp.asarray(_PLACEHOLDER, entries.dtype).reshape((9,) + (1,) * size.ndim),
    )
    q, t = jax.lax.fori_loop(
        0, steps, lambda _, motion: newton_motion(motion[0], motion[1], rays0, rays1), motion_from_essential(entries)
    )
    entries = essential_entries(q, t)
    e = entries.reshape(3, 3, 1, *entries.shape[1:])
    images = lane_sum(e * jnp.moveaxis(rays0, 1, 0)[None, :, :, None], axis=1)  # [3, 5, s, *lanes]
    residual = lane_max(jnp.abs(lane_sum(images * jnp.moveaxis(rays1, 1, 0)[:, :, None], axis=0)), axis=0)
    valid = valid & (residual <= 256.0 * eps)
    # Two candidates may come to the same solution: told by two numbers that do not depend on the sign of E.
    first = sum_of_products(_WEIGHTS, list(entries))
    second = sum_of_products(_WEIGHTS, list(entries[::-1]))
    marks = jnp.stack([first * first, first * second])
    gap = lane_max(jnp.abs(marks[:, :, None] - marks[:, None]), axis=0)  # [s, s, *lanes]
    slots = np.arange(entries.shape[1])
    earlier = jnp.asarray(slots[:, None] > slots[None]).reshape(gap.shape[:2] + (1,) * (gap.ndim - 2))
    valid = valid & ~jnp.any(earlier & valid[None] & (gap < 2.0 * eps**0.5), axis=1)
    matrices, proper = unit_matrix(entries.reshape(3, 3, *entries.shape[1:]))
    valid = valid & proper
    matrices = jnp.where(valid[None, None], matrices, 0.0)
    return jnp.moveaxis(matrices, 2, 0), valid


def motion_from_essential(e: Array) -> tuple[Components, Vector3]:
    """Quaternion and unit translation of one of the motions of E, given as [9, *lanes]: any of the four serves.

    t tᵀ = ½ tr(E Eᵀ) I - E Eᵀ and (t.t) R = cof(E) - [t]× E (Horn, "Recovering baseline and orientation from essential
    matrix", 1990); for an E that is not quite essential the result is a motion nearby.
    """
    r0, r1, r2 = ((e[3 * i], e[3 * i + 1], e[3 * i + 2]) for i in range(3))
    cofactors = (cross3(r1, r2), cross3(r2, r0), cross3(r0, r1))
    half = 0.5 * (squared(r0) + squared(r1) + squared(r2))
    d0, d1, d2 = half - squared(r0), half - squared(r1), half - squared(r2)
    o01, o02, o12 = -dot3(r0, r1), -dot3(r0, r2), -dot3(r1, r2)
    use1 = d1 > d0
    largest = jnp.where(use1, d1, d0)
    use2 = d2 > largest
    column = tuple(
        jnp.where(use2, c2, jnp.where(use1, c1, c0)) for c0, c1, c2 in ((d0, o01, o02), (o01, d1, o12), (o02, o12, d2))
    )
    norm = jnp.sqrt(jnp.maximum(squared(column), floor(half) ** 2))
    t = tuple(c / norm for c in column)
    size = jnp.sqrt(jnp.maximum(half, floor(half) ** 2))
    # With |t| = sqrt(half): R half = cof - sqrt(half) [t]× E, row i of [t]× E is the cross product of t with columns.
    turned = [cross3(t, (r0[j], r1[j], r2[j])) for j in range(3)]
    rotation = tuple(tuple((cofactors[i][j] / size - turned[j][i]) / size for j in range(3)) for i in range(3))
    return quaternion_from_rotation(rotation), t


def rotation_rows(q: Components) -> tuple[Vector3, Vector3, Vector3]:
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = q
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z
    return (
        (1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy)),
        (2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx)),
        (2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy)),
    )


def newton_motion(q: Components, t: Vector3, rays0: Array, rays1: Array) -> tuple[Components, Vector3]:
    """One Newton step on the five epipolar equations over SO3 × S².

    With g = R f0: r = t . (g × f1), dr/dt = g × f1 in the plane t⊥, dr/dφ = (t.g) f1 - (g.f1) t for g → g + φ × g. All
    by components, so that one pass over the lanes computes everything.
    """
    r = rotation_rows(q)
    b1, b2 = complement(t)
    rows = []
    for i in range(5):
        f0, f1 = ((rays[i, 0][None], rays[i, 1][None], rays[i, 2][None]) for rays in (rays0, rays1))
        g = (dot3(r[0], f0), dot3(r[1], f0), dot3(r[2], f0))
        normal = cross3(g, f1)
        along, cosine = dot3(t, g), dot3(g, f1)
        rows.append(
            [dot3(b1, normal), dot3(b2, normal), *(along * f1[j] - cosine * t[j] for j in range(3)), -dot3(t, normal)]
        )
    # Modified Gram-Schmidt on the columns, the right-hand side as a sixth: backward stable without pivoting.
    columns = [[row[j] for row in rows] for j in range(6)]
    upper: list[list[Array]] = []
    for k in range(5):
        pivot = sum_of_products(columns[k], columns[k])
        pivot = jnp.where(pivot > floor(pivot) ** 2, pivot, 1.0)
        factors = [sum_of_products(columns[k], columns[j]) / pivot for j in range(k + 1, 6)]
        for j, factor in enumerate(factors, k + 1):
            columns[j] = [c - factor * a for c, a in zip(columns[j], columns[k], strict=True)]
        upper.append(factors)
    s: list[Array] = [t[0]] * 5
    for k in range(4, -1, -1):
        s[k] = upper[k][4 - k]
        for j in range(k + 1, 5):
            s[k] = s[k] - upper[k][j - k - 1] * s[j]
    # At most half a radian.
    size = jnp.sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2] + s[3] * s[3] + s[4] * s[4])
    factor = 0.5 / jnp.maximum(size, 0.5)
    s = [entry * factor for entry in s]
    t = tuple(t[i] + s[0] * b1[i] + s[1] * b2[i] for i in range(3))
    norm = jnp.sqrt(squared(t))
    w, x, y, z = q
    p0, p1, p2 = 0.5 * s[2], 0.5 * s[3], 0.5 * s[4]
    q = (
        w - p0 * x - p1 * y - p2 * z,
        x + p0 * w + p1 * z - p2 * y,
        y + p1 * w + p2 * x - p0 * z,
        z + p2 * w + p0 * y - p1 * x,
    )
    norm_q = jnp.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return tuple(c / norm_q for c in q), tuple(c / norm for c in t)


def sum_of_products(a: Sequence[Array | float], b: Sequence[Array]) -> Array:
    """Scalar product of vectors by components."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def essential_entries(q: Components, t: Vector3) -> Array:
    """[t]× R / √2 as [9, *lanes]."""
    r = rotation_rows(q)
    columns = [cross3(t, (r[0][j], r[1][j], r[2][j])) for j in range(3)]
    return jnp.stack([columns[j][i] for i in range(3) for j in range(3)]) * 0.5**0.5
