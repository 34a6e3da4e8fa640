"""Robust fundamental matrices and homographies: accuracy against truth and PoseLib, covariance, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from vojax import Result
from vojax.ba import homography_basis
from vojax.datasets import simulate_relative_pose
from vojax.robust import RansacOptions, estimate_fundamental, estimate_homography

pytestmark = pytest.mark.optimized

B, N = 100, 120
SIZE = np.array([1280.0, 960.0])


def batched(estimator):
    def one(key, pixels0, pixels1, mask, sigma_px):
        options = RansacOptions(threshold_px=3.0 if estimator is estimate_homography else 1.5)
        return estimator(pixels0, pixels1, key=key, mask=mask, sigma_px=sigma_px, options=options)

    return jax.jit(jax.vmap(one, in_axes=(0, 0, 0, 0, None)))


solve_all = {estimator: batched(estimator) for estimator in (estimate_fundamental, estimate_homography)}


def solve(estimator, pixels0, pixels1, mask=None, sigma_px=1.0):
    keys = jax.random.split(jax.random.key(7), B)
    mask = np.ones((B, N), bool) if mask is None else mask
    return solve_all[estimator](keys, jnp.float32(pixels0), jnp.float32(pixels1), mask, jnp.float32(sigma_px))


def planes(seed, share, sigma_px=1.0):
    """Pixels of random homographies, which of them are right, and the homographies."""
    rng = np.random.default_rng(seed)
    spread = np.array([[0.1, 0.1, 50.0], [0.1, 0.1, 50.0], [1e-4, 1e-4, 0.0]])
    matrices = np.eye(3) + rng.uniform(-1.0, 1.0, (B, 3, 3)) * spread
    pixels0 = rng.uniform(0.0, SIZE, (B, N, 2))
    pixels1 = transfer(matrices, pixels0)
    right = np.arange(N) >= round(share * N)
    pixels0 = pixels0 + sigma_px * rng.normal(size=pixels0.shape)
    pixels1 = pixels1 + sigma_px * rng.normal(size=pixels1.shape)
    pixels1 = np.where(right[:, None], pixels1, rng.uniform(0.0, SIZE, pixels1.shape))
    return pixels0, pixels1, right, matrices


def transfer(matrices, pixels):
    moved = np.einsum("bij,bnj->bni", matrices, np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1))
    return moved[..., :2] / moved[..., 2:]


def corner_errors(matrices, truth):
    corners = np.broadcast_to(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * SIZE, (B, 4, 2))
    return np.linalg.norm(transfer(matrices, corners) - transfer(truth, corners), axis=-1).mean(axis=1)


@pytest.mark.slow
def test_homography_is_more_accurate_than_poselib():
    import poselib

    pixels0, pixels1, right, truth = planes(0, 0.5)
    found = solve(estimate_homography, pixels0, pixels1)
    assert np.all(found.result == Result.success)
    options = {"max_reproj_error": 3.0}
    theirs = np.stack(
        [poselib.estimate_homography(a, b, options, {})[0] for a, b in zip(pixels0, pixels1, strict=True)]
    )
    ours = corner_errors(np.asarray(found.model, np.float64), truth)
    assert np.median(ours) <= np.median(corner_errors(theirs, truth))
    inliers = np.asarray(found.inliers)
    assert inliers[:, right].mean() > 0.97
    assert inliers[:, ~right].mean() < 1e-3


def test_errors_of_homographies_follow_the_covariance():
    values = []
    for seed in range(10):
        pixels0, pixels1, _, truth = planes(10 + seed, 0.2, sigma_px=0.5)
        found = solve(estimate_homography, pixels0, pixels1, sigma_px=0.5)
        truth = truth / np.linalg.norm(truth, axis=(1, 2), keepdims=True)
        model = np.asarray(found.model, np.float64)
        truth = truth * np.sign(np.sum(truth * model, axis=(1, 2), keepdims=True))
        basis = np.asarray(jax.vmap(homography_basis)(found.model), np.float64)
        change = np.einsum("bij,bi->bj", basis, (truth - model).reshape(B, 9))
        # Inverted in float64: entries of H for pixels differ by factors of a million.
        covariance = np.asarray(found.covariance, np.float64)
        values.append(np.sum(change * np.linalg.solve(covariance, change[..., None])[..., 0], axis=1))
    values = np.concatenate(values)
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 8 * len(values)) / len(values)
    assert low < values.mean() < high


def sampson(matrices, pixels0, pixels1):
    p0, p1 = (np.concatenate([x, np.ones_like(x[..., :1])], -1) for x in (pixels0, pixels1))
    line1, line0 = np.einsum("bij,bnj->bni", matrices, p0), np.einsum("bji,bnj->bni", matrices, p1)
    slope = np.sum(line1[..., :2] ** 2 + line0[..., :2] ** 2, axis=-1)
    return np.abs(np.sum(p1 * line1, axis=-1)) / np.sqrt(slope)


@pytest.fixture(scope="module")
def two_views():
    keys = jax.random.split(jax.random.key(5), B)
    return jax.jit(jax.vmap(lambda key: simulate_relative_pose(key, N, outlier_fraction=0.3, sigma_px=1.0)))(keys)


@pytest.mark.slow
def test_fundamental_is_more_accurate_than_poselib(two_views):
    import poselib

    pixels0, pixels1 = np.asarray(two_views.pixels0, float), np.asarray(two_views.pixels1, float)
    found = solve(estimate_fundamental, pixels0, pixels1)
    assert np.all(found.result == Result.success)
    model = np.asarray(found.model, np.float64)
    # Rank two: the determinant of a float32 matrix whose small entries carry the geometry.
    assert np.abs(np.linalg.det(model)).max() < 1e-9
    options = {"max_epipolar_error": 1.5}
    theirs = np.stack(
        [poselib.estimate_fundamental(a, b, options, {})[0] for a, b in zip(pixels0, pixels1, strict=True)]
    )
    # Of noise-free points, which neither has seen: those that the truth puts where both images would see them.
    truth = jax.vmap(lambda key: simulate_relative_pose(key, N, sigma_px=0.0))(jax.random.split(jax.random.key(5), B))
    exact0, exact1 = np.asarray(truth.pixels0, float), np.asarray(truth.pixels1, float)
    ours, peer = (np.sqrt(np.mean(sampson(m, exact0, exact1) ** 2, axis=1)) for m in (model, theirs))
    assert np.median(ours) <= np.median(peer)


@pytest.mark.parametrize("estimator", [estimate_fundamental, estimate_homography])
def test_bad_input_has_a_code_and_an_empty_answer(estimator):
    pixels0, pixels1, *_ = planes(1, 0.0)
    rng = np.random.default_rng(2)
    mask = np.ones((B, N), bool)
    mask[0] = False
    mask[1] = np.arange(N) < 4
    pixels0[2] = np.nan
    pixels0[3], pixels1[3] = pixels0[3, :1], pixels1[3, :1]
    pixels1[4:54] = rng.uniform(0.0, SIZE, (50, N, 2))
    found = solve(estimator, pixels0, pixels1, mask)
    for i, code in enumerate([Result.too_few, Result.too_few, Result.too_few, Result.degenerate]):
        assert (found.result == code)[i], i
    assert np.mean((found.result == Result.no_consensus)[4:54]) > 0.9
    failed = np.asarray(~((found.result == Result.success) | (found.result == Result.not_converged)))
    assert np.all(np.asarray(found.model)[failed] == 0)
    assert not np.asarray(found.inliers)[failed].any()
    for leaf in jax.tree.leaves((found.model, found.covariance, found.score)):
        assert np.isfinite(leaf).all()


@pytest.mark.slow
def test_gradient_of_a_homography_equals_central_differences(x64):
    pixels0, pixels1, *_ = planes(3, 0.2, sigma_px=0.5)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3)) * np.array([[1, 1, 1e-3]] * 2 + [[1e3, 1e3, 1]]))

    @jax.jit
    def number(pixels):
        options = RansacOptions(final_steps=60)
        found = estimate_homography(pixels0[0], pixels, key=jax.random.key(0), sigma_px=0.5, options=options)
        return jnp.sum(weights * found.model)

    gradient = jax.jit(jax.grad(number))(pixels1[0])
    direction = np.random.default_rng(1).normal(size=pixels1[0].shape)
    along = (number(pixels1[0] + 1e-4 * direction) - number(pixels1[0] - 1e-4 * direction)) / 2e-4
    np.testing.assert_allclose(np.sum(gradient * direction), along, rtol=1e-5)
