"""`vojax bench vo`: frames per second of every odometry pipeline on a street that vojax renders."""

import functools
import io
import pathlib
import tempfile
from collections.abc import Callable
from typing import NamedTuple

from rich.console import Console

from vojax.datasets import SyntheticStereoSequence
from vojax.odometry import PIPELINES

from ._run import run_sequence

BATCH = 60  # frames
COLUMNS = ("pipeline", "frames", "frames/s", "drift %", "bridged", "compile s")


class Row(NamedTuple):
    """How a pipeline did.

    Attributes:
        name: Of the pipeline.
        frames: Of the sequence.
        frames_per_second: Of the whole loop, reading of images included, after compilation.
        drift_percent: Error of the last position over the length of the path.
        bridged: Frames whose motion was not found.
        compile_seconds: What compilation added.
    """

    name: str
    frames: int
    frames_per_second: float | None
    drift_percent: float
    bridged: int
    compile_seconds: float

    def cells(self) -> tuple[str, ...]:
        """What the table shows."""
        rate = "" if self.frames_per_second is None else f"{self.frames_per_second:.1f}"
        numbers = f"{self.drift_percent:.2f}", f"{self.bridged}", f"{self.compile_seconds:.1f}"
        return self.name, f"{self.frames}", rate, *numbers


def tasks(frames: int) -> dict[str, Callable[[], Row]]:
    """Each measures one row; pipelines that take depth images have none here."""
    sequence = SyntheticStereoSequence(frames=frames)
    return {
        name: functools.partial(_measure, name, sequence) for name, kind in PIPELINES.items() if kind.images != "depth"
    }


def _measure(name: str, sequence: SyntheticStereoSequence) -> Row:
    with tempfile.TemporaryDirectory() as out:
        found = run_sequence(sequence, pathlib.Path(out), pipeline=name, console=Console(file=io.StringIO()))
    return Row(
        name,
        found["frames"],
        found["frames_per_second"],
        found["drift_percent"],
        found["failures"],
        found["compile_seconds"],
    )
