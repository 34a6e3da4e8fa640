"""`vojax demo`: a sequence that vojax renders itself."""

from ._arguments import WINDOW, Demo
from ._run_command import warn_without_cache


def execute(command: Demo) -> None:
    """Render the sequence and run the pipeline on it."""
    warn_without_cache()
    from vojax.datasets import SyntheticStereoSequence

    from ._open_sequence import find_pipeline
    from ._run import run_sequence

    find_pipeline(command.pipeline)  # before the street is made
    run_sequence(
        SyntheticStereoSequence(frames=command.frames, seed=command.seed),
        command.out,
        pipeline=command.pipeline,
        window=WINDOW[command.window],
        seed=command.seed,
        view_frame=command.frames // 2,
    )
