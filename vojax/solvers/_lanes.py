"""Batching onto the last axis."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from vojax._types import Array

Kernel = Callable[..., tuple[Array, ...]]


def lanes_last(kernel: Kernel, chunk: int | None = None) -> Kernel:
    """Make `vmap` of an elementwise kernel carry the batch on the last axis, whatever axis the caller chose.

    The kernel takes arrays `[..., *lanes]` and returns a tuple of them. A CPU vectorises over the innermost axis, but
    the batching of `stack` and of new axes moves the batch to the front. Here the caller's arrays are transposed once
    at the boundary; with `vmap(..., in_axes=-1, out_axes=-1)` these transpositions cancel.

    Args:
        kernel: The solver.
        chunk: Most lanes at once; larger batches go through in a loop. For kernels with large tables per problem, which
            then stay in the cache; small kernels lose by it.
    """

    @custom_vmap
    def batched_kernel(*arrays: Array) -> tuple[Array, ...]:
        return kernel(*arrays)

    @batched_kernel.def_vmap
    def _(axis_size: int, batched: list[bool], *arrays: Array) -> tuple[tuple[Array, ...], tuple[bool, ...]]:
        last = [
            jnp.moveaxis(x, 0, -1) if is_batched else jnp.broadcast_to(x[..., None], (*x.shape, axis_size))
            for x, is_batched in zip(arrays, batched, strict=True)
        ]
        results = kernel(*last) if chunk is None or axis_size <= chunk else _in_chunks(kernel, last, axis_size, chunk)
        return tuple(jnp.moveaxis(x, -1, 0) for x in results), (True,) * len(results)

    return batched_kernel


def _in_chunks(kernel: Kernel, arrays: list[Array], size: int, chunk: int) -> tuple[Array, ...]:
    """Run a kernel on pieces of the last axis, one after the other; the last piece is filled up with zeros."""
    count = -(-size // chunk)
    pieces = []
    for x in arrays:
        padded = jnp.pad(x, ((0, 0),) * (x.ndim - 1) + ((0, count * chunk - size),))
        pieces.append(jnp.moveaxis(padded.reshape(*x.shape[:-1], count, chunk), -2, 0))
    results = jax.lax.map(lambda piece: kernel(*piece), tuple(pieces))
    return tuple(jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], count * chunk)[..., :size] for x in results)
