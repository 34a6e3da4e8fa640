"""Problems of many sizes through few compilations: rows are filled up to one of a few sizes, and do not count."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vojax._types import Array

from ._estimate import Estimate
from ._pairs import check_sigma


def bucket_size(n: int) -> int:
    """The size to which n rows are filled up: four sizes an octave, so at most a quarter more.

    Example:
        >>> [bucket_size(n) for n in (5, 16, 17, 200, 224, 1000)]
        [8, 16, 20, 224, 224, 1024]
    """
    step = 2 ** max((n - 1).bit_length() - 3, 0)
    return max(-(-n // step) * step, 8)


def in_bucket(
    estimate: Callable[..., Estimate[Any]],
    observations: tuple[Array, ...],
    others: tuple[Any, ...],
    sigma: Any,
    quality: Any,
    mask: Any,
) -> Estimate[Any]:
    """Call `estimate(*observations, *others, sigma, quality, mask)` at the size of the bucket.

    Args:
        estimate: Compiled by size.
        observations: What has a row for each correspondence.
        others: What has not.
        sigma: Noise, or None; arrays have a row for each correspondence.
        quality: Of each correspondence, or None.
        mask: Rows that count, or None.

    Returns:
        The estimate, with the inliers of the rows that were given.

    Raises:
        ValueError: If noise, quality or mask do not fit the observations.
    """
    n = observations[0].shape[0]
    if sigma is not None:
        check_sigma(sigma, n)
    for name, rows in (("quality", quality), ("mask", mask)):
        if rows is not None and jnp.shape(rows) != (n,):
            raise ValueError(f"{name} has shape {jnp.shape(rows)}: expected one entry for each of {n} rows, ({n},)")
    # Also where nothing is filled up: a mask that is missing would be a compilation of its own.
    mask = np.ones(n, bool) if mask is None else mask
    size = bucket_size(n)
    if size == n:
        return estimate(*observations, *others, sigma, quality, mask)
    noise = None if sigma is None or not jnp.ndim(sigma) else sigma
    observations, filled_noise, quality, mask = _filled((observations, noise, quality, mask), size)
    found = estimate(*observations, *others, sigma if noise is None else filled_noise, quality, mask)
    return dataclasses.replace(found, inliers=_first(found.inliers, n))


@functools.partial(jax.jit, static_argnums=1)
def _filled(rows: Any, size: int) -> Any:
    """Rows of zeros at the end of every array."""
    return jax.tree.map(lambda x: jnp.pad(x, [(0, size - x.shape[0])] + [(0, 0)] * (x.ndim - 1)), rows)


@functools.partial(jax.jit, static_argnums=1)
def _first(x: Array, n: int) -> Array:
    return x[:n]
