"""Windows of an image around many points at once, with spline interpolation between pixels."""

import cv2
import numpy as np
from jaxtyping import Float32, Int
from numpy.lib.stride_tricks import sliding_window_view


def pad(image: np.ndarray, border: int) -> Float32[np.ndarray, "h w"]:
    """The image in single precision with its outermost pixels repeated `border` times on every side."""
    return cv2.copyMakeBorder(image, border, border, border, border, cv2.BORDER_REPLICATE).astype(np.float32)


def windows(
    padded: np.ndarray, border: int, top: Int[np.ndarray, "n"], left: Int[np.ndarray, "n"], height: int, width: int
) -> Float32[np.ndarray, "n height width"]:
    """Cut one window per point out of a padded image; positions count in the original image."""
    rows = np.clip(top + border, 0, padded.shape[0] - height)
    cols = np.clip(left + border, 0, padded.shape[1] - width)
    # Indexing the sliding view copies whole rows of a window, several times faster than gathering single pixels.
    return sliding_window_view(padded, (height, width))[rows, cols]


def spline_coefficients(image: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Coefficients of the cubic B-spline through the pixels.

    Four-tap interpolation straight from the pixels (Keys' cubic) is out of phase by up to 0.02 px for waves of one
    radian per pixel, which biases matches towards whole and half pixels; the spline is not.
    """
    # The inverse of the filter (1, 4, 1)/6 is √3 z^|k| with z = √3 − 2; what five terms leave is below 1e-3.
    tap = np.arange(-5, 6)
    kernel = np.sqrt(3.0) * (np.sqrt(3.0) - 2.0) ** np.abs(tap)
    kernel = (kernel / kernel.sum()).astype(np.float32)
    return cv2.sepFilter2D(image, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE)


def spline_weights(fraction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Weights of the coefficients at −1, 0, 1, 2 for a position `fraction` past 0 (cubic B-spline)."""
    f, g = fraction, 1.0 - fraction
    return (
        g * g * g / 6.0,
        (3.0 * f - 6.0) * f * f / 6.0 + 2.0 / 3.0,
        (3.0 * g - 6.0) * g * g / 6.0 + 2.0 / 3.0,
        f * f * f / 6.0,
    )


def shift_rows(
    block: Float32[np.ndarray, "n height width"], fraction: Float32[np.ndarray, "n"]
) -> Float32[np.ndarray, "n height-3 width"]:
    """Interpolate `fraction` of a row further down; the first output row sits at input row 1 + `fraction`."""
    weights = [weight[:, None, None] for weight in spline_weights(fraction)]
    size = block.shape[1] - 3
    out = weights[0] * block[:, :size]
    for k in (1, 2, 3):
        out += weights[k] * block[:, k : k + size]
    return out


def shift_columns(
    block: Float32[np.ndarray, "n height width"], fraction: Float32[np.ndarray, "n height"]
) -> Float32[np.ndarray, "n height width-3"]:
    """Interpolate each row `fraction` of a column further right; the first output column sits at 1 + `fraction`."""
    weights = [weight[:, :, None] for weight in spline_weights(fraction)]
    size = block.shape[2] - 3
    out = weights[0] * block[:, :, :size]
    for k in (1, 2, 3):
        out += weights[k] * block[:, :, k : k + size]
    return out


def sample_rows(
    block: Float32[np.ndarray, "n height width"], start: Float32[np.ndarray, "n height"], columns: int
) -> Float32[np.ndarray, "n height columns"]:
    """Interpolate `columns` samples one pixel apart in each row, from column `start` on (clipped into the block)."""
    n, height, width = block.shape
    start = np.clip(start, 1.0, width - columns - 2.0 + 0.999)
    whole = start.astype(np.intp)
    view = sliding_window_view(block, columns + 3, axis=2)
    cut = view[np.arange(n)[:, None], np.arange(height)[None, :], whole - 1]
    return shift_columns(cut, (start - whole).astype(np.float32))
