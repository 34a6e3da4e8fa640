"""Bundle adjustment of many cameras and landmarks, with its gradients."""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from vojax._result import Result
from vojax._types import Array, Bool, Float, Int
from vojax.lie import SE3

from ._bundle_descent import SchurDescent
from ._bundle_gradient import with_derivative
from ._bundle_problem import BundleProblem, all_factors
from ._bundle_residual import residual
from ._bundle_schur import determined
from ._bundle_solver import BundleTrace, minimize_bundle
from ._bundle_state import BundleData, BundleState, view
from ._intrinsics import add_to_camera
from ._levenberg_marquardt import LMOptions
from ._losses import Loss, Squared
from ._whitening import whitening

BUNDLE_OPTIONS = LMOptions(max_steps=50, initial_damping=1e-4)


class BundleAdjustment(eqx.Module):
    """An adjusted bundle.

    Attributes:
        cam_from_world: Poses of the cameras, or of the rigs.
        cam_from_rig: Poses of the cameras in the rig; None without rigs.
        landmarks: Points in the world frame, homogeneous where they were; those that nobody saw are where they were.
        camera: The camera model, free parameters adjusted.
        initial_cost: ½Σρ before, priors included.
        cost: ½Σρ after.
        iterations: Evaluations of the residuals.
        behind_camera: Observations whose landmark ended behind its camera (z ≤ 0); they count like all others.
        trace: What every iteration did.
        unconstrained_cameras: Those of the `BundleProblem`, and cameras for which a direction has no information at the
            end, whatever the landmarks are.
        unconstrained_extrinsics: The same for the cameras in the rig.
        unconstrained_landmarks: Those of the `BundleProblem`, and landmarks for which a direction has none, such as the
            depth of one that all cameras saw along one ray.
        result: How it ended. `degenerate` if free cameras are unconstrained, or the cost is not finite.
    """

    cam_from_world: SE3
    cam_from_rig: SE3 | None
    landmarks: Float[Array, "p h"]
    camera: Any
    initial_cost: Float[Array, ""]
    cost: Float[Array, ""]
    iterations: Int[Array, ""]
    behind_camera: Int[Array, ""]
    trace: BundleTrace
    unconstrained_cameras: Bool[Array, " c"]
    unconstrained_extrinsics: Bool[Array, " r"]
    unconstrained_landmarks: Bool[Array, " p"]
    result: Result


