import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.solvers.alignment_problems import check_gradients, pose_matrices
from tests.solvers.clouds import motion_errors, move, small_motions, surface, wires
from vojax import Result
from vojax.lie import SE3
from vojax.solvers import icp
from vojax.solvers._icp import METHODS

N, M, BATCH = 300, 400, 64
each_method = pytest.mark.parametrize("method", METHODS)
# Each compiles for long: one stands for all but in slow runs.
one_or_each_method = pytest.mark.parametrize(
    "method", [m if m == "point_to_plane" else pytest.param(m, marks=pytest.mark.slow) for m in METHODS]
)


def aligner(method):
    def align(points0, points1, vectors, mask0, mask1, max_distance, initial):
        return icp(points0, points1, method=method, normals1=vectors, directions1=vectors, iterations=30,
                   max_distance=max_distance, initial=SE3(initial), mask0=mask0, mask1=mask1)  # fmt: skip

    return jax.jit(jax.vmap(align))


aligners = {method: aligner(method) for method in METHODS}
IDENTITY = np.eye(7)[0]


def align(
    method, points0, points1, vectors, mask0=None, mask1=None, max_distance=0.5, initial=IDENTITY, dtype=np.float32
):
    count = len(points0)
    result = aligners[method](
        points0.astype(dtype), points1.astype(dtype), vectors.astype(dtype),
        np.ones((count, N), bool) if mask0 is None else mask0, np.ones((count, M), bool) if mask1 is None else mask1,
        np.full(count, max_distance, dtype), np.broadcast_to(initial, (count, 7)).astype(dtype),
    )  # fmt: skip
    return jax.tree.map(np.asarray, result)


def problems(method, seed=0, same=False):
    """Clouds before and after a small motion, vectors at the second; `same` makes the first a part of the second."""
    rng = np.random.default_rng(seed)
    make = wires if method == "point_to_line" else surface
    points1, vectors = make(rng, BATCH, M)
    points0 = points1[:, :N] if same else make(rng, BATCH, N)[0]
    motions = small_motions(rng, BATCH)
    return points0, move(motions, points1), np.einsum("bij,bnj->bni", motions[:, :3, :3], vectors), motions


def errors(result, motions):
    return motion_errors(pose_matrices(result.frame1_from_frame0.wxyz_xyz), motions)


@one_or_each_method
def test_aligns_copies_exactly(method):
    points0, points1, vectors, motions = problems(method, same=True)
    result = align(method, points0, points1, vectors)
    angle, shift = errors(result, motions)
    # Now and then a start is too far off, and the rounds end in a wrong place.
    assert np.mean((angle < 1e-4) & (shift < 1e-4)) >= 0.9
    good = angle < 1e-4
    assert (result.rms[good] < 1e-5).all()
    np.testing.assert_array_equal(result.matches[good], np.broadcast_to(np.arange(N), (good.sum(), N)))
    np.testing.assert_array_equal(result.inlier_share, 1.0)
    assert (result.result._value[good] == Result.success._value).all()


@pytest.mark.parametrize("method", ["point_to_line", "point_to_plane"])
def test_aligns_different_samples(method):
    # Nearest points are a tenth apart; along a line or a plane that costs nothing.
    points0, points1, vectors, motions = problems(method, seed=1)
    result = align(method, points0, points1, vectors)
    angle, shift = errors(result, motions)
    angle_point, shift_point = errors(align("point_to_point", points0, points1, vectors), motions)
    assert np.median(angle) < 0.5 * np.median(angle_point)
    assert np.median(shift) < 0.5 * np.median(shift_point)
    assert np.median(shift) < 0.01
    assert 0.02 < np.median(result.rms) < 0.3


