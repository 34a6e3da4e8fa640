import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.solvers.alignment_problems import check_gradients, pose_matrices
from tests.solvers.clouds import motion_errors, move, small_motions, surface
from vojax import Result
from vojax.solvers import gicp, icp, surface_covariances, surface_normals

N, M, BATCH, K = 300, 400, 64, 12


@jax.jit
@jax.vmap
def align(points0, points1, mask0, mask1):
    return gicp(points0, points1, mask0=mask0, mask1=mask1, neighbours=K, iterations=20, max_distance=0.5)


by_points = jax.jit(jax.vmap(lambda points0, points1: icp(points0, points1, iterations=20, max_distance=0.5)))
normals_of = jax.jit(lambda points, mask: surface_normals(points, K, mask))


def problems(seed):
    rng = np.random.default_rng(seed)
    points1, points0 = surface(rng, BATCH, M)[0], surface(rng, BATCH, N)[0]
    motions = small_motions(rng, BATCH)
    return points0.astype(np.float32), move(motions, points1).astype(np.float32), motions


def solve(points0, points1, mask0=None, mask1=None):
    mask0 = np.ones((BATCH, N), bool) if mask0 is None else mask0
    mask1 = np.ones((BATCH, M), bool) if mask1 is None else mask1
    return jax.tree.map(np.asarray, align(points0, points1, mask0, mask1))


@pytest.mark.slow
def test_aligns_different_samples_better_than_points():
    points0, points1, motions = problems(0)
    ours, theirs = solve(points0, points1), by_points(points0, points1)
    (angle, shift), (angle_point, shift_point) = (
        motion_errors(pose_matrices(r.frame1_from_frame0.wxyz_xyz), motions) for r in (ours, theirs)
    )
    assert np.median(angle) < 0.5 * np.median(angle_point)
    assert np.median(shift) < 0.5 * np.median(shift_point)
    assert np.median(shift) < 0.02
    assert (ours.inlier_share > 0.95).all()
    assert (ours.result._value != Result.degenerate._value).all()


def test_padding_changes_nothing():
    points0, points1, _ = problems(1)
    mask0, mask1 = np.arange(N) < 200, np.arange(M) < 250
    mask0, mask1 = np.broadcast_to(mask0, (BATCH, N)), np.broadcast_to(mask1, (BATCH, M))
    first = solve(points0, points1, mask0, mask1)
    absurd = (np.where(m[..., None], p, np.nan).astype(np.float32) for m, p in ((mask0, points0), (mask1, points1)))
    other = solve(*absurd, mask0, mask1)
    np.testing.assert_array_equal(first.frame1_from_frame0.wxyz_xyz, other.frame1_from_frame0.wxyz_xyz)
    assert (first.matches[:, 200:] == -1).all()


@pytest.mark.parametrize("kind", ["no overlap", "empty", "nan"])
def test_without_matches_the_start_is_kept(kind):
    points0, points1, _ = problems(2)
    mask1 = np.full((BATCH, M), kind != "empty")
    if kind == "no overlap":
        points1 = points1 + 100.0
    elif kind == "nan":
        points0[:] = np.nan
    result = solve(points0, points1, None, mask1)
    np.testing.assert_array_equal(result.result._value, Result.too_few._value)
    np.testing.assert_array_equal(result.frame1_from_frame0.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (BATCH, 7)))
    np.testing.assert_array_equal(result.inlier_share, 0.0)


@pytest.mark.parametrize("kind", ["coincident", "line"])
def test_clouds_without_shape_stay_finite(kind):
    points0, points1, _ = problems(3)
    if kind == "coincident":
        points0[:], points1[:] = points0[:, :1], points0[:, :1] + 0.01
    else:
        points0, points1 = points0 * np.array([1.0, 0.0, 0.0]), points1 * np.array([1.0, 0.0, 0.0])
    result = solve(points0.astype(np.float32), points1.astype(np.float32))
    assert np.isfinite(result.frame1_from_frame0.wxyz_xyz).all()
    assert np.isfinite(result.rms).all()


