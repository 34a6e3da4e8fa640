"""`vojax run`: a recorded sequence."""

import contextlib
import sys

from ._arguments import WINDOW, Run
from ._compilation_cache import enable_compilation_cache


def execute(command: Run) -> None:
    """Open the sequence and run the pipeline on it."""
    warn_without_cache()
    from ._open_sequence import open_source
    from ._run import run_sequence

    if command.rerun is not None and len(command.rerun) > 1:
        files = " ".join(map(str, command.rerun))
        raise ValueError(f"--rerun: found {files}, expected one file or none")
    source = open_source(
        command.dataset,
        command.path,
        command.pipeline,
        sequence=command.sequence,
        calibration=command.calibration,
        camera_name=command.camera_name,
    )
    with contextlib.ExitStack() as stack:
        viewer = None
        if command.rerun is not None:
            from ._rerun import RerunViewer

            viewer = stack.enter_context(RerunViewer(source, command.rerun[0] if command.rerun else None))
        metrics = run_sequence(
            source,
            command.out,
            pipeline=command.pipeline,
            window=WINDOW[command.window],
            features=command.features,
            seed=command.seed,
            max_frames=command.max_frames,
            viewer=viewer,
        )
    if metrics["error"] is not None:
        from ._report import count

        raise ValueError(f"{metrics['error']}; {count(metrics['frames'], 'pose')} kept in {command.out}")


def warn_without_cache() -> None:
    """Set up the cache of compiled programs; without it a start is slower and nothing else."""
    problem = enable_compilation_cache()
    if problem is not None:
        print(f"vojax: warning: {' '.join(problem.split())}", file=sys.stderr)
