"""The monocular pipelines on rendered and on real images, and their stages on simulated tracks.

One file, so that one process compiles the stages once for all of them.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vojax.datasets import KittiSequence, SyntheticStereoSequence, read_planar_tracks
from vojax.features import DetectorOptions
from vojax.lie import SE3
from vojax.metrics import Trajectory, evaluate
from vojax.odometry import (
    PIPELINES,
    AbsoluteMotionOptions,
    BootstrapOptions,
    Flag,
    MonoOdometry,
    MonoOdometryOptions,
    MonoWindowOptions,
    PlanarMotionOptions,
    RelativeMotionOptions,
    relative_scale,
)
from vojax.odometry._absolute_motion import absolute_motion
from vojax.odometry._bootstrap import Bootstrap
from vojax.odometry._mono_window import MonoKeyframe, MonoWindow
from vojax.odometry._planar_motion import planar_motion
from vojax.odometry._relative_motion import relative_motion
from vojax.odometry._tracks import Features

pytestmark = pytest.mark.optimized

DETECTOR = DetectorOptions(max_features=384)
SIZE = 384
BLANK = np.zeros((240, 640), np.uint8)


@pytest.fixture(scope="module")
def street():
    return SyntheticStereoSequence(frames=24)


def pose(angles_deg=(0.0, 0.0, 0.0), center=(0.0, 0.0, 0.0)):
    """`world_from_cam` of a camera."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix()
    matrix[:3, 3] = center
    return matrix


def seen(camera, world_from_cam, points, rng, noise=0.2):
    """Pixels of points, with noise, and which of them the camera sees."""
    local = (points - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]
    pixels = np.asarray(camera.project(jnp.asarray(local, jnp.float32))) + noise * rng.normal(size=(len(points), 2))
    inside = np.all((pixels > 0) & (pixels < [639, 239]), axis=1)
    return pixels.astype(np.float32), inside & (local[:, 2] > 0.5)


def scene(rng, n=300, plane=False):
    """Points before the camera, 6 to 30 m away; on a wall that is not square to it, if asked for."""
    x, y, z = rng.uniform(-1.0, 1.0, n), rng.uniform(-0.35, 0.35, n), rng.uniform(6.0, 30.0, n)
    points = np.stack([0.7 * x * z, y * z, z], axis=1)
    if plane:
        points = np.stack([8.0 * x, 8.0 * y, 12.0 + 4.0 * x], axis=1)
    return points


def features(pixels, visible):
    rows = np.flatnonzero(visible)
    return Features(BLANK, rows, pixels[rows], np.ones(len(rows), np.float32), np.arange(len(rows)), 0)


def full(array):
    array = np.asarray(array)
    return jnp.asarray(np.pad(array, [(0, SIZE - len(array))] + [(0, 0)] * (array.ndim - 1)).astype(np.float32))


def angle_deg(matrix):
    return np.degrees(np.linalg.norm(Rotation.from_matrix(np.asarray(matrix, np.float64)).as_rotvec()))


# Scale


def ratio_problem(rng, wrong=0.0, n=80, noise=0.002):
    points = np.array([0, 0, 15.0]) + rng.uniform(-5.0, 5.0, (n, 3))
    again = (points @ Rotation.random(rng=rng).as_matrix().T) / 2.5
    points, again = points * (1 + noise * rng.normal(size=points.shape)), again * (1 + noise * rng.normal(size=(n, 3)))
    bad = rng.permutation(n)[: int(wrong * n)]
    again[bad] += rng.normal(size=(len(bad), 3)) * 6.0
    std = np.full(n, 0.05)
    return full(points[: len(points)]), full(again), full(std), full(std / 2.5), jnp.arange(SIZE) < n


def test_scale_is_the_ratio_of_distances():
    rng = np.random.default_rng(0)
    exact = ratio_problem(rng, noise=0.0)
    for statistic in ("median", "mean"):
        scale, spread = relative_scale(*exact, statistic)
        assert abs(scale - 2.5) < 1e-5
        assert spread < 1e-5


