"""Relative pose from five rays by the action matrix: a second way to the same essential matrices.

With E = x E0 + y E1 + z E2 + E3 the ten cubics of `_five_point.py` are solved for all ten monomials of degree three.
Modulo the cubics, multiplication by x then maps the ten monomials b = (x², xy, xz, y², yz, z², x, y, z, 1) to
combinations of themselves: A b = x b, so every solution is a real eigenvalue x of the 10×10 matrix A, with b as its
eigenvector (Stewénius).

No eigenvalue routine runs in the lanes of a batch, so A is brought to Hessenberg form by Householder reflections, whose
characteristic polynomial follows by Hyman's recurrence (La Budde), and its real roots are isolated as in `five_point`.
For each, the rows of A b = x b that are not mere definitions leave six equations, linear in (y², yz, z², y, z, 1).

It is here to be compared with: `five_point` is faster.

References:
    H. Stewénius, C. Engels, D. Nistér. Recent developments on direct relative orientation. ISPRS 2006.
    R. Rehman, I. Ipsen. La Budde's method for computing characteristic polynomials. 2011.
"""

import functools

import jax.numpy as jnp

from vojax._numerics import lane_sum
from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._components import floor
from ._essential_newton import polish_essential, sum_of_products
from ._five_point import SLOTS, correspondences, cubic_constraints, epipolar_basis, epipolar_equations, unit_rays
from ._implicit import implicit
from ._lanes import lanes_last, one_kernel
from ._matrix_models import perturb_essential
from ._null_space import eliminate
from ._roots import polynomial_roots

# Monomials as sorted indices of (x, y, z, 1); the first ten are those of degree three.
_MONOMIALS = (
    *("000", "001", "002", "011", "012", "022", "111", "112", "122", "222"),
    *("003", "013", "023", "113", "123", "223", "033", "133", "233", "333"),
)  # fmt: skip


def _action_matrix(reduced: Float[Array, "10 10 *lanes"]) -> Float[Array, "10 10 *lanes"]:
    """Multiplication by x on the basis b: six rows from the cubics, four that are definitions."""
    identity = jnp.broadcast_to(
        jnp.eye(10, dtype=reduced.dtype).reshape(10, 10, *(1,) * (reduced.ndim - 2)), reduced.shape
    )
    return jnp.concatenate([-reduced[:6], identity[:3], identity[6:7]])


def _hessenberg(matrix: Float[Array, "n n *lanes"]) -> Float[Array, "n n *lanes"]:
    """A similar matrix that is zero below the first subdiagonal."""
    n = matrix.shape[0]
    for k in range(n - 2):
        x = matrix[k + 1 :, k]
        length2 = lane_sum(x * x, axis=0)
        usable = length2 > floor(length2) ** 2
        safe = jnp.sqrt(jnp.where(usable, length2, 1.0))
        alpha = jnp.where(x[0] > 0, -safe, safe)
        v = jnp.concatenate([(x[0] - alpha)[None], x[1:]])
        beta = jnp.where(usable, 1.0 / (safe * safe - alpha * x[0]), 0.0)
        rows = matrix[k + 1 :]
        rows = rows - v[:, None] * (beta[None] * lane_sum(v[:, None] * rows, axis=0))[None]
        matrix = jnp.concatenate([matrix[: k + 1], rows])
        columns = matrix[:, k + 1 :]
        columns = columns - (beta[None] * lane_sum(columns * v[None], axis=1))[:, None] * v[None]
        matrix = jnp.concatenate([matrix[:, : k + 1], columns], axis=1)
    return matrix


def _characteristic_polynomial(h: Float[Array, "n n *lanes"]) -> Float[Array, "n+1 *lanes"]:
    """Ascending coefficients of det(λ I - H) of a Hessenberg matrix, by its leading principal minors."""
    n = h.shape[0]
    one = jnp.ones_like(h[0, :1])

    def widened(p: Array) -> Array:
        return jnp.pad(p, ((0, n + 1 - p.shape[0]), *((0, 0),) * (p.ndim - 1)))

    minors = [widened(one)]
    for k in range(n):
        last = minors[-1]
        p = jnp.concatenate([jnp.zeros_like(one), last[:-1]]) - h[k, k][None] * last
        product = one[0]
        for m in range(1, k + 1):
            product = product * h[k - m + 1, k - m]
            p = p - (h[k - m, k] * product)[None] * minors[k - m]
        minors.append(p)
    return minors[-1]


