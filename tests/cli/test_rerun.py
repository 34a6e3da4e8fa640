"""What a run tells the rerun viewer; the real package is not needed for that."""

import sys
import types

import numpy as np
import pytest


class Recording:
    def __init__(self, name):
        self.name, self.logged, self.clock, self.calls = name, [], {}, []

    def spawn(self):
        self.calls.append("spawn")

    def save(self, file):
        self.calls.append(("save", file))

    def disconnect(self):
        self.calls.append("disconnect")

    def set_time(self, timeline, *, sequence=None, duration=None):
        self.clock[timeline] = sequence if sequence is not None else duration

    def log(self, path, *what, static=False):
        self.logged.append((self.clock.get("frame"), path, what, static))


@pytest.fixture
def rerun(monkeypatch):
    """The parts of the package that are used, which keep what they are given."""
    module = types.ModuleType("rerun")
    recordings = []

    def recording(name):
        recordings.append(Recording(name))
        return recordings[-1]

    def kept(kind):
        class Kept:
            def __init__(self, *args, **fields):
                self.kind, self.args, self.fields = kind, args, fields

            def compress(self):
                return self

        return Kept

    for kind in ("Image", "LineStrips2D", "LineStrips3D", "Scalars", "Transform3D", "Pinhole"):
        setattr(module, kind, kept(kind))
    module.ViewCoordinates = types.SimpleNamespace(RDF="RDF")
    module.RecordingStream = recording
    module.recordings = recordings
    monkeypatch.setitem(sys.modules, "rerun", module)
    return module


def test_a_run_is_recorded(run_kitti, fake, rerun, tmp_path):
    assert run_kitti("--rerun", tmp_path / "film.rrd").status == 0
    (recording,) = rerun.recordings
    assert recording.calls == [("save", tmp_path / "film.rrd"), "disconnect"]
    by_path = {}
    for frame, path, what, static in recording.logged:
        by_path.setdefault(path, []).append((None if static else frame, what[0]))
    assert [frame for frame, _ in by_path["world/camera"]] == list(range(6))
    for k, pose in by_path["world/camera"]:
        np.testing.assert_allclose(pose.fields["translation"], [0.02 * k, 0, 1.01 * k], atol=1e-12)
    assert [int(scalar.args[0][0]) for _, scalar in by_path["inliers"]] == [0, 101, 102, 103, 104, 105]
    (_, truth), *_ = by_path["world/truth"]
    np.testing.assert_allclose(truth.args[0][0][:, 2], np.arange(6))
    # The line grows with every pose.
    assert [len(line.args[0][0]) for _, line in by_path["world/path/0"]] == [1, 2, 3, 4, 5, 6]
    (frame, pinhole), *images = by_path["world/camera/image"]
    assert frame is None
    assert (pinhole.fields["width"], pinhole.fields["height"]) == (32, 16)
    assert pinhole.fields["image_from_camera"][0][0] == 20
    assert len(images) == 6


def test_the_viewer_is_started_where_no_file_is_named(run_kitti, fake, rerun):
    assert run_kitti("--rerun").status == 0
    assert rerun.recordings[0].calls == ["spawn", "disconnect"]


def test_poses_found_later_are_shown_at_their_frames(run_kitti, fake, rerun, tmp_path):
    fake.pending = (0, 1, 2)
    assert run_kitti("--pipeline", "mono-3d2d", "--rerun", tmp_path / "film.rrd").status == 0
    frames = [frame for frame, path, _, _ in rerun.recordings[0].logged if path == "world/camera"]
    assert frames == list(range(6))


def test_without_the_package(run_kitti, fake, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    error = run_kitti("--rerun").error
    assert "pip install 'vojax[rerun]'" in error
    assert fake.made == []


def test_files_that_cannot_be(run_kitti, fake, rerun, tmp_path):
    assert "no such folder" in run_kitti("--rerun", tmp_path / "nowhere" / "film.rrd").error
    assert "expected one file or none" in run_kitti("--rerun", "a.rrd", "b.rrd").error
    assert fake.made == []