def test_the_median_scale_stands_up_to_30_percent_of_wrong_points_and_the_mean_does_not():
    rng = np.random.default_rng(1)
    errors = {
        statistic: np.array([abs(relative_scale(*ratio_problem(rng, 0.3), statistic)[0] - 2.5) for _ in range(20)])
        for statistic in ("median", "mean")
    }
    assert np.max(errors["median"]) < 0.1
    assert np.median(errors["mean"]) > 0.2


def test_scale_without_points_is_zero_and_finite():
    *arrays, _ = ratio_problem(np.random.default_rng(2))
    for count in (0, 1):
        for statistic in ("median", "mean"):
            scale, spread = relative_scale(*arrays, jnp.arange(SIZE) < count, statistic)
            assert scale == 0
            assert np.isinf(spread)
    coincident = [jnp.zeros_like(arrays[0]), jnp.zeros_like(arrays[1]), *arrays[2:]]
    assert relative_scale(*coincident, jnp.arange(SIZE) < 50)[0] == 0


# Stages


def test_motion_from_landmarks(street):
    rng = np.random.default_rng(3)
    points = scene(rng)
    truth = pose((0.5, 2.0, -0.3), (0.1, 0.0, 0.9))
    pixels, visible = seen(street.camera, truth, points, rng)
    wrong = rng.uniform(size=len(points)) < 0.25
    pixels[wrong] += rng.uniform(-30, 30, (int(wrong.sum()), 2)).astype(np.float32)
    covariance = np.tile(1e-4 * np.eye(3), (len(points), 1, 1))
    usable = jnp.asarray(np.pad(visible, (0, SIZE - len(points))))
    found = absolute_motion(
        full(points), full(covariance), full(pixels), usable, jnp.ones(SIZE), SE3.identity(), street.camera,
        jax.random.key(0), AbsoluteMotionOptions(),
    )  # fmt: skip
    error = np.linalg.inv(truth) @ np.linalg.inv(np.asarray(found.cam1_from_cam0.as_matrix(), np.float64))
    assert np.linalg.norm(error[:3, 3]) < 0.02
    assert angle_deg(error[:3, :3]) < 0.05
    inliers = np.asarray(found.inliers)[: len(points)]
    assert np.mean(inliers[visible & ~wrong]) > 0.95
    assert np.mean(inliers[wrong]) < 0.1
    nobody = absolute_motion(
        full(points), full(covariance), full(pixels), usable & False, jnp.ones(SIZE), SE3.identity(), street.camera,
        jax.random.key(0), AbsoluteMotionOptions(),
    )  # fmt: skip
    assert nobody.num_inliers == 0
    assert np.isfinite(nobody.cam1_from_cam0.wxyz_xyz).all()


@pytest.mark.parametrize("kind", ["relative", "planar"])
def test_motion_from_pairs_of_pixels(street, kind):
    rng = np.random.default_rng(4)
    points = scene(rng)
    # The vehicle turns by 3 degrees to the right on an arc, and pitches a little.
    truth = pose((0.1, 3.0, 0.0), (0.9 * np.sin(np.radians(1.5)), 0.0, 0.9 * np.cos(np.radians(1.5))))
    pixels0, visible0 = seen(street.camera, np.eye(4), points, rng)
    pixels1, visible1 = seen(street.camera, truth, points, rng)
    wrong = rng.uniform(size=len(points)) < 0.25
    pixels1[wrong] += rng.uniform(-30, 30, (int(wrong.sum()), 2)).astype(np.float32)
    usable = jnp.asarray(np.pad(visible0 & visible1, (0, SIZE - len(points))))
    landmarks = points + 0.01 * rng.normal(size=points.shape)
    arrays = (full(pixels0), full(pixels1), usable, full(landmarks), full(np.full(len(points), 0.02)), usable)
    if kind == "planar":
        found = planar_motion(*arrays, street.camera, PlanarMotionOptions())
    else:
        found = relative_motion(*arrays, jnp.ones(SIZE), street.camera, jax.random.key(0), RelativeMotionOptions())
    error = np.linalg.inv(truth) @ np.linalg.inv(np.asarray(found.cam1_from_cam0.as_matrix(), np.float64))
    assert np.linalg.norm(error[:3, 3]) < 0.05
    assert angle_deg(error[:3, :3]) < 0.1
    assert abs(found.scale - 0.9) < 0.03
    inliers = np.asarray(found.inliers)[: len(points)]
    assert np.mean(inliers[np.asarray(usable)[: len(points)] & ~wrong]) > 0.9


