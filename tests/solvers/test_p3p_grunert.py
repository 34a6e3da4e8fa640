import functools

import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.problems import (
    absolute_pose_problems,
    central_differences,
    lanes,
    pose_errors,
    recall,
    solve_in_batches,
)
from vojax.solvers import Candidates, p3p, p3p_grunert, select_by_fourth_point, select_by_second_p3p

solve_last = jax.jit(jax.vmap(p3p_grunert, in_axes=-1, out_axes=-1))
other_last = jax.jit(jax.vmap(p3p, in_axes=-1, out_axes=-1))
by_point = jax.jit(jax.vmap(select_by_fourth_point))
by_second = jax.jit(jax.vmap(select_by_second_p3p))
DEGENERATE = ["collinear", "equal points", "one point", "zero ray", "one ray", "nan", "inf"]


def solve(points, bearings, dtype):
    return solve_in_batches(solve_last, points, bearings, dtype=dtype)


def four_points(count, seed):
    """A fourth point beside `absolute_pose_problems`."""
    points, bearings, rotation, translation = absolute_pose_problems(count, seed)
    rng = np.random.default_rng(seed + 1000)
    rays = np.concatenate([rng.uniform(-0.7, 0.7, (count, 1, 2)), np.ones((count, 1, 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    cam = rays * rng.uniform(1.0, 10.0, (count, 1, 1))
    fourth = np.einsum("bji,bnj->bni", rotation, cam - translation[:, None])
    return np.concatenate([points, fourth], axis=1), np.concatenate([bearings, rays], axis=1), rotation, translation


def spoiled(points, bearings, kind):
    points, bearings = points.copy(), bearings.copy()
    if kind == "collinear":
        points[:, 2] = 0.3 * points[:, 0] + 0.7 * points[:, 1]
    elif kind == "equal points":
        points[:, 2] = points[:, 0]
    elif kind == "one point":
        points[:] = points[:, :1]
    elif kind == "zero ray":
        bearings[:, 1] = 0.0
    elif kind == "one ray":
        bearings[:] = bearings[:, :1]
    elif kind == "nan":
        points[:, 0, 2] = np.nan
    elif kind == "inf":
        bearings[:, 1, 0] = np.inf
    elif kind == "huge":
        points *= 1e30
    elif kind == "tiny":
        points *= 1e-30
    elif kind == "two rays":
        bearings[:, 1] = bearings[:, 0]
    return points, bearings


def mixed(seed, count):
    """Random problems, half of them degenerate in one of several ways or absurd."""
    points, bearings, *_ = absolute_pose_problems(count, seed)
    for part, kind in zip(
        np.array_split(np.arange(count // 2), 10), [*DEGENERATE, "huge", "tiny", "two rays"], strict=True
    ):
        points[part], bearings[part] = spoiled(points[part], bearings[part], kind)
    return points, bearings


def same_sets(ours, theirs, tolerance):
    """Poses found by both, missed and extra, where each argument is (parameters [s, 7], valid [s])."""
    ours, theirs = (
        np.reshape(x, (-1, 7)) * np.where(np.reshape(x, (-1, 7))[:, :1] < 0, [-1.0] * 4 + [1.0] * 3, 1.0)
        for x in (ours, theirs)
    )
    distance = np.abs(ours[:, None] - theirs[None]).max(axis=-1)
    near, back = distance.min(axis=0, initial=np.inf), distance.min(axis=1, initial=np.inf)
    return np.array([np.sum(near < tolerance), np.sum(near >= tolerance), np.sum(back >= tolerance)])


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
        assert recall(candidates, rotation, translation, 1e-3) >= 0.997
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


@pytest.mark.slow
def test_finds_the_poses_p3p_and_poselib_find(x64):
    points, bearings, *_ = absolute_pose_problems(1000, seed=3)
    ours, theirs = (solve_in_batches(f, points, bearings, dtype=np.float64) for f in (solve_last, other_last))
    counts, counts_poselib = np.zeros(3, int), np.zeros(3, int)
    for i in range(1000):
        found = ours.models.wxyz_xyz[i][ours.valid[i]]
        counts += same_sets(found, theirs.models.wxyz_xyz[i][theirs.valid[i]], 1e-5)
        peer = [[*pose.q, *pose.t] for pose in poselib.p3p(list(bearings[i]), list(points[i]))]
        counts_poselib += same_sets(found, np.array(peer), 1e-5)
    for found, missed, extra in (counts, counts_poselib):
        assert found > 1500
        # Near-double roots are reported differently: once, twice or not at all.
        assert missed <= 3
        assert extra <= 3


def test_four_is_a_bound_that_is_not_always_reached(x64):
    # Two quadratics in the ratios of distances have at most 2 · 2 common roots; one, two, three and four of them are
    # real and positive in turn.
    points, bearings, *_ = absolute_pose_problems(4000, seed=3)
    count = solve(points, bearings, np.float64).valid.sum(axis=1)
    frequency = np.bincount(count, minlength=5) / 4000
    assert count.max() == 4
    assert frequency[0] == 0  # the truth is always there
    assert frequency[1:3].min() > 0.3
    assert frequency[3:].min() > 0.02


def test_symmetric_triangle_has_four_poses(dtype):
    # The textbook case (Fischler & Bolles): an equilateral triangle under three angles with cosine 5/8. Two of its
    # solutions share a root of the quartic, for every numbering.
    side = 2.0 * np.sqrt(3.0)
    points = np.array([[0.0, 0.0, 0.0], [side, 0.0, 0.0], [side / 2, side * np.sqrt(3) / 2, 0.0]])
    slant = np.sqrt((1.0 - 5.0 / 8.0) * 2.0 / 3.0)
    angles = np.array([0.0, 2.0, 4.0]) * np.pi / 3.0
    bearings = np.stack([slant * np.cos(angles), slant * np.sin(angles), np.full(3, np.sqrt(1 - slant**2))], axis=-1)
    orders = [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]]
    candidates = solve(points[np.array(orders)], bearings[np.array(orders)], dtype)
    assert candidates.valid.all()
    for poses in candidates.models.wxyz_xyz.astype(np.float64):
        rotation = Rotation.from_quat(poses[:, [1, 2, 3, 0]]).as_matrix()
        distances = np.linalg.norm(np.einsum("sij,nj->sni", rotation, points) + poses[:, None, 4:], axis=-1)
        distances = np.sort(distances, axis=-1)
        expected = np.array([[1.0, 4.0, 4.0]] * 3 + [[4.0, 4.0, 4.0]])
        atol = 1e-4 if dtype == jnp.float32 else 1e-6
        np.testing.assert_allclose(distances[np.argsort(distances[:, 0])], expected, atol=atol)


def symmetric_problems(count, seed):
    """Equilateral triangles, frontal and nearly so, seen under three nearly or exactly equal angles."""
    rng = np.random.default_rng(seed)
    angles = np.array([0.0, 2.0, 4.0]) * np.pi / 3.0
    points = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=-1)
    tilt = Rotation.from_rotvec(rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-6, -1, (count, 1))).as_matrix()
    tilt[: count // 4] = np.eye(3)
    offset = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-6, -1, (count, 1))
    offset[: count // 4] = 0.0
    translation = offset + np.array([0.0, 0.0, 1.0]) * rng.uniform(1.8, 6.0, (count, 1))
    cam = np.einsum("bij,nj->bni", tilt, points) + translation[:, None]
    return np.broadcast_to(points, (count, 3, 3)), cam / np.linalg.norm(cam, axis=-1, keepdims=True), tilt, translation


def test_equilateral_triangles_under_equal_angles(dtype):
    points, bearings, rotation, translation = symmetric_problems(1000, seed=20)
    candidates = solve(points, bearings, dtype)
    threshold = 1e-3 if dtype == jnp.float32 else 1e-6
    assert recall(candidates, rotation, translation, threshold) >= 0.98


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


@pytest.mark.slow
def test_vmap_equals_loop(x64):
    points, bearings, *_ = absolute_pose_problems(16, seed=4)
    batched = solve(points, bearings, np.float64)
    single = jax.jit(p3p_grunert)
    for i in range(16):
        candidates = single(points[i], bearings[i])
        np.testing.assert_array_equal(candidates.valid, batched.valid[i])
        np.testing.assert_allclose(candidates.models.wxyz_xyz, batched.models.wxyz_xyz[i], atol=1e-9)


@pytest.mark.slow
def test_batch_axis_does_not_matter():
    points, bearings, *_ = (x.astype(np.float32) for x in absolute_pose_problems(500, seed=5))
    first = jax.jit(jax.vmap(p3p_grunert))(points, bearings)
    last = solve(points, bearings, np.float32)
    # Another fusion rounds otherwise, and decides otherwise about a solution next to a double root.
    same = (np.asarray(first.valid) == last.valid).all(axis=1)
    assert same.mean() >= 0.995
    moved = np.abs(np.asarray(first.models.wxyz_xyz) - last.models.wxyz_xyz)[same].max(axis=(1, 2))
    assert np.quantile(moved, 0.95) < 1e-4


def test_scale_and_length_of_bearings():
    points, bearings, rotation, translation = absolute_pose_problems(500, seed=7)
    for size in (1e-4, 1e4):
        candidates = solve(points * size, bearings, np.float32)
        assert recall(candidates, rotation, translation * size, 1e-3) > 0.99
    candidates = solve(points, bearings * np.array([2.0, 0.3, 50.0])[None, :, None], np.float32)
    assert recall(candidates, rotation, translation, 1e-3) > 0.99


def test_telephoto_lens(x64):
    # A field of view of two degrees.
    _, _, rotation, translation = absolute_pose_problems(500, seed=7)
    rng = np.random.default_rng(7)
    rays = np.concatenate([rng.uniform(-0.02, 0.02, (500, 3, 2)), np.ones((500, 3, 1))], axis=-1)
    bearings = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    points_cam = bearings * rng.uniform(90.0, 110.0, (500, 3, 1))
    points = np.einsum("bji,bnj->bni", rotation, points_cam - translation[:, None])
    assert recall(solve(points, bearings, np.float64), rotation, translation, 1e-5) > 0.99


@pytest.mark.parametrize("kind", DEGENERATE)
def test_impossible_problems_have_no_valid_slot(dtype, kind):
    points, bearings, *_ = absolute_pose_problems(64, seed=9)
    candidates = solve(*spoiled(points, bearings, kind), dtype)
    assert not candidates.valid.any()
    np.testing.assert_array_equal(candidates.models.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (64, 4, 7)))


def test_nothing_is_infinite(dtype):
    candidates = solve(*mixed(seed=8, count=2000), dtype)
    poses = candidates.models.wxyz_xyz
    assert np.isfinite(poses).all()
    assert (poses[~candidates.valid] == np.eye(7)[0]).all()


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(8):
        candidates = solve(*mixed(seed=seed, count=125_000), dtype)
        assert np.isfinite(candidates.models.wxyz_xyz).all()


@functools.cache
def weighted_sum():
    def function(points, bearings):
        candidates = p3p_grunert(points, bearings)
        factors = jnp.arange(1.0, 29.0).reshape(4, 7) / 28.0
        return jnp.sum(jnp.where(candidates.valid[:, None], candidates.models.wxyz_xyz, 0.0) * factors)

    return jax.jit(function), jax.jit(jax.grad(function, (0, 1))), jax.jit(jax.jacfwd(function, (0, 1)))


@pytest.mark.slow
def test_gradients_equal_central_differences(x64):
    function, reverse, forward = weighted_sum()
    points, bearings, *_ = absolute_pose_problems(5, seed=11)
    for x, f in zip(points, bearings, strict=True):
        for index, (back, ahead) in enumerate(zip(reverse(x, f), forward(x, f), strict=True)):
            numeric = central_differences(function, (x, f), index)
            np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())
            np.testing.assert_allclose(ahead, back, rtol=1e-9, atol=1e-9 * np.abs(numeric).max())


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    points, bearings = mixed(12, 2048)
    gradient = jax.jit(jax.vmap(jax.grad(lambda x, f: jnp.sum(p3p_grunert(x, f).models.wxyz_xyz), (0, 1)), -1, -1))
    for part in gradient(*lanes(points, bearings, dtype=np.float32)):
        assert np.isfinite(part).all()


def test_the_solution_moves_smoothly_with_noise(x64):
    points, bearings, rotation, translation = absolute_pose_problems(500, seed=15)
    noise = np.random.default_rng(15).normal(size=bearings.shape)
    exact = solve(points, bearings, np.float64)
    nearest = np.where(exact.valid, pose_errors(exact.models.wxyz_xyz, rotation, translation), np.inf).argmin(axis=1)
    truth = np.take_along_axis(exact.models.wxyz_xyz, nearest[:, None, None], axis=1)
    medians = []
    for sigma in (1e-6, 1e-5):
        noisy = solve(points, bearings + sigma * noise, np.float64)
        moved = np.abs(noisy.models.wxyz_xyz - truth).max(axis=-1)
        medians.append(np.median(np.where(noisy.valid, moved, np.inf).min(axis=1)))
    assert medians[0] < 1e-4
    np.testing.assert_allclose(medians[1] / medians[0], 10.0, rtol=0.05)


@pytest.mark.parametrize("solver", [solve_last, other_last], ids=["grunert", "p3p"])
def test_a_fourth_point_finds_the_true_pose(x64, solver):
    points, bearings, rotation, translation = four_points(2000, seed=16)
    first = solve_in_batches(solver, points[:, :3], bearings[:, :3], dtype=np.float64)
    second = solve_in_batches(solver, points[:, 1:], bearings[:, 1:], dtype=np.float64)
    assert (first.valid.sum(axis=1) > 1).mean() > 0.5  # there is something to decide
    for best in (by_point(first, points[:, 3], bearings[:, 3]), by_second(first, second, points)):
        assert best.valid.shape == (2000, 1)
        assert recall(best, rotation, translation, 1e-5) == 1.0


def test_a_fourth_point_in_single_precision():
    points, bearings, rotation, translation = four_points(2000, seed=17)
    first = solve(points[:, :3], bearings[:, :3], np.float32)
    second = solve(points[:, 1:], bearings[:, 1:], np.float32)
    points, bearings = points.astype(np.float32), bearings.astype(np.float32)
    for best in (by_point(first, points[:, 3], bearings[:, 3]), by_second(first, second, points)):
        assert recall(best, rotation, translation, 1e-2) > 0.99


def test_a_fourth_point_decides_between_symmetric_poses(x64):
    # Row 56 of stress: triangle and view are symmetric, the fourth point is not.
    points, bearings, rotation, translation = symmetric_problems(500, seed=21)
    first = solve(points, bearings, np.float64)
    extra = np.broadcast_to([0.4, 0.1, 0.7], (500, 3))
    ray = np.einsum("bij,bj->bi", rotation, extra) + translation
    has_truth = np.where(first.valid, pose_errors(first.models.wxyz_xyz, rotation, translation), np.inf).min(1) < 1e-6
    best = by_point(first, extra, ray)
    found = pose_errors(best.models.wxyz_xyz, rotation, translation)[:, 0] < 1e-6
    np.testing.assert_array_equal(found, has_truth)


def test_nothing_to_choose_from(x64):
    points, bearings, *_ = four_points(64, seed=18)
    good = solve(points[:, :3], bearings[:, :3], np.float64)
    none = solve(*spoiled(points[:, :3], bearings[:, :3], "one ray"), np.float64)
    nan, zero = np.full((64, 3), np.nan), np.zeros((64, 3))
    for best in (
        by_point(none, points[:, 3], bearings[:, 3]),
        by_point(good, nan, bearings[:, 3]),
        by_point(good, points[:, 3], zero),
        by_second(none, good, points),
        by_second(good, none, points),
        by_second(good, good, nan[:, None]),
    ):
        assert not best.valid.any()
        np.testing.assert_array_equal(best.models.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (64, 1, 7)))


@pytest.mark.slow
def test_gradient_of_the_chosen_pose(x64):
    points, bearings, *_ = four_points(1, seed=19)

    @jax.jit
    def function(points, bearings):
        first = p3p_grunert(points[:3], bearings[:3])
        by_one = select_by_fourth_point(first, points[3], bearings[3])
        by_three = select_by_second_p3p(first, p3p_grunert(points[1:], bearings[1:]), points)
        factors = jnp.arange(1.0, 8.0)[None]
        return jnp.sum(factors * (by_one.models.wxyz_xyz + 2.0 * by_three.models.wxyz_xyz))

    for index, gradient in enumerate(jax.jit(jax.grad(function, (0, 1)))(points[0], bearings[0])):
        numeric = central_differences(function, (points[0], bearings[0]), index)
        np.testing.assert_allclose(gradient, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())
        assert (gradient[3] == 0).all()  # the fourth point chooses, and moves nothing


@pytest.mark.slow
def test_one_slot_of_candidates():
    points, bearings, *_ = (x.astype(np.float32) for x in four_points(2048, seed=19))
    first = jax.tree.map(lambda x: jnp.asarray(x[0]), solve(points[:, :3], bearings[:, :3], np.float32))
    best = select_by_fourth_point(first, points[0, 3], bearings[0, 3])
    assert isinstance(best, Candidates)
    assert best.models.wxyz_xyz.shape == (1, 7)
    assert best.models.wxyz_xyz.dtype == jnp.float32