def _remaining_coordinates(reduced: Array, x: Array) -> tuple[Array, Array]:
    """(y, z) at an eigenvalue x: [slots, *lanes] each."""
    x2 = x * x
    # Rows x·(x², xy, xz, y², yz, z²) = -reduced · b, in the order of the unknowns (y², yz, z², y, z | 1).
    rows = []
    for i in range(6):
        c = [reduced[i, j][None] for j in range(10)]  # of x², xy, xz, y², yz, z², x, y, z, 1
        row = [c[3] + 0 * x, c[4] + 0 * x, c[5] + 0 * x, c[1] * x + c[7], c[2] * x + c[8], c[0] * x2 + c[6] * x + c[9]]
        if i == 0:
            row[5] = row[5] + x2 * x
        elif i in (1, 2):
            row[2 + i] = row[2 + i] + x2
        else:
            row[i - 3] = row[i - 3] + x
        rows.append(row)
    # Six equations in five unknowns: Gram-Schmidt on the columns.
    columns = [list(entries) for entries in zip(*rows, strict=True)]
    upper: list[list[Array]] = []
    for k in range(5):
        pivot = sum_of_products(columns[k], columns[k])
        pivot = jnp.where(pivot > floor(pivot) ** 2, pivot, 1.0)
        factors = [sum_of_products(columns[k], columns[j]) / pivot for j in range(k + 1, 6)]
        for j, factor in enumerate(factors, k + 1):
            columns[j] = [c - factor * a for c, a in zip(columns[j], columns[k], strict=True)]
        upper.append(factors)
    z = -upper[4][0]
    y = -upper[3][1] - upper[3][0] * z
    return y, z


_roots = one_kernel(functools.partial(polynomial_roots, slots=SLOTS))
_polish = one_kernel(functools.partial(polish_essential, steps=6))


def _solve_lanes(rays0: Array, rays1: Array) -> tuple[Array, Array]:
    """E [10, 3, 3, *lanes] and validity [10, *lanes] from rays [5, 3, *lanes]."""
    rays0, rays1, proper = unit_rays(rays0, rays1)
    basis, independent = epipolar_basis(rays0, rays1)
    reduced = eliminate(cubic_constraints(basis, _MONOMIALS))
    polynomial = _characteristic_polynomial(_hessenberg(_action_matrix(reduced)))
    (u, v), valid = _roots(polynomial)
    x = u / jnp.maximum(v, floor(v))
    y, z = _remaining_coordinates(reduced, x)
    flat = basis.reshape(4, 9, 1, *basis.shape[3:])
    entries = x[None] * flat[0] + y[None] * flat[1] + z[None] * flat[2] + flat[3]
    return _polish(entries, valid & (proper & independent)[None], rays0, rays1)


_solve = lanes_last(_solve_lanes, chunk=128)


def _candidates(data: tuple[Array, Array]) -> Candidates[Array]:
    return Candidates(*_solve(*data))


_five_point = implicit(_candidates, epipolar_equations, perturb_essential, 5)


def five_point_action_matrix(
    rays0: Float[ArrayLike, "5 3"], rays1: Float[ArrayLike, "5 3"]
) -> Candidates[Float[Array, "10 3 3"]]:
    """Find the essential matrices of two views that see five points, by the eigenvalues of the action matrix.

    The same answer as `five_point` by other arithmetic; slower, and in float32 it misses more.

    Args:
        rays0: Directions in camera 0, one per row, of any positive length; bearings beyond 180° too.
        rays1: The matching directions in camera 1.

    Returns:
        Ten slots of E, as `five_point`.

    Degenerate input: as `five_point`.

    Differentiability: as `five_point`.

    References: see the module.
    """
    return _five_point(correspondences(rays0, rays1))
