"""The derivative of a window's optimum in its data, by the implicit function theorem."""

from typing import Any

import jax
import jax.numpy as jnp

from vojax._types import Array, Float
from vojax.lie import SE3

from . import _window_schur
from ._losses import Loss
from ._window_residual import WindowData, WindowState, cost, observed, points_in_cameras


@jax.custom_jvp
def with_derivative(state: WindowState, data_loss: tuple[WindowData, Loss]) -> WindowState:
    """Give an optimum its derivative in the data: dy = −H⁻¹ (∂∇C/∂data) ddata, H the exact Hessian of the cost."""
    del data_loss
    return state


@with_derivative.defjvp
def _(primals: Any, tangents: Any) -> Any:
    state, data_loss = primals
    point, rotation = points_in_cameras(state)
    (_, c, p), dtype = point.shape, point.dtype

    def observation_cost(turns: Array, moves: Array, data_loss: tuple[WindowData, Loss]) -> Array:
        """The cost with a copy of its camera and its landmark for every observation: [6, c, p] and [3, c, p]."""
        data, loss = data_loss
        moved = point + jnp.sum(rotation[..., None] * moves[None], axis=1)
        free = data.free[None, :, None]
        back = SE3.exp(jnp.moveaxis(-turns * free, 0, -1))
        moved = back.apply(jnp.moveaxis(moved, 0, -1))
        return cost(observed(moved[..., 0], moved[..., 1], moved[..., 2], data, loss))

    gradient = jax.grad(observation_cost, argnums=(0, 1))
    at = (jnp.zeros((6, c, p), dtype), jnp.zeros((3, c, p), dtype))
    _, change = jax.jvp(lambda data_loss: gradient(*at, data_loss), (data_loss,), (tangents[1],))
    # With copies the Hessian is one 9 × 9 block an observation: nine products with tangents of ones give it whole.
    _, hessian = jax.linearize(lambda *y: gradient(*y, data_loss), *at)
    units = jnp.eye(9, dtype=dtype)
    expand = lambda unit: jnp.broadcast_to(unit[:, None, None], (unit.shape[0], c, p))  # noqa: E731
    by_camera, by_landmark = jax.vmap(lambda unit: hessian(expand(unit[:6]), expand(unit[6:])))(units)

    def prior_cost(turns: Float[Array, "6 c"], data: WindowData) -> Array:
        if data.prior is None:
            return jnp.zeros((), dtype)
        errors = data.prior.errors(state.poses @ SE3.exp((turns * data.free[None]).T))
        return 0.5 * jnp.sum(errors * errors)

    zero = (jnp.zeros((6, c), dtype), jnp.zeros((3, p), dtype))
    camera_change, coupling = jnp.sum(change[0], axis=-1), None
    if data_loss[0].prior is not None:
        prior_gradient = jax.grad(prior_cost)
        _, by_prior = jax.jvp(lambda data: prior_gradient(zero[0], data), (data_loss[0],), (tangents[1][0],))
        camera_change = camera_change + by_prior
        coupling = jax.hessian(prior_cost)(zero[0], data_loss[0])
    system = _window_schur.ArrowSystem(
        camera=jnp.sum(by_camera[:6], axis=-1),
        landmark=jnp.sum(by_landmark[6:], axis=2),
        cross=by_landmark[:6].swapaxes(1, 2),
        camera_gradient=camera_change,
        landmark_gradient=jnp.sum(change[1], axis=1),
        coupling=coupling,
    )
    step = _window_schur.solve(system)
    return state, jax.jvp(state.moved, zero, step)[1]
