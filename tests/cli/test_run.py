import io
import json
import pathlib
import platform
import signal
import subprocess
import sys

import jax
import numpy as np
import pytest

import vojax
import vojax.datasets
from vojax.cameras import Pinhole, RectifiedStereo
from vojax.metrics import read_trajectory
from vojax.odometry import Flag

NAMES = {
    "ate_rmse_m", "alignment", "ate_rmse_se3_m", "ate_rmse_sim3_m", "drift_percent", "rpe_trans_m", "rpe_rot_deg",
    "kitti_t_rel_percent", "kitti_r_rel_deg_per_100m", "frames", "frames_per_second", "compile_seconds",
    "first_pose_seconds", "mean_inliers", "failures", "peak_memory_mb", "versions",
}  # fmt: skip
FRAMES = 6


def read_metrics(tmp_path):
    return json.loads((tmp_path / "out" / "metrics.json").read_text())


def test_features_that_are_matched(run_kitti, fake, tmp_path):
    assert run_kitti("--features", "orb").status == 0
    assert fake.made[0].options.detector.kind == "orb"
    assert read_metrics(tmp_path)["features"] == "orb"
    assert "kind is 'surf': expected one of sift, orb" in run_kitti("--features", "surf").error


def test_writes_trajectories_metrics_and_picture(run_kitti, fake, drawn_for_real, tmp_path):
    outcome = run_kitti("--seed", 3, "--window", "off")
    assert outcome.status == 0
    assert outcome.stderr == ""
    (odometry,) = fake.made
    assert (odometry.seed, odometry.options.window) == (3, False)
    assert float(odometry.camera.baseline) == pytest.approx(0.5)
    assert [left.shape for left, _ in odometry.images] == [(16, 32)] * FRAMES

    metrics = read_metrics(tmp_path)
    assert metrics.keys() >= NAMES
    assert metrics["frames"] == FRAMES
    assert metrics["alignment"] == "none"
    # Error of frame k is k·(0.02, 0, 0.01).
    step = np.hypot(0.02, 0.01)
    assert metrics["ate_rmse_m"] == pytest.approx(step * np.sqrt(np.mean(np.arange(FRAMES) ** 2)))
    assert metrics["drift_percent"] == pytest.approx(100 * step)
    assert metrics["rpe_trans_m"] == pytest.approx(step)
    assert metrics["rpe_rot_deg"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["kitti_t_rel_percent"] is None
    assert metrics["mean_inliers"] == pytest.approx(103)
    assert (metrics["failures"], metrics["bridged_frames"], metrics["error"]) == (0, [], None)
    assert metrics["frames_per_second"] > 0
    assert metrics["compile_seconds"] >= 0
    assert 0 < metrics["first_pose_seconds"] < 1e6
    assert 10 < metrics["peak_memory_mb"] < 1e5
    assert metrics["versions"] == {
        "vojax": vojax.__version__,
        "jax": jax.__version__,
        "python": platform.python_version(),
    }

    tum = read_trajectory(tmp_path / "out" / "trajectory.txt", "tum")
    kitti = read_trajectory(tmp_path / "out" / "trajectory_kitti.txt", "kitti")
    np.testing.assert_allclose(tum.timestamps, 0.1 * np.arange(FRAMES), atol=1e-9)
    np.testing.assert_allclose(tum.world_from_cam, kitti.world_from_cam, atol=1e-9)
    assert (tmp_path / "out" / "trajectory.png").read_bytes()[:4] == b"\x89PNG"

    for word in ("ATE", "RPE", "drift", "compile seconds", "failures", "metrics.json", str(tmp_path / "out")):
        assert word in outcome.stdout
    assert "not be tracked" not in outcome.stdout
    assert "frame 6/6" in outcome.stdout


def test_poses_are_in_the_files_before_the_next_frame_is_taken(run_kitti, fake, tmp_path, monkeypatch):
    seen = []

    def look(self, k):
        if k:
            seen.append(
                [
                    len(read_trajectory(tmp_path / "out" / name, format))
                    for format, name in (("tum", "trajectory.txt"), ("kitti", "trajectory_kitti.txt"))
                ]
            )

    monkeypatch.setattr(fake, "before", look)
    assert run_kitti().status == 0
    assert seen == [[k, k] for k in range(1, FRAMES)]


def test_without_truth(run_kitti, kitti, fake, tmp_path):
    (kitti / "poses" / "07.txt").unlink()
    outcome = run_kitti()
    assert outcome.status == 0
    metrics = read_metrics(tmp_path)
    assert metrics["frames"] == FRAMES
    assert "ate_rmse_m" not in metrics
    assert "ATE" not in outcome.stdout
    assert (tmp_path / "out" / "trajectory.png").read_text() == f"{FRAMES} poses"


def test_bridged_frames_are_counted_and_said(run_kitti, fake, tmp_path):
    fake.bridged = (2, 3)
    outcome = run_kitti()
    assert outcome.status == 0
    assert "2 frames could not be tracked" in outcome.stdout
    assert "repeated there: 2, 3" in outcome.stdout
    metrics = read_metrics(tmp_path)
    assert (metrics["failures"], metrics["bridged_frames"]) == (2, [2, 3])
    assert metrics["mean_inliers"] == pytest.approx((101 + 104 + 105) / 5)


def test_flags_are_counted_and_said(run_kitti, fake, tmp_path):
    fake.flagged = {2: (Flag.dark,), 3: (Flag.dark, Flag.overlap)}
    outcome = run_kitti()
    assert outcome.status == 0
    assert "under-exposed in 2 frames: 2, 3" in outcome.stdout
    assert "too little overlap with the frame before in 1 frame: 3" in outcome.stdout
    assert read_metrics(tmp_path)["flags"] == {Flag.dark: 2, Flag.overlap: 1}


def test_poses_found_later_are_written_in_their_place(run_kitti, fake, tmp_path, monkeypatch):
    fake.pending, seen = (0, 1, 3, 5), []

    def look(self, k):
        path = tmp_path / "out" / "trajectory.txt"
        seen.append(len(read_trajectory(path)) if path.exists() else 0)

    monkeypatch.setattr(fake, "before", look)
    outcome = run_kitti("--pipeline", "mono-3d2d")
    assert outcome.status == 0
    assert seen == [0, 0, 0, 3, 3, 5]
    trajectory = read_trajectory(tmp_path / "out" / "trajectory.txt")
    # The last frame's was never found.
    np.testing.assert_allclose(trajectory.positions[:, 2], 1.01 * np.array([0, 1, 2, 3, 4, 4]), atol=1e-9)
    np.testing.assert_allclose(trajectory.timestamps, 0.1 * np.arange(FRAMES), atol=1e-9)
    assert "no motion was found for 1 frame; the pose before was repeated there: 5" in outcome.stdout
    metrics = read_metrics(tmp_path)
    assert (metrics["frames"], metrics["failures"], metrics["bridged_frames"]) == (FRAMES, 1, [5])
    assert metrics["alignment"] == "sim3"
    assert metrics["mean_inliers"] == pytest.approx((102 + 104) / 2)


def test_a_path_that_never_began_is_no_motion(run_kitti, fake, tmp_path):
    fake.pending = tuple(range(FRAMES))
    outcome = run_kitti("--pipeline", "mono-3d2d")
    assert outcome.status == 0
    assert read_metrics(tmp_path)["failures"] == FRAMES
    trajectory = read_trajectory(tmp_path / "out" / "trajectory.txt")
    np.testing.assert_array_equal(trajectory.world_from_cam, np.tile(np.eye(4), (FRAMES, 1, 1)))


def test_one_camera_reads_one_image(run_kitti, kitti, fake):
    folder = kitti / "sequences" / "07"
    (folder / "image_1").rename(folder / "elsewhere")
    assert run_kitti("--pipeline", "mono-3d2d").status == 0
    assert [len(images) for images in fake.made[0].images] == [1] * FRAMES
    error = run_kitti().error
    assert "monocular pipelines are mono-2d2d, mono-3d2d, planar-1pt" in error


def test_stages_are_timed(run_kitti, fake, tmp_path):
    assert run_kitti().status == 0
    timings = read_metrics(tmp_path)["timings"]
    assert timings.keys() == {"read", "step", "write", "frame"}
    for stage in timings.values():
        assert 0 <= stage["p50_ms"] <= stage["p90_ms"] <= stage["p99_ms"]
    assert (tmp_path / "out" / "timings.png").read_text() == "read step write frame"


def test_a_killed_run_leaves_whole_lines(kitti, tmp_path):
    code = (
        "import sys, time\n"
        f"sys.path.insert(0, {str(pathlib.Path(__file__).parent)!r})\n"
        "from conftest import FakeOdometry\n"
        "from vojax.cli import main\n"
        "from vojax.odometry import PIPELINES\n"
        "class Slow(FakeOdometry):\n"
        "    def before(self, k):\n"
        "        if k == 4:\n"
        "            print('four are done', flush=True)\n"
        "            time.sleep(60)\n"
        "PIPELINES['stereo-3d2d'] = PIPELINES['stereo-3d2d']._replace(odometry=Slow)\n"
        "options = ['--dataset', 'kitti', '--pipeline', 'stereo-3d2d']\n"
        f"main(['run', {str(kitti)!r}, *options, '--out', {str(tmp_path)!r}])\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if "four are done" in line:
            break
    process.kill()
    process.stdout.close()
    assert process.wait(60) == -signal.SIGKILL
    for format, name in (("tum", "trajectory.txt"), ("kitti", "trajectory_kitti.txt")):
        trajectory = read_trajectory(tmp_path / name, format)
        np.testing.assert_allclose(trajectory.positions[:, 2], 1.01 * np.arange(4), atol=1e-9)


def test_max_frames_and_the_only_sequence(vojax_command, kitti, fake, tmp_path):
    outcome = vojax_command(
        "run", kitti, "--dataset", "kitti", "--pipeline", "stereo-3d2d", "--out", tmp_path / "out", "--max-frames", 4
    )
    assert outcome.status == 0
    metrics = read_metrics(tmp_path)
    assert (metrics["frames"], metrics["frames_in_sequence"], metrics["sequence"]) == (4, FRAMES, "07")
    assert len(read_trajectory(tmp_path / "out" / "trajectory.txt")) == 4


def test_a_single_frame_has_a_pose_and_no_accuracy(run_kitti, fake, tmp_path):
    assert run_kitti("--max-frames", 1).status == 0
    metrics = read_metrics(tmp_path)
    assert metrics["frames"] == 1
    assert "ate_rmse_m" not in metrics
    assert metrics["first_pose_seconds"] is None


def test_demo_draws_its_tracks_too(vojax_command, fake, drawn_for_real, tmp_path, monkeypatch):
    class Sequence:
        def __init__(self, frames, seed):
            self.name = f"synthetic-{seed}"
            self.times = 0.1 * np.arange(frames)
            self.poses = np.tile(np.eye(4)[None, :3], (frames, 1, 1))
            self.poses[:, 2, 3] = np.arange(frames)
            self.frame_names = [f"{k:06d}" for k in range(frames)]
            self.stereo = RectifiedStereo(Pinhole(fx=20.0, fy=20.0, cx=15.5, cy=7.5), baseline=0.5)

        def __len__(self):
            return len(self.times)

        def images(self, k):
            return np.full((16, 32), k, np.uint8), np.full((16, 32), k, np.uint8)

    monkeypatch.setattr(vojax.datasets, "SyntheticStereoSequence", Sequence)
    drawn = []
    monkeypatch.setattr("vojax.cli._run.draw_tracks", lambda *args: drawn.append(args) or vojax.viz.draw_tracks(*args))
    outcome = vojax_command("demo", "--out", tmp_path / "deep" / "out", "--frames", 5, "--seed", 2)
    assert outcome.status == 0, outcome.stderr
    assert fake.made[0].seed == 2
    names = {path.name for path in (tmp_path / "deep" / "out").iterdir()}
    assert names == {
        "trajectory.txt", "trajectory_kitti.txt", "metrics.json", "trajectory.png", "timings.png", "view.png",
    }  # fmt: skip
    ((image, start, end),) = drawn
    assert image[0, 0] == 2  # the middle frame
    np.testing.assert_allclose(end - start, 1.0)
    assert (tmp_path / "deep" / "out" / "view.png").read_bytes()[:4] == b"\x89PNG"
    assert "view.png" in outcome.stdout


def test_compiled_programs_go_to_the_users_cache(run_kitti, fake, own_cache_folder):
    assert run_kitti().status == 0
    assert (own_cache_folder / "vojax" / "jax").is_dir()
    assert pathlib.Path(jax.config.jax_compilation_cache_dir).parent == own_cache_folder / "vojax" / "jax"


def test_without_a_cache_the_run_goes_on(run_kitti, fake, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("precious")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    outcome = run_kitti()
    assert outcome.status == 0
    assert "warning" in outcome.line
    assert "compile again" in outcome.line
    assert read_metrics(tmp_path)["frames"] == FRAMES


def test_output_that_is_not_utf8_is_no_reason_to_fail(run_kitti, fake, monkeypatch):
    output = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", output)
    outcome = run_kitti()
    assert outcome.status == 0, outcome.stderr
    output.flush()
    assert b"RPE rotation" in output.buffer.getvalue()


def test_version(vojax_command):
    outcome = vojax_command("--version")
    assert (outcome.status, outcome.stdout) == (0, f"vojax {vojax.__version__}\n")


@pytest.mark.parametrize("command", ["demo", "run", "compare", "eval"])
def test_help_of_a_command(vojax_command, command):
    outcome = vojax_command(command, "--help")
    assert outcome.status == 0
    assert f"vojax {command}" in outcome.stdout
    assert outcome.stderr == ""


def test_help_loads_nothing_heavy():
    code = (
        "import sys\n"
        f"sys.path.insert(0, {str(next(iter(vojax.__path__)) + '/..')!r})\n"
        "from vojax.cli import main\n"
        "status = main([])\n"
        "heavy = ['cv2', 'matplotlib', 'rich', 'vojax.odometry', 'vojax.metrics']\n"
        "print([name for name in heavy if name in sys.modules])\n"
        "sys.exit(status)\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "[]"
    for command in ("demo", "run", "eval"):
        assert f"• {command}" in result.stdout
