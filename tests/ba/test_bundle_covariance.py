"""Covariances of an adjusted bundle against COLMAP's, and against the errors of many adjustments."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from vojax import SE3
from vojax.ba import LMOptions, adjust_bundle, bundle_covariance, bundle_problem
from vojax.cameras import Pinhole
from vojax.datasets._bal import BalCamera
from vojax.datasets._colmap import ColmapImage, ColmapModel, write_colmap

C, P = 5, 30


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        xi = 0.1 * rng.normal(size=(C, 6))
        xi[:, 0] += 0.6 * np.arange(C)
        poses = SE3.exp(jnp.asarray(xi)).inverse()
        points = rng.uniform([-2, -2, 4], [4, 2, 9], size=(P, 3))
        frame, seen = (index.ravel() for index in np.indices((C, P)))
        camera = BalCamera(focal=500.0, k1=-0.05, k2=0.01, cx=320.0, cy=240.0)
        exact = np.asarray(camera.project(SE3(poses.wxyz_xyz[frame]).apply(jnp.asarray(points[seen]))))
        return poses, points, exact + 0.3 * rng.normal(size=exact.shape), frame, seen, camera


def test_covariances_are_those_of_colmap(scene, tmp_path, x64):
    pycolmap = pytest.importorskip("pycolmap")
    poses, points, pixels, frame, seen, camera = scene
    images = [
        ColmapImage(k + 1, np.asarray(poses.wxyz_xyz[k]), 1, f"{k}", pixels[frame == k] + 0.5, seen[frame == k] + 1)
        for k in range(C)
    ]
    tracks = [np.array([(k + 1, j) for k in range(C)]) for j in range(P)]
    cameras = {1: ("RADIAL", 640, 480, np.array([500.0, 320.5, 240.5, -0.05, 0.01]))}
    write_colmap(
        tmp_path,
        ColmapModel(cameras, images, np.arange(1, P + 1), points, np.zeros((P, 3), np.uint8), np.zeros(P), tracks),
    )
    reconstruction = pycolmap.Reconstruction(tmp_path)
    config = pycolmap.BundleAdjustmentConfig()
    for number in reconstruction.images:
        config.add_image(number)
    # Two cameras stay: the gauge is the same for both of us.
    for number in (1, 2):
        config.set_constant_rig_from_world_pose(reconstruction.images[number].frame_id)
    options = pycolmap.BundleAdjustmentOptions()
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    settings = pycolmap.BACovarianceOptions()
    settings.damping = 0.0
    theirs = pycolmap.estimate_ba_covariance(settings, reconstruction, adjuster)
    assert theirs is not None

    problem = bundle_problem(
        poses, points, pixels, frame, seen, camera, free_intrinsics=["focal", "k1", "k2"],
        fixed_cameras=np.arange(C) < 2,
    )  # fmt: skip
    ours = bundle_covariance(problem, poses, points, camera)
    assert ours.regular

    def to_colmap(k):
        """Their tangent, (rotation, translation) of exp(θ) R and t + τ, from ours, exp(−ξ) @ cam_from_world."""
        x, y, z = np.asarray(poses.wxyz_xyz[k, 4:])
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.block([[np.zeros((3, 3)), -_TURN * np.eye(3)], [-np.eye(3), cross]])

    def close(mine, reference, other=None, another=None):
        scale = np.sqrt(
            np.outer(np.diag(reference if other is None else other), np.diag(reference if other is None else another))
        )
        np.testing.assert_allclose(mine / scale, reference / scale, rtol=0, atol=1e-6)

    for k in range(2, C):
        close(to_colmap(k) @ np.asarray(ours.cameras(k))[:6, :6] @ to_colmap(k).T, theirs.get_cam_cov_from_world(k + 1))
    between = to_colmap(2) @ np.asarray(ours.cameras(2, 3))[:6, :6] @ to_colmap(3).T
    close(
        between,
        theirs.get_cam_cross_cov_from_world(3, 4),
        theirs.get_cam_cov_from_world(3),
        theirs.get_cam_cov_from_world(4),
    )
    intrinsics = theirs.get_other_params_cov(reconstruction.cameras[1].params)
    if intrinsics is not None:
        keep = [0, 1, 2] if intrinsics.shape == (3, 3) else [0, 3, 4]
        close(np.asarray(ours.intrinsics()), intrinsics[np.ix_(keep, keep)])


# COLMAP turns by quaternions, whose tangent is half the angle.
_TURN = 0.5


def calibration(scene, trials):
    """Mean NEES of all unknown pose coordinates, and of one landmark, over adjustments of noisy copies."""
    poses, points, _, frame, seen, _ = scene
    camera = Pinhole(fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    exact = camera.project(SE3(poses.wxyz_xyz[frame]).apply(jnp.asarray(points[seen])))
    problem = bundle_problem(poses, points, exact, frame, seen, camera, sigma_px=0.5, gauge="two_cameras")
    columns = problem.layout.pose_columns

    def one(noise):
        noisy = eqx.tree_at(lambda problem: problem.measurements, problem, exact + 0.5 * noise)
        found = adjust_bundle(noisy, options=LMOptions(max_steps=8))
        covariance = bundle_covariance(noisy, found.cam_from_world, found.landmarks, found.camera)
        # exp(−ξ) @ truth is the estimate.
        xi = (poses @ found.cam_from_world.inverse()).log()
        error = jnp.zeros(problem.layout.unknowns).at[columns].set(xi, mode="drop")
        poses_nees = error @ jnp.linalg.solve(covariance.inverse, error)
        offset = found.landmarks[7] - points[7]
        return poses_nees, offset @ jnp.linalg.solve(covariance.landmark(7), offset), covariance.regular

    noise = np.random.default_rng(1).normal(size=(trials, *exact.shape))
    return problem.layout.unknowns, *jax.jit(lambda noise: jax.lax.map(one, noise, batch_size=25))(jnp.asarray(noise))


@pytest.mark.slow
@pytest.mark.parametrize("trials", [50, pytest.param(1000, marks=pytest.mark.slow)])
def test_errors_are_as_large_as_covariances_say(trials, scene, x64):
    dimension, poses, landmark, regular = calibration(scene, trials)
    assert np.all(regular)
    for size, values in ((dimension, poses), (3, landmark)):
        low, high = scipy.stats.chi2.ppf([5e-4, 1 - 5e-4], size * trials) / trials
        assert low < np.mean(values) < high, size
