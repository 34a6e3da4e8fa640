"""Normal equations of bundle adjustment on a full grid of cameras × landmarks, solved by eliminating the landmarks.

The matrix is the block arrow [[U, W], [Wᵀ, V]] with U block diagonal over cameras and V over landmarks. Eliminating the
landmarks leaves S = U − W V⁻¹ Wᵀ, six unknowns a camera (Szeliski, "Computer Vision", section 11.4.3).

Axes are [rows, columns, cameras, landmarks], landmarks innermost: every small-matrix operation is elementwise over
landmarks, and the only large product, W V⁻¹ Wᵀ, is one matrix multiplication.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from vojax._numerics import symmetric_inverse
from vojax._types import Array, Bool, Float


class ArrowSystem(eqx.Module):
    """Blocks of the normal equations and their right-hand side J ᵀr."""

    camera: Float[Array, "6 6 c"]
    landmark: Float[Array, "3 3 p"]
    cross: Float[Array, "6 3 c p"]
    camera_gradient: Float[Array, "6 c"]
    landmark_gradient: Float[Array, "3 p"]

    def damped(self, damping: Float[Array, ""]) -> "ArrowSystem":
        """Scale the diagonal by 1 + λ."""
        camera = self.camera * (1.0 + damping * jnp.eye(6, dtype=damping.dtype)[:, :, None])
        landmark = self.landmark * (1.0 + damping * jnp.eye(3, dtype=damping.dtype)[:, :, None])
        return eqx.tree_at(lambda system: (system.camera, system.landmark), self, (camera, landmark))


class Reduced(eqx.Module):
    """The camera system after elimination, factored."""

    factor: Float[Array, "d d"]
    scale: Float[Array, " d"]
    eliminated: Float[Array, "6 3 c p"]
    landmark_inverse: Float[Array, "3 3 p"]
    regular: Bool[Array, ""]

    def solve_cameras(self, rhs: Float[Array, "d k"]) -> Float[Array, "d k"]:
        """Solve S x = rhs."""
        scaled = jax.scipy.linalg.cho_solve((self.factor, True), self.scale[:, None] * rhs)
        return self.scale[:, None] * scaled


def reduce(system: ArrowSystem) -> Reduced:
    """Eliminate the landmarks and factor what is left.

    Cameras without information (fixed, or seeing nothing) and landmarks without information get an increment of zero.
    If S is not positive definite in working precision, `regular` is False and the factor is the identity.
    """
    dtype = system.camera.dtype
    c, p = system.cross.shape[2:]
    inverse, _ = symmetric_inverse(system.landmark)
    eliminated = jnp.sum(system.cross[:, :, None] * inverse[None, :, :, None, :], axis=1)  # W V⁻¹: [6, 3, c, p]
    flat = (2, 0, 3, 1)  # [c, 6, p, 3]
    left = eliminated.transpose(flat).reshape(6 * c, 3 * p)
    right = system.cross.transpose(flat).reshape(6 * c, 3 * p)
    blocks = jnp.zeros((c, 6, c, 6), dtype)
    cameras = jnp.arange(c)
    blocks = blocks.at[cameras, :, cameras, :].set(system.camera.transpose(2, 0, 1))
    full = blocks.reshape(6 * c, 6 * c) - jnp.matmul(left, right.T, precision="highest")
    # Jacobi scaling makes metres and radians comparable, which float32 needs.
    diagonal = system.camera[jnp.arange(6), jnp.arange(6)].T.reshape(-1)
    informed = diagonal > 0
    scale = jnp.where(informed, jax.lax.rsqrt(jnp.where(informed, diagonal, 1.0)), 0.0)
    scaled = scale[:, None] * full * scale[None, :] + jnp.diag(jnp.where(informed, 0.0, 1.0).astype(dtype))
    factor = jnp.linalg.cholesky(scaled, symmetrize_input=True)
    regular = jnp.all(jnp.isfinite(factor))
    factor = jnp.where(regular, factor, jnp.eye(6 * c, dtype=dtype))
    return Reduced(factor, scale, eliminated, inverse, regular)


def solve(system: ArrowSystem) -> tuple[Float[Array, "c 6"], Float[Array, "p 3"]]:
    """Solve the normal equations for −(camera, landmark) gradient.

    Where the reduced system cannot be factored, the answer is the diagonally scaled gradient step, which is finite.
    """
    reduced = reduce(system)
    c = system.cross.shape[2]
    rhs = -system.camera_gradient + jnp.sum(reduced.eliminated * system.landmark_gradient[None, :, None, :], (1, 3))
    cameras = reduced.solve_cameras(rhs.T.reshape(6 * c, 1)).reshape(c, 6)
    cameras = jnp.where(reduced.regular, cameras, 0.0)
    diagonal = system.camera[jnp.arange(6), jnp.arange(6)].T
    fallback = jnp.where(diagonal > 0, -system.camera_gradient.T / jnp.where(diagonal > 0, diagonal, 1.0), 0.0)
    cameras = jnp.where(reduced.regular, cameras, fallback)
    # V η = −g − Wᵀ ξ, landmark by landmark.
    remaining = -system.landmark_gradient - jnp.sum(system.cross * cameras.T[:, None, :, None], axis=(0, 2))
    landmarks = jnp.sum(reduced.landmark_inverse * remaining[None], axis=1)
    return cameras, landmarks.T


def camera_covariances(system: ArrowSystem) -> tuple[Float[Array, "c 6 6"], Bool[Array, ""]]:
    """Marginal covariances of the cameras: the diagonal blocks of S⁻¹; zero for cameras that are fixed."""
    reduced = reduce(system)
    c = system.cross.shape[2]
    full = reduced.solve_cameras(jnp.diag(jnp.where(reduced.scale > 0, 1.0, 0.0).astype(reduced.scale.dtype)))
    blocks = full.reshape(c, 6, c, 6)[jnp.arange(c), :, jnp.arange(c), :]
    return jnp.where(reduced.regular, blocks, 0.0), reduced.regular


class _SchurState(eqx.Module):
    system: ArrowSystem


class SchurDescent(optx.AbstractDescent):
    """Levenberg–Marquardt step of a bundle: landmarks eliminated, cameras solved densely, landmarks substituted back.

    Works on `y = (camera increments [c, 6], landmark increments [p, 3])` and a tuple of residual components `[c, p]`.
    Each residual depends on one camera and one landmark, so six and three products with tangents of ones give every
    block of the Jacobian exactly.
    """

    def init(self, y: Any, f_info_struct: Any) -> _SchurState:
        """Zeros of the right shape."""
        del f_info_struct
        (c, _), (p, _) = y[0].shape, y[1].shape
        zeros = lambda *shape: jnp.zeros(shape, y[0].dtype)  # noqa: E731
        return _SchurState(ArrowSystem(zeros(6, 6, c), zeros(3, 3, p), zeros(6, 3, c, p), zeros(6, c), zeros(3, p)))

    def query(self, y: Any, f_info: Any, state: _SchurState) -> _SchurState:
        """Form the blocks at a newly accepted point."""
        del state
        return _SchurState(arrow_system(y, f_info.residual, f_info.jac.mv))

    def step(self, step_size: Any, state: _SchurState) -> tuple[Any, optx.RESULTS]:
        """Solve for the increment at damping 1/step_size."""
        return solve(state.system.damped(1.0 / step_size)), optx.RESULTS.successful


def arrow_system(y: Any, residual: tuple[Array, ...], jvp: Any) -> ArrowSystem:
    """Blocks from residual components `[c, p]` and the product with their Jacobian."""
    cameras, landmarks = y
    r = jnp.stack(residual)  # [d, c, p]
    by_camera = jnp.stack(
        [jnp.stack(jvp((jnp.zeros_like(cameras).at[:, i].set(1.0), jnp.zeros_like(landmarks)))) for i in range(6)]
    )
    by_landmark = jnp.stack(
        [jnp.stack(jvp((jnp.zeros_like(cameras), jnp.zeros_like(landmarks).at[:, i].set(1.0)))) for i in range(3)]
    )
    return ArrowSystem(
        camera=jnp.sum(by_camera[:, None] * by_camera[None], axis=(2, 4)),
        landmark=jnp.sum(by_landmark[:, None] * by_landmark[None], axis=(2, 3)),
        cross=jnp.sum(by_camera[:, None] * by_landmark[None], axis=2),
        camera_gradient=jnp.sum(by_camera * r[None], axis=(1, 3)),
        landmark_gradient=jnp.sum(by_landmark * r[None], axis=(1, 2)),
    )
