"""Noise of the inliers from errors with outliers among them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.ba import mad_scale
from vojax.datasets import simulate_relative_pose
from vojax.robust import estimate_relative_pose, noise_scale, squared_errors

B, N, SIGMA = 40, 1000, 0.7


def draw(dimension, share, seed=0):
    """Gaussian errors, and wrong ones that are not uniform: differences of uniform numbers."""
    rng = np.random.default_rng(seed)
    errors = SIGMA * rng.normal(size=(B, N, dimension))
    wrong = np.arange(N) < round(share * N)
    far = rng.uniform(0, 900, errors.shape) - rng.uniform(0, 900, errors.shape)
    return np.where(wrong[:, None], far, errors)


solve = {d: jax.jit(jax.vmap(lambda s, d=d: noise_scale(s, dimension=d))) for d in (1, 2, 3)}


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4, 0.6])
@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_recovers_noise_and_share(dimension, share):
    errors = draw(dimension, share)
    found = solve[dimension](jnp.float32(np.sum(errors**2, axis=-1)))
    ratio = np.asarray(found.sigma) / SIGMA
    # As precise as with the inliers known: 1/√(2 N d) of each, and a bias within two per cent.
    ideal = 1.0 / np.sqrt(2.0 * dimension * N * (1.0 - share))
    assert abs(ratio.mean() - 1.0) < 0.02
    assert ratio.std() < 1.5 * ideal
    np.testing.assert_allclose(found.inlier_share, 1.0 - share, atol=0.02)


def test_stays_right_where_the_median_deviation_does_not():
    errors = draw(1, 0.6)[..., 0]
    median = np.asarray(jax.vmap(mad_scale)(jnp.float32(errors)))
    assert np.all(median > 10 * SIGMA)  # that of the outliers
    assert np.all(np.abs(np.asarray(solve[1](jnp.float32(errors**2)).sigma) / SIGMA - 1) < 0.2)


def test_any_unit_and_any_padding():
    squares = jnp.float32(np.sum(draw(1, 0.4) ** 2, axis=-1))
    found = solve[1](squares)
    np.testing.assert_allclose(solve[1](squares * 1e-8).sigma, found.sigma * 1e-4, rtol=1e-4)
    one = noise_scale(squares[0], dimension=1)
    filled = jnp.concatenate([squares[0], jnp.full((24,), jnp.nan)])
    np.testing.assert_allclose(noise_scale(filled, dimension=1).sigma, one.sigma, rtol=1e-4)
    # Infinite errors are outliers: they lower the share and leave the scale.
    wrong = noise_scale(filled.at[-24:].set(jnp.inf), dimension=1)
    np.testing.assert_allclose(wrong.sigma, one.sigma, rtol=1e-4)
    np.testing.assert_allclose(wrong.inlier_share, one.inlier_share * N / (N + 24), rtol=1e-3)
    masked = noise_scale(filled.at[-24:].set(0.0), dimension=1, mask=jnp.arange(N + 24) < N)
    np.testing.assert_allclose(masked.sigma, one.sigma, rtol=1e-4)


def test_degrees_of_freedom_of_the_fit_are_given_back():
    rng = np.random.default_rng(1)
    n, parameters = 60, 8
    design = rng.normal(size=(n, parameters))
    left = np.eye(n) - design @ np.linalg.pinv(design)
    residuals = rng.normal(size=(400, n)) @ left  # of least squares
    found = jax.vmap(lambda s: noise_scale(s, dimension=1, model_dof=parameters))(jnp.float32(residuals**2))
    assert abs(np.sqrt(np.mean(np.asarray(found.sigma) ** 2)) - 1.0) < 0.04  # √(1 − 8/60) is 0.93


@pytest.mark.slow
def test_derivative_equals_central_differences(x64):
    errors = draw(2, 0.4)[0]
    number = jax.jit(lambda e: noise_scale(jnp.sum(e * e, axis=1), dimension=2).sigma)
    errors = jnp.asarray(errors)
    direction = np.random.default_rng(2).normal(size=errors.shape)
    gradient = jax.grad(number)(errors)
    step = 1e-5
    along = (number(errors + step * direction) - number(errors - step * direction)) / (2 * step)
    # The window of the last steps moves with the data, which the derivative leaves out: half a thousandth of it here.
    np.testing.assert_allclose(np.sum(gradient * direction), along, rtol=2e-3)
    _, forward = jax.jvp(number, (errors,), (jnp.asarray(direction),))
    np.testing.assert_allclose(forward, np.sum(gradient * direction), rtol=1e-8)


@pytest.mark.slow
def test_nothing_is_ever_not_a_number():
    rng = np.random.default_rng(3)
    for squares in (
        np.zeros(20),
        np.full(20, np.nan),
        np.full(20, np.inf),
        np.r_[np.zeros(10), np.full(10, 1e6)],
        np.full(20, 1e30),
        np.r_[rng.normal(size=3) ** 2, np.full(17, np.inf)],
        rng.uniform(0, 1, 20),
    ):
        value, gradient = jax.value_and_grad(lambda s: noise_scale(s, dimension=1).sigma)(jnp.float32(squares))
        assert np.isfinite(value)
        assert np.isfinite(gradient).all()


def test_bad_arguments_are_said_in_one_line():
    for n, more in [
        (0, {"dimension": 1}),
        (4, {"dimension": 0}),
        (4, {"dimension": 1, "model_dof": -1}),
    ]:
        with pytest.raises(ValueError, match="expected") as caught:
            noise_scale(jnp.ones(n), **more)
        assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_estimate_measure_estimate():
    """The recipe of docs/robust.md for unknown noise: a wide threshold, the scale, the estimate again."""
    from vojax.robust import RansacOptions

    sigma = []
    for seed in range(20):
        problem = simulate_relative_pose(jax.random.key(seed), 200, outlier_fraction=0.4, sigma_px=0.3)
        views = (problem.pixels0, problem.pixels1, problem.camera, problem.camera)
        wide = RansacOptions(threshold_px=3.0)
        first = estimate_relative_pose(*views, key=jax.random.key(1), options=wide)
        errors = squared_errors(estimate_relative_pose, first.model, *views)
        sigma.append(float(noise_scale(errors, dimension=1, model_dof=5).sigma))
    assert abs(np.mean(sigma) / 0.3 - 1.0) < 0.05
