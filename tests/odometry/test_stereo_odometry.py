"""The pipeline on rendered and on real images, and its stages on simulated measurements.

One file, so that one process compiles the motion and the window once for all of them.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.cameras import Pinhole, RectifiedStereo
from vojax.datasets import EurocSequence, KittiSequence, SyntheticStereoSequence, read_stereo_tracks
from vojax.features import DescriptorOptions
from vojax.lie import SE3
from vojax.metrics import Trajectory, evaluate
from vojax.odometry import (
    PIPELINES,
    DisparityCalibration,
    Flag,
    KeyframeOptions,
    MotionOptions,
    PairRectifier,
    StereoOdometry,
    StereoOdometryOptions,
    is_keyframe,
)
from vojax.odometry._motion import StereoFeatures, stereo_motion

pytestmark = pytest.mark.optimized

STEREO = RectifiedStereo(Pinhole(fx=700.0, fy=700.0, cx=600.0, cy=180.0), baseline=0.54)
SIZE = 640


def simulated_pair(seed: int, offsets=(0.0, 0.0), noise=1.0, outliers=0.2):
    """Features of two frames 1 m apart, padded; `offsets` is what the disparities lack."""
    rng = np.random.default_rng(seed)
    n = 500
    depth = rng.uniform(5.0, 60.0, n)
    points = np.stack([rng.uniform(-0.8, 0.8, n) * depth, rng.uniform(-0.2, 0.2, n) * depth, depth], 1)
    motion = SE3.exp(jnp.array([0.02, -0.01, -1.0, 0.003, 0.01, -0.002]) + 0.002 * rng.normal(size=6))
    measured = []
    for pose, sigma in ((SE3.identity(), 0.1), (motion, 0.25)):  # as MotionOptions states them
        m = np.array(STEREO.project(pose.apply(jnp.asarray(points, jnp.float32))))
        x = (m[:, 0] - 600.0) / 700.0
        m[:, 2] += offsets[0] + offsets[1] * x**2  # u_right too large: disparity too small
        jitter = noise * rng.normal(size=(n, 3)) * [sigma, sigma, 0.15]
        m += jitter + jitter[:, :1] * [0, 0, 1]
        measured.append(m)
    wrong = rng.uniform(size=n) < outliers
    measured[1][wrong, :2] += rng.uniform(-40, 40, (int(wrong.sum()), 2))

    def padded(m):
        full = np.zeros((SIZE, 3), np.float32)
        full[:n] = m
        there = jnp.arange(SIZE) < n
        return StereoFeatures(jnp.asarray(full), jnp.full((SIZE,), 0.15), there, there)

    return motion, padded(measured[0]), padded(measured[1]), wrong


def estimate(seed, first, second, calibration=None, options=MotionOptions()):
    calibration = DisparityCalibration.prior() if calibration is None else calibration
    key = jax.random.key(seed)
    return stereo_motion(first, second, jnp.ones(SIZE), SE3.identity(), calibration, STEREO, key, options)


@pytest.mark.slow
def test_motion_is_found_among_outliers_with_a_covariance_that_fits():
    nees = []
    for seed in range(12):
        truth, first, second, wrong = simulated_pair(seed)
        motion = estimate(seed, first, second)
        error = np.asarray((truth @ motion.cam1_from_cam0.inverse()).log())
        assert np.linalg.norm(error[:3]) < 0.02
        assert np.degrees(np.linalg.norm(error[3:])) < 0.05
        kept = np.asarray(motion.inliers)[: len(wrong)]
        assert kept[~wrong].mean() > 0.9
        assert kept[wrong].mean() < 0.1
        assert not np.asarray(motion.inliers)[len(wrong) :].any()
        nees.append(error @ np.linalg.solve(np.asarray(motion.covariance, np.float64), error))
    # Robust weights and shared noise make the covariance approximate: six degrees of freedom within a factor of two.
    assert 3.0 < np.mean(nees) < 12.0


@pytest.mark.slow
def test_disparity_error_is_calibrated_away_and_without_it_scale_is_wrong():
    truth_offsets = np.array([0.1, 1.0])
    calibration, plain_scale, calibrated_scale = DisparityCalibration.prior(), [], []
    for seed in range(20):
        truth, first, second, _ = simulated_pair(seed, truth_offsets)
        motion = estimate(seed, first, second, calibration)
        calibration = motion.calibration
        length = float(jnp.linalg.norm(truth.translation()))
        calibrated_scale.append(float(jnp.linalg.norm(motion.cam1_from_cam0.translation())) / length - 1.0)
        plain = estimate(seed, first, second, options=MotionOptions(self_calibrate=False))
        plain_scale.append(float(jnp.linalg.norm(plain.cam1_from_cam0.translation())) / length - 1.0)
    np.testing.assert_allclose(calibration.estimate(), truth_offsets, atol=0.15)
    assert np.mean(plain_scale) > 0.004
    assert abs(np.mean(calibrated_scale[10:])) < 0.5 * np.mean(plain_scale)


def test_nothing_to_track_leaves_the_guess_and_no_inliers():
    _, first, second, _ = simulated_pair(0)
    empty = StereoFeatures(first.measurements, first.sigma_disparity, first.has_position & False, first.has_disparity)
    motion = estimate(0, empty, second)
    assert int(motion.num_inliers) == 0
    for leaf in jax.tree.leaves(motion):
        assert np.isfinite(np.asarray(leaf, np.float64)).all()


def test_keyframe_rule():
    depths = np.full(100, 20.0)
    options = KeyframeOptions(distance_over_depth=0.1, min_shared=50)
    assert not is_keyframe(1.9, depths, 80, options)
    assert is_keyframe(2.1, depths, 80, options)
    assert is_keyframe(0.1, depths, 49, options)
    assert not is_keyframe(1.0, np.zeros(0), 80, options)


def drive(sequence, options=StereoOdometryOptions(), blank=(), skipped=(), frames=None):
    odometry = PIPELINES["stereo-3d2d"].odometry(sequence.stereo, options)
    estimates = []
    for k in range(len(sequence)) if frames is None else frames:
        if k in skipped:
            estimates.append(odometry.skip())
            continue
        left, right = sequence.images(k)
        if k in blank:
            left, right = np.zeros_like(left), np.zeros_like(right)
        estimates.append(odometry.step(left, right))
    return estimates


def measure(sequence, estimates):
    poses = np.tile(np.eye(4), (len(sequence), 1, 1))
    poses[:, :3] = sequence.poses
    return evaluate(
        Trajectory(sequence.times, np.stack([e.world_from_cam for e in estimates])), Trajectory(sequence.times, poses)
    )


@pytest.fixture(scope="module")
def street():
    return SyntheticStereoSequence(frames=20)


def test_rendered_street_is_followed(street):
    estimates = drive(street)
    metrics = measure(street, estimates)
    assert metrics.drift_percent < 0.5
    assert metrics.rpe_rot_deg < 0.1
    assert not any(e.bridged for e in estimates)
    assert sum(e.keyframe for e in estimates) >= 4
    again = drive(street)
    for one, other in zip(estimates, again, strict=True):
        np.testing.assert_array_equal(one.world_from_cam, other.world_from_cam)


def test_the_window_keeps_to_the_path(street):
    estimates = drive(street, StereoOdometryOptions(window=True))
    assert measure(street, estimates).drift_percent < 0.5
    assert not any(e.bridged for e in estimates)


@pytest.mark.parametrize("kind", ["sift", "orb"])
def test_matched_features_are_followed(street, kind):
    estimates = drive(street, StereoOdometryOptions(detector=DescriptorOptions(kind=kind, max_features=600)))
    assert measure(street, estimates).drift_percent < {"sift": 1.0, "orb": 2.0}[kind]
    assert not any(e.bridged for e in estimates)
    assert np.mean([e.num_inliers for e in estimates[1:]]) > 50


@pytest.mark.parametrize("how", ["blank", "skipped"])
def test_a_frame_without_content_is_bridged_and_the_next_inherits_no_guess(street, how):
    estimates = drive(street, **{how: (9,)})
    assert [k for k, e in enumerate(estimates) if e.bridged] == [9]
    if how == "blank":
        assert estimates[9].flags == (Flag.texture, Flag.dark)
    else:
        assert estimates[9].flags == (Flag.unreadable,)
    assert all(not e.flags for k, e in enumerate(estimates) if k != 9)
    for e in estimates:
        assert np.isfinite(e.world_from_cam).all()
        np.testing.assert_allclose(e.world_from_cam[:3, :3] @ e.world_from_cam[:3, :3].T, np.eye(3), atol=1e-9)
    # Tracked across the gap, the path is what it is without one.
    assert measure(street, estimates).drift_percent < 0.5


def test_images_that_share_nothing_are_bridged_and_said(street):
    odometry = StereoOdometry(street.stereo)
    for k in range(4):
        odometry.step(*street.images(k))
    # Upside down there is texture enough, and nothing to follow.
    lost = odometry.step(*(np.ascontiguousarray(image[::-1, ::-1]) for image in street.images(4)))
    assert lost.bridged
    assert lost.num_inliers == 0
    assert {Flag.overlap, Flag.consensus} & set(lost.flags)


def test_pictures_of_two_times_are_said():
    # Late by a twentieth of a frame: the rows hardly show it, and the path is 5 % off.
    sequence = SyntheticStereoSequence(frames=12, right_late=0.05)
    odometry = StereoOdometry(sequence.stereo)
    estimates = [odometry.step(*sequence.images(k)) for k in range(len(sequence))]
    late, deviation = odometry.right_late
    assert abs(late - 0.05) < 3.0 * deviation < 0.03
    assert measure(sequence, estimates).drift_percent > 2.0
    assert Flag.unsynchronised in estimates[-1].flags
    assert not any(Flag.unsynchronised in e.flags for e in estimates[:3])


def test_a_camera_at_rest_stays_and_makes_no_keyframes(street):
    estimates = drive(street, frames=[0, 1, 2, *[3] * 8, 4, 5])
    at_rest = estimates[4:11]
    assert all(e.flags == (Flag.static,) and not e.bridged and not e.keyframe for e in at_rest)
    for e in at_rest:
        np.testing.assert_allclose(e.world_from_cam, estimates[3].world_from_cam, atol=1e-3)
    assert not estimates[11].flags
    # Its path goes on where it stopped.
    poses = np.stack([e.world_from_cam for k, e in enumerate(estimates) if k not in range(4, 11)])
    whole = np.tile(np.eye(4), (6, 1, 1))
    whole[:, :3] = street.poses[:6]
    assert evaluate(Trajectory(street.times[:6], poses), Trajectory(street.times[:6], whole)).drift_percent < 1.0


def test_three_d_to_three_d(street):
    options = PIPELINES["stereo-3d3d"].options()
    estimates = drive(street, options)
    metrics = measure(street, estimates)
    assert metrics.drift_percent < 1.0
    assert metrics.rpe_rot_deg < 0.2
    assert not any(e.bridged or e.flags for e in estimates)


def test_images_of_another_size_are_refused(street):
    odometry = StereoOdometry(street.stereo)
    odometry.step(*street.images(0))
    with pytest.raises(ValueError, match="a sequence has one size"):
        odometry.step(np.zeros((100, 100), np.uint8), np.zeros((100, 100), np.uint8))


# Tracks from elsewhere


def tracked(street, k, points, rng, noise):
    """Ids and measurements of points in a frame, in any order; every fifth without a match in the right image."""
    pose = street.poses[k]
    local = (points - pose[:, 3]) @ pose[:, :3]
    ahead = np.flatnonzero(local[:, 2] > 2.0)
    measured = np.array(street.stereo.project(jnp.asarray(local[ahead], jnp.float32)))
    inside = np.all((measured[:, :2] > 0) & (measured[:, :2] < [639, 239]), axis=1)
    ids, measured = ahead[inside], measured[inside] + noise * rng.normal(size=(int(inside.sum()), 3))
    measured[ids % 5 == 0, 2] = np.nan
    order = rng.permutation(min(len(ids), 600))
    return ids[order], measured[order]


@pytest.mark.parametrize(("noise", "percent"), [(0.0, 0.01), (0.2, 0.5)])
def test_tracks_of_another_front_end_are_followed(street, noise, percent):
    rng = np.random.default_rng(4)
    points = rng.uniform([-15.0, -6.0, 0.0], [15.0, 3.0, 60.0], (3000, 3))
    points = points @ street.poses[0, :, :3].T + street.poses[0, :, 3]
    odometry = StereoOdometry(street.stereo)
    estimates = [odometry.step_tracks(*tracked(street, k, points, rng, noise)) for k in range(12)]
    truth = np.tile(np.eye(4), (12, 1, 1))
    truth[:, :3] = street.poses[:12]
    poses = np.stack([e.world_from_cam for e in estimates])
    assert evaluate(Trajectory(street.times[:12], poses), Trajectory(street.times[:12], truth)).drift_percent < percent
    assert all(e.num_inliers > 100 for e in estimates[1:])
    # Nothing to go by, and back again.
    lost = odometry.step_tracks(np.zeros(0, int), np.zeros((0, 3)))
    assert lost.bridged
    assert Flag.texture in lost.flags
    assert not odometry.step_tracks(*tracked(street, 13, points, rng, noise)).bridged


@pytest.mark.parametrize(
    ("ids", "measurements", "message"),
    [
        ([1, 1], np.ones((2, 3)), "feature 1 stands 2 times"),
        ([1, 2], np.ones((3, 3)), r"ids have shape \(2,\) and pixels \(3, 2\)"),
        ([1, 2], np.ones((2, 2)), r"measurements have shape \(2, 2\): expected \(u_left, v, u_right\)"),
        ([1, 2], np.array([[1, 2, 3], [np.nan, 2, 3]]), r"feature 2 is at \(nan, 2.0\)"),
        ([1.5, 2.0], np.ones((2, 3)), "ids are of float64"),
    ],
)
def test_tracks_that_make_no_sense_are_refused(street, ids, measurements, message):
    with pytest.raises(ValueError, match=message):
        StereoOdometry(street.stereo).step_tracks(np.array(ids), measurements)


def test_images_and_tracks_do_not_mix(street):
    ids, measurements = np.arange(30), np.ones((30, 3))
    odometry = StereoOdometry(street.stereo)
    odometry.step(*street.images(0))
    with pytest.raises(ValueError, match="tracks after an image"):
        odometry.step_tracks(ids, measurements)
    odometry = StereoOdometry(street.stereo)
    odometry.step_tracks(ids, measurements)
    with pytest.raises(ValueError, match="an image after tracks"):
        odometry.step(*street.images(0))


@pytest.mark.data
@pytest.mark.slow
def test_stereo_tracks_of_kitti_00(data_root):
    tracks = read_stereo_tracks(data_root / "kitti00_stereo_tracks")
    truth = np.loadtxt(data_root / "trajectories" / "KITTI_00_gt.txt").reshape(-1, 3, 4)[: len(tracks)]
    odometry = StereoOdometry(tracks.stereo)
    poses = []
    for k in range(len(tracks)):
        rows = tracks.frame(k)
        poses.append(odometry.step_tracks(tracks.track_index[rows], tracks.measurements[rows]).world_from_cam)
    times = np.arange(len(tracks), dtype=float)
    whole = np.tile(np.eye(4), (len(tracks), 1, 1))
    whole[:, :3] = truth
    # The poses that come with the tracks are 0.37 m off; the truth itself starts with wrong steps.
    assert evaluate(Trajectory(times, np.stack(poses)), Trajectory(times, whole), "se3").ate_rmse_m < 0.5


@pytest.mark.data
def test_kitti_06_clip(data_root):
    sequence = KittiSequence(data_root / "kitti", "06")
    metrics = measure(sequence, drive(sequence))
    assert metrics.drift_percent <= 0.8
    assert metrics.ate_rmse_m <= 0.3


@pytest.mark.data
@pytest.mark.slow
def test_kitti_06_clip_from_points_to_points(data_root):
    sequence = KittiSequence(data_root / "kitti", "06")
    metrics = measure(sequence, drive(sequence, PIPELINES["stereo-3d3d"].options()))
    assert metrics.drift_percent <= 1.5


@pytest.mark.data
@pytest.mark.slow
def test_an_unrectified_pair_at_rest(data_root):
    sequence = EurocSequence(data_root / "euroc" / "V1_01_easy")
    rectifier = PairRectifier(*sequence.cameras, sequence.cam1_from_cam0, sequence.size)
    odometry = StereoOdometry(rectifier)
    estimates = [odometry.step(*sequence.images(k)) for k in range(len(sequence))]
    # Once the drone stirs by a third of a pixel.
    assert sum(Flag.static in e.flags for e in estimates[1:]) >= len(estimates) - 2
    assert not any(e.bridged for e in estimates)
    for e in estimates:
        assert np.linalg.norm(e.world_from_cam[:3, 3]) < 5e-3
