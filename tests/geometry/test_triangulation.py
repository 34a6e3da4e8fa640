"""Linear and refined triangulation against numpy, OpenCV, scipy and Monte-Carlo runs."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from vojax.cameras import BrownConrady, Pinhole, RectifiedStereo
from vojax.geometry import (
    TriangulationOptions,
    projection_matrix,
    ray_distance_std,
    ray_distances,
    triangulate_dlt,
    triangulate_dlt_homogeneous,
    triangulate_dlt_inhomogeneous,
    triangulate_rays,
    triangulate_rectified,
    triangulate_refine,
)
from vojax.geometry._null_vector import null_vector
from vojax.lie import SE3

CENTERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.4, 0.2], [0.1, -0.2, 1.0]])
CAMERA = (500.0, 510.0, 320.0, 240.0)


def poses(dtype=None, views=4):
    """Cameras that look roughly along +z from `CENTERS`."""
    turns = np.random.default_rng(0).normal(size=(4, 3)) * 0.05
    tangents = np.concatenate([CENTERS, turns], axis=1)[:views]
    world_from_cam = SE3.exp(jnp.asarray(tangents, dtype or jnp.result_type(float)))
    return world_from_cam.inverse()


def observe(points, cam_from_world, camera):
    """Pixels [n, c, 2]."""
    return jax.vmap(lambda point: jax.vmap(lambda pose: camera.project(pose.apply(point)))(cam_from_world))(points)


def rays_to(points, centers, dtype=None):
    """Bearings [n, c, 3]."""
    rays = np.asarray(points)[:, None, :] - np.asarray(centers)[None, :, :]
    return jnp.asarray(rays / np.linalg.norm(rays, axis=2, keepdims=True), dtype)


def nees_band(degrees, trials):
    """99.9 % band of the mean of `trials` squared normalised errors."""
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], degrees * trials)
    return low / trials, high / trials


def angle(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b))


def check_jacobian(function, x, step=1e-5, tolerance=1e-6):
    """Both modes of a function of one array against central differences."""
    size = x.size
    shifts = step * jnp.eye(size).reshape(size, *x.shape)
    many = jax.jit(jax.vmap(function))
    numeric = np.moveaxis(np.asarray((many(x[None] + shifts) - many(x[None] - shifts)) / (2 * step)), 0, -1)
    for mode in (jax.jacfwd, jax.jacrev):
        jacobian = np.asarray(jax.jit(mode(function))(x))
        np.testing.assert_allclose(jacobian.reshape(numeric.shape), numeric, rtol=tolerance, atol=tolerance)


# Nearest point to rays


def test_two_rays_meet_at_the_midpoint_of_their_perpendicular(dtype):
    centers = jnp.asarray([[0.0, 1.0, 0.0], [0.0, -1.0, 3.0]], dtype)
    bearings = jnp.asarray([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype)
    point = triangulate_rays(centers, bearings)
    np.testing.assert_allclose(point, [0.0, 0.0, 0.0], atol=2e-6)
    np.testing.assert_allclose(ray_distances(point, centers, bearings), 1.0, rtol=1e-6)


@pytest.mark.parametrize("views", [2, 3, 4])
def test_nearest_point_minimises_weighted_squared_distances(views, x64):
    rng = np.random.default_rng(views)
    centers, weights = CENTERS[:views], rng.uniform(0.5, 2.0, size=views)
    bearings = np.asarray(rays_to(np.array([[0, 0, 5.0]]) + rng.normal(size=(1, 3)), centers))[0]
    bearings = bearings + rng.normal(size=bearings.shape) * 0.02
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    # Stack of sqrt(w) (I - b bᵀ) p = sqrt(w) (I - b bᵀ) c.
    projectors = [np.sqrt(w) * (np.eye(3) - np.outer(b, b)) for w, b in zip(weights, bearings, strict=True)]
    right = np.concatenate([p @ c for p, c in zip(projectors, centers, strict=True)])
    expected = np.linalg.lstsq(np.concatenate(projectors), right, rcond=None)[0]
    np.testing.assert_allclose(triangulate_rays(centers, bearings, weights), expected, rtol=1e-9)
    padded = [np.concatenate([a, np.ones_like(a[:1])]) for a in (centers, bearings, weights)]
    masked = triangulate_rays(*padded, mask=np.arange(views + 1) < views)
    np.testing.assert_allclose(masked, expected, rtol=1e-9)


def test_float32_rays_keep_the_depth_of_far_points():
    # 0.2 mrad between the rays: sums of I - b bᵀ in world axes lose it in float32, where 1 - cos is below rounding.
    point = np.array([300.0, -200.0, 5000.0])
    bearings = rays_to(point[None], CENTERS[:2], jnp.float32)[0]
    found = np.asarray(triangulate_rays(jnp.asarray(CENTERS[:2], jnp.float32), bearings))
    assert np.linalg.norm(found - point) < 0.01 * np.linalg.norm(point)


@pytest.mark.slow
@pytest.mark.parametrize("direction", [[0, 0, 1.0], [0.6, 0.0, -0.8], [1.0, 0, 0]])
def test_parallel_rays_meet_far_away_in_their_direction(direction, dtype):
    bearings = jnp.tile(jnp.asarray(direction, dtype)[None, :], (4, 1))
    centers = jnp.asarray(CENTERS, dtype)
    point, jacobians = triangulate_rays(centers, bearings), jax.jacrev(triangulate_rays, (0, 1))(centers, bearings)
    assert 1e5 < float(jnp.linalg.norm(point)) < 1e8
    assert angle(np.asarray(point), direction) < 1e-5
    assert all(jnp.isfinite(j).all() for j in jacobians)


def test_degenerate_rays_are_finite():
    rays = jax.jit(lambda c, b, m: (triangulate_rays(c, b, mask=m), jax.jacrev(triangulate_rays, 1)(c, b)))
    some = rays_to([[0.3, 0.2, 4.0]], CENTERS, jnp.float32)[0]
    opposed = jnp.asarray([[0, 0, 1.0], [0, 0, -1.0], [0, 0, 1.0], [0, 0, -1.0]])
    same_centre = jnp.tile(jnp.asarray([[1.0, 2.0, 3.0]]), (4, 1))
    everything, nothing = np.ones(4, bool), np.zeros(4, bool)
    for inputs in (
        (jnp.asarray(CENTERS, jnp.float32), opposed, everything),
        (jnp.asarray(CENTERS, jnp.float32), some, nothing),
        (jnp.asarray(CENTERS, jnp.float32), jnp.zeros((4, 3)), everything),
        (same_centre, some, everything),
    ):
        point, jacobian = rays(*inputs)
        assert jnp.isfinite(point).all()
        assert jnp.isfinite(jacobian).all()
    np.testing.assert_allclose(point, [1.0, 2.0, 3.0], atol=1e-5)


@pytest.mark.slow
def test_gradient_of_nearest_point_matches_central_differences(x64):
    bearings = rays_to([[0.3, 0.2, 4.0]], CENTERS)[0]
    check_jacobian(lambda x: triangulate_rays(x[:4], x[4:]), jnp.concatenate([jnp.asarray(CENTERS), bearings]))


def test_ray_distance_std_grows_with_noise_where_the_deviation_about_the_mean_is_blind(x64):
    rng = np.random.default_rng(3)
    bearings = np.asarray(rays_to([[0.3, 0.2, 4.0]], CENTERS[:2]))[0]
    qualities = []
    for noise in (0.0, 1e-3, 1e-2):
        noisy = bearings + noise * np.array([[0, 1.0, 0], [0, -1.0, 0]])
        noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
        point = triangulate_rays(CENTERS[:2], noisy)
        qualities.append(float(ray_distance_std(point, CENTERS[:2], noisy)))
        assert float(jnp.std(ray_distances(point, CENTERS[:2], noisy))) < 1e-12
    assert qualities[0] < 1e-12
    np.testing.assert_allclose(qualities[2] / qualities[1], 10.0, rtol=0.05)
    # Over many views of isotropic noise the deviation is what the noise moves a ray at that distance.
    centers = rng.normal(size=(400, 3)) * 0.3
    noisy = np.asarray(rays_to([[0, 0, 4.0]], centers))[0] + rng.normal(size=(400, 3)) * 1e-3
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    point = triangulate_rays(centers, noisy)
    np.testing.assert_allclose(ray_distance_std(point, centers, noisy), 4.0 * 1e-3 * np.sqrt(2), rtol=0.1)


# Null vector and direct linear transform


@pytest.mark.parametrize("rows", [4, 6, 30])
def test_null_vector_agrees_with_numpy_svd(rows, dtype):
    matrices = np.random.default_rng(rows).normal(size=(60, rows, 4))
    matrices[:20, :, 3] *= 1e-3
    matrices[20:40, :, 2] = matrices[20:40, :, 0] + 1e-2 * matrices[20:40, :, 1]
    expected = np.linalg.svd(matrices)[2][:, -1]
    found = np.asarray(jax.jit(jax.vmap(null_vector))(jnp.asarray(matrices, dtype)), float)
    error = np.linalg.norm(found - expected * np.sign(np.sum(found * expected, axis=1, keepdims=True)), axis=1)
    assert error.max() < {jnp.float32: 1e-4, jnp.float64: 1e-12}[dtype]


@pytest.mark.slow
def test_null_vector_derivative_matches_central_differences_and_survives_repeated_values(x64):
    matrix = jnp.asarray(np.random.default_rng(5).normal(size=(6, 4)))
    check_jacobian(null_vector, matrix)
    # The derivative of an SVD is NaN here: the other three singular values are equal.
    check_jacobian(null_vector, jnp.diag(jnp.asarray([2.0, 2.0, 2.0, 1.0])))
    both = jax.jit(lambda m: (null_vector(m), jax.jacrev(null_vector)(m)))
    for degenerate in (jnp.eye(4), jnp.zeros((4, 4)), jnp.ones((4, 4))):
        vector, jacobian = both(degenerate)
        np.testing.assert_allclose(jnp.sum(vector**2), 1.0, rtol=1e-12)
        assert jnp.isfinite(jacobian).all()


def test_dlt_agrees_with_opencv(x64):
    camera = Pinhole(*CAMERA)
    views = poses(views=2)
    points = np.array([0, 0, 5.0]) + np.random.default_rng(6).normal(size=(30, 3))
    pixels = np.asarray(observe(jnp.asarray(points), views, camera))
    pixels = pixels + np.random.default_rng(7).normal(size=pixels.shape)
    projections = np.asarray(projection_matrix(views, camera))
    h = cv2.triangulatePoints(projections[0], projections[1], pixels[:, 0].T.copy(), pixels[:, 1].T.copy()).T
    found = jax.jit(jax.vmap(lambda x: triangulate_dlt(projections, x)))(jnp.asarray(pixels))
    np.testing.assert_allclose(found, h[:, :3] / h[:, 3:], rtol=1e-7)


def test_all_linear_methods_recover_exact_points_with_masked_views(dtype):
    points = np.array([0, 0, 6.0]) + np.random.default_rng(8).normal(size=(10, 3))
    views = poses(dtype)
    coordinates = np.array(observe(jnp.asarray(points, dtype), views, Pinhole(1.0, 1.0, 0.0, 0.0)))
    mask = np.array([True, True, False, True])
    coordinates[:, 2] = 77.0
    projections = projection_matrix(views)
    tolerance = {jnp.float32: 1e-3, jnp.float64: 1e-10}[dtype]
    for method in (triangulate_dlt, triangulate_dlt_inhomogeneous):
        found = jax.jit(jax.vmap(lambda x, method=method: method(projections, x, mask=mask)))(coordinates)
        np.testing.assert_allclose(found, points, rtol=tolerance, atol=tolerance)


def test_w_1_breaks_for_nearly_parallel_rays_where_homogeneous_keeps_the_direction(x64):
    views = poses(views=2)
    projections = projection_matrix(views)
    rng = np.random.default_rng(9)
    directions = rng.normal(size=(200, 3)) * [0.2, 0.2, 0] + [0, 0, 1]
    far = jnp.asarray(directions * 1e5)
    coordinates = np.asarray(observe(far, views, Pinhole(1.0, 1.0, 0.0, 0.0)))
    coordinates = jnp.asarray(coordinates + rng.normal(size=coordinates.shape) * 2e-3)

    def errors(method):
        found = np.asarray(jax.jit(jax.vmap(lambda x: method(projections, x)))(coordinates))
        return np.array([angle(a, b) for a, b in zip(found, directions, strict=True)])

    homogeneous = np.array(errors(lambda p, x: triangulate_dlt_homogeneous(p, x)[:3]))
    assert homogeneous.max() < 0.01
    with_w_1 = errors(triangulate_dlt_inhomogeneous)
    # Noise decides the sign of the depth: the point lands behind the cameras about half of the time.
    assert np.mean(with_w_1 > 3.0) > 0.3


def test_parallel_rays_give_a_finite_far_point_by_dlt():
    views = SE3.exp(jnp.asarray([[0.0] * 6, [-1.0] + [0.0] * 5]))
    projections = projection_matrix(views)
    coordinates = jnp.asarray([[0.1, 0.2], [0.1, 0.2]])
    for method in (triangulate_dlt, triangulate_dlt_inhomogeneous):
        jacobian = jax.jit(jax.jacrev(lambda x, method=method: method(projections, x)))(coordinates)
        assert jnp.isfinite(jacobian).all()
    point = np.asarray(triangulate_dlt(projections, coordinates))
    assert np.linalg.norm(point) > 1e4
    assert angle(point, [0.1, 0.2, 1.0]) < 1e-4
    assert angle(np.asarray(triangulate_dlt_inhomogeneous(projections, coordinates)), [0.1, 0.2, 1.0]) > 0.1


# Rectified stereo


def test_rectified_covariance_is_the_propagated_one_and_covers_monte_carlo_errors(x64):
    stereo = RectifiedStereo(Pinhole(700.0, 710.0, 600.0, 180.0, skew=2.0), baseline=0.5)
    truth = jnp.asarray([2.0, -1.0, 8.0])
    measurement = stereo.project(truth)
    spd = jnp.asarray([[1.0, 0.2, 0.5], [0.2, 0.8, 0.1], [0.5, 0.1, 1.2]]) * 0.04
    jacobian = jax.jacfwd(stereo.unproject)(measurement)
    point, covariance = triangulate_rectified(measurement, stereo, covariance_px=spd)
    np.testing.assert_allclose(point, truth, rtol=1e-10)
    np.testing.assert_allclose(covariance, jacobian @ spd @ jacobian.T, rtol=1e-10)
    _, isotropic = triangulate_rectified(measurement, stereo, 0.3)
    np.testing.assert_allclose(isotropic, 0.09 * jacobian @ jacobian.T, rtol=1e-10)
    np.testing.assert_allclose(isotropic[2, 2] ** 0.5, 2**0.5 * 0.3 * 64.0 / (700 * 0.5), rtol=1e-10)

    trials = 2000
    noise = np.random.default_rng(10).multivariate_normal(np.zeros(3), np.asarray(spd), size=trials)
    points, covariances = jax.jit(jax.vmap(lambda m: triangulate_rectified(m, stereo, covariance_px=spd)))(
        measurement[None, :] + noise
    )
    errors = np.asarray(points - truth[None, :])
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors).mean()
    low, high = nees_band(3, trials)
    assert low < nees < high


def test_rectified_point_without_disparity_is_far_with_a_vast_finite_covariance():
    stereo = RectifiedStereo(Pinhole(700.0, 700.0, 600.0, 180.0), baseline=0.5)
    for u_right in (650.0, 660.0):
        measurement = jnp.asarray([650.0, 100.0, u_right])
        point, covariance = triangulate_rectified(measurement, stereo)
        assert jnp.isfinite(point).all()
        assert jnp.isfinite(covariance).all()
        assert float(covariance[2, 2]) > float(point[2]) ** 2
        jacobians = jax.jacrev(lambda m: triangulate_rectified(m, stereo))(measurement)
        assert all(jnp.isfinite(j).all() for j in jacobians)


# Refinement


def refine(camera, views, sigma_px=1.0, **kwargs):
    return jax.jit(jax.vmap(lambda p, x: triangulate_refine(p, x, camera, views, sigma_px, **kwargs)))


def test_refined_points_are_scipys_optimum_from_rough_starts(x64):
    camera = BrownConrady(*CAMERA, -0.2, 0.05, 1e-3, -1e-3, 0.0)
    views = poses()
    rng = np.random.default_rng(11)
    truth = rng.normal(size=(20, 3)) * [1, 1, 2] + [0, 0, 7]
    pixels = np.asarray(observe(jnp.asarray(truth), views, camera))
    pixels = pixels + rng.normal(size=pixels.shape)
    found = refine(camera, views)(jnp.asarray(truth * 1.5), jnp.asarray(pixels))
    assert bool(found.valid.all())
    residuals = jax.jit(lambda p, x: (jax.vmap(lambda pose: camera.project(pose.apply(p)))(views) - x).ravel())
    jacobian = jax.jit(jax.jacfwd(residuals))
    for i in range(len(truth)):
        best = scipy.optimize.least_squares(
            lambda p, x: np.asarray(residuals(p, x)),
            truth[i],
            lambda p, x: np.asarray(jacobian(p, x)),
            args=(pixels[i],),
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-12,
        )
        np.testing.assert_allclose(found.point[i], best.x, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found.covariance[i], np.linalg.inv(best.jac.T @ best.jac), rtol=1e-4)
        np.testing.assert_allclose(found.rms_px[i], np.sqrt(2 * best.cost / 4), rtol=1e-6)


def test_refined_covariance_covers_monte_carlo_errors():
    camera, views, sigma = Pinhole(*CAMERA), poses(jnp.float32), np.array([0.3, 0.5, 0.4, 0.6], np.float32)
    truth = jnp.asarray([0.5, -0.4, 4.0], jnp.float32)
    trials = 2000
    noise = np.random.default_rng(12).normal(size=(trials, 4, 2)) * sigma[:, None]
    pixels = observe(truth[None, :], views, camera) + jnp.asarray(noise, jnp.float32)
    found = refine(camera, views, jnp.asarray(sigma))(jnp.tile(1.3 * truth[None, :], (trials, 1)), pixels)
    errors = np.asarray(found.point - truth[None, :], float)
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(np.asarray(found.covariance, float)), errors).mean()
    low, high = nees_band(3, trials)
    assert low < nees < high
    assert bool(found.valid.all())


@pytest.mark.slow
def test_masked_views_do_not_count_and_cameras_may_differ_per_view(x64):
    cameras = [
        Pinhole(*CAMERA),
        Pinhole(800.0, 790.0, 400.0, 300.0),
        Pinhole(*CAMERA),
        Pinhole(300.0, 300.0, 160.0, 120.0),
    ]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    views = poses()
    truth = jnp.asarray([0.5, -0.4, 4.0])
    pixels = jnp.stack([camera.project(SE3(views.wxyz_xyz[i]).apply(truth)) for i, camera in enumerate(cameras)])
    mask = jnp.asarray([False, True, False, True])
    garbage = pixels.at[jnp.asarray([0, 2])].set(-1e4)
    found = jax.jit(lambda x, m: triangulate_refine(1.4 * truth, x, stack, views, mask=m))(garbage, mask)
    np.testing.assert_allclose(found.point, truth, atol=1e-8)
    assert bool(found.valid)
    behind = SE3(views.wxyz_xyz.at[2].set(SE3.exp(jnp.asarray([0.0, 0.0, -9.0, 0.0, 0.0, 0.0])).wxyz_xyz))
    seen = jax.jit(lambda m: triangulate_refine(truth, pixels, stack, behind, mask=m).valid)
    assert bool(seen(mask))
    assert not bool(seen(jnp.ones(4, bool)))


def test_gradient_of_the_optimum_matches_central_differences(x64):
    camera, views = Pinhole(*CAMERA), poses(views=3)
    truth = jnp.asarray([0.5, -0.4, 3.0])
    # Large residuals: with the Gauss-Newton matrix in place of the exact Hessian this test fails.
    pixels = observe(truth[None, :], views, camera)[0] + np.random.default_rng(13).normal(size=(3, 2)) * 10
    many = TriangulationOptions(steps=40)

    def point(pixels, fx, tangents):
        moved = SE3.exp(tangents) @ views
        return triangulate_refine(truth, pixels, Pinhole(fx, *CAMERA[1:]), moved, options=many).point

    inputs = (pixels, jnp.asarray(500.0), jnp.zeros((3, 6)))
    forward = jax.jit(jax.jacfwd(point, (0, 1, 2)))(*inputs)
    np.testing.assert_allclose(jax.jit(jax.jacrev(point))(*inputs), forward[0], rtol=1e-8, atol=1e-12)
    jitted = jax.jit(point)
    for i, step in enumerate((1e-2, 1e-2, 1e-4)):
        flat = np.asarray(inputs[i]).reshape(-1)
        for j in range(0, flat.size, 5):
            plus, minus = (
                jitted(
                    *inputs[:i], (flat + sign * step * np.eye(flat.size)[j]).reshape(inputs[i].shape), *inputs[i + 1 :]
                )
                for sign in (1, -1)
            )
            numeric = (plus - minus) / (2 * step)
            np.testing.assert_allclose(forward[i].reshape(3, -1)[:, j], numeric, rtol=1e-5, atol=1e-8)


def test_degenerate_refinements_are_finite_and_not_valid():
    camera = Pinhole(*CAMERA)
    views = SE3.exp(jnp.asarray([[0.0] * 6, [-1.0] + [0.0] * 5], jnp.float32))
    same_place = SE3.identity((2,), jnp.float32)
    middle, left, right = (jnp.asarray([u, 240.0]) for u in (320.0, 310.0, 330.0))
    ahead, origin = jnp.asarray([0.0, 0.0, 5.0]), jnp.zeros(3)
    both, one, none = (jnp.asarray(m) for m in ([True, True], [False, True], [False, False]))

    def summary(start, pixels, views, mask):
        return triangulate_refine(start, pixels, camera, views, mask=mask)

    run = jax.jit(lambda *a: (summary(*a), jax.jacrev(lambda x: summary(a[0], x, *a[2:]).point)(a[1])))
    cases = {
        "parallel": (ahead, jnp.stack([middle, middle]), views, both),
        "diverging": (ahead, jnp.stack([left, right]), views, both),
        "no baseline": (ahead, jnp.stack([middle, left]), same_place, both),
        "one view": (ahead, jnp.stack([right, left]), views, one),
        "no view": (ahead, jnp.stack([right, left]), views, none),
        "start at a camera, diverging": (origin, jnp.stack([left, right]), views, both),
    }
    for name, case in cases.items():
        found, jacobian = run(*case)
        assert not bool(found.valid), name
        for leaf in (*jax.tree.leaves(found), jacobian):
            assert jnp.isfinite(leaf).all(), name
    parallel = np.asarray(run(*cases["parallel"])[0].point)
    assert np.linalg.norm(parallel) > 1e4
    assert angle(parallel, [0, 0, 1.0]) < 1e-3
    # The same two views of a point with parallax are accepted.
    good, _ = run(ahead, jnp.stack([right, left]), views, both)
    assert bool(good.valid)


@pytest.mark.slow
def test_uncertain_points_and_small_angles_are_flagged():
    camera = Pinhole(*CAMERA)
    views = poses(jnp.float32, views=2)
    point = jnp.asarray([0.0, 0.0, 30.0])
    pixels = observe(point[None, :], views, camera)[0]

    def judge(**options):
        options = TriangulationOptions(**options)
        return jax.jit(lambda sigma: triangulate_refine(point, pixels, camera, views, sigma, options=options).valid)

    usual = judge()
    assert bool(usual(0.1))
    # One unit of baseline at a depth of 30: σ = 5 px is σ_z = √2 · 5 · 30² / 500 = 13.
    assert not bool(usual(5.0))
    assert bool(judge(max_relative_std=2.0)(5.0))
    assert not bool(judge(min_angle_rad=0.05)(0.1))
