"""Robust rigid and similar motions: truth, a real set with 9 % inliers, covariance, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.spatial.transform import Rotation

from vojax import Result
from vojax.metrics import nees
from vojax.robust import RansacOptions, estimate_rigid, estimate_similarity

pytestmark = pytest.mark.optimized

B, N = 100, 60
THRESHOLD, SIGMA = 0.1, 0.02


def batched(estimator):
    def one(key, points0, points1, mask):
        options = RansacOptions(threshold=THRESHOLD)
        return estimator(points0, points1, key=key, mask=mask, sigma=SIGMA, options=options)

    return jax.jit(jax.vmap(one))


solve_all = {estimator: batched(estimator) for estimator in (estimate_rigid, estimate_similarity)}
both = pytest.mark.parametrize("estimator", list(solve_all))


def problems(estimator, seed, share):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(B, rng=rng).as_matrix()
    scale = rng.uniform(0.5, 2.0, (B, 1, 1)) if estimator is estimate_similarity else np.ones((B, 1, 1))
    translation = rng.normal(size=(B, 3)) * 3.0
    points0 = rng.normal(size=(B, N, 3)) + 5.0
    points1 = scale * np.einsum("bij,bnj->bni", rotation, points0) + translation[:, None]
    points1 = points1 + SIGMA * rng.normal(size=points1.shape)
    right = np.arange(N) >= round(share * N)
    middle = points1.mean(axis=1, keepdims=True)
    points1 = np.where(right[:, None], points1, middle + 2.0 * rng.normal(size=points1.shape))
    return points0, points1, right, rotation, translation, scale[:, 0, 0]


def solve(estimator, points0, points1, mask=None):
    mask = np.ones((B, N), bool) if mask is None else mask
    keys = jax.random.split(jax.random.key(3), B)
    return solve_all[estimator](keys, jnp.float32(points0), jnp.float32(points1), mask)


@both
def test_recalls_the_motion(estimator):
    points0, points1, right, rotation, _, scale = problems(estimator, 0, 0.6)
    found = solve(estimator, points0, points1)
    assert np.all(found.result == Result.success)
    matrices = np.asarray(found.model.rotation().as_matrix(), np.float64)
    # 24 points of spread one with 0.02 of noise: 0.004 radians a component.
    assert np.abs(matrices - rotation).max() < 0.04
    if estimator is estimate_similarity:
        np.testing.assert_allclose(found.model.scale(), scale, rtol=0.05)
    inliers = np.asarray(found.inliers)
    assert inliers[:, right].mean() > 0.999
    assert inliers[:, ~right].mean() < 0.01


@both
def test_errors_follow_the_covariance(estimator):
    values = []
    for seed in range(10):
        points0, points1, _, rotation, translation, scale = problems(estimator, 20 + seed, 0.0)
        found = solve(estimator, points0, points1)
        kind = type(found.model)
        quaternion = Rotation.from_matrix(rotation).as_quat()[:, [3, 0, 1, 2]]
        parameters = [quaternion, translation] + ([scale[:, None]] if estimator is estimate_similarity else [])
        truth = kind(jnp.asarray(np.concatenate(parameters, axis=1), jnp.float32))
        # truth = exp(−ξ) @ model
        xi = jax.vmap(lambda truth, model: (model @ truth.inverse()).log())(truth, found.model)
        values.append(np.asarray(nees(xi, found.covariance)))
    values = np.concatenate(values)
    d = 7 if estimator is estimate_similarity else 6
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], d * len(values)) / len(values)
    assert low < values.mean() < high


@both
def test_bad_input_has_a_code_and_an_empty_answer(estimator):
    points0, points1, *_ = problems(estimator, 1, 0.0)
    mask = np.ones((B, N), bool)
    mask[0] = False
    mask[1] = np.arange(N) < 3
    points0[2] = np.nan
    points0[3], points1[3] = points0[3, :1], points1[3, :1]
    points0[4] = points0[4, :1] + np.linspace(-1, 1, N)[:, None] * np.ones(3)
    points1[5:55] = np.random.default_rng(0).normal(size=(50, N, 3)) * 3.0
    found = solve(estimator, points0, points1, mask)
    expected = [Result.too_few, Result.too_few, Result.too_few, Result.degenerate]
    for i, code in enumerate(expected):
        assert (found.result == code)[i], i
    assert np.mean((found.result == Result.no_consensus)[5:55]) > 0.9
    failed = np.asarray(~((found.result == Result.success) | (found.result == Result.not_converged)))
    assert failed[4]
    assert not np.asarray(found.inliers)[failed].any()
    for leaf in jax.tree.leaves((found.model, found.covariance, found.score)):
        assert np.isfinite(leaf).all()


@pytest.mark.slow
@pytest.mark.data
def test_real_points_with_nine_percent_inliers(data_root):
    rows = np.loadtxt(data_root / "rigid3d" / "rigid_pose_example_points.txt")
    truth = np.loadtxt(data_root / "rigid3d" / "rigid_pose_example_gt.txt")
    points0, points1 = jnp.float32(rows[:, :3]), jnp.float32(rows[:, 3:6])
    options = RansacOptions(threshold=0.05, max_hypotheses=65536, chunk_size=4096)
    estimate = jax.jit(lambda key: estimate_rigid(points0, points1, key=key, options=options))
    found = [estimate(jax.random.key(i)) for i in range(100)]
    rotation = truth[:3, :3]  # of determinant 0.999
    good = [
        np.abs(np.asarray(x.model.rotation().as_matrix()) - rotation).max() < 0.05 and int(x.num_inliers) > 300
        for x in found
    ]
    assert sum(good) >= 99
