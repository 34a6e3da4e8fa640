import numpy as np
import pytest

from vojax.datasets import SyntheticStereoSequence
from vojax.datasets._street import GROUND_Y, make_boxes, make_path, street_from_camera

FRAMES = 48


@pytest.fixture(scope="module")
def sequence():
    return SyntheticStereoSequence(frames=FRAMES)


@pytest.fixture(scope="module")
def clean():
    return SyntheticStereoSequence(frames=FRAMES, noise_gray=0.0)


def _rays(sequence):
    v, u = np.mgrid[: sequence.height, : sequence.width].astype(float)
    fx, cx, cy = (float(x) for x in (sequence.camera.fx, sequence.camera.cx, sequence.camera.cy))
    return np.stack([(u - cx) / fx, (v - cy) / fx, np.ones_like(u)], axis=-1)


def _warp_error(sequence, k, factor=1.0):
    """Photometric difference after fetching the right picture by depth, on pixels that both cameras see."""
    left, right = (image.astype(float) for image in sequence.images(k))
    depth = sequence.depth(k).astype(float) * factor
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    disparity = float(sequence.camera.fx) * float(sequence.stereo.baseline) / np.where(depth > 0, depth, 1e6)
    target = u - disparity
    inside = (target >= 0) & (target <= width - 2) & (depth > 0)
    column = np.clip(np.floor(target).astype(int), 0, width - 2)
    weight = target - column
    fetched = (1 - weight) * right[v, column] + weight * right[v, column + 1]
    # A surface in front, seen by the right camera in the same place, hides the point.
    front = np.full((height, width + 4), np.inf)
    for shift in (-1, 0, 1, 2):
        np.minimum.at(front, (v[inside], column[inside] + shift + 1), depth[inside])
    seen = inside & (depth <= 1.02 * front[v, column + 1])
    assert seen.mean() > 0.6
    return np.abs(fetched - left)[seen]


def test_reads_like_a_recorded_sequence(sequence):
    assert len(sequence) == FRAMES
    assert sequence.times.shape == (FRAMES,)
    np.testing.assert_allclose(np.diff(sequence.times), 0.1)
    left, right = sequence.images(3)
    assert left.shape == right.shape == (240, 640)
    assert left.dtype == right.dtype == np.uint8
    assert sequence.depth(3).dtype == np.float32
    assert sequence.images(-1)[0] is sequence.images(FRAMES - 1)[0]
    with pytest.raises(IndexError):
        sequence.images(FRAMES)


@pytest.mark.parametrize("seed", range(4))
def test_path_is_a_gentle_drive_with_one_bend(seed):
    poses = SyntheticStereoSequence(frames=FRAMES, seed=seed).poses
    assert poses.shape == (FRAMES, 3, 4)
    assert poses.dtype == np.float64
    np.testing.assert_array_equal(poses[0], np.eye(4)[:3])
    rotation = poses[:, :, :3]
    eye = np.broadcast_to(np.eye(3), rotation.shape)
    np.testing.assert_allclose(rotation @ rotation.swapaxes(1, 2), eye, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    step = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1)
    assert step.min() > 0.75
    assert step.max() < 1.2
    assert 36 < step.sum() < 46
    forward = rotation[:, :, 2]
    turn = np.degrees(np.arccos(np.clip(np.sum(forward[1:] * forward[:-1], axis=1), -1, 1)))
    assert turn.max() < 6
    assert 60 < np.degrees(np.arccos(forward[0] @ forward[-1])) < 95


@pytest.mark.parametrize("seed", range(6))
def test_camera_keeps_clear_of_everything(seed):
    path = make_path(96, seed)
    position = street_from_camera(path, np.arange(96), seed)[:, :3, 3]
    for x, z, yaw, half_x, half_z, _, _ in make_boxes(path, seed).geometry:
        dx, dz = position[:, 0] - x, position[:, 2] - z
        along, aside = np.cos(yaw) * dx - np.sin(yaw) * dz, np.sin(yaw) * dx + np.cos(yaw) * dz
        gap = np.hypot(np.maximum(np.abs(along) - half_x, 0), np.maximum(np.abs(aside) - half_z, 0))
        assert gap.min() > 1.2