@pytest.mark.slow
def test_window_triangulates_and_adjusts(street):
    rng = np.random.default_rng(5)
    points = scene(rng)
    window = MonoWindow(street.camera, MonoWindowOptions())
    truth = [pose((0.0, 1.0 * k, 0.2 * k), (0.3 * k, 0.0, 0.8 * k)) for k in range(6)]
    guesses = []
    for k, world_from_cam in enumerate(truth):
        pixels, visible = seen(street.camera, world_from_cam, points, rng)
        guess = world_from_cam.copy()
        if k >= 2:
            guess[:3, 3] += 0.02 * rng.normal(size=3)
        guesses.append(guess)
        adjusted = window.add(MonoKeyframe(guess, np.flatnonzero(visible), pixels[visible]), adjust=k >= 2)
    assert np.linalg.norm(adjusted[:3, 3] - truth[-1][:3, 3]) < 0.4 * np.linalg.norm(
        guesses[-1][:3, 3] - truth[-1][:3, 3]
    )
    assert len(window.landmarks.ids) > 150
    error = window.landmarks.points - points[window.landmarks.ids]
    whitened = np.einsum("ni,nij,nj->n", error, np.linalg.inv(window.landmarks.covariances), error)
    # The covariances are given the poses, and these have errors too.
    assert 1.0 < np.median(whitened) < 6.0
    window.clear()
    assert window.newest is None


# The first motion


def first_motion(street, points, poses, rng, options=BootstrapOptions()):
    bootstrap = Bootstrap(street.camera, options, SIZE, jax.random.key(1))
    for world_from_cam in poses:
        start = bootstrap.add(features(*seen(street.camera, world_from_cam, points, rng)))
        if start is not None:
            return start
    return None


def test_bootstrap_waits_for_parallax_and_places_the_frames_between(street):
    rng = np.random.default_rng(6)
    poses = [pose((0.0, 0.4 * k, 0.0), (0.05 * k, 0.0, 0.12 * k)) for k in range(12)]
    start = first_motion(street, scene(rng), poses, rng)
    assert start is not None
    assert 3 <= len(start.poses) <= 12
    assert np.linalg.norm(start.poses[-1][:3, 3]) == pytest.approx(1.0, abs=1e-5)
    unit = np.linalg.norm(poses[len(start.poses) - 1][:3, 3])
    for found, truth in zip(start.poses, poses, strict=False):
        error = np.linalg.inv(truth) @ found
        assert angle_deg(error[:3, :3]) < 0.3
        assert np.linalg.norm(found[:3, 3] - truth[:3, 3] / unit) < 0.08


@pytest.mark.slow  # compiles the comparison of two-view models
def test_no_first_motion_from_a_camera_that_turns_in_place(street):
    rng = np.random.default_rng(7)
    assert first_motion(street, scene(rng), [pose((0.0, 1.5 * k, 0.0)) for k in range(6)], rng) is None


@pytest.mark.slow  # compiles the comparison of two-view models
def test_first_motion_before_a_plane_is_the_one_that_a_third_view_agrees_with(street):
    rng = np.random.default_rng(8)
    poses = [pose((0.0, 0.5 * k, 0.0), (0.5 * k, 0.1 * k, 0.1 * k)) for k in range(8)]
    start = first_motion(street, scene(rng, plane=True), poses, rng)
    assert start is not None
    truth = poses[len(start.poses) - 1]
    direction = truth[:3, 3] / np.linalg.norm(truth[:3, 3])
    assert np.degrees(np.arccos(np.clip(direction @ start.poses[-1][:3, 3], -1, 1))) < 6.0
    assert angle_deg(truth[:3, :3].T @ start.poses[-1][:3, :3]) < 1.5


