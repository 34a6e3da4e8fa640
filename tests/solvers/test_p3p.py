import functools

import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.problems import absolute_pose_problems, central_differences, lanes, pose_errors, recall
from vojax.solvers import p3p

solve_last = jax.jit(jax.vmap(p3p, in_axes=-1, out_axes=-1))
solve_first = jax.jit(jax.vmap(p3p))


CHUNK = 2048


def solve(points, bearings, dtype, chunk=CHUNK):
    """Candidates with the batch on the first axis, computed with the batch on the last, in chunks of one shape."""
    results = []
    for start in range(0, len(points), chunk):
        part = [x[start : start + chunk] for x in (points, bearings)]
        padded = [np.concatenate([x, np.zeros((chunk - len(x), 3, 3))]) for x in part]
        candidates = solve_last(*lanes(*padded, dtype=dtype))
        results.append(jax.tree.map(lambda x, n=len(part[0]): np.moveaxis(np.asarray(x), -1, 0)[:n], candidates))
    return jax.tree.map(lambda *x: np.concatenate(x), *results)


def mixed(seed, count):
    """Random problems, a share of them degenerate in one of several ways or absurd."""
    points, bearings, *_ = absolute_pose_problems(count, seed)
    rng = np.random.default_rng(seed)
    kinds = np.array_split(rng.permutation(count)[: count // 2], 10)
    points[kinds[0], 2] = 2.0 * points[kinds[0], 1] - points[kinds[0], 0]
    points[kinds[1], 1] = points[kinds[1], 0]
    points[kinds[2]] = points[kinds[2], :1]
    bearings[kinds[3], 1] = bearings[kinds[3], 0]
    bearings[kinds[4], 1] = 0.0
    bearings[kinds[5]] = bearings[kinds[5], :1]
    points[kinds[6], 0, 0] = np.nan
    bearings[kinds[7], 2, 1] = np.inf
    points[kinds[8]] *= 1e30
    points[kinds[9]] *= 1e-30
    return points, bearings


def test_poses_satisfy_the_equations(dtype):
    points, bearings, *_ = absolute_pose_problems(2000)
    candidates = solve(points, bearings, dtype)
    poses = candidates.models.wxyz_xyz.astype(np.float64)
    rotation = Rotation.from_quat(poses[..., [1, 2, 3, 0]].reshape(-1, 4)).as_matrix().reshape(2000, 4, 3, 3)
    points_cam = np.einsum("bsij,bnj->bsni", rotation, points) + poses[..., None, 4:]
    distance = np.linalg.norm(points_cam, axis=-1, keepdims=True)
    angle = np.linalg.norm(points_cam / distance - bearings[:, None], axis=-1).max(axis=-1)[candidates.valid]
    assert np.quantile(angle, 0.99) < (2e-5 if dtype == jnp.float32 else 1e-12)
    assert angle.max() < (1e-2 if dtype == jnp.float32 else 1e-6)
    np.testing.assert_allclose(np.linalg.norm(poses[..., :4], axis=-1), 1.0, atol=1e-6)


def test_finds_the_truth(dtype):
    points, bearings, rotation, translation = absolute_pose_problems(4000, seed=1)
    candidates = solve(points, bearings, dtype)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-3) >= 0.99
    else:
        assert recall(candidates, rotation, translation, 1e-6) >= 0.999


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    points, bearings, rotation, translation = absolute_pose_problems(100_000, seed=2)
    candidates = solve(points, bearings, dtype)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-3) >= 0.998
    else:
        assert recall(candidates, rotation, translation, 1e-6) >= 0.9999


def test_finds_the_poses_poselib_finds(x64):
    points, bearings, *_ = absolute_pose_problems(1000, seed=3)
    candidates = solve(points, bearings, np.float64)
    found, missed, extra = 0, 0, 0
    for i in range(1000):
        ours = candidates.models.wxyz_xyz[i][candidates.valid[i]]
        theirs = np.array([[*pose.q, *pose.t] for pose in poselib.p3p(list(bearings[i]), list(points[i]))])
        theirs = theirs.reshape(-1, 7) * np.where(theirs.reshape(-1, 7)[:, :1] < 0, [-1.0] * 4 + [1.0] * 3, 1.0)
        ours = ours * np.where(ours[:, :1] < 0, [-1.0] * 4 + [1.0] * 3, 1.0)
        distance = np.abs(ours[:, None] - theirs[None]).max(axis=-1)
        found += np.sum(distance.min(axis=0, initial=np.inf) < 1e-5)
        missed += np.sum(distance.min(axis=0, initial=np.inf) >= 1e-5)
        extra += np.sum(distance.min(axis=1, initial=np.inf) >= 1e-5)
    assert found > 1500
    # PoseLib reports near-double roots differently: once, twice or not at all.
    assert missed <= 3
    assert extra <= 3


