"""Common points of three quadrics in projective three-space: an octic, in the lanes.

For unknowns (x, y, z, w) up to scale the three equations are solved for the monomials y², yz and z²,

    y² = A1 y + A2 z + A3,      yz = B1 y + B2 z + B3,      z² = C1 y + C2 z + C3,                                 (1)

with forms in (x, w) as coefficients, of degree 1, 1 and 2. The identities y² z = (yz) y, z² y = (yz) z and
y² z² = (yz)² then are three equations linear in (y, z, 1),

    M(x, w) (y, z, 1)ᵀ = 0,                                                                                        (2)

whose determinant is a form of degree eight in x : w. Its real roots give the points, which Newton's iteration on the
three quadrics themselves polishes. Which pair of unknowns is (y, z) is decided by the determinant of the system that
is solved for (1): it vanishes if a common point has x = w = 0.

References:
    Z. Kukelova, J. Heller, A. Fitzgibbon. Efficient intersection of three quadrics and applications in computer vision.
    CVPR 2016.
"""

import functools
import operator
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from vojax._numerics import Vector3, cross3, dot3, lane_sum
from vojax._types import Array, Bool, Float

from ._components import floor, squared
from ._roots import polynomial_roots

Polynomial = tuple[Array, ...]
Row = tuple[Polynomial, Polynomial, Polynomial]
SLOTS = 8
# Monomials of a quadric, as pairs of the unknowns.
PAIRS = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3))
_INDEX = {pair: k for k, pair in enumerate(PAIRS)}
# Which unknowns are x, w, y and z, by turns, and where the monomials then stand in PAIRS.
ORDERS = ((0, 3, 1, 2), (1, 2, 0, 3), (0, 1, 2, 3), (2, 3, 0, 1), (0, 2, 1, 3), (1, 3, 0, 2))
PLACES = tuple(tuple(_INDEX[min(o[i], o[j]), max(o[i], o[j])] for i, j in PAIRS) for o in ORDERS)


def _add(*polynomials: Polynomial) -> Polynomial:
    """Sum of polynomials of one degree."""
    return tuple(functools.reduce(operator.add, terms) for terms in zip(*polynomials, strict=True))


def _scale(factor: float, a: Polynomial) -> Polynomial:
    return tuple(factor * x for x in a)


def _multiply(a: Polynomial, b: Polynomial) -> Polynomial:
    """Product of polynomials, ascending coefficients."""
    total: list[Array | None] = [None] * (len(a) + len(b) - 1)
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            held = total[i + j]
            total[i + j] = x * y if held is None else held + x * y
    return tuple(x for x in total if x is not None)


def _over(a: Polynomial, size: Array) -> Polynomial:
    """Quotients, which XLA keeps: what is no quotient it computes again wherever it is used."""
    return tuple(x / size for x in a)


def _determinant3(a: Vector3, b: Vector3, c: Vector3) -> Array:
    return dot3(a, cross3(b, c))


def orthonormal_rows(rows: Float[Array, "3 n *lanes"]) -> tuple[Float[Array, "3 n *lanes"], Bool[Array, "*lanes"]]:
    """Orthonormal combinations of three rows, and whether these are independent in working precision."""
    eps = float(jnp.finfo(rows.dtype).eps)
    rounding = 512.0 * eps if eps > 1e-10 else 1e-10
    done: list[Array] = []
    size = jnp.max(jnp.abs(rows), axis=(0, 1))
    proper = jnp.isfinite(size) & (size > 0)
    rows = rows / jnp.where(proper, size, 1.0)[None, None]
    volume = jnp.ones_like(size)
    for k in range(3):
        row = rows[k]
        for _ in range(2 if done else 0):  # twice is enough
            for other in done:
                row = row - other * lane_sum(other * row, axis=0)[None]
        left = lane_sum(row * row, axis=0)
        # What is left of one row is uncertain by rounding over what was left of those before. Of equal points and the
        # like, the product is some 200 eps at most.
        volume = volume * left
        proper = proper & (volume > rounding * rounding)
        done.append(row / jnp.sqrt(jnp.where(proper, left, 1.0))[None])
    return jnp.where(proper[None, None], jnp.stack(done), 0.0), proper


def _permuted(quadrics: Array) -> tuple[Array, Array, Array]:
    """The quadrics with (y, z) chosen, the choice, and its determinant."""
    best, index = None, None
    for k, (_, _, y, z) in enumerate(ORDERS):
        columns = [quadrics[:, _INDEX[pair]] for pair in ((y, y), (min(y, z), max(y, z)), (z, z))]
        # The coefficient of yz stands for two entries of the symmetric matrix.
        size = jnp.abs(_determinant3(*((c[0], c[1], c[2]) for c in columns)))
        if best is None or index is None:
            best, index = size, jnp.zeros(size.shape, jnp.int32)
        else:
            index = jnp.where(size > best, k, index)
            best = jnp.maximum(size, best)
    assert best is not None
    assert index is not None
    return choose(quadrics, index, PLACES), index, best