def test_bootstrap_moves_on_where_the_first_view_is_lost(street):
    rng = np.random.default_rng(9)
    bootstrap = Bootstrap(street.camera, BootstrapOptions(), SIZE, jax.random.key(2))
    elsewhere = features(*seen(street.camera, np.eye(4), scene(rng), rng))
    assert bootstrap.add(elsewhere._replace(ids=elsewhere.ids + 10_000)) is None
    points = scene(rng)
    for k in range(6):
        start = bootstrap.add(features(*seen(street.camera, pose((0, 0.3 * k, 0), (0.2 * k, 0, 0.5 * k)), points, rng)))
        if start is not None:
            break
    assert start is not None
    # The lost view and the new first one stay where they were.
    np.testing.assert_array_equal(start.poses[:2], np.tile(np.eye(4), (2, 1, 1)))


def test_bootstrap_moves_on_where_a_small_first_view_has_too_few_left(street):
    # Fifty features, of which 35 stay in view: no motion will ever be found with this one.
    rng = np.random.default_rng(10)
    bootstrap = Bootstrap(street.camera, BootstrapOptions(), SIZE, jax.random.key(3))
    points = scene(rng)
    start = None
    for k in range(8):
        place = pose((0, 0.3 * k, 0), (0.2 * k, 0, 0.5 * k))
        found = features(*seen(street.camera, place, points, rng))
        if k == 0:
            found = found._replace(ids=np.where(np.arange(len(found.ids)) < 35, found.ids, found.ids + 10_000))
            found = found._replace(ids=found.ids[:50], pixels=found.pixels[:50], quality=found.quality[:50])
        start = bootstrap.add(found)
        if start is not None:
            break
    assert start is not None


# Images


def drive(sequence, motion, frames=None, blank=(), skipped=(), **options):
    """Estimates and poses in order, with those of pending frames where they belong."""
    odometry = MonoOdometry(sequence.camera, MonoOdometryOptions(motion=motion, detector=DETECTOR, **options))
    estimates, poses = [], []
    for k in range(len(sequence) if frames is None else frames):
        image = sequence.images(k)[0]
        estimate = odometry.skip() if k in skipped else odometry.step(np.zeros_like(image) if k in blank else image)
        estimates.append(estimate)
        if not estimate.pending:
            poses.extend([*estimate.earlier, estimate.world_from_cam])
    return estimates, np.stack(poses)


def measure(sequence, poses):
    count = len(poses)
    truth = np.tile(np.eye(4), (count, 1, 1))
    truth[:, :3] = sequence.poses[:count]
    times = sequence.times[:count]
    return evaluate(Trajectory(times, poses), Trajectory(times, truth), "sim3")


@pytest.fixture(scope="module")
def followed(street):
    return functools.cache(lambda motion: drive(street, motion))


@pytest.mark.parametrize(("motion", "percent"), [("absolute", 1.0), ("relative", 1.5), ("planar", 1.5)])
def test_rendered_street_is_followed(street, followed, motion, percent):
    estimates, poses = followed(motion)
    metrics = measure(street, poses)
    assert len(poses) == len(street)
    assert not any(e.bridged for e in estimates)
    assert metrics.ate_rmse_m < percent / 100 * metrics.path_length_m
    assert metrics.rpe_rot_deg < 0.15
    assert sum(e.keyframe for e in estimates) >= 4
    np.testing.assert_array_equal(poses[0], np.eye(4))


def test_same_seed_same_path(street, followed):
    np.testing.assert_array_equal(drive(street, "absolute", frames=8)[1], followed("absolute")[1][:8])


def test_a_frame_that_cannot_be_read_is_bridged_and_costs_nothing(street, followed):
    estimates, poses = drive(street, "absolute", skipped=(10,))
    assert estimates[10].flags == (Flag.unreadable,)
    assert [k for k, e in enumerate(estimates) if e.bridged] == [10]
    whole = measure(street, followed("absolute")[1]).ate_rmse_m
    assert measure(street, poses).ate_rmse_m < 2.0 * whole + 0.05


def test_a_loss_is_bridged_said_and_followed_by_a_new_start(street):
    estimates, poses = drive(street, "absolute", blank=(10,))
    assert estimates[10].bridged
    assert any(Flag.restarted in e.flags for e in estimates)
    assert len(poses) == len(street)
    assert np.isfinite(poses).all()
    # The rate of the motion before the loss gives the scale of what comes after.
    assert measure(street, poses).drift_percent < 10.0