def test_normals_are_those_of_the_neighbours():
    points, truth = surface(np.random.default_rng(4), 1, 700)
    points, truth = points[0].astype(np.float32), truth[0]
    found, determined = (np.asarray(x) for x in normals_of(points, np.ones(700, bool)))
    assert determined.all()
    _, places = cKDTree(points).query(points, k=K)
    for i in range(0, 700, 7):
        near = points[places[i]].astype(np.float64)
        _, s, vt = np.linalg.svd(near - near.mean(axis=0))
        assert abs(vt[2] @ found[i]) > 1.0 - 1e-4 * (s[1] / (s[1] - s[2])) ** 2
    assert np.quantile(np.abs(np.sum(found * truth, axis=1)), 0.2) > 0.9


def test_neighbourhoods_without_a_normal():
    rng = np.random.default_rng(5)
    points = rng.normal(size=(700, 3)).astype(np.float32)
    line = points * np.array([1.0, 0.0, 0.0], np.float32)
    normals, determined = normals_of(line, np.ones(700, bool))
    assert not np.asarray(determined).any()
    np.testing.assert_array_equal(normals, np.broadcast_to([0.0, 0.0, 1.0], (700, 3)))
    _, determined = normals_of(points, np.arange(700) < 2)
    assert not np.asarray(determined).any()


def test_covariances_are_flat(x64):
    points, _ = surface(np.random.default_rng(6), 1, 200)
    covariances = np.asarray(jax.jit(lambda x: surface_covariances(x, K, 0.01))(points[0]))
    np.testing.assert_allclose(np.linalg.eigvalsh(covariances), [[0.01, 1.0, 1.0]] * 200, atol=1e-12)


@pytest.mark.slow
def test_gradient_for_given_matches(x64):
    rng = np.random.default_rng(7)
    points1 = surface(rng, 1, 60)[0]
    motion = small_motions(rng, 1, 0.02, 0.02)
    points0, points1 = points1[0, :50] + 0.01 * rng.normal(size=(50, 3)), move(motion, points1)[0]
    covariance0, covariance1 = (np.asarray(surface_covariances(x, K, 0.1)) for x in (points0, points1))

    def total(points0, points1, root0, root1):
        covariances = (x @ jnp.swapaxes(x, 1, 2) for x in (root0, root1))
        pose = gicp(points0, points1, **dict(zip(("covariance0", "covariance1"), covariances, strict=True)))
        return jnp.sum(pose.frame1_from_frame0.as_matrix() * jnp.arange(1.0, 17.0).reshape(4, 4))

    check_gradients(total, [(points0, points1, *map(np.linalg.cholesky, (covariance0, covariance1)))], used=(0, 1))


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    points0, points1, _ = problems(8)
    points0, points1 = points0[:20, :40], points1[:20, :50]
    points1[:4] += 100.0
    points0[4:8] = points0[4:8, :1]
    points0[8:12, 3] = np.nan
    points1[12:14] = np.inf

    def total(points0, points1):
        result = gicp(points0, points1, neighbours=6, iterations=3, max_distance=1.0)
        return jnp.sum(result.frame1_from_frame0.wxyz_xyz) + result.rms

    for part in jax.jit(jax.vmap(jax.grad(total, (0, 1))))(points0, points1):
        assert np.isfinite(part).all()
        assert np.abs(part[14:]).max() > 0


def test_bad_input():
    cloud = np.zeros((5, 3), np.float32)
    with pytest.raises(ValueError, match="at least 3"):
        surface_normals(cloud, neighbours=2)
    with pytest.raises(ValueError, match="found covariance1 of shape"):
        inspect.unwrap(gicp)(cloud, cloud, covariance0=np.zeros((5, 3, 3), np.float32),
                             covariance1=np.zeros((4, 3, 3), np.float32))  # fmt: skip
