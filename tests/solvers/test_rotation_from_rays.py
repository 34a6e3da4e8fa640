import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.problems import central_differences, lanes, solve_in_batches
from vojax.lie import SO3
from vojax.solvers import rotation_from_rays

N = 6
solve_last = jax.jit(jax.vmap(rotation_from_rays, in_axes=-1, out_axes=-1))
solve_first = jax.jit(jax.vmap(rotation_from_rays))


def solve(rays0, rays1, weights, dtype, size=2048):
    return solve_in_batches(solve_last, rays0, rays1, weights, dtype=dtype, size=size)


def problems(count, seed=0, width=0.7, noise=0.0):
    """Rays of random length in both views [count, N, 3], weights, and rotations over all of SO(3)."""
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-width, width, (count, N, 2)), np.ones((count, N, 1))], axis=-1)
    rotation = Rotation.random(count, rng=rng).as_matrix()
    turned = np.einsum("bij,bnj->bni", rotation, rays) + noise * rng.normal(size=rays.shape)
    lengths = rng.uniform(0.2, 5.0, (2, count, N, 1))
    return rays * lengths[0], turned * lengths[1], rng.uniform(0.1, 2.0, (count, N)), rotation


def angle_errors(candidates, rotation):
    """Angle to the truth, infinite where the slot is not valid."""
    wxyz = np.asarray(candidates.models.wxyz, np.float64)[:, 0]
    found = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]])
    errors = (found * Rotation.from_matrix(rotation).inv()).magnitude()
    return np.where(np.asarray(candidates.valid)[:, 0], errors, np.inf)


def mixed(seed, count):
    """Random problems, half of them degenerate in one of several ways or absurd."""
    rays0, rays1, weights, _ = problems(count, seed, noise=0.01)
    rng = np.random.default_rng(seed)
    kinds = np.array_split(rng.permutation(count)[: count // 2], 10)
    rays0[kinds[0]] = rays0[kinds[0], :1]
    rays1[kinds[1]] = rays1[kinds[1], :1]
    rays0[kinds[2], 1] = 0.0
    rays0[kinds[3]] = rays1[kinds[3]] = 0.0
    weights[kinds[4]] = 0.0
    weights[kinds[5], 0] = -1.0
    rays0[kinds[6], 0, 0] = np.nan
    rays1[kinds[7], 2, 1] = np.inf
    rays0[kinds[8]] *= 1e30
    rays1[kinds[9]] *= 1e-30
    return rays0, rays1, weights


def test_finds_the_truth(dtype):
    rays0, rays1, weights, rotation = problems(4000)
    errors = angle_errors(solve(rays0, rays1, weights, dtype), rotation)
    assert np.mean(errors < (3e-6 if dtype == jnp.float32 else 1e-13)) >= 0.9999


def test_two_rays_suffice(dtype):
    rays0, rays1, weights, rotation = problems(4000, seed=1)
    weights[:, 2:] = 0.0
    errors = angle_errors(solve(rays0, rays1, weights, dtype), rotation)
    apart = np.linalg.norm(
        np.cross(*(x / np.linalg.norm(x, axis=-1, keepdims=True) for x in rays0[:, :2].swapaxes(0, 1))), axis=-1
    )
    conditioned = apart > 0.05
    assert conditioned.mean() > 0.98
    assert np.mean(errors[conditioned] < (1e-5 if dtype == jnp.float32 else 1e-13)) >= 0.9999


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    rays0, rays1, weights, rotation = problems(100_000, seed=2)
    errors = angle_errors(solve(rays0, rays1, weights, dtype), rotation)
    assert np.mean(errors < (3e-6 if dtype == jnp.float32 else 1e-13)) >= 0.9999


def test_narrow_field_of_view(dtype):
    # Two degrees across: what remains is the rounding of the rays, divided by the angle between them.
    rays0, rays1, weights, rotation = problems(500, seed=3, width=0.017)
    errors = angle_errors(solve(rays0, rays1, weights, dtype), rotation)
    assert np.quantile(errors, 0.99) < (6e-5 if dtype == jnp.float32 else 1e-13)


def test_equals_scipy(x64):
    rays0, rays1, weights, _ = problems(200, seed=4, noise=0.05)
    candidates = solve(rays0, rays1, weights, np.float64)
    assert candidates.valid.all()
    unit0, unit1 = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (rays0, rays1))
    expected = [
        Rotation.align_vectors(b, a, weights=w)[0].as_matrix() for a, b, w in zip(unit0, unit1, weights, strict=True)
    ]
    assert angle_errors(candidates, np.array(expected)).max() < 1e-12


def test_optimum_has_no_torque(dtype):
    rays0, rays1, weights, _ = problems(500, seed=5, noise=0.05)
    candidates = solve(rays0, rays1, weights, dtype)
    wxyz = candidates.models.wxyz[:, 0].astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(wxyz, axis=-1), 1.0, atol=1e-6)
    rotation = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix()
    unit0, unit1 = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (rays0, rays1))
    turned = np.einsum("bij,bnj->bni", rotation, unit0)
    torque = np.sum(weights[..., None] * np.cross(turned, unit1), axis=1)
    assert np.abs(torque).max() < (3e-6 if dtype == jnp.float32 else 1e-14)


