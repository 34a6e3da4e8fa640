"""Entry point of the `vojax` command: whatever a user can get wrong ends in one line and exit status 2."""

import importlib
import io
import os
import sys
from collections.abc import Sequence

from vojax._version import __version__

from . import _timing as _timing  # first: the clock of `first_pose_seconds` starts with the process

_USAGE_ERROR = 2
_INTERRUPTED = 130  # 128 + SIGINT, as shells have it
_EXTRAS = {"cv2": "features", "matplotlib": "viz", "tyro": "cli", "rich": "cli"}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments after the program's name; those of the process where it is None.

    Returns:
        Exit status: 0, 2 after an error that the user can mend (one line on stderr), 130 after Ctrl-C. With
        `VOJAX_TRACEBACK=1` in the environment errors are raised instead.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    # XLA reports programs out of its own cache as built for another processor, at length and wrongly; it reads this
    # when JAX is first imported.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # A degree sign must not end a run where output is ASCII.
    try:
        return _dispatch(arguments)
    except KeyboardInterrupt as stop:
        _say(f"interrupted{f': {stop}' if str(stop) else ''}")
        return _INTERRUPTED
    except (ValueError, OSError, ImportError) as error:
        sentence = _sentence(error)
        if sentence is None or os.environ.get("VOJAX_TRACEBACK") == "1":
            raise
        _say(f"error: {sentence}")
        return _USAGE_ERROR


def _dispatch(arguments: list[str]) -> int:
    if arguments == ["--version"]:
        print(f"vojax {__version__}")
        return 0
    from ._arguments import Ba, Bench, Calibrate, Compare, Demo, Eval, Help, Run, parse

    command = parse(arguments)
    if isinstance(command, Help):
        return 0
    # The command's own module, and with it JAX, OpenCV and matplotlib, comes only now: help stays fast.
    modules = {
        Demo: "_demo_command",
        Run: "_run_command",
        Compare: "_compare_command",
        Eval: "_eval_command",
        Ba: "_ba_command",
        Calibrate: "_calibrate_command",
        Bench: "_bench_command",
    }
    module = modules[type(command)]
    importlib.import_module(f"vojax.cli.{module}").execute(command)
    return 0


def _sentence(error: Exception) -> str | None:
    """The error in one line, or None where it is no fault of the user's."""
    if isinstance(error, ImportError):
        extra = _EXTRAS.get((error.name or "").split(".")[0])
        if isinstance(error, ModuleNotFoundError) and extra is not None:
            return f"the package {error.name!r} is not installed, and this command needs it: pip install 'vojax[cli]'"
        return _flat(str(error)) if "pip install" in str(error) else None
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{_flat(str(error.filename))}: {error.strerror}; check the path and its permissions"
    return _flat(str(error)) or type(error).__name__


def _flat(text: str) -> str:
    return " ".join(text.split())


def _say(line: str) -> None:
    sys.stdout.flush()
    print(f"vojax: {line}", file=sys.stderr, flush=True)
