"""A batch in one call gives what its problems give one by one, whatever varies within it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.cameras import Pinhole
from vojax.datasets import simulate_absolute_pose
from vojax.robust import RansacOptions, estimate_absolute_pose

pytestmark = pytest.mark.optimized

N = 40


def estimate(points, pixels, key, focal):
    camera = Pinhole(fx=focal, fy=focal, cx=639.5, cy=479.5)
    options = RansacOptions(max_hypotheses=256, chunk_size=64)
    found = estimate_absolute_pose(points, pixels, camera, key=key, options=options)
    return found.model.wxyz_xyz, found.num_hypotheses


@pytest.fixture(scope="module")
def problems():
    draw = jax.vmap(lambda key: simulate_absolute_pose(key, N, outlier_fraction=0.6))
    return jax.jit(draw)(jax.random.split(jax.random.key(0), 4))


def test_keys_vary_and_observations_are_shared(problems):
    keys = jax.random.split(jax.random.key(1), 4)
    shared = problems.points_world[0], problems.pixels[0]
    batch = jax.jit(jax.vmap(lambda key: estimate(*shared, key, 800.0)))(keys)
    alone = jax.jit(lambda key: estimate(*shared, key, 800.0))
    for i, key in enumerate(keys):
        pose, drawn = alone(key)
        assert int(drawn) == int(batch[1][i])
        np.testing.assert_allclose(batch[0][i], pose, atol=1e-4)


@pytest.mark.slow
def test_every_problem_stops_when_it_is_done_in_a_batch_of_batches(problems):
    keys = jax.random.split(jax.random.key(2), (3, 4))
    many = jax.vmap(jax.vmap(estimate, (0, 0, 0, None)), (None, None, 0, 0))
    focal = jnp.array([800.0, 801.0, 799.0])
    poses, drawn = jax.jit(many)(problems.points_world, problems.pixels, keys, focal)
    assert poses.shape == (3, 4, 7)
    assert len(np.unique(drawn)) > 1  # in lock-step all would draw what the last one needs
    alone = jax.jit(estimate)
    for j in range(3):
        for i in range(4):
            expected = alone(problems.points_world[i], problems.pixels[i], keys[j, i], focal[j])
            assert int(drawn[j, i]) == int(expected[1])
            np.testing.assert_allclose(poses[j, i], expected[0], atol=1e-3)


def test_derivatives_go_through_a_batch(problems):
    keys = jax.random.split(jax.random.key(3), 4)

    def depth(pixels):
        return jnp.sum(
            jax.vmap(lambda x, u, key: estimate(x, u, key, 800.0)[0][6])(problems.points_world, pixels, keys)
        )

    gradient = jax.jit(jax.grad(depth))(problems.pixels)
    assert bool(jnp.isfinite(gradient).all())
    assert (jnp.abs(gradient).max(axis=(1, 2)) > 0).all()
