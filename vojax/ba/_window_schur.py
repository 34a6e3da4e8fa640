"""Normal equations of a window on the full grid of cameras × landmarks, solved by eliminating the landmarks.

The matrix is the block arrow [[U, W], [Wᵀ, V]] with V block diagonal over landmarks and U block diagonal over cameras
but for a prior. With V = L Lᵀ and E = W L⁻ᵀ, eliminating the landmarks leaves S = U − E Eᵀ, six unknowns a camera
(Szeliski, "Computer Vision", section 11.4.3).

Landmarks are innermost: every small-matrix operation is elementwise over them. Unknowns of the cameras are ordered
[6, cameras], so that E is a matrix as it stands and the only large product, E Eᵀ, is one matrix multiplication.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from vojax._numerics import cholesky_factor
from vojax._types import Array, Bool, Float

from ._window_residual import Blocks, cross, dot


class ArrowSystem(eqx.Module):
    """Blocks of the normal equations and their right-hand side Jᵀr.

    `coupling` is what a prior adds to the cameras' part, and is None without one.
    """

    camera: Float[Array, "6 6 c"]
    landmark: Float[Array, "3 3 p"]
    cross: Float[Array, "6 c 3 p"]
    camera_gradient: Float[Array, "6 c"]
    landmark_gradient: Float[Array, "3 p"]
    coupling: Float[Array, "6 c 6 c"] | None

    def camera_diagonal(self) -> Float[Array, "6 c"]:
        """Diagonal of the cameras' part."""
        diagonal = self.camera[jnp.arange(6), jnp.arange(6)]
        if self.coupling is None:
            return diagonal
        return diagonal + _diagonal(self.coupling)

    def damped(self, damping: Float[Array, ""]) -> "ArrowSystem":
        """Scale the diagonal by 1 + λ."""
        eye6, eye3 = jnp.eye(6, dtype=damping.dtype), jnp.eye(3, dtype=damping.dtype)
        camera = self.camera + damping * eye6[..., None] * self.camera_diagonal()[None]
        landmark = self.landmark * (1.0 + damping * eye3[..., None])
        return eqx.tree_at(lambda system: (system.camera, system.landmark), self, (camera, landmark))


class Reduced(eqx.Module):
    """The camera system after elimination, factored."""

    factor: Float[Array, "u u"]
    scale: Float[Array, " u"]
    eliminated: tuple[Array, ...]  # E [u, p] for each coordinate of the landmarks
    landmark_root: tuple[Array, ...]  # L⁻¹ of the landmark blocks, row by row
    regular: Bool[Array, ""]

    def solve_cameras(self, rhs: Float[Array, "u k"]) -> Float[Array, "u k"]:
        """Solve S x = rhs."""
        scaled = jax.scipy.linalg.cho_solve((self.factor, True), self.scale[:, None] * rhs)
        return self.scale[:, None] * scaled


def reduce(system: ArrowSystem) -> Reduced:
    """Eliminate the landmarks and factor what is left.

    Cameras without information (fixed, or seeing nothing) and landmarks without information get an increment of zero.
    If S is not positive definite in working precision, `regular` is False and the factor is the identity.
    """
    c, p = system.camera.shape[-1], system.landmark.shape[-1]
    root = _inverse_root(system.landmark)
    # Not one matrix [u, 3 p]: putting it together takes XLA longer than the product.
    eliminated = _times_root(root, tuple(system.cross[:, :, i].reshape(6 * c, p) for i in range(3)))
    full = _spread(system.camera).reshape(6 * c, 6 * c)
    if system.coupling is not None:
        full = full + system.coupling.reshape(6 * c, 6 * c)
    full = full - sum(jnp.matmul(e, e.T, precision="highest") for e in eliminated)
    # Jacobi scaling makes metres and radians comparable, which float32 needs.
    diagonal = system.camera_diagonal().reshape(-1)
    informed = diagonal > 0
    scale = jnp.where(informed, jax.lax.rsqrt(jnp.where(informed, diagonal, 1.0)), 0.0)
    scaled = scale[:, None] * full * scale[None, :] + jnp.diag(jnp.where(informed, 0.0, 1.0).astype(full.dtype))
    # LAPACK takes columns first: the other triangle, which is the same, is written as it is read.
    factor = jnp.linalg.cholesky(scaled.T, symmetrize_input=False)
    regular = jnp.isfinite(factor[-1, -1])  # all of it is NaN where the factorisation failed
    factor = jnp.where(regular, factor, jnp.eye(6 * c, dtype=full.dtype))
    return Reduced(factor, scale, eliminated, root, regular)


