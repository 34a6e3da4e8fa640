import functools

import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.problems import central_differences, lanes, pose_errors, recall, solve_in_batches
from vojax.solvers import up2p

solve_last = jax.jit(jax.vmap(up2p, in_axes=-1, out_axes=-1))
DEGENERATE = ["one above the other", "equal points", "equal rays", "level rays", "zero ray", "zero up", "nan", "inf"]


def problems(count, seed=0):
    """Points and bearings [count, 2, 3], the vertical in both frames [count, 3], and the poses."""
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-0.7, 0.7, (count, 2, 2)), np.ones((count, 2, 1))], axis=-1)
    bearings = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    cam = bearings * rng.uniform(1.0, 10.0, (count, 2, 1))
    rotation = Rotation.random(count, rng=rng).as_matrix()
    translation = rng.normal(size=(count, 3)) * 2.0
    points = np.einsum("bji,bnj->bni", rotation, cam - translation[:, None])
    up_world = rng.normal(size=(count, 3))
    up_world /= np.linalg.norm(up_world, axis=-1, keepdims=True)
    return (points, bearings, up_world, np.einsum("bij,bj->bi", rotation, up_world)), rotation, translation


def solve(data, dtype):
    return solve_in_batches(solve_last, *data, dtype=dtype)


def spoiled(data, kind):
    points, bearings, up_world, up_cam = (x.copy() for x in data)
    if kind == "one above the other":
        points[:, 1] = points[:, 0] + 1.7 * up_world
    elif kind == "equal points":
        points[:, 1] = points[:, 0]
    elif kind == "equal rays":
        bearings[:, 1] = bearings[:, 0]
    elif kind == "level rays":
        up_cam[:] = np.cross(bearings[:, 0], bearings[:, 1])
    elif kind == "zero ray":
        bearings[:, 1] = 0.0
    elif kind == "zero up":
        up_world[:] = 0.0
    elif kind == "nan":
        points[:, 0, 2] = np.nan
    elif kind == "inf":
        up_cam[:, 1] = np.inf
    elif kind == "huge":
        points *= 1e30
    elif kind == "tiny":
        points *= 1e-30
    return points, bearings, up_world, up_cam


