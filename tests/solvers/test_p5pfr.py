import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.derivatives import assert_derivatives
from tests.solvers.problems import lanes, solve_in_batches
from tests.solvers.unknown_intrinsics import DEGENERATE, mixed, problems, recall, spoiled
from vojax.solvers import p5pfr
from vojax.solvers._radial_camera import points_and_pixels

solve_last = jax.jit(jax.vmap(p5pfr, in_axes=-1, out_axes=-1))


def solve(points, pixels, dtype):
    return solve_in_batches(solve_last, points, pixels, dtype=dtype)


def test_finds_the_truth(dtype):
    points, pixels, *truth = problems(4000, 1)
    candidates = solve(points, pixels, dtype)
    assert recall(candidates, *truth, 1e-3 if dtype == jnp.float32 else 1e-6) >= (
        0.996 if dtype == jnp.float32 else 0.999
    )


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    points, pixels, *truth = problems(100_000, 3)
    candidates = solve(points, pixels, dtype)
    assert recall(candidates, *truth, 1e-3 if dtype == jnp.float32 else 1e-6) >= (
        0.997 if dtype == jnp.float32 else 0.9999
    )


def test_finds_what_poselib_finds(x64):
    # Its radial solver gives the first two rows of a pose.
    points, pixels, *_ = problems(500, 4)
    candidates = solve(points, pixels, np.float64)
    found = missed = 0
    for i in range(500):
        lines = [np.array([-v, u, 0.0]) for u, v in pixels[i] / 1000.0]
        theirs = poselib.p5lp_radial(lines, list(points[i]))
        ours = candidates.models.cam_from_world.wxyz_xyz[i][candidates.valid[i]]
        turned = Rotation.from_quat(ours[:, [1, 2, 3, 0]]).as_matrix() if len(ours) else np.zeros((0, 3, 3))
        mine = np.concatenate([turned[:, :2], ours[:, 4:6, None]], axis=2)
        peers = [np.concatenate([pose.R[:2], pose.t[:2, None]], axis=1) for pose in theirs]
        for row in mine:
            near = min((min(np.abs(row - q).max(), np.abs(row + q).max()) for q in peers), default=np.inf)
            found += near < 1e-5 * (1.0 + np.abs(row).max())
            missed += near >= 1e-5 * (1.0 + np.abs(row).max())
    assert found > 500
    assert missed <= 2


def test_without_distortion(x64):
    points, pixels, *truth = problems(1000, 5, distorted=0.0)
    assert recall(solve(points, pixels, np.float64), *truth, 1e-6) >= 0.999


def test_moves_smoothly_with_noise(x64):
    medians = []
    for sigma in (1e-5, 1e-4):
        points, pixels, *truth = problems(500, 6, sigma=sigma)
        candidates = solve(points, pixels, np.float64)
        errors = np.abs(candidates.models.focal / truth[2][:, None] - 1.0)
        medians.append(np.median(np.where(candidates.valid, errors, np.inf).min(axis=1)))
    np.testing.assert_allclose(medians[1] / medians[0], 10.0, rtol=0.1)


@pytest.mark.parametrize("kind", DEGENERATE)
def test_impossible_problems_have_no_valid_slot(dtype, kind):
    points, pixels, *_ = problems(64, 9)
    candidates = solve(*spoiled(points, pixels, kind), dtype)
    assert not candidates.valid.any()
    assert (candidates.models.focal == 1.0).all()
    np.testing.assert_array_equal(candidates.models.cam_from_world.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (64, 4, 7)))


def test_nothing_is_infinite(dtype):
    candidates = solve(*mixed(*problems(2000, 8)[:2]), dtype)
    for x in jax.tree.leaves(candidates.models):
        assert np.isfinite(x).all()
    assert (candidates.models.focal[~candidates.valid] == 1.0).all()
    assert (candidates.models.focal > 0).all()


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(8):
        for x in jax.tree.leaves(solve(*mixed(*problems(125_000, seed)[:2]), dtype).models):
            assert np.isfinite(x).all()


def test_gradients_equal_central_differences(x64):
    # Pixels of the order of one, so that the distortion is too.
    points, pixels, *_ = problems(1, 11, sigma=1.0)
    assert_derivatives(p5pfr, solve_last, (points[0], pixels[0] / 1000.0))


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    data = mixed(*problems(2048, 12)[:2])

    def total(points, pixels):
        models = p5pfr(points, pixels).models
        return jnp.sum(models.cam_from_world.wxyz_xyz) + jnp.sum(models.focal) + jnp.sum(models.distortion)

    for part in jax.jit(jax.vmap(jax.grad(total, (0, 1)), -1, -1))(*lanes(*data, dtype=np.float32)):
        assert np.isfinite(part).all()


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="expected five of each"):
        points_and_pixels(jnp.zeros((4, 3)), jnp.zeros((4, 2)), 5, "five")