@pytest.mark.slow
def test_vmap_equals_loop(x64):
    points, bearings, *_ = absolute_pose_problems(16, seed=4)
    batched = solve(points, bearings, np.float64)
    for i in range(16):
        single = p3p(points[i], bearings[i])
        np.testing.assert_array_equal(single.valid, batched.valid[i])
        np.testing.assert_allclose(single.models.wxyz_xyz, batched.models.wxyz_xyz[i], atol=1e-9)


@pytest.mark.slow
def test_batch_axis_does_not_matter():
    points, bearings, *_ = (x.astype(np.float32) for x in absolute_pose_problems(500, seed=5))
    first = solve_first(points, bearings)
    last = solve(points, bearings, np.float32)
    np.testing.assert_array_equal(first.valid, last.valid)
    # The two programs fuse differently, and next to a double root half the digits are rounding.
    difference = np.abs(first.models.wxyz_xyz - last.models.wxyz_xyz).max(axis=(1, 2))
    assert np.quantile(difference, 0.99) < 1e-5
    assert difference.max() < np.finfo(np.float32).eps ** 0.5


@pytest.mark.slow
def test_batch_of_batches_and_shared_points():
    points, bearings, *_ = (x.astype(np.float32) for x in absolute_pose_problems(12, seed=5))
    last = solve(points, bearings, np.float32)
    both = jax.jit(
        lambda points, bearings: (
            jax.vmap(jax.vmap(p3p), in_axes=1)(points, bearings),
            jax.vmap(p3p, in_axes=(None, 0))(points[0, 0], bearings[0]),
        )
    )
    nested, shared = both(*(x.reshape(3, 4, 3, 3) for x in (points, bearings)))
    np.testing.assert_array_equal(np.swapaxes(nested.valid, 0, 1).reshape(12, 4), last.valid)
    np.testing.assert_array_equal(shared.valid[0], last.valid[0])
    assert shared.valid.shape == (4, 4)


@pytest.mark.slow
def test_many_lanes_give_what_few_give():
    # Some versions of XLA compute fused loops wrongly from some thousand lanes on.
    points, bearings, rotation, translation = absolute_pose_problems(65_536, seed=6)
    many = solve(points, bearings, np.float32, chunk=65_536)
    few = solve(points, bearings, np.float32)
    same = (few.valid == many.valid).all(axis=-1)
    assert same.mean() > 0.999
    difference = np.abs(few.models.wxyz_xyz - many.models.wxyz_xyz)[same]
    assert np.quantile(difference.max(axis=(-1, -2)), 0.99) < 1e-3
    assert recall(many, rotation, translation, 1e-3) > 0.998
    with jax.enable_x64(True):
        exact = solve(points, bearings, np.float64)
    assert (exact.valid.sum(axis=-1) == many.valid.sum(axis=-1)).mean() > 0.99


@pytest.mark.slow
def test_scale_and_field_of_view(x64):
    points, bearings, rotation, translation = absolute_pose_problems(500, seed=7)
    for size in (1e-4, 1e4):
        candidates = solve(points * size, bearings, np.float32)
        assert recall(candidates, rotation, translation * size, 1e-3) > 0.99
    candidates = solve(points, bearings * np.array([2.0, 0.3, 50.0])[None, :, None], np.float32)
    assert recall(candidates, rotation, translation, 1e-3) > 0.99
    # A telephoto lens of two degrees.
    rng = np.random.default_rng(7)
    rays = np.concatenate([rng.uniform(-0.02, 0.02, (500, 3, 2)), np.ones((500, 3, 1))], axis=-1)
    bearings = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    points_cam = bearings * rng.uniform(90.0, 110.0, (500, 3, 1))
    points = np.einsum("bji,bnj->bni", rotation, points_cam - translation[:, None])
    assert recall(solve(points, bearings, np.float64), rotation, translation, 1e-5) > 0.99


def test_degenerate_problems_give_finite_placeholders(dtype):
    points, bearings = mixed(seed=8, count=2000)
    candidates = solve(points, bearings, dtype)
    poses = candidates.models.wxyz_xyz
    assert np.isfinite(poses).all()
    np.testing.assert_array_equal(
        poses[~candidates.valid], np.broadcast_to(np.eye(7)[0], poses.shape)[~candidates.valid]
    )


@pytest.mark.parametrize("spoil", ["collinear", "equal points", "one point", "zero ray", "one ray", "nan", "inf"])
def test_impossible_problems_have_no_valid_slot(dtype, spoil):
    points, bearings, *_ = absolute_pose_problems(64, seed=9)
    if spoil == "collinear":
        points[:, 2] = 0.3 * points[:, 0] + 0.7 * points[:, 1]
    elif spoil == "equal points":
        points[:, 2] = points[:, 0]
    elif spoil == "one point":
        points[:] = points[:, :1]
    elif spoil == "zero ray":
        bearings[:, 1] = 0.0
    elif spoil == "one ray":
        bearings[:] = bearings[:, :1]
    elif spoil == "nan":
        points[:, 0, 2] = np.nan
    else:
        bearings[:, 1, 0] = np.inf
    assert not solve(points, bearings, dtype).valid.any()


