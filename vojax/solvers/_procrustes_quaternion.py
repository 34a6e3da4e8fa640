"""Rigid motion between two point sets by Horn's quaternion: the problem of `procrustes` without singular values.

With the correlation H = sum_i w_i (y_i - ȳ)(x_i - x̄)ᵀ, the unit quaternion q of the best rotation maximises

    trace(R(q)ᵀ H) = qᵀ N q,    N = [[tr H, dᵀ], [d, H + Hᵀ - tr H I]],    d = (H21 - H12, H02 - H20, H10 - H01),  (1)

so it is the eigenvector of the largest eigenvalue λ of the symmetric 4x4 matrix N. Scaled to |H| = 1, λ is the largest
root of

    (λ² - 1)² = 8 det(H) λ + 4 |cof H|²,                                                                          (2)

a convex quartic there: Newton's iteration comes down to λ from above. In this form, unlike in powers of λ, it loses no
digits for points that are almost on a line, where two roots meet at λ = 1. Then q is a column of the adjugate of
N - λ I, the one with the largest diagonal entry, so that it never vanishes with a component of q; and two Newton steps
on the sphere |q| = 1,

    q <- q + P (λ I - Pᵀ N P)⁻¹ Pᵀ N q,    P = (q i, q j, q k),    λ = qᵀ N q,                                    (3)

take away what rounding of (2) left. The matrix in (3) has the gaps λ - λ_k for eigenvalues, which say how unique q is.
Eigenvectors of unit quaternions are rotations: a reflection cannot come out.

References:
    B. Horn. Closed-form solution of absolute orientation using unit quaternions. JOSA A 1987.
    M. Shuster, S. Oh. Three-axis attitude determination from vector observations. JGC 1981 (Newton's iteration).
"""

import jax
import jax.numpy as jnp

from vojax._numerics import cholesky_solve, dot3
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import Components, Rows3, difference, rotate
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last
from ._procrustes import centred, correspondences
from ._weighted_points import Correspondences, centred_components, largest_coordinate, normal_weights


def _largest_root(h: Rows3) -> tuple[Array, Array]:
    """Largest root of (2), for |H| = 1; and 2 |cof H|."""
    cofactors = tuple(
        tuple(
            h[(i + 1) % 3][(j + 1) % 3] * h[(i + 2) % 3][(j + 2) % 3]
            - h[(i + 1) % 3][(j + 2) % 3] * h[(i + 2) % 3][(j + 1) % 3]
            for j in range(3)
        )
        for i in range(3)
    )
    determinant = dot3(h[0], cofactors[0])
    c = 4.0 * (dot3(cofactors[0], cofactors[0]) + dot3(cofactors[1], cofactors[1]) + dot3(cofactors[2], cofactors[2]))
    b = 8.0 * determinant
    # An upper bound, and close where the right-hand side of (2) is small: λ is at most sqrt(3).
    start = jnp.sqrt(1.0 + jnp.sqrt(c + 1.7320508 * jnp.maximum(b, 0.0)))

    def newton(_: object, root: Array) -> Array:
        mu = root * root - 1.0
        slope = 4.0 * root * mu - b
        # Beyond a double root rounding decides; then it stays.
        step = (mu * mu - (b * root + c)) / jnp.where(slope > 0, slope, jnp.inf)
        return root - step

    return jax.lax.fori_loop(0, 9 if start.dtype == jnp.float64 else 7, newton, start), jnp.sqrt(c)


