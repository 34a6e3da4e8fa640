"""Deviations mean what they say: spread and score of many calibrations of the same views with fresh noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.calibration import calibrate
from vojax.cameras import Pinhole

TRIALS = 300


@pytest.mark.slow
def test_standard_deviations_by_monte_carlo(board, make_views, x64):
    truth = Pinhole(fx=520.0, fy=515.0, cx=325.0, cy=236.0)
    clean, _ = make_views(truth, board, 6, seed=3)
    corners = jnp.asarray(clean)[None] + 0.3 * jax.random.normal(jax.random.key(1), (TRIALS, *clean.shape))
    one = jax.jit(lambda corners: calibrate(corners, board, (640, 480), model=Pinhole))
    found = [one(view) for view in corners]
    error = np.array([np.asarray(each.values()) for each in found]) - [520.0, 515.0, 325.0, 236.0]
    deviation = np.array([np.asarray(each.standard_deviations()) for each in found])
    # The deviation of a spread of 300 samples is 4 %: five of them.
    np.testing.assert_allclose(error.std(axis=0) / deviation.mean(axis=0), 1.0, atol=0.2)
    score = np.array(
        [e @ np.linalg.solve(np.asarray(each.covariance), e) for e, each in zip(error, found, strict=True)]
    )
    # χ² with four degrees of freedom (nearly: σ is estimated from 303 of them): mean 4 ± 5 · √8/√300.
    assert abs(score.mean() - 4.0) < 0.85
