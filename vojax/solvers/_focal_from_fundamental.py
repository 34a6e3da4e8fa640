"""Focal lengths from a fundamental matrix and the principal points.

With pixels relative to the principal points, E = diag(f1, f1, 1) F diag(f0, f0, 1) is an essential matrix. Two focal
lengths follow in closed form (Bougnoux): with e the epipole of image 1, Fᵀe = 0, and r = (-e_y, e_x, 0),

    f0² = -(r · F_2) F_22 / (r · F_0 F_20 + r · F_1 F_21),      F_j the columns of F,                              (1)

and f1² likewise from Fᵀ. One focal length for both, f0 = f1 = f, is a root of Kruppa's equations: with the singular
values and vectors of F, ω = diag(g, g, 1) and g = f²,

    s1² (v1 · ω v1) (u1 · ω u1) = s2² (v2 · ω v2) (u2 · ω u2),                                                     (2)
    s2 (u1 · ω u2) (v2 · ω v2) = -s1 (v1 · ω v2) (u1 · ω u1),
    s1 (u1 · ω u2) (v1 · ω v1) = -s2 (v1 · ω v2) (u2 · ω u2),

a quadratic equation and, after division by 1 - g, two linear ones. The quadratic one is solved; the linear ones choose.

References:
    S. Bougnoux. From projective to Euclidean space under any practical situation, a criticism of self-calibration. ICCV
    1998. P. Sturm, On focal length calibration from two views. CVPR 2001. K. Kanatani, C. Matsunaga. Closed-form
    expression for focal lengths from the fundamental matrix. ACCV 2000.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from vojax._numerics import cross3, safe_divide
from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._components import Rows3, floor, squared
from ._implicit import implicit
from ._lanes import lanes_last
from ._roots import quadratic_roots
from ._svd3 import svd3

Data = tuple[Array, Array, Array]
# Cancellation beyond this many units of rounding leaves nothing of a numerator or denominator.
_LOST = 64.0


def _relative(fundamental: Array, point0: Array, point1: Array) -> tuple[list[list[Array]], Array, Array]:
    """Entries of F for pixels relative to the principal points, in a unit that balances them; the unit; usable or not.

    The unit is a power of two, so that it costs no rounding and has no derivative.
    """
    finite = jnp.all(jnp.isfinite(fundamental), axis=(0, 1))
    for point in (point0, point1):
        finite = finite & jnp.all(jnp.isfinite(point), axis=0)
    largest = jnp.max(jnp.abs(fundamental), axis=(0, 1))
    # Beyond these the derivative is no number of the dtype.
    usable = finite & (largest > floor(largest) ** 2) & (largest < 1.0 / floor(largest) ** 2)
    scale = jax.lax.stop_gradient(jnp.where(usable, largest, 1.0))
    f = [[jnp.where(usable, fundamental[i, j], 0.0) / scale for j in range(3)] for i in range(3)]
    p, q = ([jnp.where(usable, point[a], 0.0) for a in range(2)] for point in (point0, point1))
    for i in range(3):
        f[i][2] = f[i][0] * p[0] + f[i][1] * p[1] + f[i][2]
    for j in range(3):
        f[2][j] = f[0][j] * q[0] + f[1][j] * q[1] + f[2][j]
    inner = f[0][0] ** 2 + f[0][1] ** 2 + f[1][0] ** 2 + f[1][1] ** 2
    edge = f[0][2] ** 2 + f[1][2] ** 2 + f[2][0] ** 2 + f[2][1] ** 2
    inner, edge = jax.lax.stop_gradient((inner, edge))
    usable = usable & (inner > floor(inner) ** 2) & (edge > floor(edge) ** 2)
    exponent = 0.5 * (jnp.log2(jnp.where(usable, edge, 1.0)) - jnp.log2(jnp.where(usable, inner, 1.0)))
    unit = jnp.exp2(jnp.round(jnp.clip(exponent, -60.0, 60.0)))
    weights = (unit, unit, jnp.ones_like(unit))
    f = [[f[i][j] * weights[i] * weights[j] for j in range(3)] for i in range(3)]
    size = jax.lax.stop_gradient(
        jnp.sqrt(sum(x * x for row in f for x in row))  # type: ignore[arg-type]
    )
    size = jnp.where(usable, size, 1.0)
    return [[x / size for x in row] for row in f], unit, usable


def _bougnoux(f: list[list[Array]]) -> tuple[Array, Array]:
    """The square (1), and whether rounding leaves something of it."""
    eps = float(jnp.finfo(f[0][0].dtype).eps)
    columns = [tuple(f[i][j] for i in range(3)) for j in range(3)]
    e = cross3(columns[0], columns[1])
    for i, j in ((1, 2), (2, 0)):
        other = cross3(columns[i], columns[j])
        longer = squared(other) > squared(e)
        e = tuple(jnp.where(longer, x, y) for x, y in zip(other, e, strict=True))
    length = jnp.sqrt(squared(e))
    across = [e[0] * f[1][j] - e[1] * f[0][j] for j in range(3)]
    numerator = -across[2] * f[2][2]
    terms = (across[0] * f[2][0], across[1] * f[2][1])
    denominator = terms[0] + terms[1]
    magnitude = [jnp.abs(e[0] * f[1][j]) + jnp.abs(e[1] * f[0][j]) for j in range(3)]
    bound = magnitude[0] * jnp.abs(f[2][0]) + magnitude[1] * jnp.abs(f[2][1])
    lost = _LOST * eps
    sound = (jnp.abs(denominator) > lost * bound) & (jnp.abs(denominator) > lost * length)
    # F was sized to one: entries below rounding are zero.
    sound = sound & (jnp.abs(across[2]) > lost * magnitude[2]) & (jnp.abs(f[2][2]) > lost) & (length > lost)
    square = safe_divide(numerator, denominator)
    return square, sound & (square > 0)


def _both_kernel(fundamental: Array, point0: Array, point1: Array) -> tuple[Array, Array]:
    """Focal lengths [1, 2, *lanes] and validity [1, *lanes]."""
    f, unit, usable = _relative(fundamental, point0, point1)
    square0, sound0 = _bougnoux(f)
    square1, sound1 = _bougnoux([[f[j][i] for j in range(3)] for i in range(3)])
    valid = usable & sound0 & sound1
    focals = [unit * jnp.sqrt(jnp.where(valid, square, 1.0)) for square in (square0, square1)]
    valid = valid & jnp.isfinite(focals[0]) & jnp.isfinite(focals[1])
    return jnp.stack([jnp.where(valid, focal, 1.0) for focal in focals])[None], valid[None]


def _both_equations(focals: Array, data: Data) -> Array:
    """Two equations: the products of (1)."""
    f, unit, _ = _relative(*data)
    residuals = []
    for focal, m in zip(focals, (f, [[f[j][i] for j in range(3)] for i in range(3)]), strict=True):
        square, _ = _bougnoux(m)
        residuals.append(2.0 * jnp.log(focal / unit) - jnp.log(jnp.where(square > 0, square, 1.0)))
    return jnp.stack(residuals)


def _kruppa(u: Rows3, s: Sequence[Array], v: Rows3) -> tuple[Array, tuple[Array, Array], tuple[Array, Array]]:
    """Coefficients of the quadratic and of the two linear equations of (2) in g, ascending; u and v by columns."""
    p1, p2, q1, q2 = u[0][2], u[1][2], v[0][2], v[1][2]  # what is along the optical axes

    def form(x: Array) -> tuple[Array, Array]:
        return x * x, 1.0 - x * x

    def product(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        return a[0] * b[0], a[0] * b[1] + a[1] * b[0], a[1] * b[1]

    first, second = product(form(q1), form(p1)), product(form(q2), form(p2))
    s11, s22 = s[0] * s[0], s[1] * s[1]
    quadratic = jnp.stack([s11 * a - s22 * b for a, b in zip(first, second, strict=True)])
    pp, qq = p1 * p2, q1 * q2
    linear1 = tuple(s[1] * pp * a + s[0] * qq * b for a, b in zip(form(q2), form(p1), strict=True))
    linear2 = tuple(s[0] * pp * a + s[1] * qq * b for a, b in zip(form(q1), form(p2), strict=True))
    return quadratic, (linear1[0], linear1[1]), (linear2[0], linear2[1])


def _shared_kernel(fundamental: Array, point0: Array, point1: Array) -> tuple[Array, Array]:
    """Focal lengths [2, *lanes], the one that fits the linear equations first, and validity."""
    eps = float(jnp.finfo(fundamental.dtype).eps)
    f, unit, usable = _relative(fundamental, point0, point1)
    u, s, v = svd3(f)
    quadratic, *linear = _kruppa(u, s, v)
    usable = usable & (s[1] > _LOST * eps * s[0])
    usable = usable & (jnp.max(jnp.abs(quadratic), axis=0) > _LOST * eps * s[0] * s[0])
    (x, y), valid = quadratic_roots(jnp.where(usable[None], quadratic, 0.0))
    valid = valid & (x > eps * y) & (y > eps * x) & usable[None]
    # Residuals of the linear equations for the pair g = x / y; sums of magnitudes say what is rounding.
    error = sum(jnp.abs(a[0][None] * y + a[1][None] * x) for a in linear)
    size = jnp.sqrt(x * x + y * y)
    error = jnp.where(valid, error / size, jnp.inf)
    swap = error[1] < error[0]
    error = jnp.stack([jnp.minimum(error[0], error[1]), jnp.maximum(error[0], error[1])])
    g = x / jnp.where(valid, y, 1.0)
    g = jnp.stack([jnp.where(swap, g[1], g[0]), jnp.where(swap, g[0], g[1])])
    valid = jnp.stack([jnp.where(swap, valid[1], valid[0]), jnp.where(swap, valid[0], valid[1])])
    # Where both fit alike, the optical axes lie in a plane and the linear equations say nothing.
    alike = error[1] <= 8.0 * error[0] + eps**0.5 * s[0]
    # A double root: the axes are parallel, or meet at equal distances.
    apart = jnp.abs(g[0] - g[1]) > 8.0 * eps**0.5 * jnp.abs(g[0])
    first = jnp.arange(2).reshape(2, *(1,) * alike.ndim) == 0
    valid = valid & (first | (alike & apart)[None])
    focal = unit[None] * jnp.sqrt(jnp.where(valid, g, 1.0))
    valid = valid & jnp.isfinite(focal)
    return jnp.where(valid, focal, 1.0), valid


def _shared_equation(focal: Array, data: Data) -> Array:
    """The quadratic equation of (2), with singular vectors correct to first order in F."""
    f, unit, usable = _relative(*data)
    held = jax.tree.map(jax.lax.stop_gradient, f)
    regular = [[jnp.where(usable, held[i][j], 1.0 if i == j else 0.0) for j in range(3)] for i in range(3)]
    u, s, v = svd3(regular)
    u, s, v = jax.lax.stop_gradient((u, s, v))
    matrix = jnp.stack([jnp.stack(row) for row in f])
    left, right = (jnp.stack([jnp.stack(column) for column in columns]) for columns in (u, v))
    # m = Uᵀ F V; off its diagonal are the turns of the singular vectors.
    m = jnp.sum(jnp.sum(left[:, :, None] * matrix[None], axis=1)[:, None] * right[None], axis=2)
    turned = []
    for basis, n in ((left, m), (right, m.T)):
        columns = []
        for j in range(2):
            column = basis[j]
            for i in range(3):
                if i != j:
                    turn = safe_divide(s[j] * n[i, j] + s[i] * n[j, i], s[j] * s[j] - s[i] * s[i])
                    column = column + turn * basis[i]
            columns.append((column[0], column[1], column[2]))
        turned.append((columns[0], columns[1], columns[1]))
    quadratic, *_ = _kruppa(turned[0], (m[0, 0], m[1, 1]), turned[1])
    g = (focal / unit) ** 2
    return (quadratic[0] + quadratic[1] * g + quadratic[2] * g * g)[None]


_solve_both = lanes_last(_both_kernel)
_solve_shared = lanes_last(_shared_kernel)
_both = implicit(
    lambda data: Candidates(*_solve_both(*data)), _both_equations, lambda focals, tangent: focals * (1.0 + tangent), 2
)
_shared = implicit(
    lambda data: Candidates(*_solve_shared(*data)),
    _shared_equation,
    lambda focal, tangent: focal * (1.0 + tangent[0]),
    1,
)


def _data(fundamental: ArrayLike, principal_point0: ArrayLike, principal_point1: ArrayLike) -> Data:
    arrays = tuple(jnp.asarray(x) for x in (fundamental, principal_point0, principal_point1))
    dtype = jnp.result_type(*arrays)
    return arrays[0].astype(dtype), arrays[1].astype(dtype), arrays[2].astype(dtype)


def focal_from_fundamental(
    fundamental: Float[ArrayLike, "3 3"],
    principal_point0: Float[ArrayLike, "2"],
    principal_point1: Float[ArrayLike, "2"],
) -> Candidates[Float[Array, "1 2"]]:
    """Find the focal lengths of two cameras from their fundamental matrix and principal points.

    Args:
        fundamental: F with `pixel1ᵀ F pixel0 = 0`, of any scale.
        principal_point0: In pixels of image 0. Pixels are square.
        principal_point1: In pixels of image 1.

    Returns:
        One slot with the focal lengths (f0, f1) in pixels; ones where it is not valid.

    Degenerate input: no focal lengths exist, and the slot is not valid, where a square comes out negative (as noise
        makes it), where the optical axes lie in one plane to rounding (they meet, or are parallel), and for anything
        not finite. Near such configurations, which are common, the result is at the mercy of noise.
    Differentiability: both modes, any order, in all arguments; zero for an invalid slot.
    References: see the module.
    """
    return _both(_data(fundamental, principal_point0, principal_point1))


def shared_focal_from_fundamental(
    fundamental: Float[ArrayLike, "3 3"],
    principal_point0: Float[ArrayLike, "2"],
    principal_point1: Float[ArrayLike, "2"],
) -> Candidates[Float[Array, "2"]]:
    """Find the focal length that two cameras share from their fundamental matrix and principal points.

    Args:
        fundamental: F with `pixel1ᵀ F pixel0 = 0`, of any scale.
        principal_point0: In pixels of image 0. Pixels are square.
        principal_point1: In pixels of image 1.

    Returns:
        Two slots with the focal length in pixels; one where a slot is not valid. The first fits best. The second is
        valid only where the optical axes lie in one plane, so that nothing decides between the two.

    Degenerate input: parallel optical axes and axes that meet at equal distances from both centres leave the focal
        length undetermined: no slot is valid, or with rounding what comes out means nothing. Matrices of rank one, and
        anything not finite, leave no slot valid.
    Differentiability: both modes, first order, in all arguments, by the implicit function theorem; zero for slots that
        are not valid and at a double root.
    References: see the module.
    """
    return _shared(_data(fundamental, principal_point0, principal_point1))
