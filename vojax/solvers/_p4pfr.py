"""Pose, focal length and one coefficient of radial distortion from four points: the minimal problem.

Whatever the focal length and the distortion, a point lies in the half plane of its pixel (radial alignment). Four of
these equations leave the first two rows p1, p2 of s [R | t] a combination of four null vectors, with coordinates a, and

    p1 · p2 = 0,      |p1|² - |p2|² = 0                                                                            (1)

are two quadrics in a. The equations that are linear in f, f k and t3 (see `_radial_camera.py`) are four for three
unknowns; with μ = u x + v y, ρ = u² + v² and the third row p1 × p2 they have a solution if

    det [ μ, ρ μ, ρ, ρ (p1 × p2) · X ] = 0,                                                                        (2)

a row per point: a quartic form in a. Two quadrics and a quartic meet in sixteen points; at four of them, complex ones,
p1 and p2 are parallel: twelve solutions. In a plane x : w of the pencil a = (x, w, y, z), polynomials in y and z modulo
(1) are a space with the basis 1, y, z, yz, in which multiplication by (2) is a matrix G(x, w). It is singular where the
three have a common point, with the null vector (1, y, z, yz); det G is a form of degree sixteen in x : w, known from
seventeen values on a circle.

Precondition: pixels relative to the centre of distortion, which is the principal point, and square.

References:
    M. Bujnak, Z. Kukelova, T. Pajdla. New efficient solution to the absolute pose problem for camera with unknown focal
    length and radial distortion. ACCV 2010 (the problem). D. Cox, J. Little, D. O'Shea. Using algebraic geometry, ch. 2
    (multiplication matrices).
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from vojax._numerics import lane_max, lane_sum
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import floor
from ._implicit import implicit
from ._lanes import lanes_last, one_kernel
from ._null_space import null_space_and_rank
from ._radial_camera import (
    Data,
    Normalised,
    RadialCamera,
    cameras_from_rows,
    distinct,
    errors,
    normalised,
    perturb,
    points_and_pixels,
    rows_from,
    with_placeholders,
)
from ._roots import polynomial_roots
from ._three_quadrics import ORDERS, PAIRS, PLACES, choose, in_first_order, newton_on_sphere, quadric_values

SLOTS = 12
_DEGREE = 16
# A fixed rotation of the null vectors: for points on a plane, some planes of the pencil they come in hold pairs of
# solutions, double roots.
_TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(4, 4)))[0]
_ANGLES = np.pi * np.arange(_DEGREE + 1) / (_DEGREE + 1)
_FROM_VALUES = np.linalg.inv(
    np.cos(_ANGLES)[:, None] ** np.arange(_DEGREE + 1) * np.sin(_ANGLES)[:, None] ** np.arange(_DEGREE, -1, -1)
)
# Laplace expansion of (2) along its first two columns: rows i, j there, rows k, l in the others, sign.
_MINORS = tuple(
    (i, j, *(k for k in range(4) if k not in (i, j)), (-1) ** (i + j + 1))
    for i, j in itertools.combinations(range(4), 2)
)


def _forms(basis: Array, problem: Normalised) -> tuple[Array, Array, Array, Array]:
    """In coordinates a: the quadrics (1) [2, 10], (p1 × p2) · X [4, 10], μ [4, 4] and the factors of (2) [6]."""
    p, q = basis[:, 0, :3], basis[:, 1, :3]  # [4, 3, *lanes]
    x, u, h = problem.x, problem.u, problem.homogeneous

    def symmetric(entry: Array) -> list[Array]:
        return [entry[i, j] + entry[j, i] if i != j else entry[i, i] for i, j in PAIRS]

    pq = lane_sum(p[:, None] * q[None], axis=2)
    pp_qq = lane_sum(p[:, None] * p[None] - q[:, None] * q[None], axis=2)
    conics = jnp.stack([jnp.stack(symmetric(pq)), jnp.stack(symmetric(pp_qq))])
    size = jnp.sqrt(lane_sum(conics * conics, axis=1))
    conics = conics / jnp.where(size > floor(size), size, 1.0)[:, None]
    turned = jnp.stack([p[:, None, (c + 1) % 3] * q[None, :, (c + 2) % 3] for c in range(3)])
    turned = turned - jnp.stack([p[:, None, (c + 2) % 3] * q[None, :, (c + 1) % 3] for c in range(3)])
    heights = jnp.stack([jnp.stack(symmetric(lane_sum(x[n][:, None, None] * turned, axis=0))) for n in range(4)])
    # μ, the same multiple of (2) in all rows.
    linear = jnp.stack(
        [
            lane_sum(basis[:, 0] * (u[n, 0][None] * h[n])[None] + basis[:, 1] * (u[n, 1][None] * h[n])[None], axis=1)
            for n in range(4)
        ]
    )
    square = lane_sum(u * u, axis=1)
    factors = jnp.stack([s * (square[j] - square[i]) * square[k] * square[m] for i, j, k, m, s in _MINORS])
    return conics, heights, linear, factors


def _choice(conics: Array) -> Array:
    """Which unknowns should be x, w, y, z: (1) leaves no other monomials of y and z if it determines y² and z²."""
    best, index = None, None
    for k, place in enumerate(PLACES):
        (a, b, c), (d, e, f) = ((conics[n, place[7]], conics[n, place[8]], conics[n, place[9]]) for n in range(2))
        determinant = a * f - c * d
        # Their resultant vanishes if a common point of (1) has x = w = 0.
        resultant = determinant * determinant - (a * e - b * d) * (b * f - c * e)
        size = jnp.minimum(determinant * determinant, jnp.abs(resultant))
        if best is None or index is None:
            best, index = size, jnp.zeros(size.shape, jnp.int32)
        else:
            index = jnp.where(size > best, k, index)
            best = jnp.maximum(size, best)
    assert index is not None
    return index


def _matrix(x: Array, w: Array, conics: Array, heights: Array, linear: Array, factors: Array) -> Array:
    """G [4, 4, k, *lanes] at x : w, [k, *lanes]."""
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)

    def in_plane(q: Array) -> tuple[Array, ...]:
        """A quadric's coefficients of 1, y, z, yz, y² and z²."""
        c = q[:, None]  # of PAIRS: 0 xx, 1 xw, 2 xy, 3 xz, 4 ww, 5 wy, 6 wz, 7 yy, 8 yz, 9 zz
        constant = c[0] * x * x + c[1] * x * w + c[4] * w * w
        return constant, c[2] * x + c[5] * w, c[3] * x + c[6] * w, c[8] * one, c[7] * one, c[9] * one

    (*first, a, b), (*second, c, d) = in_plane(conics[0]), in_plane(conics[1])
    determinant = a * d - b * c
    usable = jnp.abs(determinant) > floor(determinant) ** 2
    scale = jnp.where(usable, -determinant, jnp.inf)
    # y² and z² in the basis 1, y, z, yz. Quotients, here and below, because XLA keeps them; what is no quotient it
    # computes again wherever it is used.
    yy = [(d * p - b * q) / scale for p, q in zip(first, second, strict=True)]
    zz = [(a * q - c * p) / scale for p, q in zip(first, second, strict=True)]
    # y² z = yy · z and y z² = zz · y, of which each needs the other.
    yyz = [p + yy[2] * q for p, q in zip((zero, zero, yy[0], yy[1]), zz, strict=True)]
    yzz = [p + zz[1] * q for p, q in zip((zero, zz[0], zero, zz[2]), yy, strict=True)]
    left = 1.0 - yy[3] * zz[3]
    left = jnp.where(jnp.abs(left) > floor(left) ** 2, left, jnp.inf)
    yyz, yzz = (
        [(p + yy[3] * q) / left for p, q in zip(yyz, yzz, strict=True)],
        [(q + zz[3] * p) / left for p, q in zip(yyz, yzz, strict=True)],
    )
    # One for the whole pencil: the values must stay those of a form.
    size = 1.0 + lane_max(sum(jnp.abs(p) for p in (*yy, *zz, *yyz, *yzz)), axis=0)[None]  # type: ignore[arg-type]
    yyzz = [p + yyz[2] * q + yyz[3] * r for p, q, r in zip((zero, zero, yyz[0], yyz[1]), zz, yzz, strict=True)]

    def reduced(q: tuple[Array, ...]) -> list[Array]:
        return [(p + q[4] * r + q[5] * t) / size for p, r, t in zip(q, yy, zz, strict=False)]

    heights_in = [reduced(in_plane(heights[n])) for n in range(4)]
    lines = [(m[0] * x + m[1] * w, m[2] * one, m[3] * one) for m in (linear[n, :, None] for n in range(4))]
    # (2) as a sum of products of two elements of the basis, the upper triangle.
    terms: dict[tuple[int, int], Array] = {}
    for factor, (i, j, k, m, _) in zip(factors, _MINORS, strict=True):
        p, q = lines[i], lines[j]
        pair = (p[0] * q[0], p[0] * q[1] + p[1] * q[0], p[0] * q[2] + p[2] * q[0], p[1] * q[2] + p[2] * q[1])
        pair = reduced((*pair, p[1] * q[1], p[2] * q[2]))
        difference = [factor[None] * (s - t) for s, t in zip(heights_in[m], heights_in[k], strict=True)]
        for s, t in itertools.product(range(4), repeat=2):
            place = (min(s, t), max(s, t))
            terms[place] = terms.get(place, zero) + pair[s] * difference[t]
    basis: tuple[list[Array], ...] = tuple([one if i == j else zero for j in range(4)] for i in range(4))
    products = {
        **{(0, k): basis[k] for k in range(4)},
        **{(1, 1): yy, (1, 2): basis[3], (1, 3): yyz, (2, 2): zz, (2, 3): yzz, (3, 3): yyzz},
    }
    element = [sum(terms[p] * products[p][c] for p in products) / size for c in range(4)]
    return jnp.stack(
        [
            jnp.stack([sum(element[k] * products[min(m, k), max(m, k)][c] for k in range(4)) / size for c in range(4)])
            for m in range(4)
        ]
    )


