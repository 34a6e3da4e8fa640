import inspect

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from scipy.stats import chi2

from tests.solvers.alignment_problems import check_gradients, mixed
from tests.solvers.problems import lanes, solve_in_batches
from vojax.solvers import _align_2d as solvers
from vojax.solvers._plane_motions import align_2d_covariance

FAMILIES = ["translation", "euclidean", "similarity", "affine", "projective"]
N = 8
DOF = {"translation": 2, "euclidean": 3, "similarity": 4, "affine": 6, "projective": 8}
solver_of = {family: getattr(solvers, f"align_2d_{family}") for family in FAMILIES}
batched = {family: jax.jit(jax.vmap(solver_of[family], in_axes=-1, out_axes=-1)) for family in FAMILIES}
each_family = pytest.mark.parametrize("family", FAMILIES)


def solve(family, points0, points1, weights=None, covariance1=None, dtype=np.float64):
    weights = np.ones(points0.shape[:2]) if weights is None else weights
    covariance1 = np.broadcast_to(np.eye(2), (*points0.shape[:2], 2, 2)) if covariance1 is None else covariance1
    return solve_in_batches(batched[family], points0, points1, weights, covariance1, dtype=dtype)


def matrix_of(family, x):
    """The matrix of parameters, as the docstrings name them."""
    if family == "translation":
        return np.array([[1.0, 0.0, x[0]], [0.0, 1.0, x[1]], [0.0, 0.0, 1.0]])
    if family == "euclidean":
        c, s = np.cos(x[2]), np.sin(x[2])
        return np.array([[c, -s, x[0]], [s, c, x[1]], [0.0, 0.0, 1.0]])
    if family == "similarity":
        return np.array([[x[2], -x[3], x[0]], [x[3], x[2], x[1]], [0.0, 0.0, 1.0]])
    if family == "affine":
        return np.array([*x, 0.0, 0.0, 1.0]).reshape(3, 3)
    return np.array([*x, 1.0]).reshape(3, 3)


def parameters_of(family, m):
    m = m / m[2, 2]
    if family == "translation":
        return m[:2, 2]
    if family == "euclidean":
        return np.array([m[0, 2], m[1, 2], np.arctan2(m[1, 0], m[0, 0])])
    if family == "similarity":
        return np.array([m[0, 2], m[1, 2], m[0, 0], m[1, 0]])
    return m.reshape(9)[: DOF[family]]


def transfer(m, points):
    moved = points @ np.swapaxes(m[..., :2], -1, -2) + m[..., None, :, 2]
    return moved[..., :2] / moved[..., 2:]


def problems(family, count, noise=0.0, seed=0, anisotropic=False, n=N):
    """Pixels of a 1280 x 960 image, weights, covariances, and true matrices with h22 = 1."""
    rng = np.random.default_rng(seed)
    points0 = rng.uniform(0.0, 1.0, (count, n, 2)) * np.array([1280.0, 960.0])
    truth = []
    for _ in range(count):
        angle, scale = rng.uniform(-3.0, 3.0), np.exp(rng.normal() * 0.3)
        shift = rng.normal(size=2) * 100.0
        c, s = scale * np.cos(angle), scale * np.sin(angle)
        by_family = {
            "translation": shift,
            "euclidean": np.array([*shift, angle]),
            "similarity": np.array([*shift, c, s]),
            "affine": np.array([c, -s, shift[0], s, c, shift[1]]) + rng.normal(size=6) * 0.2,
        }
        if family == "projective":
            affine = by_family["affine"]
            truth.append(matrix_of(family, np.array([*affine, *(rng.uniform(-2e-4, 2e-4, 2))])))
        else:
            truth.append(matrix_of(family, by_family[family]))
    truth = np.array(truth)
    weights = rng.uniform(0.3, 2.0, (count, n))
    root = np.broadcast_to(np.eye(2), (count, n, 2, 2))
    if anisotropic:
        root = np.eye(2) + rng.normal(size=(count, n, 2, 2)) * 0.2
    covariance = noise**2 * root @ np.swapaxes(root, -1, -2) if noise else root @ np.swapaxes(root, -1, -2)
    error = np.einsum("bnij,bnj->bni", root, rng.normal(size=points0.shape)) / np.sqrt(weights)[..., None]
    return points0, transfer(truth, points0) + noise * error, weights, covariance, truth


