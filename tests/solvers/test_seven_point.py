"""The seven-point solver against OpenCV, the truth of simulations, and its own equations."""

import functools

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.solvers.problems import solve_in_batches, unit_matrices
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
from vojax.solvers import seven_point

SIZE = 1024
solve_last = jax.jit(jax.vmap(seven_point, in_axes=-1, out_axes=-1))


def errors_of(count, dtype, seed, size=SIZE):
    """Distance of the best slot from the truth, in coordinates of the calibrated camera, and the candidates."""
    first, second, truth = pixel_problems(count, 7, seed)
    candidates = solve_in_batches(solve_last, first, second, dtype=dtype, size=size)
    return matrix_errors(calibrated(candidates.models), candidates.valid, calibrated(truth)), candidates


def test_finds_the_truth(dtype):
    errors, candidates = errors_of(4 * SIZE, dtype, seed=1)
    assert_finite_with_zero_placeholders(candidates)
    assert (errors < (1e-3 if dtype == jnp.float32 else 1e-8)).mean() >= (0.995 if dtype == jnp.float32 else 0.999)
    # One or three real roots of a cubic.
    assert (np.isin(candidates.valid.sum(axis=-1), (1, 3))).mean() > 0.999


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    errors, _ = errors_of(100_000, dtype, seed=2)
    assert (errors < (1e-3 if dtype == jnp.float32 else 1e-6)).mean() >= (0.996 if dtype == jnp.float32 else 0.9999)


def test_the_equations_hold(dtype):
    first, second, _ = bearing_problems(SIZE, 7, seed=3)
    _, candidates = errors_of(SIZE, dtype, seed=3)
    models = calibrated(candidates.models)
    eps = float(jnp.finfo(dtype).eps)
    assert np.abs(epipolar_errors(models, first, second)).max() < 100 * eps
    assert np.linalg.svd(models, compute_uv=False)[..., 2].max() < 100 * eps


def test_matrices_are_those_of_opencv(x64):
    first, second, _ = pixel_problems(300, 7, seed=4)
    first, second = (x.astype(np.float32).astype(np.float64) for x in (first, second))  # OpenCV rounds them
    candidates = solve_in_batches(solve_last, first, second, dtype=np.float64, size=SIZE)
    found, missed, extra = 0, 0, 0
    for i in range(300):
        theirs, _ = cv2.findFundamentalMat(first[i], second[i], cv2.FM_7POINT)
        theirs = unit_matrices(calibrated(theirs.reshape(-1, 3, 3)))
        ours = unit_matrices(calibrated(candidates.models[i][candidates.valid[i]]))
        distance = np.abs(ours[:, None] - theirs[None]).max(axis=(-1, -2))
        distance = np.minimum(distance, np.abs(ours[:, None] + theirs[None]).max(axis=(-1, -2)))
        found += np.sum(distance.min(axis=0) < 1e-6)
        missed += np.sum(distance.min(axis=0) >= 1e-6)
        extra += np.sum(distance.min(axis=1) >= 1e-6)
    assert found > 300
    # Nearly equal roots are real or not by rounding.
    assert missed <= 2
    assert extra <= 2


def test_noise_moves_the_solution_smoothly(x64):
    first, second, truth = pixel_problems(SIZE, 7, seed=5)
    noise = np.random.default_rng(5).normal(size=(2, *first.shape))
    medians = []
    for size in (1e-3, 1e-4):
        candidates = solve_in_batches(
            solve_last, first + size * noise[0], second + size * noise[1], dtype=np.float64, size=SIZE
        )
        medians.append(np.median(matrix_errors(calibrated(candidates.models), candidates.valid, calibrated(truth))))
    assert 8.0 < medians[0] / medians[1] < 12.0
    assert medians[1] < 1e-4


def test_points_on_a_plane_are_degenerate(dtype):
    first, second, _ = pixel_problems(8 * SIZE, 7, seed=6, planar=True)
    candidates = solve_in_batches(solve_last, first, second, dtype=dtype, size=SIZE)
    assert not candidates.valid.any()
    assert_finite_with_zero_placeholders(candidates)


