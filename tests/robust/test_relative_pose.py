"""Robust relative pose: accuracy against truth and PoseLib, covariance, bad input, derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from vojax import Result
from vojax.ba import translation_basis
from vojax.cameras import Pinhole
from vojax.datasets import simulate_relative_pose
from vojax.metrics import nees
from vojax.robust import RansacOptions, estimate_relative_pose

pytestmark = pytest.mark.optimized

B, N = 100, 120
CAMERA = {"fx": 800.0, "fy": 800.0, "cx": 639.5, "cy": 479.5}


@jax.jit
def estimate(keys, pixels0, pixels1, mask, sigma_px):
    camera = Pinhole(**CAMERA)

    def one(key, pixels0, pixels1, mask):
        return estimate_relative_pose(pixels0, pixels1, camera, camera, key=key, mask=mask, sigma_px=sigma_px)

    return jax.vmap(one)(keys, pixels0, pixels1, mask)


def simulate(seed, share, sigma_px=1.0):
    keys = jax.random.split(jax.random.key(seed), B)
    draw = jax.jit(jax.vmap(lambda key: simulate_relative_pose(key, N, outlier_fraction=share, sigma_px=sigma_px)))
    return draw(keys)


def solve(pixels0, pixels1, mask=None, sigma_px=1.0, seed=0):
    keys = jax.random.split(jax.random.key(100 + seed), B)
    mask = jnp.ones((B, N), bool) if mask is None else jnp.asarray(mask)
    return estimate(keys, pixels0, pixels1, mask, jnp.float32(sigma_px))


def errors(rotations, translations, truth):
    """The larger of the angles of rotation and translation, degrees."""
    matrices = np.asarray(truth.as_matrix(), np.float64)
    chord = np.linalg.norm(rotations - matrices[:, :3, :3], axis=(1, 2)) / 8**0.5
    direction = matrices[:, :3, 3] / np.linalg.norm(matrices[:, :3, 3], axis=1, keepdims=True)
    cosine = np.sum(direction * translations, axis=1) / np.linalg.norm(translations, axis=1)
    return np.degrees(np.maximum(2 * np.arcsin(np.clip(chord, 0, 1)), np.arccos(np.clip(cosine, -1, 1))))


def pose_errors(estimate, truth):
    matrices = np.asarray(estimate.model.as_matrix(), np.float64)
    return errors(matrices[:, :3, :3], matrices[:, :3, 3], truth)


@pytest.fixture(scope="module")
def half_wrong():
    problem = simulate(5, 0.5)
    return problem, solve(problem.pixels0, problem.pixels1)


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_is_more_accurate_than_poselib(share, half_wrong):
    import poselib

    problem = half_wrong[0] if share == 0.5 else simulate(3, share)
    found = half_wrong[1] if share == 0.5 else solve(problem.pixels0, problem.pixels1)
    camera = {"model": "PINHOLE", "width": 1280, "height": 960, "params": list(CAMERA.values())}
    theirs = []
    for pixels0, pixels1 in zip(np.asarray(problem.pixels0, float), np.asarray(problem.pixels1, float), strict=True):
        theirs.append(
            poselib.estimate_relative_pose(pixels0, pixels1, camera, camera, {"max_epipolar_error": 1.5}, {})[0]
        )
    peer = errors(np.stack([x.R for x in theirs]), np.stack([x.t for x in theirs]), problem.cam1_from_cam0)
    ours = pose_errors(found, problem.cam1_from_cam0)
    assert np.all(found.result == Result.success)
    assert np.median(ours) <= np.median(peer)
    # Area under the recall curve up to five degrees.
    auc = [np.mean(np.clip(1 - e / 5.0, 0, 1)) for e in (ours, peer)]
    assert auc[0] >= auc[1]


def test_inliers_and_unit_translation(half_wrong):
    problem, found = half_wrong
    inliers, true = np.asarray(found.inliers), np.asarray(problem.inliers)
    # Noise of 1 px puts 13 % of the Sampson distances beyond 1.5 px.
    assert 0.82 < inliers[true].mean() < 0.9
    assert inliers[~true].mean() < 0.03
    assert np.array_equal(found.num_inliers, inliers.sum(axis=1))
    np.testing.assert_allclose(np.linalg.norm(found.model.translation(), axis=1), 1.0, atol=1e-5)


def test_the_same_key_gives_the_same_bits(half_wrong):
    problem, found = half_wrong
    again = solve(problem.pixels0, problem.pixels1)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
        assert np.array_equal(one, other)


def test_what_is_masked_or_not_finite_does_not_matter(half_wrong):
    problem, _ = half_wrong
    mask = np.random.default_rng(0).uniform(size=(B, N)) < 0.9
    found = solve(problem.pixels0, problem.pixels1, mask)
    filled = solve(jnp.where(mask[..., None], problem.pixels0, jnp.nan), problem.pixels1)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(filled), strict=True):
        assert np.array_equal(one, other)


def tangent_errors(model, truth):
    """(τ, φ) with truth = exp(−(B τ, φ)) @ model, translations of length one."""
    turn = truth.rotation() @ model.rotation().inverse()
    direction = truth.translation() / jnp.linalg.norm(truth.translation())
    tau = translation_basis(model).T @ (turn @ model.translation() - direction)
    return jnp.concatenate([tau, -turn.log()])


@pytest.mark.slow
def test_errors_follow_the_covariance():
    values = []
    for seed in range(4):
        # Without wrong matches: one that lies near its epipolar line by chance is not in the covariance.
        problem = simulate(40 + seed, 0.0, sigma_px=0.5)
        found = solve(problem.pixels0, problem.pixels1, sigma_px=0.5)
        assert np.all(found.result == Result.success)
        xi = jax.vmap(tangent_errors)(found.model, problem.cam1_from_cam0)
        values.append(np.asarray(nees(xi, found.covariance)))
    values = np.concatenate(values)
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 5 * len(values)) / len(values)
    assert low < values.mean() < high


def test_bad_input_has_a_code_and_an_empty_answer():
    problem = simulate(1, 0.0)
    pixels0, pixels1 = np.array(problem.pixels0), np.array(problem.pixels1)
    mask = np.ones((B, N), bool)
    mask[0] = False
    mask[1] = np.arange(N) < 5
    pixels0[2] = np.nan
    pixels0[3], pixels1[3] = pixels0[3, :1], pixels1[3, :1]
    pixels1[4:54] = np.random.default_rng(0).uniform([0, 0], [1280, 960], size=(50, N, 2))
    found = solve(jnp.asarray(pixels0), jnp.asarray(pixels1), mask)
    expected = [Result.too_few, Result.too_few, Result.too_few, Result.degenerate]
    for i, code in enumerate(expected):
        assert (found.result == code)[i], i
    # Noise is now and then as good as the best of thousands of models: 256 samples per look, many looks.
    assert np.mean((found.result == Result.no_consensus)[4:54]) > 0.9
    failed = np.asarray(~((found.result == Result.success) | (found.result == Result.not_converged)))
    assert np.all(np.asarray(found.model.wxyz_xyz)[failed] == np.eye(7)[0])
    assert not np.asarray(found.inliers)[failed].any()
    for leaf in jax.tree.leaves((found.model, found.covariance, found.score)):
        assert np.isfinite(leaf).all()


def test_wrong_shapes_are_said_in_one_line():
    camera, key = Pinhole(**CAMERA), jax.random.key(0)
    for first, second, more in [
        ((8, 2), (7, 2), {}),
        ((8, 3), (8, 3), {}),
        ((4, 2), (4, 2), {}),
        ((8, 2), (8, 2), {"sigma_px": np.ones(9, np.float32)}),
    ]:
        with pytest.raises((ValueError, TypeError)) as caught:
            estimate_relative_pose(
                np.ones(first, np.float32), np.ones(second, np.float32), camera, camera, key=key, **more
            )
        assert not isinstance(caught.value, ValueError) or "\n" not in str(caught.value)


@pytest.mark.slow
def test_gradient_equals_central_differences(x64):
    problem = simulate_relative_pose(jax.random.key(3), 40, outlier_fraction=0.2, sigma_px=0.5, dtype=jnp.float64)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(3, 4)))

    @jax.jit
    def number(pixels1, focal):
        camera = Pinhole(fx=focal, fy=focal, cx=639.5, cy=479.5)
        options = RansacOptions(threshold_px=1.5, final_steps=60)
        found = estimate_relative_pose(
            problem.pixels0, pixels1, camera, camera, key=jax.random.key(1), options=options, sigma_px=0.5
        )
        return jnp.sum(weights * found.model.as_matrix()[:3])

    pixels1, focal = problem.pixels1, jnp.asarray(800.0)
    gradient = jax.jit(jax.grad(number, argnums=(0, 1)))(pixels1, focal)
    direction = np.random.default_rng(1).normal(size=pixels1.shape)
    step = 1e-4
    along = (number(pixels1 + step * direction, focal) - number(pixels1 - step * direction, focal)) / (2 * step)
    np.testing.assert_allclose(np.sum(gradient[0] * direction), along, rtol=1e-5)
    by_focal = (number(pixels1, focal + 1e-3) - number(pixels1, focal - 1e-3)) / 2e-3
    np.testing.assert_allclose(gradient[1], by_focal, rtol=1e-4)