def test_symmetric_triangle_has_four_poses(x64):
    # The textbook case (Fischler & Bolles): an equilateral triangle seen under three angles with cosine 5/8.
    side = 2.0 * np.sqrt(3.0)
    points = np.array([[0.0, 0.0, 0.0], [side, 0.0, 0.0], [side / 2, side * np.sqrt(3) / 2, 0.0]])
    slant = np.sqrt((1.0 - 5.0 / 8.0) * 2.0 / 3.0)
    angles = np.array([0.0, 2.0, 4.0]) * np.pi / 3.0
    bearings = np.stack([slant * np.cos(angles), slant * np.sin(angles), np.full(3, np.sqrt(1 - slant**2))], axis=-1)
    candidates = p3p(points, bearings)
    assert candidates.valid.all()
    points_cam = jax.vmap(lambda pose: pose @ points)(candidates.models)
    distances = np.sort(np.linalg.norm(points_cam, axis=-1), axis=-1)
    expected = np.array([[1.0, 4.0, 4.0]] * 3 + [[4.0, 4.0, 4.0]])
    np.testing.assert_allclose(distances[np.argsort(distances[:, 0])], expected, atol=1e-6)


def test_danger_cylinder(dtype):
    # The camera centre on the circular cylinder through the points: a double solution.
    rng = np.random.default_rng(10)
    angles = rng.uniform(0.0, 2.0 * np.pi, (200, 3)) + np.array([[0.0, 2.0, 4.0]])
    points = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    around = rng.uniform(0.0, 2.0 * np.pi, 200)
    centre = np.stack([np.cos(around), np.sin(around), -rng.uniform(1.0, 3.0, 200)], axis=-1)
    rays = points - centre[:, None]
    candidates = solve(points, rays / np.linalg.norm(rays, axis=-1, keepdims=True), dtype)
    errors = pose_errors(candidates.models.wxyz_xyz, np.broadcast_to(np.eye(3), (200, 3, 3)), -centre)
    best = np.where(candidates.valid, errors, np.inf).min(axis=-1)
    # Half the digits at a double root.
    assert np.mean(best < (3e-2 if dtype == jnp.float32 else 1e-5)) > 0.9


@functools.cache
def weighted_sum():
    def function(points, bearings):
        candidates = p3p(points, bearings)
        factors = jnp.arange(1.0, 29.0).reshape(4, 7) / 28.0
        return jnp.sum(jnp.where(candidates.valid[:, None], candidates.models.wxyz_xyz, 0.0) * factors)

    return jax.jit(function), jax.jit(jax.grad(function, (0, 1))), jax.jit(jax.jacfwd(function, (0, 1)))


def test_gradients_equal_central_differences(x64):
    function, reverse, forward = weighted_sum()
    points, bearings, *_ = absolute_pose_problems(5, seed=11)
    for x, f in zip(points, bearings, strict=True):
        for index, (back, ahead) in enumerate(zip(reverse(x, f), forward(x, f), strict=True)):
            numeric = central_differences(function, (x, f), index)
            np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())
            np.testing.assert_allclose(ahead, back, rtol=1e-9, atol=1e-9 * np.abs(numeric).max())


@pytest.mark.slow
def test_second_derivative(x64):
    points, bearings, *_ = absolute_pose_problems(1, seed=11)
    _, reverse, _ = weighted_sum()
    direction = np.random.default_rng(0).normal(size=(3, 3))
    along = jax.jvp(lambda x: reverse(x, bearings[0])[0], (jnp.asarray(points[0]),), (jnp.asarray(direction),))[1]
    ends = [np.asarray(reverse(points[0] + step * direction, bearings[0])[0]) for step in (1e-6, -1e-6)]
    numeric = (ends[0] - ends[1]) / 2e-6
    np.testing.assert_allclose(along, numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max())


def finite_gradients(seed, count, dtype):
    points, bearings = mixed(seed, count)
    gradient = jax.jit(jax.vmap(jax.grad(lambda x, f: jnp.sum(p3p(x, f).models.wxyz_xyz), (0, 1)), -1, -1))
    for part in gradient(*lanes(points, bearings, dtype=dtype)):
        assert np.isfinite(part).all()


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    finite_gradients(12, 4000, np.float32)


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(8):
        points, bearings = mixed(seed=seed, count=125_000)
        assert np.isfinite(solve(points, bearings, dtype).models.wxyz_xyz).all()
    finite_gradients(13, 200_000, dtype)


def test_accepts_numpy_and_mixed_precision():
    points, bearings, *_ = absolute_pose_problems(1, seed=14)
    candidates = p3p(points[0], bearings[0].astype(np.float32))
    assert candidates.models.wxyz_xyz.dtype == jnp.float32
    assert candidates.valid.any()
