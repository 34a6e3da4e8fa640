"""Which images a pipeline takes, and a data set opened for it."""

import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from vojax.cameras import Camera, RectifiedStereo, read_cameras
from vojax.datasets import (
    EurocSequence,
    FrameSequence,
    ImageSequence,
    KittiSequence,
    SevenScenesSequence,
    TumSequence,
)
from vojax.odometry import PIPELINES, PairRectifier, Pipeline

Images = Literal["one", "pair", "depth"]

_IN_WORDS = {"one": "one image", "pair": "a stereo pair", "depth": "an image with its depth"}
# What a frame of each data set can have.
_OFFERED: dict[str, tuple[Images, ...]] = {
    "kitti": ("one", "pair"),
    "tum": ("one", "depth"),
    "euroc": ("one", "pair"),
    "7scenes": ("one", "depth"),
    "images": ("one",),
}


@dataclasses.dataclass(frozen=True)
class FrameSource:
    """A sequence as a pipeline takes it.

    Attributes:
        sequence: Names, times and true poses.
        camera: What the odometry is made with.
        read: The images of a step, by the number of the frame.
    """

    sequence: FrameSequence
    camera: Camera | RectifiedStereo | PairRectifier
    read: Callable[[int], tuple[np.ndarray, ...]]


def find_pipeline(name: str) -> Pipeline:
    """The pipeline of a name.

    Raises:
        ValueError: There is none; the message lists them.
    """
    if name not in PIPELINES:
        raise ValueError(f"unknown pipeline {name!r}; choose one of {', '.join(PIPELINES)}")
    return PIPELINES[name]


def source_for(sequence: Any, pipeline: str) -> FrameSource:
    """What a pipeline takes of a sequence's frames.

    Args:
        sequence: A `FrameSequence`; with `stereo` where it has a rectified pair, with `cam1_from_cam0` where it has
            one to rectify.
        pipeline: Name in `vojax.odometry.PIPELINES`.

    Raises:
        ValueError: The pipeline is not known, or takes images that the sequence lacks.
    """
    takes = find_pipeline(pipeline).images
    offered: list[Images] = ["one"]
    rectified, beside = getattr(sequence, "stereo", None), getattr(sequence, "cam1_from_cam0", None)
    if rectified is not None or beside is not None:
        offered.append("pair")
    if hasattr(sequence, "depth"):
        offered.append("depth")
    if takes not in offered:
        raise ValueError(_misfit(f"sequence {sequence.name}", pipeline, offered))
    match takes:
        case "one":
            return FrameSource(sequence, sequence.camera, lambda k: sequence.images(k)[:1])
        case "pair":
            if rectified is not None:
                return FrameSource(sequence, rectified, sequence.images)
            assert beside is not None  # or "pair" would not be offered
            rectifier = PairRectifier(sequence.cameras[0], sequence.cameras[1], beside, _image_size(sequence))
            return FrameSource(sequence, rectifier, sequence.images)
        case "depth":
            return FrameSource(sequence, sequence.camera, lambda k: (sequence.images(k)[0], sequence.depth(k)))