@pytest.mark.parametrize("spoil", ["rotation", "repeated", "one", "zero", "nan", "inf"])
def test_impossible_problems_have_no_valid_slot(spoil, dtype):
    first, second, _ = pixel_problems(64, 7, seed=7)
    if spoil == "rotation":
        second = first @ np.array([[0.6, 0.8], [-0.8, 0.6]])
    elif spoil == "repeated":
        first[:, 3], second[:, 3] = first[:, 5], second[:, 5]
    elif spoil == "one":
        first[:], second[:] = first[:, :1], second[:, :1]
    elif spoil == "zero":
        first[:] = 0.0
    else:
        second[:, 2, 1] = float(spoil)
    assert not solve_in_batches(solve_last, first, second, dtype=dtype, size=SIZE).valid.any()


@pytest.mark.slow
def test_values_and_gradients_are_finite_everywhere(dtype):
    first, second = spoiled(*pixel_problems(SIZE, 7, seed=8)[:2], seed=8)
    assert_finite_with_zero_placeholders(solve_in_batches(solve_last, first, second, dtype=dtype, size=SIZE))
    if dtype == jnp.float32:
        assert_finite_gradients(seven_point, first, second, dtype)


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(10):
        first, second = spoiled(*pixel_problems(100_000, 7, seed=seed)[:2], seed=seed)
        assert_finite_with_zero_placeholders(solve_in_batches(solve_last, first, second, dtype=dtype, size=100_000))
    assert_finite_gradients(seven_point, first, second, dtype)


@functools.cache
def weighted_sum():
    factors = jnp.asarray([[1.0, -2.0, 3.0], [0.5, 4.0, -1.0], [2.0, 1.5, -0.7]])
    scale = jnp.asarray([*CAMERA[:2, :2].diagonal().tolist(), 1.0])
    slots = jnp.asarray([1.0, 0.6, -0.8])

    def function(first, second):
        weights = (factors * scale[:, None] * scale[None, :])[None] * slots[:, None, None]
        return jnp.sum(seven_point(first, second).models * weights)

    return jax.jit(function), jax.jit(jax.grad(function, (0, 1))), jax.jit(jax.jacfwd(function, (0, 1)))


def test_gradients_equal_central_differences(x64):
    function, reverse, forward = weighted_sum()
    first, second, _ = pixel_problems(3, 7, seed=9)
    for arguments in zip(first, second, strict=True):
        for index, (back, ahead) in enumerate(zip(reverse(*arguments), forward(*arguments), strict=True)):
            numeric = numeric_gradient(function, arguments, index, 1e-3)
            size = np.abs(numeric).max()
            np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=1e-6 * size)
            np.testing.assert_allclose(ahead, back, rtol=1e-8, atol=1e-8 * size)


@pytest.mark.slow
def test_vmap_equals_loop_and_batch_axis_does_not_matter(x64):
    first, second, _ = pixel_problems(4, 7, seed=10)
    last = solve_in_batches(solve_last, first, second, dtype=np.float64, size=SIZE)
    batched = jax.jit(jax.vmap(seven_point))(first, second)
    np.testing.assert_array_equal(batched.valid, last.valid)
    np.testing.assert_allclose(calibrated(batched.models), calibrated(last.models), atol=1e-10)
    for i in range(4):
        single = seven_point(first[i], second[i])
        np.testing.assert_array_equal(single.valid, last.valid[i])
        np.testing.assert_allclose(calibrated(single.models), calibrated(last.models[i]), atol=1e-10)


@pytest.mark.slow
def test_many_lanes_give_what_few_give():
    many, _ = errors_of(65_536, np.float32, seed=11, size=65_536)
    few, _ = errors_of(65_536, np.float32, seed=11)
    assert (many < 1e-3).mean() > 0.995
    assert np.mean((many < 1e-3) != (few < 1e-3)) < 3e-3


def test_wrong_number_of_points_is_refused():
    with pytest.raises(ValueError, match="found 8 correspondences; expected 7"):
        seven_point.__wrapped__(np.ones((8, 2)), np.ones((8, 2)))
