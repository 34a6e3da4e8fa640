"""Levenberg–Marquardt as vojax runs it: optimistix is the engine, the damping and its schedule are ours.

Minimises ½‖r(y)‖² over a tangent increment y. Two things differ from optimistix' stock solver:

- damping is by the diagonal, (JᵀJ + λ diag JᵀJ) d = −Jᵀr (Marquardt 1963), so that metres and radians need no scaling;
- λ starts small and follows the gain ratio (Nielsen 1999), so that a good Gauss–Newton problem takes Gauss–Newton
steps.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from vojax._numerics import cholesky_solve
from vojax._types import Array, Bool, Float


@dataclasses.dataclass(frozen=True)
class LMOptions:
    """When Levenberg–Marquardt starts and stops.

    Attributes:
        max_steps: Most evaluations of the residuals, rejected steps included.
        initial_damping: λ of the first step, relative to the diagonal of JᵀJ.
        tolerance: The solve ends with the step that promises to lower the cost by less than this share of it. None
            takes what the dtype can resolve, 256 eps: 3e-5 in float32, 6e-14 in float64.
    """

    max_steps: int = 20
    initial_damping: float = 1e-4
    tolerance: float | None = None


class _SearchState(eqx.Module):
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    converged: Bool[Array, ""]


class NielsenSearch(optx.AbstractSearch):
    """Accept steps that reduce the cost and steer λ by the gain ratio.

    The step size handed to the descent is 1/λ. Residuals are expected in units of their standard deviation. A step
    whose predicted gain is below the rounding error of the cost is taken as it is, so that float32 solves end instead
    of shrinking their steps for ever.

    References: Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05, eq. (2.5).
    """

    initial_damping: float = 1e-4
    tolerance: float | None = None
    smallest_damping: float = 1e-12
    largest_damping: float = 1e8

    def init(self, y: Any, f_info_struct: Any) -> _SearchState:
        """Start with the initial damping and the smallest growth factor."""
        del f_info_struct
        dtype = jnp.result_type(*jax.tree.leaves(y))
        return _SearchState(jnp.asarray(self.initial_damping, dtype), jnp.asarray(2.0, dtype), jnp.array(False))

    def step(self, first_step: Any, y: Any, y_eval: Any, f_info: Any, f_eval_info: Any, state: _SearchState) -> Any:
        """Judge the trial point `y_eval` and choose the damping of the next step."""
        step = jax.tree.map(lambda new, old: new - old, y_eval, y)
        change = f_info.jac.mv(step)
        predicted = _dot(f_info.residual, change) + 0.5 * _dot(change, change)
        cost = f_info.as_min()
        actual = f_eval_info.as_min() - cost
        # A residual of one pixel is the difference of two coordinates of up to a thousand: the cost of whitened
        # residuals is known to some hundreds of eps, and noise-free data end at a floor of their own.
        resolution = 256 * float(jnp.finfo(cost.dtype).eps)
        rounding = resolution * (cost + 0.1)
        tolerance = resolution if self.tolerance is None else self.tolerance
        unresolved = jnp.abs(predicted) <= rounding
        accept = first_step | (actual <= jnp.where(unresolved, 4 * rounding, 1e-3 * predicted))
        converged = accept & ~first_step & (jnp.abs(predicted) <= tolerance * (cost + 0.1))
        gain = jnp.where(unresolved, 1.0, actual / jnp.where(predicted < 0, predicted, -1.0))
        shrink = jnp.maximum(1.0 / 3.0, 1.0 - (2.0 * jnp.clip(gain, 0.0, 1.0) - 1.0) ** 3)
        damping = jnp.where(accept, state.damping * shrink, state.damping * state.growth)
        damping = jnp.where(first_step, state.damping, damping)
        damping = jnp.clip(damping, self.smallest_damping, self.largest_damping)
        growth = jnp.where(accept, 2.0, 2.0 * state.growth)
        return 1.0 / damping, accept, optx.RESULTS.successful, _SearchState(damping, growth, converged)


class _DenseState(eqx.Module):
    hessian: Float[Array, "d d"]
    gradient: Float[Array, " d"]


class DenseDescent(optx.AbstractDescent):
    """Solve the damped normal equations of a few variables by a Cholesky factorisation of our own.

    A direction without curvature gets no step; the result is always finite and successful, and the search judges it.
    """

    def init(self, y: Any, f_info_struct: Any) -> _DenseState:
        """Zeros of the right shape."""
        del f_info_struct
        return _DenseState(jnp.zeros((y.shape[0], y.shape[0]), y.dtype), jnp.zeros_like(y))

    def query(self, y: Any, f_info: Any, state: _DenseState) -> _DenseState:
        """Form JᵀJ and Jᵀr at a newly accepted point."""
        del state
        columns = jnp.stack([f_info.jac.mv(jnp.zeros_like(y).at[i].set(1.0)) for i in range(y.shape[0])])
        hessian = jnp.sum(columns[:, None] * columns[None], axis=-1)
        return _DenseState(hessian, jnp.sum(columns * f_info.residual[None], axis=-1))

    def step(self, step_size: Any, state: _DenseState) -> tuple[Any, optx.RESULTS]:
        """Solve for the increment at damping 1/step_size."""
        identity = jnp.eye(state.gradient.shape[0], dtype=state.gradient.dtype)
        damped = state.hessian * (1.0 + identity / step_size)
        increment, _ = cholesky_solve(damped, -state.gradient[:, None])
        return increment[:, 0], optx.RESULTS.successful


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """optimistix' Gauss–Newton loop with a descent that damps by the diagonal and Nielsen's search."""

    rtol: float
    atol: float
    norm: Callable[..., Any]
    descent: optx.AbstractDescent
    search: optx.AbstractSearch
    verbose: Callable[..., None]

    def __init__(self, descent: optx.AbstractDescent, options: LMOptions):
        self.rtol = self.atol = 0.0  # optimistix' test compares residuals one by one; ours looks at the cost
        self.norm = optx.max_norm
        self.descent = descent
        self.search = NielsenSearch(options.initial_damping, options.tolerance)
        self.verbose = _silent

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> tuple[Array, optx.RESULTS]:
        """End with the first accepted step whose promised gain is below the tolerance."""
        del fn, y, args, options, tags
        return state.search_state.converged, state.result


class UntilConverged(optx.AbstractLeastSquaresSolver):
    """How the solvers on manifolds, whose states have a `search_state`, come to an end."""

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: frozenset[object]
    ) -> tuple[Array, optx.RESULTS]:
        """End with the first accepted step whose promised gain is below the tolerance."""
        del fn, y, args, options, tags
        return state.search_state.converged, optx.RESULTS.successful

    def postprocess(
        self,
        fn: Any,
        y: Any,
        aux: Any,
        args: Any,
        options: Any,
        state: Any,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[Any, Any, dict[str, Any]]:
        """Nothing to add."""
        del fn, args, options, state, tags, result
        return y, aux, {}


def minimize(fn: Callable[..., Any], y0: Any, args: Any, descent: optx.AbstractDescent, options: LMOptions) -> Any:
    """Run the solver; never raises, never differentiates through its iterations.

    Returns:
        The optimistix solution. `solution.state.f_info` holds residual and Jacobian at the last accepted point.
    """
    return optx.least_squares(
        fn,
        LevenbergMarquardt(descent, options),
        y0,
        args=args,
        max_steps=options.max_steps,
        throw=False,
    )


def _dot(a: Any, b: Any) -> Array:
    return sum(jnp.sum(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))  # type: ignore


def _silent(**values: Any) -> None:
    del values
