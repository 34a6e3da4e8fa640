"""Levenberg–Marquardt on the manifold of a window, in optimistix' loop; batches of windows through a few lanes."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.custom_batching import custom_vmap

from vojax._types import Array, Bool, Float, Int

from ._levenberg_marquardt import LMOptions, NielsenSearch, UntilConverged
from ._losses import Loss
from ._window_residual import Blocks, WindowData, WindowState, cost, linearize, residuals
from ._window_schur import SchurDescent

# Windows solved side by side: their normal equations stay in the cache.
_LANES = 16


class Optimum(NamedTuple):
    """Where a solve ended."""

    state: WindowState
    initial_cost: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


class _Evaluation(NamedTuple):
    """What the search reads of a point, as optimistix' `FunctionInfo.ResidualJac`."""

    blocks: Blocks

    @property
    def residual(self) -> tuple[Array, ...]:
        return *self.blocks.residual, self.blocks.prior_residual

    @property
    def jac(self) -> "_Evaluation":
        return self

    def mv(self, step: tuple[Array, Array]) -> tuple[Array, ...]:
        return self.blocks.along(*step)

    def as_min(self) -> Array:
        return cost(self.residual)


class _LinearizedAt(NamedTuple):
    """What the descent reads of an accepted point."""

    jac: Blocks


class _State(eqx.Module):
    first_step: Bool[Array, ""]
    step: tuple[Array, Array]
    y_eval: WindowState
    blocks: Blocks
    search_state: Any
    initial_cost: Float[Array, ""]


class WindowLevenbergMarquardt(UntilConverged):
    """optimistix' iteration with steps on the manifold, and every trial point linearised as it is evaluated.

    Rejections are rare, and under `vmap` both ways would be taken anyhow.
    """

    rtol: float
    atol: float
    norm: Callable[..., Any]
    descent: optx.AbstractDescent
    search: optx.AbstractSearch

    def __init__(self, descent: optx.AbstractDescent, options: LMOptions):
        self.rtol = self.atol = 0.0  # the search decides about convergence, by the cost
        self.norm = optx.max_norm
        self.descent = descent
        self.search = NielsenSearch(options.initial_damping, options.tolerance)

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: frozenset[object]
    ) -> Any:
        """Zeros of the right shapes."""
        del fn, options, f_struct, aux_struct, tags
        dtype = y.points.dtype
        step = (jnp.zeros((6, y.poses.wxyz_xyz.shape[0]), dtype), jnp.zeros_like(y.points))
        blocks = jax.tree.map(
            lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), eqx.filter_eval_shape(linearize, y, *args)
        )
        search_state = self.search.init(step, None)  # type: ignore[arg-type]
        return _State(jnp.array(True), step, y, blocks, search_state, jnp.zeros((), dtype))

    def restarted(self, state: _State, y: WindowState) -> _State:
        """Ready for the first step of another window; what that step does not read stays as it is."""
        search_state = self.search.init(state.step, None)  # type: ignore[arg-type]
        return _State(jnp.array(True), state.step, y, state.blocks, search_state, state.initial_cost)

    def step(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: frozenset[object]) -> Any:
        """Judge the trial point and take the next step from the better one."""
        del fn, options, tags
        trial = linearize(state.y_eval, *args)
        origin = jax.tree.map(jnp.zeros_like, state.step)
        step_size, accept, _, search_state = self.search.step(
            state.first_step,
            origin,
            state.step,
            _Evaluation(state.blocks),  # type: ignore[arg-type]
            _Evaluation(trial),  # type: ignore[arg-type]
            state.search_state,
        )
        # Numbers for all that follows: without a barrier XLA works them out anew for every element.
        step_size, accept, search_state = jax.lax.optimization_barrier((step_size, accept, search_state))
        keep = lambda new, old: jnp.where(accept, new, old)  # noqa: E731
        y = jax.tree.map(keep, state.y_eval, y)
        blocks = jax.tree.map(keep, trial, state.blocks)
        system = self.descent.query(y, _LinearizedAt(blocks), None)  # type: ignore[arg-type]
        step, _ = self.descent.step(step_size, system)
        tangents = step[0] * blocks.free[None]
        initial_cost = jnp.where(state.first_step, _Evaluation(trial).as_min(), state.initial_cost)
        trial_point = y.moved(tangents, step[1])
        after = _State(jnp.array(False), (tangents, step[1]), trial_point, blocks, search_state, initial_cost)
        return y, after, None


