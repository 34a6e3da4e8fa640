"""Least squares over many observations and few variables, handed to optimistix as a system of few equations.

A loop that carries residuals and Jacobian of every observation is bound by memory. All that Levenberg–Marquardt needs is
M = [J r]ᵀ[J r]. With M = LLᵀ, the d + 1 residuals r̃ = (last row of L) with Jacobian J̃ = (first d rows of L)ᵀ have the
same cost, gradient JᵀR and Gauss–Newton matrix JᵀJ, whatever the number of observations. So M is summed over the
observations in one pass, and optimistix sees d + 1 residuals.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from vojax._numerics import cholesky_factor
from vojax._types import Array

# moments(y, args) -> lower triangle of [J r]ᵀ[J r] in a local tangent δ at y, and dδ/dy as rows of entries.
Moments = Callable[[Array, Any], tuple[Sequence[Sequence[Array]], Sequence[Sequence[Array]]]]


def compressed_residual(moments: Moments) -> Callable[[Array, Any], Array]:
    """Turn accumulated moments into a residual function of the same least-squares problem.

    The function has a derivative in `y` only; `args` are constants to it.
    """

    @jax.custom_jvp
    def residual(y: Array, args: Any) -> Array:
        rows = cholesky_factor(moments(y, args)[0])[0]
        return jnp.stack(rows[-1])

    @residual.defjvp
    def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
        y, args = primals
        accumulated, local_from_y = moments(y, args)
        rows = cholesky_factor(accumulated)[0]
        size = len(rows) - 1
        # J̃ = (first rows of L)ᵀ dδ/dy, formed once: `jvp` is applied to every basis vector in turn.
        jacobian = [
            [sum(rows[j][k] * local_from_y[j][i] for j in range(k, size)) for i in range(size)] for k in range(size)
        ]
        dy = tangents[0]
        change = [sum(jacobian[k][i] * dy[i] for i in range(size)) for k in range(size)]
        return jnp.stack(rows[-1]), jnp.stack([*change, jnp.zeros_like(dy[0])])  # type: ignore

    return residual

