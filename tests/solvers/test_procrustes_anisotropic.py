import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tests.solvers.alignment_problems import (
    SPOILED,
    alignment_problems,
    check_gradients,
    mixed,
    pose_matrices,
    spoiled,
)
from tests.solvers.problems import lanes, pose_errors, recall, solve_in_batches
from vojax.lie import SE3
from vojax.solvers import alignment_covariance, procrustes, procrustes_anisotropic

# One shape for all tests: compiling takes most of their time.
N = 30
solve_last = jax.jit(jax.vmap(procrustes_anisotropic, in_axes=-1, out_axes=-1))
scalar_last = jax.jit(jax.vmap(procrustes, in_axes=-1, out_axes=-1))
covariances = jax.jit(jax.vmap(lambda pose, *data: alignment_covariance(SE3(pose), *data)))


def solve(*data, dtype=np.float64):
    return solve_in_batches(solve_last, *data, dtype=dtype)


def random_covariances(rng, count, n, sigma=0.05):
    """Covariances [count, n, 3, 3] with standard deviations from a third of to three times σ, in any direction."""
    axes = Rotation.random(count * n, rng=rng).as_matrix().reshape(count, n, 3, 3)
    scaled = axes * (sigma * 3.0 ** rng.uniform(-1.0, 1.0, (count, n, 1, 3)))
    return scaled @ np.swapaxes(scaled, -1, -2)


def noisy(rng, covariance):
    return np.einsum("bnij,bnj->bni", np.linalg.cholesky(covariance), rng.normal(size=covariance.shape[:3]))


def random_problems(count, n, sigma=0.05, seed=0):
    points0, points1, rotation, translation = alignment_problems(count, n, seed=seed)
    rng = np.random.default_rng(seed + 50)
    covariance0, covariance1 = (random_covariances(rng, count, n, sigma) for _ in range(2))
    data = (points0 + noisy(rng, covariance0), points1 + noisy(rng, covariance1), covariance0, covariance1)
    return data, rotation, translation


def stereo_problems(count, n, seed):
    """Points from a rectified pair before and after a motion: σ of the depth is Z²/(f b) pixels, across it Z / f."""
    rng = np.random.default_rng(seed)
    focal, baseline, sigma_px = 700.0, 0.5, 0.5
    rays = np.concatenate([rng.uniform(-0.6, 0.6, (count, n, 2)), np.ones((count, n, 1))], axis=-1)
    points0 = rays * rng.uniform(4.0, 40.0, (count, n, 1))
    rotation = Rotation.from_rotvec(rng.normal(size=(count, 3)) * 0.05).as_matrix()
    translation = rng.normal(size=(count, 3)) * 0.3 + np.array([0.0, 0.0, -1.0])
    points1 = np.einsum("bij,bnj->bni", rotation, points0) + translation[:, None]
    arrays = []
    for points in (points0, points1):
        x, y, z = np.moveaxis(points, -1, 0)
        zero = np.zeros_like(z)
        # Derivatives of the point by (u_left, v, u_right); z = f b / (u_left - u_right).
        by_left = np.stack([z / focal - x * z / (focal * baseline), -y * z / (focal * baseline),
                            -z * z / (focal * baseline)], axis=-1)  # fmt: skip
        by_right = np.stack([x, y, z], axis=-1) * (z / (focal * baseline))[..., None]
        jacobian = sigma_px * np.stack([by_left, np.stack([zero, z / focal, zero], axis=-1), by_right], axis=-1)
        arrays.append((points + np.einsum("bnij,bnj->bni", jacobian, rng.normal(size=points.shape)),
                       jacobian @ np.swapaxes(jacobian, -1, -2)))  # fmt: skip
    return (arrays[0][0], arrays[1][0], arrays[0][1], arrays[1][1]), rotation, translation


def cost(pose, points0, points1, covariance0, covariance1):
    """Sum of squared Mahalanobis distances, of pose = (rotation vector, translation)."""
    rotation = Rotation.from_rotvec(pose[:3]).as_matrix()
    e = points1 - points0 @ rotation.T - pose[3:]
    v = covariance1 + rotation @ covariance0 @ rotation.T
    return np.einsum("ni,ni->", e, np.linalg.solve(v, e[..., None])[..., 0])


def check_truth(count, dtype):
    points0, points1, rotation, translation = alignment_problems(count, N)
    rng = np.random.default_rng(1)
    covariance0, covariance1 = (random_covariances(rng, 1000, N)[rng.integers(0, 1000, count)] for _ in range(2))
    candidates = solve(points0, points1, covariance0, covariance1, dtype=dtype)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-3) >= 0.999
    else:
        assert recall(candidates, rotation, translation, 1e-6) >= 0.9999