def solve(system: ArrowSystem) -> tuple[Float[Array, "6 c"], Float[Array, "3 p"]]:
    """Solve the normal equations for −(camera, landmark) gradient.

    Where the reduced system cannot be factored, the cameras' answer is the diagonally scaled gradient step, which is
    finite.
    """
    c = system.camera.shape[-1]
    reduced = reduce(system)
    halved = _times_root(reduced.landmark_root, tuple(system.landmark_gradient))
    rhs = sum(jnp.matmul(e, h, precision="highest") for e, h in zip(reduced.eliminated, halved, strict=True))
    rhs = rhs - system.camera_gradient.reshape(6 * c)
    cameras = reduced.solve_cameras(rhs[:, None])[:, 0]
    diagonal = system.camera_diagonal()
    informed = diagonal > 0
    fallback = jnp.where(informed, -system.camera_gradient / jnp.where(informed, diagonal, 1.0), 0.0)
    cameras = jnp.where(reduced.regular, cameras, fallback.reshape(6 * c))
    # V η = −g − Wᵀ ξ is Lᵀ η = −(L⁻¹ g + Eᵀ ξ).
    halved = [h + jnp.matmul(cameras, e, precision="highest") for h, e in zip(halved, reduced.eliminated, strict=True)]
    return cameras.reshape(6, c), -_times_root_transposed(reduced.landmark_root, halved)


def camera_covariances(system: ArrowSystem) -> tuple[Float[Array, "c 6 6"], Bool[Array, ""]]:
    """Marginal covariances of the cameras: the diagonal blocks of S⁻¹; zero for cameras that are fixed.

    False, and zeros, where a pivot of S is within the rounding error of what elimination took from it: the direction
    has no information, whether or not the factorisation came through.
    """
    c = system.camera.shape[-1]
    reduced = reduce(system)
    # In scaled form the diagonal was one before. A free scale leaves up to 60 eps with three cameras; windows that
    # determine their cameras have 0.01.
    pivots = jnp.where(reduced.scale > 0, jnp.diag(reduced.factor) ** 2, 1.0)
    regular = reduced.regular & (jnp.min(pivots) > 8 * len(pivots) * float(jnp.finfo(pivots.dtype).eps))
    full = reduced.solve_cameras(jnp.diag(jnp.where(reduced.scale > 0, 1.0, 0.0).astype(reduced.scale.dtype)))
    blocks = jnp.sum(full.reshape(6, c, 6, c) * jnp.eye(c, dtype=full.dtype)[None, :, None], axis=3)
    return jnp.where(regular, blocks.transpose(1, 0, 2), 0.0), regular


