"""Time per frame, by stage."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ._figure import INK, new_figure, quiet_axes, series_colour

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_timings(stages: Mapping[str, Sequence[float] | np.ndarray], *, title: str | None = None) -> "Figure":
    """Draw how long each stage took, frame by frame, and which share of the frames took how long at most.

    Args:
        stages: Seconds per frame by the stage's name, one number for each frame; NaN is left out.
        title: Headline.

    Returns:
        A matplotlib figure for `save_figure` or a notebook.

    Raises:
        ImportError: Matplotlib is not installed.
        ValueError: There is no time to draw.
    """
    milliseconds = {name: 1e3 * np.asarray(seconds, np.float64) for name, seconds in stages.items()}
    milliseconds = {name: values for name, values in milliseconds.items() if np.isfinite(values).any()}
    if not milliseconds:
        raise ValueError("there are no finite times: expected some")
    figure = new_figure(10.4, 4.0)
    by_frame, shares = figure.subplots(1, 2, width_ratios=(1.5, 1), sharey=True)
    for axes in (by_frame, shares):
        quiet_axes(axes)
    for i, (name, values) in enumerate(milliseconds.items()):
        colour, finite = series_colour(i), np.sort(values[np.isfinite(values)])
        median, p99 = np.percentile(finite, [50, 99])
        by_frame.plot(values, color=colour, linewidth=1.2)
        share = 100 * np.arange(1, len(finite) + 1) / len(finite)
        label = f"{name}: median {median:.3g} ms, 99 % within {p99:.3g} ms"
        shares.plot(share, finite, color=colour, linewidth=1.6, label=label)
    # Reading and writing take a hundredth of what a step takes.
    if all((values[np.isfinite(values)] > 0).all() for values in milliseconds.values()):
        by_frame.set_yscale("log")
    by_frame.set_xlabel("frame", color=INK)
    by_frame.set_ylabel("time [ms]", color=INK)
    shares.set_xlabel("share of the frames [%]", color=INK)
    shares.legend(
        frameon=False, fontsize=9, labelcolor=INK, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2
    )
    if title:
        figure.suptitle(title, color=INK, fontsize=13, fontweight="bold", x=0.01, ha="left")
    return figure
