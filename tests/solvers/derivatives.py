"""Derivatives of a solver, forward and reverse, against central differences made in one batch."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.solvers.problems import solve_in_batches


def _weighted(leaves, valid, numpy):
    """Sum of all numbers in valid slots, each with another factor; slots are the axis after the batch."""
    total = 0.0
    for leaf in leaves:
        width = int(np.prod(leaf.shape[valid.ndim :]))
        factors = numpy.arange(1.0, valid.shape[-1] * width + 1.0).reshape(*leaf.shape[valid.ndim - 1 :]) / width
        mask = valid.reshape(*valid.shape, *(1,) * (leaf.ndim - valid.ndim))
        if valid.ndim > 1:
            factors = factors[None]
        axes = tuple(range(valid.ndim - 1, leaf.ndim))
        total = total + numpy.sum(numpy.where(mask, leaf, 0.0) * factors, axis=axes)
    return total


def assert_derivatives(solver, solve_last, data, step=1e-6, rtol=1e-6, chosen=None):
    """Reverse mode equals central differences, and forward mode equals reverse mode, in float64.

    Args:
        solver: Called on the arrays of one problem.
        solve_last: The same, jitted, batch on the last axis.
        data: Arrays of one problem.
        step: Of the differences.
        rtol: Relative to the largest derivative with respect to an array.
        chosen: Which arrays; all of them by default.
    """
    data = [np.asarray(x, np.float64) for x in data]
    chosen = tuple(range(len(data))) if chosen is None else chosen

    def function(*arrays):
        candidates = solver(*arrays)
        return _weighted(jax.tree.leaves(candidates.models), candidates.valid, jnp)

    @jax.jit
    def both(*arrays):
        reverse = jax.grad(function, chosen)(*arrays)
        _, pushed = jax.linearize(
            lambda *x: function(*(x[chosen.index(i)] if i in chosen else arrays[i] for i in range(len(arrays)))),
            *(arrays[i] for i in chosen),
        )
        sizes = [arrays[i].size for i in chosen]
        basis = jnp.eye(sum(sizes))
        parts = jnp.split(basis, np.cumsum(sizes)[:-1], axis=1)
        tangents = [part.reshape(-1, *arrays[i].shape) for part, i in zip(parts, chosen, strict=True)]
        return reverse, jax.vmap(pushed)(*tangents)

    reverse, forward = both(*data)
    backward = np.concatenate([np.asarray(x).ravel() for x in reverse])
    np.testing.assert_allclose(forward, backward, rtol=1e-8, atol=1e-8 * np.abs(backward).max())
    batch = [[] for _ in data]
    for index in chosen:
        for entry in np.ndindex(data[index].shape):
            for change in (step, -step):
                for k, x in enumerate(data):
                    moved = x.copy()
                    if k == index:
                        moved[entry] += change
                    batch[k].append(moved)
    candidates = solve_in_batches(solve_last, *(np.stack(x) for x in batch), dtype=np.float64)
    values = _weighted(jax.tree.leaves(candidates.models), candidates.valid, np).reshape(-1, 2)
    numeric = (values[:, 0] - values[:, 1]) / (2.0 * step)
    assert np.abs(numeric).max() > 0
    start = 0
    for x, index in zip(reverse, chosen, strict=True):
        part = numeric[start : start + data[index].size].reshape(x.shape)
        np.testing.assert_allclose(x, part, rtol=rtol, atol=rtol * np.abs(part).max())
        start += data[index].size
