"""`vojax eval`: two trajectory files."""

import math

from rich.console import Console

from vojax.metrics import evaluate, read_trajectory

from ._arguments import Eval
from ._report import print_line, print_metrics, write_json

_ALIGNED = {"none": "not aligned", "se3": "SE(3) aligned", "sim3": "Sim(3) aligned"}
_ORIGIN = {"identity": "both start at the identity", "given": "origins as given"}


def execute(command: Eval) -> None:
    """Read both files, compare, print and write."""
    if not (math.isfinite(command.max_difference_s) and command.max_difference_s >= 0):
        raise ValueError(f"--max-difference-s is {command.max_difference_s}; expected seconds, 0 or more")
    if command.json is not None and command.json.resolve() in (command.est.resolve(), command.truth.resolve()):
        raise ValueError(f"--json {command.json} is one of the trajectories; choose another file")
    estimate = read_trajectory(command.est, command.format)
    truth = read_trajectory(command.truth, command.format)
    metrics = evaluate(
        estimate,
        truth,
        command.alignment,
        origin=command.origin,
        max_difference_s=command.max_difference_s,
    )
    values = {
        **metrics.as_dict(),
        "origin": command.origin,
        "frames_in_estimate": len(estimate),
        "frames_in_truth": len(truth),
    }
    if command.json is not None:
        write_json(command.json, values)
    console = Console()
    title = f"{_ALIGNED[command.alignment]}, {_ORIGIN[command.origin]}"
    print_metrics(console, title, values, by_name=True)
    print_line(console, f"{len(estimate)} poses in the estimate, {len(truth)} in the truth, {metrics.frames} compared")
    if command.json is not None:
        print_line(console, f"in {command.json}: the same numbers")
