import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.solvers.alignment_problems import SPOILED, alignment_problems, check_gradients, mixed, spoiled
from tests.solvers.problems import lanes, solve_in_batches
from vojax.solvers import affine_3d, translation_3d

SOLVERS = pytest.mark.parametrize("solver", [translation_3d, affine_3d])
N = 6
batched = {solver: jax.jit(jax.vmap(solver, in_axes=-1, out_axes=-1)) for solver in (translation_3d, affine_3d)}
PLACEHOLDER = {translation_3d: np.zeros(3), affine_3d: np.eye(3, 4)}


def solve(solver, points0, points1, weights=None, dtype=np.float64):
    weights = np.ones(points0.shape[:2]) if weights is None else weights
    return solve_in_batches(batched[solver], points0, points1, weights, dtype=dtype)


def problems(solver, count, noise=0.0, seed=0):
    """Points, weights, and the true models."""
    rng = np.random.default_rng(seed)
    points0 = rng.normal(size=(count, N, 3))
    matrix = np.stack([np.eye(3)] * count) if solver is translation_3d else rng.normal(size=(count, 3, 3))
    offset = rng.normal(size=(count, 3))
    points1 = np.einsum("bij,bnj->bni", matrix, points0) + offset[:, None] + noise * rng.normal(size=points0.shape)
    truth = offset if solver is translation_3d else np.concatenate([matrix, offset[..., None]], axis=-1)
    return points0, points1, rng.uniform(0.1, 2.0, (count, N)), truth


@SOLVERS
def test_finds_the_truth(solver, dtype):
    points0, points1, weights, truth = problems(solver, 100_000)
    candidates = solve(solver, points0, points1, weights, dtype)
    error = np.abs(candidates.models[:, 0] - truth).reshape(100_000, -1).max(axis=1)
    recall = (candidates.valid[:, 0] & (error < (1e-3 if dtype == jnp.float32 else 1e-9))).mean()
    assert recall >= (0.999 if dtype == jnp.float32 else 0.9999)


@SOLVERS
def test_equals_numpy(solver, x64):
    points0, points1, weights, _ = problems(solver, 200, noise=0.3, seed=1)
    found = solve(solver, points0, points1, weights).models[:, 0]
    for x, y, w, model in zip(points0, points1, weights, found, strict=True):
        root = np.sqrt(w)[:, None]
        if solver is translation_3d:
            expected = np.linalg.lstsq(root, root * (y - x), rcond=None)[0][0]
        else:
            rows = np.concatenate([x, np.ones((N, 1))], axis=1)
            expected = np.linalg.lstsq(root * rows, root * y, rcond=None)[0].T
        np.testing.assert_allclose(model, expected, atol=1e-9, rtol=1e-9)


def test_affine_of_thin_sets_in_single_precision():
    points0, _, weights, truth = problems(affine_3d, 1000, seed=2)
    points0[..., 2] *= 0.01
    points1 = np.einsum("bij,bnj->bni", truth[..., :3], points0) + truth[:, None, :, 3]
    candidates = solve(affine_3d, points0, points1, weights, np.float32)
    moved = np.einsum("bij,bnj->bni", candidates.models[:, 0, :, :3], points0) + candidates.models[:, 0, None, :, 3]
    assert candidates.valid.mean() > 0.99
    assert np.quantile(np.abs(moved - points1)[candidates.valid[:, 0]], 0.99) < 3e-5
    error = np.abs(candidates.models[:, 0] - truth).max(axis=(1, 2))
    assert np.median(error) < 3e-4  # 1e-7 over a hundredth


def test_a_mirror_and_a_projection_are_affine(x64):
    points0, *_ = alignment_problems(100, N, seed=3)
    for diagonal in ([-1.0, 1.0, 1.0], [1.0, 1.0, 0.0]):
        found = solve(affine_3d, points0, points0 * np.array(diagonal))
        assert found.valid.all()
        np.testing.assert_allclose(
            found.models[:, 0, :, :3], np.broadcast_to(np.diag(diagonal), (100, 3, 3)), atol=1e-8
        )


@pytest.mark.parametrize("kind", [*SPOILED, "plane", "plane far away", "negative", "no weight"])
@SOLVERS
def test_degenerate_sets(solver, kind, dtype):
    points0, points1, *_ = alignment_problems(200, N, seed=4)
    weights = np.ones((200, N))
    if kind == "negative":
        weights[:, 1] = -1.0
    elif kind == "no weight":
        weights[:] = 0.0
    elif kind.startswith("plane"):
        points0[..., 2] = 0.3 * points0[..., 0] - 0.2 * points0[..., 1]
        points0 += 0.0 if kind == "plane" else 1000.0
    else:
        points0, points1 = spoiled(points0, points1, kind)
    candidates = solve(solver, points0, points1, weights, dtype)
    if solver is translation_3d and kind not in ("nan", "inf", "negative", "no weight"):
        assert candidates.valid.all()  # any point will do
        return
    assert not candidates.valid.any()
    expected = PLACEHOLDER[solver]
    np.testing.assert_array_equal(candidates.models, np.broadcast_to(expected, (200, 1, *expected.shape)))


@SOLVERS
def test_nothing_but_numbers_comes_out(solver):
    assert np.isfinite(solve(solver, *mixed(5, 100_000, N), dtype=np.float32).models).all()


@SOLVERS
def test_gradients_equal_central_differences(solver, x64):
    def total(*data):
        models = solver(*data).models
        return jnp.sum(models * jnp.arange(1.0, models.size + 1.0).reshape(models.shape))

    data = problems(solver, 1, noise=0.3, seed=6)[:3]
    check_gradients(total, [tuple(x[0] for x in data)])


@pytest.mark.slow
@SOLVERS
def test_gradients_are_finite_everywhere(solver):
    gradient = jax.jit(jax.vmap(jax.grad(lambda *data: jnp.sum(solver(*data).models), (0, 1, 2)), -1, -1))
    for part in gradient(*lanes(*mixed(7, 2048, N), np.ones((2048, N)), dtype=np.float32)):
        assert np.isfinite(part).all()


@SOLVERS
def test_bad_shapes(solver):
    with pytest.raises(ValueError, match="at least"):
        solver(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    with pytest.raises(ValueError, match="two equal shapes"):
        inspect.unwrap(solver)(np.zeros((4, 3)), np.zeros((5, 3)))
