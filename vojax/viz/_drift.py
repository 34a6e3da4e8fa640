"""Relative errors by the length of the stretch, as the KITTI benchmark plots them."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from vojax.metrics import KittiErrors

from ._figure import INK, MUTED, new_figure, quiet_axes, series_colour

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_drift_by_length(errors: Mapping[str, KittiErrors], *, title: str | None = None) -> "Figure":
    """Draw the mean relative error of stretches of 100 m, 200 m, …, with their quartiles where there are several.

    Args:
        errors: What `vojax.metrics.kitti_errors` returns, by a name for the legend.
        title: Headline.

    Returns:
        A matplotlib figure for `save_figure` or a notebook.

    Raises:
        ImportError: Matplotlib is not installed.
        ValueError: No path is long enough for a stretch.
    """
    shown = {name: one for name, one in errors.items() if one.lengths_m.size}
    if not shown:
        raise ValueError("no path is as long as the shortest stretch: expected errors of at least one")
    figure = new_figure(9.6, 4.0)
    translation, rotation = figure.subplots(1, 2)
    panels = (
        (translation, "translation error [%]", lambda one: 100.0 * one.translation),
        (rotation, "rotation error [°/100 m]", lambda one: 100.0 * np.degrees(one.rotation_rad_per_m)),
    )
    for axes, label, values_of in panels:
        quiet_axes(axes)
        for i, (name, one) in enumerate(shown.items()):
            values = values_of(one)
            lengths = np.unique(one.lengths_m)
            by_length = [values[one.lengths_m == length] for length in lengths]
            lower, upper = (np.array([np.quantile(part, q) for part in by_length]) for q in (0.25, 0.75))
            colour = series_colour(i)
            axes.fill_between(lengths, lower, upper, color=colour, alpha=0.15, linewidth=0)
            mean = [part.mean() for part in by_length]
            axes.plot(lengths, mean, color=colour, marker="o", markersize=5, linewidth=1.5, label=name)
        axes.set_xlabel("length of the stretch [m]", color=INK)
        axes.set_ylabel(label, color=INK)
        axes.set_ylim(bottom=0.0)
    if len(shown) > 1:
        translation.legend(frameon=False, fontsize=9, labelcolor=INK)
    if title is None and len(shown) == 1:
        title = next(iter(shown))
    if title:
        figure.suptitle(title, color=INK, fontsize=13, fontweight="bold", x=0.01, ha="left")
    stretches = sum(one.lengths_m.size for one in shown.values())
    figure.supxlabel(f"mean and quartiles of {stretches:,} stretches", color=MUTED, fontsize=9, x=0.01, ha="left")
    return figure
