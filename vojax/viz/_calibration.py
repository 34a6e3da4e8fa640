"""What a calibration leaves: residuals, and where in the image corners were seen."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ._figure import BLUE, INK, MUTED, ORANGE, new_figure, quiet_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_calibration(
    corners: Float[np.ndarray, "k 2"],
    residuals: Float[np.ndarray, "k 2"],
    image_size: tuple[int, int],
    *,
    title: str | None = None,
) -> "Figure":
    """Draw where corners were seen with their enlarged residuals, and the residuals by themselves.

    Args:
        corners: Measured pixels of all views.
        residuals: Reprojected minus measured, pixels.
        image_size: Width and height.
        title: Headline.

    Returns:
        A matplotlib figure for `save_figure` or a notebook.

    Raises:
        ImportError: Matplotlib is not installed.
        ValueError: There are no corners, or the arrays do not match.
    """
    if corners.shape != residuals.shape or len(corners) == 0:
        raise ValueError(f"corners {corners.shape} and residuals {residuals.shape}: expected some, one for each")
    width, height = image_size
    figure = new_figure(11.0, 4.6)
    coverage, scatter = figure.subplots(1, 2, width_ratios=(1.6, 1))
    length = np.linalg.norm(residuals, axis=1)
    typical = max(float(np.quantile(length, 0.9)), 1e-9)
    factor = 10.0 ** np.floor(np.log10(0.04 * width / typical))
    coverage.plot(corners[:, 0], corners[:, 1], ".", color=BLUE, markersize=3, alpha=0.5)
    ends = corners + factor * residuals
    coverage.plot(
        np.stack([corners[:, 0], ends[:, 0]]), np.stack([corners[:, 1], ends[:, 1]]), color=ORANGE, linewidth=0.6
    )
    coverage.set_xlim(-0.5, width - 0.5)
    coverage.set_ylim(height - 0.5, -0.5)
    coverage.set_aspect("equal")
    coverage.set_xlabel(f"u, px (residuals × {factor:g})", color=INK)
    coverage.set_ylabel("v, px", color=INK)
    reach = 1.5 * max(float(np.quantile(length, 0.98)), 1e-9)
    scatter.plot(residuals[:, 0], residuals[:, 1], ".", color=BLUE, markersize=2.5, alpha=0.5)
    scatter.axhline(0, color=MUTED, linewidth=0.8)
    scatter.axvline(0, color=MUTED, linewidth=0.8)
    scatter.set_xlim(-reach, reach)
    scatter.set_ylim(reach, -reach)
    scatter.set_aspect("equal")
    scatter.set_xlabel(f"residual, u, px (RMS {float(np.sqrt(np.mean(length**2))):.3g} px)", color=INK)
    scatter.set_ylabel("residual, v, px", color=INK)
    for axes in (coverage, scatter):
        quiet_axes(axes)
    if title:
        figure.suptitle(title, color=INK, fontsize=11)
    return figure
