"""Levenberg–Marquardt on the manifold of a bundle, in optimistix' loop, with a record of every iteration."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from vojax._types import Array, Bool, Float, Int

from ._bundle_layout import BundleLayout
from ._bundle_priors import landmark_root
from ._bundle_residual import Blocks, linearize, residual
from ._bundle_state import BundleData, BundleState, retract, zero_like_unknowns
from ._levenberg_marquardt import LMOptions, NielsenSearch, UntilConverged
from ._losses import Loss


class BundleTrace(eqx.Module):
    """What every iteration did; entries beyond the number of iterations are zero.

    Attributes:
        cost: ½Σρ at the trial point, the first one the start.
        accepted: Whether the trial point was taken.
        gradient_norm: Largest entry of the gradient at the last accepted point.
        damping: λ of the step from there.
        step_norm: Euclidean length of that step, in the units of the variables.
    """

    cost: Float[Array, " n"]
    accepted: Bool[Array, " n"]
    gradient_norm: Float[Array, " n"]
    damping: Float[Array, " n"]
    step_norm: Float[Array, " n"]


class BundleJacobian(NamedTuple):
    """The Jacobian at an accepted point, by blocks: what optimistix calls `f_info.jac`."""

    blocks: Blocks
    data: BundleData
    layout: BundleLayout

    def mv(self, step: tuple[Array, Array]) -> tuple[Array, ...]:
        """Change of all residuals along a step."""
        unknowns, landmarks = step
        cameras = self.layout.expand(unknowns)
        at_slots = cameras.T.at[:, self.layout.slot_camera].get(mode="clip")
        moves = self.layout.spread(landmarks)
        blocks, priors = self.blocks, self.blocks.priors
        change = jnp.sum(blocks.by_camera * at_slots[None], axis=1) + jnp.sum(blocks.by_landmark * moves[None], axis=1)
        by_priors = list(priors.residuals)
        if priors.landmarks.size:
            by_priors[0] = jnp.sum(landmark_root(self.data.priors, self.layout) * landmarks[None], axis=1)
        root = self.data.priors.intrinsics_root
        if priors.intrinsics.size and root is not None:
            by_priors[1] = root * self.layout.expand_groups(unknowns)
        by_factors = (
            jnp.sum(jacobian * self.layout.take(unknowns, columns)[:, None], axis=-1)
            for columns, (_, jacobian) in zip(self.layout.factor_columns, blocks.factors, strict=True)
        )
        return *change, *by_priors, *by_factors


class _Evaluation(NamedTuple):
    """What the search reads: residuals and Jacobian of a point, as optimistix' `FunctionInfo.ResidualJac`."""

    residual: tuple[Array, ...]
    jac: BundleJacobian | None

    def as_min(self) -> Array:
        return 0.5 * sum(jnp.sum(part * part) for part in self.residual)  # type: ignore[return-value]


class _State(eqx.Module):
    first_step: Bool[Array, ""]
    y_eval: BundleState
    step: tuple[Array, Array]
    blocks: Blocks
    search_state: Any
    descent_state: Any
    trace: BundleTrace
    num_steps: Int[Array, ""]


