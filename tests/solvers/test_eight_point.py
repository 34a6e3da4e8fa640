"""The linear solvers for eight and more correspondences, and the projection to essential matrices."""

import functools

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.solvers.problems import central_differences, lanes, solve_in_batches, unit_matrices
from tests.solvers.two_views import (
    CAMERA,
    assert_finite_gradients,
    assert_finite_with_zero_placeholders,
    bearing_problems,
    calibrated,
    epipolar_errors,
    matrix_errors,
    numeric_gradient,
    pixel_problems,
    spoiled,
)
from vojax.solvers import eight_point, fundamental_eight_point, project_to_essential
from vojax.solvers._linear_epipolar import two_views

SIZE = 1024
essential_last = jax.jit(jax.vmap(eight_point, in_axes=-1, out_axes=-1))
fundamental_last = jax.jit(jax.vmap(fundamental_eight_point, in_axes=-1, out_axes=-1))
project_last = jax.jit(jax.vmap(project_to_essential, in_axes=-1, out_axes=-1))


def errors_of(kind, n, count, dtype, seed, size=SIZE):
    """Errors and candidates of random problems, in coordinates of the calibrated camera."""
    if kind == "essential":
        first, second, truth = bearing_problems(count, n, seed)
        candidates = solve_in_batches(essential_last, first, second, dtype=dtype, size=size)
        return matrix_errors(candidates.models, candidates.valid, truth), candidates
    first, second, truth = pixel_problems(count, n, seed)
    candidates = solve_in_batches(fundamental_last, first, second, dtype=dtype, size=size)
    return matrix_errors(calibrated(candidates.models), candidates.valid, calibrated(truth)), candidates


# The longest to compile are left to the slow run.
both_sizes = pytest.mark.parametrize(
    ("kind", "n"),
    [
        ("essential", 8),
        ("essential", 20),
        ("fundamental", 8),
        pytest.param("fundamental", 20, marks=pytest.mark.slow),
    ],
)


@both_sizes
def test_finds_the_truth(kind, n, dtype):
    errors, candidates = errors_of(kind, n, 4 * SIZE, dtype, seed=1)
    assert_finite_with_zero_placeholders(candidates)
    if dtype == jnp.float64:
        # Row 30 of the seeds: 1e-10.
        assert (errors < 1e-10).mean() >= (0.9995 if n == 8 else 1.0)
        assert errors.max() < 1e-6
    else:
        assert (errors < 1e-3).mean() >= (0.996 if n == 8 else 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["essential", "fundamental"])
def test_finds_the_truth_in_many_problems(kind, dtype):
    errors, _ = errors_of(kind, 8, 100_000, dtype, seed=2)
    if dtype == jnp.float64:
        assert (errors < 1e-8).mean() >= 0.9999
    else:
        assert (errors < 1e-3).mean() >= 0.997


@pytest.mark.parametrize("kind", ["essential", "fundamental"])
def test_the_equations_hold(kind, dtype):
    _, candidates = errors_of(kind, 8, SIZE, dtype, seed=3)
    eps = float(jnp.finfo(dtype).eps)
    if kind == "essential":
        first, second, _ = bearing_problems(SIZE, 8, 3)
        models = candidates.models.astype(np.float64)
    else:
        first, second, _ = bearing_problems(SIZE, 8, 3)
        models = calibrated(candidates.models)
    # N has rounding errors only, but the nearest matrix of the right kind is as far from it as N is from the truth.
    residual = np.abs(epipolar_errors(models, first, second)).max(axis=(1, 2))
    assert np.quantile(residual, 0.9) < 1000 * eps
    singular = np.linalg.svd(models[:, 0], compute_uv=False)
    np.testing.assert_allclose(singular[:, 2], 0.0, atol=30 * eps)
    if kind == "essential":
        np.testing.assert_allclose(singular[:, :2], 0.5**0.5, atol=10 * eps)


