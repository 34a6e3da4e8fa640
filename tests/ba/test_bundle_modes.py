"""Structure-only and motion-only adjustment, against the solvers for one landmark and for one camera."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3, Result
from vojax.ba import LMOptions, adjust_bundle, bundle_covariance, bundle_problem, refine_absolute_pose
from vojax.cameras import Pinhole
from vojax.geometry import TriangulationOptions, triangulate_refine

C, P = 3, 12
CAMERA = Pinhole(fx=400.0, fy=400.0, cx=320.0, cy=240.0)
TIGHT = LMOptions(max_steps=60, tolerance=1e-18)
adjust = eqx.filter_jit(adjust_bundle)


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        xi = 0.05 * rng.normal(size=(C, 6))
        xi[:, 0] += 0.8 * np.arange(C)
        poses = SE3.exp(jnp.asarray(xi)).inverse()
        points = rng.uniform([-2, -2, 4], [3, 2, 9], size=(P, 3))
        frame, seen = (index.ravel() for index in np.indices((C, P)))
        pixels = CAMERA.project(SE3(poses.wxyz_xyz[frame]).apply(jnp.asarray(points[seen])))
        return poses, points, np.asarray(pixels) + 0.5 * rng.normal(size=(C * P, 2)), frame, seen


@pytest.mark.slow
def test_structure_only_is_triangulation(scene, x64):
    poses, points, pixels, frame, seen = scene
    problem = bundle_problem(
        poses, points + 0.1, pixels, frame, seen, CAMERA, sigma_px=0.5, fixed_cameras=np.ones(C, bool)
    )
    assert problem.layout.unknowns == 0
    found = adjust(problem, options=TIGHT)
    assert found.result == Result.success
    np.testing.assert_array_equal(found.cam_from_world.wxyz_xyz, problem.cam_from_world.wxyz_xyz)
    covariance = bundle_covariance(problem, found.cam_from_world, found.landmarks, CAMERA)
    options = TriangulationOptions(steps=20)
    for j in (0, 7):
        expected = triangulate_refine(
            jnp.asarray(points[j]), pixels.reshape(C, P, 2)[:, j], CAMERA, poses, 0.5, options=options
        )
        np.testing.assert_allclose(found.landmarks[j], expected.point, atol=1e-8)
        scale = float(jnp.abs(expected.covariance).max())
        np.testing.assert_allclose(covariance.landmark(j), expected.covariance, atol=1e-6 * scale)


@pytest.mark.slow
def test_motion_only_is_pose_refinement(scene, x64):
    poses, points, pixels, frame, seen = scene
    moved = SE3.exp(0.02 * jnp.asarray(np.random.default_rng(1).normal(size=(C, 6)))) @ poses
    problem = bundle_problem(moved, points, pixels, frame, seen, CAMERA, sigma_px=0.5, fixed_landmarks=np.ones(P, bool))
    assert not problem.gauge_free
    found = adjust(problem, options=TIGHT)
    assert found.result == Result.success
    np.testing.assert_array_equal(found.landmarks, problem.landmarks)
    covariance = bundle_covariance(problem, found.cam_from_world, found.landmarks, CAMERA)
    for i in (0, 2):
        expected = refine_absolute_pose(
            SE3(moved.wxyz_xyz[i]), points, pixels.reshape(C, P, 2)[i], CAMERA, sigma_px=0.5, options=TIGHT
        )
        np.testing.assert_allclose(found.cam_from_world.wxyz_xyz[i], expected.model.wxyz_xyz, atol=1e-8)
        scale = float(jnp.abs(expected.covariance).max())
        np.testing.assert_allclose(covariance.cameras(i), expected.covariance, atol=1e-6 * scale)
