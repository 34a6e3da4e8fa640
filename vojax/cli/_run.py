"""The loop that `vojax run` and `vojax demo` share: images in, poses, metrics and pictures out."""

import contextlib
import dataclasses
import errno
import pathlib
import platform
import tempfile
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from rich.console import Console

from vojax._version import __version__
from vojax.cameras import RectifiedStereo
from vojax.metrics import Trajectory, TrajectoryWriter, evaluate
from vojax.odometry import PIPELINES, FrameEstimate
from vojax.viz import draw_tracks, plot_trajectory, save_figure

from ._prefetch import prefetch
from ._progress import FrameProgress
from ._report import print_line, print_metrics, write_json
from ._timing import FrameClock, peak_memory_mb, seconds_since_process_start


@runtime_checkable
class StereoSequence(Protocol):
    """A recorded or rendered stereo sequence, such as `vojax.datasets.KittiSequence`."""

    @property
    def name(self) -> str: ...

    @property
    def stereo(self) -> RectifiedStereo | None: ...

    @property
    def times(self) -> np.ndarray: ...

    @property
    def poses(self) -> np.ndarray | None: ...

    def __len__(self) -> int: ...

    def images(self, k: int) -> tuple[np.ndarray, np.ndarray | None]: ...


@dataclasses.dataclass
class _Log:
    """What is known so far; the trajectory files are opened with the first pose."""

    poses: list[np.ndarray] = dataclasses.field(default_factory=list)
    inliers: list[int] = dataclasses.field(default_factory=list)
    bridged: list[int] = dataclasses.field(default_factory=list)
    keyframes: int = 0
    first_pose_seconds: float | None = None
    view: tuple[np.ndarray, FrameEstimate] | None = None

    def add(self, estimate: FrameEstimate) -> None:
        """Take the next frame's estimate."""
        self.inliers.append(int(estimate.num_inliers))
        self.keyframes += bool(estimate.keyframe)
        if estimate.bridged:
            self.bridged.append(len(self.poses))
        elif self.poses and self.first_pose_seconds is None:
            self.first_pose_seconds = seconds_since_process_start()
        self.poses.append(np.asarray(estimate.world_from_cam, np.float64))


def run_sequence(
    sequence: StereoSequence,
    out: pathlib.Path,
    *,
    pipeline: str = "stereo-3d2d",
    window: bool = True,
    seed: int = 0,
    max_frames: int | None = None,
    view_frame: int | None = None,
    console: Console | None = None,
) -> dict[str, Any]:
    """Estimate the trajectory of a sequence and write it, its metrics and its picture into a folder.

    Every pose is written as it comes, to `trajectory.txt` (TUM) and `trajectory_kitti.txt`. When the loop ends, by
    itself or by an error, `metrics.json` and `trajectory.png` follow for the frames done. Files of an earlier run are
    replaced once there is a first pose to put in their place.

    In `metrics.json`, `frames_per_second` is the rate of the whole loop, image reading included, over the frames in
    which JAX compiled nothing; `compile_seconds` is what the other frames (`compiling_frames`) took beyond as many
    ordinary ones; `first_pose_seconds` counts from the start of the process to the first estimated motion.

    Args:
        sequence: Images, calibration, times and, where known, true poses.
        out: Folder for the results.
        pipeline: Name in `vojax.odometry.PIPELINES`.
        window: Adjust the last keyframes together.
        seed: Of the random sampling.
        max_frames: Stop after this many frames.
        view_frame: Draw the tracks of this frame, or of the last one before it, into `view.png`.
        console: Where progress and results are printed; standard output by default.

    Returns:
        The contents of `metrics.json`.

    Raises:
        ValueError: An unknown pipeline, an option out of range, or a frame that cannot be used.
        OSError: The folder cannot be written to.
    """
    # The others take images that this loop does not read yet.
    pipelines = {name: one for name, one in PIPELINES.items() if one.images == "pair"}
    if pipeline not in pipelines:
        raise ValueError(f"unknown pipeline {pipeline!r}; choose one of {', '.join(pipelines)}")
    if seed < 0:
        raise ValueError(f"the seed is {seed}; expected 0 or more")
    if max_frames is not None and max_frames < 1:
        raise ValueError(f"the number of frames is {max_frames}; expected at least 1")
    if sequence.stereo is None:
        raise ValueError(f"sequence {sequence.name} has one camera; the pipeline {pipeline} needs a stereo pair")
    prepare_folder(out)
    console = Console() if console is None else console
    frames = len(sequence) if max_frames is None else min(max_frames, len(sequence))
    chosen = pipelines[pipeline]
    odometry = chosen.odometry(sequence.stereo, chosen.options(window=window), seed=seed)
    log, clock = _Log(), FrameClock()
    failure: Exception | None = None
    try:
        _loop(sequence, odometry, frames, out, view_frame, console, log, clock)
    except KeyboardInterrupt:
        done = _count(len(log.poses), "pose")
        raise KeyboardInterrupt(f"{done} kept in {out}" if log.poses else "before the first pose") from None
    except Exception as error:
        failure = error
    if not log.poses:
        assert failure is not None
        raise failure
    what_failed = None if failure is None else " ".join(str(failure).split()) or type(failure).__name__
    metrics = {
        "sequence": sequence.name,
        "pipeline": pipeline,
        "window": window,
        "seed": seed,
        **_accuracy(sequence, log.poses),
        "frames": len(log.poses),
        "frames_in_sequence": len(sequence),
        "frames_per_second": clock.frames_per_second,
        "compile_seconds": clock.compile_seconds,
        "compiling_frames": clock.compiling_frames,
        "loop_seconds": clock.total_seconds,
        "first_pose_seconds": log.first_pose_seconds,
        "mean_inliers": float(np.mean(log.inliers[1:])) if len(log.poses) > 1 else None,
        "keyframes": log.keyframes,
        "failures": len(log.bridged),
        "bridged_frames": log.bridged,
        "peak_memory_mb": peak_memory_mb(),
        "error": what_failed,
        "versions": {"vojax": __version__, "jax": jax.__version__, "python": platform.python_version()},
        "device": jax.default_backend(),
    }
    write_json(out / "metrics.json", metrics)
    pictures = _draw(sequence, out, log, f"{sequence.name} · {pipeline}{'' if window else ' without window'}")
    print_metrics(console, f"{sequence.name}, {pipeline}", metrics)
    if log.bridged:
        print_line(console, _bridged_sentence(log.bridged))
    written = ", ".join(["trajectory.txt", "trajectory_kitti.txt", "metrics.json", *pictures])
    print_line(console, f"in {out}: {written}")
    if failure is not None:
        if not isinstance(failure, (ValueError, OSError)):
            raise failure
        kept = f"{_count(len(log.poses), 'pose')} before it kept in {out}"
        raise ValueError(f"frame {len(log.poses)}: {what_failed}; {kept}") from failure
    return metrics


