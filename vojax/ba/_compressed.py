"""Least squares over many observations and few variables, handed to optimistix as a system of few equations.

A loop that carries residuals and Jacobian of every observation is bound by memory. All that Levenberg–Marquardt needs
is M = [J r]ᵀ[J r]. With M = L Lᵀ, the d + 1 residuals r̃ = (last row of L) with Jacobian J̃ = (first d rows of L)ᵀ
have the same cost, gradient Jᵀr and Gauss–Newton matrix JᵀJ, whatever the number of observations. So M is summed over
the observations in one pass, and optimistix sees d + 1 residuals.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from vojax._numerics import cholesky_factor
from vojax._types import Array

# moments(y, args) -> [J r]ᵀ[J r] by a local tangent δ at y, and dδ/dy.
Moments = Callable[[Array, Any], tuple[Array, Array]]


def compressed_residual(moments: Moments) -> Callable[[Array, Any], Array]:
    """Turn accumulated moments into a residual function of the same least-squares problem.

    The function has a derivative in `y` only; `args` are constants to it.
    """

    @jax.custom_jvp
    def residual(y: Array, args: Any) -> Array:
        return _factor(moments(y, args)[0])[-1]

    @residual.defjvp
    def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
        accumulated, local_from_y = moments(*primals)
        factor = _factor(accumulated)
        # Formed once: the product below is taken with every basis vector in turn.
        jacobian = jnp.sum(factor[:-1, :, None] * local_from_y[:, None, :], axis=0)
        return factor[-1], jnp.sum(jacobian * tangents[0][None], axis=1)

    return residual


def _factor(matrix: Array) -> Array:
    """Lower-triangular Cholesky factor."""
    columns, _, _ = cholesky_factor(matrix)
    return jnp.stack([jnp.concatenate([jnp.zeros_like(matrix[:k, 0]), column]) for k, column in enumerate(columns)], 1)
