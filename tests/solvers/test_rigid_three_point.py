import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.solvers.alignment_problems import SPOILED, alignment_problems, check_gradients, mixed, pose_matrices, spoiled
from tests.solvers.problems import lanes, pose_errors, recall, solve_in_batches
from vojax.solvers import procrustes, rigid_three_point

solve_last = jax.jit(jax.vmap(rigid_three_point, in_axes=-1, out_axes=-1))
general_last = jax.jit(jax.vmap(procrustes, in_axes=-1, out_axes=-1))


def solve(points0, points1, dtype):
    return solve_in_batches(solve_last, points0, points1, dtype=dtype)


def test_finds_the_truth(dtype):
    points0, points1, rotation, translation = alignment_problems(100_000, 3)
    candidates = solve(points0, points1, dtype)
    assert candidates.valid.shape == (100_000, 1)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-3) >= 0.9995
    else:
        assert recall(candidates, rotation, translation, 1e-6) >= 0.9999
        assert recall(candidates, rotation, translation, 1e-9) >= 0.9995


@pytest.mark.parametrize("noise", [0.05, 3.0], ids=["noise", "unrelated"])
def test_is_the_least_squares_optimum(x64, noise):
    # numpy's singular value decomposition, with the reflection put right.
    points0, points1, *_ = alignment_problems(500, 3, noise=noise, seed=1)
    candidates = solve(points0, points1, np.float64)
    assert candidates.valid.all()
    mean0, mean1 = points0.mean(axis=1), points1.mean(axis=1)
    h = np.einsum("bni,bnj->bij", points1 - mean1[:, None], points0 - mean0[:, None])
    u, _, vt = np.linalg.svd(h)
    u[..., 2] *= np.linalg.det(u @ vt)[:, None]
    rotation = u @ vt
    translation = mean1 - np.einsum("bij,bj->bi", rotation, mean0)
    assert np.quantile(pose_errors(candidates.models.wxyz_xyz, rotation, translation), 0.99) < 1e-10


def test_a_mirrored_triangle_is_turned_over(x64):
    points0, *_ = alignment_problems(200, 3, seed=2)
    points1 = points0 * np.array([1.0, 1.0, -1.0])
    candidates = solve(points0, points1, np.float64)
    general = solve_in_batches(general_last, points0, points1, np.ones((200, 3)), dtype=np.float64)
    assert candidates.valid.all()
    assert general.valid.all()
    found, expected = (pose_matrices(c.models.wxyz_xyz[:, 0]) for c in (candidates, general))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    moved = np.einsum("bij,bnj->bni", found[:, :3, :3], points0) + found[:, None, :3, 3]
    np.testing.assert_allclose(moved, points1, atol=1e-9)


def test_thin_triangles_in_single_precision():
    points0, _, rotation, translation = alignment_problems(2000, 3, seed=3)
    points0[:, 2] = 0.3 * points0[:, 0] + 0.7 * points0[:, 1] + 1e-3 * points0[:, 2]
    points1 = np.einsum("bij,bnj->bni", rotation, points0) + translation[:, None]
    candidates = solve(points0, points1, np.float32)
    errors = pose_errors(candidates.models.wxyz_xyz, rotation, translation)
    assert candidates.valid.mean() > 0.98
    # Coordinates of size 5 round by 3e-7, over 1e-3 that is 3e-4 radians.
    assert np.median(errors) < 1e-3


def test_far_from_the_origin_in_single_precision():
    points0, points1, rotation, _ = alignment_problems(1000, 3, seed=4)
    points0, points1 = points0 + 1000.0, points1 - 500.0
    candidates = solve(points0, points1, np.float32)
    assert candidates.valid.mean() > 0.97
    # The rotation alone: the translation lies a thousand units away from the points.
    still = np.concatenate([candidates.models.wxyz_xyz[..., :4], np.ones((1000, 1, 3))], axis=-1)
    assert np.median(pose_errors(still, rotation, np.ones((1000, 3)))) < 1e-3


@pytest.mark.parametrize("kind", [*SPOILED, "collinear in one", "huge", "tiny"])
def test_degenerate_sets(kind, dtype):
    points0, points1 = spoiled(*alignment_problems(200, 3, seed=5)[:2], kind)
    candidates = solve(points0, points1, dtype)
    if kind in ("huge", "tiny") and dtype == jnp.float64:
        assert candidates.valid.all()
        return
    assert not candidates.valid.any()
    np.testing.assert_array_equal(candidates.models.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (200, 1, 7)))


def test_collinear_far_from_the_origin(dtype):
    points0, points1 = spoiled(*alignment_problems(200, 3, seed=6)[:2], "collinear")
    candidates = solve(points0 + 1000.0, points1 + 1000.0, dtype)
    assert not candidates.valid.any()


def test_nothing_but_numbers_comes_out():
    candidates = solve(*mixed(7, 100_000, 3), np.float32)
    assert np.isfinite(candidates.models.wxyz_xyz).all()
    assert candidates.valid[50_000:].mean() > 0.999


@pytest.mark.slow
def test_nothing_but_numbers_comes_out_of_a_million(dtype):
    for seed in range(8):
        candidates = solve(*mixed(seed + 20, 125_000, 3), dtype)
        assert np.isfinite(candidates.models.wxyz_xyz).all()


def weighted_sum(points0, points1):
    models = rigid_three_point(points0, points1).models
    return jnp.sum(models.as_matrix() * jnp.arange(1.0, 17.0).reshape(1, 4, 4))


def test_gradients_equal_central_differences(x64):
    points0, points1, *_ = alignment_problems(3, 3, noise=0.3, seed=8)
    check_gradients(weighted_sum, list(zip(points0, points1, strict=True)))


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    gradient = jax.jit(
        jax.vmap(jax.grad(lambda x, y: jnp.sum(rigid_three_point(x, y).models.wxyz_xyz), (0, 1)), -1, -1)
    )
    for part in gradient(*lanes(*mixed(9, 2048, 3), dtype=np.float32)):
        assert np.isfinite(part).all()
        assert np.abs(part[..., 1024:]).max() > 0


def test_batch_equals_loop(x64):
    points0, points1, *_ = alignment_problems(5, 3, noise=0.1, seed=10)
    batch = solve(points0, points1, np.float64)
    one = jax.jit(rigid_three_point)
    for i in range(5):
        np.testing.assert_allclose(one(points0[i], points1[i]).models.wxyz_xyz, batch.models.wxyz_xyz[i], atol=1e-13)


def test_bad_shapes():
    with pytest.raises(ValueError, match=r"expected two of \(3, 3\)"):
        inspect.unwrap(rigid_three_point)(np.zeros((3, 3), np.float32), np.zeros((4, 3), np.float32))
