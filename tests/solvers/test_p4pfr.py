import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.solvers.derivatives import assert_derivatives
from tests.solvers.problems import lanes, solve_in_batches
from tests.solvers.unknown_intrinsics import DEGENERATE, mixed, problems, recall, spoiled
from vojax.solvers import p4pfr, p5pfr
from vojax.solvers._radial_camera import points_and_pixels

solve_last = jax.jit(jax.vmap(p4pfr, in_axes=-1, out_axes=-1))
# In float32 the form of degree sixteen is noise for one problem in twelve.
LOWEST = {"float32": 0.90, "float64": 0.998}


def solve(points, pixels, dtype):
    return solve_in_batches(solve_last, points, pixels, dtype=dtype)


def threshold(dtype):
    return 1e-3 if dtype == jnp.float32 else 1e-6


def test_finds_the_truth(dtype):
    points, pixels, *truth = problems(4000, 1, points=4)
    assert recall(solve(points, pixels, dtype), *truth, threshold(dtype)) >= LOWEST[jnp.dtype(dtype).name]


def test_finds_the_truth_on_planes(x64):
    points, pixels, *truth = problems(2000, 2, points=4, planar=True)
    assert recall(solve(points, pixels, np.float64), *truth, 1e-6) >= 0.99


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    points, pixels, *truth = problems(100_000, 3, points=4)
    assert recall(solve(points, pixels, dtype), *truth, threshold(dtype)) >= LOWEST[jnp.dtype(dtype).name]


def test_valid_slots_reproduce_the_pixels(x64):
    points, pixels, *_ = problems(1000, 4, points=4)
    candidates = solve(points, pixels, np.float64)
    cameras = candidates.models
    ahead = np.asarray(jax.vmap(jax.vmap(lambda pose, x: pose @ x, (0, None)))(cameras.cam_from_world, points))
    straight = cameras.focal[..., None, None] * ahead[..., :2] / ahead[..., 2:]
    undistorted = 1.0 + cameras.distortion[..., None] * np.sum(pixels**2, axis=-1)[:, None]
    error = np.abs(straight * undistorted[..., None] - pixels[:, None]).max((-1, -2))
    assert candidates.valid.sum() > 1200
    assert (ahead[..., 2][candidates.valid] > 0).all()
    assert np.quantile(error[candidates.valid], 0.99) < 1e-6
    assert error[candidates.valid].max() < 1e-2


@pytest.mark.slow
def test_finds_what_five_points_have_in_common(x64):
    # A solution of five points is one of any four of them.
    points, pixels, *_ = problems(500, 5, points=5)
    five = solve_in_batches(jax.jit(jax.vmap(p5pfr, in_axes=-1, out_axes=-1)), points, pixels, dtype=np.float64)
    four = solve(points[:, 1:], pixels[:, 1:], np.float64)
    # Without noise only the true one satisfies all the equations that five points have.
    away = np.abs(four.models.focal[:, None] / five.models.focal[:, :, None] - 1.0)
    shared = five.valid[:, :, None] & four.valid[:, None] & (away < 1e-7)
    assert shared.any((1, 2)).mean() >= 0.996


def test_without_distortion(x64):
    points, pixels, *truth = problems(1000, 6, distorted=0.0, points=4)
    assert recall(solve(points, pixels, np.float64), *truth, 1e-6) >= 0.998


@pytest.mark.parametrize("kind", DEGENERATE)
def test_impossible_problems_have_no_valid_slot(dtype, kind):
    points, pixels, *_ = problems(64, 9, points=4)
    candidates = solve(*spoiled(points, pixels, kind), dtype)
    assert not candidates.valid.any()
    assert (candidates.models.focal == 1.0).all()
    identity = np.broadcast_to(np.eye(7)[0], candidates.models.cam_from_world.wxyz_xyz.shape)
    np.testing.assert_array_equal(candidates.models.cam_from_world.wxyz_xyz, identity)


def test_pixels_on_a_circle_say_nothing_about_distortion(dtype):
    points, pixels, *_ = problems(256, 10, points=4)
    pixels = pixels / np.linalg.norm(pixels, axis=-1, keepdims=True) * 500.0
    assert solve(points, pixels, dtype).valid.mean() < 0.01


def test_nothing_is_infinite(dtype):
    candidates = solve(*mixed(*problems(2000, 8, points=4)[:2]), dtype)
    for x in jax.tree.leaves(candidates.models):
        assert np.isfinite(x).all()
    assert (candidates.models.focal[~candidates.valid] == 1.0).all()
    assert (candidates.models.focal > 0).all()


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(8):
        for x in jax.tree.leaves(solve(*mixed(*problems(125_000, seed, points=4)[:2]), dtype).models):
            assert np.isfinite(x).all()


@pytest.mark.slow
def test_gradients_equal_central_differences(x64):
    # A well-conditioned problem, with pixels of the order of one, so that the distortion is too.
    points, pixels, *_ = problems(256, 13, points=4)
    assert_derivatives(p4pfr, solve_last, (points[253], pixels[253] / 1000.0))


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    data = mixed(*problems(2048, 12, points=4)[:2])

    def total(points, pixels):
        models = p4pfr(points, pixels).models
        return jnp.sum(models.cam_from_world.wxyz_xyz) + jnp.sum(models.focal) + jnp.sum(models.distortion)

    for part in jax.jit(jax.vmap(jax.grad(total, (0, 1)), -1, -1))(*lanes(*data, dtype=np.float32)):
        assert np.isfinite(part).all()


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="expected four of each"):
        points_and_pixels(jnp.zeros((5, 3)), jnp.zeros((4, 2)), 4, "four")
