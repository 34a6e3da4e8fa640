"""A rig of stereo pairs that look different ways, on simulated tracks and on rendered images."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.cameras import Pinhole, RectifiedStereo
from vojax.datasets import SyntheticStereoSequence
from vojax.lie import SE3, SO3
from vojax.odometry import (
    Flag,
    MotionOptions,
    PairRectifier,
    RigidMotionOptions,
    RigOdometry,
    StereoOdometry,
    StereoOdometryOptions,
)
from vojax.odometry._motion import StereoFeatures
from vojax.odometry._rectification import DisparityCalibration
from vojax.odometry._rig_motion import PairRig, rig_motion

pytestmark = pytest.mark.optimized

WIDTH, HEIGHT = 640, 480
FRONT = RectifiedStereo(Pinhole(fx=400.0, fy=400.0, cx=319.5, cy=239.5), baseline=0.5)
SIDE = RectifiedStereo(Pinhole(fx=300.0, fy=310.0, cx=330.0, cy=230.0), baseline=0.2)
PAIRS = (FRONT, SIDE)
# One looks ahead; the other to the right, from 1.2 m behind.
LEFT_FROM_RIG = SE3.from_rotation_and_translation(
    SO3.exp(jnp.array([[0.0, 0.0, 0.0], [0.0, -np.pi / 2, 0.0]])), jnp.array([[0.0, 0.0, 0.0], [1.2, 0.1, -0.3]])
)


def matrices(poses: SE3) -> np.ndarray:
    return np.asarray(poses.as_matrix(), np.float64)


def seen(stereo: RectifiedStereo, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of points in a left camera's frame that are in its image, and their exact measurements."""
    f, b = stereo.camera, float(stereo.baseline)
    ahead = np.flatnonzero(points[:, 2] > 1.0)
    x, y, z = points[ahead].T
    u, v = float(f.fx) * x / z + float(f.cx), float(f.fy) * y / z + float(f.cy)
    inside = (u > 0) & (u < WIDTH) & (v > 0) & (v < HEIGHT)
    return ahead[inside], np.stack([u, v, u - float(f.fx) * b / z], axis=1)[inside]


def in_pair(k: int, world_from_rig: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    left_from_world = matrices(LEFT_FROM_RIG)[k] @ np.linalg.inv(world_from_rig)
    return seen(PAIRS[k], points @ left_from_world[:3, :3].T + left_from_world[:3, 3])


def path(frames: int) -> np.ndarray:
    """An arc of 0.8 m and 2° a frame."""
    step = matrices(SE3.exp(jnp.array([0.0, 0.0, 0.8, 0.0, np.radians(2.0), 0.0])))
    poses = [np.eye(4)]
    for _ in range(frames - 1):
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def surroundings(seed: int, n: int = 4000) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-30, -6, -20], [30, 4, 40], (n, 3))


def tracks(pose: np.ndarray, points: np.ndarray, rng: np.random.Generator, noise: float, pairs: tuple[int, ...]):
    ids, measurements = [], []
    for k in pairs:
        rows, exact = in_pair(k, pose, points)
        order = rng.permutation(len(rows))[:500]
        measured = exact[order] + noise * rng.normal(size=(len(order), 3))
        measured[rows[order] % 7 == 0, 2] = np.nan  # without a match in the right image
        ids.append(rows[order])
        measurements.append(measured)
    return ids, measurements


@pytest.mark.parametrize(("noise", "metres", "degrees"), [(0.0, 1e-3, 2e-3), (0.2, 0.05, 0.2)])
def test_the_path_of_a_rig_is_found_by_both_pairs(noise, metres, degrees):
    truth, points, rng = path(10), surroundings(1), np.random.default_rng(2)
    odometry = RigOdometry(PAIRS, LEFT_FROM_RIG)
    estimates = [odometry.step_tracks(*tracks(pose, points, rng, noise, (0, 1))) for pose in truth]
    assert not any(e.bridged or e.flags for e in estimates)
    error = np.linalg.inv(truth[-1]) @ estimates[-1].world_from_cam
    assert np.linalg.norm(error[:3, 3]) < metres
    vector = [error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]]
    assert np.degrees(0.5 * np.linalg.norm(vector)) < degrees