def test_same_arguments_give_the_same_pictures(sequence):
    short = SyntheticStereoSequence(frames=6)
    for ours, theirs in zip(short.images(5), sequence.images(5), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(short.poses, sequence.poses[:6])
    other = SyntheticStereoSequence(frames=6, seed=1)
    assert np.mean(other.images(5)[0] != sequence.images(5)[0]) > 0.8


@pytest.mark.parametrize("k", [0, 24, 40])
def test_right_picture_is_the_left_one_moved_by_depth(clean, k):
    error = _warp_error(clean, k)
    assert np.median(error) < 2.0
    assert error.mean() < 4.0
    assert _warp_error(clean, k, factor=1.15).mean() > 1.5 * error.mean()


def _hit_by_polygons(rays, origin, geometry):
    """Depth by intersecting every face of every box, and the ground, one plane at a time."""
    depth = np.full(rays.shape[0], np.inf)
    t = (GROUND_Y - origin[1]) / rays[:, 1]
    depth = np.where((t > 0) & (t < 2000), t, depth)
    for x, z, yaw, half_x, half_z, top, bottom in geometry:
        axis_x, axis_z = np.array([np.cos(yaw), 0, -np.sin(yaw)]), np.array([np.sin(yaw), 0, np.cos(yaw)])
        down = np.array([0.0, 1.0, 0.0])
        centre = np.array([x, (top + bottom) / 2, z])
        half = {0: half_x, 1: (bottom - top) / 2, 2: half_z}
        axes = {0: axis_x, 1: down, 2: axis_z}
        for normal in range(3):
            for side in (-1, 1):
                point = centre + side * half[normal] * axes[normal]
                t = ((point - origin) @ axes[normal]) / (rays @ axes[normal])
                hit = origin + t[:, None] * rays - centre
                inside = t > 0.05
                for other in set(range(3)) - {normal}:
                    inside &= np.abs(hit @ axes[other]) <= half[other]
                depth = np.where(inside & (t < depth), t, depth)
    return np.where(np.isfinite(depth), depth, 0.0)


@pytest.mark.parametrize("k", [0, 22, 47])
def test_depth_is_exact(sequence, k):
    pose = sequence._street_from_cam[k]
    pick = np.s_[3::8, 5::8]
    rays = _rays(sequence)[pick] @ pose[:3, :3].T
    truth = _hit_by_polygons(rays.reshape(-1, 3), pose[:3, 3], sequence._boxes.geometry).reshape(rays.shape[:2])
    depth = sequence.depth(k)[pick]
    error = np.abs(depth - truth) / np.maximum(truth, 1e-3)
    # Rounding moves a few rays across an outline; far, tiny boxes may be left out of a picture.
    assert np.mean(error > 1e-4) < 0.004
    assert np.any(truth == 0) or k == 22


def test_ground_is_one_plane_in_the_world(sequence):
    """Points from depth and poses alone: the strip of road before the car lies on the plane of the first frame."""
    rays = _rays(sequence)[225:240, 280:360].reshape(-1, 3)

    def points(k):
        depth = sequence.depth(k)[225:240, 280:360].reshape(-1, 1)
        return (rays * depth) @ sequence.poses[k][:, :3].T + sequence.poses[k][:, 3]

    first = points(0)
    centre = first.mean(axis=0)
    normal = np.linalg.svd(first - centre)[2][2]
    assert np.abs((first - centre) @ normal).max() < 1e-4
    for k in (12, 30, 47):
        assert np.abs((points(k) - centre) @ normal).max() < 0.02


@pytest.mark.parametrize("k", [0, 16, 24, 32, 47])
def test_enough_corners_everywhere(sequence, k):
    cv2 = pytest.importorskip("cv2")
    left, _ = sequence.images(k)
    corners = cv2.goodFeaturesToTrack(left, 2000, 0.01, 5)[:, 0]
    assert len(corners) >= 300
    # In each third of the picture.
    assert np.histogram(corners[:, 0], bins=3, range=(0, 640))[0].min() >= 60
    assert 60 < left.mean() < 180
    assert np.mean(left == 255) < 0.12


@pytest.mark.slow
def test_knobs_break_the_assumptions(sequence):
    left = sequence.images(4)[0].astype(float)
    flat = SyntheticStereoSequence(frames=8, texture_contrast=0.0).images(4)[0].astype(float)
    assert np.abs(np.diff(flat, axis=1)).mean() < 0.7 * np.abs(np.diff(left, axis=1)).mean()
    flicker = SyntheticStereoSequence(frames=8, lighting_amplitude=0.5)
    assert flicker.images(6)[0].mean() > 1.15 * sequence.images(6)[0].mean()
    np.testing.assert_array_equal(flicker.images(0)[0], sequence.images(0)[0])
    sparse = SyntheticStereoSequence(frames=4, stride=2)
    np.testing.assert_allclose(sparse.poses, sequence.poses[:8:2])
    np.testing.assert_array_equal(sparse.images(2)[0], sequence.images(4)[0])
    np.testing.assert_allclose(sparse.times, [0, 0.2, 0.4, 0.6])


def test_a_moving_car_hides_what_stands_still(sequence):
    busy = SyntheticStereoSequence(frames=8, moving_cars=2)
    for k in (0, 7):
        with_car, without = busy.depth(k), sequence.depth(k)
        nearer = with_car < without - 0.5
        assert 0.002 < nearer.mean() < 0.3
        assert np.mean(with_car > without + 0.5) < 1e-3


@pytest.mark.parametrize(
    "bad", [{"frames": 0}, {"width": 4}, {"stride": 0}, {"supersample": 0}, {"noise_gray": -1.0}, {"seed": -1}]
)
def test_bad_arguments_are_named(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        SyntheticStereoSequence(**bad)


def test_a_lap_closes_and_bends_fast():
    sequence = SyntheticStereoSequence(frames=1001, lap=True)
    position, rotation = sequence.poses[:, :, 3], sequence.poses[:, :, :3]
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    assert 400.0 < steps[:500].sum() < 500.0
    # Back to within the sway of the car, in both laps.
    assert np.linalg.norm(position[[500, 1000]], axis=1).max() < 0.3
    turns = np.einsum("kij,kil->kjl", rotation[:-1], rotation[1:])
    angles = np.degrees(np.arccos((np.trace(turns, axis1=1, axis2=2) - 1) / 2))
    assert 4.0 < angles.max() < 6.0


def test_a_late_right_picture_is_that_of_a_later_time():
    exact = SyntheticStereoSequence(frames=4, noise_gray=0.0)
    late = SyntheticStereoSequence(frames=4, noise_gray=0.0, right_late=1.0)
    np.testing.assert_array_equal(late.images(2)[0], exact.images(2)[0])
    np.testing.assert_array_equal(late.images(2)[1], exact.images(3)[1])
    half = SyntheticStereoSequence(frames=4, noise_gray=0.0, right_late=0.5).images(3)[1]
    assert np.abs(half.astype(float) - exact.images(3)[1]).mean() > 1.0
    with pytest.raises(ValueError, match=r"right_late is -0\.1; expected at least 0"):
        SyntheticStereoSequence(frames=1, right_late=-0.1)


@pytest.mark.slow
def test_an_open_shutter_blurs_along_the_motion():
    sharp = SyntheticStereoSequence(frames=26, noise_gray=0.0)
    blurred = SyntheticStereoSequence(frames=26, noise_gray=0.0, shutter=0.5)
    # Frame 25 is in the bend: the picture moves sideways.
    one, other = (s.images(25)[0].astype(float) for s in (sharp, blurred))
    assert np.abs(np.diff(other, axis=1)).mean() < 0.7 * np.abs(np.diff(one, axis=1)).mean()
    assert abs(other.mean() - one.mean()) < 3.0
    np.testing.assert_array_equal(sharp.poses, blurred.poses)