@each_family
def test_finds_the_truth(family, dtype):
    points0, points1, weights, covariance, truth = problems(family, 4096, anisotropic=True)
    candidates = solve(family, points0, points1, weights, covariance, dtype)
    inside = np.random.default_rng(1).uniform(0.0, 1.0, (4096, 4, 2)) * np.array([1280.0, 960.0])
    with np.errstate(all="ignore"):
        error = np.abs(transfer(candidates.models[:, 0].astype(np.float64), inside) - transfer(truth, inside))
    error = error.max(axis=(1, 2))
    # Pixels; the points are known to 1e-4 in float32.
    found = candidates.valid[:, 0] & (error < (0.05 if dtype == jnp.float32 else 1e-7))
    assert found.mean() >= (0.99 if family == "projective" else 0.998)


@each_family
def test_is_the_minimum_scipy_finds(family, x64):
    points0, points1, weights, covariance, truth = problems(family, 20, noise=1.0, seed=2, anisotropic=True)
    found = solve(family, points0, points1, weights, covariance).models[:, 0]
    units = np.array([1.0] * DOF[family])
    if family == "projective":
        units[6:] = 1e-4
    for x, y, w, c, m, start in zip(points0, points1, weights, covariance, found, truth, strict=True):
        white = np.linalg.inv(np.linalg.cholesky(c)) * np.sqrt(w)[:, None, None]

        def residuals(theta, x=x, y=y, white=white):
            return np.einsum("nij,nj->ni", white, transfer(matrix_of(family, theta), x) - y).ravel()

        best = scipy.optimize.least_squares(residuals, parameters_of(family, start), x_scale=units, xtol=1e-14,
                                            ftol=1e-14, gtol=1e-14)  # fmt: skip
        expected = matrix_of(family, best.x)
        grid = np.array([[0.0, 0.0], [1280.0, 0.0], [640.0, 480.0], [0.0, 960.0]])
        np.testing.assert_allclose(transfer(m, grid), transfer(expected, grid), atol=1e-3)
        ours = np.sum(residuals(parameters_of(family, m)) ** 2)
        assert ours <= 2.0 * best.cost * (1.0 + 1e-9)


def test_equals_opencv(x64):
    points0, points1, *_ = problems("affine", 20, noise=1.0, seed=3)
    affine, similarity = (solve(family, points0, points1).models[:, 0] for family in ("affine", "similarity"))
    for x, y, a, s in zip(points0, points1, affine, similarity, strict=True):
        # One refined on all points as inliers.
        expected, _ = cv2.estimateAffine2D(x, y, method=cv2.RANSAC, ransacReprojThreshold=1e3, refineIters=100)
        np.testing.assert_allclose(a[:2], expected, atol=1e-3, rtol=1e-4)
        expected, _ = cv2.estimateAffinePartial2D(x, y, method=cv2.RANSAC, ransacReprojThreshold=1e4, refineIters=100)
        np.testing.assert_allclose(s[:2], expected, atol=1e-1, rtol=1e-3)


def test_linear_families_equal_numpy(x64):
    points0, points1, weights, *_ = problems("affine", 50, noise=5.0, seed=4)
    found = solve("affine", points0, points1, weights).models[:, 0]
    for x, y, w, m in zip(points0, points1, weights, found, strict=True):
        root = np.sqrt(w)[:, None]
        rows = np.concatenate([x, np.ones((N, 1))], axis=1)
        expected = np.linalg.lstsq(root * rows, root * y, rcond=None)[0].T
        np.testing.assert_allclose(m[:2], expected, rtol=1e-8, atol=1e-7)