def optimise(start: WindowState, data: WindowData, loss: Loss, options: LMOptions) -> Optimum:
    """Solve one window; a batch under `vmap` goes through a few lanes. Not differentiable."""
    return _batchable(options)(start, data, loss)


@functools.cache
def _batchable(options: LMOptions) -> Callable[..., Optimum]:
    """The solver with a rule of its own for batches."""
    solver = WindowLevenbergMarquardt(SchurDescent(), options)

    def plain(start: WindowState, data: WindowData, loss: Loss) -> Optimum:
        solution = optx.least_squares(
            lambda y, args: residuals(y, *args), solver, start, (data, loss), max_steps=options.max_steps, throw=False
        )
        successful = solution.result == optx.RESULTS.successful
        return _optimum(solution.value, solution.state, solution.stats["num_steps"], successful)

    one = custom_vmap(plain)

    @one.def_vmap
    def _(axis_size: int, batched: Any, *arguments: Any) -> Any:
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
        if axis_size <= _LANES:
            found = jax.vmap(plain, in_axes=tuple(axes))(*arguments)
        else:
            found = _in_lanes(solver, options.max_steps, axis_size, batched, arguments)
        return found, jax.tree.map(lambda _: True, found)

    return one


def _optimum(y: WindowState, state: _State, steps: Array, converged: Array) -> Optimum:
    return Optimum(WindowState(y.poses.normalize(), y.points), state.initial_cost, steps, converged)


class _Lanes(NamedTuple):
    """Windows under way, one in each lane, and those that are done."""

    window: Int[Array, " lanes"]  # its number; the number of windows or more where there is none left
    following: Int[Array, ""]
    y: WindowState
    state: _State
    steps: Int[Array, " lanes"]
    found: Optimum


def _in_lanes(
    solver: WindowLevenbergMarquardt, max_steps: int, count: int, batched: Any, arguments: tuple[Any, ...]
) -> Optimum:
    """Solve many windows, a few at a time: a lane whose window is done takes the next; none waits for the slowest."""
    # Each lane has its own state, also where all windows start alike.
    every = lambda x, is_batched: x if is_batched else jnp.broadcast_to(x, (count, *x.shape))  # noqa: E731
    arguments = (jax.tree.map(every, arguments[0], batched[0]), *arguments[1:])
    batched = (jax.tree.map(lambda _: True, batched[0]), *batched[1:])

    def taken(window: Array) -> Any:
        rows = jnp.minimum(window, count - 1)
        return jax.tree.map(lambda x, is_batched: x[rows] if is_batched else x, arguments, batched)

    axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)

    def begin(start: WindowState, data: WindowData, loss: Loss) -> tuple[WindowState, _State]:
        return start, solver.init(None, start, (data, loss), {}, None, None, frozenset())

    def step(y: WindowState, state: _State, data: WindowData, loss: Loss) -> Any:
        y, state, _ = solver.step(None, y, (data, loss), {}, state, frozenset())
        return y, state

    def body(lanes: _Lanes) -> _Lanes:
        y, state = jax.vmap(step, in_axes=(0, 0, *axes[1:]))(lanes.y, lanes.state, *taken(lanes.window)[1:])
        steps = lanes.steps + 1
        converged = state.search_state.converged
        ended = converged | (steps >= max_steps)
        rows = jnp.where(ended, lanes.window, count)  # others are dropped
        optimum = jax.vmap(_optimum)(y, state, steps, converged)
        found = jax.tree.map(lambda out, x: out.at[rows].set(x, mode="drop"), lanes.found, optimum)
        window = jnp.where(ended, lanes.following + jnp.cumsum(ended) - 1, lanes.window)
        start = taken(window)[0]
        renewed = (start, jax.vmap(solver.restarted)(state, start))
        choose = lambda new, old: jnp.where(ended.reshape(-1, *(1,) * (new.ndim - 1)), new, old)  # noqa: E731
        y, state = jax.tree.map(choose, renewed, (y, state))
        return _Lanes(window, lanes.following + jnp.sum(ended), y, state, jnp.where(ended, 0, steps), found)

    window = jnp.arange(_LANES)
    y, state = jax.vmap(begin, in_axes=axes)(*taken(window))
    steps = jnp.zeros((_LANES,), jnp.int32)
    found = jax.eval_shape(jax.vmap(_optimum), y, state, steps, state.search_state.converged)
    found = jax.tree.map(lambda x: jnp.zeros((count, *x.shape[1:]), x.dtype), found)
    first = _Lanes(window, jnp.asarray(_LANES), y, state, steps, found)
    return jax.lax.while_loop(lambda lanes: jnp.any(lanes.window < count), body, first).found
