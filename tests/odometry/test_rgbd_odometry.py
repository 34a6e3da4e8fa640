"""RGB-D odometry on rendered depths and on a real sequence."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from vojax.cameras import BrownConrady, Pinhole
from vojax.datasets import SevenScenesSequence, SyntheticStereoSequence
from vojax.features import remap
from vojax.metrics import Trajectory, evaluate
from vojax.odometry import PIPELINES, DepthOptions, RgbdOdometry
from vojax.odometry._rgbd import disparities_of_depths

pytestmark = pytest.mark.optimized


@pytest.fixture(scope="module")
def street():
    return SyntheticStereoSequence(frames=12)


def limited(depth, furthest=20.0):
    """A depth sensor's range."""
    return np.where(depth < furthest, depth, 0.0).astype(np.float32)


def follow(odometry, frames):
    return [odometry.step(*frame) for frame in frames]


def drift(sequence, estimates):
    poses = np.tile(np.eye(4), (len(sequence), 1, 1))
    poses[:, :3] = sequence.poses
    path = Trajectory(sequence.times, np.stack([e.world_from_cam for e in estimates]))
    return evaluate(path, Trajectory(sequence.times, poses)).drift_percent


def frames_of(sequence):
    return [(sequence.images(k)[0], limited(sequence.depth(k))) for k in range(len(sequence))]


def test_rendered_street_is_followed_with_and_without_some_depths(street):
    frames = frames_of(street)
    estimates = follow(PIPELINES["rgbd-3d2d"].odometry(street.camera), frames)
    assert not any(e.bridged for e in estimates)
    assert drift(street, estimates) < 1.0
    # One frame has no depth at all, one has zeros: both are tracked from the one before.
    frames[4] = frames[4][0], None
    frames[8] = frames[8][0], np.zeros_like(frames[8][1])
    estimates = follow(RgbdOdometry(street.camera), frames)
    assert not any(e.bridged for e in estimates)
    assert drift(street, estimates) < 1.0


def test_a_camera_with_distortion(street):
    plain = street.camera
    lens = BrownConrady(
        fx=plain.fx, fy=plain.fy, cx=plain.cx, cy=plain.cy, k1=-0.12, k2=0.02, p1=1e-3, p2=-1e-3, k3=0.0
    )
    height, width = street.images(0)[0].shape[:2]
    grid = jnp.stack(jnp.meshgrid(jnp.arange(width), jnp.arange(height)), axis=-1).reshape(-1, 2).astype(jnp.float32)
    source = np.asarray(plain.project(lens.unproject(grid))).reshape(height, width, 2)
    nearest = np.rint(source).astype(int).clip(0, [width - 1, height - 1])
    frames = [(remap(image, source), depth[nearest[..., 1], nearest[..., 0]]) for image, depth in frames_of(street)]
    estimates = follow(RgbdOdometry(lens), frames)
    assert not any(e.bridged for e in estimates)
    assert drift(street, estimates) < 1.0
    # Taken for a pinhole the same images give a wrong path, so that the test sees the distortion.
    wrong = follow(RgbdOdometry(plain), frames)
    assert drift(street, wrong) > 2.0 * drift(street, estimates)


def test_no_depth_anywhere_moves_nothing(street):
    estimates = follow(RgbdOdometry(street.camera), [(image, None) for image, _ in frames_of(street)[:4]])
    assert all(e.bridged for e in estimates[1:])
    assert all(e.flags for e in estimates[1:])
    np.testing.assert_allclose([e.world_from_cam for e in estimates], np.tile(np.eye(4), (4, 1, 1)), atol=1e-9)


def test_depths_become_disparities_with_the_noise_of_the_sensor():
    depth = np.full((20, 30), 2.0, np.float32)
    depth[:, 15:] = 4.0
    depth[:5, :5] = 0.0
    depth[10, 3] = np.nan
    pixels = np.array([[8.2, 10.1], [22.0, 9.0], [15.0, 10.0], [1.0, 1.0], [3.0, 10.0], [-4.0, 2.0], [29.0, 19.0]])
    matches = disparities_of_depths(depth, pixels, 400.0, DepthOptions(sigma_per_m2=2e-3))
    # Inside both planes and beside the hole; not on the edge, in the gap or outside. The image's corner lacks most
    # of its window.
    np.testing.assert_array_equal(matches.valid, [True, True, False, False, True, False, False])
    np.testing.assert_allclose(matches.disparity[[0, 1, 4]], [200, 100, 200])
    np.testing.assert_allclose(matches.sigma[[0, 1, 4]], 2e-3 * 400.0)
    none = disparities_of_depths(None, pixels, 400.0)
    assert not none.valid.any()
    assert np.isfinite(none.sigma).all()


def test_a_slanted_plane_reads_the_depth_of_its_middle():
    camera = Pinhole(fx=500.0, fy=500.0, cx=319.5, cy=239.5)
    columns = np.arange(640)
    # z = 2 + 0.5 x on the ray x = z (u - cx)/fx.
    z = 2.0 / (1.0 - 0.5 * (columns - 319.5) / 500.0)
    depth = np.tile(z.astype(np.float32), (480, 1))
    pixels = np.array([[100.0, 200.0], [500.0, 300.0]])
    matches = disparities_of_depths(depth, pixels, float(camera.fx) * 0.075)
    np.testing.assert_allclose(matches.disparity, 37.5 / z[[100, 500]], rtol=1e-5)


def test_bad_input(street):
    image, depth = frames_of(street)[0]
    odometry = RgbdOdometry(street.camera)
    with pytest.raises(ValueError, match="expected one depth for each pixel"):
        odometry.step(image, depth[:-1])
    odometry.step(image, depth)
    with pytest.raises(ValueError, match="a sequence has one size"):
        odometry.step(image[:-2], depth[:-2])
    for options in ({"sigma_per_m2": 0.0}, {"radius_px": -1}, {"baseline_m": -0.1}):
        with pytest.raises(ValueError, match="expected"):
            dataclasses.replace(DepthOptions(), **options)


@pytest.mark.data
@pytest.mark.slow
def test_seven_scenes(data_root):
    sequence = SevenScenesSequence(data_root / "7scenes")
    odometry = RgbdOdometry(sequence.camera)
    estimates = [odometry.step(sequence.images(k)[0], sequence.depth(k)) for k in range(len(sequence))]
    poses = np.tile(np.eye(4), (len(sequence), 1, 1))
    poses[:, :3] = sequence.poses
    path = Trajectory(sequence.times, np.stack([e.world_from_cam for e in estimates]))
    assert evaluate(path, Trajectory(sequence.times, poses), "se3").ate_rmse_m <= 0.05
    assert not any(e.bridged for e in estimates)
