"""Least squares over one model of few degrees of freedom and many observations: two-view geometry and alignment.

Minimises ½Σ wᵢ ρ(‖rᵢ(M)‖²) over a model M on its manifold. A problem says how its model moves and what its residuals
are; Levenberg–Marquardt, the covariance and the derivative of the optimum are the same for all. (A camera pose has
closed-form Jacobians and its own file, `_refinement.py`.)
"""

import functools
from collections.abc import Callable
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from vojax._numerics import cholesky_solve, symmetric_inverse
from vojax._result import Result
from vojax._types import Array, Float, Int
from vojax.solvers import Candidates, implicit

from ._compressed import compressed_residual
from ._levenberg_marquardt import DenseDescent, LMOptions, minimize
from ._losses import Loss, Squared, robustify

Model = TypeVar("Model")


@runtime_checkable
class ModelProblem(Protocol):
    """Observations of a model. A pytree: what the optimum depends on is in its leaves."""

    tangent_dim: ClassVar[int]

    @staticmethod
    def retract(model: Any, tangent: Array) -> Any:
        """Move a model along its manifold; the zero tangent leaves it where it is."""
        ...

    def residual(self, model: Any) -> tuple[Array, ...]:
        """Components of the residuals in standard deviations, `[n]` each."""
        ...


class ModelRefinement(eqx.Module, Generic[Model]):
    """A refined model.

    Attributes:
        model: The model at the optimum.
        covariance: Of its tangent, inverse of the Gauss–Newton matrix; zero where the problem is degenerate.
        cost: ½Σ w ρ at the model.
        iterations: Evaluations of the residuals.
        result: How it ended.
    """

    model: Model
    covariance: Float[Array, "t t"]
    cost: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Result


def refine_model(
    start: Model,
    problem: ModelProblem,
    *,
    weight: Float[Array, " n"] | None = None,
    loss: Loss = Squared(),
    options: LMOptions = LMOptions(),
) -> ModelRefinement[Model]:
    """Bring a model to the least squares of its problem by Levenberg–Marquardt.

    Args:
        start: A model near the optimum.
        problem: Its observations.
        weight: Factor on the loss of each observation; zero leaves it out.
        loss: Robust loss of the squared residuals.
        options: Of the optimiser.

    Degenerate input: where the observations leave a direction open, the model does not move along it; the result says
        `degenerate` and the covariance is zero.
    Differentiability: both modes, in all of `problem` and `weight`, by the implicit function theorem with the exact
        Hessian; zero in `start`.
    """
    data = (problem, weight, loss)
    found, iterations, converged = _optimise(*jax.lax.stop_gradient((start, data)), options)
    model = jax.tree.map(lambda x: x[0], _with_derivative(type(problem))((found, data)).models)
    sums = jax.lax.stop_gradient(_moments(model, jnp.zeros((problem.tangent_dim,), _dtype(model)), data))
    d = problem.tangent_dim
    covariance, regular = symmetric_inverse(sums[:d, :d])
    result = Result.where(converged, Result.success, Result.not_converged)
    result = Result.where(regular, result, Result.degenerate)
    return ModelRefinement(model, jnp.where(regular, covariance, 0.0), 0.5 * sums[d, d], iterations, result)


def polish_model(start: Model, problem: ModelProblem, *, weight: Float[Array, " n"], loss: Loss, steps: int) -> Model:
    """A fixed number of reweighted Gauss–Newton steps, for hypotheses in lock-step.

    Weights follow the residuals from step to step, so a loss that is flat far out chooses the inliers anew each time.
    Whether the result is better is the caller's to check. Not meant to be differentiated.
    """
    d = problem.tangent_dim

    def step(_: Any, model: Model) -> Model:
        zero = jnp.zeros((d,), _dtype(model))
        residual, columns = _linearized(problem.residual, problem, model, zero)
        robust = weight * loss.weight(sum(r * r for r in residual))  # type: ignore[arg-type]
        rows = [jnp.concatenate([c, r[None]]) for c, r in zip(columns, residual, strict=True)]
        sums = jnp.sum(jnp.stack([jnp.matmul(x * robust[None], x.T, precision="highest") for x in rows]), axis=0)
        damped = sums[:d, :d] * (1.0 + 1e-4 * jnp.eye(d, dtype=sums.dtype))
        increment, _ = cholesky_solve(damped, -sums[:d, d:])
        return problem.retract(model, increment[:, 0])

    return jax.lax.fori_loop(0, steps, step, start)


def _linearized(residual: Callable[..., Any], problem: ModelProblem, model: Any, tangent: Array) -> tuple[Any, Any]:
    """Residual components `[n]` at a tangent, and their derivatives `[d, n]` by it."""
    value, derivative = jax.linearize(lambda y: residual(problem.retract(model, y)), tangent)
    return value, jax.vmap(derivative)(jnp.eye(problem.tangent_dim, dtype=tangent.dtype))


def _dtype(model: Any) -> Any:
    return jnp.result_type(*jax.tree.leaves(model))


def _residual(model: Any, data: Any) -> tuple[Array, ...]:
    problem, weight, loss = data
    return robustify(problem.residual(model), loss, weight)


def _moments(model: Any, tangent: Array, data: Any) -> Array:
    """[J r]ᵀ[J r] at retract(model, tangent), J by the tangent."""
    residual, columns = _linearized(lambda model: _residual(model, data), data[0], model, tangent)
    rows = jnp.concatenate([jnp.concatenate([c, r[None]]) for c, r in zip(columns, residual, strict=True)], axis=1)
    return jnp.matmul(rows, rows.T, precision="highest")


def _about(tangent: Array, args: Any) -> tuple[Array, Array]:
    start, data = args
    return _moments(start, tangent, data), jnp.eye(tangent.shape[0], dtype=tangent.dtype)


_compressed = compressed_residual(_about)


def _optimise(start: Any, data: Any, options: LMOptions) -> tuple[Any, Array, Array]:
    problem = data[0]
    zero = jnp.zeros((problem.tangent_dim,), _dtype(start))
    solution = minimize(_compressed, zero, (start, data), DenseDescent(), options)
    model = problem.retract(start, solution.value)
    return model, solution.stats["num_steps"], solution.result == optx.RESULTS.successful


def _gradient(model: Any, found_and_data: Any) -> Array:
    """Gradient of the cost by the tangent: zero at the optimum."""
    data = found_and_data[1]
    problem = data[0]

    def cost(tangent: Array) -> Array:
        residual = _residual(problem.retract(model, tangent), data)
        return 0.5 * sum(jnp.sum(r * r) for r in residual)  # type: ignore[return-value]

    return jax.grad(cost)(jnp.zeros((problem.tangent_dim,), _dtype(model)))


def _as_candidate(found_and_data: Any) -> Candidates[Any]:
    return Candidates(jax.tree.map(lambda x: x[None], found_and_data[0]), jnp.ones((1,), bool))


@functools.cache
def _with_derivative(kind: Any) -> Callable[[Any], Candidates[Any]]:
    """The optimum, found beforehand, with its derivative."""
    return implicit(_as_candidate, _gradient, kind.retract, kind.tangent_dim)