def open_source(
    dataset: str,
    path: pathlib.Path,
    pipeline: str,
    *,
    sequence: str | None = None,
    calibration: pathlib.Path | None = None,
    camera_name: str | None = None,
) -> FrameSource:
    """Open a data set with those images that a pipeline takes.

    Args:
        dataset: "kitti", "tum", "euroc", "7scenes" or "images".
        path: Folder of the data set, or a video file.
        pipeline: Name in `vojax.odometry.PIPELINES`.
        sequence: Of KITTI the sequence's name; elsewhere a folder or file in `path`.
        calibration: Camera file of images, and where the published one does not hold of TUM and 7-Scenes.
        camera_name: Which camera of that file.

    Raises:
        ValueError: The pipeline is not known or does not fit, or a file does not hold what it should.
        OSError: Something is missing, or cannot be read.
    """
    takes = find_pipeline(pipeline).images
    if takes not in _OFFERED[dataset]:
        raise ValueError(_misfit(f"the data set {dataset}", pipeline, _OFFERED[dataset]))
    if calibration is not None and dataset in ("kitti", "euroc"):
        raise ValueError(f"--calibration is {calibration}: expected none, as {dataset} has its own")
    if camera_name is not None and calibration is None:
        raise ValueError(f"--camera-name is {camera_name!r}: expected --calibration with it")
    root = path if sequence is None or dataset == "kitti" else _folder(path, sequence)
    opened: FrameSequence
    match dataset:
        case "kitti":
            name = _only_sequence(path) if sequence is None else sequence
            opened = _of_cameras(lambda stereo: KittiSequence(root, name, stereo=stereo), takes)
        case "euroc":
            opened = _of_cameras(lambda stereo: EurocSequence(root, stereo=stereo), takes)
        case "tum":
            opened = TumSequence(root, _camera(calibration, camera_name), depth=takes == "depth")
        case "7scenes":
            opened = SevenScenesSequence(root, _camera(calibration, camera_name), depth=takes == "depth")
        case _:
            if calibration is None:
                raise ValueError("--dataset images needs --calibration FILE: the camera that took them")
            opened = ImageSequence(root, calibration, camera_name=camera_name)
    return source_for(opened, pipeline)


def _image_size(sequence: Any) -> tuple[int, int]:
    """What the calibration says, or the first image shows."""
    if sequence.size is not None:
        return sequence.size
    height, width = sequence.images(0)[0].shape[:2]
    return width, height


def _misfit(what: str, pipeline: str, offered: Sequence[Images]) -> str:
    fitting = ", ".join(name for name, one in PIPELINES.items() if one.images in offered)
    has = " or ".join(_IN_WORDS[kind] for kind in offered)
    takes = _IN_WORDS[PIPELINES[pipeline].images]
    return f"the pipeline {pipeline} takes {takes} per frame, and {what} has {has}: choose one of {fitting}"


def _of_cameras(opened: Callable[[bool], Any], takes: Images) -> Any:
    """Open one camera or both; where only the right one is missing, say which pipelines do without."""
    if takes == "one":
        return opened(False)
    try:
        return opened(True)
    except FileNotFoundError as error:
        opened(False)  # raises where more is missing
        monocular = ", ".join(name for name, pipeline in PIPELINES.items() if pipeline.images == "one")
        raise FileNotFoundError(f"{error}; monocular pipelines are {monocular}") from None


def _only_sequence(root: pathlib.Path) -> str:
    """The sequence that is meant when none is named: the only one."""
    folder = root / "sequences"
    names = sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    if len(names) > 1:
        raise ValueError(f"{folder} holds {len(names)} sequences; choose one with --sequence: {', '.join(names)}")
    return names[0] if names else "00"


def _folder(path: pathlib.Path, sequence: str) -> pathlib.Path:
    """The sequence's folder or file in `path`."""
    if not path.is_dir():
        raise FileNotFoundError(f"{path} not found: expected a folder that holds the sequence {sequence!r}")
    if not sequence or not (path / sequence).exists():
        there = ", ".join(sorted(entry.name for entry in path.iterdir() if entry.is_dir())) or "none"
        raise FileNotFoundError(f"sequence {sequence!r} not found in {path}: choose one of those there ({there})")
    return path / sequence


def _camera(calibration: pathlib.Path | None, name: str | None) -> Camera | None:
    """The camera that a file describes; None without a file."""
    if calibration is None:
        return None
    cameras = read_cameras(calibration)
    names = list(cameras.cameras)
    if name is None and len(names) > 1:
        raise ValueError(f"{calibration} holds cameras {', '.join(names)}: choose one with --camera-name")
    if name is not None and name not in names:
        raise ValueError(f"{calibration} has no camera {name!r}: expected one of {', '.join(names)}")
    return cameras[name if name is not None else names[0]]
