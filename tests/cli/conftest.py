import dataclasses
import pathlib
from typing import ClassVar

import cv2
import jax
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from vojax.cli import main
from vojax.odometry import PIPELINES, Flag, FrameEstimate

FRAMES = 6
ROW = "20 0 16 {} 0 20 8 0 0 0 1 0"


@pytest.fixture(autouse=True)
def own_cache_folder(tmp_path, monkeypatch):
    """Commands put JAX's cache where the user's cache is; here that is a folder of the test."""
    names = (
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
        "jax_persistent_cache_min_entry_size_bytes",
    )
    before = {name: getattr(jax.config, name) for name in names}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    jax.config.update("jax_compilation_cache_dir", None)
    yield tmp_path / "cache"
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@dataclasses.dataclass
class Outcome:
    status: int
    stdout: str
    stderr: str

    @property
    def error(self) -> str:
        """The one line that a user's mistake ends in."""
        assert self.status == 2, (self.status, self.stdout, self.stderr)
        return self.line

    @property
    def line(self) -> str:
        assert self.stderr.endswith("\n")
        assert self.stderr.count("\n") == 1, self.stderr
        assert "Traceback" not in self.stderr
        assert len(self.stderr) > 20
        return self.stderr


@pytest.fixture
def vojax_command(capsys):
    """Run the command line in this process."""

    def run(*arguments) -> Outcome:
        capsys.readouterr()
        status = main([str(argument) for argument in arguments])
        return Outcome(status, *capsys.readouterr())

    return run


@pytest.fixture
def kitti(tmp_path) -> pathlib.Path:
    """A KITTI folder with one sequence, "07", of small random images and a straight path."""
    root = tmp_path / "kitti"
    folder = root / "sequences" / "07"
    rng = np.random.default_rng(0)
    for camera in ("image_0", "image_1"):
        (folder / camera).mkdir(parents=True)
        for k in range(FRAMES):
            cv2.imwrite(str(folder / camera / f"{k:06d}.png"), rng.integers(0, 255, (16, 32), dtype=np.uint8))
    (folder / "calib.txt").write_text(f"P0: {ROW.format(0)}\nP1: {ROW.format(-10)}\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(FRAMES)))
    (root / "poses").mkdir()
    (root / "poses" / "07.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {k}\n" for k in range(FRAMES)))
    return root


class FakeOdometry:
    """Says that the camera moves 1.01 m ahead and 0.02 m to the right with every frame."""

    made: ClassVar[list["FakeOdometry"]] = []
    bridged: tuple[int, ...] = ()
    pending: tuple[int, ...] = ()
    flagged: ClassVar[dict[int, tuple[Flag, ...]]] = {}

    def __init__(self, camera, options, *, seed=0):
        self.camera, self.options, self.seed = camera, options, seed
        self.images = []  # of each frame; None for one that was skipped
        self.waiting = 0
        type(self).made.append(self)

    def before(self, k: int) -> None:
        """What happens as frame k arrives."""

    def step(self, *images):
        k = len(self.images)
        self.before(k)
        self.images.append(images)
        if k in self.pending:
            self.waiting += 1
            return FrameEstimate(np.eye(4), pending=True)
        points = np.array([[3.0, 4.0], [20.0, 9.0]], np.float32)
        inliers = 0 if k in self.bridged or k == 0 else 100 + k
        earlier = np.array([self.pose(j) for j in range(k - self.waiting, k)]).reshape(-1, 4, 4)
        self.waiting = 0
        return FrameEstimate(
            self.pose(k), inliers, k in self.bridged, k % 2 == 0, points, points - 1.0,
            flags=self.flagged.get(k, ()), earlier=earlier,
        )  # fmt: skip

    def skip(self):
        self.images.append(None)
        return FrameEstimate(self.pose(len(self.images) - 1), bridged=True, flags=(Flag.unreadable,))

    @staticmethod
    def pose(k: int) -> np.ndarray:
        pose = np.eye(4)
        pose[:3, 3] = [0.02 * k, 0.0, 1.01 * k]
        return pose


@pytest.fixture
def drawn_for_real():
    """Ask for this to have matplotlib draw `fake`'s results; it takes a second."""


@pytest.fixture
def fake(request, monkeypatch):
    """Pipelines without their computations, and pictures that only say how many poses they show."""

    class Fake(FakeOdometry):
        made: ClassVar[list] = []

    for name, pipeline in PIPELINES.items():
        monkeypatch.setitem(PIPELINES, name, pipeline._replace(odometry=Fake))
    if "drawn_for_real" not in request.fixturenames:
        monkeypatch.setattr("vojax.cli._run.plot_trajectory", lambda estimate, truth, **_: f"{len(estimate)} poses")
        monkeypatch.setattr("vojax.cli._run.plot_timings", lambda stages, **_: " ".join(stages))
        monkeypatch.setattr("vojax.cli._run.save_figure", lambda figure, path, **_: path.write_text(str(figure)))
    return Fake


@pytest.fixture
def run_kitti(vojax_command, kitti, tmp_path):
    """`vojax run` on that folder, into `out` there; more options may follow."""

    def run(*more, sequence="07") -> Outcome:
        return vojax_command(
            "run", kitti, "--dataset", "kitti", "--sequence", sequence, "--pipeline", "stereo-3d2d",
            "--out", tmp_path / "out", *more,
        )  # fmt: skip

    return run
