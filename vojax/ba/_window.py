"""Sliding-window bundle adjustment: poses and landmarks of a few keyframes together, against all their measurements.

Every window has the same shape [keyframes, landmarks] and says by a mask what was seen, so one compilation serves a
whole sequence. The solve is anchored: the origin moves to the oldest keyframe, and float32 never sees absolute
coordinates.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from vojax._result import Result
from vojax._types import Array, ArrayLike, Bool, Float, Int
from vojax.lie import SE3

from . import _schur
from ._levenberg_marquardt import LMOptions, minimize
from ._losses import Huber, Loss, robustify
from ._whitening import whiten, whitening


class Window(eqx.Module):
    """An adjusted window.

    Attributes:
        world_from_cam: Poses of the keyframes.
        points_world: Landmarks; those without enough measurements are where they were.
        pose_covariances: Marginal covariances of the camera-frame tangents (translation first), given the fixed
            keyframes; zero for fixed keyframes and for degenerate windows.
        initial_cost: ½Σρ before.
        cost: ½Σρ after.
        iterations: Evaluations of the residuals.
        result: How it ended.
    """

    world_from_cam: SE3
    points_world: Float[Array, "p 3"]
    pose_covariances: Float[Array, "c 6 6"]
    initial_cost: Float[Array, ""]
    cost: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Result


def adjust_window(
    world_from_cam: SE3,
    points_world: Float[ArrayLike, "p 3"],
    measurements: Float[ArrayLike, "c p d"],
    mask: Bool[ArrayLike, "c p"],
    camera: Any,
    *,
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    fixed: Bool[ArrayLike, " c"] | None = None,
    loss: Loss = Huber(),
    options: LMOptions = LMOptions(),
) -> Window:
    """Adjust keyframe poses and landmarks by Levenberg–Marquardt with landmark elimination.

    Args:
        world_from_cam: Poses of the keyframes, oldest first `[c]`.
        points_world: Landmarks, in the world frame.
        measurements: Measured projections of every landmark in every keyframe: pixels `(u, v)`, or
            `(u_left, v, u_right)` with a `RectifiedStereo`. Entries that the mask excludes must be finite.
        mask: True where a landmark was measured.
        camera: A camera of `vojax.cameras`, the same for all keyframes.
        sigma_px: Standard deviation of a measurement's components in pixels: a scalar, `[c, p]`, or covariances
            `[c, p, d, d]`.
        fixed: Keyframes that stay. None fixes the first; with pixels only, fix two, or scale is free.
        loss: Robust loss of the squared whitened residual.
        options: Of the optimiser.

    Returns:
        The adjusted window.

    Degenerate input: cameras and landmarks without information do not move. A window with a free keyframe that its
        measurements do not determine ends as `degenerate` with zero covariances: pad with fixed keyframes.
    Differentiability: both modes, in the measurements, their noise and the camera, by the implicit function theorem
        with the exact Hessian, solved by the same elimination. Starting values, fixed poses among them, have
        derivative zero.
    References: Szeliski, "Computer Vision", section 11.4; Triggs et al., "Bundle adjustment - a modern synthesis",
        2000.
    """
    points_world, measurements = jnp.asarray(points_world), jnp.asarray(measurements)
    mask = jnp.asarray(mask)
    c, p, d = measurements.shape
    if mask.shape != (c, p) or points_world.shape != (p, 3) or world_from_cam.wxyz_xyz.shape != (c, 7):
        raise ValueError(
            f"window shapes do not fit: poses {world_from_cam.wxyz_xyz.shape[:-1]}, points {points_world.shape}, "
            f"measurements {measurements.shape}, mask {mask.shape}; expected (c,), (p, 3), (c, p, d), (c, p)"
        )
    dtype = jnp.result_type(points_world, measurements)
    free = jnp.arange(c) > 0 if fixed is None else ~jnp.asarray(fixed)
    anchor = SE3(jax.lax.stop_gradient(world_from_cam.wxyz_xyz[0]))
    poses = anchor.inverse() @ world_from_cam
    points = anchor.inverse().apply(points_world)
    data = _Data(
        tuple(measurements[..., i].astype(dtype) for i in range(d)),
        whitening(sigma_px, (c, p), d, dtype),
        mask.astype(dtype),
        free.astype(dtype),
        camera,
    )
    start = (SE3(poses.wxyz_xyz.astype(dtype)), points.astype(dtype))
    start = jax.lax.stop_gradient(start)
    found, iterations, converged = _optimise(start, *jax.lax.stop_gradient((data, loss)), options)
    poses, points = _with_derivative(found, (data, loss))

    increments = _zero_increments(start)
    residual_at = lambda state: lambda y: _residual(y, (state, data, loss))  # noqa: E731
    final, jvp = jax.linearize(residual_at((poses, points)), increments)
    system = _schur.arrow_system(increments, final, jvp)
    covariances, regular = _schur.camera_covariances(system)
    blind = free & (system.camera[0, 0] == 0)
    regular = regular & ~jnp.any(blind)
    covariances = jnp.where(regular, covariances, 0.0)
    result = Result.where(converged, Result.success, Result.not_converged)
    result = Result.where(regular, result, Result.degenerate)
    return Window(
        (anchor @ poses).normalize(),
        anchor.apply(points),
        covariances,
        _cost(residual_at(start)(increments)),
        _cost(final),
        iterations,
        result,
    )


class _Data(eqx.Module):
    measured: tuple[Array, ...]
    whitening: tuple[Array, ...]
    mask: Array
    free: Array
    camera: Any


def _zero_increments(state: tuple[SE3, Array]) -> tuple[Array, Array]:
    poses, points = state
    return jnp.zeros((poses.wxyz_xyz.shape[0], 6), points.dtype), jnp.zeros_like(points)


def _residual(y: tuple[Array, Array], args: Any) -> tuple[Array, ...]:
    """Whitened, robustified residual components [c, p]."""
    (poses, points), data, loss = args
    increments, moves = y
    cam_from_anchor = (poses @ SE3.exp(increments * data.free[:, None])).inverse().as_matrix()
    points = points + moves
    x, y_, z = (
        sum(cam_from_anchor[:, i, j, None] * points[None, :, j] for j in range(3)) + cam_from_anchor[:, i, 3, None]
        for i in range(3)
    )
    return _observed(x, y_, z, data, loss)


def _observed(x: Array, y: Array, z: Array, data: _Data, loss: Loss) -> tuple[Array, ...]:
    """Residual components of camera-frame points [c, p]."""
    raw = tuple(a - b for a, b in zip(data.camera.project_xyz(x, y, z), data.measured, strict=True))
    return robustify(whiten(data.whitening, raw), loss, data.mask)


def _cost(residual: tuple[Array, ...]) -> Array:
    return 0.5 * sum(jnp.sum(component * component) for component in residual)  # type: ignore[return-value]


def _optimise(start: tuple[SE3, Array], data: _Data, loss: Loss, options: LMOptions) -> Any:
    poses, points = start
    y0 = _zero_increments(start)
    solution = minimize(_residual, y0, (start, data, loss), _schur.SchurDescent(), options)
    increments, moves = solution.value
    poses = (poses @ SE3.exp(increments * data.free[:, None])).normalize()
    return (poses, points + moves), solution.stats["num_steps"], solution.result == optx.RESULTS.successful


@jax.custom_jvp
def _with_derivative(state: tuple[SE3, Array], data_loss: tuple[_Data, Loss]) -> tuple[SE3, Array]:
    """Give an optimum its derivative in the data: dy = −H⁻¹ (∂∇C/∂data) ddata, H the exact Hessian of the cost."""
    del data_loss
    return state


@_with_derivative.defjvp
def _(primals: Any, tangents: Any) -> Any:
    state, data_loss = primals
    poses, points = state
    cam_from_anchor = poses.inverse()
    rotation = cam_from_anchor.as_matrix()[:, :3, :3]
    points_cam = SE3(cam_from_anchor.wxyz_xyz[:, None]).apply(points[None])  # [c, p, 3]
    c, p = points_cam.shape[:2]

    def cost(increments: Array, moves: Array, data_loss: tuple[_Data, Loss]) -> Array:
        """The cost with a copy of its camera and its landmark for every observation: [c, p, 6] and [c, p, 3]."""
        data, loss = data_loss
        moved = points_cam + jnp.sum(rotation[:, None] * moves[:, :, None, :], axis=-1)
        moved = SE3.exp(-increments * data.free[:, None, None]).apply(moved)
        return _cost(_observed(moved[..., 0], moved[..., 1], moved[..., 2], data, loss))

    gradient = jax.grad(cost, argnums=(0, 1))
    at = (jnp.zeros((c, p, 6), points.dtype), jnp.zeros((c, p, 3), points.dtype))
    _, change = jax.jvp(lambda data_loss: gradient(*at, data_loss), (data_loss,), (tangents[1],))
    # With copies the Hessian is one 9 × 9 block an observation: nine products with tangents of ones give it whole.
    _, hessian = jax.linearize(lambda *y: gradient(*y, data_loss), *at)
    by_camera = [hessian(at[0].at[..., i].set(1.0), at[1]) for i in range(6)]
    by_landmark = [hessian(at[0], at[1].at[..., i].set(1.0)) for i in range(3)]
    system = _schur.ArrowSystem(
        camera=jnp.stack([jnp.sum(block[0], axis=1).T for block in by_camera]),
        landmark=jnp.stack([jnp.sum(block[1], axis=0).T for block in by_landmark]),
        cross=jnp.stack([block[1].transpose(2, 0, 1) for block in by_camera]),
        camera_gradient=jnp.sum(change[0], axis=1).T,
        landmark_gradient=jnp.sum(change[1], axis=0).T,
    )
    increments, moves = _schur.solve(system)
    retract = lambda y: (poses @ SE3.exp(y[0]), points + y[1])  # noqa: E731
    zero = _zero_increments(state)
    return state, jax.jvp(retract, (zero,), ((increments, moves),))[1]
