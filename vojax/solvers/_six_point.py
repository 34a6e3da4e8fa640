"""Essential matrix from six bearings, linearly: Philip's algorithm.

Six equations ray1ᵀ E ray0 = 0 leave E = x A + y B + z C. The nine equations of

    (E Eᵀ - ½ tr(E Eᵀ) I) E = 0                                                                                  (1)

and det E = 0 are linear in the ten cubic monomials of (x, y, z), so their null vector holds x³, x²y, … and x : y : z
can be read off. E has five degrees of freedom: the sixth equation makes the solution unique, and with noise there is no
exact one. The linear result is therefore only the start of a Gauss-Newton iteration on essential matrices, which
minimises the sum of (ray1ᵀ E ray0)², and whose stationarity is what the derivative belongs to.

Precondition: the points are in general position and the camera moves.

References:
    J. Philip. A non-iterative algorithm for determining all essential matrices corresponding to five point pairs.
    The Photogrammetric Record 1996. J. Philip. Critical point configurations of the 5-, 6-, 7-, and 8-point algorithms
    for relative orientation. KTH 1998.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from vojax._numerics import Vector3, cholesky_solve, cross3, lane_sum
from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._components import Components, complement, rotate, squared
from ._essential_projection import nearest_essential, projection_stationarity
from ._implicit import implicit
from ._lanes import lanes_last, one_kernel
from ._linear_epipolar import (
    algebraic_errors,
    epipolar_rows,
    least_vector_and_second,
    matrix_rows,
    null_space_and_least,
    two_views,
    unit_rays,
)
from ._matrix_models import perturb_essential, unit_matrix

# Quadratic monomials x², xy, xz, y², yz, z², and the cubic one that each of them makes with x, y, z.
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_CUBIC = {(0, 0, 0): 0, (0, 0, 1): 1, (0, 0, 2): 2, (0, 1, 1): 3, (0, 1, 2): 4, (0, 2, 2): 5}
_CUBIC |= {(1, 1, 1): 6, (1, 1, 2): 7, (1, 2, 2): 8, (2, 2, 2): 9}


def six_point(rays0: Float[ArrayLike, "6 3"], rays1: Float[ArrayLike, "6 3"]) -> Candidates[Float[Array, "1 3 3"]]:
    """Find the essential matrix of six matching bearings.

    For a batch, `jax.vmap(six_point, in_axes=-1, out_axes=-1)` on arrays [6, 3, batch] is the fast layout on a CPU.

    Args:
        rays0: Directions in camera 0's frame, one per row, of any positive length.
        rays1: The matching ones in camera 1's frame.

    Returns:
        One slot with E, `ray1ᵀ E ray0 = 0`, Frobenius norm 1 and its largest entry positive. With noise it is a local
        least-squares solution of the six equations for unit bearings.

    Degenerate input: points on a plane have two solutions, whose mixtures the ten equations cannot tell apart; after a
        pure rotation and with coincident correspondences there are infinitely many. The slot is then invalid with the
        zero matrix in it: the second least singular value of the ten equations times the least one of the six is below
        eps. With noise such sets are no longer exactly degenerate and the result is meaningless. Zero rays and anything
        not finite are invalid.
    Differentiability: both modes, any order, by the implicit function theorem. Zero for an invalid slot.

    Raises:
        ValueError: If there are not six correspondences.
    References: see the module.

    Example:
        >>> import numpy as np
        >>> points = np.random.default_rng(0).uniform((-2, -2, 4), (2, 2, 8), (6, 3)).astype(np.float32)
        >>> candidates = six_point(points, points + np.array([[1.0, 0.0, 0.0]], np.float32))
        >>> [[round(abs(float(x)), 2) for x in row] for row in candidates.models[0]]
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.71], [0.0, 0.71, 0.0]]
    """
    rays0, rays1, _ = two_views(rays0, rays1, None, at_least=6)
    if rays0.shape[0] != 6:
        raise ValueError(f"found {rays0.shape[0]} correspondences; expected 6: use eight_point for eight or more")
    return _six_point((rays0, rays1))


def _cubic_constraints(basis: Float[Array, "3 3 3 *lanes"]) -> Float[Array, "10 10 *lanes"]:
    """Coefficients of (1) and of the determinant: one row per equation, one column per cubic monomial."""
    quadratic = []
    for p, q in _PAIRS:
        # The coefficient of a monomial in E Eᵀ, [3, 3, *lanes].
        product = lane_sum(basis[p][:, None] * basis[q][None, :], axis=2)
        if p != q:
            product = product + jnp.swapaxes(product, 0, 1)
        half_trace = 0.5 * (product[0, 0] + product[1, 1] + product[2, 2])
        identity = jnp.eye(3, dtype=basis.dtype).reshape(3, 3, *(1,) * half_trace.ndim)
        quadratic.append(product - identity * half_trace[None, None])
    columns: list[Array | None] = [None] * 10
    for (p, q), form in zip(_PAIRS, quadratic, strict=True):
        for r in range(3):
            a, b, c = sorted((p, q, r))
            term = lane_sum(form[:, :, None] * basis[r][None, :, :], axis=1)
            index = _CUBIC[(a, b, c)]
            held = columns[index]
            columns[index] = term if held is None else held + term
    trace = jnp.stack([c for c in columns if c is not None], axis=2)  # [3, 3, 10, *lanes]
    rows = [tuple(tuple(basis[p][i, j] for j in range(3)) for i in range(3)) for p in range(3)]
    determinant: list[Array | None] = [None] * 10
    for p, q in _PAIRS:
        minor = cross3(rows[p][1], rows[q][2])
        if p != q:
            other = cross3(rows[q][1], rows[p][2])
            minor = tuple(x + y for x, y in zip(minor, other, strict=True))
        for r in range(3):
            a, b, c = sorted((p, q, r))
            term = rows[r][0][0] * minor[0] + rows[r][0][1] * minor[1] + rows[r][0][2] * minor[2]
            index = _CUBIC[(a, b, c)]
            held = determinant[index]
            determinant[index] = term if held is None else held + term
    last = jnp.stack([c for c in determinant if c is not None])
    return jnp.concatenate([trace.reshape(9, 10, *trace.shape[3:]), last[None]])


def _linear_solution(basis: Float[Array, "3 9 *lanes"]) -> tuple[Float[Array, "9 *lanes"], Array]:
    """Philip's x A + y B + z C, and the second least singular value of the equations of its monomials."""
    constraints = _cubic_constraints(basis.reshape(3, 3, 3, *basis.shape[2:]))
    monomials, second = least_vector_and_second(constraints, 8 if basis.dtype == jnp.float64 else 5)
    # x³ : x²y : x²z and its likes, from the largest of the three cubes.
    triples = [jnp.stack([monomials[i] for i in picks]) for picks in ((0, 1, 2), (3, 6, 7), (5, 8, 9))]
    largest, xyz = jnp.abs(triples[0][0]), triples[0]
    for k in (1, 2):
        cube = jnp.abs(triples[k][k])
        xyz = jnp.where((cube > largest)[None], triples[k], xyz)
        largest = jnp.maximum(largest, cube)
    return lane_sum(xyz[:, None] * basis, axis=0), second * jnp.sqrt(lane_sum(constraints * constraints, axis=(0, 1)))