def mixed(count, seed):
    data, *_ = problems(count, seed)
    for part, kind in zip(np.array_split(np.arange(count // 2), 10), [*DEGENERATE, "huge", "tiny"], strict=True):
        for x, y in zip(data, spoiled([x[part] for x in data], kind), strict=True):
            x[part] = y
    return data


def test_poses_satisfy_the_equations(dtype):
    data, *_ = problems(2000)
    candidates = solve(data, dtype)
    points, bearings, up_world, up_cam = data
    poses = candidates.models.wxyz_xyz.astype(np.float64)
    rotation = Rotation.from_quat(poses[..., [1, 2, 3, 0]].reshape(-1, 4)).as_matrix().reshape(2000, 2, 3, 3)
    cam = np.einsum("bsij,bnj->bsni", rotation, points) + poses[..., None, 4:]
    angle = np.linalg.norm(cam / np.linalg.norm(cam, axis=-1, keepdims=True) - bearings[:, None], axis=-1).max(axis=-1)
    tilt = np.abs(np.einsum("bsij,bj->bsi", rotation, up_world) - up_cam[:, None]).max(axis=-1)
    assert tilt[candidates.valid].max() < (5e-6 if dtype == jnp.float32 else 1e-14)
    assert np.quantile(angle[candidates.valid], 0.99) < (1e-4 if dtype == jnp.float32 else 1e-13)


def test_finds_the_truth(dtype):
    data, rotation, translation = problems(20_000, seed=1)
    candidates = solve(data, dtype)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-3) >= 0.995
    else:
        assert recall(candidates, rotation, translation, 1e-6) >= 0.9999


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    data, rotation, translation = problems(100_000, seed=2)
    candidates = solve(data, dtype)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-3) >= 0.995
    else:
        assert recall(candidates, rotation, translation, 1e-6) >= 0.9999


def test_finds_the_poses_poselib_finds(x64):
    # PoseLib takes y as the vertical of both frames.
    data, *_ = problems(1000, seed=3)
    points, bearings, up_world, up_cam = data
    to_y = [Rotation.align_vectors([[0.0, 1.0, 0.0]], [up])[0].as_matrix() for up in up_world]
    cam_to_y = [Rotation.align_vectors([[0.0, 1.0, 0.0]], [up])[0].as_matrix() for up in up_cam]
    ours = solve(data, np.float64)
    found = missed = extra = 0
    for i in range(1000):
        theirs = []
        for pose in poselib.up2p(list(bearings[i] @ cam_to_y[i].T), list(points[i] @ to_y[i].T)):
            r, t = cam_to_y[i].T @ pose.R @ to_y[i], cam_to_y[i].T @ pose.t
            # It reports points behind the camera too.
            if (np.sum((points[i] @ r.T + t) * bearings[i], axis=1) > 0).all():
                theirs.append([*r.ravel(), *t])
        theirs = np.reshape(theirs, (-1, 12))
        poses = ours.models.wxyz_xyz[i][ours.valid[i]]
        turned = (
            Rotation.from_quat(poses[:, [1, 2, 3, 0]]).as_matrix().reshape(-1, 9) if len(poses) else np.zeros((0, 9))
        )
        distance = np.abs(np.concatenate([turned, poses[:, 4:]], axis=1)[:, None] - theirs[None]).max(axis=-1)
        found += np.sum(distance.min(axis=0, initial=np.inf) < 1e-6)
        missed += np.sum(distance.min(axis=0, initial=np.inf) >= 1e-6)
        extra += np.sum(distance.min(axis=1, initial=np.inf) >= 1e-6)
    assert found > 1200
    assert missed <= 2
    assert extra <= 2


def test_the_default_verticals(x64):
    # A level camera that looks along +x of a world whose z points up.
    (points, bearings, *_), *_ = problems(2048, seed=4)
    rotation = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    points = (bearings * np.array([[4.0], [6.0]]) - np.array([0.3, 0.2, 1.0])) @ rotation
    candidates = jax.jit(jax.vmap(up2p))(points, bearings)
    truth = np.broadcast_to(rotation, (2048, 3, 3)), np.broadcast_to([0.3, 0.2, 1.0], (2048, 3))
    assert recall(candidates, *truth, 1e-6) >= 0.999


def test_solutions_at_the_bounds(x64):
    data, *_ = problems(4000, seed=5)
    count = solve(data, np.float64).valid.sum(axis=1)
    assert set(count) == {1, 2}
    assert min((count == 1).mean(), (count == 2).mean()) > 0.2


def test_double_root(dtype):
    # Depths at which the line of (1) touches the conic.
    count = 4000
    data, rotation, translation = problems(count, seed=6)
    points, bearings, up_world, up_cam = data
    f0, f1 = bearings[:, 0], bearings[:, 1]
    z0, z1 = np.sum(f0 * up_cam, axis=1, keepdims=True), np.sum(f1 * up_cam, axis=1, keepdims=True)
    h0, h1 = f0 - z0 * up_cam, f1 - z1 * up_cam
    moving = z0 * h1 - z1 * h0
    # The conic changes by 2 (d1 h1 - d0 h0) · moving along the line.
    d0 = np.sum(h1 * moving, axis=1, keepdims=True)
    d1 = np.sum(h0 * moving, axis=1, keepdims=True)
    front = ((d0 * d1) > 0)[:, 0]
    sign = np.sign(d0)
    cam = np.stack([sign * d0 * f0, sign * d1 * f1], axis=1)
    cam /= np.abs(cam).max(axis=(1, 2), keepdims=True)
    points = np.einsum("bji,bnj->bni", rotation, cam - translation[:, None])
    candidates = solve((points, bearings, up_world, up_cam), dtype)
    errors = pose_errors(candidates.models.wxyz_xyz, rotation, translation)
    best = np.where(candidates.valid, errors, np.inf).min(axis=1)[front]
    assert len(best) > 300
    # Half the digits at a double root.
    assert np.mean(best < (3e-2 if dtype == jnp.float32 else 1e-5)) > 0.9


@pytest.mark.parametrize("kind", DEGENERATE)
def test_impossible_problems_have_no_valid_slot(dtype, kind):
    data, *_ = problems(64, seed=7)
    candidates = solve(spoiled(data, kind), dtype)
    assert not candidates.valid.any()
    np.testing.assert_array_equal(candidates.models.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (64, 2, 7)))


