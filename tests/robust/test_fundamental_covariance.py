"""Errors of fundamental matrices against their covariance: NEES over 1,000 problems with known noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from vojax import Result
from vojax.ba import fundamental_basis
from vojax.datasets import simulate_relative_pose
from vojax.robust import estimate_fundamental

B, N = 100, 120
MATRIX = np.array([[800.0, 0, 639.5], [0, 800, 479.5], [0, 0, 1]])


def truth_of(poses):
    """F with `pixel1ᵀ F pixel0 = 0`, norm 1."""
    matrices = np.asarray(poses.as_matrix(), np.float64)
    t, rotation, inverse = matrices[:, :3, 3], matrices[:, :3, :3], np.linalg.inv(MATRIX)
    zero = np.zeros(len(t))
    skew = np.stack([zero, -t[:, 2], t[:, 1], t[:, 2], zero, -t[:, 0], -t[:, 1], t[:, 0], zero], axis=1)
    truth = inverse.T @ skew.reshape(-1, 3, 3) @ rotation @ inverse
    return truth / np.linalg.norm(truth, axis=(1, 2), keepdims=True)


@pytest.mark.slow
def test_errors_follow_the_covariance(x64):
    # In float64: deviations of F for pixels span six orders of magnitude, and one in a hundred covariances rounded to
    # float32 is no longer positive.
    @jax.jit
    @jax.vmap
    def solve(key, pixels0, pixels1):
        return estimate_fundamental(pixels0, pixels1, key=key, sigma_px=jnp.float64(0.5))

    values = []
    for seed in range(10):
        keys = jax.random.split(jax.random.key(60 + seed), B)
        problem = jax.vmap(lambda key: simulate_relative_pose(key, N, sigma_px=0.5, dtype=jnp.float64))(keys)
        found = solve(jax.random.split(jax.random.key(seed), B), problem.pixels0, problem.pixels1)
        assert np.all(found.result == Result.success)
        model, truth = np.asarray(found.model, np.float64), truth_of(problem.cam1_from_cam0)
        truth = truth * np.sign(np.sum(truth * model, axis=(1, 2), keepdims=True))
        basis = np.asarray(jax.vmap(fundamental_basis)(found.model), np.float64)
        change = np.einsum("bij,bi->bj", basis, (truth - model).reshape(B, 9))
        covariance = np.asarray(found.covariance, np.float64)
        values.append(np.sum(change * np.linalg.solve(covariance, change[..., None])[..., 0], axis=1))
    values = np.concatenate(values)
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 7 * len(values)) / len(values)
    print(f"NEES {values.mean():.3f} of 7, band {low:.3f} to {high:.3f}, median {np.median(values):.2f}")
    assert low < values.mean() < high
