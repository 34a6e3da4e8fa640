"""Derivatives of an adjusted bundle by the implicit function theorem, with the exact Hessian of the cost.

At an optimum ∇C(y, data) = 0, so dy = −H⁻¹ (∂∇C/∂data) ddata. H has a block for every observation, as JᵀJ has, and is
eliminated the same way; with JᵀJ in its place a gradient would be off by the share of residual times curvature.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array

from ._bundle_descent import DERIVATIVE_ACCURACY
from ._bundle_factors import FactorBlock
from ._bundle_layout import BundleLayout
from ._bundle_pcg import solve_iteratively
from ._bundle_priors import intrinsics_deviation, landmark_deviation, landmark_root
from ._bundle_residual import gradient_and_hessian
from ._bundle_schur import BundleSystem, solve
from ._bundle_state import BundleData, BundleState, retract, zero_like_unknowns
from ._losses import Loss

DataLoss = tuple[BundleData, Loss]


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def with_derivative(
    state: BundleState, data_loss: DataLoss, layout: BundleLayout, gauge_free: bool, iterative: bool
) -> BundleState:
    """Give an optimum its derivative in data and loss; `state` itself has none.

    Args:
        state: The optimum.
        data_loss: What it is the optimum for.
        layout: Of the problem.
        gauge_free: H has directions without curvature then; a little damping keeps the solution in the others.
        iterative: Solve by conjugate gradients.
    """
    del data_loss, layout, gauge_free, iterative
    return state


@with_derivative.defjvp
def _(gauge_free: bool, iterative: bool, primals: tuple, tangents: tuple) -> tuple[BundleState, BundleState]:
    state, (data, loss), layout = primals
    system = exact_system(state, data, loss, layout, tangents[1])
    if gauge_free:
        dtype = system.camera.dtype
        system = system.damped(jnp.asarray(1e-2 * float(jnp.finfo(dtype).eps) ** 0.5, dtype))
    step = solve_iteratively(system, layout, *DERIVATIVE_ACCURACY) if iterative else solve(system, layout)
    origin = zero_like_unknowns(layout, state.landmarks.dtype)
    return state, jax.jvp(lambda unknowns, moves: retract(state, unknowns, moves, data, layout), origin, step)[1]


def exact_system(
    state: BundleState, data: BundleData, loss: Loss, layout: BundleLayout, tangent: DataLoss | None
) -> BundleSystem:
    """The exact Hessian; its right-hand side is the change of the gradient along a tangent of data and loss."""
    hessian, change = gradient_and_hessian(state, data, loss, layout, tangent)
    size, _, s = hessian.shape
    k = size - 3
    free = layout.spread(layout.landmark_free.astype(hessian.dtype))
    if change is None:
        change = jnp.zeros((size, s), hessian.dtype)
    camera = layout.sum_cameras(hessian[:k, :k].reshape(k * k, s).T).reshape(-1, k, k)
    system = BundleSystem(
        camera=camera,
        camera_gradient=layout.sum_cameras(change[:k].T),
        landmark=layout.sum_landmarks(hessian[k:, k:] * free[None, None]),
        landmark_gradient=layout.sum_landmarks(change[k:] * free[None]),
        cross=hessian[:k, k:] * free[None, None],
        factors=tuple(_factor_block(i, state, data, tangent) for i in range(len(data.factors))),
    )
    return _add_priors(system, state, data, layout, tangent)


def _add_priors(
    system: BundleSystem, state: BundleState, data: BundleData, layout: BundleLayout, tangent: DataLoss | None
) -> BundleSystem:
    priors = data.priors
    along = lambda gradient: _change(gradient, data, tangent)  # noqa: E731
    if priors.landmarks is not None:
        root = landmark_root(priors, layout)

        def landmark_gradient(data: BundleData) -> Array:
            deviation = landmark_deviation(state.landmarks, data.priors, layout)
            return jnp.sum(landmark_root(data.priors, layout) * deviation[:, None], axis=0)

        system = eqx.tree_at(
            lambda system: (system.landmark, system.landmark_gradient),
            system,
            (
                system.landmark + jnp.sum(root[:, :, None] * root[:, None], axis=0),
                system.landmark_gradient + along(landmark_gradient),
            ),
        )
    if priors.intrinsics is not None and priors.intrinsics_root is not None:
        rows, own = layout.group_camera[:, None], jnp.arange(-len(data.free), 0)[None]

        def intrinsics_gradient(data: BundleData) -> Array:
            return data.priors.intrinsics_root * intrinsics_deviation(state.intrinsics, data)  # type: ignore[operator]

        system = eqx.tree_at(
            lambda system: (system.camera, system.camera_gradient),
            system,
            (
                system.camera.at[rows, own, own].add(priors.intrinsics_root**2, mode="drop"),
                system.camera_gradient.at[rows, own].add(along(intrinsics_gradient), mode="drop"),
            ),
        )
    return system


def _factor_block(i: int, state: BundleState, data: BundleData, tangent: DataLoss | None) -> FactorBlock:
    """Exact Hessian of the factors of one kind, and the change of their gradient."""
    at = data.factors[i].zero(state.landmarks.dtype)
    # Factors do not mix: a tangent of ones in one coordinate of all gives a column of all blocks.
    columns = [
        jax.jvp(lambda xi: data.factors[i].gradient(xi, state.poses), (at,), (jnp.zeros_like(at).at[:, j].set(1.0),))[1]
        for j in range(at.shape[1])
    ]
    change = _change(lambda data: data.factors[i].gradient(at, state.poses), data, tangent)
    return FactorBlock(jnp.stack(columns, axis=-1), change)


def _change(gradient, data: BundleData, tangent: DataLoss | None) -> Array:
    """Change of a gradient along a tangent of the data."""
    if tangent is None:
        return jnp.zeros_like(gradient(data))
    return jax.jvp(gradient, (data,), (tangent[0],))[1]
