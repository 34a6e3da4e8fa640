import json

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.tools import file_interface

from vojax.metrics import Trajectory, read_trajectory, write_trajectory

ALIGNMENTS = ("none", "se3", "sim3")


def wander(n, noise, seed):
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(n - 1):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec([0.02, 0.08, -0.01] + noise * rng.normal(size=3)).as_matrix()
        step[:3, 3] = [0.1, -0.02, 1.0] + noise * rng.normal(size=3)
        poses.append(poses[-1] @ step)
    return Trajectory(0.1 * np.arange(n), np.array(poses))


def evo_numbers(estimate_path, truth_path, format, alignment):
    if format == "tum":
        estimate, truth = map(file_interface.read_tum_trajectory_file, (estimate_path, truth_path))
        truth, estimate = sync.associate_trajectories(truth, estimate)
    else:
        estimate, truth = map(file_interface.read_kitti_poses_file, (estimate_path, truth_path))
    if alignment != "none":
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


def check_against_evo(vojax_command, estimate_path, truth_path, format, tmp_path):
    for alignment in ALIGNMENTS:
        outcome = vojax_command(
            "eval", estimate_path, truth_path, "--format", format, "--alignment", alignment, "--origin", "given",
            "--json", tmp_path / "numbers.json",
        )  # fmt: skip
        assert outcome.status == 0, outcome.stderr
        assert outcome.stderr == ""
        numbers = json.loads((tmp_path / "numbers.json").read_text())
        expected = evo_numbers(estimate_path, truth_path, format, alignment)
        found = [numbers[name] for name in ("ate_rmse_m", "rpe_trans_m", "rpe_rot_deg")]
        np.testing.assert_allclose(found, expected, atol=1e-6, rtol=0)
        assert numbers["alignment"] == alignment
        assert f"{expected[0]:.5g}"[:5] in outcome.stdout
        for name in ("ate_rmse_se3_m", "ate_rmse_sim3_m", "drift_percent"):
            assert name in outcome.stdout


@pytest.mark.parametrize("format", ["tum", "kitti"])
def test_agrees_with_evo(vojax_command, tmp_path, format):
    write_trajectory(tmp_path / "estimate.txt", wander(40, 0.02, 1), format)
    write_trajectory(tmp_path / "truth.txt", wander(40, 0.0, 0), format)
    check_against_evo(vojax_command, tmp_path / "estimate.txt", tmp_path / "truth.txt", format, tmp_path)


@pytest.mark.data
@pytest.mark.parametrize(
    ("estimate", "truth", "format"),
    [
        ("freiburg1_xyz-rgbdslam_drift.txt", "freiburg1_xyz-groundtruth.txt", "tum"),
        ("fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt", "tum"),
        ("KITTI_00_ORB.txt", "KITTI_00_gt.txt", "kitti"),
    ],
)
def test_agrees_with_evo_on_real_trajectories(vojax_command, data_root, tmp_path, estimate, truth, format):
    # The first poses only: evo takes half a minute for all of them.
    for name, limit in ((estimate, 200), (truth, 4000 if format == "tum" else 200)):
        lines = (data_root / "trajectories" / name).read_text().splitlines(keepends=True)
        (tmp_path / name).write_text("".join(lines[:limit]))
    check_against_evo(vojax_command, tmp_path / estimate, tmp_path / truth, format, tmp_path)


def test_origins_and_the_part_in_common(vojax_command, tmp_path):
    truth = wander(20, 0.0, 0)
    moved = np.array(truth.world_from_cam[:8])
    moved[:, :3, 3] += np.array([[5.0, 0.0, 0.0]])
    write_trajectory(tmp_path / "truth.txt", truth)
    write_trajectory(tmp_path / "estimate.txt", Trajectory(truth.timestamps[:8], moved))
    for origin, expected in (("identity", 0.0), ("given", 5.0)):
        outcome = vojax_command(
            "eval", tmp_path / "estimate.txt", tmp_path / "truth.txt", "--format", "tum", "--origin", origin,
            "--json", tmp_path / "numbers.json",
        )  # fmt: skip
        numbers = json.loads((tmp_path / "numbers.json").read_text())
        assert numbers["ate_rmse_m"] == pytest.approx(expected, abs=1e-9)
        assert (numbers["frames"], numbers["frames_in_truth"]) == (8, 20)
        assert "8 poses in the estimate, 20 in the truth, 8 compared" in outcome.stdout
        assert origin in outcome.stdout


def test_run_and_eval_say_the_same(run_kitti, vojax_command, kitti, fake, tmp_path):
    assert run_kitti().status == 0
    of_run = json.loads((tmp_path / "out" / "metrics.json").read_text())
    outcome = vojax_command(
        "eval", tmp_path / "out" / "trajectory_kitti.txt", kitti / "poses" / "07.txt", "--format", "kitti",
        "--json", tmp_path / "numbers.json",
    )  # fmt: skip
    assert outcome.status == 0
    of_eval = json.loads((tmp_path / "numbers.json").read_text())
    for name in ("ate_rmse_m", "ate_rmse_se3_m", "drift_percent", "rpe_trans_m", "rpe_rot_deg", "path_length_m"):
        assert of_eval[name] == pytest.approx(of_run[name], abs=1e-9)
    assert of_run["ate_rmse_m"] > 0.01


LINE = "{} 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("estimate", "more", "expected"),
    [
        (None, (), "no such trajectory file"),
        ("", (), "holds no poses"),
        ("1 2 3\n", (), "expected 8"),
        ("0 0 0 nan 0 0 0 1\n", (), "not finite"),
        (LINE.format(0), ("--format", "kitti"), "expected 12"),
        (LINE.format(100) + LINE.format(101), (), "share no times"),
        (LINE.format(0) + LINE.format(77), (), "single time"),
        (LINE.format(0) + LINE.format(1), ("--max-difference-s", -1), "expected seconds"),
        (LINE.format(0) + LINE.format(1), ("--json", "truth.txt"), "choose another file"),
        (LINE.format(0) + LINE.format(1), ("--json", "nowhere/numbers.json"), "nowhere/numbers.json"),
    ],
)
def test_bad_input(vojax_command, tmp_path, monkeypatch, estimate, more, expected):
    monkeypatch.chdir(tmp_path)
    truth = LINE.format(0) + LINE.format(1)
    (tmp_path / "truth.txt").write_text(truth)
    if estimate is not None:
        (tmp_path / "estimate.txt").write_text(estimate)
    error = vojax_command("eval", "estimate.txt", "truth.txt", "--format", "tum", *more).error
    assert expected in error
    assert (tmp_path / "truth.txt").read_text() == truth
    assert not list(tmp_path.glob("*.part"))


def test_a_path_that_never_moves_has_no_drift(vojax_command, tmp_path):
    write_trajectory(tmp_path / "still.txt", Trajectory(np.arange(3.0), np.tile(np.eye(4)[None], (3, 1, 1))))
    outcome = vojax_command(
        "eval", tmp_path / "still.txt", tmp_path / "still.txt", "--format", "tum", "--json", tmp_path / "numbers.json"
    )
    assert outcome.status == 0
    assert json.loads((tmp_path / "numbers.json").read_text())["drift_percent"] is None
    assert len(read_trajectory(tmp_path / "still.txt")) == 3
