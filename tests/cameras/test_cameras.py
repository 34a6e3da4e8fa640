"""Pinhole and Brown-Conrady against OpenCV, their own inverses and central differences."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.cameras import BrownConrady, Camera, Pinhole, RectifiedStereo

# fx, fy, cx, cy, k1, k2, p1, p2, k3 and the image size, as the data sets publish them.
LENSES = {
    "euroc": (
        (458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0),
        (752, 480),
    ),
    "tum_fr1": ((517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633), (640, 480)),
    "kitti_raw": (
        (959.79, 956.93, 696.02, 224.18, -0.3691481, 0.1968681, 0.001353473, 0.000567759, -0.06770705),
        (1392, 512),
    ),
}


# Compiled once per shape: run eagerly, the tests would compile each operation on its own.
project = jax.jit(lambda camera, points: camera.project(points))
unproject = jax.jit(lambda camera, pixels: camera.unproject(pixels))
normalized = jax.jit(lambda camera, pixels: camera.normalized(pixels))


def lens(name, dtype=None):
    parameters, size = LENSES[name]
    camera = BrownConrady(*parameters)
    return (camera if dtype is None else jax.tree.map(lambda leaf: leaf.astype(dtype), camera)), size


def pixel_grid(size, dtype):
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, 25), np.linspace(0, size[1] - 1, 17))
    return jnp.asarray(np.stack([u, v], axis=-1), dtype)


def matrix_and_coefficients(name):
    fx, fy, cx, cy, *coefficients = LENSES[name][0]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(coefficients)


def test_pinhole_projects_by_its_matrix(dtype):
    camera = Pinhole(fx=500, fy=480.0, cx=np.float64(320.0), cy=240.0, skew=3.0)
    assert camera.fx.dtype == dtype
    points = np.random.default_rng(0).normal(size=(4, 5, 3)) + np.array([0, 0, 4.0])
    expected = points @ np.array([[500, 3, 320], [0, 480, 240], [0, 0, 1.0]]).T
    expected = expected[..., :2] / expected[..., 2:]
    tolerance = {jnp.float32: 1e-3, jnp.float64: 1e-10}[dtype]
    np.testing.assert_allclose(project(camera, jnp.asarray(points, dtype)), expected, atol=tolerance)
    np.testing.assert_allclose(camera.matrix() @ jnp.asarray([0.1, 0.2, 1.0], dtype), [370.6, 336.0, 1.0], rtol=1e-6)


def test_parameters_keep_the_dtype_they_come_with(x64):
    camera = Pinhole(fx=np.float32(500), fy=jnp.asarray(500, jnp.float32), cx=320.0, cy=240)
    assert (camera.fx.dtype, camera.fy.dtype) == (jnp.float32, jnp.float32)
    assert (camera.cx.dtype, camera.cy.dtype, camera.skew.dtype) == (jnp.float64,) * 3
    assert not camera.cx.weak_type


@pytest.mark.parametrize("name", LENSES)
def test_projection_agrees_with_opencv(name, x64):
    camera, _ = lens(name)
    points = np.random.default_rng(1).normal(size=(200, 3)) * [0.8, 0.6, 0.3] + [0, 0, 2.5]
    matrix, coefficients = matrix_and_coefficients(name)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    np.testing.assert_allclose(project(camera, points), expected[:, 0], rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_undistortion_agrees_with_opencv_and_inverts_projection(name, x64):
    camera, size = lens(name)
    pixels = pixel_grid(size, jnp.float64)
    matrix, coefficients = matrix_and_coefficients(name)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    flat = np.asarray(pixels).reshape(-1, 1, 2)
    expected = cv2.undistortPoints(flat, matrix, coefficients, None, None, None, criteria)
    np.testing.assert_allclose(normalized(camera, pixels).reshape(-1, 2), expected[:, 0], atol=1e-8)
    bearings = unproject(camera, pixels)
    np.testing.assert_allclose(jnp.sum(bearings**2, axis=-1), 1.0, atol=1e-14)
    np.testing.assert_allclose(project(camera, bearings), pixels, atol=1e-10)


@pytest.mark.parametrize("name", LENSES)
def test_float32_inverse_stays_within_a_thousandth_of_a_pixel(name):
    camera, size = lens(name)
    pixels = pixel_grid(size, jnp.float32)
    error = jnp.abs(project(camera, unproject(camera, pixels)) - pixels)
    assert error.dtype == jnp.float32
    assert float(error.max()) < 1e-3


@jax.jit
def bearing(inputs):
    """Bearing of a pixel as a function of [u, v, the nine parameters]."""
    return BrownConrady(*inputs[2:]).unproject(inputs[:2])


bearing_forward, bearing_reverse = jax.jit(jax.jacfwd(bearing)), jax.jit(jax.jacrev(bearing))


@pytest.mark.parametrize("name", LENSES)
def test_implicit_derivative_of_unproject_matches_central_differences(name, x64):
    camera, size = lens(name)
    parameters = jnp.stack(jax.tree.leaves(camera))
    pixel = jnp.asarray([0.9 * size[0], 0.1 * size[1]])

    inputs = jnp.concatenate([pixel, parameters])
    forward, reverse = bearing_forward(inputs), bearing_reverse(inputs)
    np.testing.assert_allclose(forward, reverse, atol=1e-12)
    steps = jnp.where(jnp.arange(11) < 6, 1e-3, 1e-6)
    numeric = jnp.stack(
        [
            (bearing(inputs.at[i].add(steps[i])) - bearing(inputs.at[i].add(-steps[i]))) / (2 * steps[i])
            for i in range(11)
        ],
        axis=1,
    )
    np.testing.assert_allclose(forward, numeric, rtol=1e-5, atol=1e-8)


def test_both_modes_of_unproject_work_under_vmap(x64):
    camera, size = lens("euroc")
    pixels = pixel_grid(size, jnp.float64).reshape(-1, 2)[::20]
    forward = jax.jit(jax.vmap(jax.jacfwd(lambda x: camera.unproject(x))))(pixels)
    reverse = jax.jit(jax.vmap(jax.jacrev(lambda x: camera.unproject(x))))(pixels)
    loop = jnp.stack([jax.jit(jax.jacfwd(lambda x: camera.unproject(x)))(pixel) for pixel in pixels[:3]])
    np.testing.assert_allclose(forward, reverse, atol=1e-14)
    np.testing.assert_allclose(forward[:3], loop, atol=1e-14)


def test_second_derivative_of_normalized_matches_differences_of_the_first(x64):
    camera, _ = lens("kitti_raw")
    pixel = jnp.asarray([1200.0, 60.0])
    first = jax.jit(jax.jacfwd(lambda x: camera.normalized(x)))
    second = jax.jit(jax.jacfwd(first))(pixel)
    numeric = jnp.stack(
        [(first(pixel.at[i].add(0.01)) - first(pixel.at[i].add(-0.01))) / 0.02 for i in range(2)], axis=-1
    )
    np.testing.assert_allclose(second, numeric, rtol=1e-5, atol=1e-13)


@pytest.mark.parametrize("name", ["pinhole", *LENSES])
def test_degenerate_points_stay_finite_in_value_and_gradient(name):
    camera = Pinhole(500.0, 500.0, 320.0, 240.0) if name == "pinhole" else lens(name)[0]
    points = jnp.asarray(
        [[0, 0, 0], [1, -2, 0], [1, 1, -2], [0, 0, -1], [1, 0, 1e-12], [30, 30, 1e-6], [1e4, 1e4, 1e-3], [3, 4, 1e-45]],
        jnp.float32,
    )
    jacobians = jax.jit(jax.vmap(jax.jacfwd(lambda x: camera.project(x))))(points)
    assert jnp.isfinite(project(camera, points)).all()
    assert jnp.isfinite(jacobians).all()
    # Solvers square them before a mask can drop them.
    assert jnp.isfinite(jnp.sum(jacobians**2, axis=(1, 2))).all()
    by_parameter = jax.jit(jax.jacrev(lambda camera: camera.project(points)))(camera)
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(by_parameter))


@pytest.mark.parametrize("name", LENSES)
def test_pixels_that_no_ray_reaches_stay_finite_in_value_and_gradient(name):
    camera, _ = lens(name)
    pixels = jnp.asarray([[-4000.0, 100.0], [5000.0, 5000.0], [1e6, -1e6], [300.0, 1e8]], jnp.float32)
    bearings, jacobians = (
        unproject(camera, pixels),
        jax.jit(jax.vmap(jax.jacrev(lambda x: camera.unproject(x))))(pixels),
    )
    assert jnp.isfinite(bearings).all()
    assert jnp.isfinite(jacobians).all()
    np.testing.assert_allclose(jnp.sum(bearings**2, axis=1), 1.0, rtol=1e-5)


def test_unreachable_pixels_have_no_gradient():
    # x_d = x (1 - r²/4) has its maximum 2/3 · √(4/3) = 0.7698 at r = √(4/3).
    camera = BrownConrady(fx=100.0, fy=100.0, cx=0.0, cy=0.0, k1=-0.25)
    inside, outside = jnp.asarray([60.0, 0.0]), jnp.asarray([90.0, 0.0])
    jacobian = jax.jit(jax.jacfwd(lambda x: camera.normalized(x)))
    assert float(jnp.abs(jacobian(outside)).max()) == 0.0
    assert float(jnp.abs(jacobian(inside)).max()) > 0.0
    assert float(normalized(camera, inside)[0]) < (4 / 3) ** 0.5


def test_elementwise_projection_accepts_any_shape(dtype):
    x, y, z = (jnp.asarray(np.random.default_rng(2).normal(size=(2, 3, 4)) + k, dtype) for k in (0, 0, 5))
    for camera in (Pinhole(500.0, 500.0, 320.0, 240.0), lens("euroc", dtype)[0]):
        u, v = eqx.filter_jit(camera.project_xyz)(x, y, z)
        assert u.shape == v.shape == x.shape
        assert u.dtype == dtype
        np.testing.assert_array_equal(jnp.stack([u, v], axis=-1), project(camera, jnp.stack([x, y, z], axis=-1)))


def test_cameras_satisfy_the_protocol_and_map_over_a_stack():
    cameras = [Pinhole(500.0, 500.0, 320.0, 240.0), Pinhole(600.0, 610.0, 310.0, 230.0)]
    assert all(isinstance(camera, Camera) for camera in [*cameras, lens("euroc")[0]])
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    point = jnp.asarray([0.1, 0.2, 2.0])
    pixels = eqx.filter_vmap(lambda camera: camera.project(point))(stack)
    np.testing.assert_allclose(pixels, jnp.stack([project(camera, point) for camera in cameras]), rtol=1e-6)


def test_stereo_measures_depth_by_disparity_and_inverts(dtype):
    stereo = RectifiedStereo(Pinhole(700.0, 710.0, 600.0, 180.0, skew=2.0), baseline=0.54)
    points = jnp.asarray(np.random.default_rng(3).normal(size=(50, 3)) * [3, 1, 4] + [0, 0, 20], dtype)
    measurements = stereo.project(points)
    np.testing.assert_allclose(measurements[:, 0] - measurements[:, 2], 700 * 0.54 / points[:, 2], rtol=1e-3)
    right = Pinhole(700.0, 710.0, 600.0, 180.0, skew=2.0).project(points - jnp.asarray([[0.54, 0, 0]], dtype))
    np.testing.assert_allclose(measurements[:, 1:], right[:, ::-1], rtol=1e-6)
    np.testing.assert_allclose(
        stereo.unproject(measurements), points, rtol={jnp.float32: 2e-4, jnp.float64: 1e-11}[dtype]
    )


def test_stereo_without_disparity_is_far_and_finite():
    stereo = RectifiedStereo(Pinhole(700.0, 700.0, 600.0, 180.0), baseline=0.5)
    measurements = jnp.asarray([[650.0, 100.0, 650.0], [650.0, 100.0, 655.0]])
    points, jacobians = jax.jit(lambda m: (stereo.unproject(m), jax.vmap(jax.jacrev(stereo.unproject))(m)))(
        measurements
    )
    np.testing.assert_allclose(points[:, 2], 700 * 0.5 / 1e-3, rtol=1e-5)
    assert jnp.isfinite(jacobians).all()
    assert jnp.isfinite(stereo.project(jnp.zeros((1, 3)))).all()