def test_never_reflects_and_outliers_can_be_masked(x64):
    rays0, rays1, weights, rotation = problems(500, seed=6)
    rays1[:, 4] = -rays1[:, 4]
    weights[:, 4] = 0.0
    assert angle_errors(solve(rays0, rays1, weights, np.float64), rotation).max() < 1e-13


def test_noise_moves_the_rotation_smoothly(x64):
    exact = problems(500, seed=7)
    errors = [
        np.median(angle_errors(solve(*problems(500, seed=7, noise=noise)[:3], np.float64), exact[3]))
        for noise in (1e-4, 1e-3, 1e-2)
    ]
    assert 8.0 < errors[1] / errors[0] < 12.0
    assert 8.0 < errors[2] / errors[1] < 12.0
    assert errors[0] < 3e-4


@pytest.mark.slow
def test_vmap_equals_loop_on_either_axis(x64):
    rays0, rays1, weights, _ = problems(16, seed=8, noise=0.01)
    last = solve(rays0, rays1, weights, np.float64)
    first = solve_first(rays0, rays1, weights)
    np.testing.assert_allclose(first.models.wxyz, last.models.wxyz, atol=1e-13)
    for i in range(16):
        single = rotation_from_rays(rays0[i], rays1[i], weights[i])
        np.testing.assert_allclose(single.models.wxyz, last.models.wxyz[i], atol=1e-13)
    equal = rotation_from_rays(rays0[0], rays1[0])
    assert isinstance(equal.models, SO3)
    np.testing.assert_allclose(
        equal.models.wxyz, rotation_from_rays(rays0[0], rays1[0], np.full(N, 0.3)).models.wxyz, atol=1e-14
    )


@pytest.mark.slow
def test_many_lanes_give_what_few_give():
    rays0, rays1, weights, rotation = problems(65_536, seed=9)
    many = solve(rays0, rays1, weights, np.float32, size=65_536)
    assert many.valid.all()
    assert angle_errors(many, rotation).max() < 5e-6


@pytest.mark.parametrize(
    "spoil",
    ["one direction", "one direction in view 1", "opposite rays", "zero ray", "no weight", "negative", "nan", "inf"],
)
def test_impossible_problems_are_not_valid(dtype, spoil):
    rays0, rays1, weights, _ = problems(64, seed=10)
    if spoil == "one direction":
        rays0[:] = rays0[:, :1]
        rays1[:] = rays1[:, :1]
    elif spoil == "one direction in view 1":
        rays1[:] = rays1[:, :1] * np.linspace(0.5, 3.0, N)[None, :, None]
    elif spoil == "opposite rays":
        signs = np.array([1.0, -1.0, 2.0, -2.0, 1.0, 3.0])[None, :, None]
        rays0[:] = rays0[:, :1] * signs
        rays1[:] = rays1[:, :1] * signs
    elif spoil == "zero ray":
        rays0[:, 2] = 0.0
    elif spoil == "no weight":
        weights[:] = 0.0
    elif spoil == "negative":
        weights[:, 1] = -0.1
    elif spoil == "nan":
        rays1[:, 0, 2] = np.nan
    else:
        rays0[:, 1, 0] = np.inf
    candidates = solve(rays0, rays1, weights, dtype)
    assert not candidates.valid.any()
    np.testing.assert_array_equal(candidates.models.wxyz, np.broadcast_to(np.eye(4)[0], (64, 1, 4)))


def function(rays0, rays1, weights):
    return jnp.sum(rotation_from_rays(rays0, rays1, weights).models.log() * jnp.array([[1.0, -0.7, 0.4]]))


def test_gradients_equal_central_differences(x64):
    value = jax.jit(function)
    both = jax.jit(lambda *x: (jax.grad(function, (0, 1, 2))(*x), jax.jacfwd(function, (0, 1, 2))(*x)))
    problem = [x[:2] for x in problems(2, seed=11, noise=0.05)[:3]]
    for arguments in zip(*problem, strict=True):
        for index, (back, ahead) in enumerate(zip(*both(*arguments), strict=True)):
            numeric = central_differences(value, arguments, index)
            np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())
            np.testing.assert_allclose(ahead, back, rtol=1e-9, atol=1e-9 * np.abs(numeric).max())


def finite_everywhere(seed, count, dtype):
    problem = mixed(seed, count)
    candidates = solve(*problem, dtype, size=count)
    assert np.isfinite(candidates.models.wxyz).all()
    assert 0.4 < candidates.valid.mean() < 0.8
    for part in jax.jit(jax.vmap(jax.grad(function, (0, 1, 2)), -1, -1))(*lanes(*problem, dtype=dtype)):
        assert np.isfinite(part).all()


@pytest.mark.slow
def test_values_and_gradients_are_finite_everywhere():
    finite_everywhere(12, 2048, np.float32)


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(8):
        finite_everywhere(seed, 125_000, dtype)


def test_bad_shapes_raise():
    with pytest.raises(ValueError, match="at least 2"):
        rotation_from_rays(np.ones((1, 3)), np.ones((1, 3)))
    with pytest.raises(ValueError, match="one per ray"):
        inspect.unwrap(rotation_from_rays)(np.ones((3, 3)), np.ones((3, 3)), np.ones(2))