def adjust_bundle(
    problem: BundleProblem,
    *,
    loss: Loss = Squared(),
    options: LMOptions = BUNDLE_OPTIONS,
    solver: Literal["dense", "iterative"] | None = None,
    report: Callable[..., None] | None = None,
) -> BundleAdjustment:
    """Adjust all free cameras, intrinsics and landmarks by Levenberg–Marquardt with landmark elimination.

    Compile it with `eqx.filter_jit`; problems of equal layout share the program.

    Args:
        problem: Of `bundle_problem`.
        loss: Robust loss of the squared whitened residual of an observation.
        options: Of the optimiser. A tolerance of None ends with the step that promises less than 3e-6 of the cost
            (1.5e-5 in float32); give 1e-12 or so where gradients are to have all their digits.
        solver: "dense" factors the reduced system, for up to a few hundred cameras; "iterative" solves it by conjugate
            gradients without forming it. None takes what the problem was made for.
        report: Called on the host after each iteration, `report(iteration, cost=…, accepted=…, gradient_norm=…,
            damping=…, step_norm=…)`.

    Returns:
        The adjusted bundle.

    Degenerate input: variables that the data do not determine move little or not at all, and are named in the result.
        With a free gauge the damping decides where the world ends up.
    Differentiability: both modes, in measurements, deviations, weights, fixed intrinsics, priors and parameters of the
        loss, by the implicit function theorem with the exact Hessian, eliminated like the normal equations. Starting
        values have derivative zero. With a free gauge the derivative moves the world as little as possible.

    Raises:
        ValueError: The system is to be factored, and the problem was made without pairs of observations.
    References: Triggs, McLauchlan, Hartley & Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000; Agarwal,
        Snavely, Seitz & Szeliski, "Bundle adjustment in the large", 2010.
    """
    layout = problem.layout
    if solver == "dense" and not layout.has_pairs:
        raise ValueError("the problem has no pairs of observations to factor: make it with solver='dense'")
    iterative = solver == "iterative" or not layout.has_pairs
    data = slot_data(problem)
    start = jax.lax.stop_gradient(start_state(problem))
    fixed_data, fixed_loss = jax.lax.stop_gradient((data, loss))
    solution = minimize_bundle(start, fixed_data, fixed_loss, layout, SchurDescent(layout, iterative), options, report)
    found = jax.lax.stop_gradient(solution.value)
    state = with_derivative(found, (data, loss), layout, problem.gauge_free, iterative)
    cost = _cost(residual(state, data, loss, layout))
    converged = solution.result == optx.RESULTS.successful
    result = Result.where(converged, Result.success, Result.not_converged)
    placed = determined(solution.state.descent_state, layout)
    loose_poses = jnp.concatenate([problem.unconstrained_cameras, problem.unconstrained_extrinsics]) | ~placed.poses
    seen_order = layout.landmark_order
    loose_landmarks = problem.unconstrained_landmarks.at[seen_order].max(~placed.landmarks)
    result = Result.where(jnp.any(loose_poses) | ~jnp.isfinite(cost), Result.degenerate, result)
    depth = view(state, data, layout).chain()[-1][2]
    theta = _by_leaf(state.intrinsics)
    cam_from_world, cam_from_rig = _split(state.poses, layout.frames)
    return BundleAdjustment(
        cam_from_world=cam_from_world,
        cam_from_rig=None if problem.cam_from_rig is None else cam_from_rig,
        landmarks=problem.landmarks.at[layout.landmark_order].set(state.landmarks.T),
        camera=add_to_camera(problem.camera, problem.free_intrinsics, theta),
        initial_cost=_cost(residual(start, data, loss, layout)),
        cost=cost,
        iterations=solution.stats["num_steps"],
        behind_camera=jnp.sum((data.weight > 0) & (depth <= 0)),
        trace=solution.state.trace,
        unconstrained_cameras=loose_poses[: layout.frames],
        unconstrained_extrinsics=loose_poses[layout.frames :],
        unconstrained_landmarks=loose_landmarks,
        result=result,
    )


def _cost(parts: tuple[Array, ...]) -> Float[Array, ""]:
    return 0.5 * jnp.sum(jnp.stack([jnp.sum(part * part) for part in parts]))


def _by_leaf(intrinsics: Float[Array, "g m"]) -> list[Array]:
    shared = intrinsics.shape[0] == 1
    return [column[0] if shared else column for column in intrinsics.T]


def _split(poses: SE3, frames: int) -> tuple[SE3, SE3]:
    return SE3(poses.wxyz_xyz[:frames]), SE3(poses.wxyz_xyz[frames:])


def start_state(problem: BundleProblem) -> BundleState:
    """The values that a problem starts from."""
    groups, free = problem.layout.group_columns.shape
    points = problem.landmarks[problem.layout.landmark_order].T
    poses = [problem.cam_from_world.wxyz_xyz]
    if problem.cam_from_rig is not None:
        poses.append(problem.cam_from_rig.wxyz_xyz)
    return BundleState(SE3(jnp.concatenate(poses)), jnp.zeros((groups, free), points.dtype), points)


def slot_data(problem: BundleProblem) -> BundleData:
    """Measurements brought to their slots; padding has weight 0."""
    (o, d), dtype = problem.measurements.shape, problem.measurements.dtype
    layout = problem.layout
    slots = lambda values, fill: layout.shard(values.at[layout.slot_observation].get(mode="fill", fill_value=fill))  # noqa: E731
    rows = problem.sigma_px.shape[-1] if problem.sigma_px.ndim == 3 else d
    white = whitening(problem.sigma_px, (o,), rows, dtype)
    basis = None
    if problem.anchors is not None:
        world_from_anchor = SE3(problem.anchors.wxyz_xyz[problem.layout.landmark_order]).inverse().as_matrix()
        basis = jnp.moveaxis(world_from_anchor[:, :, jnp.array([0, 1, 3])], 0, -1)
    return BundleData(
        measured=tuple(slots(problem.measurements[:, i], 0) for i in range(d)),
        whitening=tuple(slots(part, 1) if part.ndim else part for part in white),
        weight=slots(problem.weights, 0),
        camera=problem.camera,
        priors=problem.priors,
        factors=all_factors(problem),
        basis=basis,
        free=problem.free_intrinsics,
        residual=problem.residual,
    )