def _gauss_newton(essential: Float[Array, "9 *lanes"], rows: Float[Array, "6 9 *lanes"]) -> Float[Array, "9 *lanes"]:
    """One step on the manifold, E ↦ Q(α) E Q(β) with rotations, in the coordinates of `perturb_essential`."""
    e = matrix_rows(essential)
    columns = [(e[0][j], e[1][j], e[2][j]) for j in range(3)]
    first, second = complement(_translation(columns))
    directions = []
    for axis in (first, second):
        turned = [cross3(axis, column) for column in columns]
        directions.append(jnp.stack([turned[j][i] for i in range(3) for j in range(3)]))
    zero, one = jnp.zeros_like(essential[0]), jnp.ones_like(essential[0])
    for axis in ((one, zero, zero), (zero, one, zero), (zero, zero, one)):
        directions.append(jnp.stack([c for row in e for c in cross3(row, axis)]))
    jacobian = jnp.stack([lane_sum(rows * direction[None], axis=1) for direction in directions])  # [5, 6, *lanes]
    residual = lane_sum(rows * essential[None], axis=1)
    normal = lane_sum(jacobian[:, None] * jacobian[None, :], axis=2)
    gradient = lane_sum(jacobian * residual[None], axis=1)
    step = cholesky_solve(normal, gradient[:, None], lane_sum)[0][:, 0]
    # No more than a tenth of a radian at once.
    length = jnp.sqrt(lane_sum(step * step, axis=0))
    half = step * (-0.5 / jnp.maximum(1.0, 10.0 * length))[None]
    left = _quaternion(tuple(half[0] * x + half[1] * y for x, y in zip(first, second, strict=True)))
    right = _quaternion((-half[2], -half[3], -half[4]))
    columns = [rotate(left, column) for column in columns]
    rows3 = [rotate(right, (columns[0][i], columns[1][i], columns[2][i])) for i in range(3)]
    return jnp.stack([c for row in rows3 for c in row])


