"""Derivatives of solvers by the implicit function theorem.

A solution x of F(x, data) = 0 moves by

    dξ = -(∂F/∂ξ)⁻¹ (∂F/∂data) ddata,        x(ξ) = retract(x, ξ),                                               (1)

whatever procedure found x: root finding, an SVD, an iteration to convergence. So nothing is differentiated through,
and the derivative is exact where that of the procedure is not a number (equal singular values, double eigenvalues).
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from vojax._numerics import tiny
from vojax._types import Array, Float
from vojax.lie import SE3, Sim3

from ._candidates import Candidates

Data = TypeVar("Data")
Model = TypeVar("Model")
LinearSolve = Callable[[Array, Array], Array]
Pose = TypeVar("Pose", SE3, Sim3)


def retract_camera(cam_from_world: Pose, tangent: Float[Array, "d"]) -> Pose:
    """Perturb a pose in the camera's frame: `world_from_cam @ exp(ξ)`, which is `exp(-ξ) @ cam_from_world`."""
    return type(cam_from_world).exp(-tangent) @ cam_from_world


def solve_square(matrix: Float[Array, "d d"], rhs: Float[Array, "d"]) -> Float[Array, "d"]:
    """Solve a small square system; zero where the matrix is singular to working precision.

    Gaussian elimination with partial pivoting after scaling rows and columns, written elementwise so that a batch of
    systems vectorises. Linear in `rhs`: pivots and the singularity test depend on the matrix alone.

    Args:
        matrix: Coefficients, not necessarily finite.
        rhs: Right-hand side.

    Returns:
        The solution, or zeros for a singular or non-finite matrix.
    """
    size = rhs.shape[0]
    matrix = jnp.where(jnp.all(jnp.isfinite(matrix)), matrix, 0.0)
    floor = tiny(matrix)
    row_scale = 1.0 / jnp.maximum(jax.lax.stop_gradient(jnp.max(jnp.abs(matrix), axis=1)), floor)
    matrix, rhs = matrix * row_scale[:, None], rhs * row_scale
    column_scale = 1.0 / jnp.maximum(jax.lax.stop_gradient(jnp.max(jnp.abs(matrix), axis=0)), floor)
    matrix = matrix * column_scale[None, :]

    # A singular matrix is replaced by the identity before anything is divided by its pivots.
    regular = _smallest_pivot(jax.lax.stop_gradient(matrix)) > 8 * size * float(jnp.finfo(matrix.dtype).eps)
    matrix = jnp.where(regular, matrix, jnp.eye(size, dtype=matrix.dtype))
    rhs = jnp.where(regular, rhs, 0.0)
    rows = jnp.arange(size)
    for k in range(size):
        swap = _pivot_row(matrix[:, k], rows, k)
        matrix, rhs = _swap(matrix, k, swap, rows), _swap(rhs, k, swap, rows)
        factor = jnp.where(rows == k, 0.0, matrix[:, k] / matrix[k, k])
        matrix = matrix - factor[:, None] * matrix[k][None, :]
        rhs = rhs - factor * rhs[k]
    return rhs / jnp.diagonal(matrix) * column_scale


def _pivot_row(column: Array, rows: Array, k: int) -> Array:
    return jnp.argmax(jnp.where(rows >= k, jnp.abs(jax.lax.stop_gradient(column)), -1.0))


def _swap(x: Array, k: int, other: Array, rows: Array) -> Array:
    """Exchange rows k and `other`, by masks instead of a gather."""
    lead = (slice(None),) + (None,) * (x.ndim - 1)
    is_other = (rows == other)[lead]
    from_other = jnp.sum(jnp.where(is_other, x, 0.0), axis=0)
    swapped = jnp.where(is_other, x[k][None], x)
    return jnp.where((rows == k)[lead], from_other[None], swapped)


def _smallest_pivot(matrix: Array) -> Array:
    size = matrix.shape[0]
    rows = jnp.arange(size)
    smallest = jnp.asarray(jnp.inf, matrix.dtype)
    for k in range(size):
        matrix = _swap(matrix, k, _pivot_row(matrix[:, k], rows, k), rows)
        pivot = jnp.abs(matrix[k, k])
        smallest = jnp.minimum(smallest, pivot)
        factor = jnp.where(rows > k, matrix[:, k] / jnp.where(pivot > 0, matrix[k, k], 1.0), 0.0)
        matrix = matrix - factor[:, None] * matrix[k][None, :]
    return smallest


def implicit(
    solve: Callable[[Data], Candidates[Model]],
    residual: Callable[[Model, Data], Array],
    retract: Callable[[Model, Array], Model],
    tangent_dim: int,
    linear_solve: LinearSolve = solve_square,
) -> Callable[[Data], Candidates[Model]]:
    """Give a solver its derivative by the implicit function theorem, in forward and in reverse mode.

    Args:
        solve: `data -> Candidates` for one problem, never differentiated. `data` is a pytree of arrays; everything the
            solution depends on must be in it.
        residual: `(model, data) -> [tangent_dim]`, as many equations as tangent coordinates, zero at a solution: the
            equations of a minimal solver, or the gradient of a cost at its optimum. It must have finite derivatives at
            the placeholder model with all data zero, which stand in for a slot that is not valid.
        retract: `(model, ξ) -> model`, a chart with `retract(model, 0) = model`. The derivative does not depend on the
            chart, the conditioning of the linear system does: see `retract_camera`.
        tangent_dim: Number of degrees of freedom of the model.
        linear_solve: `(matrix, rhs) -> solution`, linear in `rhs`; decides singularity from the matrix alone and
            returns zeros there.

    Returns:
        `solve` with a derivative. It is zero for slots that are not valid and for singular systems (a double root).
    """

    @jax.custom_jvp
    def solver(data: Data) -> Candidates[Model]:
        return solve(data)

    @solver.defjvp
    def _(primals: tuple[Data], tangents: tuple[Data]) -> tuple[Any, Any]:
        (data,), (data_tangent,) = primals, tangents
        candidates = solver(data)  # through the rule again, for derivatives of higher order

        def slot_tangent(model: Model, valid: Array) -> Model:
            def equations(tangent: Array, data: Data) -> Array:
                # Invalid slots see benign numbers: 0 · NaN would survive a mask applied to the result.
                usable = jax.tree.map(lambda x: jnp.where(valid, x, jnp.zeros_like(x)), data)
                return residual(retract(model, tangent), usable)

            zero = jnp.zeros(tangent_dim, jnp.result_type(*jax.tree.leaves(model)))
            jacobian = jax.jacfwd(equations)(zero, data)
            _, change = jax.jvp(lambda data: equations(zero, data), (data,), (data_tangent,))
            tangent = jnp.where(valid, linear_solve(jacobian, -change), 0.0)
            return jax.jvp(lambda tangent: retract(model, tangent), (zero,), (tangent,))[1]

        models_tangent = jax.vmap(slot_tangent)(candidates.models, candidates.valid)
        no_tangent = np.zeros(candidates.valid.shape, jax.dtypes.float0)
        leaves = [*jax.tree.leaves(models_tangent), no_tangent]
        return candidates, jax.tree.unflatten(jax.tree.structure(candidates), leaves)

    return solver
