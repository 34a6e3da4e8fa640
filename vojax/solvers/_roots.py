"""Real roots of polynomials in the lanes: no eigenvalue call, no branches, fixed slots.

Coefficients ascend, `c[0] + c[1] x + … + c[d] x^d`, on the first axis; lanes follow. Roots come as pairs (u, v) with
x = u / v and max(|u|, |v|) = 1, so that a root at infinity (a vanishing leading coefficient) is an ordinary one.

The polynomial is split at |x| = 1: with x = s on one half and x = 1/s on the other, both halves are sought in [-1, 1],
where a polynomial is evaluated to rounding. There the roots of a derivative separate those of its antiderivative
(Rolle), so the chain p^(d-1), …, p', p is climbed: every interval between neighbouring roots of one holds at most one
root of the next, found by Newton's iteration safeguarded by bisection. Isolation is exact up to rounding: unlike a
grid of samples it cannot step over a pair of close roots.

References: G. Collins, R. Loos. Polynomial real root isolation by differentiation. SYMSAC 1976.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from vojax._numerics import lane_max, lane_sum
from vojax._types import Array, Bool, Float

from ._components import floor, sign

_UNROLLED = 10  # degree up to which every polynomial of the chain is code of its own
# Iterations per interval up to degree 4 and beyond. Of random polynomials whose roots are all real, these find all
# roots up to degree 4 to rounding and 99.7 % at degree 10 (misses are roots that lie within 1e-3 of others).
_STEPS = {"float32": (6, 8), "float64": (8, 16)}


def quadratic_roots(c: Float[Array, "3 *lanes"]) -> tuple[Float[Array, "2 2 *lanes"], Bool[Array, "2 *lanes"]]:
    """Real roots of c0 + c1 x + c2 x², by the formula that does not cancel.

    Args:
        c: Coefficients, ascending.

    Returns:
        Pairs `[2, slots, *lanes]` (u above, v below; x = u / v) and their validity. A double root fills both slots; the
        zero polynomial has no valid slot. Invalid slots hold the pair (0, 1).
    """
    size = lane_max(jnp.abs(c), axis=0)
    proper = jnp.isfinite(size) & (size > 0)
    c = jnp.where(proper[None], c / jnp.where(proper, size, 1.0)[None], 0.0)
    half = -0.5 * c[1]
    discriminant = half * half - c[0] * c[2]
    # Rounding, of some eps in each coefficient, must not lose a double root.
    slack = 16.0 * float(jnp.finfo(c.dtype).eps) * (half * half + jnp.abs(c[0] * c[2]))
    valid = proper & (discriminant >= -slack)
    q = half + sign(half) * jnp.sqrt(jnp.maximum(discriminant, 0.0))
    # x = q / c2 and c0 / q; both factors of a pair vanish only where c1 = 0 and one of c0, c2 is.
    lost = q == 0
    first = jnp.stack([jnp.where(lost & (c[2] == 0), 1.0, q), c[2]])
    second = jnp.stack([jnp.where(lost, jnp.where(c[2] == 0, 1.0, 0.0), c[0]), jnp.where(lost, c[2], q)])
    return _normalise(jnp.stack([first, second], axis=1), jnp.stack([valid, valid]))


def cubic_roots(c: Float[Array, "4 *lanes"]) -> tuple[Float[Array, "2 3 *lanes"], Bool[Array, "3 *lanes"]]:
    """Real roots of a cubic; see `polynomial_roots`."""
    return polynomial_roots(c, 3)


def quartic_roots(c: Float[Array, "5 *lanes"]) -> tuple[Float[Array, "2 4 *lanes"], Bool[Array, "4 *lanes"]]:
    """Real roots of a quartic; see `polynomial_roots`."""
    return polynomial_roots(c, 4)


def polynomial_roots(
    c: Float[Array, "terms *lanes"], slots: int
) -> tuple[Float[Array, "2 slots *lanes"], Bool[Array, "slots *lanes"]]:
    """Real roots of polynomials of any degree, in ascending order within |x| <= 1 and then beyond.

    Args:
        c: Coefficients, ascending; their common scale does not matter.
        slots: Most roots returned, the degree or fewer.

    Returns:
        Pairs (u, v) `[2, slots, *lanes]` with x = u / v, and their validity; (0, 1) in slots without a root.

    Degenerate input: a double root counts once, twice or, within rounding of being complex, as the place where the
        polynomial comes nearest to zero. The zero polynomial and anything not finite have no root.
    """
    size = lane_max(jnp.abs(c), axis=0)
    proper = jnp.isfinite(size) & (size > 0)
    c = jnp.where(proper[None], c / jnp.where(proper, size, 1.0)[None], 0.0)
    c, unit = _balance(c)
    both = jnp.stack([c, c[::-1]], axis=1)  # [terms, 2, *lanes]: in x, and in 1/x
    x, valid = _roots_within_one(both)
    valid = valid & proper[None, None]
    # A root at |x| = 1 belongs to the first half.
    valid = valid.at[:, 1].set(valid[:, 1] & (jnp.abs(x[:, 1]) < 1.0))
    one = jnp.ones_like(x[:, 0])
    u = jnp.concatenate([x[:, 0] * unit[None], unit[None] * one])
    v = jnp.concatenate([one, x[:, 1]])
    packed = pack(jnp.stack([u, v]), jnp.concatenate([valid[:, 0], valid[:, 1]]), slots)
    return _normalise(*packed)


def evaluate(c: Float[Array, "terms *#lanes"], x: Float[Array, "*#lanes"]) -> Float[Array, "*lanes"]:
    """The polynomial at x, by Horner's rule."""
    value = c[-1]
    for k in range(c.shape[0] - 2, -1, -1):
        value = value * x + c[k]
    return value