class BundleLevenbergMarquardt(UntilConverged):
    """optimistix' iteration with steps on the manifold: a trial point is linearised only once it is accepted."""

    rtol: float
    atol: float
    norm: Callable[..., Any]
    descent: optx.AbstractDescent
    search: optx.AbstractSearch
    max_steps: int
    report: Callable[..., None] | None

    def __init__(
        self, descent: optx.AbstractDescent, options: LMOptions, dtype: Any, report: Callable[..., None] | None = None
    ):
        self.rtol = self.atol = 0.0  # the search decides about convergence, by the cost
        self.norm = optx.max_norm
        self.descent = descent
        eps = float(jnp.finfo(dtype).eps)
        tolerance = max(3e-6, 128 * eps) if options.tolerance is None else options.tolerance
        # The gauge may be free: then damping is all that keeps the reduced system regular.
        self.search = NielsenSearch(options.initial_damping, tolerance, smallest_damping=max(1e-12, 10 * eps))
        self.max_steps = options.max_steps
        self.report = report

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: frozenset[object]
    ) -> Any:
        """Zeros of the right shapes."""
        del fn, options, f_struct, aux_struct, tags
        data, loss, layout = args
        dtype = y.landmarks.dtype
        zeros = lambda struct: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), struct)  # noqa: E731
        step = zero_like_unknowns(layout, dtype)
        empty = jnp.zeros((self.max_steps,), dtype)
        return _State(
            first_step=jnp.array(True),
            y_eval=y,
            step=step,
            blocks=zeros(eqx.filter_eval_shape(linearize, y, data, loss, layout)),
            search_state=self.search.init(step, None),  # type: ignore[arg-type]
            descent_state=self.descent.init(y, None),  # type: ignore[arg-type]
            trace=BundleTrace(empty, jnp.zeros((self.max_steps,), bool), empty, empty, empty),
            num_steps=jnp.array(0),
        )

    def step(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: frozenset[object]) -> Any:
        """Judge the trial point, linearise it if it is better, and take the next step from the best point."""
        del options, tags
        data, loss, layout = args
        found, _ = fn(state.y_eval, args)
        trial = _Evaluation(found, None)
        blocks = state.blocks
        current = _Evaluation(blocks.residuals, BundleJacobian(blocks, data, layout))
        origin = jax.tree.map(jnp.zeros_like, state.step)
        step_size, accept, _, search_state = self.search.step(
            state.first_step,
            origin,
            state.step,
            current,
            trial,
            state.search_state,  # type: ignore[arg-type]
        )

        def accepted() -> Any:
            blocks = linearize(state.y_eval, data, loss, layout)
            info = _Evaluation((), BundleJacobian(blocks, data, layout))
            return state.y_eval, blocks, self.descent.query(state.y_eval, info, state.descent_state)  # type: ignore[arg-type]

        def rejected() -> Any:
            return y, state.blocks, state.descent_state

        y, blocks, descent_state = jax.lax.cond(accept, accepted, rejected)
        step, _ = self.descent.step(step_size, descent_state)
        row = {
            "cost": trial.as_min(),
            "accepted": accept,
            "gradient_norm": _gradient_norm(descent_state, layout),
            "damping": 1.0 / step_size,
            "step_norm": jnp.sqrt(sum(jnp.sum(part * part) for part in step)),  # type: ignore[arg-type]
        }
        row = {name: jnp.where(jnp.isfinite(value), value, jnp.zeros_like(value)) for name, value in row.items()}
        if self.report is not None:
            report = self.report
            jax.debug.callback(lambda k, row: report(k, **row), state.num_steps, row)
        trace = BundleTrace(
            **{name: getattr(state.trace, name).at[state.num_steps].set(value) for name, value in row.items()}
        )
        y_eval = retract(y, step[0], step[1], data, layout)
        return (
            y,
            _State(jnp.array(False), y_eval, step, blocks, search_state, descent_state, trace, state.num_steps + 1),
            None,
        )


def _gradient_norm(system: Any, layout: BundleLayout) -> Float[Array, ""]:
    cameras = jnp.abs(system.gradient(layout))
    return jnp.maximum(jnp.max(cameras, initial=0.0), jnp.max(jnp.abs(system.landmark_gradient), initial=0.0))


def minimize_bundle(
    start: BundleState,
    data: BundleData,
    loss: Loss,
    layout: BundleLayout,
    descent: optx.AbstractDescent,
    options: LMOptions,
    report: Callable[..., None] | None = None,
) -> Any:
    """Run the solver; never raises, never differentiates through its iterations.

    Returns:
        The optimistix solution; `solution.state.trace` is the record.
    """
    solver = BundleLevenbergMarquardt(descent, options, start.landmarks.dtype, report)
    return optx.least_squares(
        lambda y, args: residual(y, *args),
        solver,
        start,
        (data, loss, layout),
        max_steps=options.max_steps,
        throw=False,
    )