def _null_vector(m: tuple[Components, ...]) -> Components:
    """Unit null vector of a symmetric 4x4 matrix: the column of its adjugate with the largest diagonal entry."""
    (a00, a01, a02, a03), (_, a11, a12, a13), (_, _, a22, a23), (_, _, _, a33) = m
    s0, s1, s2 = a00 * a11 - a01 * a01, a00 * a12 - a01 * a02, a00 * a13 - a01 * a03
    s3, s4, s5 = a01 * a12 - a11 * a02, a01 * a13 - a11 * a03, a02 * a13 - a12 * a03
    c5, c4, c3 = a22 * a33 - a23 * a23, a12 * a33 - a13 * a23, a12 * a23 - a13 * a22
    c2, c1 = a02 * a33 - a03 * a23, a02 * a23 - a03 * a22
    b00, b01 = a11 * c5 - a12 * c4 + a13 * c3, a02 * c4 - a01 * c5 - a03 * c3
    b02, b03 = a13 * s5 - a23 * s4 + a33 * s3, a22 * s4 - a12 * s5 - a23 * s3
    b11, b12, b13 = a00 * c5 - a02 * c2 + a03 * c1, a23 * s2 - a03 * s5 - a33 * s1, a02 * s5 - a22 * s2 + a23 * s1
    b22, b23, b33 = a03 * s4 - a13 * s2 + a33 * s0, a12 * s2 - a02 * s4 - a23 * s0, a02 * s3 - a12 * s1 + a22 * s0
    columns = ((b00, b01, b02, b03), (b01, b11, b12, b13), (b02, b12, b22, b23), (b03, b13, b23, b33))
    best, q = jnp.abs(b00), columns[0]
    for k in range(1, 4):
        better = jnp.abs(columns[k][k]) > best
        best = jnp.where(better, jnp.abs(columns[k][k]), best)
        q = tuple(jnp.where(better, new, old) for new, old in zip(columns[k], q, strict=True))
    return _unit(tuple(c / jnp.where(best > 0, best, 1.0) for c in q))


def _unit(q: Components) -> Components:
    norm = jnp.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return tuple(c / jnp.where(norm > 0, norm, 1.0) for c in q)


def _dot4(a: Components, b: Components) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


def _newton_step(q: Components, n: tuple[Components, ...]) -> tuple[Components, Array, Array]:
    """Step (3): the quaternion, a lower bound of λ - λ_k, at least a third of it, and whether λ is the largest."""
    w, x, y, z = q
    basis = ((-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w))
    image = tuple(_dot4(row, q) for row in n)
    value = _dot4(q, image)
    images = [tuple(_dot4(row, p) for row in n) for p in basis]
    rows = [[-_dot4(basis[i], images[j]) + (value if i == j else 0.0) for j in range(3)] for i in range(3)]
    matrix = jnp.stack([jnp.stack(row) for row in rows])
    identity = jnp.eye(3, dtype=matrix.dtype).reshape(3, 3, *(1,) * value.ndim)
    inverse, regular = cholesky_solve(matrix, jnp.broadcast_to(identity, matrix.shape))
    rhs = tuple(_dot4(p, image) for p in basis)
    step = [dot3((inverse[i, 0], inverse[i, 1], inverse[i, 2]), rhs) for i in range(3)]
    q = _unit(tuple(q[k] + step[0] * basis[0][k] + step[1] * basis[1][k] + step[2] * basis[2][k] for k in range(4)))
    trace = inverse[0, 0] + inverse[1, 1] + inverse[2, 2]
    return q, 1.0 / jnp.where(regular, trace, jnp.inf), regular


