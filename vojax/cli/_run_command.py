"""`vojax run`: a recorded sequence."""

import pathlib
import sys

from ._arguments import Run
from ._compilation_cache import enable_compilation_cache


def execute(command: Run) -> None:
    """Open the sequence and run the pipeline on it."""
    warn_without_cache()
    from vojax.datasets import KittiSequence

    from ._run import run_sequence

    name = command.sequence if command.sequence is not None else _only_sequence(command.path)
    sequence = KittiSequence(command.path, name)
    run_sequence(
        sequence,
        command.out,
        pipeline=command.pipeline,
        window=command.window,
        seed=command.seed,
        max_frames=command.max_frames,
    )


def warn_without_cache() -> None:
    """Set up the cache of compiled programs; without it a start is slower and nothing else."""
    problem = enable_compilation_cache()
    if problem is not None:
        print(f"vojax: warning: {' '.join(problem.split())}", file=sys.stderr)


def _only_sequence(root: pathlib.Path) -> str:
    """The sequence that is meant when none is named: the only one."""
    folder = root / "sequences"
    names = sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    if len(names) > 1:
        raise ValueError(f"{folder} holds {len(names)} sequences; choose one with --sequence: {', '.join(names)}")
    return names[0] if names else "00"
