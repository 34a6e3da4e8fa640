import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.solvers.derivatives import assert_derivatives
from tests.solvers.problems import lanes, pose_errors, solve_in_batches
from tests.solvers.unknown_intrinsics import DEGENERATE, mixed, spoiled
from vojax.solvers import p4pf

solve_last = jax.jit(jax.vmap(p4pf, in_axes=-1, out_axes=-1))


def problems(count, seed=0, planar=False, tilt=0.5, sigma=0.0):
    """Points [count, 4, 3] 2 to 10 units ahead, pixels [count, 4, 2], R, t and focal lengths of 400 to 2000 pixels."""
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-0.7, 0.7, (count, 4, 2)), np.ones((count, 4, 1))], axis=-1)
    depths = rng.uniform(2.0, 10.0, (count, 4, 1))
    if planar:
        # Tilted by at least a third of that: a frontal plane says nothing about the focal length.
        angle, size = rng.uniform(0.0, 2.0 * np.pi, (count, 1)), tilt * rng.uniform(0.33, 1.0, (count, 1))
        normal = np.stack([size * np.cos(angle), size * np.sin(angle), np.ones_like(angle)], axis=-1)
        depths = rng.uniform(4.0, 8.0, (count, 1, 1)) / np.sum(rays * normal, axis=-1, keepdims=True)
    focal = rng.uniform(400.0, 2000.0, count)
    rotation = Rotation.random(count, rng=rng).as_matrix()
    translation = rng.normal(size=(count, 3)) * 2.0
    points = np.einsum("bji,bnj->bni", rotation, rays * depths - translation[:, None])
    pixels = focal[:, None, None] * rays[..., :2] + sigma * rng.normal(size=(count, 4, 2))
    return points, pixels, rotation, translation, focal


def solve(points, pixels, dtype):
    return solve_in_batches(solve_last, points, pixels, dtype=dtype)


def recall(candidates, rotation, translation, focal, threshold):
    """Share of problems whose true pose and relative focal length are among the valid candidates."""
    errors = pose_errors(candidates.models.cam_from_world.wxyz_xyz, rotation, translation)
    errors = np.maximum(errors, np.abs(candidates.models.focal / focal[:, None] - 1.0))
    return (np.where(candidates.valid, errors, np.inf).min(axis=1) < threshold).mean()


def test_finds_the_truth(dtype):
    points, pixels, *truth = problems(4000, 1)
    candidates = solve(points, pixels, dtype)
    assert recall(candidates, *truth, 1e-3 if dtype == jnp.float32 else 1e-6) >= 0.998


def test_points_on_a_plane(dtype):
    points, pixels, *truth = problems(4000, 2, planar=True)
    candidates = solve(points, pixels, dtype)
    if dtype == jnp.float32:
        assert recall(candidates, *truth, 1e-2) >= 0.985
    else:
        assert recall(candidates, *truth, 1e-6) >= 0.998


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    points, pixels, *truth = problems(100_000, 3)
    candidates = solve(points, pixels, dtype)
    if dtype == jnp.float32:
        assert recall(candidates, *truth, 1e-3) >= 0.998
    else:
        assert recall(candidates, *truth, 1e-6) >= 0.9999


def test_finds_what_poselib_finds(x64):
    points, pixels, *_ = problems(500, 4)
    candidates = solve(points, pixels, np.float64)
    missed = 0
    for i in range(500):
        poses, focals = poselib.p4pf(list(pixels[i]), list(points[i]), True)
        ours = candidates.models.focal[i][candidates.valid[i]]
        for pose, focal in zip(poses, focals, strict=True):
            turned = Rotation.from_quat([*pose.q[1:], pose.q[0]]).as_matrix() @ points[i].T
            cam = turned.T + pose.t
            projected = focal * cam[:, :2] / cam[:, 2:]
            exact = np.abs(projected - pixels[i]).max() < 1e-6 and (cam[:, 2] > 0).all()
            missed += exact and not (np.abs(ours / focal - 1.0) < 1e-5).any()
    assert missed <= 1


def test_with_noise_it_is_a_minimum(x64):
    points, pixels, *_ = problems(300, 5, sigma=0.5)
    candidates = solve(points, pixels, np.float64)
    assert candidates.valid.any(axis=1).mean() > 0.9
    checked = 0
    for i in np.flatnonzero(candidates.valid[:, 0])[:40]:
        pose, f = candidates.models.cam_from_world.wxyz_xyz[i, 0], candidates.models.focal[i, 0]

        def residual(v, i=i, pose=pose, f=f):
            turn = Rotation.from_rotvec(v[3:6]) * Rotation.from_quat(pose[[1, 2, 3, 0]])
            cam = turn.apply(points[i]) + pose[4:] + v[:3]
            return (f * np.exp(v[6]) * cam[:, :2] / cam[:, 2:] - pixels[i]).ravel()

        found = least_squares(residual, np.zeros(7), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
        assert np.sum(residual(np.zeros(7)) ** 2) <= 2.0 * found.cost * (1.0 + 1e-6) + 1e-12
        checked += 1
    assert checked == 40


@pytest.mark.parametrize("kind", DEGENERATE)
def test_impossible_problems_have_no_valid_slot(dtype, kind):
    points, pixels, *_ = problems(64, 9)
    candidates = solve(*spoiled(points, pixels, kind), dtype)
    assert not candidates.valid.any()
    assert (candidates.models.focal == 1.0).all()
    np.testing.assert_array_equal(candidates.models.cam_from_world.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (64, 2, 7)))


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


@pytest.mark.parametrize("sigma", [0.0, 0.3])
@pytest.mark.slow
def test_gradients_equal_central_differences(x64, sigma):
    points, pixels, *_ = problems(1, 11, sigma=sigma)
    assert_derivatives(p4pf, solve_last, (points[0], pixels[0]), rtol=1e-6 if sigma == 0 else 1e-5)


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    data = mixed(*problems(2048, 12)[:2])

    def total(points, pixels):
        models = p4pf(points, pixels).models
        return jnp.sum(models.cam_from_world.wxyz_xyz) + jnp.sum(models.focal)

    for part in jax.jit(jax.vmap(jax.grad(total, (0, 1)), -1, -1))(*lanes(*data, dtype=np.float32)):
        assert np.isfinite(part).all()