def test_what_a_frame_lacks_is_said(street, followed):
    estimates, _ = followed("absolute")
    assert not any(e.flags for e in estimates)
    odometry = MonoOdometry(street.camera, MonoOdometryOptions(detector=DETECTOR))
    images = [street.images(k)[0] for k in range(3)]
    assert odometry.step(images[0]).flags == ()
    assert odometry.step(images[0]).flags == (Flag.static,)
    upside_down = np.ascontiguousarray(images[1][::-1, ::-1])
    assert Flag.overlap in odometry.step(upside_down).flags
    assert odometry.step(BLANK).flags == (Flag.texture, Flag.dark)
    assert Flag.bright in odometry.step(np.full_like(BLANK, 255)).flags


def test_images_of_another_size_are_refused(street):
    odometry = MonoOdometry(street.camera, MonoOdometryOptions(detector=DETECTOR))
    odometry.step(street.images(0)[0])
    with pytest.raises(ValueError, match="a sequence has one size"):
        odometry.step(np.zeros((100, 100), np.uint8))


@pytest.mark.parametrize("motion", ["absolute", "relative"])
def test_tracks_of_another_front_end_are_followed(street, motion):
    rng = np.random.default_rng(11)
    points = rng.uniform([-15.0, -6.0, 4.0], [15.0, 3.0, 60.0], (1200, 3))
    points = points @ street.poses[0, :, :3].T + street.poses[0, :, 3]
    odometry = MonoOdometry(street.camera, MonoOdometryOptions(motion=motion, detector=DETECTOR))
    poses = []
    for k in range(16):
        place = np.eye(4)
        place[:3] = street.poses[k]
        pixels, visible = seen(street.camera, place, points, rng, 0.1)
        rows = rng.permutation(np.flatnonzero(visible))[:SIZE]
        estimate = odometry.step_tracks(rows, pixels[rows])
        assert not estimate.bridged
        if not estimate.pending:
            poses += [*estimate.earlier, estimate.world_from_cam]
    metrics = measure(street, np.stack(poses))
    assert len(poses) == 16
    assert metrics.ate_rmse_m < 0.002 * metrics.path_length_m
    with pytest.raises(ValueError, match="feature 3 stands 2 times"):
        odometry.step_tracks(np.array([3, 3]), np.ones((2, 2)))
    with pytest.raises(ValueError, match="an image after tracks"):
        odometry.step(BLANK)


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("motion", ["absolute", "relative"])
def test_tracks_of_a_robot(data_root, motion):
    tracks = read_planar_tracks(data_root / "sapienza_pr_vo")
    # It sees as few as 14 landmarks.
    odometry = MonoOdometry(tracks.camera, MonoOdometryOptions(motion=motion, detector=DETECTOR, min_inliers=10))
    poses = []
    for k in range(len(tracks)):
        rows = tracks.frame(k)
        estimate = odometry.step_tracks(tracks.track_index[rows], tracks.pixels[rows])
        if not estimate.pending:
            poses += [*estimate.earlier, estimate.world_from_cam]
    times, truth = np.arange(len(poses), dtype=float), np.tile(np.eye(4), (len(poses), 1, 1))
    truth[:, :3] = tracks.poses[: len(poses)]
    assert len(poses) == len(tracks)
    metrics = evaluate(Trajectory(times, np.stack(poses)), Trajectory(times, truth), "sim3")
    # The measurements have no noise.
    assert metrics.ate_rmse_m < 1e-4 * metrics.path_length_m


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "window", "metres"),
    [("mono-3d2d", True, 1.0), ("mono-2d2d", True, 3.0), ("mono-3d2d", False, 1.5), ("mono-2d2d", False, 4.0)],
)
def test_kitti_00_clip(data_root, name, window, metres):
    sequence = KittiSequence(data_root / "kitti", "00", stereo=False)
    chosen = PIPELINES[name]
    odometry = chosen.odometry(sequence.camera, chosen.options(window=window))
    estimates = [odometry.step(sequence.images(k)[0]) for k in range(len(sequence))]
    poses = np.concatenate([[*e.earlier, e.world_from_cam] for e in estimates if not e.pending])
    assert len(poses) == len(sequence)
    assert not any(e.bridged for e in estimates)
    assert measure(sequence, poses).ate_rmse_m <= metres
