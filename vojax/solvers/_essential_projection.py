"""The essential matrix nearest to a 3×3 matrix.

For M = U diag(s0, s1, s2) Vᵀ it is E = ½ (s0 + s1) U diag(1, 1, 0) Vᵀ. The derivative of the decomposition does not
exist at E itself, where the singular values are equal, but that of the nearest matrix does: E maximises ⟨M, E⟩ among
essential matrices of its norm, which is to say that for every small rotation by α on the left and by β on the right

    ⟨M, [α]× E⟩ = 0,        ⟨M, E [β]×⟩ = 0.                                                                   (1)

References: R. Hartley, A. Zisserman. Multiple View Geometry in Computer Vision, 2nd edition, result 9.18.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import cross3, dot3, lane_sum
from vojax._types import Array, ArrayLike, Bool, Float

from ._candidates import Candidates
from ._components import Rows3, complement, floor
from ._implicit import implicit
from ._lanes import lanes_last
from ._linear_epipolar import cofactors, matmul, matrix_rows
from ._matrix_models import perturb_essential
from ._svd3 import svd3


def project_to_essential(matrix: Float[ArrayLike, "3 3"]) -> Float[Array, "3 3"]:
    """Find the essential matrix nearest to a matrix in the Frobenius norm.

    Args:
        matrix: Any matrix, such as a linear estimate of an essential matrix.

    Returns:
        The matrix with the two larger singular values replaced by their mean and the least by zero; scale and sign are
        those of the argument.

    Degenerate input: where the two smaller singular values are equal there are several nearest matrices, and the
        result is zero, as it is for a zero matrix and for one that is not finite.
    Differentiability: both modes, any order, by the implicit function theorem, at equal singular values too. Zero where
        the result is.

    References: Hartley & Zisserman, result 9.18.

    Example:
        >>> projected = project_to_essential(jnp.array([[3.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.5]]))
        >>> [round(float(x), 4) for x in jnp.diagonal(projected)]
        [2.0, 2.0, 0.0]
    """
    matrix = jnp.asarray(matrix)
    candidates = _project(matrix)
    unit = candidates.models[0]
    matrix = jnp.where(candidates.valid[0], matrix, jnp.zeros_like(matrix))
    return unit * jnp.sum(unit * matrix)


def nearest_essential(matrix: Rows3) -> tuple[Rows3, Bool[Array, "*lanes"]]:
    """Essential matrix of Frobenius norm 1 nearest to the direction of a matrix by components, and if it is unique."""
    size = sum(jnp.abs(entry) for row in matrix for entry in row)
    proper = jnp.isfinite(size) & (size > floor(matrix[0][0]) ** 3)
    scale = jnp.where(proper, size, 1.0)
    entries = jnp.stack([jnp.where(proper, entry / scale, 0.0) for row in matrix for entry in row])
    rest, turned, _, unique = without_least(matrix_rows(entries))
    nearest = [[rest[i][j] + turned[i][j] for j in range(3)] for i in range(3)]
    norm = jnp.sqrt(sum(entry * entry for row in nearest for entry in row))
    unique = proper & unique
    rows = tuple(tuple(jnp.where(unique, c / jnp.where(unique, norm, 1.0), 0.0) for c in row) for row in nearest)
    return (rows[0], rows[1], rows[2]), unique


def without_least(matrix: Rows3) -> tuple[Rows3, Rows3, tuple[Array, Array, Array], Bool[Array, "*lanes"]]:
    """M' = M - s2 u vᵀ; [u]× M' [v]×ᵀ, which exchanges its singular values; all three of M; and if s1 > |s2|.

    Only the vectors of the least singular value enter, as the others are arbitrary where their values are equal.
    """
    u_all, s, v_all = svd3(matrix)
    u, v = u_all[2], v_all[2]
    columns = [(matrix[0][j], matrix[1][j], matrix[2][j]) for j in range(3)]
    along = tuple(dot3(u, column) for column in columns)  # uᵀM = s2 vᵀ
    rest = [[matrix[i][j] - u[i] * along[j] for j in range(3)] for i in range(3)]
    crossed = [cross3(u, (rest[0][j], rest[1][j], rest[2][j])) for j in range(3)]
    turned = [cross3(v, (crossed[0][i], crossed[1][i], crossed[2][i])) for i in range(3)]
    # Their inner product is 2 s0 s1; u and v may come with the wrong signs.
    inner = dot3(rest[0], turned[0]) + dot3(rest[1], turned[1]) + dot3(rest[2], turned[2])
    side = jnp.where(inner < 0, -1.0, 1.0).astype(inner.dtype)
    turned = [tuple(side * c for c in row) for row in turned]
    s2 = side * dot3(along, v)
    unique = s[1] - jnp.abs(s2) > 16.0 * float(jnp.finfo(s2.dtype).eps) * s[0]
    first, second, third = (tuple(row) for row in rest)
    return (first, second, third), (turned[0], turned[1], turned[2]), (s[0], s[1], s2), unique


def projection_stationarity(essential: Float[Array, "3 3"], matrix: Float[Array, "3 3"]) -> Float[Array, "5"]:
    """The five independent equations of (1): `essential` is nearest to `matrix` among those of its norm."""
    held = jax.lax.stop_gradient(essential)
    # tᵀE = 0: rows of cofactors are along Rᵀt, columns along t. Of the left rotations, that about t is a right one too.
    columns = cofactors(held).T
    squares = lane_sum(columns * columns, axis=1)
    longest = jnp.max(squares)
    usable = longest > 0
    upright = jnp.eye(3, dtype=held.dtype)[2]
    t = jnp.where(usable, columns[jnp.argmax(squares)] / jnp.sqrt(jnp.where(usable, longest, 1.0)), upright)
    first, second = (jnp.stack(direction) for direction in complement((t[0], t[1], t[2])))
    turn, right = _axial(matmul(matrix, essential.T)), _axial(matmul(essential.T, matrix))
    return jnp.concatenate([jnp.stack([jnp.sum(first * turn), jnp.sum(second * turn)]), right])


def _axial(x: Float[Array, "3 3"]) -> Float[Array, "3"]:
    skew = x - x.T
    return jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])


def _kernel(matrix: Float[Array, "3 3 *lanes"]) -> tuple[Array, Array]:
    rows, unique = nearest_essential(matrix_rows(matrix.reshape(9, *matrix.shape[2:])))
    return jnp.stack([jnp.stack(row) for row in rows])[None], unique[None]


_solve = lanes_last(_kernel)


def _candidates(matrix: Float[Array, "3 3"]) -> Candidates[Array]:
    models, valid = _solve(matrix)
    return Candidates(models=models, valid=valid)


def _equations(essential: Float[Array, "3 3"], matrix: Float[Array, "3 3"]) -> Float[Array, "5"]:
    # The scale of M does not matter, but its square may overflow.
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(matrix)))
    return projection_stationarity(essential, matrix / jnp.where(size > 0, size, 1.0))


_project = implicit(_candidates, _equations, perturb_essential, 5)