@each_family
def test_covariance_is_true(family, x64):
    count = 1000
    points0, points1, weights, covariance, truth = problems(family, count, noise=0.5, seed=5, anisotropic=True)
    candidates = solve(family, points0, points1, weights, covariance)
    assert candidates.valid.mean() > 0.99
    of = jax.jit(jax.vmap(lambda *data: align_2d_covariance(family, *data)))
    found = np.asarray(of(candidates.models[:, 0], points0, weights, covariance))
    ok = candidates.valid[:, 0]
    nees = []
    for m, c, t in zip(candidates.models[ok, 0], found[ok], truth[ok], strict=True):
        error = parameters_of(family, m) - parameters_of(family, t)
        if family == "euclidean":
            error[2] = (error[2] + np.pi) % (2 * np.pi) - np.pi
        size = np.sqrt(np.diag(c))
        nees.append(error / size @ np.linalg.solve(c / np.outer(size, size), error / size))
    low, high = chi2.ppf([0.0005, 0.9995], DOF[family] * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


@each_family
@pytest.mark.parametrize("kind", ["one point", "line", "nan", "inf", "negative", "no weight", "covariance"])
def test_degenerate_sets(family, kind, dtype):
    points0, points1, weights, covariance, _ = problems(family, 100, seed=6)
    if kind == "one point":
        points0[:], points1[:] = points0[:, :1], points1[:, :1]
    elif kind == "line":
        along = np.linspace(0.0, 1.0, N)[None, :, None]
        points0, points1 = (p[:, :1] + along * (p[:, 1:2] - p[:, :1]) for p in (points0, points1))
    elif kind == "nan":
        points0[:, 2, 0] = np.nan
    elif kind == "inf":
        points1[:, 1, 1] = np.inf
    elif kind == "negative":
        weights[:, 3] = -1.0
    elif kind == "no weight":
        weights[:] = 0.0
    else:
        covariance = covariance * np.array([[1.0, 1.0], [1.0, 0.0]])
    candidates = solve(family, points0, points1, weights, covariance, dtype)
    if (kind == "one point" and family == "translation") or (kind == "line" and DOF[family] <= 4):
        assert candidates.valid.all()
        return
    assert not candidates.valid.any()
    expected = np.zeros((3, 3)) if family == "projective" else np.eye(3)
    np.testing.assert_array_equal(candidates.models, np.broadcast_to(expected, (100, 1, 3, 3)))


@each_family
def test_nothing_but_numbers_comes_out(family):
    points0, points1 = mixed(7, 8192, N, dim=2)
    candidates = solve(family, points0, points1, dtype=np.float32)
    assert np.isfinite(candidates.models).all()
    assert candidates.valid[4096:].mean() > 0.99


@pytest.mark.slow
@each_family
def test_nothing_but_numbers_comes_out_of_a_million(family, dtype):
    for seed in range(8):
        assert np.isfinite(solve(family, *mixed(seed + 20, 125_000, N, dim=2), dtype=dtype).models).all()


@pytest.mark.slow
@each_family
def test_gradients_equal_central_differences(family, x64):
    def total(points0, points1, weights, root):
        models = solver_of[family](points0, points1, weights, root @ jnp.swapaxes(root, 1, 2)).models
        return jnp.sum(models * jnp.arange(1.0, 10.0).reshape(1, 3, 3))

    points0, points1, weights, covariance, _ = problems(family, 1, noise=5.0, seed=8, anisotropic=True, n=6)
    data = (points0[0] / 500, points1[0] / 500, weights[0], np.linalg.cholesky(covariance[0]) / 5)
    # The solution is known to some 1e-12: smaller steps see its rounding, on some processors more than on others.
    check_gradients(total, [data], step=1e-5)


@pytest.mark.slow
@each_family
def test_gradients_are_finite_everywhere(family):
    gradient = jax.jit(jax.vmap(jax.grad(lambda *data: jnp.sum(solver_of[family](*data).models), (0, 1, 2, 3)), -1, -1))
    points0, points1 = mixed(9, 2048, N, dim=2)
    covariance = np.broadcast_to(np.eye(2), (2048, N, 2, 2))
    for part in gradient(*lanes(points0, points1, np.ones((2048, N)), covariance, dtype=np.float32)):
        assert np.isfinite(part).all()


def test_bad_input():
    ones = np.ones((4, 2), np.float32)
    with pytest.raises(ValueError, match="at least 4"):
        solvers.align_2d_projective(ones[:3], ones[:3])
    with pytest.raises(ValueError, match="two equal shapes"):
        inspect.unwrap(solvers.align_2d_affine)(ones, ones[:3])
    with pytest.raises(ValueError, match=r"expected \(4, 2, 2\)"):
        inspect.unwrap(solvers.align_2d_affine)(ones, ones, None, np.ones((3, 2, 2), np.float32))
    with pytest.raises(ValueError, match="expected one of translation"):
        align_2d_covariance("rigid", jnp.eye(3), ones)
