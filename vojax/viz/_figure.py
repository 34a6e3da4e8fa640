"""Figures without a display and without touching matplotlib's global state."""

import os
import pathlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK = "#1a1a1a"
MUTED = "#6b7280"
GRID = "#e5e7eb"
# Okabe and Ito's palette: distinct under the common forms of colour blindness, and in grey.
BLUE = "#0072b2"
ORANGE = "#d55e00"
GREEN = "#009e73"
TRUTH = "#9ca3af"
_SERIES = (BLUE, ORANGE, GREEN, "#cc79a7", "#e69f00", "#56b4e9", INK)


def series_colour(i: int) -> str:
    """Colour of series `i`; they repeat after seven."""
    return _SERIES[i % len(_SERIES)]


def new_figure(width: float, height: float) -> "Figure":
    """Create an empty figure (inches) that no window system knows about."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError("vojax.viz draws with matplotlib, which is not installed: pip install 'vojax[viz]'") from None
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def quiet_axes(axes: Any) -> None:
    """Leave out what carries no data: top and right spines, dark grids, heavy ticks."""
    axes.set_facecolor("white")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.tick_params(colors=MUTED, labelcolor=INK, labelsize=9, length=3)
    axes.grid(True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)


def save_figure(figure: "Figure", path: str | os.PathLike, dpi: int = 150) -> pathlib.Path:
    """Write a figure to a file; needs no display and leaves matplotlib's backend alone.

    Args:
        figure: Figure to write.
        path: File; the suffix (.png, .pdf, .svg, …) picks the format. Its folder must exist.
        dpi: Dots per inch of pixel formats.

    Returns:
        The path of the file.

    Raises:
        FileNotFoundError: The folder does not exist.
        ValueError: Matplotlib does not know the suffix.
    """
    path = pathlib.Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: no such folder to write {path.name} in")
    known = figure.canvas.get_supported_filetypes()
    if path.suffix.lstrip(".").lower() not in known:
        raise ValueError(
            f"{path}: cannot write {path.suffix or 'a file without suffix'!r}; expected .png, .pdf or .svg"
        )
    figure.savefig(path, dpi=dpi)
    return path
