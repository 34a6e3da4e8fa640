"""Relative pose from five rays: the essential matrices through five correspondences, up to ten.

    ray1ᵀ E ray0 = 0 (five times),      det E = 0,      2 E Eᵀ E - tr(E Eᵀ) E = 0.                             (1)

The five linear equations leave E = x E0 + y E1 + z E2 + E3. Put into the other ten they are ten cubics in x, y, z;
eliminating the ten monomials of highest degree in (x, y) gives six rows that combine to three equations which are
linear in (x, y, 1) with coefficients of degrees 3, 3 and 4 in z. Their determinant is a polynomial of degree ten in
z, whose real roots give z, and the null vector of the 3×3 system x and y (Nistér). Here z is a
pair, so that no coordinate need be finite.

What rounding left in E is then removed by Newton's iteration on the five epipolar equations over SO3 × S², which
decides also which candidates are solutions. In float32 that iteration is what makes the answer accurate.

Precondition: five different correspondences from a moving camera. Points on a plane are fine (then two of the
solutions are the two motions of the homography).

References:
    D. Nistér. An efficient solution to the five-point relative pose problem. PAMI 2004.
    H. Stewénius, C. Engels, D. Nistér. Recent developments on direct relative orientation. ISPRS 2006.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from vojax._numerics import Vector3, cross3, lane_sum, normalize
from vojax._types import Array, ArrayLike, Bool, Float

from ._candidates import Candidates
from ._components import floor, squared
from ._essential_newton import polish_essential
from ._implicit import implicit
from ._lanes import lanes_last, one_kernel
from ._matrix_models import perturb_essential
from ._null_space import eliminate, null_space_and_rank
from ._roots import polynomial_roots

SLOTS = 10
# Monomials as sorted indices of (x, y, z, 1): those eliminated first, then those of the three equations.
_ELIMINATED = ("000", "111", "001", "011", "002", "003", "112", "113", "012", "013")
_REMAINING = ("022", "023", "033", "122", "123", "133", "222", "223", "233", "333")


def unit_rays(
    rays0: Float[Array, "5 3 *lanes"], rays1: Float[Array, "5 3 *lanes"]
) -> tuple[Float[Array, "5 3 *lanes"], Float[Array, "5 3 *lanes"], Bool[Array, "*lanes"]]:
    """Rays of length one, and which problems have only proper ones; the others get some ray instead."""
    proper = jnp.ones(rays0.shape[2:], bool)
    unit = []
    for rays in (rays0, rays1):
        size = jnp.max(jnp.abs(rays), axis=1)
        usable = jnp.isfinite(size) & (size > 0)
        scaled = jnp.where(usable[:, None], rays / jnp.where(usable, size, 1.0)[:, None], 1.0)
        unit.append(scaled / jnp.sqrt(lane_sum(scaled * scaled, axis=1))[:, None])
        proper = proper & jnp.all(usable, axis=0)
    return unit[0], unit[1], proper


def epipolar_basis(
    rays0: Float[Array, "5 3 *lanes"], rays1: Float[Array, "5 3 *lanes"]
) -> tuple[Float[Array, "4 3 3 *lanes"], Bool[Array, "*lanes"]]:
    """Orthonormal basis of the matrices that satisfy the five epipolar equations, and whether these are independent."""
    rows = rays1[:, :, None] * rays0[:, None, :]
    basis, independent = null_space_and_rank(rows.reshape(5, 9, *rows.shape[3:]))
    return basis.reshape(4, 3, 3, *rows.shape[3:]), independent


def cubic_constraints(basis: Float[Array, "4 3 3 *lanes"], monomials: tuple[str, ...]) -> Float[Array, "10 20 *lanes"]:
    """Coefficients of (1) for E = x E0 + y E1 + z E2 + w E3: nine trace constraints and the determinant.

    Args:
        basis: E0 to E3.
        monomials: The order of the columns; each is three sorted indices of (x, y, z, w).
    """
    lanes = (1,) * (basis.ndim - 3)
    first, second = (np.array([int(pair[i]) for pair in _PAIRS]) for i in range(2))
    half = jnp.asarray([0.5 if pair[0] == pair[1] else 1.0 for pair in _PAIRS], basis.dtype).reshape(10, 1, 1, *lanes)
    a, b = basis[first], basis[second]
    # E Eᵀ - ½ tr(E Eᵀ) I, and the cross product of the last two rows of E, by pairs of unknowns.
    product = sum(a[:, :, None, k] * b[:, None, :, k] for k in range(3))
    product = half * (product + jnp.swapaxes(product, 1, 2))
    trace = product[:, 0, 0] + product[:, 1, 1] + product[:, 2, 2]
    identity = jnp.eye(3, dtype=basis.dtype).reshape(1, 3, 3, *lanes)
    quadratic = product - 0.5 * identity * trace[:, None, None]
    minors = half[:, 0] * (_cross(a[:, 1], b[:, 2]) + _cross(b[:, 1], a[:, 2]))
    # Each monomial is a pair times a single unknown in up to three ways.
    trace_rows, determinant = 0.0, 0.0
    for pair, single, used in zip(*_ways(monomials), strict=True):
        weight = jnp.asarray(used, basis.dtype).reshape(20, 1, 1, *lanes)
        q, e, m = quadratic[pair], basis[single] * weight, minors[pair]
        trace_rows = trace_rows + sum(q[:, :, k, None] * e[:, None, k] for k in range(3))
        determinant = determinant + sum(m[:, k] * e[:, 0, k] for k in range(3))
    rows = jnp.concatenate(
        [jnp.reshape(trace_rows, (20, 9, *basis.shape[3:])), jnp.asarray(determinant)[:, None]], axis=1
    )
    return jnp.swapaxes(rows, 0, 1)


_PAIRS = tuple(f"{i}{j}" for i in range(4) for j in range(i, 4))


def _ways(monomials: tuple[str, ...]) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """For each of three ways and each monomial: the pair, the single unknown, and whether there is such a way."""
    ways = [[(_PAIRS.index(m.replace(c, "", 1)), int(c), 1.0) for c in sorted(set(m))] for m in monomials]
    padded = [(way + [(0, 0, 0.0)] * 3)[:3] for way in ways]
    pair, single, used = ([np.array([way[n][i] for way in padded]) for n in range(3)] for i in range(3))
    return pair, single, used


def _cross(a: Array, b: Array) -> Array:
    """Cross product over the second axis."""
    return jnp.stack(cross3((a[:, 0], a[:, 1], a[:, 2]), (b[:, 0], b[:, 1], b[:, 2])), axis=1)


def _equations(reduced: Array) -> tuple[tuple[Array, Array, Array], ...]:
    """Three equations a(z) x + b(z) y + c(z) = 0, polynomials with ascending coefficients."""
    equations = []
    for i in range(0, 6, 2):
        first, second = reduced[i], reduced[i + 1]  # of … z and … 1
        zero = jnp.zeros_like(first[:1])

        def difference(low: int, high: int, first: Array = first, second: Array = second, zero: Array = zero) -> Array:
            # first - z second, where the table lists descending powers of z.
            return jnp.concatenate([first[low:high][::-1], zero]) - jnp.concatenate([zero, second[low:high][::-1]])

        equations.append((difference(0, 3), difference(3, 6), difference(6, 10)))
    return tuple(equations)


def _determinant(equations: tuple[tuple[Array, Array, Array], ...]) -> Array:
    """Determinant of the three equations, a polynomial of degree ten.

    Its coefficients cancel by four digits and more, so in float32 they are summed with twice the precision: without
    that the true solution is lost in 3 % of problems instead of 1 %.
    """
    zero = jnp.zeros_like(equations[0][0][:1])
    columns = [
        jnp.stack([equation[i] if i == 2 else jnp.concatenate([equation[i], zero]) for equation in equations], axis=1)
        for i in range(3)
    ]  # x, y, 1: [5 coefficients, 3 equations, *lanes]
    (x, y, one) = columns
    # Minors of (x, y) for pairs of equations; both orders in one product.
    following, last = jnp.asarray([1, 2, 0]), jnp.asarray([2, 0, 1])
    first = _multiply(_exact(x[:, following]), _exact(y[:, last]))
    second = _multiply(_exact(x[:, last]), _exact(y[:, following]))
    minors = _add(first, (-second[0], -second[1]))
    terms = _multiply(minors, _exact(one))
    total = _add(
        (terms[0][:, 0], terms[1][:, 0]), _add((terms[0][:, 1], terms[1][:, 1]), (terms[0][:, 2], terms[1][:, 2]))
    )
    return (total[0] + total[1])[:11]


# Numbers as unevaluated sums of two: Dekker, "A floating-point technique for extending the available precision", 1971.
_Double = tuple[Array, Array]


def _exact(x: Array) -> _Double:
    return x, jnp.zeros_like(x)


def _add(a: _Double, b: _Double) -> _Double:
    total = a[0] + b[0]
    shifted = total - a[0]
    error = (a[0] - (total - shifted)) + (b[0] - shifted)
    return total, error + a[1] + b[1]


def _product(a: _Double, b: _Double) -> _Double:
    product = a[0] * b[0]
    if product.dtype == jnp.float64:
        return product, jnp.zeros_like(product)
    # Halves of twelve bits, whose products are exact whatever is fused.
    high_a, high_b = _upper_half(a[0]), _upper_half(b[0])
    low_a, low_b = a[0] - high_a, b[0] - high_b
    error = ((high_a * high_b - product) + high_a * low_b + low_a * high_b) + low_a * low_b
    return product, error + a[0] * b[1] + a[1] * b[0]


def _upper_half(x: Array) -> Array:
    bits = jax.lax.bitcast_convert_type(x, jnp.int32)
    return jax.lax.bitcast_convert_type(bits & jnp.int32(-4096), jnp.float32)


def _multiply(a: _Double, b: _Double) -> _Double:
    """Product of polynomials, ascending coefficients on the first axis."""
    m = b[0].shape[0]
    table = _product((a[0][:, None], a[1][:, None]), (b[0][None], b[1][None]))

    def shifted(part: Array, i: int) -> Array:
        return jnp.pad(part[:, i], ((i, m - 1 - i), *((0, 0),) * (part.ndim - 2)))

    total = (shifted(table[0], 0), shifted(table[1], 0))
    for i in range(1, m):
        total = _add(total, (shifted(table[0], i), shifted(table[1], i)))
    return total


def _homogeneous(c: Array, u: Array, v: Array) -> Array:
    """Σ c_i u^i v^(d-i)."""
    value, power = c[-1], jnp.ones_like(v)
    for k in range(c.shape[0] - 2, -1, -1):
        power = power * v
        value = value * u + c[k] * power
    return value


def _coordinates(equations: tuple[tuple[Array, Array, Array], ...], u: Array, v: Array) -> tuple[Array, Array, Array]:
    """(x, y, 1) up to scale at z = u / v: the null vector of the three equations."""
    rows = []
    for a, b, c in equations:
        row = (
            _homogeneous(a[:, None], u, v),
            _homogeneous(b[:, None], u, v),
            _homogeneous(c[:, None], u, v),
        )
        size = jnp.sqrt(squared(row)) + floor(u)
        rows.append(tuple(entry / size for entry in row))
    best: Vector3 = cross3(rows[0], rows[1])
    for i, j in ((0, 2), (1, 2)):
        other = cross3(rows[i], rows[j])
        larger = squared(other) > squared(best)
        best = tuple(jnp.where(larger, o, b) for o, b in zip(other, best, strict=True))
    return best[0], best[1], best[2]


_roots = one_kernel(functools.partial(polynomial_roots, slots=SLOTS))
_polish = one_kernel(functools.partial(polish_essential, steps=4))


def _candidate_matrices(basis: Array, degree_ten: Array, equations: tuple) -> tuple[Array, Array]:
    """E for the real roots: [9, slots, *lanes] and whether there was a root."""
    (u, v), valid = _roots(degree_ten)
    x, y, w = _coordinates(equations, u, v)
    # The null vector is that of v³ (a, b, v c), so (x, y, z, 1) ~ (X, Y, u W, v W).
    weights = (x, y, u * w, v * w)
    flat = basis.reshape(4, 9, 1, *basis.shape[3:])
    return sum(weights[a][None] * flat[a] for a in range(4)), valid  # type: ignore[return-value]


def _solve_lanes(rays0: Array, rays1: Array) -> tuple[Array, Array]:
    """E [10, 3, 3, *lanes] and validity [10, *lanes] from rays [5, 3, *lanes]."""
    rays0, rays1, proper = unit_rays(rays0, rays1)
    basis, independent = epipolar_basis(rays0, rays1)
    equations = _equations(eliminate(cubic_constraints(basis, (*_ELIMINATED, *_REMAINING)))[4:])
    entries, valid = _candidate_matrices(basis, _determinant(equations), equations)
    return _polish(entries, valid & (proper & independent)[None], rays0, rays1)


# A problem takes some thousand numbers: 128 lanes of them fit into the cache, and halve the time (jax 0.10.1).
_solve = lanes_last(_solve_lanes, chunk=128)


def _candidates(data: tuple[Array, Array]) -> Candidates[Array]:
    return Candidates(*_solve(*data))


def epipolar_equations(essential: Array, data: tuple[Array, Array]) -> Array:
    """The five equations of one problem, with unit rays."""
    rays0, rays1 = normalize(data[0]), normalize(data[1])
    return jnp.sum(rays1 * (rays0 @ essential.T), axis=-1)


_five_point = implicit(_candidates, epipolar_equations, perturb_essential, 5)


def five_point(rays0: Float[ArrayLike, "5 3"], rays1: Float[ArrayLike, "5 3"]) -> Candidates[Float[Array, "10 3 3"]]:
    """Find the essential matrices of two views that see five points along given rays.

    For a batch, `jax.vmap(five_point, in_axes=-1, out_axes=-1)` on arrays [5, 3, batch] is the fast layout on a CPU.

    Args:
        rays0: Directions in camera 0, one per row, of any positive length; bearings beyond 180° too.
        rays1: The matching directions in camera 1.

    Returns:
        Ten slots of E with `ray1ᵀ E ray0 = 0`, E = [t]× R of `cam1_from_cam0`, norm 1, largest entry positive. Valid
        slots are distinct and satisfy the equations to rounding; the others hold zeros.

    Degenerate input: equal correspondences, zero rays and anything not finite leave no slot valid. Points on a plane
        are no special case. After a pure rotation every translation satisfies the equations: slots may be valid, and
        mean nothing.

    Differentiability: both modes, any order, by the implicit function theorem; zero for slots that are not valid.

    References: see the module.
    """
    return _five_point(correspondences(rays0, rays1))


def correspondences(rays0: ArrayLike, rays1: ArrayLike) -> tuple[Array, Array]:
    """Rays of one dtype; refuses any number but five."""
    rays0, rays1 = jnp.asarray(rays0), jnp.asarray(rays1)
    if rays0.shape != (5, 3) or rays1.shape != (5, 3):
        raise ValueError(f"found rays of shapes {rays0.shape} and {rays1.shape}; expected five correspondences, (5, 3)")
    dtype = jnp.result_type(rays0, rays1)
    return rays0.astype(dtype), rays1.astype(dtype)
