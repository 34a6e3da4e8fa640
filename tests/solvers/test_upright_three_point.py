import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.problems import solve_in_batches
from tests.solvers.upright_problems import (
    POSELIB,
    check_finite_gradients,
    check_gradients,
    compare_with_poselib,
    equation_errors,
    least_errors,
    mixed,
    unit,
    upright_problems,
)
from vojax.solvers import upright_three_point
from vojax.solvers._upright_three_point import arrays

pytestmark = pytest.mark.optimized

solve_last = jax.jit(jax.vmap(upright_three_point, in_axes=-1, out_axes=-1))
solve_first = jax.jit(jax.vmap(upright_three_point))


def solve(data, dtype, size=2048):
    return solve_in_batches(solve_last, *data, dtype=dtype, size=size)


def test_poses_satisfy_the_equations(dtype):
    data, *_ = upright_problems(2048, 3)
    candidates = solve(data, dtype)
    error, _, distance = equation_errors(candidates.models.wxyz_xyz, data)
    valid = candidates.valid
    assert np.quantile(error[valid], 0.99) < (2e-6 if dtype == jnp.float32 else 1e-14)
    assert error[valid].max() < (1e-3 if dtype == jnp.float32 else 1e-11)
    assert distance[valid].min() > (-1e-5 if dtype == jnp.float32 else -1e-13)
    assert valid.sum() > 2 * len(valid)


@pytest.mark.parametrize("any_turn", [False, True])
def test_finds_the_truth(dtype, any_turn):
    data, rotation, translation = upright_problems(4096, 3, seed=1, any_turn=any_turn)
    errors = least_errors(solve(data, dtype), rotation, translation)
    if dtype == jnp.float32:
        assert (errors < 1e-3).mean() >= 0.998
    else:
        assert (errors < 1e-6).mean() >= 0.9999


def test_far_points(dtype):
    # A thousand baselines away: in float32 the bearings themselves are rounded to a thousandth of the parallax.
    data, rotation, translation = upright_problems(4096, 3, seed=2, distance=100.0)
    errors = least_errors(solve(data, dtype), rotation, translation)
    assert (errors < (1e-2 if dtype == jnp.float32 else 1e-8)).mean() > 0.99


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    data, rotation, translation = upright_problems(100_000, 3, seed=3)
    errors = least_errors(solve(data, dtype), rotation, translation)
    print("recall", dtype, [(errors < x).mean() for x in (1e-6, 1e-4, 1e-3, 1e-2)])
    if dtype == jnp.float32:
        assert (errors < 1e-3).mean() >= 0.998
    else:
        assert (errors < 1e-6).mean() >= 0.9999


def test_finds_the_poses_poselib_finds(x64):
    data, *_ = upright_problems(1500, 3, seed=4, level=True)
    both, only_poselib, only_ours = compare_with_poselib(solve(data, np.float64), data, POSELIB[3], 1e-6)
    assert both > 3000
    assert only_poselib <= 1
    assert only_ours <= 3


@pytest.mark.slow
def test_half_turn(x64):
    # tan(θ/2) is infinite.
    rng = np.random.default_rng(5)
    points = rng.normal(size=(200, 3, 3)) * 3.0
    translation = unit(rng.normal(size=(200, 3)))
    rotation = np.tile(np.diag([-1.0, 1.0, -1.0]), (200, 1, 1))
    moved = np.einsum("bij,bnj->bni", rotation, points) + translation[:, None]
    up = np.tile([0.0, 1.0, 0.0], (200, 1))
    for dtype, tolerance in ((np.float64, 1e-8), (np.float32, 1e-2)):
        errors = least_errors(solve((unit(points), unit(moved), up, up), dtype), rotation, translation)
        assert (errors < tolerance).all()


def test_length_and_sense_of_the_inputs_do_not_matter(dtype):
    data, rotation, translation = upright_problems(512, 3, seed=6)
    rng = np.random.default_rng(6)
    expected = solve(data, dtype)
    assert expected.models.wxyz_xyz.dtype == dtype
    factors = 10.0 ** rng.uniform(-12, 12, (2, 512, 3, 1))
    rays0, rays1 = data[0] * factors[0], data[1] * factors[1]
    again = solve((rays0, rays1, 1e6 * data[2], 1e-6 * data[3]), dtype)
    same = (expected.valid == again.valid).all(axis=-1)
    assert same.mean() > 0.99
    gap = np.abs(expected.models.wxyz_xyz - again.models.wxyz_xyz)[same].max(axis=(-1, -2))
    assert np.quantile(gap, 0.95) < (1e-3 if dtype == jnp.float32 else 1e-11)
    # Down instead of up: the same poses in another order.
    down = solve((rays0, rays1, -data[2], -data[3]), dtype)
    assert (expected.valid.sum(axis=-1) == down.valid.sum(axis=-1)).mean() > 0.99
    assert (least_errors(down, rotation, translation) < (1e-3 if dtype == jnp.float32 else 1e-9)).mean() > 0.99


def test_point_at_infinity(dtype):
    data, rotation, translation = upright_problems(512, 3, seed=7)
    data[1][:, 1] = np.einsum("bij,bj->bi", rotation, data[0][:, 1])
    errors = least_errors(solve(data, dtype), rotation, translation)
    assert (errors < (1e-2 if dtype == jnp.float32 else 1e-9)).mean() > 0.99


