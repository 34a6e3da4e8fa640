"""Poses from six equations linear in rotation and translation: what minimal solvers of points and lines share.

A point X on a ray, or a point of a line in the plane through the camera and its image, gives equations

    n_k · (R X_k + t) = c_k,      k = 1 … 6.                                                                       (1)

Three combinations of them are free of t: those of the null space of the matrix of the n_k. With R a quadratic form of a
quaternion q over |q|² they are three quadrics in q, whose up to eight common points `three_quadrics` finds. Then t is
the solution of (1) for the known R.

References:
    L. Zhou, J. Ye, M. Kaess. A stable algebraic camera pose estimation for minimal configurations of 2D/3D point and
    line correspondences. ACCV 2018. Z. Kukelova, J. Heller, A. Fitzgibbon, 2016 (see `_three_quadrics`).
"""

import jax.numpy as jnp
import numpy as np

from vojax._numerics import cross3, dot3, lane_sum, symmetric_inverse
from vojax._types import Array, Bool, Float

from ._components import Components, floor
from ._null_space import null_space_and_rank
from ._three_quadrics import orthonormal_rows, three_quadrics

# Turns (unit quaternions to four digits) of the points and of the result, so that no simple pose is a special case.
_BEFORE = (0.64, -0.37, 0.53, 0.42)
_AFTER = (0.51, 0.58, 0.31, -0.55)


def _unit(wxyz: tuple[float, ...]) -> np.ndarray:
    return np.array(wxyz) / np.linalg.norm(wxyz)


def _matrix(wxyz: tuple[float, ...]) -> np.ndarray:
    """Rotation matrix of a quaternion."""
    w, *v = _unit(wxyz)
    cross = np.cross(np.eye(3), v)
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _turned(rotation: np.ndarray, x: Array) -> list[Array]:
    """Components [n, *lanes] of R x, for vectors [n, 3, *lanes]."""
    return [sum(float(rotation[a, b]) * x[:, b] for b in range(3)) for a in range(3)]  # type: ignore[misc]


def _product(a: Components, b: Components) -> Components:
    """Product of quaternions."""
    u, v = (a[1], a[2], a[3]), (b[1], b[2], b[3])
    vector = cross3(u, v)
    return (a[0] * b[0] - dot3(u, v), *(a[0] * v[i] + b[0] * u[i] + vector[i] for i in range(3)))


def _quadrics(normals: Array, x: Array, c: Array, free: Array) -> Array:
    """Three quadrics [3, 10, *lanes] in the turned quaternion."""
    n, p = jnp.stack(_turned(_matrix(_AFTER), normals)), jnp.stack(_turned(_matrix(_BEFORE), x))
    products = (n[:, None] * p[None]).reshape(9, *c.shape)
    table = jnp.concatenate([products, -c[None]])  # [10, 6, *lanes]
    m = lane_sum(free[:, None] * table[None], axis=2)
    # Kept as quotients, which are not computed again.
    m = m / jnp.sqrt(1.0 + lane_sum(m * m, axis=1))[:, None]
    m00, m01, m02, m10, m11, m12, m20, m21, m22, last = (m[:, k] for k in range(10))
    entries = (
        *(last + m00 + m11 + m22, 2.0 * (m21 - m12), 2.0 * (m02 - m20), 2.0 * (m10 - m01)),
        *(last + m00 - m11 - m22, 2.0 * (m01 + m10), 2.0 * (m02 + m20)),
        *(last - m00 + m11 - m22, 2.0 * (m12 + m21)),
        last - m00 - m11 + m22,
    )
    return jnp.stack(entries, axis=1)


