import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate
from scipy.spatial.transform import Rotation

from vojax.lie import SO3
from vojax.metrics import (
    axis_rotation_error_deg,
    nees,
    pose_auc,
    reprojection_rmse,
    rotation_error_deg,
    translation_direction_error_deg,
    translation_error,
)

geodesic_error = jax.jit(rotation_error_deg)
axis_error = jax.jit(axis_rotation_error_deg)
auc = jax.jit(pose_auc)
squared_error = jax.jit(nees)
direction_error = jax.jit(translation_direction_error_deg, static_argnames="sign_agnostic")


def _so3(rotation: Rotation, dtype=jnp.float64) -> SO3:
    return SO3(jnp.asarray(np.roll(rotation.as_quat(), 1, axis=-1), dtype))


def _pair(n=500, seed=0):
    return Rotation.random(n, random_state=seed), Rotation.random(n, random_state=seed + 1)


def test_geodesic_angle_equals_scipy(dtype, tolerance):
    a, b = _pair()
    found = geodesic_error(_so3(a, dtype), _so3(b, dtype))
    expected = np.degrees((b.inv() * a).magnitude())
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, atol=100 * tolerance)


def test_axis_angle_equals_eq_18_and_stays_below_the_geodesic_one(dtype, tolerance):
    a, b = _pair()
    cosines = np.clip(np.einsum("nij,nij->nj", a.as_matrix(), b.as_matrix()), -1, 1)
    expected = np.degrees(np.arccos(cosines)).mean(axis=1)
    found = axis_error(_so3(a, dtype), _so3(b, dtype))
    np.testing.assert_allclose(found, expected, atol=500 * tolerance)
    geodesic = geodesic_error(_so3(a, dtype), _so3(b, dtype))
    assert np.all(found <= geodesic + 500 * tolerance)
    # They are different quantities: about a main axis the ratio is exactly 2/3.
    assert np.median(np.asarray(found / geodesic)) < 0.95
    turn = _so3(Rotation.from_rotvec([0.0, 0.3, 0.0]), dtype)
    one = SO3.identity(dtype=dtype)
    np.testing.assert_allclose(geodesic_error(turn, one), np.degrees(0.3), rtol=1e-5)
    np.testing.assert_allclose(axis_error(turn, one), np.degrees(0.2), rtol=1e-5)


def test_extreme_rotations(dtype):
    one = SO3.identity(dtype=dtype)
    half = _so3(Rotation.from_rotvec([np.pi, 0.0, 0.0]), dtype)
    np.testing.assert_allclose(geodesic_error(half, one), 180.0, rtol=1e-6)
    np.testing.assert_allclose(axis_error(half, one), 120.0, rtol=1e-6)
    assert float(geodesic_error(one, one)) == 0.0
    # q and -q are one rotation.
    assert float(geodesic_error(SO3(-one.parameters()), one)) == 0.0
    tiny = _so3(Rotation.from_rotvec([1e-6, 0.0, 0.0]), dtype)
    np.testing.assert_allclose(geodesic_error(tiny, one), np.degrees(1e-6), rtol=1e-5)


def test_direction_error_known_angles():
    z = np.array([0.0, 0.0, 1.0], np.float32)
    for degrees in (0.0, 1e-3, 30.0, 90.0, 135.0, 180.0):
        t = np.array([0.0, np.sin(np.radians(degrees)), np.cos(np.radians(degrees))], np.float32)
        np.testing.assert_allclose(direction_error(7 * t, 0.1 * z), degrees, rtol=1e-5, atol=1e-5)
        folded = min(degrees, 180.0 - degrees)
        np.testing.assert_allclose(direction_error(t, z, sign_agnostic=True), folded, rtol=1e-5, atol=2e-5)
    assert float(direction_error(0 * z, z)) == 90.0
    assert float(direction_error(z, 0 * z, sign_agnostic=True)) == 90.0


def test_translation_error_and_reprojection_rmse():
    np.testing.assert_allclose(translation_error(np.array([[3.0, 4.0, 0.0]]), np.zeros((1, 3))), [5.0])
    a = np.array([[3.0, 4.0], [0.0, 0.0], [np.nan, 1e30]], np.float32)
    b = np.zeros((3, 2), np.float32)
    mask = np.array([True, True, False])
    np.testing.assert_allclose(reprojection_rmse(a, b, mask), np.sqrt(25 / 2), rtol=1e-6)
    np.testing.assert_allclose(reprojection_rmse(a[:2], b[:2]), np.sqrt(25 / 2), rtol=1e-6)
    assert float(reprojection_rmse(a, b, np.zeros(3, bool))) == 0.0


