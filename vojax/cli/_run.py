"""The loop that `vojax run`, `vojax demo` and `vojax compare` share: images in, poses, metrics and pictures out."""

import contextlib
import dataclasses
import errno
import pathlib
import platform
import tempfile
import time
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import numpy as np
from rich.console import Console

from vojax._version import __version__
from vojax.datasets import FrameSequence
from vojax.features import DescriptorOptions
from vojax.metrics import Trajectory, align, evaluate, kitti_errors
from vojax.odometry import PIPELINES, Flag, FrameEstimate
from vojax.viz import draw_tracks, plot_drift_by_length, plot_timings, plot_trajectory, save_figure

from ._open_sequence import FrameSource, source_for
from ._prefetch import prefetch
from ._progress import FrameProgress
from ._report import count, print_line, print_metrics, some_frames, write_json
from ._run_log import RunLog, TrajectoryFiles
from ._timing import FrameClock, peak_memory_mb


@runtime_checkable
class Viewer(Protocol):
    """Sees what a run sees, as it goes on."""

    def frame(self, k: int, image: np.ndarray, estimate: FrameEstimate) -> None:
        """A frame was read and taken."""
        ...

    def pose(self, k: int, world_from_cam: np.ndarray) -> None:
        """The pose of frame `k` is known; they come in order."""
        ...


def run_sequence(
    sequence: Any,
    out: pathlib.Path,
    *,
    pipeline: str = "stereo-3d2d",
    window: bool | None = None,
    features: str = "corners",
    seed: int = 0,
    max_frames: int | None = None,
    view_frame: int | None = None,
    viewer: Viewer | None = None,
    console: Console | None = None,
) -> dict[str, Any]:
    """Estimate the trajectory of a sequence and write it, its metrics and its pictures into a folder.

    Every pose is written as soon as it is known, to `trajectory.txt` (TUM) and `trajectory_kitti.txt`. When the loop
    ends, by itself or by an error, `metrics.json` and the pictures follow for the frames done. Files of an earlier run
    are replaced once there is a first pose to put in their place.

    A frame that cannot be read is bridged, the first one excepted; where nothing after it can be read the path ends
    with the last frame that could. Frames of a monocular pipeline whose pose is never found take the last one known.

    In `metrics.json`, `frames_per_second` is the rate of the whole loop, image reading included, over the frames in
    which JAX compiled nothing, and `timings` has the percentiles of its stages over the same frames; `compile_seconds`
    is what the other frames (`compiling_frames`) took beyond as many ordinary ones; `first_pose_seconds` counts from
    the start of the process to the first estimated motion.

    Args:
        sequence: A `vojax.datasets.FrameSequence` with those images that the pipeline takes, or a `FrameSource`.
        out: Folder for the results.
        pipeline: Name in `vojax.odometry.PIPELINES`.
        window: Adjust the last keyframes together; None leaves it to the pipeline.
        features: "corners" are tracked; a kind of `vojax.features.DescriptorOptions` is matched.
        seed: Of the random sampling.
        max_frames: Stop after this many frames.
        view_frame: Draw the tracks of this frame, or of the last one before it, into `view.png`.
        viewer: Shown every frame and pose.
        console: Where progress and results are printed; standard output by default.

    Returns:
        The contents of `metrics.json`.

    Raises:
        ValueError: An unknown pipeline or one that does not fit the sequence, an option out of range, a first frame
            that cannot be read, or one that cannot be used.
        OSError: The folder cannot be written to.
    """
    source = sequence if isinstance(sequence, FrameSource) else source_for(sequence, pipeline)
    sequence = source.sequence
    if seed < 0:
        raise ValueError(f"the seed is {seed}; expected 0 or more")
    if max_frames is not None and max_frames < 1:
        raise ValueError(f"the number of frames is {max_frames}; expected at least 1")
    prepare_folder(out)
    console = Console() if console is None else console
    frames = len(sequence) if max_frames is None else min(max_frames, len(sequence))
    chosen = PIPELINES[pipeline]
    settings: dict[str, Any] = {} if window is None else {"window": window}
    if features != "corners":
        settings["detector"] = DescriptorOptions(kind=features)
    options = chosen.options(**settings)
    odometry = chosen.odometry(source.camera, options, seed=seed)
    log, clock = RunLog(TrajectoryFiles(out, sequence.times)), FrameClock()
    failure: Exception | None = None
    ending: str | None = None
    try:
        ending = _loop(source, odometry, frames, log, clock, view_frame, viewer, console)
    except KeyboardInterrupt:
        kept = f"{count(len(log.poses), 'pose')} kept in {out}" if log.poses else "before the first pose"
        raise KeyboardInterrupt(kept) from None
    except Exception as error:
        failure = error
    finally:
        log.files.close()
    if not log.poses:
        assert failure is not None
        raise failure
    what_failed = None if failure is None else " ".join(str(failure).split()) or type(failure).__name__
    alignment: Literal["none", "sim3"] = "none" if chosen.scale else "sim3"
    estimate = Trajectory(np.asarray(sequence.times[: len(log.poses)], np.float64), np.stack(log.poses))
    truth = true_trajectory(sequence, len(log.poses))
    compared = {} if truth is None else evaluate(*_common(estimate, truth), alignment).as_dict()
    metrics = {
        "sequence": sequence.name,
        "pipeline": pipeline,
        "window": options.window,
        "features": features,
        "seed": seed,
        **compared,
        "frames": len(log.poses),
        "frames_in_sequence": len(sequence),
        "frames_with_truth": 0 if truth is None else len(truth),
        "frames_per_second": clock.frames_per_second,
        "compile_seconds": clock.compile_seconds,
        "compiling_frames": clock.compiling_frames,
        "loop_seconds": clock.total_seconds,
        "timings": _percentiles(clock.stages),
        "first_pose_seconds": log.first_pose_seconds,
        "mean_inliers": float(np.mean(log.inliers)) if log.inliers else None,
        "keyframes": log.keyframes,
        "failures": len(log.bridged),
        "bridged_frames": log.bridged,
        "unreadable_frames": sorted(log.unreadable),
        "flags": {flag: len(where) for flag, where in log.flags.items()},
        "peak_memory_mb": peak_memory_mb(),
        "error": what_failed or ending,
        "versions": {"vojax": __version__, "jax": jax.__version__, "python": platform.python_version()},
        "device": jax.default_backend(),
    }
    write_json(out / "metrics.json", metrics)
    how = [] if features == "corners" else [features]
    how += ["without window"] if window is False else []
    title = " · ".join([sequence.name, pipeline, *how])
    pictures = _draw(estimate, truth, alignment, clock, log, out, title)
    print_metrics(console, f"{sequence.name}, {pipeline}", metrics)
    for sentence in _remarks(log):
        print_line(console, sentence)
    written = ", ".join(["trajectory.txt", "trajectory_kitti.txt", "metrics.json", *pictures])
    print_line(console, f"in {out}: {written}")
    if failure is not None:
        if not isinstance(failure, (ValueError, OSError)):
            raise failure
        kept = f"{count(len(log.poses), 'pose')} before it kept in {out}"
        raise ValueError(f"frame {log.current}: {what_failed}; {kept}") from failure
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


