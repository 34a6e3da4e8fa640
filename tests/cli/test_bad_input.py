"""Everything a user can get wrong: one line, exit status 2, nothing lost."""

import dataclasses
import io
import json
import sys

import numpy as np
import pytest

from vojax.metrics import read_trajectory


@pytest.mark.parametrize(
    ("arguments", "found", "expected"),
    [
        (["fly"], "'fly'", "demo, run, compare, eval"),
        (["--fly"], "'--fly'", "demo, run, compare, eval"),
        (["demo", "--sead", "1"], "--sead", "--seed"),
        (["demo", "--colour", "red"], "--colour", "vojax demo --help"),
        (["demo", "--seed", "one"], "'one'", "whole number"),
        (["demo", "--frames", "0"], "frames", "at least 1"),
        (["demo", "--seed", "-1"], "-1", "at least 0"),
        (["run"], "missing", "--dataset"),
        (["run", "x", "--dataset", "mars", "--pipeline", "p", "--out", "o"], "'mars'", "kitti"),
        (["run", "x", "--dataset", "kitti", "--pipeline", "p", "--out"], "--out", "expected"),
        (["run", "x", "y", "--dataset", "kitti", "--pipeline", "p", "--out", "o"], "y", "vojax run --help"),
        (["eval", "a", "b", "--format", "csv"], "'csv'", "tum"),
        (["eval", "a", "b", "--format", "tum", "--alignment", "best"], "'best'", "sim3"),
        (["eval", "a", "b", "--format", "tum", "--max-difference-s", "soon"], "'soon'", "number"),
    ],
)
def test_arguments(vojax_command, tmp_path, monkeypatch, arguments, found, expected):
    monkeypatch.chdir(tmp_path)
    error = vojax_command(*arguments).error
    assert found in error
    assert expected in error
    assert error.startswith("vojax: error: ")


@pytest.mark.parametrize("columns", ["40", "200"])
@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_the_sentence_does_not_depend_on_the_terminal(vojax_command, monkeypatch, columns, encoding):
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding=encoding))
    assert vojax_command("demo", "--sead", "1").error == (
        "vojax: error: unrecognized options: --sead, 1; did you mean --seed N?; see vojax demo --help\n"
    )
    assert vojax_command("run", "x", "--dataset", "mars", "--pipeline", "p", "--out", "o").error == (
        "vojax: error: --dataset: found 'mars', expected one of 'kitti', 'tum', 'euroc', '7scenes', 'images'; "
        "see vojax run --help\n"
    )
    assert vojax_command("run", "--out", "o").error == (
        "vojax: error: missing from vojax run: PATH, --dataset {kitti,tum,euroc,7scenes,images}, --pipeline NAME; "
        "see vojax run --help\n"
    )


def test_unknown_pipeline(run_kitti, tmp_path):
    error = run_kitti("--pipeline", "mono").error
    assert "'mono'" in error
    assert "stereo-3d2d" in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("option", "value"), [("--max-frames", 0), ("--seed", -1)])
def test_numbers_out_of_range(run_kitti, fake, tmp_path, option, value):
    error = run_kitti(option, value).error
    assert str(value) in error
    assert "expected" in error
    assert fake.made == []


def test_missing_folder(vojax_command, tmp_path, fake):
    error = vojax_command(
        "run", tmp_path / "nowhere", "--dataset", "kitti", "--sequence", "07", "--pipeline", "stereo-3d2d",
        "--out", tmp_path / "out",
    ).error  # fmt: skip
    assert "nowhere" in error
    assert "expected a folder" in error
    assert not (tmp_path / "out").exists()


def test_missing_sequence(run_kitti, fake):
    error = run_kitti(sequence="99").error
    assert "'99'" in error
    assert "(07)" in error


def test_sequence_must_be_named_where_there_are_several(vojax_command, kitti, tmp_path, fake):
    (kitti / "sequences" / "08").mkdir()
    error = vojax_command(
        "run", kitti, "--dataset", "kitti", "--pipeline", "stereo-3d2d", "--out", tmp_path / "out"
    ).error
    assert "--sequence" in error
    assert "07, 08" in error


def test_missing_calibration(run_kitti, kitti, fake):
    (kitti / "sequences" / "07" / "calib.txt").unlink()
    error = run_kitti().error
    assert "calib.txt not found" in error
    assert "P0" in error


def test_calibration_with_a_wrong_number_of_columns(run_kitti, kitti, fake):
    (kitti / "sequences" / "07" / "calib.txt").write_text("P0: 1 2 3\nP1: 1 2 3\n")
    error = run_kitti().error
    assert "3 columns" in error
    assert "12 numbers" in error


