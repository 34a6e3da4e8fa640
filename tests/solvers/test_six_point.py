"""Philip's six-point solver against numpy and scipy, the truth of simulations, and its own equations."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from tests.solvers.problems import solve_in_batches, unit_matrices
from tests.solvers.two_views import (
    assert_finite_gradients,
    assert_finite_with_zero_placeholders,
    bearing_problems,
    epipolar_errors,
    matrix_errors,
    numeric_gradient,
    spoiled,
)
from vojax.solvers import six_point
from vojax.solvers._six_point import _cubic_constraints

SIZE = 1024
solve_last = jax.jit(jax.vmap(six_point, in_axes=-1, out_axes=-1))


def errors_of(count, dtype, seed, size=SIZE):
    """Distance from the truth, and the candidates."""
    first, second, truth = bearing_problems(count, 6, seed)
    candidates = solve_in_batches(solve_last, first, second, dtype=dtype, size=size)
    return matrix_errors(candidates.models, candidates.valid, truth), candidates


def test_finds_the_truth(dtype):
    errors, candidates = errors_of(4 * SIZE, dtype, seed=1)
    assert_finite_with_zero_placeholders(candidates)
    if dtype == jnp.float32:
        assert (errors < 1e-3).mean() >= 0.994
        # What cannot be decided is declared invalid, not wrong.
        assert (errors[candidates.valid[:, 0]] < 1e-2).mean() > 0.999
    else:
        assert (errors < 1e-8).mean() >= 0.9995


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    errors, _ = errors_of(100_000, dtype, seed=2)
    assert (errors < (1e-3 if dtype == jnp.float32 else 1e-8)).mean() >= (0.995 if dtype == jnp.float32 else 0.9999)


def test_the_equations_hold(dtype):
    first, second, _ = bearing_problems(SIZE, 6, seed=3)
    _, candidates = errors_of(SIZE, dtype, seed=3)
    models = candidates.models.astype(np.float64)
    eps = float(jnp.finfo(dtype).eps)
    assert np.abs(epipolar_errors(models, first, second)).max() < 100 * eps
    singular = np.linalg.svd(models[candidates.valid], compute_uv=False)
    np.testing.assert_allclose(singular, np.broadcast_to([0.5**0.5, 0.5**0.5, 0.0], singular.shape), atol=20 * eps)


def test_cubic_equations_are_those_of_an_essential_matrix(x64):
    # The coefficients times the monomials are the polynomials, at random points of random null spaces.
    rng = np.random.default_rng(4)
    basis, xyz = rng.normal(size=(3, 3, 3)), rng.normal(size=3)
    e = np.einsum("p,pij->ij", xyz, basis)
    x, y, z = xyz
    monomials = np.array(
        [x**3, x * x * y, x * x * z, x * y * y, x * y * z, x * z * z, y**3, y * y * z, y * z * z, z**3]
    )
    values = np.asarray(_cubic_constraints(jnp.asarray(basis))) @ monomials
    gram = e @ e.T
    expected = (gram - 0.5 * np.trace(gram) * np.eye(3)) @ e
    np.testing.assert_allclose(values[:9].reshape(3, 3), expected, atol=1e-12)
    np.testing.assert_allclose(values[9], np.linalg.det(e), atol=1e-12)


def rotation(vector):
    return scipy.linalg.expm(np.cross(np.eye(3), vector))


@pytest.mark.slow
def test_noisy_solution_is_the_least_squares_one_of_scipy(x64):
    rng = np.random.default_rng(5)
    first, second, truth = bearing_problems(30, 6, seed=5)
    first, second = (x + 1e-4 * rng.normal(size=x.shape) for x in (first, second))
    first, second = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (first, second))
    candidates = solve_in_batches(solve_last, first, second, dtype=np.float64, size=SIZE)
    assert candidates.valid.all()
    agreed = 0
    for i in range(30):

        def residual(step, i=i):
            e = rotation(step[:3]) @ truth[i] @ rotation(step[3:])
            return np.einsum("ni,ij,nj->n", second[i], e, first[i])

        solution = scipy.optimize.least_squares(residual, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        expected = unit_matrices(rotation(solution.x[:3]) @ truth[i] @ rotation(solution.x[3:]))
        error = min(np.abs(candidates.models[i, 0] - side * expected).max() for side in (1.0, -1.0))
        agreed += error < 1e-6
        # Never worse than what is found from the truth.
        ours = np.einsum("ni,ij,nj->n", second[i], candidates.models[i, 0], first[i])
        assert error < 1e-6 or np.sum(ours**2) < 1e-7
    assert agreed >= 27


def test_noise_moves_the_solution_smoothly(x64):
    first, second, truth = bearing_problems(SIZE, 6, seed=6)
    noise = np.random.default_rng(6).normal(size=(2, *first.shape))
    medians = []
    for size in (1e-5, 1e-6):
        candidates = solve_in_batches(
            solve_last, first + size * noise[0], second + size * noise[1], dtype=np.float64, size=SIZE
        )
        medians.append(np.median(matrix_errors(candidates.models, candidates.valid, truth)))
    assert 8.0 < medians[0] / medians[1] < 12.0
    assert medians[1] < 1e-4


def test_points_on_a_plane_are_degenerate(dtype):
    first, second, _ = bearing_problems(8 * SIZE, 6, seed=7, planar=True)
    candidates = solve_in_batches(solve_last, first, second, dtype=dtype, size=SIZE)
    assert not candidates.valid.any()
    assert_finite_with_zero_placeholders(candidates)


@pytest.mark.parametrize("spoil", ["rotation", "repeated", "one", "zero", "nan", "inf"])
def test_impossible_problems_have_no_valid_slot(spoil, dtype):
    first, second, _ = bearing_problems(64, 6, seed=8)
    if spoil == "rotation":
        second = first @ rotation(np.array([0.1, -0.2, 0.3])).T
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
    first, second = spoiled(*bearing_problems(SIZE, 6, seed=9)[:2], seed=9)
    assert_finite_with_zero_placeholders(solve_in_batches(solve_last, first, second, dtype=dtype, size=SIZE))
    if dtype == jnp.float32:
        assert_finite_gradients(six_point, first, second, dtype)


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(10):
        first, second = spoiled(*bearing_problems(100_000, 6, seed=seed)[:2], seed=seed)
        assert_finite_with_zero_placeholders(solve_in_batches(solve_last, first, second, dtype=dtype, size=100_000))
    assert_finite_gradients(six_point, first, second, dtype)


@functools.cache
def weighted_sum():
    factors = jnp.asarray([[1.0, -2.0, 3.0], [0.5, 4.0, -1.0], [2.0, 1.5, -0.7]])

    def function(first, second):
        return jnp.sum(six_point(first, second).models[0] * factors)

    return jax.jit(function), jax.jit(jax.grad(function, (0, 1))), jax.jit(jax.jacfwd(function, (0, 1)))


@pytest.mark.parametrize("noise", [0.0, 1e-4])
@pytest.mark.slow
def test_gradients_equal_central_differences(noise, x64):
    function, reverse, forward = weighted_sum()
    rng = np.random.default_rng(10)
    first, second, _ = bearing_problems(2, 6, seed=10)
    for x0, x1 in zip(first, second, strict=True):
        arguments = (x0 + noise * rng.normal(size=x0.shape), x1 + noise * rng.normal(size=x1.shape))
        for index, (back, ahead) in enumerate(zip(reverse(*arguments), forward(*arguments), strict=True)):
            numeric = numeric_gradient(function, arguments, index, 1e-5)
            size = np.abs(numeric).max()
            np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=1e-6 * size)
            np.testing.assert_allclose(ahead, back, rtol=1e-8, atol=1e-8 * size)


@pytest.mark.slow
def test_vmap_equals_loop_and_batch_axis_does_not_matter(x64):
    first, second, _ = bearing_problems(4, 6, seed=11)
    last = solve_in_batches(solve_last, first, second, dtype=np.float64, size=SIZE)
    batched = jax.jit(jax.vmap(six_point))(first, second)
    np.testing.assert_allclose(batched.models, last.models, atol=1e-11)
    for i in range(4):
        np.testing.assert_allclose(six_point(first[i], second[i]).models, last.models[i], atol=1e-11)


@pytest.mark.slow
def test_many_lanes_give_what_few_give():
    many, _ = errors_of(65_536, np.float32, seed=12, size=65_536)
    few, _ = errors_of(65_536, np.float32, seed=12)
    assert (many < 1e-3).mean() > 0.994
    assert np.mean((many < 1e-3) != (few < 1e-3)) < 3e-3


def test_wrong_number_of_points_is_refused():
    with pytest.raises(ValueError, match="found 8 correspondences; expected 6"):
        six_point.__wrapped__(np.ones((8, 3)), np.ones((8, 3)))
