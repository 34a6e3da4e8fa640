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


def perturb_camera(cam_from_world: Pose, tangent: Float[Array, "d"]) -> Pose:
    """Perturb a pose in the camera's frame, `world_from_cam @ exp(ξ)` or `exp(-ξ) @ cam_from_world`, to first order.

    A derivative needs no more than that, and without the exponential it compiles several times faster.
    """
    parameters = cam_from_world.parameters()
    w, axis, translation = parameters[0], parameters[1:4], parameters[4:7]
    rho, phi = tangent[:3], tangent[3:6]
    half = 0.5 * phi
    changes = [
        jnp.dot(half, axis)[None],
        -half * w - jnp.cross(half, axis),
        -rho - jnp.cross(phi, translation),
    ]
    if isinstance(cam_from_world, Sim3):
        growth = tangent[6]
        changes[2] = changes[2] - growth * translation
        changes.append(-growth * parameters[7:])
    return type(cam_from_world)(parameters + jnp.concatenate(changes))


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
    rows = jnp.arange(size)
    regular = jnp.all(jnp.isfinite(matrix))
    matrix = jnp.where(regular, matrix, 0.0)
    row_scale = 1.0 / jnp.maximum(jax.lax.stop_gradient(jnp.max(jnp.abs(matrix), axis=1)), tiny(matrix))
    matrix, rhs = matrix * row_scale[:, None], rhs * row_scale
    column_scale = 1.0 / jnp.maximum(jax.lax.stop_gradient(jnp.max(jnp.abs(matrix), axis=0)), tiny(matrix))
    matrix = matrix * column_scale[None, :]
    smallest = 8 * size * float(jnp.finfo(matrix.dtype).eps)

    # A loop, not unrolled: fusion would recompute every earlier step in each later one.
    def eliminate(k: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        matrix, rhs, regular = state
        is_k = rows == k
        column = jnp.sum(jnp.where(is_k[None, :], matrix, 0.0), axis=1)
        candidates = jnp.where(rows >= k, jnp.abs(jax.lax.stop_gradient(column)), -1.0)
        is_pivot = rows == jnp.argmax(candidates)
        pivot = jnp.sum(jnp.where(is_pivot, column, 0.0))
        usable = jnp.abs(pivot) > smallest
        # Divide by the pivot only where it is one: a masked result with infinite factors would give 0 · inf backwards.
        inverse = jnp.where(usable, 1.0 / jnp.where(usable, pivot, 1.0), 0.0)

        def step(x: Array, factor: Array) -> Array:
            lead = (slice(None),) + (None,) * (x.ndim - 1)
            row_k = jnp.sum(jnp.where(is_k[lead], x, 0.0), axis=0)[None]
            row_pivot = jnp.sum(jnp.where(is_pivot[lead], x, 0.0), axis=0)[None] * inverse
            x = jnp.where(is_pivot[lead], row_k, x)
            return jnp.where(is_k[lead], row_pivot, x - factor[lead] * row_pivot)

        column_k = jnp.sum(jnp.where(is_k, column, 0.0))
        factor = jnp.where(is_pivot, column_k, column)
        return step(matrix, factor), step(rhs, factor), regular & usable

    matrix, rhs, regular = jax.lax.fori_loop(0, size, eliminate, (matrix, rhs, regular))
    return jnp.where(regular, rhs * column_scale, 0.0)


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
        retract: `(model, ξ) -> model` with `retract(model, 0) = model`, a chart of the manifold or one correct to first
            order. The derivative does not depend on the chart; the conditioning of the linear system does, hence
            `perturb_camera` for poses.
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

    # Compiled once, so that calls outside `jit` do not compile the loops of a solver each time.
    return jax.jit(solver)
