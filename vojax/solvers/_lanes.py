"""Batching onto the last axis."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.experimental.xla_metadata import set_xla_metadata

from vojax._types import Array

Kernel = Callable[..., tuple[Array, ...]]

_UNTRIED_VERSION = (0, 13)


def lanes_last(kernel: Kernel, chunk: int | None = None) -> Kernel:
    """Make `vmap` of an elementwise kernel carry the batch on the last axis, whatever axis the caller chose.

    The kernel takes arrays `[..., *lanes]` and returns a tuple of them. A CPU vectorises over the innermost axis, but
    the batching of `stack` and of new axes moves the batch to the front. Here the caller's arrays are transposed once
    at the boundary; with `vmap(..., in_axes=-1, out_axes=-1)` these transpositions cancel. A batch of batches becomes
    one long batch.

    Args:
        kernel: The solver.
        chunk: Most lanes at once; larger batches go through in a loop. For kernels with large tables per problem, which
            then stay in the cache; small kernels lose by it.
    """

    @custom_vmap
    def one(*arrays: Array) -> tuple[Array, ...]:
        return kernel(*arrays)

    @one.def_vmap
    def _(axis_size: int, batched: list[bool], *arrays: Array) -> tuple[tuple[Array, ...], tuple[bool, ...]]:
        results = many(*(jnp.moveaxis(x, 0, -1) for x in _all_batched(axis_size, batched, arrays)))
        return tuple(jnp.moveaxis(x, -1, 0) for x in results), (True,) * len(results)

    @custom_vmap
    def many(*arrays: Array) -> tuple[Array, ...]:
        size = arrays[0].shape[-1]
        return kernel(*arrays) if chunk is None or size <= chunk else _in_chunks(kernel, arrays, size, chunk)

    @many.def_vmap
    def _(axis_size: int, batched: list[bool], *arrays: Array) -> tuple[tuple[Array, ...], tuple[bool, ...]]:
        arrays = _all_batched(axis_size, batched, arrays)
        lanes = arrays[0].shape[-1]
        long = (jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], axis_size * lanes) for x in arrays)
        short = (x.reshape(*x.shape[:-1], axis_size, lanes) for x in many(*long))
        results = tuple(jnp.moveaxis(x, -2, 0) for x in short)
        return results, (True,) * len(results)

    return one


def _all_batched(axis_size: int, batched: list[bool], arrays: tuple[Array, ...]) -> tuple[Array, ...]:
    """Every array with the batch on its first axis."""
    return tuple(
        x if is_batched else jnp.broadcast_to(x[None], (axis_size, *x.shape))
        for x, is_batched in zip(arrays, batched, strict=True)
    )


def _in_chunks(kernel: Kernel, arrays: tuple[Array, ...], size: int, chunk: int) -> tuple[Array, ...]:
    """Run a kernel on pieces of the last axis, one after the other; the last piece is filled up with zeros."""
    count = -(-size // chunk)
    pieces = []
    for x in arrays:
        padded = jnp.pad(x, ((0, 0),) * (x.ndim - 1) + ((0, count * chunk - size),))
        pieces.append(jnp.moveaxis(padded.reshape(*x.shape[:-1], count, chunk), -2, 0))
    results = jax.lax.map(lambda piece: kernel(*piece), tuple(pieces))
    return tuple(jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], count * chunk)[..., :size] for x in results)


def one_kernel(phase: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel, or a phase of one, as one function that runs on one thread.

    XLA makes a kernel of every few operations. What these hand on in memory, and from thread to thread, costs more
    than the work of a solver of thousands of them: as one function `gp3p`, `p4pf`, `six_point` take half the time of
    two threads, on one, and compile faster. Use it with `chunk` (128 lanes: of much larger operations XLA refuses to
    make one function) and without sums and products of matrices, which are library calls (`lane_sum`).

    An attribute of XLA's CPU compiler, which gives it to small loops of its own accord; other compilers are not asked,
    nor versions on which it was not tried.
    """
    if jax.__version_info__ >= _UNTRIED_VERSION:
        return phase

    def plain(*arguments: Any) -> Any:
        with set_xla_metadata(inlineable=None, xla_cpu_small_call=None):
            return phase(*arguments)

    compiled = jax.jit(plain)

    def call(*arguments: Any) -> Any:
        if jax.default_backend() != "cpu":
            return phase(*arguments)
        with set_xla_metadata(inlineable="false", xla_cpu_small_call="true"):
            return compiled(*arguments)

    return call
