"""Essential matrix from eight or more bearings: ray1ᵀ E ray0 = 0 is linear in the nine entries of E.

Eight equations leave one direction, found by reflections (rows of unit bearings have length 1). With more the sum of
w (ray1ᵀ E ray0)² is minimised after Hartley's normalisation, which for bearings is a division by the Cholesky factor of
their second moments: with noise at a field of view of 16° it makes the result about a quarter more accurate, and it
makes the second least singular value a measure of degeneracy whatever the field of view. What comes out, N, is replaced
by the essential matrix nearest to it.

Precondition: the points are in general position and the camera moves. For points on a plane, on some quadrics through
both cameras, or seen from one place, other matrices fulfil the equations as well.

The derivative is that of the pair (N, E): N fulfils eight equations on the unit sphere (the rows, or the vanishing of
the tangential part of AᵀW A N), E the five of the nearest essential matrix.

References:
    H. Longuet-Higgins. A computer algorithm for reconstructing a scene from two projections. Nature 1981.
    R. Hartley. In defense of the eight-point algorithm. PAMI 1997.
"""

from typing import NamedTuple

import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._essential_projection import nearest_essential, projection_stationarity
from ._implicit import implicit
from ._lanes import lanes_last
from ._linear_epipolar import (
    algebraic_errors,
    congruent,
    dependent,
    epipolar_rows,
    least_vector_and_second,
    linear_stationarity,
    matmul,
    matrix_rows,
    null_space_and_least,
    repeated,
    two_views,
    unit_rays,
    whitened,
)
from ._matrix_models import perturb_essential, perturb_unit_matrix, unit_matrix

Data = tuple[Array, Array, Array]


class _Model(NamedTuple):
    essential: Array
    linear: Array  # N, norm 1, in the coordinates of the equations


def eight_point(
    rays0: Float[ArrayLike, "n 3"], rays1: Float[ArrayLike, "n 3"], weights: Float[ArrayLike, "n"] | None = None
) -> Candidates[Float[Array, "1 3 3"]]:
    """Find the essential matrix of eight or more matching bearings by linear least squares.

    For a batch, `jax.vmap(eight_point, in_axes=-1, out_axes=-1)` on arrays [n, 3, batch] is the fast layout on a CPU.

    Args:
        rays0: Directions in camera 0's frame, one per row, of any positive length; at least eight.
        rays1: The matching ones in camera 1's frame.
        weights: One non-negative weight per correspondence, as 1 / σ²; their common scale does not matter, and eight
            correspondences have no use for more than the zeros. All equal by default.

    Returns:
        One slot with E, `ray1ᵀ E ray0 = 0`, Frobenius norm 1 and its largest entry positive.

    Degenerate input: points on a plane, a pure rotation, fewer than eight different correspondences with positive
        weight: the equations leave more than one matrix (the least singular value of eight equations is below 4 eps,
        or the second least one of more is below 64 eps of all together), and the slot is invalid with the zero matrix
        in it. With noise in the bearings such sets are no longer exactly degenerate and the result is meaningless: the
        five-point solver is not troubled by planes. Zero rays, negative weights and anything not finite are invalid.
    Differentiability: both modes, any order, in rays and weights, by the implicit function theorem. Zero for an invalid
        slot.

    Raises:
        ValueError: If there are fewer than eight correspondences or the arrays do not match.
    References: see the module.

    Example:
        >>> import numpy as np
        >>> points = np.random.default_rng(0).uniform((-2, -2, 4), (2, 2, 8), (8, 3)).astype(np.float32)
        >>> candidates = eight_point(points, points + np.array([[1.0, 0.0, 0.0]], np.float32))
        >>> [[round(abs(float(x)), 2) for x in row] for row in candidates.models[0]]
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.71], [0.0, 0.71, 0.0]]
    """
    data = two_views(rays0, rays1, weights, at_least=8)
    candidates = _eight_point(data)
    return Candidates(models=candidates.models.essential, valid=candidates.valid)


def _kernel(rays0: Array, rays1: Array, weights: Array) -> tuple[Array, Array, Array]:
    x0, proper0 = unit_rays(rays0)
    x1, proper1 = unit_rays(rays1)
    largest = jnp.max(weights, axis=0)
    proper = proper0 & proper1 & jnp.all(weights >= 0, axis=0) & jnp.isfinite(largest) & (largest > 0)
    weights = jnp.where(proper, weights / jnp.where(proper, largest, 1.0)[None], 0.0)
    if rays0.shape[0] == 8:
        rows = jnp.where((weights > 0)[:, None], epipolar_rows(x0, x1), 0.0)
        basis, least = null_space_and_least(rows)
        certain = ~dependent(least)
        linear = basis[0]
        matrix = matrix_rows(linear)
    else:
        (x0, transform0), (x1, transform1) = whitened(x0, weights), whitened(x1, weights)
        rows = epipolar_rows(x0, x1) * jnp.sqrt(weights)[:, None]
        linear, second = least_vector_and_second(rows, 10 if rows.dtype == jnp.float64 else 6)
        certain = ~repeated(second)
        matrix = congruent(transform1, matrix_rows(linear), transform0)
    essential, unique = nearest_essential(matrix)
    unit, _ = unit_matrix(jnp.stack([jnp.stack(row) for row in essential]))
    valid = proper & certain & unique
    linear = jnp.where(valid, linear, 0.0).reshape(3, 3, *valid.shape)
    return jnp.where(valid, unit, 0.0)[None], linear[None], valid[None]


# On jax 0.12 pieces take a third off the time; on 0.10.1 it stays in its bounds.
_solve = lanes_last(_kernel, chunk=256)


def _candidates(data: Data) -> Candidates[_Model]:
    essential, linear, valid = _solve(*data)
    return Candidates(models=_Model(essential, linear), valid=valid)


def _equations(model: _Model, data: Data) -> Array:
    """Eight equations of N, and five that tie E to it."""
    rays0, rays1, weights = data
    x0, x1 = unit_rays(rays0)[0], unit_rays(rays1)[0]
    matrix = n = model.linear
    if rays0.shape[0] > 8:
        (x0, transform0), (x1, transform1) = whitened(x0, weights), whitened(x1, weights)
        t0, t1 = (jnp.stack([jnp.stack(row) for row in rows]) for rows in (transform0, transform1))
        matrix = matmul(t1.T, matmul(n, t0))
    x0, x1 = jnp.stack(x0, axis=1), jnp.stack(x1, axis=1)
    linear = algebraic_errors(x0, x1, n) if rays0.shape[0] == 8 else linear_stationarity(x0, x1, weights, n)
    return jnp.concatenate([linear, projection_stationarity(model.essential, matrix)])


def _retract(model: _Model, tangent: Array) -> _Model:
    return _Model(
        perturb_essential(model.essential, tangent[:5]),
        perturb_unit_matrix(model.linear, tangent[5:]),
    )


_eight_point = implicit(_candidates, _equations, _retract, 13)
