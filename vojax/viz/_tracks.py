"""Feature tracks drawn over an image."""

from typing import TYPE_CHECKING

import numpy as np

from vojax._types import ArrayLike, Bool, Float

from ._figure import BLUE, ORANGE, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_tracks(
    image: np.ndarray,
    pixels0: Float[ArrayLike, "n 2"],
    pixels1: Float[ArrayLike, "n 2"],
    inliers: Bool[ArrayLike, "n"] | None = None,
) -> "Figure":
    """Draw where points moved from the frame before to this image.

    Args:
        image: Grey [h, w] or RGB [h, w, 3] image, 8 or 16 bit or floating point.
        pixels0: Positions in the frame before, pixels (integer pixel centres).
        pixels1: Positions in `image`, pixels.
        inliers: True for the tracks to draw as inliers (blue); the others are orange.

    Returns:
        A figure as large as the image (at 100 dots per inch), for `save_figure` with `dpi=100` or more.

    Raises:
        ImportError: Matplotlib is not installed.
        ValueError: The image is not grey or RGB.
    """
    image = np.asarray(image)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(f"expected a grey [h, w] or RGB [h, w, 3] image; found shape {image.shape}")
    start, end = np.asarray(pixels0, np.float64), np.asarray(pixels1, np.float64)
    kept = np.ones(len(end), bool) if inliers is None else np.asarray(inliers)
    height, width = image.shape[:2]
    figure = new_figure(width / 100, height / 100)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    low, high = float(image.min()), float(image.max())
    if np.issubdtype(image.dtype, np.integer) and image.dtype.itemsize == 1:
        low, high = 0.0, 255.0
    shown = (image.astype(np.float64) - low) / max(high - low, 1e-12)
    axes.imshow(shown, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest", aspect="auto")
    from matplotlib.collections import LineCollection

    for chosen, colour in ((~kept, ORANGE), (kept, BLUE)):
        segments = list(np.stack([start[chosen], end[chosen]], axis=1))
        # White under colour keeps tracks readable on dark and bright ground alike.
        axes.add_collection(LineCollection(segments, colors="white", linewidths=2.6, alpha=0.7))
        axes.add_collection(LineCollection(segments, colors=colour, linewidths=1.3))
        axes.scatter(end[chosen, 0], end[chosen, 1], s=11, color=colour, edgecolors="white", linewidths=0.6, zorder=3)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    return figure