def test_nothing_is_infinite(dtype):
    candidates = solve(mixed(2000, seed=8), dtype)
    assert np.isfinite(candidates.models.wxyz_xyz).all()
    assert (candidates.models.wxyz_xyz[~candidates.valid] == np.eye(7)[0]).all()


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(8):
        assert np.isfinite(solve(mixed(125_000, seed), dtype).models.wxyz_xyz).all()


@pytest.mark.slow
def test_vmap_equals_loop_and_batch_axis_does_not_matter(x64):
    data, *_ = problems(16, seed=9)
    batched = solve(data, np.float64)
    first = jax.jit(jax.vmap(up2p))(*data)
    single = jax.jit(up2p)
    np.testing.assert_array_equal(first.valid, batched.valid)
    np.testing.assert_allclose(first.models.wxyz_xyz, batched.models.wxyz_xyz, atol=1e-9)
    for i in range(16):
        candidates = single(*(x[i] for x in data))
        np.testing.assert_array_equal(candidates.valid, batched.valid[i])
        np.testing.assert_allclose(candidates.models.wxyz_xyz, batched.models.wxyz_xyz[i], atol=1e-9)


@functools.cache
def weighted_sum():
    def function(*data):
        candidates = up2p(*data)
        factors = jnp.arange(1.0, 15.0).reshape(2, 7) / 14.0
        return jnp.sum(jnp.where(candidates.valid[:, None], candidates.models.wxyz_xyz, 0.0) * factors)

    return tuple(map(jax.jit, (function, jax.grad(function, (0, 1, 2, 3)), jax.jacfwd(function, (0, 1, 2, 3)))))


def test_gradients_equal_central_differences(x64):
    function, reverse, forward = weighted_sum()
    data, *_ = problems(6, seed=10)
    for i in range(6):
        arguments = tuple(x[i] for x in data)
        for index, (back, ahead) in enumerate(zip(reverse(*arguments), forward(*arguments), strict=True)):
            numeric = central_differences(function, arguments, index)
            np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())
            np.testing.assert_allclose(ahead, back, rtol=1e-9, atol=1e-9 * np.abs(numeric).max())


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    gradient = jax.jit(jax.vmap(jax.grad(lambda *data: jnp.sum(up2p(*data).models.wxyz_xyz), (0, 1, 2, 3)), -1, -1))
    for part in gradient(*lanes(*mixed(2048, seed=11), dtype=np.float32)):
        assert np.isfinite(part).all()


def test_the_solution_moves_smoothly_with_noise(x64):
    data, rotation, translation = problems(500, seed=12)
    rng = np.random.default_rng(12)
    noise = [rng.normal(size=x.shape) for x in data]
    medians = []
    for sigma in (1e-6, 1e-5):
        noisy = solve([x + sigma * e for x, e in zip(data, noise, strict=True)], np.float64)
        errors = pose_errors(noisy.models.wxyz_xyz, rotation, translation)
        medians.append(np.median(np.where(noisy.valid, errors, np.inf).min(axis=1)))
    assert medians[0] < 1e-4
    np.testing.assert_allclose(medians[1] / medians[0], 10.0, rtol=0.05)
