import copy
import itertools
import json
import math

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from vojax.metrics import Metrics, Trajectory, align, associate, evaluate, kitti_errors, read_trajectory

ALIGNMENTS = ("none", "se3", "sim3")


def _poses(rotations, positions):
    poses = np.tile(np.eye(4)[None], (len(positions), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = positions
    return poses


def _wander(n=60, seed=0, noise=0.0):
    """A smooth walk and, with noise, a drifting estimate of it."""
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(n - 1):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec([0.02, 0.08, -0.01] + noise * rng.normal(size=3)).as_matrix()
        step[:3, 3] = [0.1, -0.02, 1.0] + noise * rng.normal(size=3)
        poses.append(poses[-1] @ step)
    return Trajectory(np.arange(n) * 0.1, np.array(poses))


def _evo(estimate, truth, alignment):
    """APE and RPE of evo for pairs that match already."""
    truth = PoseTrajectory3D(poses_se3=list(truth.world_from_cam), timestamps=truth.timestamps)
    estimate = PoseTrajectory3D(poses_se3=list(estimate.world_from_cam), timestamps=estimate.timestamps)
    return _evo_numbers(estimate, truth, alignment)


def _evo_numbers(estimate, truth, alignment):
    estimate = copy.deepcopy(estimate)
    if alignment == "origin":
        estimate.align_origin(truth)
    elif alignment != "none":
        estimate.align(truth, correct_scale=alignment == "sim3")
    relation = evo_metrics.PoseRelation
    found = []
    for metric in (
        evo_metrics.APE(relation.translation_part),
        evo_metrics.RPE(relation.translation_part, 1, evo_metrics.Unit.frames, all_pairs=False),
        evo_metrics.RPE(relation.rotation_angle_deg, 1, evo_metrics.Unit.frames, all_pairs=False),
    ):
        metric.process_data((truth, estimate))
        found.append(metric.get_statistic(evo_metrics.StatisticsType.rmse))
    return found


@pytest.mark.parametrize("alignment", ALIGNMENTS)
def test_synthetic_agrees_with_evo(alignment):
    truth = _wander()
    estimate = _wander(noise=0.02, seed=5)
    world = _poses(Rotation.from_rotvec([[0.3, -1.0, 2.0]]).as_matrix(), [[10.0, -4.0, 2.0]])
    shrunk = np.array(world @ estimate.world_from_cam)
    shrunk[:, :3, 3] *= 0.37
    estimate = Trajectory(estimate.timestamps, shrunk)
    metrics = evaluate(estimate, truth, alignment, origin="given")
    ate, rpe_trans, rpe_rot = _evo(estimate, truth, alignment)
    assert metrics.ate_rmse_m == pytest.approx(ate, abs=1e-9)
    assert metrics.rpe_trans_m == pytest.approx(rpe_trans, abs=1e-9)
    assert metrics.rpe_rot_deg == pytest.approx(rpe_rot, abs=1e-6)
    assert metrics.ate_rmse_se3_m == pytest.approx(_evo(estimate, truth, "se3")[0], abs=1e-9)
    assert metrics.ate_rmse_sim3_m == pytest.approx(_evo(estimate, truth, "sim3")[0], abs=1e-9)


PAIRS = [
    ("fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt", "tum"),
    ("freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt", "tum"),
    ("freiburg1_xyz-rgbdslam_drift.txt", "freiburg1_xyz-groundtruth.txt", "tum"),
    ("KITTI_00_ORB.txt", "KITTI_00_gt.txt", "kitti"),
]


def _check_against_evo(folder, estimate_name, truth_name, format, limit):
    """Compare on the first `limit` poses of the estimate (evo takes half a minute for all of them)."""
    estimate, truth = (read_trajectory(folder / name, format) for name in (estimate_name, truth_name))
    if format == "tum":
        theirs, evo_truth = (
            file_interface.read_tum_trajectory_file(folder / name) for name in (estimate_name, truth_name)
        )
        theirs.reduce_to_ids(np.arange(len(estimate))[:limit])
        evo_truth, theirs = sync.associate_trajectories(evo_truth, theirs)
    else:
        theirs, evo_truth = (
            file_interface.read_kitti_poses_file(folder / name) for name in (estimate_name, truth_name)
        )
        for path in (theirs, evo_truth):
            path.reduce_to_ids(np.arange(len(estimate))[:limit])
    estimate = estimate.select(np.arange(len(estimate))[:limit])
    for alignment in ALIGNMENTS:
        metrics = evaluate(estimate, truth, alignment, origin="given")
        ate, rpe_trans, rpe_rot = _evo_numbers(theirs, evo_truth, alignment)
        assert metrics.frames == theirs.num_poses
        assert metrics.ate_rmse_m == pytest.approx(ate, abs=1e-6)
        assert metrics.rpe_trans_m == pytest.approx(rpe_trans, abs=1e-6)
        assert metrics.rpe_rot_deg == pytest.approx(rpe_rot, abs=1e-6)
        assert metrics.path_length_m == pytest.approx(evo_truth.path_length, abs=1e-6)
        at_origin = evaluate(estimate, truth, alignment, origin="identity")
        # evo inverts the first pose as it stands; its seven digits scale a path of half a kilometre by 1e-7.
        if alignment == "none":
            assert at_origin.ate_rmse_m == pytest.approx(_evo_numbers(theirs, evo_truth, "origin")[0], abs=1e-4)
        else:
            assert at_origin.ate_rmse_m == pytest.approx(ate, abs=1e-6)


@pytest.mark.data
@pytest.mark.parametrize(("estimate_name", "truth_name", "format"), PAIRS)
def test_real_trajectories_agree_with_evo(data_root, estimate_name, truth_name, format):
    _check_against_evo(data_root / "trajectories", estimate_name, truth_name, format, limit=250)


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(("estimate_name", "truth_name", "format"), PAIRS)
def test_whole_real_trajectories_agree_with_evo(data_root, estimate_name, truth_name, format):
    _check_against_evo(data_root / "trajectories", estimate_name, truth_name, format, limit=None)


def _devkit(estimate, truth):
    """The development kit's definition as a plain loop over frames."""
    distance = [0.0]
    for before, after in itertools.pairwise(truth):
        distance.append(distance[-1] + np.linalg.norm(after[:3, 3] - before[:3, 3]))
    translation, rotation = [], []
    for first in range(0, len(truth), 10):
        for length in (100, 200, 300, 400, 500, 600, 700, 800):
            last = next((i for i in range(first, len(truth)) if distance[i] > distance[first] + length), None)
            if last is None:
                continue
            true = np.linalg.inv(truth[first]) @ truth[last]
            found = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(found) @ true
            translation.append(np.linalg.norm(error[:3, 3]) / length)
            cosine = 0.5 * (error[0, 0] + error[1, 1] + error[2, 2] - 1)
            rotation.append(math.acos(max(min(cosine, 1.0), -1.0)) / length)
    return 100 * np.mean(translation), np.degrees(np.mean(rotation)) * 100, len(translation)


def test_kitti_errors_equal_a_plain_loop():
    truth = _wander(400)
    estimate = _wander(400, seed=2, noise=0.003)
    t_rel, r_rel, count = _devkit(estimate.world_from_cam, truth.world_from_cam)
    errors = kitti_errors(estimate.world_from_cam, truth.world_from_cam)
    assert len(errors.translation) == count > 50
    assert errors.t_rel_percent == pytest.approx(t_rel, rel=1e-9)
    assert errors.r_rel_deg_per_100m == pytest.approx(r_rel, rel=1e-7)
    metrics = evaluate(estimate, truth)
    assert metrics.kitti_t_rel_percent == pytest.approx(t_rel, rel=1e-9)
    assert metrics.kitti_r_rel_deg_per_100m == pytest.approx(r_rel, rel=1e-7)


@pytest.mark.data
def test_kitti_errors_of_orb_slam_equal_a_plain_loop(data_root):
    folder = data_root / "trajectories"
    # A shorter piece: the loop is slow.
    truth = read_trajectory(folder / "KITTI_00_gt.txt", "kitti").world_from_cam[:1000]
    estimate = read_trajectory(folder / "KITTI_00_ORB.txt", "kitti").world_from_cam[:1000]
    t_rel, r_rel, count = _devkit(estimate, truth)
    errors = kitti_errors(estimate, truth)
    assert len(errors.translation) == count
    assert errors.t_rel_percent == pytest.approx(t_rel, abs=1e-6)
    assert errors.r_rel_deg_per_100m == pytest.approx(r_rel, abs=1e-6)
    # Visual odometry drifts by 0.1 to 2 % of the distance, says the literature; ORB-SLAM2 is in the band.
    assert 0.1 < errors.t_rel_percent < 2.0


def test_kitti_errors_known_answers():
    straight = _poses(np.eye(3)[None], np.arange(301.0)[:, None] * np.array([[0.0, 0.0, 1.0]]))
    longer = straight.copy()
    longer[:, :3, 3] *= 1.01
    errors = kitti_errors(longer, straight)
    # A stretch ends at the first frame beyond its length: 101 m for 100 m, and 1 % of that is 1.01 m.
    np.testing.assert_allclose(errors.translation, 0.01 * (errors.lengths_m + 1) / errors.lengths_m, rtol=1e-9)
    assert errors.r_rel_deg_per_100m == pytest.approx(0.0, abs=1e-6)
    # Stretches of 100 m start at 0, 10, …, 190 (20 of them); of 200 m at 0 … 90 (10); 300 m needs frame 301.
    assert [int(np.sum(errors.lengths_m == length)) for length in (100, 200, 300)] == [20, 10, 0]
    # A yaw of 0.01 degrees per metre: 1.01 degrees over 101 frames.
    yaw = Rotation.from_rotvec(np.radians(0.01) * np.arange(301.0)[:, None] * np.array([[0.0, 1.0, 0.0]]))
    turning = _poses(yaw.as_matrix(), straight[:, :3, 3])
    found = kitti_errors(turning, straight, lengths_m=(100.0,))
    assert found.r_rel_deg_per_100m == pytest.approx(1.01, rel=1e-6)


def test_short_paths_have_no_kitti_numbers():
    metrics = evaluate(_wander(50), _wander(50))
    assert metrics.kitti_t_rel_percent is None
    assert metrics.kitti_r_rel_deg_per_100m is None


def test_known_answers():
    positions = np.arange(11.0)[:, None] * np.array([[0.0, 0.0, 1.0]])
    truth = Trajectory(np.arange(11.0), _poses(np.eye(3)[None], positions))
    estimate = Trajectory(np.arange(11.0), _poses(np.eye(3)[None], 1.1 * positions))
    metrics = evaluate(estimate, truth)
    assert metrics.ate_rmse_m == pytest.approx(0.1 * np.sqrt(np.mean(np.arange(11.0) ** 2)), abs=1e-12)
    assert metrics.drift_percent == pytest.approx(10.0, abs=1e-9)
    assert metrics.rpe_trans_m == pytest.approx(0.1, abs=1e-12)
    assert metrics.rpe_rot_deg == pytest.approx(0.0, abs=1e-9)
    assert metrics.path_length_m == 10
    # All on a line: the rotation about it stays open, the errors do not.
    assert metrics.ate_rmse_se3_m == pytest.approx(0.1 * np.sqrt(np.mean((np.arange(11.0) - 5) ** 2)), abs=1e-9)
    assert metrics.ate_rmse_sim3_m == pytest.approx(0.0, abs=1e-9)
    assert evaluate(estimate, truth, "sim3").scale == pytest.approx(1 / 1.1, rel=1e-9)


def test_both_start_at_identity():
    truth = _wander()
    world = _poses(Rotation.from_rotvec([[0.3, -1.0, 2.0]]).as_matrix(), [[10.0, -4.0, 2.0]])
    elsewhere = Trajectory(truth.timestamps, world @ truth.world_from_cam)
    metrics = evaluate(elsewhere, truth)
    assert metrics.ate_rmse_m < 1e-10
    assert metrics.rpe_rot_deg < 1e-6
    assert evaluate(elsewhere, truth, origin="given").ate_rmse_m > 5
    pair = align(elsewhere, truth, origin="identity")
    np.testing.assert_allclose(pair.estimate.world_from_cam[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(pair.truth.world_from_cam[0], np.eye(4), atol=1e-12)


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
def test_alignment_recovers_the_transform_poses_included(alignment):
    truth = _wander()
    world = _poses(Rotation.from_rotvec([[0.3, -1.0, 2.0]]).as_matrix(), [[10.0, -4.0, 2.0]])
    moved = np.array(world @ truth.world_from_cam)
    scale = 1.0
    if alignment == "sim3":
        moved[:, :3, 3] *= 4.0
        scale = 0.25
    pair = align(Trajectory(truth.timestamps, moved), truth, alignment, origin="given")
    np.testing.assert_allclose(pair.estimate.world_from_cam, truth.world_from_cam, atol=1e-9)
    assert pair.scale == pytest.approx(scale, rel=1e-10)
    np.testing.assert_allclose(pair.rotation_errors_deg, 0.0, atol=1e-6)
    metrics = evaluate(Trajectory(truth.timestamps, moved), truth, alignment)
    # After Sim(3) every number is in the truth's metres, drift and RPE too.
    assert metrics.drift_percent < 1e-7
    assert metrics.rpe_trans_m < 1e-9


@pytest.mark.parametrize("alignment", ALIGNMENTS)
def test_a_camera_that_stood_still(alignment):
    moving = _wander(20)
    still = Trajectory(moving.timestamps, np.tile(np.eye(4)[None], (20, 1, 1)))
    metrics = evaluate(still, moving, alignment)
    numbers = [value for value in metrics.as_dict().values() if isinstance(value, float)]
    assert np.all(np.isfinite(numbers))
    spread = moving.positions - moving.positions.mean(axis=0, keepdims=True)
    assert metrics.ate_rmse_se3_m == pytest.approx(np.sqrt(np.mean(np.sum(spread**2, axis=1))), rel=1e-9)
    assert metrics.scale == 1.0
    at_rest = evaluate(still, still, alignment)
    assert at_rest.drift_percent is None
    assert at_rest.ate_rmse_m == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
def test_on_a_line_the_orientations_settle_the_roll(alignment):
    roll = Rotation.from_rotvec(np.linspace(0.0, 2.0, 15)[:, None] * np.array([[0.0, 0.0, 1.0]])).as_matrix()
    truth = Trajectory(np.arange(15.0), _poses(roll, np.arange(15.0)[:, None] * np.array([[0.0, 0.0, 1.0]])))
    world = _poses(Rotation.from_rotvec([[0.3, -1.0, 2.0]]).as_matrix(), [[10.0, -4.0, 2.0]])
    moved = np.array(world @ truth.world_from_cam)
    moved[:, :3, 3] *= 2.0 if alignment == "sim3" else 1.0
    pair = align(Trajectory(truth.timestamps, moved), truth, alignment, origin="given")
    np.testing.assert_allclose(pair.position_errors, 0.0, atol=1e-8)
    np.testing.assert_allclose(pair.rotation_errors_deg, 0.0, atol=1e-3)


def test_two_poses_are_enough_and_one_is_not():
    metrics = evaluate(_wander(2), _wander(2), "se3")
    assert metrics.ate_rmse_m == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(ValueError, match="single time"):
        evaluate(_wander(1), _wander(2))


def test_an_estimate_that_ends_early_is_compared_where_it_exists():
    assert evaluate(_wander(30), _wander(60)).frames == 30


def test_no_common_times():
    late = Trajectory(_wander().timestamps + 1000.0, _wander().world_from_cam)
    with pytest.raises(ValueError, match=r"share no times within 0\.01 s"):
        evaluate(late, _wander())


def test_as_dict_is_what_metrics_json_holds():
    found = evaluate(_wander(noise=0.01, seed=1), _wander(), "sim3").as_dict()
    assert json.loads(json.dumps(found)) == found
    contract = {
        "ate_rmse_m", "alignment", "ate_rmse_se3_m", "ate_rmse_sim3_m", "drift_percent", "rpe_trans_m", "rpe_rot_deg",
        "kitti_t_rel_percent", "kitti_r_rel_deg_per_100m", "frames",
    }  # fmt: skip
    assert contract <= set(found)
    assert Metrics(**found).alignment == "sim3"


def _shuffled_times(rng, n, jitter):
    return np.sort(np.arange(n) * 0.05 + rng.uniform(-jitter, jitter, n))


@pytest.mark.parametrize("seed", range(10))
def test_association_agrees_with_evo(seed):
    rng = np.random.default_rng(seed)
    a = _shuffled_times(rng, 80, 0.02)[rng.random(80) < 0.8]
    b = _shuffled_times(rng, 90, 0.02)
    for first, second in ((a, b), (b, a)):
        ours = associate(first, second, 0.012)
        swap = second.size <= first.size
        short, long = (second, first) if swap else (first, second)
        theirs_short, theirs_long = sync.matching_time_indices(short, long, 0.012)
        # evo lets two short times share one long time; ours keeps the nearer.
        best = {}
        for i, j in zip(theirs_short, theirs_long, strict=True):
            if j not in best or abs(short[i] - long[j]) < abs(short[best[j]] - long[j]):
                best[j] = i
        expected = sorted((i, j) for j, i in best.items())
        found = list(zip(*(reversed(ours) if swap else ours), strict=True))
        assert [(int(i), int(j)) for i, j in found] == expected


def test_association_uses_each_time_once():
    a, b = associate(np.array([0.0, 0.4, 0.6]), np.array([0.5, 10.0, 20.0, 30.0]), max_difference_s=1.0)
    assert (a.tolist(), b.tolist()) == ([1], [0])
    a, b = associate(np.zeros(0), np.arange(3.0))
    assert a.size == b.size == 0