def test_missing_right_images(run_kitti, kitti, fake):
    folder = kitti / "sequences" / "07"
    (folder / "image_1").rename(folder / "elsewhere")
    assert "image_1" in run_kitti().error


def test_left_and_right_counts_differ(run_kitti, kitti, fake):
    (kitti / "sequences" / "07" / "image_1" / "000005.png").unlink()
    error = run_kitti().error
    assert "6 images in image_0 and 5 in image_1" in error


def test_nan_poses(run_kitti, kitti, fake, tmp_path):
    path = kitti / "poses" / "07.txt"
    path.write_text(path.read_text().replace("1 0 0 0 0 1 0 0 0 0 1 3", "1 0 0 0 0 1 0 0 0 0 1 nan"))
    error = run_kitti().error
    assert "07.txt, line 4" in error
    assert "finite" in error
    assert fake.made == []


def test_results_folder_is_a_file(run_kitti, tmp_path, fake):
    (tmp_path / "out").write_text("precious")
    error = run_kitti().error
    assert "is a file; expected a folder" in error
    assert (tmp_path / "out").read_text() == "precious"


def test_results_folder_cannot_be_made(run_kitti, tmp_path, fake):
    (tmp_path / "file").write_text("precious")
    error = run_kitti("--out", tmp_path / "file" / "out").error
    assert "file/out" in error
    assert (tmp_path / "file").read_text() == "precious"


def truncate(path):
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


DAMAGES = [truncate, lambda path: path.write_bytes(b""), lambda path: path.write_text("text")]


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_image_in_mid_run_is_bridged_and_said(run_kitti, kitti, fake, tmp_path, damage):
    damage(kitti / "sequences" / "07" / "image_1" / "000003.png")
    outcome = run_kitti()
    assert outcome.status == 0
    assert fake.made[0].images[3] is None
    assert "1 frame could not be read: 3 (3:" in outcome.stdout
    assert "000003.png" in outcome.stdout
    for format, name in (("tum", "trajectory.txt"), ("kitti", "trajectory_kitti.txt")):
        trajectory = read_trajectory(tmp_path / "out" / name, format)
        np.testing.assert_allclose(trajectory.positions[:, 2], 1.01 * np.arange(6), atol=1e-9)
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (metrics["frames"], metrics["failures"], metrics["error"]) == (6, 1, None)
    assert metrics["bridged_frames"] == metrics["unreadable_frames"] == [3]
    assert metrics["flags"] == {"the frame could not be read": 1}


def test_images_that_end_early_keep_what_was_done(run_kitti, kitti, fake, tmp_path):
    for k, damage in zip((3, 4, 5), DAMAGES, strict=True):
        damage(kitti / "sequences" / "07" / "image_1" / f"{k:06d}.png")
    outcome = run_kitti()
    error = outcome.error
    assert "ends early, with frame 2 of 6" in error
    assert "000003.png" in error
    assert "3 poses kept in" in error
    for format, name in (("tum", "trajectory.txt"), ("kitti", "trajectory_kitti.txt")):
        trajectory = read_trajectory(tmp_path / "out" / name, format)
        np.testing.assert_allclose(trajectory.positions[:, 2], [0, 1.01, 2.02], atol=1e-9)
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["frames"] == 3
    assert metrics["frames_in_sequence"] == 6
    assert metrics["failures"] == 0
    assert metrics["unreadable_frames"] == [3, 4, 5]
    assert "000003.png" in metrics["error"]
    assert metrics["path_length_m"] == pytest.approx(2.0)
    assert (tmp_path / "out" / "trajectory.png").read_text() == "3 poses"
    assert "ATE" in outcome.stdout


def test_damaged_first_image_leaves_earlier_results_alone(run_kitti, kitti, fake, tmp_path):
    assert run_kitti().status == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    truncate(kitti / "sequences" / "07" / "image_0" / "000000.png")
    assert "000000.png" in run_kitti().error
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


def test_one_frame_that_can_be_read_leaves_one_pose_and_no_old_numbers(run_kitti, kitti, fake, tmp_path):
    assert run_kitti().status == 0
    for k in range(1, 6):
        truncate(kitti / "sequences" / "07" / "image_0" / f"{k:06d}.png")
    assert "1 pose kept" in run_kitti().error
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["frames"] == 1
    assert len(read_trajectory(tmp_path / "out" / "trajectory.txt")) == 1
    assert not (tmp_path / "out" / "trajectory.png").exists()


