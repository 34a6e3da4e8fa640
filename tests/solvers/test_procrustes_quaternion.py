import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.alignment_problems import (
    SPOILED,
    alignment_problems,
    check_gradients,
    mixed,
    pose_matrices,
    spoiled,
)
from tests.solvers.problems import lanes, recall, solve_in_batches
from vojax.solvers import procrustes, procrustes_quaternion

solve_last = jax.jit(jax.vmap(procrustes_quaternion, in_axes=-1, out_axes=-1))
other_last = jax.jit(jax.vmap(procrustes, in_axes=-1, out_axes=-1))


def solve(points0, points1, weights=None, dtype=np.float64, solver=solve_last):
    weights = np.ones(points0.shape[:2]) if weights is None else weights
    return solve_in_batches(solver, points0, points1, weights, dtype=dtype)


def weights_for(count, n, seed):
    return np.random.default_rng(seed + 100).uniform(0.1, 2.0, (count, n))


def test_finds_the_truth(dtype):
    points0, points1, rotation, translation = alignment_problems(100_000, 6)
    candidates = solve(points0, points1, weights_for(100_000, 6, 0), dtype)
    assert candidates.valid.shape == (100_000, 1)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-3) >= 0.9999
    else:
        assert recall(candidates, rotation, translation, 1e-9) >= 0.9999


@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
def test_equals_procrustes(x64, noise):
    points0, points1, *_ = alignment_problems(2000, 6, noise=noise, seed=1)
    weights = weights_for(2000, 6, 1)
    ours, theirs = (pose_matrices(solve(points0, points1, weights, solver=s).models.wxyz_xyz)
                    for s in (solve_last, other_last))  # fmt: skip
    assert np.quantile(np.abs(ours - theirs).max(axis=(1, 2, 3)), 0.995) < 1e-12
    np.testing.assert_allclose(ours, theirs, atol=1e-10)


def test_equals_scipy(x64):
    points0, points1, *_ = alignment_problems(20, 6, noise=0.3, seed=2)
    weights = weights_for(20, 6, 2)
    found = pose_matrices(solve(points0, points1, weights).models.wxyz_xyz)[:, 0]
    for x, y, w, pose in zip(points0, points1, weights, found, strict=True):
        w = w / w.sum()
        expected, _ = Rotation.align_vectors(y - w @ y, x - w @ x, weights=w)
        np.testing.assert_allclose(pose[:3, :3], expected.as_matrix(), atol=1e-12)


@pytest.mark.slow
def test_no_rotation_is_better(x64):
    # Sets that have nothing in common, so that the optimum is anywhere on the sphere of quaternions.
    rng = np.random.default_rng(3)
    points0, points1 = rng.normal(size=(200, 5, 3)), rng.normal(size=(200, 5, 3))
    found = pose_matrices(solve(points0, points1).models.wxyz_xyz)[:, 0, :3, :3]
    x, y = (p - p.mean(axis=1, keepdims=True) for p in (points0, points1))
    correlation = np.einsum("bni,bnj->bij", y, x)
    best = np.sum(found * correlation, axis=(1, 2))
    others = Rotation.random(5000, rng=rng).as_matrix()
    assert (np.einsum("kij,bij->bk", others, correlation).max(axis=1) <= best).all()


def test_special_rotations(dtype):
    # Half turns, the identity and quarter turns, where a component of the quaternion vanishes.
    points0, *_ = alignment_problems(10, 5, seed=4)
    axes = np.concatenate([np.zeros((1, 3)), np.eye(3) * np.pi, np.eye(3) * np.pi / 2, -np.eye(3) * np.pi / 2])
    rotation = Rotation.from_rotvec(axes).as_matrix()
    candidates = solve(points0, np.einsum("bij,bnj->bni", rotation, points0) + 1.0, dtype=dtype)
    assert recall(candidates, rotation, np.ones((10, 3)), 1e-4 if dtype == jnp.float32 else 1e-12) == 1.0


@pytest.mark.slow
def test_mirrored_sets_give_the_best_rotation(x64):
    points0, _, rotation, _ = alignment_problems(500, 8, seed=5)
    points1 = np.einsum("bij,bnj->bni", rotation, points0 * np.array([1.0, 1.0, -1.0]))
    ours, theirs = solve(points0, points1), solve(points0, points1, solver=other_last)
    assert ours.valid.all()
    found, expected = pose_matrices(ours.models.wxyz_xyz), pose_matrices(theirs.models.wxyz_xyz)
    np.testing.assert_allclose(np.linalg.det(found[:, 0, :3, :3]), 1.0, atol=1e-12)
    assert np.quantile(np.abs(found - expected).max(axis=(1, 2, 3)), 0.99) < 1e-11