def pack(
    values: Float[Array, "d many *lanes"], valid: Bool[Array, "many *lanes"], slots: int
) -> tuple[Float[Array, "d slots *lanes"], Bool[Array, "slots *lanes"]]:
    """Move the valid entries to the front, in order, and keep as many as there are slots; zero elsewhere."""
    place = jnp.cumsum(valid.astype(jnp.int32), axis=0) - 1
    slot = jnp.arange(slots).reshape(slots, *(1,) * valid.ndim)
    chosen = valid[None] & (place[None] == slot)  # [slots, many, *lanes]
    return lane_sum(jnp.where(chosen[None], values[:, None], 0.0), axis=2), jnp.any(chosen, axis=1)


def _balance(c: Array) -> tuple[Array, Array]:
    """Substitute x = σ y such that half of the roots are smaller than one and half are larger, in magnitude.

    Clusters of small or of large roots are then spread over [-1, 1], whatever a few far ones do. log σ is where the
    upper envelope of the lines log |c_k| + (k - d/2) log σ is lowest: at the highest crossing of a falling and a rising
    one. σ is a power of two.
    """
    degree = c.shape[0] - 1
    log = jnp.log2(jnp.maximum(jnp.abs(c), float(jnp.finfo(c.dtype).tiny)))
    lanes = (1,) * (c.ndim - 1)
    low, high = np.meshgrid(np.arange((degree + 1) // 2), np.arange(degree // 2 + 1, degree + 1), indexing="ij")
    low, high = low.ravel(), high.ravel()
    crossing = (log[low] - log[high]) / jnp.asarray(high - low, c.dtype).reshape(-1, *lanes)
    height = log[low] + jnp.asarray(low - 0.5 * degree, c.dtype).reshape(-1, *lanes) * crossing
    top = height >= lane_max(height, axis=0)[None]
    exponent = lane_max(jnp.where(top, crossing, -jnp.inf), axis=0)
    limit = 100 // degree  # coefficients change by 2^50 at most
    exponent = jnp.clip(jnp.round(exponent), -limit, limit)
    powers = jnp.asarray(np.arange(degree + 1) - degree // 2, c.dtype).reshape(-1, *lanes)
    return c * jnp.exp2(powers * exponent[None]), jnp.exp2(exponent)


def _normalise(pairs: Array, valid: Array) -> tuple[Array, Array]:
    size = jnp.maximum(jnp.abs(pairs[0]), jnp.abs(pairs[1]))
    valid = valid & (size > 0)
    pairs = jnp.where(valid[None], pairs / jnp.where(valid, size, 1.0)[None], 0.0)
    pairs = pairs * sign(pairs[1])[None]
    return pairs.at[1].set(jnp.where(valid, pairs[1], 1.0)), valid


def _roots_within_one(c: Array) -> tuple[Array, Array]:
    """Roots in [-1, 1], one for each interval between critical points: [degree, *lanes] and validity."""
    degree = c.shape[0] - 1
    if degree > _UNROLLED:
        return _climb_in_a_loop(c)
    one = jnp.ones_like(c[:1])
    edges = jnp.concatenate([-one, one])  # of the intervals on which the next polynomial is monotone
    valid = jnp.zeros_like(one, dtype=bool)
    derivatives = [c]
    for _ in range(degree - 1):
        powers = jnp.arange(1.0, derivatives[-1].shape[0], dtype=c.dtype).reshape((-1,) + (1,) * (c.ndim - 1))
        derivatives.append(derivatives[-1][1:] * powers)
    for polynomial in reversed(derivatives):
        roots, valid = _solve_intervals(polynomial, edges)
        edges = jnp.concatenate([-one, roots, one])
    return edges[1:-1], valid


def _climb_in_a_loop(c: Array) -> tuple[Array, Array]:
    """The chain as a loop over polynomials of one length, with zeros above: a fraction of the code to compile.

    The intervals that a short polynomial leaves over are empty, at 1.
    """
    degree = c.shape[0] - 1
    # Derivatives over the factorials of their orders.
    orders = range(degree - 1, -1, -1)
    factors = [[math.comb(k + order, order) * (k + order <= degree) for k in range(degree + 1)] for order in orders]
    table = jnp.asarray(np.reshape(factors, (degree, degree + 1, *(1,) * (c.ndim - 1))), c.dtype)
    padded = jnp.concatenate([c, jnp.zeros_like(c)])
    one = jnp.ones_like(c[:1])

    def climb(level: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        shifted = jax.lax.dynamic_slice_in_dim(padded, degree - 1 - level, degree + 1)
        polynomial = shifted * jax.lax.dynamic_index_in_dim(table, level, keepdims=False)
        return _solve_intervals(polynomial, jnp.concatenate([-one, state[0][:-1], one]))

    start = jnp.ones_like(c[1:])
    return jax.lax.fori_loop(0, degree, climb, (start, jnp.zeros(start.shape, bool)))


def _solve_intervals(c: Array, edges: Array) -> tuple[Array, Array]:
    """The root of a polynomial in each interval on which it is monotone; where there is none, the end nearer to one."""
    low, high = edges[:-1], edges[1:]
    at_low, at_high = evaluate(c[:, None], low), evaluate(c[:, None], high)
    rising = at_high > at_low
    # What rounding may have lifted off zero: the ends are critical points, where a double root touches.
    magnitude = lane_max(jnp.abs(c), axis=0)[None]
    noise = 2.0 * c.shape[0] * float(jnp.finfo(c.dtype).eps) * magnitude
    crosses = (jnp.minimum(at_low, at_high) <= 0) & (jnp.maximum(at_low, at_high) >= 0) & (at_low != at_high)
    nearest = jnp.where(jnp.abs(at_low) < jnp.abs(at_high), low, high)
    touches = jnp.minimum(jnp.abs(at_low), jnp.abs(at_high)) <= noise

    def step(_: object, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, high, x = state
        value, slope = c[-1][None], jnp.zeros_like(x)
        for k in range(c.shape[0] - 2, -1, -1):
            slope = slope * x + value
            value = value * x + c[k][None]
        above = (value > 0) == rising
        low, high = jnp.where(above, low, x), jnp.where(above, x, high)
        guarded = jnp.where(jnp.abs(slope) > floor(slope) ** 2, slope, 1.0)
        newton = x - value / guarded
        inside = (newton >= low) & (newton <= high)  # ends included: a converged step is zero
        return low, high, jnp.where(inside, newton, 0.5 * (low + high))

    # From the end nearer to zero, where the slope vanishes, the polynomial leaves as a parabola: a start from which
    # Newton's iteration finds roots that nearly coincide.
    small, large = jnp.minimum(jnp.abs(at_low), jnp.abs(at_high)), jnp.maximum(jnp.abs(at_low), jnp.abs(at_high))
    share = jnp.sqrt(small / jnp.where(large > 0, large + small, 1.0))
    farthest = low + high - nearest
    steps = _STEPS[c.dtype.name][c.shape[0] > 5]
    start = nearest + share * (farthest - nearest)
    _, _, x = jax.lax.fori_loop(0, steps, step, (low, high, start))
    return jnp.where(crosses, x, nearest), crosses | (touches & (edges[:-1] < edges[1:]))