def features(measured: np.ndarray, size: int, sigma: float) -> StereoFeatures:
    full = np.zeros((size, 3), np.float32)
    full[: len(measured)] = measured
    there = jnp.arange(size) < len(measured)
    return StereoFeatures(jnp.asarray(full), jnp.full((size,), sigma, jnp.float32), there, there)


def simulated(seed: int, options: MotionOptions, size: int = 256):
    """Two frames of both pairs with the noise that the options state; a fifth of the tracks is wrong."""
    rng = np.random.default_rng(seed)
    points, pose = surroundings(seed, 1500), path(2)[1]
    first, second = [], []
    for k in range(2):
        rows0, exact0 = in_pair(k, np.eye(4), points)
        rows1, exact1 = in_pair(k, pose, points)
        _, i, j = np.intersect1d(rows0, rows1, return_indices=True)
        i, j = i[:size], j[:size]
        for exact, sigma, out in (
            (exact0[i], options.sigma_detect_px, first),
            (exact1[j], options.sigma_track_px, second),
        ):
            position = sigma * rng.normal(size=(len(i), 2))
            disparity = 0.15 * rng.normal(size=len(i))
            noise = np.stack([position[:, 0], position[:, 1], position[:, 0] - disparity], axis=1)
            out.append(exact + noise)
        wrong = rng.uniform(size=len(i)) < 0.2
        second[-1][wrong, :2] += rng.uniform(-40, 40, (int(wrong.sum()), 2))

    def stacked(frames: list[np.ndarray]) -> StereoFeatures:
        return jax.tree.map(lambda *x: jnp.stack(x), *(features(m, size, 0.15) for m in frames))

    return np.linalg.inv(pose), stacked(first), stacked(second)


def motion_of(first: StereoFeatures, second: StereoFeatures, seed: int, options: MotionOptions):
    rig = PairRig(jax.tree.map(lambda *x: jnp.stack(x), *PAIRS), LEFT_FROM_RIG)
    calibration = DisparityCalibration.prior(2)
    quality = jnp.ones(first.has_position.shape)
    return rig_motion(first, second, quality, SE3.identity(), calibration, rig, jax.random.key(seed), options)


def test_covariance_covers_the_errors():
    options = MotionOptions(self_calibrate=False)
    nees, alone = [], []
    for seed in range(120):
        truth, first, second = simulated(seed, options)
        found = motion_of(first, second, seed, options)
        # The state is rig0_from_rig1 exp(ξ), the error exp(ξ) = rig1_from_rig0 (estimated) rig0_from_rig1 (true).
        error = SE3.from_matrix(jnp.asarray(matrices(found.rig1_from_rig0) @ np.linalg.inv(truth))).log()
        covariance = np.asarray(found.covariance, np.float64)
        xi = np.asarray(error, np.float64)
        nees.append(xi @ np.linalg.solve(covariance, xi))
        front = without_pair(first, 1)
        alone.append(np.trace(np.asarray(motion_of(front, second, seed, options).covariance)[:3, :3]))
        assert np.trace(covariance[:3, :3]) < alone[-1]
    # 120 draws of a chi-square with six degrees of freedom average to 6 ± 0.32. The robust loss counts tracks that are
    # right for less than they say, so that the covariance is half as large again as the errors are: 4.1.
    assert 3.4 < np.mean(nees) < 6.6


def without_pair(features: StereoFeatures, k: int) -> StereoFeatures:
    blind = jnp.arange(2)[:, None] == k
    return eqx.tree_at(lambda f: f.has_position, features, features.has_position & ~blind)


@pytest.fixture(scope="module")
def street():
    return SyntheticStereoSequence(frames=8, seed=3)


def test_a_rig_of_one_pair_is_a_stereo_camera(street):
    alone = StereoOdometry(street.stereo)
    rig = RigOdometry([street.stereo], SE3(jnp.array([[1.0, 0, 0, 0, 0, 0, 0]])))
    for k in range(6):
        left, right = street.images(k)
        expected, found = alone.step(left, right), rig.step([(left, right)])
        assert abs(found.num_inliers - expected.num_inliers) < 0.05 * max(expected.num_inliers, 1)
    moved = np.linalg.norm(expected.world_from_cam[:3, 3])
    assert np.linalg.norm(found.world_from_cam[:3, 3] - expected.world_from_cam[:3, 3]) < 1e-3 * moved
    np.testing.assert_allclose(rig.disparity_offsets_px[0], alone.disparity_offsets_px, atol=0.01)


