"""Scalars that stay finite, in value and in gradient, and small closed-form linear algebra for the lanes.

Everything here is elementwise over arrays of any equal shape, so the same code runs for one problem and for a batch on
the last axis.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ._types import Array, Bool, Float


def tiny(x: Float[Array, "..."]) -> float:
    """Smallest magnitude that is still safe to divide by and to square-root in the dtype of `x`."""
    return float(jnp.finfo(x.dtype).tiny) ** 0.5


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root that is 0 with gradient 0 for `x <= 0`."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_divide(numerator: Float[Array, "*shape"], denominator: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Quotient that is 0 with gradient 0 where the denominator vanishes."""
    usable = jnp.abs(denominator) > tiny(denominator)
    return jnp.where(usable, numerator / jnp.where(usable, denominator, 1.0), 0.0)


def safe_norm(x: Float[Array, "*batch d"]) -> Float[Array, "*batch"]:
    """Euclidean norm over the last axis; 0 with gradient 0 at the origin."""
    return safe_sqrt(jnp.sum(x * x, axis=-1))


def normalize(x: Float[Array, "*batch d"]) -> Float[Array, "*batch d"]:
    """Scale vectors to unit length; the zero vector stays zero, with gradient 0."""
    norm = safe_norm(x)[..., None]
    usable = norm > 0
    return jnp.where(usable, x / jnp.where(usable, norm, 1.0), 0.0)


Vector3 = Sequence[Array]


def lane_sum(x: Float[Array, "..."], axis: int | tuple[int, ...]) -> Float[Array, "..."]:
    """Sum over axes that are not lanes, which XLA may make part of a kernel.

    From jax 0.12 on XLA takes every float32 sum for a call into a library of its own, at the price of a kernel before
    and one behind it. Rounding to the precision that the numbers have anyway keeps it from seeing one. It has a
    derivative but cannot be transposed: solving for a derivative takes `jnp.sum`.
    """
    axes = (axis,) if isinstance(axis, int) else axis
    return _sum_over(tuple(a % x.ndim for a in axes))(x)


@functools.cache
def _sum_over(axes: tuple[int, ...]) -> Callable[[Array], Array]:
    @jax.custom_jvp
    def total(x: Array) -> Array:
        info = jnp.finfo(x.dtype)

        def add(a: Array, b: Array) -> Array:
            return jax.lax.reduce_precision(a + b, info.nexp, info.nmant)

        return jax.lax.reduce(x, np.zeros((), x.dtype), add, axes)

    @total.defjvp
    def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        return total(primals[0]), jnp.sum(tangents[0], axis=axes)

    return total