def test_calibration_of_another_image_size(vojax_command, kitti, fake, tmp_path):
    calibration = tmp_path / "camera.txt"
    calibration.write_text("1 PINHOLE 640 480 500 500 320 240\n")
    (tmp_path / "cameras.txt").write_text(calibration.read_text())
    error = vojax_command(
        "run", kitti / "sequences" / "07" / "image_0", "--dataset", "images", "--pipeline", "mono-3d2d",
        "--calibration", tmp_path / "cameras.txt", "--out", tmp_path / "out",
    ).error  # fmt: skip
    assert "32×16" in error
    assert "640×480" in error


@pytest.mark.parametrize(
    ("dataset", "more", "said"),
    [
        ("kitti", ["--pipeline", "rgbd-3d2d"], "an image with its depth per frame, and the data set kitti has"),
        ("tum", ["--pipeline", "stereo-3d2d"], "choose one of mono-2d2d, mono-3d2d, planar-1pt, rgbd-3d2d"),
        ("images", ["--pipeline", "mono-3d2d"], "--dataset images needs --calibration FILE"),
        ("euroc", ["--pipeline", "mono-3d2d", "--calibration", "x.yaml"], "expected none, as euroc has its own"),
        ("tum", ["--pipeline", "mono-3d2d", "--camera-name", "cam0"], "expected --calibration with it"),
        ("tum", ["--pipeline", "mono-3d2d", "--sequence", "desk"], "choose one of those there (poses, sequences)"),
        ("tum", ["--pipeline", "mono-3d2d"], "does not tell which camera took it"),
        ("tum", ["--pipeline", "mono-3d2d", "--sequence", "sequences"], "does not tell which camera took it"),
        ("7scenes", ["--pipeline", "rgbd-3d2d"], "holds no colour images"),
        ("euroc", ["--pipeline", "stereo-3d2d"], "expected a folder that holds mav0"),
        ("images", ["--pipeline", "mono-3d2d", "--calibration", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_what_does_not_fit_together(vojax_command, kitti, fake, tmp_path, dataset, more, said):
    error = vojax_command("run", kitti, "--dataset", dataset, *more, "--out", tmp_path / "out").error
    assert said in error
    assert fake.made == []
    assert not (tmp_path / "out").exists()


def test_times_out_of_order(run_kitti, kitti, fake):
    path = kitti / "sequences" / "07" / "times.txt"
    path.write_text("0\n0.2\n0.1\n0.3\n0.4\n0.5\n")
    error = run_kitti().error
    assert "times.txt, line 3" in error
    assert "order" in error or "increas" in error


def test_a_pose_that_is_not_finite_is_never_written(run_kitti, fake, tmp_path, monkeypatch):
    good = fake.step

    def step(self, *images):
        estimate = good(self, *images)
        pose = estimate.world_from_cam * (np.nan if len(self.images) == 5 else 1.0)
        return dataclasses.replace(estimate, world_from_cam=pose)

    monkeypatch.setattr(fake, "step", step)
    error = run_kitti().error
    assert "frame 4" in error
    assert "not finite" in error
    assert len(read_trajectory(tmp_path / "out" / "trajectory.txt")) == 4


def test_interrupted_run_says_so_in_one_line(run_kitti, fake, tmp_path, monkeypatch):
    def stop(self, k):
        if k == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(fake, "before", stop)
    outcome = run_kitti()
    assert outcome.status == 130
    assert "2 poses kept in" in outcome.line
    assert len(read_trajectory(tmp_path / "out" / "trajectory.txt")) == 2
    assert len(read_trajectory(tmp_path / "out" / "trajectory_kitti.txt", "kitti")) == 2


def test_a_fault_of_the_program_keeps_its_traceback_and_the_files(run_kitti, fake, tmp_path, monkeypatch):
    def fail(self, k):
        if k == 4:
            raise RuntimeError("a fault")

    monkeypatch.setattr(fake, "before", fail)
    with pytest.raises(RuntimeError, match="a fault"):
        run_kitti()
    assert len(read_trajectory(tmp_path / "out" / "trajectory.txt")) == 4
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (metrics["frames"], metrics["error"]) == (4, "a fault")


def test_traceback_on_request(run_kitti, fake, monkeypatch):
    monkeypatch.setenv("VOJAX_TRACEBACK", "1")
    with pytest.raises(FileNotFoundError, match="'99'"):
        run_kitti(sequence="99")


@pytest.mark.parametrize(
    ("package", "importers"), [("tyro", ["_arguments"]), ("rich", ["_run", "_progress", "_report"])]
)
def test_missing_extra(run_kitti, fake, monkeypatch, package, importers):
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    for name in importers:
        monkeypatch.delitem(sys.modules, f"vojax.cli.{name}", raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    error = run_kitti().error
    assert package in error
    assert "pip install 'vojax[cli]'" in error
