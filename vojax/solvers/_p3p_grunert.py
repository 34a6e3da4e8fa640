"""Absolute pose from three points, the classical way: distances first, then the pose.

Stage one. With unit bearings f_i, depths d_i and squared distances a_ij = |X_i - X_j|^2, the law of cosines says

    (d_i - d_j)^2 + k_ij d_i d_j = a_ij,      k_ij = |f_i - f_j|^2 = 2 (1 - f_i . f_j).                          (1)

Put d_1 = (1 + x) d_0 and d_2 = (1 + y) d_0 and eliminate d_0. Two quadratics in (x, y) remain,

    a_02 (x^2 + k_01 (1 + x)) - a_01 B = 0,                       B = y^2 + k_02 (1 + y)                           (2)
    a_02 ((x - y)^2 + k_12 (1 + x)(1 + y)) - a_12 B = 0,                                                           (3)

whose difference is linear in x: D x = N with D of degree 1 and N of degree 2 in y. Put into (2), Grunert's quartic

    a_02 (N^2 + k_01 (D^2 + N D)) - a_01 B D^2 = 0.                                                                (4)

Two quadratics have at most 2 · 2 = 4 common roots: an upper bound, which real and positive ones need not reach. Each
real y is put back into (2), not into N / D: where D vanishes, both roots of (2) are solutions, and nothing is divided
by. What does not solve (1) drops out.

Stage two. The rotation takes the triangle of the points to that of its image.

The points are numbered such that a_02 is the longest side; the ratios y are pairs, so that d_0 = 0 is no exception.

References:
    J. A. Grunert. Das Pothenotische Problem in erweiterter Gestalt. Archiv der Mathematik und Physik, 1841.
    R. Haralick, C.-N. Lee, K. Ottenberg, M. Nölle. Review and analysis of solutions of the three point perspective
        pose estimation problem. IJCV 1994.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import cross3, lane_sum
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import Components, difference, floor, quaternion_from_rotation, rotate, sign, squared, vector3
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last, one_kernel
from ._p3p import _collinearity, _law_of_cosines, _newton_depths
from ._roots import pack, quartic_roots

Polynomial = list[Array]


def _times(p: Polynomial, q: Polynomial) -> Polynomial:
    product: Polynomial = [jnp.zeros_like(p[0])] * (len(p) + len(q) - 1)
    for i, a in enumerate(p):
        for j, b in enumerate(q):
            product[i + j] = product[i + j] + a * b
    return product


def _real_roots(c: Array) -> tuple[Array, Array]:
    """Roots of a quartic as `quartic_roots` gives them; free slots take extrema at which it nearly vanishes.

    The coefficients are rounded more than their size tells, so a double root may seem far from being real.
    """
    factors = jnp.arange(1.0, 5.0, dtype=c.dtype).reshape((4,) + (1,) * (c.ndim - 1))
    derivative = jnp.concatenate([c[1:] * factors, jnp.zeros_like(c[:1])])
    # Both in one call: what is compiled is half as long.
    (u, v), real = quartic_roots(jnp.stack([c, derivative], axis=1))
    value, power = c[4][None, None] * jnp.ones_like(u), jnp.ones_like(v)
    for k in range(3, -1, -1):
        power = power * v
        value = value * u + c[k][None, None] * power
    vanishes = jnp.abs(value) < float(jnp.finfo(c.dtype).eps) ** 0.5 * lane_sum(jnp.abs(c), axis=0)[None, None]
    usable = jnp.concatenate([real[:, 0], real[:, 1] & vanishes[:, 1]])
    return pack(jnp.stack([jnp.concatenate([x[:, 0], x[:, 1]]) for x in (u, v)]), usable, 4)


def _depths(k: Components, a: Components) -> Components:
    """Eight candidate triples of depths `[8, *lanes]`, where the sum of a is 1: two for each real root of (4)."""
    k01, k02, k12 = k
    a01, a02, a12 = a
    b = [k02, k02, jnp.ones_like(k02)]
    n = [(a01 - a12) * b[i] + a02 * c for i, c in enumerate((k12 - k01, k12, jnp.ones_like(k12)))]
    d = [a02 * (k01 - k12), a02 * (2.0 - k12)]
    dd, nd, nn = _times(d, d), _times(n, d), _times(n, n)
    bdd = _times(b, dd)
    zero = jnp.zeros_like(k01)
    quartic = [
        a02 * (x + k01 * (y + z)) - a01 * w for x, y, z, w in zip(nn, [*dd, zero, zero], [*nd, zero], bdd, strict=True)
    ]
    (y, w), real = _real_roots(jnp.stack(quartic))  # the ratio is y / w
    # (2), homogeneous in (x, w): x^2 + k_01 w x + k_01 w^2 - (a_01 / a_02) (y^2 + k_02 (w^2 + w y)) = 0.
    half = 0.5 * k01[None] * w
    constant = k01[None] * w * w - (a01 / a02)[None] * (y * y + k02[None] * (w * w + w * y))
    # Rounding makes a double root complex; its real part is what is wanted then.
    q = half + sign(half) * jnp.sqrt(jnp.maximum(half * half - constant, 0.0))
    other = constant / jnp.where(q > 0, q, 1.0)
    x = jnp.concatenate([-q, -jnp.where(q > 0, other, 0.0)])
    y, w, real = jnp.concatenate([y, y]), jnp.concatenate([w, w]), jnp.concatenate([real, real])
    # Depths are proportional to (w, w + x, w + y); the sum of the equations (1) sets their scale.
    form = x * x + y * y + (x - y) * (x - y)
    form = form + k01[None] * w * (w + x) + k02[None] * w * (w + y) + k12[None] * (w + x) * (w + y)
    size = sign(3.0 * w + x + y) * jnp.sqrt(jnp.maximum(form, floor(form) ** 3))
    return tuple(jnp.where(real, c / size, 0.0) for c in (w, w + x, w + y))


def _kernel(points_world: Array, bearings: Array) -> tuple[Array, Array]:
    """Arrays `[3, 3, *lanes]` to poses `[4, 7, *lanes]` and their validity `[4, *lanes]`."""
    dtype = points_world.dtype
    double = dtype == jnp.float64
    eps = float(jnp.finfo(dtype).eps)
    proper = jnp.all(jnp.isfinite(points_world) & jnp.isfinite(bearings), axis=(0, 1))
    size = jnp.max(jnp.abs(bearings), axis=1)
    proper = proper & jnp.all(size > 0, axis=0)
    f = jnp.where(proper[None, None], bearings / jnp.where(size > 0, size, 1.0)[:, None], 1.0)
    f = f / jnp.sqrt(lane_sum(f * f, axis=1))[:, None]

    sides = jnp.stack([points_world[0] - points_world[1], points_world[0] - points_world[2]])
    unit = jnp.max(jnp.abs(sides), axis=(0, 1))
    proper = proper & (unit > floor(unit) ** 3) & (unit < 1.0 / floor(unit) ** 3)
    unit = jnp.where(proper, unit, 1.0)
    x = jnp.where(proper[None, None], points_world, 0.0)
    # Number the points such that side 02 is the longest.
    squares = [squared(vector3((x[i] - x[j]) / unit[None])) for i, j in ((0, 1), (0, 2), (1, 2))]
    is01 = (squares[0] > squares[1]) & (squares[0] > squares[2])
    is12 = ~is01 & (squares[2] > squares[1])
    x, f = (
        jnp.stack(
            [jnp.where(is01[None], r[(i + 1) % 3], jnp.where(is12[None], r[(i + 2) % 3], r[i])) for i in range(3)]
        )
        for r in (x, f)
    )

    rays = [vector3(f[i]) for i in range(3)]
    k = tuple(squared(difference(rays[i], rays[j])) for i, j in ((0, 1), (0, 2), (1, 2)))
    edge1, edge2 = vector3((x[1] - x[0]) / unit[None]), vector3((x[2] - x[0]) / unit[None])
    edge12 = difference(edge2, edge1)
    a = (squared(edge1), squared(edge2), squared(edge12))
    length = jnp.sqrt(a[0] + a[1] + a[2])
    normal = cross3(edge1, edge2)
    area = jnp.sqrt(squared(normal))
    # Collinear to rounding: of the products, or of the coordinates far from the origin.
    reach = length + lane_sum(jnp.abs(x[0]), axis=0) / unit
    proper = proper & (area > 10.0 * eps * length * reach)
    length = jnp.where(proper, length, 1.0)
    a = tuple(jnp.where(proper, c / (length * length), 1.0 / 3.0) for c in a)

    k_slots, a_slots = (tuple(c[None] for c in values) for values in (k, a))
    d = _depths(k, a)
    d = jax.lax.fori_loop(0, 5, lambda _, d: _newton_depths(d, k_slots, a_slots), d)
    ok = proper[None] & (jnp.minimum(jnp.minimum(d[0], d[1]), d[2]) > 0)
    farthest = jnp.maximum(jnp.maximum(d[0], d[1]), d[2])
    # Bearings that agree to rounding put the camera at infinity.
    ok = ok & (farthest < 1.0 / (16.0 * eps)) & (k[0] + k[1] + k[2] > (16.0 * eps) ** 2)[None]
    # Rounding of (1): of the distances, and of the difference of two large depths.
    tolerance = 4096.0 if double else 64.0
    for residual in _law_of_cosines(d, k_slots, a_slots):
        ok = ok & (jnp.abs(residual) <= tolerance * eps * (1.0 + farthest))
    # Two starts may end in one solution.
    gap = sum(jnp.abs(c[:, None] - c[None]) for c in d)
    earlier = (jnp.arange(8)[None] < jnp.arange(8)[:, None]).reshape((8, 8) + (1,) * (farthest.ndim - 1))
    twice = earlier & ok[None] & (gap < 0.5 * eps**0.5 * farthest[None])
    packed, ok = pack(jnp.stack(d), ok & ~jnp.any(twice, axis=1), 4)
    d = tuple(jnp.where(ok, c, 1.0) for c in packed)

    # The rotation takes the orthonormal frame of the triangle to that of its image.
    frame3 = tuple(c / jnp.where(proper, area, 1.0) for c in normal)
    edge = jnp.sqrt(squared(edge1))
    frame1 = tuple(c / jnp.where(proper, edge, 1.0) for c in edge1)
    frame2 = cross3(frame3, frame1)
    y = [tuple(d[i] * c[None] for c in rays[i]) for i in range(3)]
    image1, image2 = difference(y[1], y[0]), difference(y[2], y[0])
    image3 = cross3(image1, image2)
    norm1, norm3 = (jnp.sqrt(jnp.maximum(squared(c), floor(length) ** 3)) for c in (image1, image3))
    image1, image3 = tuple(c / norm1 for c in image1), tuple(c / norm3 for c in image3)
    image2 = cross3(image3, image1)
    rotation = tuple(
        tuple(image1[i] * frame1[j][None] + image2[i] * frame2[j][None] + image3[i] * frame3[j][None] for j in range(3))
        for i in range(3)
    )
    quaternion = quaternion_from_rotation(rotation)
    moved = rotate(quaternion, tuple(c[None] for c in vector3(x[0])))
    model = (*quaternion, *((length * unit)[None] * y[0][i] - moved[i] for i in range(3)))
    for c in model:
        ok = ok & jnp.isfinite(c)
    model = [jnp.where(ok, c, 1.0 if i == 0 else 0.0) for i, c in enumerate(model)]
    return jnp.stack(model, axis=1), ok


_solve = lanes_last(one_kernel(_kernel), chunk=128)


def _candidates(data: tuple[Array, Array]) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


_p3p_grunert = implicit(_candidates, _collinearity, perturb_camera, 6)


def p3p_grunert(points_world: Float[ArrayLike, "3 3"], bearings: Float[ArrayLike, "3 3"]) -> Candidates[SE3]:
    """Find the camera poses that see three points along three bearings, by Grunert's quartic.

    The same answers as `p3p` by the textbook's way, for comparison and for teaching; `p3p` is faster.

    Args:
        points_world: Points in world coordinates, one per row.
        bearings: Directions towards them in the camera's frame, one per row, of any positive length.

    Returns:
        Four slots of `cam_from_world` in the unit of the points, solutions first. Valid slots are distinct, have all
        points in front (positive distance along their bearing) and satisfy the law of cosines to rounding; the others
        hold the identity.

    Degenerate input: collinear or coincident points, zero bearings and anything not finite leave no slot valid. Near
        the danger cylinder two solutions merge: they are found to the square root of the precision, or as one.

    Differentiability: both modes, any order, by the implicit function theorem; zero for slots that are not valid and
        at double roots.

    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 4.0], [1.0, 0.0, 5.0], [0.0, 1.0, 6.0]])
        >>> candidates = p3p_grunert(points, points)
        >>> errors = jnp.abs(candidates.models.translation()).max(axis=-1)
        >>> bool(jnp.any(candidates.valid & (errors < 1e-3)))
        True
    """
    points_world, bearings = jnp.asarray(points_world), jnp.asarray(bearings)
    dtype = jnp.result_type(points_world, bearings)
    return _p3p_grunert((points_world.astype(dtype), bearings.astype(dtype)))
