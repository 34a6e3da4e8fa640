"""What each command takes, and how a wrong argument is reported."""

import contextlib
import dataclasses
import io
import pathlib
import re
from typing import Annotated, Literal

import tyro

WINDOW = {"auto": None, "on": True, "off": False}

_DESCRIPTION = "Visual odometry in JAX. `vojax COMMAND --help` explains a command, `vojax --version` says the version."


@dataclasses.dataclass(frozen=True)
class Demo:
    """Estimate the path of a camera through a street that vojax renders itself."""

    out: pathlib.Path = pathlib.Path("vojax-demo")
    """Folder for the results; made where it does not exist."""
    pipeline: Annotated[str, tyro.conf.arg(metavar="NAME")] = "stereo-3d2d"
    """How to estimate; an unknown name lists them all."""
    frames: Annotated[int, tyro.conf.arg(metavar="N")] = 48
    """Length of the sequence."""
    window: Literal["auto", "on", "off"] = "auto"
    """Adjust the last keyframes together; auto does what was measured to be better for the pipeline."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Of the street and of the random sampling; the same seed gives the same path."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recording:
    """What `run` and `compare` take alike: the images, and how they are followed."""

    path: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Folder of the data set; for images a folder of them, or a video file."""
    dataset: Literal["kitti", "tum", "euroc", "7scenes", "images"]
    """Layout of that folder."""
    sequence: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Of KITTI the sequence, such as 06; elsewhere a folder inside PATH."""
    calibration: Annotated[pathlib.Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Camera file (OpenCV, Kalibr, EuRoC, KITTI or COLMAP): images need one, TUM and 7-Scenes may have another one."""
    camera_name: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Which camera of that file; needed where it has several."""
    features: Annotated[str, tyro.conf.arg(metavar="NAME")] = "corners"
    """Corners that are tracked; or sift, orb … (what the installed OpenCV has), matched by their descriptors."""
    window: Literal["auto", "on", "off"] = "auto"
    """Adjust the last keyframes together; auto does what was measured to be better for the pipeline."""
    max_frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Stop after this many frames."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Of the random sampling; the same seed and images give the same path."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run(Recording):
    """Estimate the path of a camera from a recorded sequence, and compare it with the truth where that is known."""

    pipeline: Annotated[str, tyro.conf.arg(metavar="NAME")]
    """How to estimate, such as stereo-3d2d; an unknown name lists them all."""
    out: pathlib.Path
    """Folder for the results; made where it does not exist."""
    rerun: Annotated[tuple[pathlib.Path, ...] | None, tyro.conf.arg(metavar="[FILE.rrd]")] = None
    """Show the run in the rerun viewer, or record it into a file."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compare(Recording):
    """Run several pipelines on a recorded sequence, one after the other, and put their numbers into one table."""

    pipelines: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME …")]
    """Which pipelines, such as mono-3d2d stereo-3d2d; an unknown name lists them all."""
    out: pathlib.Path
    """Folder for the table; the results of each pipeline are in a folder of its name inside."""


