import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.lie import SE3, SO3, cumulative_compose, interpolate


def test_interpolate_ends_and_middle(group, dtype):
    tolerance = 5e-6 if dtype is jnp.float32 else 1e-12
    T0 = group.sample_uniform(jax.random.key(0), (50,), dtype)
    T1 = group.sample_uniform(jax.random.key(1), (50,), dtype)
    between = jax.jit(interpolate)
    start, end, middle = (between(T0, T1, jnp.asarray(alpha, dtype)) for alpha in (0.0, 1.0, 0.5))
    np.testing.assert_allclose(start.as_matrix(), T0.as_matrix(), rtol=0, atol=tolerance)
    np.testing.assert_allclose(end.as_matrix(), T1.as_matrix(), rtol=0, atol=tolerance)
    # The middle is as far, in the same direction, from one end as the other is from it.
    first, second = (T0.inverse() @ middle).as_matrix(), (middle.inverse() @ T1).as_matrix()
    np.testing.assert_allclose(first, second, rtol=0, atol=10 * tolerance)


@pytest.mark.slow
def test_interpolate_moves_at_constant_speed(group, x64):
    T0, T1 = (group.sample_uniform(jax.random.key(seed)) for seed in (2, 3))
    alphas = jnp.linspace(-0.2, 1.2, 15)
    path = interpolate(T0, T1, alphas)
    assert path.get_batch_axes() == (15,)
    steps = [
        (group(a).inverse() @ group(b)).log() for a, b in zip(path.parameters(), path.parameters()[1:], strict=False)
    ]
    np.testing.assert_allclose(np.stack(steps), np.tile(0.1 * (T0.inverse() @ T1).log(), (14, 1)), atol=1e-12)


def test_interpolate_takes_the_shorter_way():
    T0, T1 = SO3.identity(), SO3.exp(jnp.array([0.0, 0.0, 1.5 * jnp.pi]))
    middle = interpolate(T0, T1, 0.5)
    np.testing.assert_allclose(middle.log(), [0.0, 0.0, -0.25 * np.pi], atol=1e-6)


@pytest.mark.slow
def test_equal_ends_and_half_turns(group):
    T = group.sample_uniform(jax.random.key(4))
    half = T @ group.exp(jnp.zeros(group.tangent_dim).at[-2 if group.tangent_dim == 7 else -1].set(jnp.pi))

    @jax.jit
    def value_and_slopes(a, b, alpha):
        def f(x, y, weight):
            return interpolate(group(x), group(y), weight).parameters()

        return f(a, b, alpha), jax.jacrev(f, (0, 1, 2))(a, b, alpha)

    for other in (T, half):
        results = value_and_slopes(T.parameters(), other.parameters(), jnp.asarray(0.25))
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(results))
    np.testing.assert_allclose(interpolate(T, T, 0.7).parameters(), T.parameters(), atol=1e-6)


def sequential(increments, start):
    matrices = np.asarray(increments.as_matrix(), np.float64)
    poses = [np.asarray(start.as_matrix(), np.float64)]
    for matrix in matrices:
        poses.append(poses[-1] @ matrix)
    return np.stack(poses)


@pytest.mark.parametrize("n", [1, 11])
def test_concatenation_equals_the_sequential_product(group, dtype, n):
    increments = group.exp(0.3 * jax.random.normal(jax.random.key(5), (n, group.tangent_dim), dtype))
    start = group.sample_uniform(jax.random.key(6), (), dtype)
    tolerance = 1e-5 if dtype is jnp.float32 else 1e-12
    for first in (None, start):
        expected = sequential(increments, start if first is not None else group.identity((), dtype))
        size = np.abs(expected).max()
        poses = jax.jit(cumulative_compose)(increments, first)
        assert poses.get_batch_axes() == (n,)
        np.testing.assert_allclose(poses.as_matrix() / size, expected[1:] / size, rtol=0, atol=tolerance)
        if n == 1:
            whole = cumulative_compose(increments, first, include_start=True)
            np.testing.assert_allclose(whole.as_matrix() / size, expected / size, rtol=0, atol=tolerance)


@pytest.mark.slow
def test_several_trajectories_at_once(group):
    increments = group.exp(0.2 * jax.random.normal(jax.random.key(7), (5, 3, group.tangent_dim)))
    chain = jax.jit(cumulative_compose)
    poses = chain(increments)
    for j in range(3):
        alone = chain(group(increments.parameters()[:, j]))
        np.testing.assert_allclose(poses.parameters()[:, j], alone.parameters(), atol=1e-6)


@pytest.mark.slow
def test_long_float32_chains_stay_rotations():
    # A closed circle of 3,600 steps of a tenth of a degree: back at the origin, on the unit sphere of quaternions.
    step = np.array([0.01, 0.0, 0.0, 0.0, 0.0, 2 * np.pi / 3600], np.float32)
    poses = jax.jit(cumulative_compose)(SE3.exp(np.tile(step, (3600, 1))))
    np.testing.assert_allclose(jnp.linalg.norm(poses.rotation().wxyz, axis=1), 1.0, atol=5e-7)
    np.testing.assert_allclose(poses.translation()[-1], np.zeros(3), atol=36 * 1e-4)
    radius = 0.01 * 3600 / (2 * np.pi)
    np.testing.assert_allclose(poses.translation()[1799], [0.0, 2 * radius, 0.0], atol=36 * 1e-4)


@pytest.mark.slow
def test_concatenation_is_differentiable():
    def end(step):
        return cumulative_compose(SE3.exp(jnp.tile(step[None], (5, 1)))).translation()[-1]

    # Moving straight ahead, the end moves by the number of steps times the change of ρ.
    slope = jax.jit(jax.jacrev(end))(jnp.zeros(6))
    np.testing.assert_allclose(slope[:, :3], 5 * np.eye(3), atol=1e-6)
    assert bool(jnp.isfinite(slope).all())


def test_concatenation_needs_an_axis(group):
    with pytest.raises(ValueError, match="no leading axis"):
        cumulative_compose(group.identity())
