"""Levenberg–Marquardt on the manifold of a window, in optimistix' loop; batches of windows in pieces."""

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

# Windows solved side by side: their normal equations stay in the cache, and few wait for the slowest.
_CHUNK = 16


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
    """Solve one window; a batch under `vmap` goes through in pieces. Not differentiable."""
    return _batchable(options)(start, data, loss)


@functools.cache
def _batchable(options: LMOptions) -> Callable[..., Optimum]:
    """The solver with a rule of its own for batches."""

    def plain(start: WindowState, data: WindowData, loss: Loss) -> Optimum:
        solution = optx.least_squares(
            lambda y, args: residuals(y, *args),
            WindowLevenbergMarquardt(SchurDescent(), options),
            start,
            (data, loss),
            max_steps=options.max_steps,
            throw=False,
        )
        y = WindowState(solution.value.poses.normalize(), solution.value.points)
        successful = solution.result == optx.RESULTS.successful
        return Optimum(y, solution.state.initial_cost, solution.stats["num_steps"], successful)

    one = custom_vmap(plain)

    @one.def_vmap
    def _(axis_size: int, batched: Any, *arguments: Any) -> Any:
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
        many = jax.vmap(plain, in_axes=tuple(axes))
        count = -(-axis_size // _CHUNK)
        if count == 1:
            return (found := many(*arguments)), jax.tree.map(lambda _: True, found)
        size = -(-axis_size // count)
        flat, tree = jax.tree.flatten(arguments)
        mapped = jax.tree.leaves(batched)

        def pieces(leaf: Array) -> Array:
            # Filled up with copies of the last window, which ends when that one does.
            padding = ((0, count * size - axis_size), *((0, 0),) * (leaf.ndim - 1))
            return jnp.pad(leaf, padding, mode="edge").reshape(count, size, *leaf.shape[1:])

        chunks = [pieces(leaf) for leaf, is_mapped in zip(flat, mapped, strict=True) if is_mapped]

        def solve(chunk: list[Array]) -> Optimum:
            rest = iter(chunk)
            leaves = [next(rest) if is_mapped else leaf for leaf, is_mapped in zip(flat, mapped, strict=True)]
            return many(*jax.tree.unflatten(tree, leaves))

        found = jax.lax.map(solve, chunks)
        found = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:axis_size], found)
        return found, jax.tree.map(lambda _: True, found)

    return one
