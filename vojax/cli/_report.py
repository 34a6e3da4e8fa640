"""Tables and files of numbers."""

import json
import math
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

# What the table shows, in order: key of metrics.json, label, format.
_ROWS = (
    ("frames", "frames", "{:d}"),
    ("frames_per_second", "frames per second (after compilation)", "{:.1f}"),
    ("compile_seconds", "compile seconds", "{:.1f}"),
    ("first_pose_seconds", "first pose after, seconds", "{:.1f}"),
    ("path_length_m", "path length", "{:.2f} m"),
    ("ate_rmse_m", "ATE RMSE", "{:.4f} m"),
    ("ate_rmse_se3_m", "ATE RMSE, SE(3) aligned", "{:.4f} m"),
    ("ate_rmse_sim3_m", "ATE RMSE, Sim(3) aligned", "{:.4f} m"),
    ("rpe_trans_m", "RPE translation", "{:.4f} m"),
    ("rpe_rot_deg", "RPE rotation", "{:.4f}°"),
    ("drift_percent", "drift at the end", "{:.3f} %"),
    ("kitti_t_rel_percent", "KITTI translation error", "{:.3f} %"),
    ("kitti_r_rel_deg_per_100m", "KITTI rotation error", "{:.3f}° per 100 m"),
    ("scale", "scale of the alignment", "{:.6g}"),
    ("mean_inliers", "inliers per frame", "{:.0f}"),
    ("failures", "failures (frames bridged)", "{:d}"),
    ("peak_memory_mb", "peak memory", "{:.0f} MB"),
)


def print_metrics(console: Console, title: str, metrics: Mapping[str, Any], by_name: bool = False) -> None:
    """Print those metrics that have a value.

    Args:
        console: Where to print.
        title: Headline.
        metrics: By their names in `metrics.json`.
        by_name: Label rows by these names, with all digits, instead of by words.
    """
    table = Table(show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(justify="right", no_wrap=True)
    for key, label, form in _ROWS:
        if key == "scale" and metrics.get("alignment") != "sim3":
            continue
        if metrics.get(key) is not None:
            value = metrics[key]
            exact = str(value) if isinstance(value, int) else f"{value:.9g}"
            table.add_row(*((key, exact) if by_name else (label, form.format(value))))
    console.print(title, style="bold", highlight=False, markup=False, soft_wrap=True)
    console.print(table)


def print_line(console: Console, text: str) -> None:
    """Print a sentence as it is: paths are neither wrapped nor coloured."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def count(number: int, noun: str) -> str:
    """A number of things, in words: 1 frame, 2 frames."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def some_frames(frames: Sequence[int]) -> str:
    """The first of some frames, by their numbers."""
    return ", ".join(map(str, frames[:12])) + (", …" if len(frames) > 12 else "")


def write_json(path: pathlib.Path, values: Mapping[str, Any]) -> None:
    """Write a JSON file in one go: a reader sees the old file or the whole new one. NaN and infinity become null."""
    text = json.dumps(_finite(values), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from None


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