def true_trajectory(sequence: FrameSequence, frames: int) -> Trajectory | None:
    """The true poses of those of the first frames that have one; None where fewer than two do."""
    if sequence.poses is None:
        return None
    truth = np.tile(np.eye(4)[None], (min(frames, len(sequence)), 1, 1))
    truth[:, :3] = sequence.poses[:frames]
    known = np.flatnonzero(np.isfinite(truth).all(axis=(1, 2)))
    return Trajectory(sequence.times[known], truth[known]) if len(known) > 1 else None


@dataclasses.dataclass
class _Reading:
    """The images of a frame, or why there are none, and how long that took."""

    images: tuple[np.ndarray, ...]
    error: Exception | None
    seconds: float


def _read(source: FrameSource, k: int) -> _Reading:
    started, images, problem = time.perf_counter(), (), None
    try:
        images = source.read(k)
    except (ValueError, OSError, IndexError) as error:
        problem = error
    return _Reading(images, problem, time.perf_counter() - started)


def _loop(
    source: FrameSource,
    odometry: Any,
    frames: int,
    log: RunLog,
    clock: FrameClock,
    view_frame: int | None,
    viewer: Viewer | None,
    console: Console,
) -> str | None:
    """Take the frames one by one; return how the sequence ended where that was before its time."""
    readings = contextlib.closing(prefetch(lambda k: _read(source, k), frames))
    # Frames that could not be read wait for one that can: only then is it clear that the sequence goes on.
    held: list[FrameEstimate] = []
    with FrameProgress(console, frames) as progress, readings as each, clock:
        for k, reading in enumerate(each):
            log.current = k
            clock.add("read", reading.seconds)
            if reading.error is not None:
                if k == 0:
                    raise reading.error
                log.unreadable[k] = reading.error
                held.append(_unreadable(odometry.skip()))
                progress.advance(0, True)
                continue  # its time goes to the next frame that can be read
            with clock.stage("step"):
                estimate = odometry.step(*reading.images)
            known: list[np.ndarray] = []
            with clock.stage("write"):
                for one in (*held, estimate):
                    known += log.add(one)
            held.clear()
            if view_frame is not None and k <= view_frame:
                log.view = (reading.images[0], estimate)
            if viewer is not None:
                viewer.frame(k, reading.images[0], estimate)
                _show(viewer, log, known)
            clock.tick()
            progress.advance(int(estimate.num_inliers), bool(estimate.bridged))
    known = log.finish()
    if viewer is not None:
        _show(viewer, log, known)
    if not held:
        return None
    first = frames - len(held)
    why = " ".join(str(log.unreadable[first]).split())
    return f"the sequence ends early, with frame {first - 1} of {frames}: {why}"