def six_linear_equations(
    normals: Float[Array, "6 3 *lanes"],
    points: Float[Array, "6 3 *lanes"],
    constants: Float[Array, "6 *lanes"],
    newton_steps: int,
) -> tuple[Float[Array, "8 7 *lanes"], Bool[Array, "8 *lanes"]]:
    """All poses that satisfy six equations (1).

    Args:
        normals: Vectors n, of length one.
        points: Points X.
        constants: The numbers c.
        newton_steps: On the three quadrics.

    Returns:
        Poses as quaternion and translation, and which of them solve the equations to rounding.

    Degenerate input: dependent n, or quadrics with a common curve, leave no slot valid; so does anything not finite.
    """
    dtype = points.dtype
    eps = float(jnp.finfo(dtype).eps)
    size = jnp.maximum(jnp.max(jnp.abs(points), axis=(0, 1)), jnp.max(jnp.abs(constants), axis=0))
    proper = jnp.isfinite(size) & (size < 1.0 / floor(size) ** 2) & jnp.all(jnp.isfinite(normals), axis=(0, 1))
    points = jnp.where(proper[None, None], points, 0.0)
    constants = jnp.where(proper[None], constants, 0.0)
    normals = jnp.where(proper[None, None], normals, 0.0)
    mean = points[0] + lane_sum(points - points[:1], axis=0) / 6.0
    x = points - mean[None]
    spread = jnp.max(jnp.abs(x), axis=(0, 1))
    reach = jnp.max(jnp.abs(points), axis=(0, 1))
    proper = proper & (spread > 16.0 * eps * reach) & (spread > floor(spread) ** 2)
    unit = jnp.where(proper, spread, 1.0)
    x, c = x / unit[None, None], constants / unit[None]

    free, independent = null_space_and_rank(jnp.swapaxes(normals, 0, 1))  # [3, 6, *lanes]
    quadrics, distinct = orthonormal_rows(_quadrics(normals, x, c, free))
    proper = proper & independent & distinct
    q, valid, residual = three_quadrics(quadrics, newton_steps)

    before, after = (tuple(jnp.asarray(c, dtype) for c in _unit(turn)) for turn in (_BEFORE, _AFTER))
    after = (after[0], -after[1], -after[2], -after[3])
    w, i, j, k = _product(_product(after, tuple(q[a] for a in range(4))), before)
    norm = w * w + i * i + j * j + k * k
    w2, i2, j2, k2 = 2.0 * w, 2.0 * i, 2.0 * j, 2.0 * k
    rotation = (
        (1.0 - (j2 * j + k2 * k) / norm, (i2 * j - w2 * k) / norm, (i2 * k + w2 * j) / norm),
        ((i2 * j + w2 * k) / norm, 1.0 - (i2 * i + k2 * k) / norm, (j2 * k - w2 * i) / norm),
        ((i2 * k - w2 * j) / norm, (j2 * k + w2 * i) / norm, 1.0 - (i2 * i + j2 * j) / norm),
    )
    # t from N t = c - (n · R x) in the least-squares sense: (Nᵀ N)⁻¹ Nᵀ times the table n ⊗ x, which no slot changes.
    inverse, regular = symmetric_inverse(lane_sum(normals[:, :, None] * normals[:, None], axis=0), lane_sum)
    pseudo = lane_sum(inverse[:, :, None] * jnp.swapaxes(normals, 0, 1)[None], axis=1)  # [3, 6, *lanes]
    products = normals[:, :, None] * x[:, None]
    table = lane_sum(pseudo[:, :, None, None] * products[None], axis=1)  # [3, 3, 3, *lanes]
    turns = jnp.stack([jnp.stack(row) for row in rotation])  # [3, 3, slots, *lanes]
    turned = lane_sum(table[:, :, :, None] * turns[None], axis=(1, 2))
    moved = lane_sum(turns * mean[None, :, None], axis=1)
    t = unit[None, None] * (lane_sum(pseudo * c[None], axis=1)[:, None] - turned) - moved
    tolerance = 4096.0 if dtype == jnp.float64 else 64.0
    valid = valid & (proper & regular)[None] & (residual <= tolerance * eps)
    model = jnp.stack([w, i, j, k, *t], axis=1)
    return model, valid & jnp.all(jnp.isfinite(model), axis=1)