def normal_equations(blocks: Blocks) -> ArrowSystem:
    """Gauss–Newton's, from the derivatives in the observed points.

    A point X in the camera's frame moves by −ρ − φ × X + R η, so with A = Σ aᵀa over the rows a of its derivative, the
    rows of W are −A R and (A R) × X, and those of U follow with −1 and X × in place of R.
    """
    a, x, rotation, free = blocks.by_point, blocks.point, blocks.rotation, blocks.free
    c, three, turn = free.shape[0], range(3), rotation[..., None]
    # Components one by one, in the lanes, and stacked where they are used more than once: see `linearize`.
    normal = [[sum(row[i] * row[j] for row in a) for j in three] for i in three]
    normal = jnp.stack([jnp.stack(row) for row in normal])  # A: [3, 3, c, p]
    by_point = jnp.stack([sum(row[i] * r for row, r in zip(a, blocks.residual, strict=True)) for i in three])
    turned = jnp.stack([jnp.stack([dot(normal[i], turn[:, j]) for j in three]) for i in three])  # A R
    rows = jnp.concatenate([-turned, cross(turned, x[:, None])])
    by_turn = cross(normal, x[:, None])  # [X]×ᵀ A
    corner = _total(cross(by_turn.swapaxes(0, 1), x[:, None]))
    straight, mixed = _total(normal), -_total(by_turn)
    camera = jnp.concatenate(
        [jnp.concatenate([straight, mixed.swapaxes(0, 1)], axis=1), jnp.concatenate([mixed, corner], axis=1)]
    )
    camera_gradient = jnp.concatenate([-_total(by_point), _total(cross(by_point, x))])
    landmark = [[jnp.sum(dot(turn[:, i], turned[:, j]), axis=0) for j in three] for i in three]
    landmark_gradient = [jnp.sum(dot(turn[:, i], by_point), axis=0) for i in three]
    prior = blocks.prior_by_pose
    coupling = None
    if prior.shape[0]:
        m = prior.reshape(prior.shape[0], 6 * c)
        coupling = jnp.matmul(m.T, m, precision="highest").reshape(6, c, 6, c)
        change = jnp.matmul(blocks.prior_residual, m, precision="highest").reshape(6, c)
    else:
        change = jnp.zeros((), x.dtype)
    return ArrowSystem(
        camera * free[None, None],
        jnp.stack([jnp.stack(row) for row in landmark]),
        (rows * free[None, None, :, None]).swapaxes(1, 2),
        camera_gradient * free[None] + change,
        jnp.stack(landmark_gradient),
        coupling,
    )


class SchurDescent(optx.AbstractDescent):
    """Levenberg–Marquardt step of a window: landmarks eliminated, cameras solved densely, landmarks put back."""

    def init(self, y: Any, f_info_struct: Any) -> ArrowSystem:
        """Zeros of the right shape."""
        blocks = f_info_struct
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(normal_equations, blocks))

    def query(self, y: Any, f_info: Any, state: Any) -> ArrowSystem:
        """Form the blocks at a newly accepted point."""
        del y, state
        return normal_equations(f_info.jac)

    def step(self, step_size: Any, state: ArrowSystem) -> tuple[Any, optx.RESULTS]:
        """Solve for the step at damping 1/step_size."""
        return solve(state.damped(1.0 / step_size)), optx.RESULTS.successful


def _total(x: Float[Array, "*rows p"]) -> Float[Array, "*rows"]:
    """Sum over landmarks as a product with ones: XLA cuts sums of more than 32 numbers into two passes."""
    return jnp.matmul(x, jnp.ones(x.shape[-1:], x.dtype), precision="highest")


def _diagonal(coupling: Float[Array, "6 c 6 c"]) -> Float[Array, "6 c"]:
    c = coupling.shape[-1]
    return jnp.diagonal(coupling.reshape(6 * c, 6 * c)).reshape(6, c)


def _spread(blocks: Float[Array, "6 6 c"]) -> Float[Array, "6 c 6 c"]:
    c = blocks.shape[-1]
    on_diagonal = jnp.eye(c, dtype=bool)[None, :, None, :]
    return jnp.where(on_diagonal, blocks.swapaxes(1, 2)[..., None], 0.0)


def _inverse_root(matrix: Float[Array, "3 3 *lanes"]) -> tuple[Array, ...]:
    """L⁻¹ of M = L Lᵀ, row by row; rows without information are zero."""
    columns, inverse, _ = cholesky_factor(matrix)
    a, b, c = inverse
    low = -b * columns[0][1] * a
    return a, low, b, -c * (columns[0][2] * a + columns[1][1] * low), -c * columns[1][1] * b, c


def _times_root(root: tuple[Array, ...], x: tuple[Array, ...]) -> tuple[Array, ...]:
    """L⁻¹ x for landmarks in the lanes; x may have an axis before them."""
    if x[0].ndim == 2:
        root = tuple(entry[None] for entry in root)
    return root[0] * x[0], root[1] * x[0] + root[2] * x[1], root[3] * x[0] + root[4] * x[1] + root[5] * x[2]


def _times_root_transposed(root: tuple[Array, ...], x: list[Array]) -> Float[Array, "3 p"]:
    return jnp.stack(
        [root[0] * x[0] + root[1] * x[1] + root[3] * x[2], root[2] * x[1] + root[4] * x[2], root[5] * x[2]]
    )