@pytest.mark.parametrize(
    "spoil", ["rotation", "repeated", "horizon", "pole", "zero ray", "zero up", "nan", "inf", "nan up"]
)
def test_impossible_problems_have_no_valid_slot(dtype, spoil):
    data, rotation, _ = upright_problems(512, 3, seed=8)
    rays0, rays1, up0, up1 = data
    if spoil == "rotation":
        rays1[:] = np.einsum("bij,bnj->bni", rotation, rays0)
    elif spoil == "repeated":
        rays0[:, 2], rays1[:, 2] = 3.0 * rays0[:, 0], 0.1 * rays1[:, 0]
    elif spoil == "horizon":
        for rays, up in ((rays0, up0), (rays1, up1)):
            rays -= np.sum(rays * up[:, None], axis=-1, keepdims=True) * up[:, None]
    elif spoil == "pole":
        rays0[:, 1], rays1[:, 1] = up0, up1
    elif spoil == "zero ray":
        rays0[:, 1] = 0.0
    elif spoil == "zero up":
        up1[:] = 0.0
    elif spoil == "nan":
        rays1[:, 0, 2] = np.nan
    elif spoil == "inf":
        rays0[:, 2, 0] = np.inf
    else:
        up0[:, 0] = np.nan
    assert not solve(data, dtype).valid.any()


def test_points_behind_have_no_valid_slot(x64):
    # With one ray reversed the epipolar equations hold as before, for a point behind one camera.
    data, rotation, translation = upright_problems(512, 3, seed=9)
    data[1][:, 0] *= -1.0
    assert not (least_errors(solve(data, np.float64), rotation, translation) < 1e-6).any()


def test_degenerate_problems_give_finite_placeholders(dtype):
    data = mixed(upright_problems(2048, 3, seed=10)[0], seed=10)
    candidates = solve(data, dtype)
    poses = candidates.models.wxyz_xyz
    assert np.isfinite(poses).all()
    np.testing.assert_array_equal(
        poses[~candidates.valid], np.broadcast_to(np.eye(7)[0], poses.shape)[~candidates.valid]
    )


@pytest.mark.slow
def test_gradients_equal_central_differences(x64):
    check_gradients(upright_three_point, upright_problems(16, 3, seed=11)[0], 4)


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    check_finite_gradients(upright_three_point, mixed(upright_problems(2048, 3, seed=12)[0], seed=12), np.float32)


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(8):
        data = mixed(upright_problems(125_000, 3, seed=seed)[0], seed=seed)
        assert np.isfinite(solve(data, dtype, size=25_000).models.wxyz_xyz).all()
    check_finite_gradients(upright_three_point, mixed(upright_problems(100_000, 3, seed=9)[0], seed=9), dtype)


@pytest.mark.slow
def test_vmap_equals_a_loop_on_either_axis(x64):
    data, *_ = upright_problems(64, 3, seed=13)
    last, first = solve(data, np.float64), solve_first(*data)
    np.testing.assert_array_equal(first.valid, last.valid)
    np.testing.assert_allclose(first.models.wxyz_xyz, last.models.wxyz_xyz, atol=1e-10)
    for i in range(8):
        single = upright_three_point(*(x[i] for x in data))
        np.testing.assert_array_equal(single.valid, last.valid[i])
        np.testing.assert_allclose(single.models.wxyz_xyz, last.models.wxyz_xyz[i], atol=1e-10)


def test_noise_moves_the_pose_smoothly(x64):
    data, rotation, translation = upright_problems(2048, 3, seed=14)
    noise = np.random.default_rng(14).normal(size=(2, 2048, 3, 3))
    medians = []
    for sigma in (1e-6, 1e-5, 1e-4):
        noisy = (data[0] + sigma * noise[0], data[1] + sigma * noise[1], *data[2:])
        medians.append(np.median(least_errors(solve(noisy, np.float64), rotation, translation)) / sigma)
    np.testing.assert_allclose(medians, medians[0], rtol=0.05)


@pytest.mark.slow
def test_many_lanes_give_what_few_give():
    data, rotation, translation = upright_problems(65_536, 3, seed=15)
    many, few = solve(data, np.float32, size=65_536), solve(data, np.float32)
    assert (few.valid == many.valid).all(axis=-1).mean() > 0.999
    assert (least_errors(many, rotation, translation) < 1e-3).mean() >= 0.998


def test_default_vertical_is_the_y_axis(x64):
    angle = 0.4
    rays0 = np.array([[0.1, 0.5, 1.0], [0.3, -0.2, 1.0], [-0.4, 0.1, 1.0]])
    rotation = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
    translation = unit(np.array([0.3, -0.5, 0.4]))
    rays1 = (rays0 * np.array([[4.0], [5.0], [6.0]])) @ rotation.T + translation
    candidates = upright_three_point(rays0, rays1)
    best = least_errors(jax.tree.map(lambda x: np.asarray(x)[None], candidates), rotation[None], translation[None])
    assert best[0] < 1e-10


def test_wrong_shapes_raise():
    with pytest.raises(ValueError, match=r"found rays of shape \(4, 3\); expected \(3, 3\)"):
        arrays((3, 3), (np.zeros((3, 3)), np.zeros((4, 3))), (np.zeros(3), np.zeros(3)))
    with pytest.raises(ValueError, match=r"found a direction of shape \(2,\); expected \(3,\)"):
        arrays((3, 3), (np.zeros((3, 3)), np.zeros((3, 3))), (np.zeros(2), np.zeros(3)))
