"""Absolute pose from three points: six equations, up to four poses.

With unit bearings f_i, depths d_i and squared distances a_ij = |X_i - X_j|^2, the law of cosines says

    Q_ij(d) := (d_i - d_j)^2 + k_ij d_i d_j = a_ij,      k_ij = |f_i - f_j|^2 = 2 (1 - f_i . f_j).        (1)

Every combination alpha Q_01 + beta Q_02 + delta Q_12 with (alpha, beta, delta) orthogonal to a is a conic through the
solutions. One of them is a pair of lines (its determinant, a cubic, vanishes); each line meets a second conic of the
pencil in two points. That is the construction of Ding et al. It is written here symmetrically in the three points and
projectively throughout, so that nothing is divided by a quantity that may vanish: the pencil is (u1, u2) orthogonal to
a, the cubic's root is the pair (3 c3, t - c2), the lines are spanned by their common point v and two directions, and
the roots of the quadratics are pairs as well. Differences f_i - f_j keep narrow fields of view accurate in float32.

Precondition: the points span a triangle and the bearings are distinct directions.

References:
    Y. Ding, J. Yang, V. Larsson, C. Olsson, K. Åström. Revisiting the P3P problem. CVPR 2023.
    M. Persson, K. Nordberg. Lambda Twist: an accurate fast robust perspective three point (P3P) solver. ECCV 2018.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import Vector3, cross3, dot3, normalize
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import (
    Components,
    complement,
    difference,
    floor,
    quaternion_from_rotation,
    rotate,
    sign,
    squared,
    vector3,
)
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last


def _cube_root_guess(x: Array) -> Array:
    """Cube root of a positive number to about 3 %: divide the exponent bits by three."""
    bits = jax.lax.bitcast_convert_type(x.astype(jnp.float32), jnp.int32)
    third = (bits.astype(jnp.float32) * (1.0 / 3.0)).astype(jnp.int32) + 709921077
    return jax.lax.bitcast_convert_type(third, jnp.float32).astype(x.dtype)


def _isolated_root(c: Components, newton_steps: int) -> tuple[Array, Array]:
    """The best separated root of c0 + c1 g + c2 g^2 + c3 g^3, as a pair (x, y) with g = y / x.

    t = 3 c3 g + c2 satisfies t^3 - 3 q t - 2 r = 0. The root with the sign of r is the largest in magnitude and never
    closer than 3 sqrt(q) to the others, so that Newton's iteration is well behaved there; an infinite g (c3 = 0) is an
    ordinary case.
    """
    size = jnp.abs(c[0]) + jnp.abs(c[1]) + jnp.abs(c[2]) + jnp.abs(c[3]) + floor(c[0]) ** 2
    c0, c1, c2, c3 = (x / size for x in c)
    q = c2 * c2 - 3.0 * c1 * c3
    r = c2 * (4.5 * c1 * c3 - c2 * c2) - 13.5 * c0 * c3 * c3
    side, r = sign(r), jnp.abs(r)
    discriminant = r * r - q * q * q
    tiny = floor(r) ** 2
    # Cardano where there is one real root; between three, 2 sqrt(q) cos(acos(w) / 3) is nearly linear in w = r / q^1.5.
    root = _cube_root_guess(r + jnp.sqrt(jnp.maximum(discriminant, 0.0)) + tiny)
    sqrt_q = jnp.sqrt(jnp.maximum(q, 0.0))
    chord = 1.7320508 * sqrt_q + 0.26794919 * r / (jnp.maximum(q, 0.0) + tiny)
    t = jnp.where(discriminant < 0, chord, root + q / root)

    def newton(_, t: Array) -> Array:
        slope = 3.0 * (t * t - q)
        return t - (t * (t * t - 3.0 * q) - 2.0 * r) / jnp.where(slope > tiny, slope, 1.0)

    t = jax.lax.fori_loop(0, newton_steps, newton, t)
    return 3.0 * c3, side * t - c2


def _law_of_cosines(d: Components, k: Components, a: Components) -> Components:
    """Residuals of (1) for the pairs 01, 02, 12."""
    return tuple(
        (d[i] - d[j]) * (d[i] - d[j]) + k[p] * d[i] * d[j] - a[p] for p, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)))
    )


def _newton_depths(d: Components, k: Components, a: Components) -> Components:
    """One Newton step on (1)."""
    r0, r1, r2 = _law_of_cosines(d, k, a)
    d01, d02, d12 = d[0] - d[1], d[0] - d[2], d[1] - d[2]
    j00, j01 = 2.0 * d01 + k[0] * d[1], k[0] * d[0] - 2.0 * d01
    j10, j12 = 2.0 * d02 + k[1] * d[2], k[1] * d[0] - 2.0 * d02
    j21, j22 = 2.0 * d12 + k[2] * d[2], k[2] * d[1] - 2.0 * d12
    first, second = j00 * j12 * j21, j01 * j10 * j22
    determinant = first + second
    # Within rounding of a double root the step is noise, and would throw the solution away.
    usable = jnp.abs(determinant) > float(jnp.finfo(r0.dtype).eps) ** 0.5 * (jnp.abs(first) + jnp.abs(second))
    determinant = jnp.where(usable, determinant, jnp.inf)
    s0 = (j12 * j21 * r0 + j01 * j22 * r1 - j01 * j12 * r2) / determinant
    s1 = (j10 * j22 * r0 - j00 * j22 * r1 + j00 * j12 * r2) / determinant
    s2 = (-j10 * j21 * r0 + j00 * j21 * r1 + j01 * j10 * r2) / determinant
    return (d[0] - s0, d[1] - s1, d[2] - s2)


def _depths(k: Components, a: Components, newton_steps: int) -> Components:
    """Four candidate triples of depths, up to rounding; complex solutions give something finite."""
    eps_floor = floor(k[0])
    # s_ij = sin^2 of the angle between bearings, scaled; the determinant is linear in (s, 1 - c01 c02 c12).
    h = tuple(0.5 * x for x in k)
    s = tuple(x * (2.0 - x) for x in h)
    volume = h[0] + h[1] + h[2] - h[0] * h[1] - h[0] * h[2] - h[1] * h[2] + h[0] * h[1] * h[2]
    scale = s[0] + s[1] + s[2] + eps_floor
    s0, s1, s2, g = s[0] / scale, s[1] / scale, s[2] / scale, 2.0 * volume / scale

    # Two combinations orthogonal to a: a has no negative entry, hence is never parallel to the fixed vector used here,
    # which is skew to the symmetries of an equilateral triangle.
    u: Vector3 = (0.62 * a[2] + 0.27 * a[1], -0.27 * a[0] - 0.81 * a[2], 0.81 * a[1] - 0.62 * a[0])
    w: Vector3 = cross3((a[0], a[1], a[2]), u)

    def determinant(x: Vector3) -> Array:
        return (
            x[0] * x[0] * (x[1] + x[2]) * s0
            + x[1] * x[1] * (x[0] + x[2]) * s1
            + x[2] * x[2] * (x[0] + x[1]) * s2
            + x[0] * x[1] * x[2] * g
        )

    def derivative(x: Vector3, y: Vector3) -> Array:
        gx = 2.0 * x[0] * (x[1] + x[2]) * s0 + x[1] * x[1] * s1 + x[2] * x[2] * s2 + x[1] * x[2] * g
        gy = x[0] * x[0] * s0 + 2.0 * x[1] * (x[0] + x[2]) * s1 + x[2] * x[2] * s2 + x[0] * x[2] * g
        gz = x[0] * x[0] * s0 + x[1] * x[1] * s1 + 2.0 * x[2] * (x[0] + x[1]) * s2 + x[0] * x[1] * g
        return gx * y[0] + gy * y[1] + gz * y[2]

    root_u, root_w = _isolated_root((determinant(u), derivative(u, w), derivative(w, u), determinant(w)), newton_steps)
    alpha, beta, delta = (root_u * u[i] + root_w * w[i] for i in range(3))
    norm = jnp.abs(alpha) + jnp.abs(beta) + jnp.abs(delta) + eps_floor * eps_floor
    lines: Vector3 = (alpha / norm, beta / norm, delta / norm)
    conic = cross3((a[0], a[1], a[2]), lines)
    alpha, beta, delta = lines

    # The lines meet in the null vector v of the degenerate conic: a column of its adjugate, the largest one.
    c01, c02, c12 = 1.0 - h[0], 1.0 - h[1], 1.0 - h[2]
    e = alpha * beta + alpha * delta + beta * delta
    a00 = e + delta * delta * s[2]
    a11 = e + beta * beta * s[1]
    a22 = e + alpha * alpha * s[0]
    a01 = alpha * (beta + delta) * c01 + beta * delta * c02 * c12
    a02 = beta * (alpha + delta) * c02 + alpha * delta * c01 * c12
    a12 = delta * (alpha + beta) * c12 + alpha * beta * c01 * c02
    use1 = jnp.abs(a11) > jnp.abs(a00)
    largest = jnp.where(use1, jnp.abs(a11), jnp.abs(a00))
    use2 = jnp.abs(a22) > largest
    v = tuple(
        jnp.where(use2, last, jnp.where(use1, middle, first))
        for first, middle, last in ((a00, a01, a02), (a01, a11, a12), (a02, a12, a22))
    )
    norm = jnp.sqrt(squared(v) + eps_floor * eps_floor)
    x, y, z = (component / norm for component in v)
    basis = ((x, y, z), *complement((x, y, z)))

    def forms(first: Vector3, second: Vector3) -> tuple[Array, Array]:
        values = tuple(
            (first[i] - first[j]) * (second[i] - second[j]) + 0.5 * k[q] * (first[i] * second[j] + first[j] * second[i])
            for q, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)))
        )
        return dot3(values, lines), dot3(values, conic)

    m11, k11 = forms(basis[1], basis[1])
    m12, k12 = forms(basis[1], basis[2])
    m22, k22 = forms(basis[2], basis[2])
    _, k00 = forms(basis[0], basis[0])
    _, k01 = forms(basis[0], basis[1])
    _, k02 = forms(basis[0], basis[2])

    def quadratic(qa: Array, qb: Array, qc: Array) -> tuple[Array, Array]:
        """Roots (x, y) of qa y^2 + 2 qb x y + qc x^2 on a new leading axis, real parts where they are complex."""
        root = jnp.sqrt(jnp.maximum(qb * qb - qa * qc, 0.0))
        half = -(qb + sign(qb) * root)
        first = jnp.arange(2).reshape((2,) + (1,) * qa.ndim) == 0
        x, y = (jnp.where(first, p[None], q[None]) for p, q in ((qa, half), (half, qc)))
        size = jnp.abs(x) + jnp.abs(y) + eps_floor * eps_floor
        return x / size, y / size

    px, py = quadratic(m22, m12, m11)
    kww = px * px * k11[None] + 2.0 * px * py * k12[None] + py * py * k22[None]
    kvw = px * k01[None] + py * k02[None]
    qx, qy = quadratic(kww, kvw, jnp.broadcast_to(k00[None], kww.shape))
    flat = (4, *k00.shape)
    px, py = (jnp.broadcast_to(c[None], qx.shape).reshape(flat) for c in (px, py))
    qx, qy = qx.reshape(flat), qy.reshape(flat)
    d = tuple(qx * basis[0][i][None] + qy * (px * basis[1][i][None] + py * basis[2][i][None]) for i in range(3))
    d01, d02, d12 = d[0] - d[1], d[0] - d[2], d[1] - d[2]
    # The sum of the three equations (1) sets the scale: a positive definite form, and the distances sum to one.
    form = d01 * d01 + d02 * d02 + d12 * d12
    form = form + k[0][None] * d[0] * d[1] + k[1][None] * d[0] * d[2] + k[2][None] * d[1] * d[2]
    size = sign(d[0] + d[1] + d[2]) * jnp.sqrt(jnp.maximum(form, floor(form) ** 3))
    return tuple(x / size for x in d)


def p3p_components(
    points: tuple[Vector3, Vector3, Vector3], bearings: tuple[Vector3, Vector3, Vector3]
) -> tuple[Components, Array]:
    """P3P on components: arrays of any one shape in, four poses (w, x, y, z, tx, ty, tz) and their validity out."""
    dtype = points[0][0].dtype
    double = dtype == jnp.float64
    eps = float(jnp.finfo(dtype).eps)
    x0, x1, x2 = points
    f = []
    proper = jnp.ones_like(x0[0], dtype=bool)
    for bearing in bearings:
        norm2 = squared(bearing)
        proper = proper & (norm2 > floor(norm2) ** 2) & (norm2 < 1.0 / floor(norm2) ** 2)
        inverse = jax.lax.rsqrt(jnp.where(norm2 > floor(norm2) ** 2, norm2, 1.0))
        f.append(tuple(c * inverse for c in bearing))
    f01, f02, f12 = difference(f[0], f[1]), difference(f[0], f[2]), difference(f[1], f[2])
    # Squared roots look idle, but XLA keeps a root for its consumers and recomputes a product in each of them.
    k = tuple(jnp.sqrt(squared(x)) for x in (f01, f02, f12))
    k = tuple(x * x for x in k)
    edge1, edge2, edge12 = difference(x1, x0), difference(x2, x0), difference(x2, x1)
    a = (squared(edge1), squared(edge2), squared(edge12))
    total = jnp.maximum(a[0] + a[1] + a[2], floor(a[0]) ** 3)
    unit = tuple(x / total for x in a)
    length = jnp.sqrt(total)

    normal = cross3(edge1, edge2)
    area = jnp.sqrt(squared(normal))
    # Collinear to rounding: of the products, or of the coordinates far from the origin.
    reach = length + jnp.abs(x0[0]) + jnp.abs(x0[1]) + jnp.abs(x0[2])
    proper = proper & (area > 10.0 * eps * length * reach) & jnp.isfinite(area)
    frame3 = tuple(c / jnp.where(proper, area, 1.0) for c in normal)
    edge = jnp.sqrt(jnp.where(proper, a[0], 1.0))
    frame1 = tuple(c / edge for c in edge1)
    frame2 = cross3(frame3, frame1)

    lanes = tuple(x[None] for x in k)
    unit_lanes = tuple(x[None] for x in unit)
    d = _depths(k, unit, 4 if double else 3)
    d = jax.lax.fori_loop(0, 3 if double else 2, lambda _, d: _newton_depths(d, lanes, unit_lanes), d)
    r = _law_of_cosines(d, lanes, unit_lanes)
    largest = jnp.maximum(jnp.maximum(d[0], d[1]), d[2])
    # Rounding of (1): of the distances themselves, and of the difference of two large depths. A Newton step near a
    # double root multiplies that rounding, most where scalars are not fused alike.
    tolerance = 4096.0 if double else 64.0
    ok = proper[None] & (jnp.minimum(jnp.minimum(d[0], d[1]), d[2]) > 0)
    # Bearings that agree to rounding put the camera at infinity.
    ok = ok & (largest < 1.0 / (16.0 * eps)) & (k[0] + k[1] + k[2] > (16.0 * eps) ** 2)[None]
    for q in range(3):
        ok = ok & (jnp.abs(r[q]) <= tolerance * eps * (1.0 + largest))
    # A root met twice counts once.
    for later in range(1, 4):
        twice = jnp.zeros_like(ok[later])
        for earlier in range(later):
            gap = sum(jnp.abs(c[later] - c[earlier]) for c in d)
            twice = twice | (ok[earlier] & (gap < 0.5 * eps**0.5 * largest[earlier]))
        ok = ok & ~((jnp.arange(4) == later).reshape((4,) + (1,) * twice.ndim) & twice[None])
    # The rotation takes the orthonormal frame of the triangle to that of its image.
    y = [tuple(d[i] * c[None] for c in f[i]) for i in range(3)]
    image1, image2 = difference(y[1], y[0]), difference(y[2], y[0])
    image3 = cross3(image1, image2)
    norm1, norm3 = (jnp.sqrt(jnp.maximum(squared(x), floor(length) ** 3)) for x in (image1, image3))
    image1 = tuple(c / norm1 for c in image1)
    image3 = tuple(c / norm3 for c in image3)
    image2 = cross3(image3, image1)
    rotation = tuple(
        tuple(image1[i] * frame1[j][None] + image2[i] * frame2[j][None] + image3[i] * frame3[j][None] for j in range(3))
        for i in range(3)
    )
    quaternion = quaternion_from_rotation(rotation)
    moved = rotate(quaternion, tuple(c[None] for c in x0))
    model = (*quaternion, *(length[None] * y[0][i] - moved[i] for i in range(3)))
    for c in model[4:]:
        ok = ok & jnp.isfinite(c)
    return tuple(jnp.where(ok, c, 1.0 if i == 0 else 0.0) for i, c in enumerate(model)), ok


def p3p_lanes(points_world: Array, bearings: Array) -> tuple[Array, Array]:
    """P3P for arrays [3, 3, *lanes]: poses [4, 7, *lanes] and validity [4, *lanes].

    The lanes stay the innermost axes throughout, which is what a CPU vectorises over.
    """
    points, rays = ((vector3(x[0]), vector3(x[1]), vector3(x[2])) for x in (points_world, bearings))
    model, valid = p3p_components(points, rays)
    return jnp.stack(model, axis=1), valid


_solve = lanes_last(p3p_lanes)


def _candidates(data: tuple[Array, Array]) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


def _collinearity(cam_from_world: SE3, data: tuple[Array, Array]) -> Array:
    """Six equations: the direction of each point minus its bearing, in the tangent plane of the bearing."""
    points_world, bearings = data
    directions = normalize(bearings)
    # Any basis of the tangent plane gives the same derivative at a solution, so that of the bearing is held fixed.
    held = jax.lax.stop_gradient(directions)
    tangents = complement((held[:, 0], held[:, 1], held[:, 2]))
    error = normalize(cam_from_world @ points_world) - directions
    return jnp.concatenate([jnp.sum(jnp.stack(tangent, axis=-1) * error, axis=-1) for tangent in tangents])


_p3p = implicit(_candidates, _collinearity, perturb_camera, 6)


def p3p(points_world: Float[ArrayLike, "3 3"], bearings: Float[ArrayLike, "3 3"]) -> Candidates[SE3]:
    """Find the camera poses that see three points along three bearings.

    For a batch, `jax.vmap(p3p, in_axes=-1, out_axes=-1)` on arrays [3, 3, batch] is the fast layout on a CPU.

    Args:
        points_world: Points in world coordinates, one per row.
        bearings: Directions towards them in the camera's frame, one per row, of any positive length.

    Returns:
        Four slots of `cam_from_world` in the unit of the points. Valid slots are distinct, have all points in front
        (positive distance along their bearing) and satisfy the law of cosines to rounding; the others hold the
        identity.

    Degenerate input: collinear or coincident points, zero bearings and anything not finite leave no slot valid. Near
        the danger cylinder two solutions merge: they are found to the square root of the precision, or as one.

    Differentiability: both modes, any order, by the implicit function theorem; zero for slots that are not valid and
        at double roots.

    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 4.0], [1.0, 0.0, 5.0], [0.0, 1.0, 6.0]])
        >>> candidates = p3p(points, points)
        >>> errors = jnp.abs(candidates.models.translation()).max(axis=-1)
        >>> bool(jnp.any(candidates.valid & (errors < 1e-3)))
        True
    """
    points_world, bearings = jnp.asarray(points_world), jnp.asarray(bearings)
    dtype = jnp.result_type(points_world, bearings)
    return _p3p((points_world.astype(dtype), bearings.astype(dtype)))