def _kernel(points0: Array, points1: Array, weights: Array) -> tuple[Array, Array]:
    """Arrays [n, 3, *lanes] and weights [n, *lanes]: pose [1, 7, *lanes] and validity [1, *lanes]."""
    weights, ok = normal_weights(weights, points0, points1)
    x, mean0 = centred_components(points0, weights, ok)
    y, mean1 = centred_components(points1, weights, ok)
    h = [[jnp.sum(weights * y[i] * x[j], axis=0) for j in range(3)] for i in range(3)]
    largest = jnp.max(jnp.abs(jnp.stack([jnp.stack(row) for row in h])), axis=(0, 1))
    ok = ok & (largest > 0) & jnp.isfinite(largest)
    # A half turn's worth of identity in its place: three equal eigenvalues would divide by zero.
    h = [[jnp.where(ok, h[i][j] / jnp.where(ok, largest, 1.0), float(i == j)) for j in range(3)] for i in range(3)]
    norm = jnp.sqrt(sum((c * c for row in h for c in row), jnp.zeros_like(largest)))
    (h00, h01, h02), (h10, h11, h12), (h20, h21, h22) = rows = tuple(tuple(c / norm for c in row) for row in h)
    trace = h00 + h11 + h22
    d0, d1, d2 = h21 - h12, h02 - h20, h10 - h01
    s01, s02, s12 = h01 + h10, h02 + h20, h12 + h21
    n = (
        (trace, d0, d1, d2),
        (d0, 2.0 * h00 - trace, s01, s02),
        (d1, s01, 2.0 * h11 - trace, s12),
        (d2, s02, s12, 2.0 * h22 - trace),
    )
    root, width = _largest_root(rows)  # type: ignore[arg-type]
    q = _null_vector(tuple(tuple(c - root if i == j else c for j, c in enumerate(row)) for i, row in enumerate(n)))
    gap, regular = jnp.zeros_like(root), jnp.zeros_like(ok)
    q, gap, regular = jax.lax.fori_loop(0, 2, lambda _, state: _newton_step(state[0], n), (q, gap, regular))
    eps = float(jnp.finfo(root.dtype).eps)
    # Rounding of H is eps |H|, that of the coordinates eps |p| each. On a line the gap itself is a quotient of rounding
    # errors: the width, 2 |cof H| and so twice the second singular value, has to exceed them too.
    margin = (64.0 if eps < 1e-10 else 16.0) * eps
    magnitude = largest_coordinate(points0, ok) * largest_coordinate(points1, ok)
    size = jnp.where(ok, largest, 1.0) * norm
    ok = ok & regular & (jnp.minimum(gap, width) > margin + margin**2 * magnitude / size)
    model = (*q, *difference(mean1, rotate(q, mean0)))
    for component in model:
        ok = ok & jnp.isfinite(component)
    model = tuple(jnp.where(ok, c, 1.0 if i == 0 else 0.0) for i, c in enumerate(model))
    return jnp.stack(model)[None], ok[None]


_solve = lanes_last(_kernel)


def _candidates(data: Correspondences) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


def _stationarity(model: SE3, data: Correspondences) -> Array:
    """Six equations: the torque of the residuals about the centroid, and their sum."""
    x, y, mean0, mean1, weights = centred(data)
    torque = jnp.sum(weights * jnp.cross(y, model.rotation() @ x), axis=0)
    return jnp.concatenate([torque, model @ mean0 - mean1])


_procrustes_quaternion = implicit(_candidates, _stationarity, perturb_camera, 6)


def procrustes_quaternion(
    points0: Float[ArrayLike, "n 3"], points1: Float[ArrayLike, "n 3"], weights: Float[ArrayLike, "n"] | None = None
) -> Candidates[SE3]:
    """Find the rigid motion that takes `points0` to `points1` in the least-squares sense, by Horn's quaternion.

    The same optimum as `procrustes`, by another road: an eigenvector in nearly closed form instead of a singular value
    decomposition by sweeps, in about half the time for few points.

    Args:
        points0: Points in frame 0, one per row, at least three.
        points1: The same points in frame 1.
        weights: One non-negative weight per point, as 1 / σ²; their common scale does not matter. All equal by default.

    Returns:
        One slot with `frame1_from_frame0`: `points1 ≈ model @ points0`. Always a rotation, never a reflection.

    Degenerate input: points that are coincident or collinear to rounding (in float32, thinner than about 1e-3 of their
        length), a mirrored set whose best rotation is not unique, negative weights and anything not finite leave the
        slot invalid with the identity in it. In sets a hundredth of their length thin this loses two digits that
        `procrustes` keeps.
    Differentiability: both modes, any order, in points and weights, by the implicit function theorem; exact where
        the other eigenvalues coincide. Zero for an invalid slot.

    Raises:
        ValueError: If there are fewer than three points or the arrays do not match.
    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
        >>> candidates = procrustes_quaternion(points, points + 1.0)
        >>> bool(jnp.allclose(candidates.models.translation(), 1.0, atol=1e-5))
        True
    """
    return _procrustes_quaternion(correspondences(points0, points1, weights))
