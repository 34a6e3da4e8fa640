"""Affine cameras from incomplete tracks: least squares in the cameras, with the points solved for in each step.

Every coordinate of a view is a row r with unknowns a_r = (m_r, t_r), and sees point j at m_r · X_j + t_r. The points
are linear least squares given the cameras, so the cost is a function of the cameras alone (variable projection). With
x̃ = (X, 1) and residuals e, its normal matrix is the Schur complement

    S = D - C P⁻¹ Cᵀ,    D_r = Σ_j x̃_j x̃_jᵀ,    P_j = Σ_r m_r m_rᵀ,    C_rj = x̃_j m_rᵀ  (- e_rj [I 0]ᵀ if exact)     (1)

over the entries that were seen. An affine map of space changes m_r to m_r B, t_r to t_r + m_r · b: twelve directions
that change nothing. Adding a multiple of M Mᵀ ⊗ I holds them, and changes no other component of a step.

References:
    G. Golub, V. Pereyra. The differentiation of pseudo-inverses and nonlinear least squares problems whose variables
    separate. SIAM J. Numer. Anal. 1973. T. Okatani, T. Yoshida, K. Deguchi. ICCV 2011.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve

from vojax._numerics import symmetric_inverse
from vojax._types import Array, Bool, Float

MAX_STEPS = 100


def place_points(
    cameras: Float[Array, "r 4"], w: Float[Array, "r p"], weights: Float[Array, "r p"]
) -> tuple[Float[Array, "p 3"], Float[Array, "p 3 3"]]:
    """The best points for given cameras, and P⁻¹ of each; zero for points that the cameras do not determine."""
    m, t = cameras[:, :3], cameras[:, 3:]
    normal = jnp.einsum("rp,rk,rl->klp", weights, m, m)
    inverse, regular = symmetric_inverse(normal)
    inverse = jnp.moveaxis(jnp.where(regular[None, None], inverse, 0.0), -1, 0)
    return jnp.einsum("pkl,lp->pk", inverse, m.T @ (weights * (w - t))), inverse


def normal_matrix(
    cameras: Float[Array, "r 4"],
    points: Float[Array, "p 3"],
    w: Float[Array, "r p"],
    weights: Float[Array, "r p"],
    exact: bool = False,
) -> tuple[Float[Array, "d d"], Float[Array, "d q"], Float[Array, "p 3 3"]]:
    """S of (1) with the gauge held, C, and P⁻¹ of each point; d = 4 r, q = 3 p."""
    rows, count = w.shape
    m = cameras[:, :3]
    seen = jnp.concatenate([points, jnp.ones_like(points[:, :1])], axis=1)
    _, inverse = place_points(cameras, w, weights)
    coupling = weights[:, None, :, None] * seen.T[None, :, :, None] * m[:, None, None, :]
    if exact:
        error = weights * (w - cameras @ seen.T)
        lift = jnp.eye(4, 3, dtype=w.dtype)
        coupling = coupling - error[:, None, :, None] * lift[None, :, None, :]
    half = jnp.einsum("rapk,pkl->rapl", coupling, inverse)
    coupling, half = coupling.reshape(4 * rows, 3 * count), half.reshape(4 * rows, 3 * count)
    blocks = jnp.einsum("rp,pa,pb->rab", weights, seen, seen)
    same = jnp.eye(rows, dtype=w.dtype)
    held = (count / rows) * (m @ m.T)
    diagonal = same[:, None, :, None] * blocks[:, :, None, :]
    gauge = held[:, None, :, None] * jnp.eye(4, dtype=w.dtype)[None, :, None, :]
    return (diagonal + gauge).reshape(4 * rows, 4 * rows) - half @ coupling.T, coupling, inverse


def regular_inverse(matrix: Float[Array, "d d"]) -> tuple[Callable[[Array], Array], Bool[Array, ""]]:
    """A function that solves with a positive definite matrix, and whether it is one, to working precision.

    Scaled to unit diagonal; pivots below 32 eps times the size are rounding. The function is finite in any case.
    """
    diagonal = jnp.diagonal(matrix)
    positive = jnp.all(jnp.isfinite(matrix)) & jnp.all(diagonal > 0)
    scale = jnp.where(positive, 1.0 / jnp.sqrt(jnp.where(positive, diagonal, 1.0)), 1.0)
    identity = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    scaled = jnp.where(positive, matrix * scale[:, None] * scale[None], identity)
    lower = jnp.linalg.cholesky(scaled)
    pivots = jnp.diagonal(lower) ** 2
    smallest = 32.0 * float(jnp.finfo(matrix.dtype).eps) * matrix.shape[0] ** 0.5
    regular = positive & jnp.all(pivots > smallest)  # False for NaN too
    lower = jnp.where(regular, lower, identity)
    return lambda rhs: scale * cho_solve((lower, True), scale * rhs), regular


def minimize(
    cameras: Float[Array, "r 4"], w: Float[Array, "r p"], weights: Float[Array, "r p"]
) -> tuple[Float[Array, "r 4"], Bool[Array, ""]]:
    """Levenberg-Marquardt on the cameras; the second value says whether it settled on a determined solution."""
    rows = w.shape[0]
    eps = float(jnp.finfo(w.dtype).eps)

    def cost(cameras: Array) -> tuple[Array, Array, Array]:
        points, _ = place_points(cameras, w, weights)
        seen = jnp.concatenate([points, jnp.ones_like(points[:, :1])], axis=1)
        error = weights * (w - cameras @ seen.T)
        return 0.5 * jnp.sum(error * error), error, points

    def body(state: tuple[Array, ...]) -> tuple[Array, ...]:
        cameras, damping, _, taken = state
        value, error, points = cost(cameras)
        matrix, _, _ = normal_matrix(cameras, points, w, weights)
        seen = jnp.concatenate([points, jnp.ones_like(points[:, :1])], axis=1)
        damped = matrix + damping * jnp.diag(jnp.diagonal(matrix))
        step = cho_solve(cho_factor(damped, lower=True), (error @ seen).reshape(-1)).reshape(cameras.shape)
        # A new basis of the same space: orthogonal columns keep all numbers near one.
        moved = cameras + step
        basis = rows**0.5 * jnp.linalg.qr(moved[:, :3])[0]
        moved = jnp.concatenate([basis, moved[:, 3:]], axis=1)
        # Where costs differ by rounding alone, steps still bring the gradient to zero. False for NaN.
        better = cost(moved)[0] <= value * (1.0 + 8.0 * eps)
        size = jnp.sqrt(jnp.mean(step * step))
        still = jnp.isfinite(size) & (size < 16.0 * eps**0.75) & (damping < 1e-2)
        damping = jnp.where(better, jnp.maximum(damping / 8.0, 1e-9), 4.0 * damping)
        return jnp.where(better, moved, cameras), damping, still, taken + 1

    def go_on(state: tuple[Array, ...]) -> Array:
        return ~state[2] & (state[3] < MAX_STEPS)

    first = (cameras, jnp.asarray(1e-3, w.dtype), jnp.asarray(False), jnp.asarray(0))
    cameras, _, settled, _ = jax.lax.while_loop(go_on, body, first)
    points, _ = place_points(cameras, w, weights)
    _, regular = regular_inverse(normal_matrix(cameras, points, w, weights)[0])
    return cameras, settled & regular