def test_fundamental_matrix_is_that_of_opencv(x64):
    # With noise, where the rank-2 correction is not small.
    rng = np.random.default_rng(4)
    pixels0, pixels1, _ = pixel_problems(40, 20, seed=4)
    pixels0, pixels1 = (x + rng.normal(size=x.shape) for x in (pixels0, pixels1))
    candidates = solve_in_batches(fundamental_last, pixels0, pixels1, dtype=np.float64, size=SIZE)
    for i in range(40):
        theirs, _ = cv2.findFundamentalMat(pixels0[i], pixels1[i], cv2.FM_8POINT)
        np.testing.assert_allclose(calibrated(candidates.models[i]), calibrated(unit_matrices(theirs))[None], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("n", [8, 20])
def test_essential_matrix_is_that_of_numpy(n, x64):
    rng = np.random.default_rng(5)
    rays0, rays1, _ = bearing_problems(40, n, seed=5)
    rays0, rays1 = (x + 1e-3 * rng.normal(size=x.shape) for x in (rays0, rays1))
    rays0, rays1 = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (rays0, rays1))
    weights = rng.uniform(0.2, 1.0, (40, n))
    weights[:, :8] += 1.0
    found = solve_in_batches(essential_last, rays0, rays1, weights, dtype=np.float64, size=SIZE)
    for i in range(40):
        w = weights[i] / weights[i].sum()
        factors = [np.linalg.cholesky(np.einsum("n,ni,nj->ij", w, x[i], x[i])) for x in (rays0, rays1)]
        if n == 8:
            factors = [np.eye(3)] * 2
        x0, x1 = (np.linalg.solve(f, x[i].T).T for f, x in zip(factors, (rays0, rays1), strict=True))
        rows = np.einsum("n,ni,nj->nij", np.sqrt(w), x1, x0).reshape(n, 9)
        null = np.linalg.svd(rows)[2][8].reshape(3, 3)
        matrix = np.linalg.inv(factors[1]).T @ null @ np.linalg.inv(factors[0])
        u, _, vt = np.linalg.svd(matrix)
        expected = unit_matrices(u @ np.diag([1.0, 1.0, 0.0]) @ vt)
        np.testing.assert_allclose(found.models[i, 0], expected, atol=1e-9)


def test_zero_weight_masks(x64):
    dtype = np.float64
    rays0, rays1, truth = bearing_problems(64, 20, seed=6)
    rays1[:, 12:] = np.roll(rays1[:, 12:], 1, axis=1)
    weights = np.ones((64, 20))
    weights[:, 12:] = 0.0
    candidates = solve_in_batches(essential_last, rays0, rays1, weights, dtype=dtype, size=SIZE)
    errors = matrix_errors(candidates.models, candidates.valid, truth)
    assert errors.max() < 1e-9
    weights[:, 7:] = 0.0
    assert not solve_in_batches(essential_last, rays0, rays1, weights, dtype=dtype, size=SIZE).valid.any()
    weights[:, 0] = -1.0
    assert not solve_in_batches(essential_last, rays0, rays1, weights, dtype=dtype, size=SIZE).valid.any()


@pytest.mark.parametrize("n", [8, 20])
def test_noise_moves_the_solution_smoothly(n, x64):
    rays0, rays1, truth = bearing_problems(SIZE, n, seed=7)
    noise = np.random.default_rng(7).normal(size=(2, *rays0.shape))
    medians = []
    for size in (1e-4, 1e-5, 1e-6):
        moved = (rays0 + size * noise[0], rays1 + size * noise[1])
        candidates = solve_in_batches(essential_last, *moved, dtype=np.float64, size=SIZE)
        medians.append(np.median(matrix_errors(candidates.models, candidates.valid, truth)))
    assert 8.0 < medians[1] / medians[2] < 12.0
    assert medians[2] < (2e-4 if n == 8 else 2e-5)


@both_sizes
def test_points_on_a_plane_are_degenerate(kind, n, dtype):
    problems, solve = (bearing_problems, essential_last) if kind == "essential" else (pixel_problems, fundamental_last)
    first, second, _ = problems(4 * SIZE, n, seed=8, planar=True)
    candidates = solve_in_batches(solve, first, second, dtype=dtype, size=SIZE)
    assert not candidates.valid.any()
    assert_finite_with_zero_placeholders(candidates)


@pytest.mark.parametrize("spoil", ["rotation", "repeated", "one", "zero", "nan", "inf"])
@pytest.mark.parametrize("kind", ["essential", "fundamental"])
def test_impossible_problems_have_no_valid_slot(kind, spoil, dtype):
    problems, solve = (bearing_problems, essential_last) if kind == "essential" else (pixel_problems, fundamental_last)
    first, second, _ = problems(64, 8, seed=9)
    if spoil == "rotation":
        # The same rays, turned about the optical axis.
        turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])[: first.shape[2], : first.shape[2]]
        second = first @ turn.T
    elif spoil == "repeated":
        first[:, 3], second[:, 3] = first[:, 5], second[:, 5]
    elif spoil == "one":
        first[:], second[:] = first[:, :1], second[:, :1]
    elif spoil == "zero":
        first[:] = 0.0
    else:
        second[:, 2, 1] = float(spoil)
    assert not solve_in_batches(solve, first, second, dtype=dtype, size=SIZE).valid.any()


