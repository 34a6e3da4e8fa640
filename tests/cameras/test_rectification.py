"""Rectification against OpenCV's, and by what it is for: equal rows, and disparities that measure depth."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.cameras import BrownConrady, DoubleSphere, KannalaBrandt, Pinhole, Scaramuzza, rectification_maps
from vojax.lie import SE3

SIZE = (752, 480)
LEFT = (458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0)
RIGHT = (457.587, 456.134, 379.999, 255.238, -0.28368365, 0.07451284, -0.00010473, -3.555907e-05, 0.0)


def pose(rotation_vector, translation):
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.array(rotation_vector))[0]
    matrix[:3, 3] = translation
    return SE3.from_matrix(jnp.asarray(matrix)), matrix


def matrix_of(parameters):
    return np.array([[parameters[0], 0, parameters[2]], [0, parameters[1], parameters[3]], [0, 0, 1.0]])


def test_rotations_and_maps_are_opencvs(x64):
    cam1_from_cam0, matrix = pose([0.02, -0.015, 0.03], [-0.11, 0.004, -0.01])
    k0, k1, d0, d1 = matrix_of(LEFT), matrix_of(RIGHT), np.array(LEFT[4:]), np.array(RIGHT[4:])
    r0, r1, p0, p1, *_ = cv2.stereoRectify(k0, d0, k1, d1, SIZE, matrix[:3, :3], matrix[:3, 3:], alpha=0)
    rectified = Pinhole(p0[0, 0], p0[1, 1], p0[0, 2], p0[1, 2])
    pair = rectification_maps(BrownConrady(*LEFT), BrownConrady(*RIGHT), cam1_from_cam0, SIZE, rectified=rectified)
    np.testing.assert_allclose(pair.rect_from_cam.as_matrix(), np.stack([r0, r1]), atol=1e-12)
    assert abs(float(pair.stereo.baseline) - (-p1[0, 3] / p1[0, 0])) < 1e-12
    for i, (k, d, r) in enumerate([(k0, d0, r0), (k1, d1, r1)]):
        u, v = cv2.initUndistortRectifyMap(k, d, r, p0[:, :3], SIZE, cv2.CV_32FC1)
        # OpenCV's maps are float32.
        np.testing.assert_allclose(pair.maps[i], np.stack([u, v], axis=-1), atol=1e-4)
        inside = (u > 0) & (u < SIZE[0] - 1) & (v > 0) & (v < SIZE[1] - 1)
        assert (np.asarray(pair.valid[i])[inside]).all()
        assert np.mean(np.asarray(pair.valid[i]) != inside) < 1e-3


def test_fisheye_maps_are_opencvs(x64):
    parameters = (190.98, 190.97, 254.9, 256.9, 3.5e-3, 7e-4, -2.05e-3, 2.03e-4)
    cam1_from_cam0, _ = pose([0.01, -0.02, 0.03], [-0.1, 0.0, 0.0])
    rectified = Pinhole(150.0, 150.0, 127.5, 127.5)
    camera = KannalaBrandt(*parameters)
    pair = rectification_maps(
        camera, camera, cam1_from_cam0, (512, 512), rectified=rectified, rectified_size=(256, 256)
    )
    for i, rotation in enumerate(np.asarray(pair.rect_from_cam.as_matrix())):
        u, v = cv2.fisheye.initUndistortRectifyMap(
            matrix_of(parameters),
            np.array(parameters[4:]),
            rotation,
            np.asarray(rectified.matrix()),
            (256, 256),
            cv2.CV_32FC1,
        )
        np.testing.assert_allclose(pair.maps[i], np.stack([u, v], axis=-1), atol=1e-3)
    assert pair.valid.all()


def test_two_different_models_see_a_point_in_one_row_and_measure_its_depth(x64):
    # A double sphere beside Scaramuzza's polynomial, whose half angles of view are more than 90 degrees.
    left = DoubleSphere(351.0, 350.0, 365.9, 249.3, -0.2385, 0.5679)
    right = Scaramuzza(370.0, 240.0, 260.0, -9e-4, 4e-7, -1.4e-9, 1.0004, 2e-4, -3e-4)
    cam1_from_cam0, matrix = pose([0.05, -0.1, 0.08], [-0.3, 0.02, 0.05])
    pair = jax.jit(lambda pose: rectification_maps(left, right, pose, SIZE))(cam1_from_cam0)
    points = np.random.default_rng(0).normal(size=(200, 3)) * [1.0, 0.7, 1.0] + [0, 0, 4.0]
    rectified = np.asarray(pair.rect_from_cam.as_matrix())
    seen = []
    for rotation, camera, points_cam in (
        (rectified[0], left, points),
        (rectified[1], right, points @ matrix[:3, :3].T + matrix[:3, 3]),
    ):
        bearings = np.asarray(camera.unproject(camera.project(points_cam)))
        seen.append(np.asarray(pair.stereo.camera.project(bearings @ rotation.T)))
    np.testing.assert_allclose(seen[0][:, 1], seen[1][:, 1], atol=1e-7)
    measured = pair.stereo.unproject(np.column_stack([seen[0], seen[1][:, 0]]))
    np.testing.assert_allclose(measured, points @ rectified[0].T, atol=1e-7)
    # The maps hold the pixel that looks along the rectified ray, and the middle of both views is the middle.
    middle = pair.stereo.camera.unproject(jnp.asarray([375.0, 239.0]))
    np.testing.assert_allclose(pair.maps[0, 239, 375], left.project(rectified[0].T @ middle), atol=1e-7)
    assert pair.valid[:, 239, 375].all()
    assert pair.maps.shape == (2, 480, 752, 2)


def test_what_lies_beyond_the_images_is_masked(x64):
    camera = Pinhole(400.0, 400.0, 375.5, 239.5)
    cam1_from_cam0, _ = pose([0.0, 0.3, 0.0], [-0.3, 0.0, 0.0])
    pair = rectification_maps(camera, camera, cam1_from_cam0, SIZE)
    maps, valid = np.asarray(pair.maps), np.asarray(pair.valid)
    inside = ((maps >= 0) & (maps <= [SIZE[0] - 1, SIZE[1] - 1])).all(axis=-1)
    np.testing.assert_array_equal(valid, inside)
    assert 0.5 < valid.mean() < 0.99


def test_gradients_stay_finite_without_a_rotation(x64):
    camera = BrownConrady(*LEFT)
    aligned = SE3(jnp.asarray([1.0, 0, 0, 0, -0.1, 0, 0]))

    @jax.jit
    def moved(parameters):
        pair = rectification_maps(camera, camera, SE3(parameters), (32, 24))
        return jnp.sum(pair.maps), pair.maps

    gradient, maps = jax.grad(moved, has_aux=True)(aligned.wxyz_xyz)
    assert np.isfinite(gradient).all()
    assert np.isfinite(maps).all()


@pytest.mark.parametrize(
    ("translation", "size", "expected"),
    [
        ([0.1, 0.0, 0.0], SIZE, "expected it on the right"),
        ([-0.05, -0.1, 0.0], SIZE, "expected it on the right"),
        ([-0.1, 0.0, 0.0], (752, 0), "both positive"),
    ],
)
def test_bad_input_is_refused(translation, size, expected):
    camera = Pinhole(400.0, 400.0, 375.5, 239.5)
    beside = SE3(jnp.asarray([1.0, 0, 0, 0, *translation], jnp.float32))
    with pytest.raises(ValueError, match=expected):
        rectification_maps(camera, camera, beside, size)
