"""Calibration without a board: known scenes, vanishing points, two images."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3, SO3, Result
from vojax.calibration import (
    calibrate_from_scene,
    calibrate_from_vanishing_points,
    estimate_shared_focal,
    vanishing_point,
)
from vojax.cameras import Pinhole

CAMERA = (620.0, 610.0, 315.0, 250.0)


def scene(seed, n=40):
    rng = np.random.default_rng(seed)
    pose = SE3.exp(jnp.asarray([0.3, -0.2, 6.0, 0.2, -0.3, 0.1]))
    points = rng.uniform(-2, 2, size=(n, 3))
    pixels = Pinhole(*CAMERA).project(pose.apply(jnp.asarray(points)))
    return points, np.asarray(pixels), pose, rng


def test_a_known_scene_gives_camera_and_pose(x64):
    points, pixels, pose, rng = scene(0)
    found = calibrate_from_scene(points, pixels + 0.3 * rng.normal(size=pixels.shape))
    assert found.result == Result.success
    assert found.names == ("fx", "fy", "cx", "cy")
    values = np.array([float(getattr(found.camera, name)) for name in found.names])
    assert np.abs((values - CAMERA) / np.asarray(found.standard_deviations())).max() < 4.0
    error = (found.cam_from_world @ pose.inverse()).log()
    assert float(error @ jnp.linalg.solve(found.pose_covariance, error)) < 30.0
    assert float(found.sigma_px) == pytest.approx(0.3, abs=0.1)
    # A plane determines no camera.
    flat = points * [1.0, 1.0, 0.0]
    image = np.asarray(Pinhole(*CAMERA).project(pose.apply(jnp.asarray(flat))))
    lost = calibrate_from_scene(flat, image)
    assert lost.result == Result.degenerate
    assert np.isfinite(np.asarray(lost.residuals)).all()


def test_a_scene_of_five_points_is_refused():
    with pytest.raises(ValueError, match="found 5 points; expected at least 6"):
        calibrate_from_scene(np.zeros((5, 3)), np.zeros((5, 2)))


def vanishing(rotation, focal, centre):
    k = jnp.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    return (k @ rotation.as_matrix()).T


def test_orthogonal_vanishing_points_give_focal_length_and_rotation(x64):
    rng = np.random.default_rng(1)
    for _ in range(20):
        rotation = SO3.exp(jnp.asarray(rng.uniform(-0.5, 0.5, 3)) + jnp.array([0.4, -0.6, 0.1]))
        points = vanishing(rotation, 700.0, (330.0, 236.0)) * jnp.asarray(rng.uniform(0.5, 2.0, (3, 1)))
        for given in (points, points[:2]):
            centre = None if len(given) == 3 else jnp.array([330.0, 236.0])
            found = calibrate_from_vanishing_points(given, centre)
            assert bool(found.valid)
            assert float(found.focal) == pytest.approx(700.0, rel=1e-8)
            np.testing.assert_allclose(np.asarray(found.principal_point), [330.0, 236.0], rtol=1e-8)
            # Columns up to sign: x and y look ahead.
            columns = np.asarray(found.cam_from_world.as_matrix())
            np.testing.assert_allclose(np.abs((columns * np.asarray(rotation.as_matrix())).sum(0)), 1.0, atol=1e-9)
            assert np.linalg.det(columns) == pytest.approx(1.0)


def test_vanishing_points_of_no_camera_are_not_valid(x64):
    acute = jnp.array([[100.0, 0.0, 1.0], [120.0, 10.0, 1.0]])
    parallel = jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for points in (acute, parallel, acute * jnp.nan):
        found = calibrate_from_vanishing_points(points, jnp.zeros(2))
        assert not bool(found.valid)
        assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(found))
        slope = jax.grad(lambda p: calibrate_from_vanishing_points(p, jnp.zeros(2)).focal)(points)
        assert np.isfinite(np.asarray(slope)).all()
    with pytest.raises(ValueError, match="two vanishing points and no principal point"):
        calibrate_from_vanishing_points(acute)
    with pytest.raises(ValueError, match="expected \\[2, 3\\] or \\[3, 3\\]"):
        inspect.unwrap(calibrate_from_vanishing_points)(np.zeros((4, 3)))


def test_lines_meet_in_their_vanishing_point(x64):
    rng = np.random.default_rng(2)
    target = np.array([900.0, -150.0])
    ends = rng.uniform(0, 500, size=(12, 2))
    far = ends + rng.uniform(0.1, 0.5, size=(12, 1)) * (target - ends)
    point, valid = vanishing_point(np.stack([ends, far], axis=1))
    assert bool(valid)
    np.testing.assert_allclose(np.asarray(point[:2] / point[2]), target, rtol=1e-9)
    # Parallel lines meet at infinity.
    point, valid = vanishing_point(np.stack([ends, ends + np.array([30.0, 40.0])], axis=1))
    assert bool(valid)
    assert abs(float(point[2])) < 1e-12
    np.testing.assert_allclose(np.abs(np.asarray(point[:2])), [0.6, 0.8], rtol=1e-9)
    _, valid = vanishing_point(np.tile(np.array([[[0.0, 0.0], [10.0, 0.0]]]), (3, 1, 1)))
    assert not bool(valid)


@pytest.mark.slow
def test_a_shared_focal_length_from_two_images_with_wrong_matches(x64):
    rng = np.random.default_rng(4)
    camera = Pinhole(fx=600.0, fy=600.0, cx=320.0, cy=240.0)
    points = jnp.asarray(rng.uniform([-3, -3, 5], [3, 3, 11], size=(200, 3)))
    cam1_from_cam0 = SE3.exp(jnp.array([-1.5, 0.4, 0.9, 0.25, 0.35, 0.1]))
    pixels = [np.asarray(camera.project(p)) for p in (points, cam1_from_cam0.apply(points))]
    pixels = [p + 0.2 * rng.normal(size=p.shape) for p in pixels]
    pixels[1][:40] += rng.uniform(20, 200, size=(40, 2))
    centre = jnp.array([320.0, 240.0])
    found = estimate_shared_focal(*pixels, centre, centre, key=jax.random.key(0), sigma_px=0.2)
    assert bool(found.valid)
    assert int(found.fundamental.num_inliers) >= 150
    assert 0.0 < float(found.standard_deviation) < 60.0
    assert abs(float(found.focal) - 600.0) < 4 * float(found.standard_deviation)