@pytest.mark.parametrize("kind", ["essential", "fundamental"])
def test_values_are_finite_everywhere(kind, dtype):
    problems, solve = (bearing_problems, essential_last) if kind == "essential" else (pixel_problems, fundamental_last)
    first, second = spoiled(*problems(SIZE, 8, seed=10)[:2], seed=10)
    assert_finite_with_zero_placeholders(solve_in_batches(solve, first, second, dtype=dtype, size=SIZE))


@pytest.mark.parametrize(
    "solver", [eight_point, pytest.param(fundamental_eight_point, marks=pytest.mark.slow)], ids=["rays", "pixels"]
)
@pytest.mark.slow
def test_gradients_are_finite_everywhere(solver):
    problems = bearing_problems if solver is eight_point else pixel_problems
    first, second = spoiled(*problems(SIZE, 8, seed=10)[:2], seed=10)
    assert_finite_gradients(solver, first, second, jnp.float32)


@pytest.mark.slow
@pytest.mark.parametrize("n", [8, 12])
@pytest.mark.parametrize("kind", ["essential", "fundamental"])
def test_nothing_is_ever_infinite(kind, n, dtype):
    problems, solve = (bearing_problems, essential_last) if kind == "essential" else (pixel_problems, fundamental_last)
    solver = eight_point if kind == "essential" else fundamental_eight_point
    for seed in range(5):
        first, second = spoiled(*problems(100_000, n, seed=seed)[:2], seed=seed)
        assert_finite_with_zero_placeholders(solve_in_batches(solve, first, second, dtype=dtype, size=100_000))
    assert_finite_gradients(solver, first, second, dtype)


@functools.cache
def weighted_sum(kind):
    factors = jnp.asarray([[1.0, -2.0, 3.0], [0.5, 4.0, -1.0], [2.0, 1.5, -0.7]])
    # Entries of a fundamental matrix differ by factors of 700² in size.
    scale = jnp.asarray([*CAMERA[:2, :2].diagonal().tolist(), 1.0]) if kind == "fundamental" else jnp.ones(3)

    def function(first, second, weights):
        solver = eight_point if kind == "essential" else fundamental_eight_point
        return jnp.sum(solver(first, second, weights).models[0] * factors * scale[:, None] * scale[None, :])

    return jax.jit(function), jax.jit(jax.grad(function, (0, 1, 2))), jax.jit(jax.jacfwd(function, (0, 1, 2)))


@pytest.mark.parametrize(
    ("kind", "n"),
    [
        ("fundamental", 8),
        ("essential", 12),
        pytest.param("essential", 8, marks=pytest.mark.slow),
        pytest.param("fundamental", 12, marks=pytest.mark.slow),
    ],
)
@pytest.mark.slow
def test_gradients_equal_central_differences(kind, n, x64):
    # With noise, so that the correction to a matrix of the right kind has a derivative of its own.
    rng = np.random.default_rng(11)
    problems = bearing_problems if kind == "essential" else pixel_problems
    first, second, _ = problems(2, n, seed=11)
    noise, step = (1e-3, 2e-5) if kind == "essential" else (0.5, 1e-2)
    function, reverse, forward = weighted_sum(kind)
    for x0, x1 in zip(first, second, strict=True):
        arguments = (x0 + noise * rng.normal(size=x0.shape), x1 + noise * rng.normal(size=x1.shape))
        arguments = (*arguments, rng.uniform(0.5, 1.5, n))
        for index, (back, ahead) in enumerate(zip(reverse(*arguments), forward(*arguments), strict=True)):
            numeric = numeric_gradient(function, arguments, index, 1e-2 if index == 2 else step)
            size = np.abs(numeric).max()
            np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=1e-6 * size + 1e-9)
            np.testing.assert_allclose(ahead, back, rtol=1e-8, atol=1e-8 * size + 1e-11)