@pytest.mark.parametrize("function", [geodesic_error, axis_error])
def test_rotation_gradients(function, x64):
    a, b = _so3(Rotation.from_rotvec([0.3, -0.5, 0.9])), _so3(Rotation.from_rotvec([-0.2, 0.1, 0.4]))

    def value(phi):
        return function(a @ SO3.exp(phi), b)

    gradient = jax.jit(jax.grad(value))(np.zeros(3))
    h, value = 1e-6, jax.jit(value)
    numeric = [(value(h * e) - value(-h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(gradient, numeric, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("function", [geodesic_error, axis_error])
@pytest.mark.parametrize("rotvec", [[0.0, 0.0, 0.0], [np.pi, 0.0, 0.0], [np.pi / 2, 0.0, 0.0]])
def test_rotation_gradients_are_finite_at_singular_points(function, rotvec):
    error = _so3(Rotation.from_rotvec(rotvec), jnp.float32)
    gradient = jax.jit(jax.grad(lambda q: function(SO3(q), SO3.identity())))(error.parameters())
    assert np.all(np.isfinite(gradient))


@pytest.mark.parametrize("sign_agnostic", [False, True])
def test_direction_gradients(sign_agnostic, x64):
    t, true = jnp.array([0.3, -0.4, -0.2]), jnp.array([0.1, 0.2, 0.7])

    @jax.jit
    def value(t):
        return direction_error(t, true, sign_agnostic=sign_agnostic)

    gradient, h = jax.jit(jax.grad(value)), 1e-6
    numeric = [(value(t + h * e) - value(t - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(gradient(t), numeric, atol=1e-6)
    for singular in (true, -true, 0 * true):
        assert np.all(np.isfinite(gradient(singular)))


def test_batches_and_jit():
    a, b = _pair(12)
    left, right = _so3(a, jnp.float32), _so3(b, jnp.float32)
    together = geodesic_error(SO3(left.parameters().reshape(3, 4, 4)), SO3(right.parameters().reshape(3, 4, 4)))
    single = [float(geodesic_error(SO3(p), SO3(q))) for p, q in zip(left.parameters(), right.parameters(), strict=True)]
    np.testing.assert_allclose(together.ravel(), single, rtol=1e-5)
    t = np.arange(24.0, dtype=np.float32).reshape(2, 4, 3)
    assert direction_error(t, t[::-1].copy()).shape == (2, 4)
    assert reprojection_rmse(t[..., :2], t[..., 1:]).shape == (2,)


def _recall_area(errors, threshold):
    """Integrate the piecewise-linear recall curve numerically."""
    ordered = np.sort(errors)
    count = len(errors)

    def recall(x):
        knots_x = np.concatenate([[0.0], ordered[ordered < threshold]])
        knots_y = np.arange(len(knots_x)) / count
        return np.interp(x, knots_x, knots_y)

    grid = np.unique(np.concatenate([np.linspace(0, threshold, 2001), ordered[ordered < threshold]]))
    return integrate.trapezoid(recall(grid), grid) / threshold


def test_pose_auc_equals_numerical_integration(dtype, tolerance):
    errors = np.random.default_rng(0).exponential(6.0, size=(3, 200))
    errors[:, :20] = np.inf
    thresholds = np.array([1.0, 5.0, 10.0, 20.0])
    found = auc(jnp.asarray(errors, dtype), jnp.asarray(thresholds, dtype))
    expected = [[_recall_area(row, t) for t in thresholds] for row in errors]
    np.testing.assert_allclose(found, expected, atol=10 * tolerance)


def test_pose_auc_known_answers():
    thresholds = np.array([10.0], np.float32)
    # One problem of error e: a triangle up to e, level from there.
    np.testing.assert_allclose(auc(np.array([4.0], np.float32), thresholds), [(4 / 2 + 6) / 10])
    assert float(auc(np.zeros(5, np.float32), thresholds)[0]) == 1.0
    assert float(auc(np.full(5, np.nan, np.float32), thresholds)[0]) == 0.0
    assert float(auc(np.full(5, 11.0, np.float32), thresholds)[0]) == 0.0


def test_nees_is_the_mahalanobis_distance(dtype):
    rng = np.random.default_rng(1)
    root = rng.normal(size=(50, 6, 6)) + 2 * np.eye(6)[None]
    covariance = root @ root.transpose(0, 2, 1)
    error = rng.normal(size=(50, 6))
    expected = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    found = squared_error(jnp.asarray(error, dtype), jnp.asarray(covariance, dtype))
    np.testing.assert_allclose(found, expected, rtol=2e-2 if dtype == jnp.float32 else 1e-9)


def test_nees_of_matching_noise_follows_chi_square():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6)) + 2 * np.eye(6)
    error = (rng.normal(size=(20000, 6)) @ root.T).astype(np.float32)
    covariance = np.broadcast_to((root @ root.T).astype(np.float32), (20000, 6, 6))
    values = np.asarray(squared_error(error, covariance))
    # Mean d and variance 2 d; the standard error of the mean is sqrt(12 / 20000) = 0.024.
    assert abs(values.mean() - 6) < 4 * np.sqrt(12 / 20000)
    assert abs(values.var() - 12) < 1.5


def test_nees_of_an_impossible_covariance_is_huge_and_finite():
    broken = np.diag([1.0, -1.0]).astype(np.float32)
    assert float(squared_error(np.ones(2, np.float32), broken)) == np.finfo(np.float32).max
    gradient = jax.grad(lambda c: squared_error(jnp.ones(2), c))(jnp.asarray(broken))
    assert np.all(np.isfinite(gradient))
