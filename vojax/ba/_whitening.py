"""Whitening of measurements: noise enters every least-squares problem here, by components."""

from typing import Any

import jax.numpy as jnp

from vojax._numerics import cholesky_factor
from vojax._types import Array


def whitening(sigma_px: Any, shape: tuple[int, ...], d: int, dtype: Any) -> tuple[Array, ...]:
    """Inverse square roots of measurement covariances.

    Args:
        sigma_px: Standard deviation in pixels: one for all `()`, one per observation `shape`, or covariances
            `[*shape, d, d]` in px².
        shape: Of the observations.
        d: Components of a measurement.
        dtype: Of the result.

    Returns:
        One array (independent components of equal deviation), or the d(d+1)/2 entries of a lower-triangular factor,
        row by row.

    Raises:
        ValueError: If the shape of `sigma_px` is none of these.
    """
    sigma = jnp.asarray(sigma_px, dtype)
    if sigma.shape in ((), shape):
        return (1.0 / sigma,)
    if sigma.shape != (*shape, d, d):
        raise ValueError(
            f"sigma_px has shape {sigma.shape}: expected one standard deviation (), one for each observation {shape}, "
            f"or covariances {(*shape, d, d)}"
        )
    columns, inverse, _ = cholesky_factor(jnp.moveaxis(sigma, (-2, -1), (0, 1)))
    whitened: list[list[Array]] = []  # inverse of the Cholesky factor, by forward substitution
    for i in range(d):
        row = [-inverse[i] * sum(columns[k][i - k] * whitened[k][j] for k in range(j, i)) for j in range(i)]
        whitened.append([*row, inverse[i]])
    return tuple(entry for row in whitened for entry in row)


def whiten(whitening: tuple[Array, ...], residual: tuple[Array, ...]) -> tuple[Array, ...]:
    """Apply a whitening to residual components."""
    if len(whitening) == 1:
        return tuple(whitening[0] * r for r in residual)
    rows = range(len(residual))
    return tuple(sum(whitening[i * (i + 1) // 2 + j] * residual[j] for j in range(i + 1)) for i in rows)  # type: ignore