@pytest.mark.slow
def test_vmap_equals_loop_and_batch_axis_does_not_matter(x64):
    rays0, rays1, _ = bearing_problems(4, 8, seed=12)
    last = solve_in_batches(essential_last, rays0, rays1, dtype=np.float64, size=SIZE)
    first = jax.jit(jax.vmap(eight_point))(rays0, rays1)
    np.testing.assert_allclose(first.models, last.models, atol=1e-11)
    for i in range(4):
        np.testing.assert_allclose(eight_point(rays0[i], rays1[i]).models, last.models[i], atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["essential", "fundamental"])
def test_many_lanes_give_what_few_give(kind):
    many, _ = errors_of(kind, 8, 65_536, np.float32, seed=13, size=65_536)
    few, _ = errors_of(kind, 8, 65_536, np.float32, seed=13)
    assert (many < 1e-3).mean() > 0.997
    assert abs((many < 1e-4).mean() - (few < 1e-4).mean()) < 1e-3
    assert np.mean((many < 1e-3) != (few < 1e-3)) < 3e-3


def test_wrong_input_is_refused():
    with pytest.raises(ValueError, match="found 7 correspondences; expected at least 8"):
        eight_point(np.ones((7, 3)), np.ones((7, 3)))
    with pytest.raises(ValueError, match="found 0 correspondences"):
        fundamental_eight_point(np.ones((0, 2)), np.ones((0, 2)))
    # Shapes that do not match are refused by the type checker under pytest, and by this everywhere.
    with pytest.raises(ValueError, match="expected equal shapes"):
        two_views(np.ones((8, 2)), np.ones((9, 2)), None, 8)
    with pytest.raises(ValueError, match="expected one per correspondence"):
        two_views(np.ones((8, 2)), np.ones((8, 2)), np.ones(7), 8)


def test_projection_is_that_of_the_svd(dtype):
    rng = np.random.default_rng(14)
    matrices = rng.normal(size=(200, 3, 3))
    matrices[:100] = unit_matrices(bearing_problems(100, 8, seed=14)[2]) + 1e-2 * matrices[:100]
    projected = np.moveaxis(np.asarray(project_last(*lanes(matrices, dtype=dtype))), -1, 0)
    u, s, vt = np.linalg.svd(matrices)
    mean = 0.5 * (s[:, 0] + s[:, 1])
    expected = mean[:, None, None] * (u[:, :, :2] @ vt[:, :2])
    # How well the nearest matrix is determined depends on the gap below it.
    gap = (s[:, 1] - s[:, 2]) / s[:, 0]
    error = np.abs(projected - expected).max(axis=(1, 2)) * gap
    assert error.max() < (1e-5 if dtype == jnp.float32 else 1e-13)


@pytest.mark.slow
def test_projection_of_impossible_matrices_is_zero(dtype):
    project = jax.jit(project_to_essential)
    gradient = jax.jit(jax.grad(lambda m: jnp.sum(project_to_essential(m))))
    good = np.asarray(bearing_problems(1, 8, seed=15)[2][0], dtype)
    spoilt = [np.zeros((3, 3)), np.eye(3), np.full((3, 3), np.nan), np.where(np.eye(3) > 0, np.inf, 1.0)]
    for matrix in [np.asarray(m, dtype) for m in (*spoilt, np.outer([1, 2, 3], [3, 1, 2]))]:
        assert (project(matrix) == 0).all()
        assert np.isfinite(gradient(matrix)).all()
    for size in (1e-6, 1e6):
        np.testing.assert_allclose(project(good * dtype(size)) / size, good, atol=1e-6)
        assert np.isfinite(gradient(good * dtype(size))).all()


@pytest.mark.slow
def test_projection_gradients(x64):
    def function(matrix):
        return jnp.sum(project_to_essential(matrix) * jnp.arange(1.0, 10.0).reshape(3, 3))

    compiled, reverse, forward = jax.jit(function), jax.jit(jax.grad(function)), jax.jit(jax.jacfwd(function))
    rng = np.random.default_rng(16)
    essential = bearing_problems(1, 8, seed=16)[2][0]
    # On the manifold, where the singular values are equal, beside it, and far away.
    for matrix in (essential, essential + 0.05 * rng.normal(size=(3, 3)), rng.normal(size=(3, 3))):
        numeric = central_differences(compiled, (matrix,), 0)
        np.testing.assert_allclose(reverse(matrix), numeric, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(forward(matrix), reverse(matrix), rtol=1e-9, atol=1e-10)