def _minors(rows: tuple[Array, Array]) -> dict[tuple[int, int], Array]:
    a, b = rows
    return {(i, j): a[i] * b[j] - a[j] * b[i] for i, j in itertools.combinations(range(4), 2)}


def _determinant(g: Array) -> Array:
    upper, lower = _minors((g[0], g[1])), _minors((g[2], g[3]))
    return sum(s * upper[i, j] * lower[k, m] for i, j, k, m, s in _MINORS)  # type: ignore[return-value]


def _null_vector(g: Array) -> Array:
    """The largest vector of cofactors of a row, [4, *lanes]."""
    size = lane_max(lane_max(jnp.abs(g), axis=1), axis=0)
    g = g / jnp.where(size > floor(size), size, 1.0)[None, None]
    best, length = jnp.zeros_like(g[0]), jnp.zeros_like(g[0, 0]) - 1.0
    for row in range(4):
        a, b, c = (g[r] for r in range(4) if r != row)
        minors = _minors((a, b))
        cofactors = []
        for k in range(4):
            i, j, m = (n for n in range(4) if n != k)
            cofactors.append((-1) ** k * (minors[i, j] * c[m] - minors[i, m] * c[j] + minors[j, m] * c[i]))
        vector = jnp.stack(cofactors)
        square = lane_sum(vector * vector, axis=0)
        best = jnp.where((square > length)[None], vector, best)
        length = jnp.maximum(length, square)
    return best