def _unreadable(estimate: FrameEstimate) -> FrameEstimate:
    return dataclasses.replace(estimate, bridged=True, flags=tuple(dict.fromkeys((*estimate.flags, Flag.unreadable))))


def _show(viewer: Viewer, log: RunLog, known: list[np.ndarray]) -> None:
    for k, pose in enumerate(known, start=len(log.poses) - len(known)):
        viewer.pose(k, pose)


def _percentiles(stages: dict[str, list[float]]) -> dict[str, dict[str, float]]:
    """Milliseconds a frame takes by stage: half, nine tenths and all but a hundredth of the frames need no more."""
    result = {}
    for name, seconds in stages.items():
        steady = 1e3 * np.array([s for s in seconds if not np.isnan(s)])
        if steady.size:
            p50, p90, p99 = np.percentile(steady, [50, 90, 99])
            result[name] = {"p50_ms": float(p50), "p90_ms": float(p90), "p99_ms": float(p99)}
    return result


def _common(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Both at the times of the truth, which are among those of the estimate."""
    return estimate.select(np.flatnonzero(np.isin(estimate.timestamps, truth.timestamps))), truth


def _draw(
    estimate: Trajectory,
    truth: Trajectory | None,
    alignment: Literal["none", "sim3"],
    clock: FrameClock,
    log: RunLog,
    out: pathlib.Path,
    title: str,
) -> list[str]:
    """Draw what there is to see, and return the names of the files."""
    figures: dict[str, Any] = {}
    if len(estimate) > 1:
        figures["trajectory.png"] = plot_trajectory(estimate, truth, alignment=alignment, title=title)
    if truth is not None:
        pair = align(*_common(estimate, truth), alignment)
        errors = kitti_errors(pair.estimate.world_from_cam, pair.truth.world_from_cam)
        if errors.lengths_m.size:
            figures["drift.png"] = plot_drift_by_length({title: errors})
    if clock.frames_per_second is not None:
        figures["timings.png"] = plot_timings(clock.stages, title=title)
    for name, figure in figures.items():
        save_figure(figure, out / name)
    if log.view is not None:
        image, view = log.view
        if image.ndim == 3:
            image = image[:, :, :3]
        save_figure(draw_tracks(image, view.previous_pixels, view.pixels), out / "view.png", dpi=100)
    return [*figures, *(["view.png"] if log.view is not None else [])]


def _remarks(log: RunLog) -> list[str]:
    """What a reader of the numbers should know of single frames, in words."""
    remarks = []
    within = [k for k in log.unreadable if k < len(log.poses)]
    if within:
        why = " ".join(str(log.unreadable[within[0]]).split())
        remarks.append(f"{count(len(within), 'frame')} could not be read: {some_frames(within)} ({within[0]}: {why})")
    bridged = [k for k in log.bridged if k not in log.unreadable and k not in log.lost]
    if bridged:
        sentence = f"{count(len(bridged), 'frame')} could not be tracked; the motion before was repeated there"
        remarks.append(f"{sentence}: {some_frames(bridged)}")
    if log.lost:
        sentence = f"no motion was found for {count(len(log.lost), 'frame')}; the pose before was repeated there"
        remarks.append(f"{sentence}: {some_frames(log.lost)}")
    for flag, where in log.flags.items():
        if flag != Flag.unreadable:
            remarks.append(f"{flag} in {count(len(where), 'frame')}: {some_frames(where)}")
    return remarks
