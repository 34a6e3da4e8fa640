"""Rigid motion between two point sets with a covariance for every point, in both sets.

With e_i = y_i - (R x_i + t), cov(y_i) = C1_i and cov(x_i) = C0_i, the maximum-likelihood motion minimises

    1/2 sum_i e_iᵀ V_i⁻¹ e_i,      V_i = C1_i + R C0_i Rᵀ.                                                      (1)

V turns with R, and its derivative belongs to the gradient: with u_i = V_i⁻¹ e_i that is

    -sum_i (u_i, R x̂_i x u_i),      x̂_i = x_i + C0_i Rᵀ u_i,                                                    (2)

where x̂_i is where the measurements say that the point is. So Gauss-Newton steps with x̂ for x (those of the
errors-in-variables model, a 6x6 system whitened by V) end exactly at the minimum of (1); with x they would end where
the weights, held still, are optimal, which is somewhere else. They start at `procrustes` with weights 1 / tr V.

References:
    L. Matthies, S. Shafer. Error modeling in stereo navigation. IEEE JRA 1987.
    N. Ohta, K. Kanatani. Optimal estimation of three-dimensional rotation and reliability evaluation. ECCV 1998.
    A. Segal, D. Haehnel, S. Thrun. Generalized-ICP. RSS 2009 (the same cost).
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from vojax._numerics import Vector3, symmetric_inverse
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import Components, Rows3, rotate
from ._implicit import implicit, perturb_camera
from ._information_alignment import (
    information,
    normal_equations,
    rotation_rows,
    solve_step,
    symmetric_rows,
    times,
    total,
    turn,
    turned,
)
from ._lanes import lanes_last
from ._procrustes import alignment_kernel
from ._weighted_points import centred_components, normal_weights

# Points 0 and 1, their covariances, weights (one, or zero for a point that is not there).
Data = tuple[Array, Array, Array, Array, Array]


def whitened_residuals(
    wxyz: Components, offset: Vector3, x: Components, y: Components, c0: Rows3, c1: Rows3
) -> tuple[Vector3, Vector3, Rows3, Array]:
    """R x̂, u and V⁻¹ of (2) by components [n, *lanes], for y = R x + offset; which V are positive definite."""
    rows = rotation_rows(tuple(c[None] for c in wxyz))
    turned0 = turned(rows, c0)
    weight, regular = information(total(c1, turned0))
    moved = times(rows, (x[0], x[1], x[2]))
    e = tuple(y[i] - moved[i] - offset[i][None] for i in range(3))
    u = times(weight, e)
    shift = times(turned0, u)
    return tuple(moved[i] + shift[i] for i in range(3)), u, weight, regular


def anisotropic_kernel(iterations: int) -> Callable[..., tuple[Array, Array]]:
    """The solver on arrays [n, 3, *lanes], covariances [n, 3, 3, *lanes], weights [n, *lanes]."""
    start = alignment_kernel(with_scale=False)

    def kernel(
        points0: Array, points1: Array, covariance0: Array, covariance1: Array, weights: Array
    ) -> tuple[Array, Array]:
        trace = sum((c[:, i, i] for c in (covariance0, covariance1) for i in range(3)), jnp.zeros_like(weights))
        first = jnp.where(trace > 0, weights / jnp.where(trace > 0, trace, 1.0), 0.0)
        poses, valid = start(points0, points1, first)
        present = weights > 0
        _, ok = normal_weights(first, points0, points1)
        ok = ok & valid[0] & jnp.all(jnp.isfinite(weights), axis=0)
        for covariance in (covariance0, covariance1):
            ok = ok & jnp.all(jnp.isfinite(covariance), axis=(0, 1, 2))
        even, _ = normal_weights(jnp.where(ok[None], first, 1.0))
        x, mean0 = centred_components(points0, even, ok)
        y, mean1 = centred_components(points1, even, ok)
        c0, c1 = (
            symmetric_rows(
                jnp.where(ok[None, None, None], c, jnp.eye(3, dtype=c.dtype).reshape(1, 3, 3, *(1,) * ok.ndim))
            )
            for c in (covariance0, covariance1)
        )
        factor = jnp.where(ok[None], weights, 0.0)
        wxyz = tuple(poses[0, i] for i in range(4))
        moved = rotate(wxyz, mean0)
        offset = tuple(jnp.where(ok, poses[0, 4 + i] + moved[i] - mean1[i], 0.0) for i in range(3))

        def residuals(wxyz: Components, offset: Components) -> tuple[Array, ...]:
            p, u, weight, definite = whitened_residuals(wxyz, (offset[0], offset[1], offset[2]), x, y, c0, c1)
            return (*p, *u, *weight[0], *weight[1][1:], weight[2][2], definite)

        # The residuals are carried from step to step, because XLA would compute them again in each of the 27 sums.
        def iterate(_: object, state: tuple[Components, Components, Components, Components]) -> tuple[Components, ...]:
            wxyz, offset, parts, _ = state
            a00, a01, a02, a11, a12, a22, definite = parts[6:]
            weight = ((a00, a01, a02), (a01, a11, a12), (a02, a12, a22))
            normal, rhs = normal_equations(parts[:3], parts[3:6], weight, factor)
            step, regular = solve_step(normal, rhs)
            wxyz = turn(wxyz, (step[3], step[4], step[5]))
            offset = tuple(offset[i] + step[i] for i in range(3))
            regular = regular & jnp.all(definite | ~present, axis=0)
            squares = (step * rhs, step[3:] * step[3:], step[:3] * step[:3])
            sizes = (regular, *(jnp.sum(square, axis=0) for square in squares))
            return wxyz, offset, residuals(wxyz, offset), sizes

        large = jnp.full_like(wxyz[0], jnp.inf)
        # The first round has nothing to go by, does not move and fills in the residuals.
        nothing = (*(jnp.zeros_like(factor) for _ in range(12)), jnp.zeros_like(present))
        state = (wxyz, offset, nothing, (jnp.zeros_like(ok), large, large, large))
        wxyz, offset, _, (regular, decrease, angle2, shift2) = jax.lax.fori_loop(0, iterations + 1, iterate, state)
        eps = float(jnp.finfo(wxyz[0].dtype).eps)
        size2 = jnp.sum(even * sum((c * c for c in (*x, *y)), jnp.zeros_like(even)), axis=0)
        # Converged: the last step was a hundredth of a standard deviation, or next to rounding.
        still = (angle2 < eps) & (shift2 < eps * size2)
        ok = ok & regular & ((decrease < 1e-4) | still)
        moved = rotate(wxyz, mean0)
        model = (*wxyz, *(mean1[i] + offset[i] - moved[i] for i in range(3)))
        for c in model:
            ok = ok & jnp.isfinite(c)
        model = tuple(jnp.where(ok, c, 1.0 if i == 0 else 0.0) for i, c in enumerate(model))
        return jnp.stack(model)[None], ok[None]

    return kernel


def _at(model: SE3, data: Data) -> tuple[Vector3, Vector3, Rows3, Array, Vector3]:
    """`whitened_residuals` of one problem about the mean of the points, their weights, and that mean in frame 1."""
    points0, points1, covariance0, covariance1, weights = data
    held = jax.lax.stop_gradient(weights)
    centre = jnp.sum(held[:, None] * points0, axis=0) / jnp.maximum(jnp.sum(held), 1.0)
    wxyz = tuple(model.wxyz_xyz[i] for i in range(4))
    middle = model @ centre
    x = tuple(points0[:, i] - centre[i] for i in range(3))
    y = tuple(points1[:, i] - middle[i] for i in range(3))
    c0, c1 = symmetric_rows(covariance0), symmetric_rows(covariance1)
    nothing = jnp.zeros_like(centre)
    p, u, weight, _ = whitened_residuals(wxyz, (nothing[0], nothing[1], nothing[2]), x, y, c0, c1)
    return p, u, weight, weights, (middle[0], middle[1], middle[2])


def exact_stationarity(model: SE3, data: Data) -> Array:
    """The gradient (2) of the exact cost, about the mean of the points."""
    p, u, _, weights, _ = _at(model, data)
    torque = (p[1] * u[2] - p[2] * u[1], p[2] * u[0] - p[0] * u[2], p[0] * u[1] - p[1] * u[0])
    return jnp.stack([jnp.sum(weights * c) for c in (*u, *torque)])


@functools.cache
def anisotropic_solver(iterations: int) -> Callable[[Data], Candidates[SE3]]:
    """The solver with its derivative, for a number of Gauss-Newton steps; weights of zero leave points out."""
    solve = lanes_last(anisotropic_kernel(iterations))

    def candidates(data: Data) -> Candidates[SE3]:
        models, valid = solve(*data)
        return Candidates(models=SE3(models), valid=valid)

    return implicit(candidates, exact_stationarity, perturb_camera, 6)


def _checked(points0: ArrayLike, points1: ArrayLike, covariance0: ArrayLike, covariance1: ArrayLike) -> Data:
    arrays = [jnp.asarray(x) for x in (points0, points1, covariance0, covariance1)]
    n = arrays[0].shape[0]
    for array, expected in zip(arrays, ((n, 3), (n, 3), (n, 3, 3), (n, 3, 3)), strict=True):
        if array.shape != expected:
            raise ValueError(f"found an array of shape {array.shape}; expected {expected} beside {n} points")
    if n < 3:
        raise ValueError(f"found {n} points; expected at least 3 to align two point sets")
    dtype = jnp.result_type(*arrays)
    points0, points1, covariance0, covariance1 = (x.astype(dtype) for x in arrays)
    return points0, points1, covariance0, covariance1, jnp.ones(n, dtype)


def procrustes_anisotropic(
    points0: Float[ArrayLike, "n 3"],
    points1: Float[ArrayLike, "n 3"],
    covariance0: Float[ArrayLike, "n 3 3"],
    covariance1: Float[ArrayLike, "n 3 3"],
    iterations: int = 10,
) -> Candidates[SE3]:
    """Find the most likely rigid motion that takes `points0` to `points1`, given the covariance of every point.

    For points from stereo or a depth camera, whose noise is large along the ray and grows with distance, a weight per
    point says too little: the direction matters.

    Args:
        points0: Points in frame 0, one per row, at least three.
        points1: The same points in frame 1.
        covariance0: Covariances of `points0`, in frame 0; the lower triangle is not read. May be zero.
        covariance1: Covariances of `points1`, in frame 1; the sum of both must be positive definite.
        iterations: Gauss-Newton steps. They converge linearly, the faster the smaller the noise is against the
            extent of the points; ten leave less than 1e-4 of the gradient at a noise of a fifth of it.

    Returns:
        One slot with `frame1_from_frame0`: `points1 ≈ model @ points0`. Its covariance: `alignment_covariance`.

    Degenerate input: points that are coincident or collinear to rounding, covariances whose sum is not positive
        definite to rounding (standard deviations a few hundred times longer in one direction than in another in
        float32), steps that have not converged and anything not finite leave the slot invalid with the identity in it.
    Differentiability: both modes, any order, in points and covariances, by the implicit function theorem through the
        exact cost. Zero for an invalid slot.

    Raises:
        ValueError: If there are fewer than three points or the arrays do not match.
    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 4.0], [1.0, 0.0, 5.0], [0.0, 2.0, 6.0], [1.0, 1.0, 9.0]])
        >>> covariance = jnp.eye(3)[None] * jnp.array([0.01, 0.01, 0.3])[None, :, None] * jnp.ones((4, 1, 1))
        >>> candidates = procrustes_anisotropic(points, points + 1.0, covariance, covariance)
        >>> bool(jnp.allclose(candidates.models.translation(), 1.0, atol=1e-4))
        True
    """
    return anisotropic_solver(iterations)(_checked(points0, points1, covariance0, covariance1))


def alignment_covariance(
    frame1_from_frame0: SE3,
    points0: Float[ArrayLike, "n 3"],
    points1: Float[ArrayLike, "n 3"],
    covariance0: Float[ArrayLike, "n 3 3"],
    covariance1: Float[ArrayLike, "n 3 3"],
) -> Float[Array, "6 6"]:
    """Covariance of a rigid motion estimated by `procrustes_anisotropic`: the inverse of its Gauss-Newton matrix.

    Args:
        frame1_from_frame0: The estimate, one pose: a slot of the solver's answer.
        points0: Points in frame 0.
        points1: The same points in frame 1.
        covariance0: Covariances of `points0`.
        covariance1: Covariances of `points1`.

    Returns:
        Covariance of the tangent ξ = (ρ, φ) in frame 1, `exp(-ξ) @ frame1_from_frame0`. As true as the covariances of
        the points. Zero where a direction has no information.

    Differentiability: both modes.

    Raises:
        ValueError: If the arrays do not match.
    """
    data = _checked(points0, points1, covariance0, covariance1)
    p, u, weight, weights, middle = _at(frame1_from_frame0, data)
    normal, _ = normal_equations(p, u, weight, weights)
    covariance, regular = symmetric_inverse(normal)
    covariance = jnp.where(regular & jnp.all(jnp.isfinite(normal)), covariance, 0.0)
    # About the middle of the points it is well conditioned; from there to the origin of frame 1.
    x, y, z = middle
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    shift = jnp.stack(
        [
            jnp.stack([one, zero, zero, zero, -z, y]),
            jnp.stack([zero, one, zero, z, zero, -x]),
            jnp.stack([zero, zero, one, -y, x, zero]),
            *jnp.eye(6, dtype=x.dtype)[3:],
        ]
    )
    return shift @ covariance @ shift.T
