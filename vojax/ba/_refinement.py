"""Refinement of one pose against many observations: the six-dof least squares behind every absolute-pose estimate.

Minimises ½Σ wᵢ ρ(‖Σᵢ^{-1/2}(π(T Xᵢ) − zᵢ)‖²) over T = cam_from_world (Scaramuzza & Fraundorfer 2011, eq. (10)). The
state is the camera-frame tangent ξ about a fixed pose T₀, T = exp(−ξ) T₀, so nothing in the loop sees world
coordinates.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from vojax._numerics import cholesky_solve, symmetric_inverse
from vojax._result import Result
from vojax._types import Array, ArrayLike, Bool, Float, Int
from vojax.lie import SE3
from vojax.solvers import Candidates, implicit, perturb_camera

from ._compressed import compressed_residual
from ._levenberg_marquardt import DenseDescent, LMOptions, minimize
from ._losses import Loss, Squared, robustify
from ._whitening import whiten, whitening


class _Observations(eqx.Module):
    """Observations by components, so that every array in the loop is contiguous over observations."""

    points: tuple[Array, Array, Array]  # frame of the starting camera
    measured: tuple[Array, ...]
    whitening: tuple[Array, ...]  # one: isotropic, 1/sigma; d(d+1)/2: rows of the lower triangle
    weight: Array | None


class Refinement(eqx.Module):
    """A refined model.

    Attributes:
        model: The pose `cam_from_world`.
        covariance: Of the camera-frame tangent ξ (translation first; the state is `world_from_cam @ exp(ξ)`), inverse
            of the Gauss–Newton matrix; zero where the problem is degenerate.
        cost: ½Σ w ρ at the model.
        iterations: Evaluations of the residuals.
        result: How it ended.
    """

    model: SE3
    covariance: Float[Array, "6 6"]
    cost: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Result


def refine_absolute_pose(
    cam_from_world: SE3,
    points_world: Float[ArrayLike, "n 3"],
    measurements: Float[ArrayLike, "n d"],
    camera: Any,
    *,
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    mask: Bool[ArrayLike, " n"] | None = None,
    weights: Float[ArrayLike, " n"] | None = None,
    loss: Loss = Squared(),
    options: LMOptions = LMOptions(),
) -> Refinement:
    """Refine a camera pose by Levenberg–Marquardt on the reprojection error.

    Args:
        cam_from_world: Where to start.
        points_world: Points, in the world frame.
        measurements: Pixels `[n, 2]`; or `[n, 3]` stereo measurements `(u_left, v, u_right)` when `camera` is a
            `RectifiedStereo`.
        camera: A camera of `vojax.cameras`.
        sigma_px: Standard deviation of the measurements in pixels, one for all or one per observation, or their
            covariances `[n, d, d]`. Uncertain points enter here: add J Σ_X Jᵀ.
        mask: False for observations to leave out.
        weights: Non-negative factor on each observation's loss.
        loss: Robust loss of the squared whitened residual.
        options: Of the optimiser.

    Returns:
        The refined pose with its covariance.

    Degenerate input: with fewer than three observations, or points on a line, the pose moves only along directions
        that have information; the result says `degenerate` and the covariance is zero.
    Differentiability: both modes, in the observations, camera and noise, by the implicit function theorem with the
        exact Hessian. The starting pose has derivative zero. Robust to `vmap`; batches run in lock-step.
    References: Scaramuzza & Fraundorfer, "Visual odometry, part I", 2011, eq. (10).
    """
    points_world, measurements = jnp.asarray(points_world), jnp.asarray(measurements)
    n, d = measurements.shape
    if points_world.shape != (n, 3):
        raise ValueError(f"points_world has shape {points_world.shape}: expected ({n}, 3), one for each measurement")
    dtype = jnp.result_type(points_world, measurements)
    weight = None if weights is None else jnp.asarray(weights, dtype)
    if mask is not None:
        weight = jnp.where(jnp.asarray(mask), 1.0 if weight is None else weight, 0.0).astype(dtype)
    data = (points_world.astype(dtype), measurements.astype(dtype), whitening(sigma_px, (n,), d, dtype), weight, camera)
    start = SE3(cam_from_world.wxyz_xyz.astype(dtype))
    model, iterations, converged = _solve(start, data, loss, options)
    hessian, cost = jax.lax.stop_gradient(_normal_equations(model, data, loss))
    covariance, regular = symmetric_inverse(hessian)
    result = Result.where(converged, Result.success, Result.not_converged)
    result = Result.where(regular, result, Result.degenerate)
    return Refinement(model, jnp.where(regular, covariance, 0.0), cost, iterations, result)


def polish_absolute_pose(
    cam_from_world: SE3,
    points_world: Float[ArrayLike, "n 3"],
    measurements: Float[ArrayLike, "n d"],
    camera: Any,
    *,
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    mask: Bool[ArrayLike, " n"] | None = None,
    loss: Loss = Squared(),
    steps: int = 4,
) -> SE3:
    """Improve a pose that is nearly right by a fixed number of Gauss–Newton steps.

    For many hypotheses in lock-step: no acceptance test and no stopping rule, so it is small to compile and every lane
    takes equally long. Whether the result is better is the caller's to check. Not meant to be differentiated; arguments
    as `refine_absolute_pose`.
    """
    points_world, measurements = jnp.asarray(points_world), jnp.asarray(measurements)
    n, d = measurements.shape
    dtype = cam_from_world.wxyz_xyz.dtype
    weight = None if mask is None else jnp.asarray(mask).astype(dtype)
    data = (points_world, measurements, whitening(sigma_px, (n,), d, dtype), weight, camera)

    def step(_: Any, pose: SE3) -> SE3:
        observations, camera = _observe(pose, data)
        moments = _accumulate(observations.points, observations, camera, loss)
        damped = moments[:6, :6] * (1.0 + 1e-4 * jnp.eye(6, dtype=dtype))
        increment, _ = cholesky_solve(damped, -moments[:6, 6:])
        return (SE3.exp(-increment[:, 0]) @ pose).normalize()

    return jax.lax.fori_loop(0, steps, step, cam_from_world)


def _observe(cam_from_world: SE3, data: Any) -> tuple[_Observations, Any]:
    points_world, measurements, whitening, weight, camera = data
    points = cam_from_world.apply(points_world)
    measured = tuple(measurements[:, i] for i in range(measurements.shape[1]))
    return _Observations((points[:, 0], points[:, 1], points[:, 2]), measured, whitening, weight), camera


def _residual(x: Array, y: Array, z: Array, observations: _Observations, camera: Any, loss: Loss) -> tuple[Array, ...]:
    """Whitened, robustified residual components of points in the camera frame."""
    raw = [p - m for p, m in zip(camera.project_xyz(x, y, z), observations.measured, strict=True)]
    white = whiten(observations.whitening, tuple(raw))
    return robustify(white, loss, observations.weight)


def _accumulate(points: Any, observations: _Observations, camera: Any, loss: Loss) -> Array:
    """[J r]ᵀ[J r] for a camera-frame perturbation of points that are already in the camera frame."""
    x, y, z = points
    residual, derivative = jax.linearize(lambda a, b, c: _residual(a, b, c, observations, camera, loss), x, y, z)
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)
    by_x, by_y, by_z = derivative(one, zero, zero), derivative(zero, one, zero), derivative(zero, zero, one)
    # X(ξ) = exp(−ξ) X has dX = −ρ + X × φ, so the row by φ is (a, b, c) × X.
    columns = [
        (-a, -b, -c, b * z - c * y, c * x - a * z, a * y - b * x, r)
        for r, a, b, c in zip(residual, by_x, by_y, by_z, strict=True)
    ]
    rows = jnp.concatenate([jnp.stack(column) for column in columns], axis=1)
    return jnp.matmul(rows, rows.T, precision="highest")


def _moments(increment: Array, args: Any) -> tuple[Array, Array]:
    observations, camera, loss = args
    matrix = SE3.exp(-increment).as_matrix()
    x, y, z = observations.points
    moved = tuple(matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z + matrix[i, 3] for i in range(3))
    return _accumulate(moved, observations, camera, loss), SE3.jacobian_right(increment)


_pose_residual = compressed_residual(_moments)


def _normal_equations(cam_from_world: SE3, data: Any, loss: Loss) -> tuple[Array, Array]:
    """Gauss–Newton matrix and cost at a pose."""
    observations, camera = _observe(cam_from_world, data)
    sums = _accumulate(observations.points, observations, camera, loss)
    return sums[:6, :6], 0.5 * sums[6, 6]


def _optimise(start: SE3, data: Any, loss: Loss, options: LMOptions) -> tuple[SE3, Array, Array]:
    observations, camera = _observe(start, data)
    solution = minimize(
        _pose_residual,
        jnp.zeros((6,), start.wxyz_xyz.dtype),
        (observations, camera, loss),
        DenseDescent(),
        options,
    )
    model = (SE3.exp(-solution.value) @ start).normalize()
    return model, solution.stats["num_steps"], solution.result == optx.RESULTS.successful


def _gradient(cam_from_world: SE3, found_data_loss: Any) -> Array:
    """Gradient of the cost by a camera-frame perturbation: the six equations that hold at the optimum."""
    _, data, loss = found_data_loss

    def cost(tangent: Array) -> Array:
        observations, camera = _observe(SE3.exp(-tangent) @ cam_from_world, data)
        residual = _residual(*observations.points, observations, camera, loss)
        return 0.5 * sum(jnp.sum(r * r) for r in residual)  # type: ignore[return-value]

    return jax.grad(cost)(jnp.zeros((6,), cam_from_world.wxyz_xyz.dtype))


def _as_candidate(found_data_loss: Any) -> Candidates[SE3]:
    return Candidates(SE3(found_data_loss[0].wxyz_xyz[None]), jnp.ones((1,), bool))


# The optimum is found beforehand; this gives it its derivative, with the exact Hessian of the cost.
_with_derivative = implicit(_as_candidate, _gradient, perturb_camera, 6)


def _solve(start: SE3, data: Any, loss: Loss, options: LMOptions) -> tuple[SE3, Array, Array]:
    found, iterations, converged = _optimise(*jax.lax.stop_gradient((start, data, loss)), options)
    model = SE3(_with_derivative((found, data, loss)).models.wxyz_xyz[0])
    return model, iterations, converged
