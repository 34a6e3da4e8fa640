"""Residuals before and after an adjustment."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ._figure import BLUE, INK, MUTED, ORANGE, new_figure, quiet_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# More points than this look like fewer.
_MOST_POINTS = 20_000


def plot_residuals(
    before: Float[np.ndarray, "o 2"], after: Float[np.ndarray, "o 2"], *, unit: str = "px", title: str | None = None
) -> "Figure":
    """Draw how long residuals were and are, and where those that remain point.

    Args:
        before: Residuals at the start.
        after: Residuals at the end, in the same order.
        unit: Of both.
        title: Headline.

    Returns:
        A matplotlib figure for `save_figure` or a notebook.

    Raises:
        ImportError: Matplotlib is not installed.
        ValueError: There are no finite residuals.
    """
    rows = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    if before.shape != after.shape or not rows.any():
        raise ValueError(
            f"residuals of shapes {before.shape} and {after.shape} with {int(rows.sum())} finite rows: expected some"
        )
    before, after = before[rows], after[rows]
    lengths = {"before": np.linalg.norm(before, axis=1), "after": np.linalg.norm(after, axis=1)}
    figure = new_figure(10.4, 4.4)
    histogram, scatter = figure.subplots(1, 2, width_ratios=(1.5, 1))
    smallest = max(min(np.quantile(values, 0.01) for values in lengths.values()), 1e-6)
    largest = max(max(values.max() for values in lengths.values()), 10 * smallest)
    bins = np.geomspace(smallest, largest, 60)
    for (name, values), color in zip(lengths.items(), (ORANGE, BLUE), strict=True):
        rms = float(np.sqrt(np.mean(values**2)))
        label = f"{name}: RMS {rms:.3g} {unit}, median {np.median(values):.3g} {unit}"
        histogram.hist(np.clip(values, smallest, largest), bins=bins, color=color, alpha=0.6, label=label)
    histogram.set_xscale("log")
    histogram.set_xlabel(f"length of the residual, {unit}", color=INK)
    histogram.set_ylabel("observations", color=INK)
    histogram.legend(frameon=False, fontsize=9, labelcolor=INK)
    reach = 1.5 * max(float(np.quantile(lengths["after"], 0.98)), 1e-6)
    shown = after[np.linspace(0, len(after) - 1, min(len(after), _MOST_POINTS)).astype(int)]
    scatter.plot(shown[:, 0], shown[:, 1], ".", color=BLUE, markersize=1.5, alpha=0.4)
    scatter.axhline(0, color=MUTED, linewidth=0.8)
    scatter.axvline(0, color=MUTED, linewidth=0.8)
    scatter.set_xlim(-reach, reach)
    scatter.set_ylim(reach, -reach)
    scatter.set_aspect("equal")
    scatter.set_xlabel(f"after, u, {unit}", color=INK)
    scatter.set_ylabel(f"after, v, {unit}", color=INK)
    for axes in (histogram, scatter):
        quiet_axes(axes)
    if title:
        figure.suptitle(title, color=INK, fontsize=11)
    return figure