def _translation(columns: Sequence[Vector3]) -> Vector3:
    """Unit vector t with tᵀE = 0: the longest of the cross products of columns."""
    t = cross3(columns[0], columns[1])
    size = squared(t)
    for i in (1, 2):
        cross = cross3(columns[i], columns[i - 2])
        longer = squared(cross) > size
        t = tuple(jnp.where(longer, new, old) for new, old in zip(cross, t, strict=True))
        size = jnp.where(longer, squared(cross), size)
    norm = jnp.sqrt(squared(t))
    usable = norm > 0
    upright = (0.0, 0.0, 1.0)
    return tuple(jnp.where(usable, c / jnp.where(usable, norm, 1.0), z) for c, z in zip(t, upright, strict=True))


def _quaternion(half_turn: Vector3) -> Components:
    """Unit quaternion of a small rotation vector, given by half of it."""
    norm = jnp.sqrt(1.0 + squared(half_turn))
    return (1.0 / norm, half_turn[0] / norm, half_turn[1] / norm, half_turn[2] / norm)


def _kernel(rays0: Array, rays1: Array) -> tuple[Array, Array]:
    x0, proper0 = unit_rays(rays0)
    x1, proper1 = unit_rays(rays1)
    rows = epipolar_rows(x0, x1)
    basis, least = null_space_and_least(rows)
    linear, second = _linear_solution(basis)
    # The rounding of the null space, eps / least, is that of the cubic equations. For points on a plane the product
    # reaches 0.4 eps, for a pure rotation 0.12 eps (where every matrix of the null space is a solution); for points in
    # general position it is below 1 eps of float32 in two cases of a thousand.
    unique = least * second > float(jnp.finfo(rows.dtype).eps)
    nearest, essential_like = nearest_essential(matrix_rows(linear))
    valid = proper0 & proper1 & unique & essential_like
    start = jnp.where(valid, jnp.stack([c for row in nearest for c in row]), 0.0)
    polished = jax.lax.fori_loop(0, 5 if rows.dtype == jnp.float64 else 3, lambda _, e: _gauss_newton(e, rows), start)
    models, finite = unit_matrix(polished.reshape(3, 3, *valid.shape))
    valid = valid & finite
    return jnp.where(valid, models, 0.0)[None], valid[None]


_solve = lanes_last(one_kernel(_kernel), chunk=128)


def _candidates(data: tuple[Array, Array]) -> Candidates[Array]:
    models, valid = _solve(*data)
    return Candidates(models=models, valid=valid)


def _equations(essential: Array, data: tuple[Array, Array]) -> Array:
    """Five equations: the derivative of half the sum of (ray1ᵀ E ray0)² along the manifold."""
    x0, x1 = (jnp.stack(unit_rays(rays)[0], axis=1) for rays in data)
    # The inner products of the gradient with the tangents are those of the equations of a projection.
    error = algebraic_errors(x0, x1, essential)
    gradient = jnp.sum((error[:, None] * x1)[:, :, None] * x0[:, None, :], axis=0)
    return projection_stationarity(essential, gradient)


_six_point = implicit(_candidates, _equations, perturb_essential, 5)