@pytest.mark.slow
def test_coinciding_smaller_eigenvalues(dtype):
    # A cube: three equal singular values, so three equal eigenvalues below the largest. And a square.
    cube = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(8, 3)
    square = cube * np.array([1.0, 1.0, 0.0])
    points0 = np.concatenate([np.stack([cube] * 100), np.stack([square] * 100)])
    rotation = Rotation.random(200, rng=np.random.default_rng(6)).as_matrix()
    points1 = np.einsum("bij,bnj->bni", rotation, points0) + 2.0
    candidates = solve(points0, points1, dtype=dtype)
    assert recall(candidates, rotation, np.full((200, 3), 2.0), 1e-5 if dtype == jnp.float32 else 1e-12) == 1.0


def test_thin_sets(dtype):
    points0, _, rotation, translation = alignment_problems(2000, 8, seed=7)
    points0 = points0 * np.array([1.0, 0.03, 0.03])
    points1 = np.einsum("bij,bnj->bni", rotation, points0) + translation[:, None]
    candidates = solve(points0, points1, dtype=dtype)
    # The gap of the eigenvalues is 2e-3 of the largest, of which rounding is 6e-8.
    assert recall(candidates, rotation, translation, 1e-3 if dtype == jnp.float32 else 1e-10) >= 0.999


@pytest.mark.parametrize("kind", [*SPOILED, "far", "octahedron", "negative", "no weight", "huge"])
def test_degenerate_sets(kind, dtype):
    points0, points1, *_ = alignment_problems(200, 6, seed=8)
    weights = np.ones((200, 6))
    if kind == "far":
        points0, points1 = spoiled(points0, points1, "collinear")
        points0, points1 = points0 + 1000.0, points1 + 1000.0
    elif kind == "octahedron":
        points0 = np.stack([np.concatenate([np.eye(3), -np.eye(3)])] * 200)
        points1 = -points0
    elif kind == "negative":
        weights[:, 1] = -1.0
    elif kind == "no weight":
        weights[:] = 0.0
    else:
        points0, points1 = spoiled(points0, points1, kind)
    candidates = solve(points0, points1, weights, dtype)
    if kind == "huge" and dtype == jnp.float64:
        assert candidates.valid.all()
        return
    assert not candidates.valid.any()
    np.testing.assert_array_equal(candidates.models.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (200, 1, 7)))


def test_nothing_but_numbers_comes_out():
    candidates = solve(*mixed(9, 100_000, 6), dtype=np.float32)
    assert np.isfinite(candidates.models.wxyz_xyz).all()
    assert candidates.valid[50_000:].all()


@pytest.mark.slow
def test_nothing_but_numbers_comes_out_of_a_million(dtype):
    for seed in range(8):
        assert np.isfinite(solve(*mixed(seed + 20, 125_000, 6), dtype=dtype).models.wxyz_xyz).all()


def weighted_sum(points0, points1, weights):
    models = procrustes_quaternion(points0, points1, weights).models
    return jnp.sum(models.as_matrix() * jnp.arange(1.0, 17.0).reshape(1, 4, 4))


@pytest.mark.slow
def test_gradients_equal_central_differences(x64):
    points0, points1, *_ = alignment_problems(2, 6, noise=0.3, seed=10)
    weights = weights_for(2, 6, 10)
    # Three equal eigenvalues, where the derivative of an eigenvector is not a number.
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    points0[1], points1[1], weights[1] = octahedron, octahedron[:, [1, 2, 0]], 1.0
    check_gradients(weighted_sum, list(zip(points0, points1, weights, strict=True)))


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    def total(points0, points1, weights):
        return jnp.sum(procrustes_quaternion(points0, points1, weights).models.wxyz_xyz)

    gradient = jax.jit(jax.vmap(jax.grad(total, (0, 1, 2)), -1, -1))
    for part in gradient(*lanes(*mixed(11, 2048, 6), np.ones((2048, 6)), dtype=np.float32)):
        assert np.isfinite(part).all()
        assert np.abs(part[..., 1024:]).max() > 0


def test_bad_shapes():
    with pytest.raises(ValueError, match="at least 3"):
        procrustes_quaternion(np.zeros((2, 3), np.float32), np.zeros((2, 3), np.float32))
    with pytest.raises(ValueError, match="one per point"):
        inspect.unwrap(procrustes_quaternion)(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(3))
