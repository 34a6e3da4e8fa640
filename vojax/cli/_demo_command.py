"""`vojax demo`: a sequence that vojax renders itself."""

from ._arguments import Demo
from ._run_command import warn_without_cache


def execute(command: Demo) -> None:
    """Render the sequence and run the stereo pipeline on it."""
    warn_without_cache()
    from vojax.datasets import SyntheticStereoSequence

    from ._run import run_sequence

    sequence = SyntheticStereoSequence(frames=command.frames, seed=command.seed)
    run_sequence(sequence, command.out, window=command.window, seed=command.seed, view_frame=command.frames // 2)
