"""The right singular vector of the smallest singular value of a tall narrow matrix.

One-sided Jacobi rotations (Hestenes) make the columns orthogonal: A V = U S. They never form AᵀA, so float32 keeps
small singular values to their own relative accuracy. The derivative is that of a simple eigenvector of AᵀA,

    dv = Σᵢ vᵢ (vᵢᵀ d(AᵀA) v) / (σ² - σᵢ²)   over the other singular vectors vᵢ,

which stays finite where singular values meet (such terms count as 0), unlike the derivative of an SVD.

References: Hestenes, "Inversion of matrices by biorthogonalization", 1958.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import tiny
from vojax._types import Array, Float

# Convergence is quadratic: random 4x4 to 60x4 matrices are at float64 rounding after 5 or 6 sweeps.
SWEEPS = 7


def _rotate(pair: tuple[Array, Array], cosine: Array, sine: Array) -> tuple[Array, Array]:
    first, second = pair
    return cosine * first - sine * second, sine * first + cosine * second


def _jacobi(matrix: Float[Array, "rows columns"]) -> tuple[Array, Array]:
    """Right singular vectors, one per ROW, and squared singular values, unordered."""
    size = matrix.shape[1]
    negligible = tiny(matrix)

    def sweep(_, state):
        columns, vectors = list(state[0]), list(state[1])
        for i in range(size):
            for j in range(i + 1, size):
                alpha = jnp.sum(columns[i] * columns[i])
                beta = jnp.sum(columns[j] * columns[j])
                gamma = jnp.sum(columns[i] * columns[j])
                active = jnp.abs(gamma) > negligible
                zeta = (beta - alpha) / (2.0 * jnp.where(active, gamma, 1.0))
                magnitude = jnp.abs(zeta)
                # For a huge ratio sqrt(1 + zeta²) would overflow; the tangent is 1 / (2 zeta) there.
                capped = jnp.minimum(magnitude, 1.0 / float(jnp.finfo(matrix.dtype).eps))
                tangent = jnp.where(zeta < 0, -1.0, 1.0) / (magnitude + jnp.sqrt(1.0 + capped * capped))
                tangent = jnp.where(active, tangent, 0.0)
                cosine = 1.0 / jnp.sqrt(1.0 + tangent * tangent)
                sine = cosine * tangent
                columns[i], columns[j] = _rotate((columns[i], columns[j]), cosine, sine)
                vectors[i], vectors[j] = _rotate((vectors[i], vectors[j]), cosine, sine)
        return jnp.stack(columns), jnp.stack(vectors)

    columns, vectors = jax.lax.fori_loop(0, SWEEPS, sweep, (matrix.T, jnp.eye(size, dtype=matrix.dtype)))
    return vectors, jnp.sum(columns * columns, axis=1)


@jax.custom_jvp
def null_vector(matrix: Float[Array, "rows columns"]) -> Float[Array, "columns"]:
    """Unit vector v that minimises |A v|, its largest entry positive.

    Args:
        matrix: The matrix A, with at most a handful of columns; scale rows and columns sensibly.

    Returns:
        The singular vector of the smallest singular value.

    Degenerate input: where the smallest singular value is repeated, one vector of its space.

    Differentiability: both modes, first order.
    """
    vectors, squares = _jacobi(matrix)
    return _positive(vectors[jnp.argmin(squares)])


def _positive(vector: Array) -> Array:
    return vector * jnp.where(vector[jnp.argmax(jnp.abs(vector))] < 0, -1.0, 1.0).astype(vector.dtype)


@null_vector.defjvp
def _null_vector_jvp(primals, tangents):
    (matrix,), (d_matrix,) = primals, tangents
    vectors, squares = jax.lax.stop_gradient(_jacobi(jax.lax.stop_gradient(matrix)))
    smallest = jnp.argmin(squares)
    vector = _positive(vectors[smallest])
    d_gram_v = d_matrix.T @ (matrix @ vector) + matrix.T @ (d_matrix @ vector)
    gaps = squares[smallest] - squares
    distinct = -gaps > 8 * float(jnp.finfo(matrix.dtype).eps) * jnp.max(squares) * float(jnp.finfo(matrix.dtype).eps)
    weights = jnp.where(distinct, 1.0 / jnp.where(distinct, gaps, 1.0), 0.0)
    return vector, vectors.T @ (weights * (vectors @ d_gram_v))