def prepare_folder(out: pathlib.Path) -> None:
    """Make a folder that files can be written to.

    Raises:
        OSError: There is a file of this name, or the system does not allow it.
    """
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "is a file; expected a folder for the results", str(out))
    out.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise OSError(error.errno, f"cannot write there ({error.strerror})", str(out)) from None


def _loop(
    sequence: StereoSequence,
    odometry: Any,
    frames: int,
    out: pathlib.Path,
    view_frame: int | None,
    console: Console,
    log: _Log,
    clock: FrameClock,
) -> None:
    tum: TrajectoryWriter | None = None
    kitti: TrajectoryWriter | None = None
    try:
        images = contextlib.closing(prefetch(sequence.images, frames))
        with FrameProgress(console, frames) as progress, images as pairs, clock:
            for k, (left, right) in enumerate(pairs):
                estimate = odometry.step(left, right)
                if tum is None or kitti is None:
                    _remove_results(out)
                    tum = TrajectoryWriter(out / "trajectory.txt", "tum")
                    kitti = TrajectoryWriter(out / "trajectory_kitti.txt", "kitti")
                tum.append(estimate.world_from_cam, float(sequence.times[k]))
                kitti.append(estimate.world_from_cam)
                log.add(estimate)
                if view_frame is not None and k <= view_frame:
                    log.view = (left, estimate)
                clock.tick()
                progress.advance(log.inliers[-1], bool(estimate.bridged))
    finally:
        for writer in (tum, kitti):
            if writer is not None:
                writer.close()


def _remove_results(out: pathlib.Path) -> None:
    """Numbers and pictures of an earlier run must not stand beside another trajectory."""
    for name in ("metrics.json", "trajectory.png", "view.png"):
        (out / name).unlink(missing_ok=True)


def _trajectories(sequence: StereoSequence, poses: list[np.ndarray]) -> tuple[Trajectory, Trajectory | None]:
    count = len(poses)
    times = np.asarray(sequence.times[:count], np.float64)
    estimate = Trajectory(times, np.stack(poses))
    if sequence.poses is None:
        return estimate, None
    truth = np.tile(np.eye(4)[None], (count, 1, 1))
    truth[:, :3] = sequence.poses[:count]
    return estimate, Trajectory(times, truth)


def _accuracy(sequence: StereoSequence, poses: list[np.ndarray]) -> dict[str, Any]:
    """The metrics that need a truth; a stereo rig sees scale, so nothing is aligned."""
    estimate, truth = _trajectories(sequence, poses)
    if truth is None or len(poses) < 2:
        return {}
    return evaluate(estimate, truth, "none").as_dict()


def _draw(sequence: StereoSequence, out: pathlib.Path, log: _Log, title: str) -> list[str]:
    names = []
    if len(log.poses) > 1:
        estimate, truth = _trajectories(sequence, log.poses)
        save_figure(plot_trajectory(estimate, truth, title=title), out / "trajectory.png")
        names.append("trajectory.png")
    if log.view is not None:
        image, view = log.view
        if image.ndim == 3:
            image = image[:, :, :3]
        save_figure(draw_tracks(image, view.previous_pixels, view.pixels), out / "view.png", dpi=100)
        names.append("view.png")
    return names


def _bridged_sentence(frames: list[int]) -> str:
    shown = ", ".join(map(str, frames[:12])) + (", …" if len(frames) > 12 else "")
    return f"{_count(len(frames), 'frame')} could not be tracked; the motion before was repeated there: {shown}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
