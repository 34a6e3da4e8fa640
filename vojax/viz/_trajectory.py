"""A trajectory beside the truth: top view, and errors over time."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vojax.metrics import AlignedPair, Trajectory, align

from ._figure import BLUE, GREEN, INK, MUTED, ORANGE, TRUTH, new_figure, quiet_axes, series_colour

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Plane = Literal["xz", "xy", "yz"]


def plot_trajectory(
    estimate: Trajectory,
    truth: Trajectory | None = None,
    *,
    alignment: Literal["none", "se3", "sim3"] = "none",
    origin: Literal["identity", "given"] = "identity",
    max_difference_s: float = 0.01,
    plane: Plane = "xz",
    title: str | None = None,
    label: str = "vojax",
    time_unit: str = "s",
) -> "Figure":
    """Draw a trajectory from above and, where the truth is known, its errors over time.

    Args:
        estimate: Estimated poses.
        truth: True poses; without them only the path is drawn.
        alignment: How the estimate is brought to the truth; see `vojax.metrics.align`.
        origin: "identity" draws both in the frame of their first common pose; "given" as they are.
        max_difference_s: Largest difference of matching times, seconds.
        plane: Plane to look at. "xz" is the view from above for a camera that starts level, with x to its right, y
            down and z forward.
        title: Headline.
        label: Name of the estimate in the legend.
        time_unit: Unit of the timestamps: "s", or "frames" where the format has no times.

    Returns:
        A matplotlib figure for `save_figure` or a notebook.

    Raises:
        ImportError: Matplotlib is not installed.
        ValueError: An unknown plane, or what `align` raises.
    """
    if plane not in ("xz", "xy", "yz"):
        raise ValueError(f"unknown plane {plane!r}; expected 'xz', 'xy' or 'yz'")
    if truth is None:
        figure = new_figure(5.6, 5.2)
        path = estimate.from_origin() if origin == "identity" else estimate
        axes = figure.add_subplot()
        _draw_map(axes, path, None, plane, label)
        note = f"{path.path_length:,.1f} m, {len(path):,} poses"
    else:
        pair = align(estimate, truth, alignment, origin=origin, max_difference_s=max_difference_s)
        figure = new_figure(10.4, 4.8)
        grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
        _draw_map(figure.add_subplot(grid[:, 0]), pair.estimate, pair.truth, plane, label)
        upper = figure.add_subplot(grid[0, 1])
        lower = figure.add_subplot(grid[1, 1], sharex=upper)
        _draw_errors(upper, lower, pair, time_unit)
        note = _summary(pair, alignment)
    if title:
        figure.suptitle(title, color=INK, fontsize=13, fontweight="bold", x=0.01, ha="left")
    figure.supxlabel(note, color=MUTED, fontsize=9, x=0.01, ha="left")
    return figure


def plot_trajectories(
    estimates: Mapping[str, Trajectory],
    truth: Trajectory | None = None,
    *,
    plane: Plane = "xz",
    title: str | None = None,
) -> "Figure":
    """Draw several trajectories from above, as they are.

    Args:
        estimates: Poses by a name for the legend, in the frame and scale of the truth; see `vojax.metrics.align`.
        truth: True poses.
        plane: As for `plot_trajectory`.
        title: Headline.

    Returns:
        A matplotlib figure for `save_figure` or a notebook.

    Raises:
        ImportError: Matplotlib is not installed.
        ValueError: There is no trajectory, or the plane is not known.
    """
    if plane not in ("xz", "xy", "yz"):
        raise ValueError(f"unknown plane {plane!r}; expected 'xz', 'xy' or 'yz'")
    if not estimates:
        raise ValueError("there are no trajectories: expected at least one")
    h, v = ("xyz".index(letter) for letter in plane)
    figure = new_figure(7.6, 5.6)
    axes = figure.add_subplot()
    quiet_axes(axes)
    if truth is not None:
        x, y = _broken(truth.timestamps, truth.positions[:, h], truth.positions[:, v])
        axes.plot(x, y, color=TRUTH, linewidth=4.5, alpha=0.75, solid_capstyle="round", label="ground truth")
    for i, (name, estimate) in enumerate(estimates.items()):
        x, y = _broken(estimate.timestamps, estimate.positions[:, h], estimate.positions[:, v])
        axes.plot(x, y, color=series_colour(i), linewidth=1.6, label=name)
    everything = np.concatenate([one.positions for one in (*estimates.values(), *([truth] if truth else []))])
    _frame(axes, everything[:, h], everything[:, v])
    axes.set_xlabel(f"{plane[0]} [m]", color=INK)
    axes.set_ylabel(f"{plane[1]} [m]", color=INK)
    axes.legend(frameon=False, fontsize=9, labelcolor=INK, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    if title:
        figure.suptitle(title, color=INK, fontsize=13, fontweight="bold", x=0.01, ha="left")
    return figure


def _summary(pair: AlignedPair, alignment: str) -> str:
    rmse = float(np.sqrt(np.mean(pair.position_errors**2)))
    length = pair.truth.path_length
    aligned = {"none": "no alignment", "se3": "SE(3) aligned", "sim3": f"Sim(3) aligned, scale {pair.scale:.4g}"}
    parts = [f"ATE {_metres(rmse)} RMSE ({aligned[alignment]})"]
    if length > 0:
        parts.append(f"drift {100 * pair.position_errors[-1] / length:.2f} % at the end")
    parts.append(f"path {_metres(length)}")
    parts.append(f"{len(pair.truth):,} poses")
    return "   ·   ".join(parts)


def _metres(value: float) -> str:
    return f"{value:,.1f} m" if value >= 10 else f"{value:.2f} m" if value >= 1 else f"{100 * value:.1f} cm"


def _unit(errors: np.ndarray) -> tuple[float, str]:
    """Factor and unit that keep the numbers on a metre axis readable."""
    return (100.0, "cm") if errors.max() < 0.5 else (1.0, "m")


def _broken(times: np.ndarray, *series: np.ndarray) -> list[np.ndarray]:
    """Put a NaN where poses are missing for long, so that no line is drawn across."""
    steps = np.diff(times)
    gaps = np.flatnonzero(steps > 10 * np.median(steps)) + 1 if steps.size else np.zeros(0, np.int64)
    return [np.insert(values.astype(np.float64), gaps, np.nan) for values in series]


def _draw_map(axes: Any, estimate: Trajectory, truth: Trajectory | None, plane: Plane, label: str) -> None:
    h, v = ("xyz".index(letter) for letter in plane)
    quiet_axes(axes)
    if truth is not None:
        x, y = _broken(truth.timestamps, truth.positions[:, h], truth.positions[:, v])
        # A wide pale band under a thin line: both stay visible where they coincide.
        axes.plot(x, y, color=TRUTH, linewidth=4.5, alpha=0.75, solid_capstyle="round", label="ground truth")
    path = estimate.positions
    axes.plot(*_broken(estimate.timestamps, path[:, h], path[:, v]), color=BLUE, linewidth=1.6, label=label)
    marks = {"markeredgecolor": "white", "markeredgewidth": 1.0, "linestyle": "none", "zorder": 5}
    axes.plot(path[0, h], path[0, v], marker="o", markersize=8, color=GREEN, label="start", **marks)
    axes.plot(path[-1, h], path[-1, v], marker="s", markersize=8, color=ORANGE, label="end", **marks)
    everything = path if truth is None else np.concatenate([path, truth.positions])
    _frame(axes, everything[:, h], everything[:, v])
    axes.set_xlabel(f"{plane[0]} [m]", color=INK)
    axes.set_ylabel(f"{plane[1]} [m]", color=INK)
    axes.legend(
        frameon=False,
        fontsize=9,
        labelcolor=INK,
        ncols=4,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.2,
        handlelength=1.4,
        columnspacing=1.2,
    )


def _frame(axes: Any, x: np.ndarray, y: np.ndarray) -> None:
    """Set equal scales, a margin, and a frame whose sides differ by no more than 5:2."""
    middle_x, middle_y = (x.min() + x.max()) / 2, (y.min() + y.max()) / 2
    width, height = float(np.ptp(x)), float(np.ptp(y))
    extent = max(width, height, 1e-3)
    half_x, half_y = (0.56 * max(side, 0.4 * extent) for side in (width, height))
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(middle_x - half_x, middle_x + half_x)
    axes.set_ylim(middle_y - half_y, middle_y + half_y)


def _draw_errors(upper: Any, lower: Any, pair: AlignedPair, time_unit: str) -> None:
    time = pair.truth.timestamps
    # Times counted from 1970 say nothing on an axis; count from the start.
    time = time if time_unit == "frames" else time - time[0]
    factor, unit = _unit(pair.position_errors)
    panels = (
        (upper, factor * pair.position_errors, BLUE, "position error", f" {unit}"),
        (lower, pair.rotation_errors_deg, ORANGE, "rotation error", "°"),
    )
    for axes, errors, colour, name, suffix in panels:
        quiet_axes(axes)
        x, y = _broken(time, time, errors)
        axes.fill_between(x, 0.0, y, color=colour, alpha=0.15, linewidth=0)
        axes.plot(x, y, color=colour, linewidth=1.3)
        rmse, largest = float(np.sqrt(np.mean(errors**2))), float(errors.max())
        axes.axhline(rmse, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
        axes.set_title(
            f"RMSE {rmse:.3g}{suffix} (dashed)   ·   largest {largest:.3g}{suffix}",
            loc="right",
            fontsize=9,
            color=MUTED,
        )
        axes.set_ylabel(f"{name} [{suffix.strip()}]", color=INK)
        axes.set_ylim(0.0, 1.08 * largest if largest > 0 else 1.0)
        axes.margins(x=0.01)
    upper.tick_params(labelbottom=False)
    lower.set_xlabel("frame" if time_unit == "frames" else f"time [{time_unit}]", color=INK)