def test_equals_rounds_with_a_tree():
    # The same rounds in numpy: nearest points by scipy, motion by singular value decomposition.
    points0, points1, vectors, _ = problems("point_to_point", seed=2)
    result = align("point_to_point", points0, points1, vectors, max_distance=0.3)
    found = pose_matrices(result.frame1_from_frame0.wxyz_xyz)
    same = 0
    for i in range(16):
        tree, pose = cKDTree(points1[i]), np.eye(4)
        for _ in range(31):
            moved = points0[i] @ pose[:3, :3].T + pose[:3, 3]
            distance, place = tree.query(moved)
            x, y = points0[i][distance < 0.3], points1[i][place[distance < 0.3]]
            u, _, vt = np.linalg.svd((y - y.mean(axis=0)).T @ (x - x.mean(axis=0)))
            pose[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
            pose[:3, 3] = y.mean(axis=0) - pose[:3, :3] @ x.mean(axis=0)
        same += np.abs(found[i] - pose).max() < 1e-3
        assert abs(result.inlier_share[i] - np.mean(distance < 0.3)) < 0.02
    assert same >= 15  # a match at the limit may fall on either side


@one_or_each_method
def test_padding_changes_nothing(method):
    points0, points1, vectors, _ = problems(method, seed=3)
    mask0, mask1 = np.arange(N) < np.arange(100, 100 + BATCH)[:, None] + 100, np.arange(M) < 350
    mask1 = np.broadcast_to(mask1, (BATCH, M))
    first = align(method, points0, points1, vectors, mask0, mask1)
    rng = np.random.default_rng(4)
    for absurd in (rng.normal(size=(BATCH, N, 3)), np.full((BATCH, N, 3), np.nan), np.full((BATCH, N, 3), 1e30)):
        filled0 = np.where(mask0[..., None], points0, absurd)
        filled1 = np.where(mask1[..., None], points1, absurd[:, :1])
        other = align(method, filled0, filled1, vectors, mask0, mask1)
        np.testing.assert_array_equal(first.frame1_from_frame0.wxyz_xyz, other.frame1_from_frame0.wxyz_xyz)
        np.testing.assert_array_equal(first.matches, other.matches)
    assert (first.matches[~mask0] == -1).all()
    # And points that are no number count as masked.
    filled0 = np.where(mask0[..., None], points0, np.nan)
    other = align(method, filled0, np.where(mask1[..., None], points1, np.inf), vectors)
    np.testing.assert_array_equal(first.matches, other.matches)


def test_partial_overlap():
    points0, points1, vectors, motions = problems("point_to_plane", seed=5)
    points0[:, :60] += np.array([0.0, 0.0, 3.0])  # what the second cloud has not seen
    result = align("point_to_plane", points0, points1, vectors, max_distance=0.4)
    angle, shift = errors(result, motions)
    assert np.median(shift) < 0.02
    assert np.median(angle) < 0.02
    assert np.abs(np.median(result.inlier_share) - 0.8) < 0.02
    assert (result.matches[:, :60] == -1).mean() > 0.95


@pytest.mark.slow
def test_a_good_start_helps():
    points0, points1, vectors, motions = problems("point_to_plane", seed=6)
    turn = SE3.exp(jnp.asarray([4.0, 0.0, 0.0, 0.0, 0.0, 1.5]))
    points1, vectors = (np.asarray(f @ x.reshape(-1, 3)).reshape(x.shape) for f, x in
                        ((turn, points1), (turn.rotation(), vectors)))  # fmt: skip
    truth = np.asarray(turn.as_matrix(), np.float64) @ motions
    near = align("point_to_plane", points0, points1, vectors, initial=np.asarray(turn.wxyz_xyz))
    assert np.median(errors(near, truth)[1]) < 0.01
    far = align("point_to_plane", points0, points1, vectors)
    assert np.median(errors(far, truth)[1]) > 0.1


@each_method
@pytest.mark.parametrize("kind", ["no overlap", "empty", "nan", "no distance"])
def test_without_matches_the_start_is_kept(method, kind):
    points0, points1, vectors, _ = problems(method, seed=7)
    mask1, distance = np.ones((BATCH, M), bool), 0.5
    start = np.asarray(SE3.exp(jnp.asarray([0.1, 0.2, 0.0, 0.0, 0.1, 0.0])).wxyz_xyz)
    if kind == "no overlap":
        points1 = points1 + 100.0
    elif kind == "empty":
        mask1[:] = False
    elif kind == "nan":
        points0[:] = np.nan
    else:
        distance = 0.0
    result = align(method, points0, points1, vectors, None, mask1, distance, start)
    np.testing.assert_allclose(result.frame1_from_frame0.wxyz_xyz, np.broadcast_to(start, (BATCH, 7)), atol=1e-6)
    np.testing.assert_array_equal(result.result._value, Result.too_few._value)
    np.testing.assert_array_equal(result.inlier_share, 0.0)
    np.testing.assert_array_equal(result.rms, 0.0)
    np.testing.assert_array_equal(result.matches, -1)


def test_a_plane_slides():
    # Point to plane between two pieces of one plane: tilt and height are found, the rest is not moved.
    rng = np.random.default_rng(8)
    points1 = np.concatenate([rng.uniform(-2.0, 2.0, (BATCH, M, 2)), np.zeros((BATCH, M, 1))], axis=-1)
    points0 = points1[:, :N] * 0.5 + np.array([0.0, 0.0, 0.1])
    vectors = np.broadcast_to([0.0, 0.0, 1.0], points1.shape)
    result = align("point_to_plane", points0, points1, vectors)
    np.testing.assert_array_equal(result.result._value, Result.degenerate._value)
    np.testing.assert_allclose(pose_matrices(result.frame1_from_frame0.wxyz_xyz)[:, :3, 3], [[0, 0, -0.1]] * BATCH,
                               atol=1e-5)  # fmt: skip


@each_method
def test_coincident_points(method):
    points0, points1, vectors, _ = problems(method, seed=9)
    points0[:], points1[:] = points0[:, :1], points0[:, :1] + 0.01
    result = align(method, points0, points1, vectors)
    assert np.isfinite(result.frame1_from_frame0.wxyz_xyz).all()
    np.testing.assert_array_equal(result.result._value, Result.degenerate._value)


@pytest.mark.slow
def test_gradient_for_given_matches(x64):
    rng = np.random.default_rng(10)
    points1, normals = surface(rng, 1, 60)
    motion = small_motions(rng, 1, 0.02, 0.02)
    points0, points1 = points1[0, :50] + 0.01 * rng.normal(size=(50, 3)), move(motion, points1)[0]

    def total(points0, points1, normals1):
        pose = icp(points0, points1, method="point_to_plane", normals1=normals1, iterations=10).frame1_from_frame0
        return jnp.sum(pose.as_matrix() * jnp.arange(1.0, 17.0).reshape(4, 4))

    check_gradients(total, [(points0, points1, normals[0])])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["point_to_point", "point_to_plane"])