def choose(x: Array, index: Array, tables: Sequence[Sequence[int]]) -> Array:
    """x[:, tables[index]] lane by lane, in a loop: its result is kept, that of selections is computed again."""
    places = jnp.asarray(tables)

    def step(k: Array, chosen: Array) -> Array:
        return jnp.where((index == k)[None, None], x[:, places[k]], chosen)

    return jax.lax.fori_loop(0, len(tables), step, x)


def in_first_order(solution: Array, index: Array) -> Array:
    """Unknowns (x, w, y, z) [4, slots, *lanes] back in their places."""
    tables = [[order.index(i) for i in range(4)] for order in ORDERS]
    return jnp.moveaxis(choose(jnp.moveaxis(solution, 1, 0), index, tables), 0, 1)


def _monic(q: Array) -> tuple[Row, Row, Row]:
    """The coefficients of (1): for y², yz and z² the polynomials of y, z and 1 in x, ascending, at w = 1."""
    # Pairs of (x, w, y, z): 0 xx, 1 xw, 2 xy, 3 xz, 4 ww, 5 wy, 6 wz, 7 yy, 8 yz, 9 zz.
    yy, yz, zz = ((q[0, k], q[1, k], q[2, k]) for k in (7, 8, 9))
    minors = (cross3(yz, zz), cross3(zz, yy), cross3(yy, yz))
    determinant = dot3(yy, minors[0])
    usable = jnp.abs(determinant) > floor(determinant) ** 2
    scale = jnp.where(usable, -determinant, jnp.inf)

    def solved(minor: Vector3, columns: tuple[int, ...]) -> Polynomial:
        return tuple(dot3(minor, (q[0, k], q[1, k], q[2, k])) / scale for k in columns)

    first, second, third = ((solved(m, (5, 2)), solved(m, (6, 3)), solved(m, (4, 1, 0))) for m in minors)
    return first, second, third


def _linear_equations(q: Array) -> tuple[Row, Row, Row]:
    """The three rows of M in (2), scaled."""
    (a1, a2, a3), (b1, b2, b3), (c1, c2, c3) = _monic(q)
    size = jnp.ones_like(a1[0])
    for x in (*a1, *a2, *a3, *b1, *b2, *b3, *c1, *c2, *c3):
        size = size + jnp.abs(x)

    def mul(a: Polynomial, b: Polynomial) -> Polynomial:
        return _multiply(a, b)

    def minus(a: Polynomial) -> Polynomial:
        return _scale(-1.0, a)

    left, right = _add(a1, minus(b2)), _add(c2, minus(b1))
    shared = _add(mul(a2, c1), minus(mul(b1, b2)), minus(b3))
    first = (
        shared,
        _add(mul(left, b2), mul(a2, right), a3),
        _add(mul(left, b3), mul(a2, c3), minus(mul(a3, b1))),
    )
    second = (
        _add(mul(c1, left), mul(right, b1), c3),
        shared,
        _add(mul(c1, a3), mul(right, b3), minus(mul(b2, c3))),
    )
    p = _add(mul(a1, c1), minus(mul(b1, b1)))
    r = _add(mul(a1, c2), mul(a2, c1), _scale(-2.0, mul(b1, b2)))
    s = _add(mul(a2, c2), minus(mul(b2, b2)))
    p, r, s = _over(p, size), _over(r, size), _over(s, size)
    a, b, c = (tuple(_over(x, size) for x in row) for row in ((a1, a2, a3), (b1, b2, b3), (c1, c2, c3)))
    third = tuple(
        _add(mul(p, a1i), mul(r, b1i), mul(s, c1i), *rest)
        for a1i, b1i, c1i, rest in (
            (a1, b1, c1, (mul(a[0], c3), mul(a3, c[0]), _scale(-2.0, mul(b[0], b3)))),
            (a2, b2, c2, (mul(a[1], c3), mul(a3, c[1]), _scale(-2.0, mul(b[1], b3)))),
            (a3, b3, c3, (mul(a[2], c3), minus(mul(b[2], b3)))),
        )
    )
    return tuple(tuple(_over(x, size) for x in row) for row in (first, second, third))  # type: ignore[return-value]


def _octic(rows: tuple[Row, Row, Row]) -> Array:
    first, second, third = rows
    size = functools.reduce(operator.add, (jnp.abs(x) for entry in (*first, *second) for x in entry))
    size = jnp.where(size > 0, size, 1.0)
    minors = []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        minor = _add(_multiply(first[j], second[k]), _scale(-1.0, _multiply(first[k], second[j])))
        minors.append(_over(minor, size))
    return jnp.stack(_add(*(_multiply(entry, minor) for entry, minor in zip(third, minors, strict=True))))


def _homogeneous(c: Polynomial, u: Array, v: Array) -> Array:
    """Σ c_i u^i v^(d-i) at [slots, *lanes]."""
    value, power = c[-1][None], jnp.ones_like(v)
    for k in range(len(c) - 2, -1, -1):
        power = power * v
        value = value * u + c[k][None] * power
    return value