def test_finds_the_truth(dtype):
    check_truth(4096, dtype)


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    check_truth(100_000, dtype)


def test_is_the_minimum_scipy_finds(x64):
    data, *_ = random_problems(20, N, sigma=0.1)
    found = pose_matrices(solve(*data).models.wxyz_xyz)[:, 0]
    for pose, *problem in zip(found, *data, strict=True):
        start = np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3]])
        best = scipy.optimize.minimize(cost, start + 0.02, args=tuple(problem), method="BFGS", options={"gtol": 1e-7})
        expected = np.eye(4)
        expected[:3, :3], expected[:3, 3] = Rotation.from_rotvec(best.x[:3]).as_matrix(), best.x[3:]
        np.testing.assert_allclose(pose, expected, atol=1e-6)
        assert cost(start, *problem) <= best.fun * (1.0 + 1e-10)


def test_weights_held_still_would_end_elsewhere(x64):
    # What the turning of the covariances is for: with it held, the optimum is off by a good part of its deviation.
    data, *_ = random_problems(50, N, sigma=0.2, seed=2)
    found = pose_matrices(solve(*data).models.wxyz_xyz)[:, 0]
    differences = []
    for pose, x, y, c0, c1 in zip(found, *data, strict=True):
        rotation = pose[:3, :3]
        e = y - x @ rotation.T - pose[:3, 3]
        u = np.linalg.solve(c1 + rotation @ c0 @ rotation.T, e[..., None])[..., 0]
        exact = np.concatenate([u, np.cross((x + np.einsum("nij,nj->ni", c0, u @ rotation)) @ rotation.T, u)], axis=-1)
        held = np.concatenate([u, np.cross(x @ rotation.T, u)], axis=-1)
        assert np.abs(exact.sum(axis=0)).max() < 1e-4 * np.abs(exact).max()
        differences.append(np.abs(held.sum(axis=0)).max() / np.abs(held).max())
    assert np.median(differences) > 0.01


def test_equal_isotropic_covariances_are_procrustes(x64):
    points0, points1, *_ = alignment_problems(300, N, noise=0.1, seed=3)
    covariance = np.broadcast_to(0.01 * np.eye(3), (300, N, 3, 3))
    ours = pose_matrices(solve(points0, points1, covariance, covariance).models.wxyz_xyz)
    theirs = solve_in_batches(scalar_last, points0, points1, np.ones((300, N)), dtype=np.float64)
    np.testing.assert_allclose(ours, pose_matrices(theirs.models.wxyz_xyz), atol=1e-9)


def test_exchanged_frames_give_the_inverse(x64):
    (x, y, c0, c1), *_ = random_problems(100, N, seed=4)
    there, back = (pose_matrices(c.models.wxyz_xyz)[:, 0] for c in (solve(x, y, c0, c1), solve(y, x, c1, c0)))
    np.testing.assert_allclose(there @ back, np.broadcast_to(np.eye(4), (100, 4, 4)), atol=1e-8)


def test_beats_scalar_weights_on_stereo_noise(x64):
    data, rotation, translation = stereo_problems(2000, N, seed=5)
    ours = solve(*data)
    assert ours.valid.mean() > 0.999
    # The best that one number per point can say.
    trace = np.trace(data[2] + data[3], axis1=-2, axis2=-1)
    scalar = solve_in_batches(scalar_last, *data[:2], 1.0 / trace, dtype=np.float64)
    for of in (slice(0, 3), slice(3, 4)):  # rotation, translation
        errors = []
        for candidates in (ours, scalar):
            difference = pose_matrices(candidates.models.wxyz_xyz)[:, 0, :3, of]
            difference = difference - (rotation if of.stop == 3 else translation[..., None])
            errors.append(np.sum(difference**2, axis=(1, 2)))
        paired = errors[1] - errors[0]
        rng = np.random.default_rng(6)
        means = paired[rng.integers(0, 2000, (1000, 2000))].mean(axis=1)
        assert np.quantile(means, 0.025) > 0
        assert errors[1].mean() > 2.0 * errors[0].mean()


