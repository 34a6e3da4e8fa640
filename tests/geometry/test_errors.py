"""Reprojection and epipolar errors against OpenCV, an exact correction of the points, and each other."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from vojax.cameras import BrownConrady, Pinhole
from vojax.geometry import (
    algebraic_error,
    essential_from_fundamental,
    essential_from_pose,
    fundamental_from_essential,
    projection_matrix,
    reprojection_error,
    sampson_error,
    sampson_residual,
    symmetric_epipolar_error,
)
from vojax.lie import SE3


def two_views(dtype=jnp.float64, n=40):
    rng = np.random.default_rng(0)
    points0 = rng.uniform([-2, -2, 4], [2, 2, 8], size=(n, 3))
    pose = SE3.exp(jnp.asarray([0.8, -0.3, 0.2, 0.1, -0.3, 0.2], dtype))
    points0 = jnp.asarray(points0, dtype)
    return pose, points0, pose.apply(points0)


def test_reprojection_error_is_projected_minus_observed_as_opencv_projects(x64):
    camera = BrownConrady(500.0, 510.0, 320.0, 240.0, -0.3, 0.1, 1e-3, -2e-3, 0.02)
    pose, points, _ = two_views()
    rotation_vector, translation = pose.rotation().log(), pose.translation()
    matrix = np.array([[500, 0, 320], [0, 510, 240], [0, 0, 1.0]])
    projected, _ = cv2.projectPoints(
        np.asarray(points),
        np.asarray(rotation_vector),
        np.asarray(translation),
        matrix,
        np.array([-0.3, 0.1, 1e-3, -2e-3, 0.02]),
    )
    observed = projected[:, 0] + np.array([[2.0, -3.0]])
    residuals = jax.jit(reprojection_error)(points, observed, camera, pose)
    np.testing.assert_allclose(residuals, np.broadcast_to([-2.0, 3.0], observed.shape), atol=1e-9)


def test_reprojection_error_is_finite_behind_the_camera():
    camera = Pinhole(500.0, 500.0, 320.0, 240.0)
    points = jnp.asarray([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, -1.0]])

    def cost(points):
        return jnp.sum(reprojection_error(points, jnp.zeros((3, 2)), camera, SE3.identity()) ** 2)

    value, gradient = jax.jit(jax.value_and_grad(cost))(points)
    assert jnp.isfinite(value)
    assert jnp.isfinite(gradient).all()


def test_essential_matrix_is_translation_cross_rotation(dtype):
    pose, points0, points1 = two_views(dtype)
    tolerance = {jnp.float32: 2e-5, jnp.float64: 1e-13}[dtype]
    essential = essential_from_pose(pose)
    np.testing.assert_allclose(algebraic_error(essential, points0, points1), 0.0, atol=50 * tolerance)
    # The other order of the factors, R [t]×, is another matrix: it must not pass.
    t = pose.translation()
    cross = jnp.asarray([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    rotation = pose.rotation().as_matrix()
    np.testing.assert_allclose(essential, cross @ rotation, atol=tolerance)
    assert float(jnp.abs(algebraic_error(rotation @ cross, points0, points1)).max()) > 0.1
    # Nor must the transpose, which exchanges the views.
    assert float(jnp.abs(algebraic_error(essential.T, points0, points1)).max()) > 0.1


def test_fundamental_matrix_relates_pixels(x64):
    pose, points0, points1 = two_views()
    camera0, camera1 = Pinhole(500.0, 520.0, 320.0, 240.0, skew=5.0), Pinhole(700.0, 690.0, 300.0, 200.0, skew=-3.0)
    essential = essential_from_pose(pose)
    fundamental = fundamental_from_essential(essential, camera0, camera1)
    pixels0, pixels1 = camera0.project(points0), camera1.project(points1)
    np.testing.assert_allclose(sampson_residual(fundamental, pixels0, pixels1), 0.0, atol=1e-9)
    np.testing.assert_allclose(essential_from_fundamental(fundamental, camera0, camera1), essential, atol=1e-12)


def test_projection_matrix_projects(x64):
    pose, points, _ = two_views()
    camera = Pinhole(500.0, 520.0, 320.0, 240.0, skew=5.0)
    homogeneous = jnp.concatenate([points, jnp.ones((len(points), 1))], axis=1)
    h = homogeneous @ projection_matrix(pose, camera).T
    np.testing.assert_allclose(h[:, :2] / h[:, 2:], camera.project(pose.apply(points)), rtol=1e-12)
    assert projection_matrix(SE3.identity((4,))).shape == (4, 3, 4)


def noisy_pixels():
    pose, points0, points1 = two_views()
    camera = Pinhole(500.0, 500.0, 320.0, 240.0)
    fundamental = fundamental_from_essential(essential_from_pose(pose), camera, camera)
    rng = np.random.default_rng(1)
    pixels0, pixels1 = (
        np.asarray(camera.project(points)) + rng.normal(size=(len(points), 2)) for points in (points0, points1)
    )
    return fundamental, pixels0, pixels1


def test_sampson_error_is_the_squared_correction_and_not_the_unsquared_print(x64):
    fundamental, pixels0, pixels1 = noisy_pixels()
    error = sampson_error(fundamental, pixels0, pixels1)
    # The definition that it approximates: least squared movement of both pixels onto the constraint.
    f = np.asarray(fundamental)

    def constraint(x):
        return np.array([*x[2:], 1.0]) @ f @ np.array([*x[:2], 1.0]) * 1e4

    for i in range(5):
        observed = np.concatenate([pixels0[i], pixels1[i]])
        found = scipy.optimize.minimize(
            lambda x, observed=observed: np.sum((x - observed) ** 2),
            observed,
            constraints={"type": "eq", "fun": constraint},
            method="SLSQP",
            options={"ftol": 1e-12},
        )
        np.testing.assert_allclose(error[i], found.fun, rtol=1e-2, atol=1e-6)
    np.testing.assert_allclose(error, sampson_residual(fundamental, pixels0, pixels1) ** 2, rtol=1e-10)
    # A squared distance ignores the matrix's scale and scales with the square of the pixels' unit. The formula with the
    # numerator not squared, as one of the sources prints it, does neither.
    np.testing.assert_allclose(sampson_error(7.0 * fundamental, pixels0, pixels1), error, rtol=1e-10)
    unit = jnp.diag(jnp.asarray([0.5, 0.5, 1.0]))
    np.testing.assert_allclose(sampson_error(unit @ fundamental @ unit, 2 * pixels0, 2 * pixels1), 4 * error, rtol=1e-9)

    def unsquared(matrix):
        ones = jnp.ones((len(pixels0), 1))
        h0, h1 = (jnp.concatenate([jnp.asarray(p), ones], axis=1) for p in (pixels0, pixels1))
        lines1, lines0 = h0 @ matrix.T, h1 @ matrix
        return jnp.sum(h1 * lines1, axis=1) / (jnp.sum(lines1[:, :2] ** 2, 1) + jnp.sum(lines0[:, :2] ** 2, 1))

    assert float(jnp.abs(unsquared(7.0 * fundamental) / unsquared(fundamental) - 1).min()) > 0.5
    assert float(jnp.median(jnp.abs(unsquared(fundamental) / error))) > 100


def test_sampson_error_agrees_with_opencv(x64):
    fundamental, pixels0, pixels1 = noisy_pixels()
    error = sampson_error(fundamental, pixels0, pixels1)
    for i in range(10):
        h0, h1 = (np.append(p[i], 1.0).reshape(3, 1) for p in (pixels0, pixels1))
        np.testing.assert_allclose(error[i], cv2.sampsonDistance(h0, h1, np.asarray(fundamental)), rtol=1e-9)


def test_symmetric_error_sums_squared_distances_to_opencv_lines(x64):
    fundamental, pixels0, pixels1 = noisy_pixels()
    lines1 = cv2.computeCorrespondEpilines(pixels0.reshape(-1, 1, 2), 1, np.asarray(fundamental))[:, 0]
    lines0 = cv2.computeCorrespondEpilines(pixels1.reshape(-1, 1, 2), 2, np.asarray(fundamental))[:, 0]
    # OpenCV's lines have a unit normal.
    d1 = np.sum(lines1[:, :2] * pixels1, axis=1) + lines1[:, 2]
    d0 = np.sum(lines0[:, :2] * pixels0, axis=1) + lines0[:, 2]
    np.testing.assert_allclose(symmetric_epipolar_error(fundamental, pixels0, pixels1), d0**2 + d1**2, rtol=1e-6)


def test_errors_are_finite_at_the_epipoles():
    # Pure forward motion: both epipoles are the principal point.
    essential = essential_from_pose(SE3.exp(jnp.asarray([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])))
    zero, away = jnp.zeros((1, 2)), jnp.full((1, 2), 0.3)
    for error in (sampson_error, sampson_residual, symmetric_epipolar_error):
        for pair in ((zero, zero), (zero, away), (away, zero)):
            value, gradients = jax.jit(
                jax.value_and_grad(lambda e, a, b, error=error: error(e, a, b)[0], argnums=(0, 1, 2))
            )(essential, *pair)
            assert float(value) == 0.0
            assert all(jnp.isfinite(g).all() for g in gradients)


def test_hypotheses_by_points_is_a_vmap(x64):
    pose, points0, points1 = two_views()
    normalized0, normalized1 = (points[:, :2] / points[:, 2:] for points in (points0, points1))
    tangents = jnp.asarray(np.random.default_rng(2).normal(size=(6, 6)) * 0.1)
    essentials = jnp.stack([essential_from_pose(pose @ SE3.exp(tangent)) for tangent in tangents])
    for error in (sampson_error, symmetric_epipolar_error):
        table = jax.jit(jax.vmap(error, in_axes=(0, None, None)))(essentials, normalized0, normalized1)
        assert table.shape == (6, len(points0))
        np.testing.assert_allclose(table[4], error(essentials[4], normalized0, normalized1), rtol=1e-10)