def test_a_pair_that_sees_nothing_leaves_the_others_to_go_on(street):
    ahead = SE3(jnp.array([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0, 0]]))
    odometry = RigOdometry([street.stereo, street.stereo], ahead)
    alone = StereoOdometry(street.stereo)
    blank = (np.zeros((street.height, street.width), np.uint8), np.zeros((street.height, street.width), np.uint8))
    for k in range(6):
        images = street.images(k)
        estimate = odometry.step([images, blank if k in (2, 3) else images])
        expected = alone.step(*images)
        assert not estimate.bridged
        assert (Flag.dark in estimate.flags) == (k in (2, 3))
    shift = estimate.world_from_cam[:3, 3] - expected.world_from_cam[:3, 3]
    assert np.linalg.norm(shift) < 0.005 * np.linalg.norm(expected.world_from_cam[:3, 3])
    assert estimate.num_inliers > 1.5 * expected.num_inliers
    # All of them blind: bridged, and found again from before.
    lost = odometry.step([blank, blank])
    assert lost.bridged
    assert odometry.skip().flags == (Flag.unreadable,)
    assert not odometry.step([street.images(7)] * 2).bridged


def test_the_mount_of_an_unrectified_pair_is_that_of_its_left_camera():
    cam1_from_cam0 = SE3.exp(jnp.array([-0.4, 0.05, 0.02, 0.02, -0.03, 0.01]))
    rectifier = PairRectifier(FRONT.camera, FRONT.camera, cam1_from_cam0, (WIDTH, HEIGHT))
    assert np.linalg.norm(rectifier.rect_from_cam0 - np.eye(3)) > 0.05
    turn = np.eye(4)
    turn[:3, :3] = rectifier.rect_from_cam0
    rect_from_rig = turn @ matrices(LEFT_FROM_RIG)[1]
    odometry = RigOdometry([rectifier], SE3(LEFT_FROM_RIG.wxyz_xyz[1:]))
    truth, points = path(6), surroundings(5)
    for pose in truth:
        rect_from_world = rect_from_rig @ np.linalg.inv(pose)
        rows, exact = seen(rectifier.stereo, points @ rect_from_world[:3, :3].T + rect_from_world[:3, 3])
        estimate = odometry.step_tracks([rows[:500]], [exact[:500]])
    np.testing.assert_allclose(estimate.world_from_cam, truth[-1], atol=2e-3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RigOdometry([], LEFT_FROM_RIG), "0 pairs with left_from_rig"),
        (lambda: RigOdometry([FRONT], LEFT_FROM_RIG), r"1 pairs with left_from_rig of shape \(2, 7\)"),
        (lambda: RigOdometry(PAIRS, LEFT_FROM_RIG, StereoOdometryOptions(window=True)), "without window"),
        (
            lambda: RigOdometry(PAIRS, LEFT_FROM_RIG, StereoOdometryOptions(motion=RigidMotionOptions())),
            "from points to pixels",
        ),
        (lambda: RigOdometry(PAIRS, LEFT_FROM_RIG).step([]), "0 pairs of images for a rig of 2 pairs"),
        (
            lambda: RigOdometry(PAIRS, LEFT_FROM_RIG).step_tracks([np.arange(3)] * 2, [np.ones((3, 2))] * 2),
            r"measurements have shape \(3, 2\)",
        ),
    ],
)
def test_what_does_not_fit_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_images_of_another_size_are_refused():
    odometry = RigOdometry(PAIRS, LEFT_FROM_RIG)
    good, small = np.zeros((480, 640), np.uint8), np.zeros((100, 100), np.uint8)
    odometry.step([(good, good), (good, good)])
    with pytest.raises(ValueError, match="of pair 1 is 100×100 px"):
        odometry.step([(good, good), (small, small)])