def test_gradients_are_finite_everywhere(method):
    points0, points1, vectors, _ = (x.astype(np.float32) for x in problems(method, seed=11))
    points0, points1, vectors = points0[:24, :40], points1[:24, :50], vectors[:24, :50]
    points1[:4] += 100.0
    points0[4:8] = points0[4:8, :1]
    points0[8:12, 3] = np.nan
    vectors[12:16] = 0.0
    points1[16:18] = np.inf

    def total(points0, points1, vectors):
        result = icp(points0, points1, method=method, normals1=vectors, iterations=3, max_distance=1.0)
        return jnp.sum(result.frame1_from_frame0.wxyz_xyz) + result.rms

    for part in jax.jit(jax.vmap(jax.grad(total, (0, 1, 2))))(points0, points1, vectors):
        assert np.isfinite(part).all()
        if method == "point_to_plane":
            assert np.abs(part[18:]).max() > 0
            assert np.abs(part[:4]).max() == 0


def test_bad_input():
    cloud = np.zeros((5, 3), np.float32)
    with pytest.raises(ValueError, match="expected one of point_to_point"):
        icp(cloud, cloud, method="plane")
    with pytest.raises(ValueError, match="found no normals1"):
        icp(cloud, cloud, method="point_to_plane")
    with pytest.raises(ValueError, match="found no directions1"):
        icp(cloud, cloud, method="point_to_line")
    with pytest.raises(ValueError, match=r"found points0 of shape \(5, 2\)"):
        inspect.unwrap(icp)(cloud[:, :2], cloud)
    with pytest.raises(ValueError, match="found a mask of"):
        inspect.unwrap(icp)(cloud, cloud, mask0=np.ones(4, bool))