def _quartic(a: Array, heights: Array, linear: Array, factors: Array) -> tuple[Array, list[Array]]:
    """The form (2) at points [4, slots, *lanes], and its gradient."""
    q, q_gradient = quadric_values(heights, a)
    mu = [sum(linear[n, c][None] * a[c] for c in range(4)) for n in range(4)]
    value, gradient = jnp.zeros_like(a[0]), [jnp.zeros_like(a[0])] * 4
    for factor, (i, j, k, m, _) in zip(factors, _MINORS, strict=True):
        f, difference = factor[None], q[m] - q[k]
        value = value + f * mu[i] * mu[j] * difference
        for c in range(4):
            slope = (linear[i, c][None] * mu[j] + linear[j, c][None] * mu[i]) * difference
            slope = slope + mu[i] * mu[j] * (q_gradient[m][c] - q_gradient[k][c])
            gradient[c] = gradient[c] + f * slope
    return value, gradient


def _kernel(points: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Poses [12, 7, *lanes], focal lengths and distortions [2, 12, *lanes], and validity [12, *lanes]."""
    dtype = points.dtype
    double = dtype == jnp.float64
    eps = float(jnp.finfo(dtype).eps)
    problem = normalised(points, pixels)
    null, independent = null_space_and_rank(problem.alignment)
    turn = jnp.asarray(_TURN, dtype)
    lanes = (1,) * problem.usable.ndim
    null = lane_sum(turn.reshape(4, 4, 1, *lanes) * null[None], axis=1)
    basis = null.reshape(4, 2, 4, *problem.usable.shape)
    conics, heights, linear, factors = _forms(basis, problem)
    largest = lane_max(jnp.abs(factors), axis=0)
    independent = independent & (largest > 256.0 * eps)
    factors = factors / jnp.where(independent, largest, 1.0)[None]
    index = _choice(conics)
    turned = (choose(conics, index, PLACES), choose(heights, index, PLACES), choose(linear, index, ORDERS), factors)

    circle = [
        jnp.asarray(c, dtype).reshape(-1, *lanes) * jnp.ones_like(problem.unit)[None]
        for c in (np.cos(_ANGLES), np.sin(_ANGLES))
    ]
    values = _determinant(_matrix(circle[0], circle[1], *turned))
    matrix = jnp.asarray(_FROM_VALUES, dtype).reshape(_DEGREE + 1, _DEGREE + 1, *lanes)
    (x, w), valid = polynomial_roots(lane_sum(matrix * values[None], axis=1), SLOTS)
    m = _null_vector(_matrix(x, w, *turned))
    point = in_first_order(jnp.stack([x * m[0], w * m[0], m[1], m[2]]), index)
    size = jnp.sqrt(lane_sum(point * point, axis=0))
    valid = valid & (size > floor(size))
    point = point / jnp.where(valid, size, 1.0)[None]

    def polished(_: object, a: Array) -> Array:
        (first, second), gradients = quadric_values(conics, a)
        third, gradient = _quartic(a, heights, linear, factors)
        return newton_on_sphere(a, [first, second, third], [*gradients, gradient])

    point = jax.lax.fori_loop(0, 6, polished, point)
    rows, length, gap = rows_from(basis, point)
    valid = valid & (problem.usable & independent)[None] & (length > 64.0 * eps)
    valid = valid & (gap <= (4096.0 if double else 64.0) * eps)
    model, intrinsics, valid, error = cameras_from_rows(rows, length, valid, problem)
    # The four linear equations agree.
    valid = valid & (error <= (2.0**20 if double else 4096.0) * eps)
    return with_placeholders(model, intrinsics, distinct(point, valid))


_solve = lanes_last(one_kernel(_kernel), chunk=128)


def _candidates(data: Data) -> Candidates[RadialCamera]:
    poses, intrinsics, valid = _solve(*data)
    return Candidates(models=RadialCamera(SE3(poses), intrinsics[0], intrinsics[1]), valid=valid)


def _equations(model: RadialCamera, data: Data) -> Array:
    radial, error, _, _ = errors(model, data)
    return jnp.concatenate([radial, error])


_p4pfr = implicit(_candidates, _equations, perturb, 8)


def p4pfr(points_world: Float[ArrayLike, "4 3"], pixels: Float[ArrayLike, "4 2"]) -> Candidates[RadialCamera]:
    """Find pose, focal length and radial distortion of a camera from four points.

    For a batch, `jax.vmap(p4pfr, in_axes=-1, out_axes=-1)` on arrays [4, 3, batch] is the fast layout on a CPU.

    Args:
        points_world: Points in world coordinates, one per row; points on a plane too.
        pixels: Where they are seen, distorted, relative to the principal point.

    Returns:
        Twelve slots of `cam_from_world`, `focal` and `distortion`. Valid slots are distinct, reproduce the pixels, have
        positive focal length and all points in front. The others hold the identity, a focal length of one and no
        distortion.

    Degenerate input: pixels at equal distances from the principal point (which say nothing about the distortion),
        points on a line, coincident points and anything not finite leave no slot valid, or with rounding mean nothing.
    Differentiability: both modes, any order, in points and pixels, by the implicit function theorem; zero for slots
        that are not valid.

    Raises:
        ValueError: If there are not four points and four pixels.
    References: see the module.
    """
    return _p4pfr(points_and_pixels(points_world, pixels, 4, "four"))