def _null_vector(rows: tuple[Row, Row, Row], u: Array, v: Array) -> Vector3:
    """(y, z, 1) up to scale: the largest cross product of two rows of (2)."""
    unit = []
    for row in rows:
        entries = tuple(_homogeneous(c, u, v) for c in row)
        size = jnp.sqrt(squared(entries) + floor(u) ** 2)
        unit.append(tuple(c / size for c in entries))
    best: Vector3 = cross3(unit[0], unit[1])
    for i, j in ((0, 2), (1, 2)):
        other = cross3(unit[i], unit[j])
        larger = squared(other) > squared(best)
        best = tuple(jnp.where(larger, o, b) for o, b in zip(other, best, strict=True))
    return best


def _unit4(x: Array) -> Array:
    size = jnp.sqrt(lane_sum(x * x, axis=0))
    return x / jnp.where(size > floor(size), size, jnp.inf)[None]


def quadric_values(q: Array, x: Array) -> tuple[list[Array], list[list[Array]]]:
    """Quadrics [k, 10, *lanes] at points [4, slots, *lanes], and their gradients."""
    values, gradients = [], []
    for k in range(q.shape[0]):
        gradient = []
        for i in range(4):
            terms = [(2.0 if i == j else 1.0) * q[k, _INDEX[min(i, j), max(i, j)]][None] * x[j] for j in range(4)]
            gradient.append(terms[0] + terms[1] + terms[2] + terms[3])
        gradients.append(gradient)
        values.append(0.5 * (gradient[0] * x[0] + gradient[1] * x[1] + gradient[2] * x[2] + gradient[3] * x[3]))
    return values, gradients


def newton_on_sphere(x: Array, values: list[Array], gradients: list[list[Array]]) -> Array:
    """One step along the unit sphere of four unknowns, on three forms given by values and gradients."""
    eps = float(jnp.finfo(x.dtype).eps)
    a, b, c, d = x[0], x[1], x[2], x[3]
    # A basis of the tangent space of the sphere, as of the unit quaternions.
    tangents = ((-b, a, d, -c), (-c, -d, a, b), (-d, c, -b, a))
    columns = []
    for t in tangents:
        columns.append(tuple(g[0] * t[0] + g[1] * t[1] + g[2] * t[2] + g[3] * t[3] for g in gradients))
    minors = (cross3(columns[1], columns[2]), cross3(columns[2], columns[0]), cross3(columns[0], columns[1]))
    determinant = dot3(columns[0], minors[0])
    bound = jnp.sqrt(squared(columns[0]) * squared(minors[0]))
    # Within rounding of a double root the step is noise.
    usable = jnp.abs(determinant) > eps**0.75 * bound + floor(a) ** 2
    divisor = jnp.where(usable, determinant, jnp.inf)
    step = [-dot3(minor, values) / divisor for minor in minors]
    length = jnp.sqrt(squared(step))
    shrink = jnp.minimum(1.0, 0.5 / jnp.maximum(length, 0.5))
    moved = [
        x[i] + shrink * (step[0] * tangents[0][i] + step[1] * tangents[1][i] + step[2] * tangents[2][i])
        for i in range(4)
    ]
    return _unit4(jnp.stack(moved))


def three_quadrics(
    quadrics: Float[Array, "3 10 *lanes"], newton_steps: int
) -> tuple[Float[Array, "4 8 *lanes"], Bool[Array, "8 *lanes"], Float[Array, "8 *lanes"]]:
    """Real common points of three quadrics.

    Args:
        quadrics: Coefficients of the monomials `PAIRS` of four unknowns, a quadric per row; the rows orthonormal.
        newton_steps: On the quadrics, from the roots of the octic.

    Returns:
        Unit vectors, one per slot; where there is a distinct one; and the largest of the three values there. Some zeros
        of the octic are none of the quadrics to rounding: it is for the caller to draw the line.

    Degenerate input: common curves, and quadrics of which a combination vanishes, give no or meaningless points.
    """
    eps = float(jnp.finfo(quadrics.dtype).eps)
    chosen, index, size = _permuted(quadrics)
    rows = _linear_equations(chosen)
    (u, v), valid = polynomial_roots(_octic(rows), SLOTS)
    y, z, w = _null_vector(rows, u, v)
    solution = _unit4(jnp.stack((u * w, v * w, y, z)))  # x, w, y, z
    points = in_first_order(solution, index)
    points = jax.lax.fori_loop(0, newton_steps, lambda _, p: newton_on_sphere(p, *quadric_values(quadrics, p)), points)
    values, _ = quadric_values(quadrics, points)
    residual = jnp.maximum(jnp.maximum(jnp.abs(values[0]), jnp.abs(values[1])), jnp.abs(values[2]))
    valid = valid & (size > floor(size))[None] & (lane_sum(points * points, axis=0) > 0.5)
    # A point met twice counts once.
    inner = jnp.abs(lane_sum(points[:, :, None] * points[:, None], axis=0))
    near = 1.0 - inner < (0.5 if eps < 1e-10 else 2.0) * eps
    slots = jnp.arange(SLOTS)
    before = (slots[:, None] < slots[None]).reshape(SLOTS, SLOTS, *(1,) * size.ndim)
    return points, valid & ~jnp.any(near & before & valid[:, None], axis=0), residual
