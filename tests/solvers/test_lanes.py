"""Batches on the last axis: however they are nested, in chunks or as one kernel, the answers are the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax._numerics import lane_sum
from vojax.solvers._lanes import lanes_last, one_kernel


def kernel(x, y):
    """Some work with a loop, a sum and a division: [2, *lanes] and [3, *lanes]."""
    scaled = jax.lax.fori_loop(0, 3, lambda _, z: 0.5 * (z + lane_sum(x * x, axis=0)[None] / z), y)
    return scaled, jnp.max(x, axis=0) > scaled[0]


def arrays(*batch):
    x, y = np.random.default_rng(0).uniform(1.0, 2.0, (2, 3, *batch)).astype(np.float32)
    return jnp.asarray(x[:2]), jnp.asarray(y)


@pytest.mark.parametrize("wrapped", [False, True], ids=["kernels", "one kernel"])
@pytest.mark.parametrize(("batch", "chunk"), [(1, None), (7, None), (7, 3), (6, 3), (300, 128)])
def test_a_batch_is_what_each_problem_gives(batch, chunk, wrapped):
    solve = lanes_last(one_kernel(kernel) if wrapped else kernel, chunk=chunk)
    x, y = arrays(batch)
    values, flags = jax.jit(jax.vmap(solve, in_axes=-1, out_axes=-1))(x, y)
    for i in (0, batch // 2, batch - 1):
        value, flag = kernel(x[:, i], y[:, i])
        np.testing.assert_allclose(values[:, i], value, rtol=1e-6)
        assert flags[i] == flag


@pytest.mark.slow
def test_a_batch_of_batches_is_one_long_batch():
    solve = lanes_last(one_kernel(kernel), chunk=4)
    x, y = arrays(5, 3)
    nested = jax.vmap(jax.vmap(solve, in_axes=-1, out_axes=-1), in_axes=-1, out_axes=-1)
    values, flags = nested(x, y)
    flat_values, flat_flags = jax.vmap(solve, in_axes=-1, out_axes=-1)(x.reshape(2, 15), y.reshape(3, 15))
    np.testing.assert_allclose(values.reshape(3, 15), flat_values, rtol=1e-6)
    np.testing.assert_array_equal(flags.reshape(15), flat_flags)
    # One argument shared by the outer batch.
    shared = jax.vmap(jax.vmap(solve, in_axes=-1, out_axes=-1), in_axes=(-1, None), out_axes=-1)(x, y[..., 0])[0]
    np.testing.assert_allclose(shared[..., 0], values[..., 0], rtol=1e-6)


def test_the_lane_sum_is_the_sum():
    x = jnp.asarray(np.random.default_rng(1).normal(size=(3, 4, 5)), jnp.float32)
    for axis in (0, 1, -1, (0, 2)):
        np.testing.assert_allclose(lane_sum(x, axis=axis), jnp.sum(x, axis=axis), rtol=1e-6, atol=1e-6)
    weights = jnp.arange(20.0, dtype=jnp.float32).reshape(4, 5)
    gradient = jax.grad(lambda x: jnp.vdot(weights, lane_sum(x * x, axis=0)))(x)
    np.testing.assert_allclose(gradient, 2 * weights[None] * x, rtol=1e-6)
    np.testing.assert_allclose(
        jax.vmap(lambda x: lane_sum(x, axis=0), in_axes=1)(x), jnp.sum(x, axis=0), rtol=1e-6, atol=1e-6
    )
    assert lane_sum(jnp.zeros((0, 3)), axis=0).tolist() == [0.0, 0.0, 0.0]
