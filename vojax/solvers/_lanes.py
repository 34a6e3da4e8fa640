"""Batching onto the last axis."""

from collections.abc import Callable

import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from vojax._types import Array

Kernel = Callable[..., tuple[Array, ...]]


def lanes_last(kernel: Kernel) -> Kernel:
    """Make `vmap` of an elementwise kernel carry the batch on the last axis, whatever axis the caller chose.

    The kernel takes arrays `[..., *lanes]` and returns a tuple of them. A CPU vectorises over the innermost axis, but
    the batching of `stack` and of new axes moves the batch to the front. Here the caller's arrays are transposed once
    at the boundary; with `vmap(..., in_axes=-1, out_axes=-1)` these transpositions cancel.
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
        results = kernel(*last)
        return tuple(jnp.moveaxis(x, -1, 0) for x in results), (True,) * len(results)

    return batched_kernel