def lane_max(x: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """Largest entry along an axis that is no lane, for the same reason as `lane_sum`."""
    return _max_over(axis % x.ndim)(x)


@functools.cache
def _max_over(axis: int) -> Callable[[Array], Array]:
    @jax.custom_jvp
    def largest(x: Array) -> Array:
        info = jnp.finfo(x.dtype)

        def larger(a: Array, b: Array) -> Array:
            return jax.lax.reduce_precision(jnp.maximum(a, b), info.nexp, info.nmant)

        return jax.lax.reduce(x, np.full((), -np.inf, x.dtype), larger, (axis,))

    @largest.defjvp
    def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        found = largest(primals[0])
        first = jnp.argmax(primals[0], axis=axis, keepdims=True)
        return found, jnp.take_along_axis(tangents[0], first, axis=axis).squeeze(axis)

    return largest


def dot3(a: Vector3, b: Vector3) -> Array:
    """Scalar product of two vectors given by components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross3(a: Vector3, b: Vector3) -> Vector3:
    """Vector product of two vectors given by components."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def complement(unit: Vector3) -> tuple[Vector3, Vector3]:
    """Two unit vectors that complete a unit vector to an orthonormal, right-handed frame.

    References: T. Duff et al. Building an orthonormal basis, revisited. JCGT 2017.
    """
    x, y, z = unit
    s = jnp.where(z < 0, -1.0, 1.0).astype(z.dtype)
    p = -1.0 / (s + z)
    xy = x * y * p
    return (1.0 + s * x * x * p, s * xy, -s * x), (xy, s + y * y * p, -y)


def cholesky_factor(matrix: Float[Array, "d d *lanes"]) -> tuple[list[Array], list[Array], Array]:
    """Factor small positive semidefinite matrices M = L Lᵀ, one column after the other.

    Whole columns are updated at once: unrolled to scalars, the same arithmetic takes a compiler tens of times longer.

    Args:
        matrix: Symmetric matrices, batch on the trailing axes.

    Returns:
        The columns of L, from the diagonal down `[d − k, *lanes]`; the inverses of its diagonal; and a mask that is
        False where M is singular to working precision. Columns whose pivot is noise are 0, their inverses too, so that
        solutions stay finite and have no component along directions without information.
    """
    size = matrix.shape[0]
    diagonal = [matrix[k, k] for k in range(size)]
    columns: list[Array] = []
    inverse_pivots: list[Array] = []
    regular = jnp.isfinite(diagonal[0])
    rest = matrix
    for k in range(size):
        pivot = rest[0, 0]
        # Below the rounding error of the diagonal entry that it came from, a pivot is noise.
        positive = pivot > 2 * size * float(jnp.finfo(pivot.dtype).eps) * jnp.abs(diagonal[k])
        inverse = jnp.where(positive, 1.0 / jnp.sqrt(jnp.where(positive, pivot, 1.0)), 0.0)
        column = rest[:, 0] * inverse[None]
        rest = rest[1:, 1:] - column[1:, None] * column[None, 1:]
        columns.append(column)
        inverse_pivots.append(inverse)
        regular = regular & positive
    return columns, inverse_pivots, regular


def cholesky_solve(
    matrix: Float[Array, "d d *lanes"], rhs: Float[Array, "d r *lanes"], total: Callable[..., Array] = jnp.sum
) -> tuple[Float[Array, "d r *lanes"], Bool[Array, "*lanes"]]:
    """Solve small symmetric positive definite systems; see `cholesky_factor` for singular ones.

    Args:
        matrix: Of the systems.
        rhs: Right-hand sides.
        total: How sums are taken: `lane_sum` within a kernel, which is not for solving for derivatives.

    Returns:
        The solutions, and the mask of systems that are regular.
    """
    columns, inverse_pivots, regular = cholesky_factor(matrix)
    forward: list[Array] = []
    rest = rhs
    for column, inverse in zip(columns, inverse_pivots, strict=True):
        entry = rest[0] * inverse[None]
        rest = rest[1:] - column[1:, None] * entry[None]
        forward.append(entry)
    solution = jnp.zeros_like(rhs[:0])
    for column, inverse, entry in zip(columns[::-1], inverse_pivots[::-1], forward[::-1], strict=True):
        entry = (entry - total(column[1:, None] * solution, axis=0)) * inverse[None]
        solution = jnp.concatenate([entry[None], solution])
    return solution, regular


def symmetric_inverse(
    matrix: Float[Array, "d d *lanes"], total: Callable[..., Array] = jnp.sum
) -> tuple[Float[Array, "d d *lanes"], Bool[Array, "*lanes"]]:
    """Invert small positive definite matrices, and say which could be inverted.

    A matrix is singular to working precision when, scaled to unit diagonal, its condition number exceeds 1/(32 eps),
    3e5 in float32: beyond, rounding in its entries decides a direction (points on a line reach 2e6 and more).
    """
    identity = jnp.eye(matrix.shape[0], dtype=matrix.dtype).reshape(matrix.shape[:2] + (1,) * (matrix.ndim - 2))
    inverse, regular = cholesky_solve(matrix, jnp.broadcast_to(identity, matrix.shape), total)
    # The trace of the scaled inverse bounds its largest eigenvalue.
    trace = sum(matrix[i, i] * inverse[i, i] for i in range(matrix.shape[0]))
    return inverse, regular & (trace < 1.0 / (32.0 * float(jnp.finfo(matrix.dtype).eps)))


def propagated(jacobian: Float[Array, "*n i j"], covariance: Float[Array, "n j j"]) -> Float[Array, "n i i"]:
    """J Σ Jᵀ of each row of a batch on the first axis; one Jacobian `[i, j]` serves all rows.

    Sums instead of matrix products: of small matrices XLA makes one kernel.
    """
    jacobian = jnp.broadcast_to(jacobian, (covariance.shape[0], *jacobian.shape[-2:]))
    half = jnp.sum(jacobian[:, :, :, None] * covariance[:, None], axis=2)
    return jnp.sum(half[:, :, None, :] * jacobian[:, None, :, :], axis=3)