@pytest.mark.parametrize("problem", ["stereo", "random"])
def test_covariance_is_true(x64, problem):
    count, n = 1000, N
    if problem == "stereo":
        data, rotation, translation = stereo_problems(count, n, seed=7)
    else:
        data, rotation, translation = random_problems(count, n, sigma=0.03, seed=7)
    candidates = solve(*data)
    assert candidates.valid.all()
    poses = np.asarray(candidates.models.wxyz_xyz)[:, 0]
    covariance = np.asarray(covariances(poses, *data))
    estimate, truth = pose_matrices(poses), np.zeros((count, 4, 4))
    truth[:, :3, :3], truth[:, :3, 3], truth[:, 3, 3] = rotation, translation, 1.0
    # ξ with truth = exp(-ξ) estimate, to first order.
    change = np.eye(4) - truth @ np.linalg.inv(estimate)
    xi = np.stack([*np.moveaxis(change[:, :3, 3], -1, 0), change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], axis=-1)
    nees = np.einsum("bi,bij,bj->b", xi, np.linalg.inv(covariance), xi)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * count) / count
    assert low < nees.mean() < high


@pytest.mark.parametrize("kind", [*SPOILED, "no covariance", "singular", "nan covariance", "negative"])
def test_degenerate_input(kind, dtype):
    (x, y, c0, c1), *_ = random_problems(100, N, seed=8)
    if kind == "no covariance":
        c0, c1 = 0.0 * c0, 0.0 * c1
    elif kind == "singular":
        c0, c1 = (np.broadcast_to(np.diag([1.0, 1.0, 0.0]), c0.shape),) * 2
        y = x + 1.0
    elif kind == "nan covariance":
        c0[:, 1, 2, 2] = np.nan
    elif kind == "negative":
        c1 = -10.0 * c1
    else:
        x, y = spoiled(x, y, kind)
    candidates = solve(x, y, c0, c1, dtype=dtype)
    assert not candidates.valid.any()
    np.testing.assert_array_equal(candidates.models.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (100, 1, 7)))


def test_one_set_without_noise(x64):
    (x, y, c0, c1), rotation, translation = random_problems(100, N, sigma=0.01, seed=9)
    candidates = solve(x, y, 0.0 * c0, c1 + 1e-6 * np.eye(3))
    assert candidates.valid.all()
    assert np.median(pose_errors(candidates.models.wxyz_xyz, rotation, translation)) < 0.1


def absurd(seed, count):
    points0, points1 = mixed(seed, count, N)
    rng = np.random.default_rng(seed)
    covariance0, covariance1 = (random_covariances(rng, 500, N)[rng.integers(0, 500, count)] for _ in range(2))
    scale = 10.0 ** rng.uniform(-12, 12, (count, 1, 1, 1))
    scale[count // 2 :] = 1.0
    return points0, points1, scale * covariance0, scale * covariance1


def test_nothing_but_numbers_comes_out():
    candidates = solve(*absurd(10, 4096), dtype=np.float32)
    assert np.isfinite(candidates.models.wxyz_xyz).all()
    assert candidates.valid[2048:].mean() > 0.99


@pytest.mark.slow
def test_nothing_but_numbers_comes_out_of_a_million(dtype):
    for seed in range(8):
        assert np.isfinite(solve(*absurd(seed + 20, 125_000), dtype=dtype).models.wxyz_xyz).all()


def weighted_sum(*data):
    models = procrustes_anisotropic(*data, iterations=20).models
    return jnp.sum(models.as_matrix() * jnp.arange(1.0, 17.0).reshape(1, 4, 4))


def symmetric_sum(points0, points1, half0, half1):
    """Covariances by their square roots, so that they stay symmetric."""
    return weighted_sum(points0, points1, half0 @ jnp.swapaxes(half0, 1, 2), half1 @ jnp.swapaxes(half1, 1, 2))


@pytest.mark.slow
def test_gradients_equal_central_differences(x64):
    (x, y, c0, c1), *_ = random_problems(1, 4, sigma=0.05, seed=11)
    check_gradients(symmetric_sum, [(x[0], y[0], np.linalg.cholesky(c0[0]), np.linalg.cholesky(c1[0]))])


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    def total(*data):
        return jnp.sum(procrustes_anisotropic(*data).models.wxyz_xyz)

    gradient = jax.jit(jax.vmap(jax.grad(total, (0, 1, 2, 3)), -1, -1))
    for part in gradient(*lanes(*absurd(12, 2048), dtype=np.float32)):
        assert np.isfinite(part).all()
        assert np.abs(part[..., 1024:]).max() > 0


def test_bad_shapes():
    with pytest.raises(ValueError, match="at least 3"):
        procrustes_anisotropic(*np.zeros((2, 2, 3)), *np.zeros((2, 2, 3, 3)))
    with pytest.raises(ValueError, match=r"expected \(4, 3, 3\) beside 4 points"):
        inspect.unwrap(procrustes_anisotropic)(*np.zeros((2, 4, 3)), np.zeros((4, 3)), np.zeros((4, 3, 3)))