@dataclasses.dataclass(frozen=True)
class Eval:
    """Measure an estimated trajectory against the true one."""

    est: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="EST")]
    """Estimated trajectory."""
    truth: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="TRUTH")]
    """True trajectory, metres."""
    format: Literal["tum", "kitti"]
    """Of both files: `t x y z qx qy qz qw`, matched by time, or the 3x4 pose, matched by line."""
    alignment: Literal["none", "se3", "sim3"] = "none"
    """Transform of the estimate that is fitted to the truth first: none, rigid or similarity."""
    origin: Literal["identity", "given"] = "identity"
    """`identity`: both start at the identity, as in metrics.json; `given`: compared as they are, as evo does."""
    max_difference_s: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 0.01
    """Poses match up to this difference of their times."""
    json: Annotated[pathlib.Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write the metrics to this file too."""


@dataclasses.dataclass(frozen=True)
class Ba:
    """Adjust the cameras and points of a reconstruction together, and write it, a report and a picture."""

    file: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """A BAL problem, or the folder of a COLMAP model (text or binary)."""
    format: Literal["bal", "colmap"]
    """Of the file."""
    out: pathlib.Path
    """Folder for the results; made where it does not exist."""
    loss: Literal["squared", "huber", "cauchy"] = "squared"
    """Robust loss of a residual, in pixels."""
    max_steps: Annotated[int, tyro.conf.arg(metavar="N")] = 50
    """Most iterations."""
    dtype: Literal["float64", "float32"] = "float64"
    """Precision."""


@dataclasses.dataclass(frozen=True)
class Calibrate:
    """Calibrate a camera, or the cameras of a rig, from images of a chessboard."""

    images: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES")]
    """A folder, a pattern or files; for a rig one folder or pattern for each camera, views in the same order."""
    board: Annotated[str, tyro.conf.arg(metavar="COLSxROWS")]
    """Inner corners of the board, one fewer than squares in each direction."""
    square: Annotated[float, tyro.conf.arg(metavar="METRES")]
    """Side of a square."""
    out: pathlib.Path
    """Folder for the results; made where it does not exist."""
    model: Literal[
        "pinhole", "brown-conrady", "kannala-brandt", "unified", "extended-unified", "double-sphere", "scaramuzza",
        "spherical",
    ] = "brown-conrady"  # fmt: skip
    """Camera model."""
    format: Literal["vojax", "opencv", "kalibr", "euroc", "colmap"] = "vojax"
    """Of the camera file."""
    dtype: Literal["float64", "float32"] = "float64"
    """Precision."""


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure the speed of vojax on this machine: run it while nothing else computes."""

    what: Annotated[Literal["solvers", "robust", "ba", "vo"], tyro.conf.Positional]
    """What is measured."""
    batch: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Problems solved in one call, 100,000 for solvers, 64 for robust estimators and 256 for ba where left out; frames
    of vo, 60."""
    only: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Only those with this in their names."""
    json: Annotated[pathlib.Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write the numbers to this file too."""


@dataclasses.dataclass(frozen=True)
class Help:
    """The user asked for help and has read it."""


Command = Demo | Run | Compare | Eval | Ba | Calibrate | Bench
_COMMANDS = ("demo", "run", "compare", "eval", "ba", "calibrate", "bench")
_Choice = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Ba, tyro.conf.subcommand("ba")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
)


def parse(arguments: list[str]) -> Command | Help:
    """Turn arguments into a command; help is printed here.

    Raises:
        ValueError: An argument is unknown, missing or of the wrong kind; the message is one line.
    """
    command_name = arguments[0] if arguments else "--help"
    if command_name not in (*_COMMANDS, "-h", "--help"):
        kind = "option" if command_name.startswith("-") else "command"
        raise ValueError(f"unknown {kind} {command_name!r}; expected {', '.join(_COMMANDS)}; see vojax --help")
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            # Typed loosely: a union of annotated types is no type to the checker.
            command: Command = tyro.cli(  # type: ignore[assignment]
                _Choice, prog="vojax", description=_DESCRIPTION, args=arguments or ["--help"]
            )
    except SystemExit as stop:
        if not stop.code:
            return Help()
        message = _one_line(box.getvalue()) or "these arguments make no sense"
        raise ValueError(f"{message}; see vojax {command_name} --help") from None
    return command


# The parser's phrases, and what a user can read.
_PLAIN = (
    (r"^Error parsing (\S+): ", r"\1: "),
    (r"no type matching (?:\{None\}\|)?INT could be instantiated from \[(.*)\]", r"found \1, expected a whole number"),
    (r"invalid literal for int\(\) with base 10: (.*)", r"found \1, expected a whole number"),
    (r"could not convert string to float: (.*)", r"found \1, expected a number"),
    (
        r"invalid choice (.*) for argument '(.*)'\. Expected one of \((.*?)(?:,\s*)?\)$",
        r"\2: found \1, expected one of \3",
    ),
    (r"Missing value for argument '(.*)'\. Expected 1 values?", r"\1: found nothing, expected a value"),
)


def _one_line(box: str) -> str:
    """Take what matters from tyro's framed message; the frame is of spaces where the output is not UTF-8.

    After the title, the first section says what is wrong; indented by four it lists names, by eight their help. A later
    section may hold the names that the user could have meant.
    """
    sections: list[list[str]] = [[]]
    for framed in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines():
        line = re.sub(r"^[│ ] ?|[│ ]+$", "", framed)
        if not line.strip("╭╮╰╯─- ") or line.startswith("╭"):
            sections.append([])
        else:
            sections[-1].append(line)
    sections = [section for section in sections if section]
    if "╭" not in box and len(sections) > 1:
        sections = sections[1:]  # the title
    if not sections:
        return ""
    said = [line for line in sections[0] if not line.startswith(" ")]
    names = [line.strip() for line in sections[0] if re.match(r" {4}\S", line)]
    message = re.sub(r"\s*Got errors:.*", "", " ".join(said)).rstrip(" .:")
    for pattern, plain in _PLAIN:
        message = re.sub(pattern, plain, message)
    if names:
        # A choice that ends with a comma goes on in the next line.
        message = f"{message}: {', '.join(names).replace(',, ', ',')}"
    for section in sections[1:]:
        if section and section[0].startswith("Perhaps you meant"):
            close = [line.strip() for line in section[1:] if re.match(r" {4}\S", line)]
            message += f"; did you mean {' or '.join(close)}?" if close else ""
        elif section and section[0].startswith("Available subcommands"):
            message += f"; {' '.join(section)[:1].lower()}{' '.join(section)[1:]}"
    return message[:1].lower() + message[1:]
