"""Disparity of points in a rectified pair.

Integer search by zero-mean normalised cross-correlation on half-size images, one full-size step around its peak, then
least squares for the sub-pixel part. In the last step the left window L, whose noise does not depend on the estimate,
supplies the gradients: with the right image sampled at the current disparity,

    R(x − d(x)) ≈ gain · L(x) + bias + gain · Lₓ(x) · (δ + δ_slope · y),    d(x) = d + slope · y,

is linear with a fixed left side, so that one pseudo-inverse per point serves all iterations, and interpolation noise
does not pull the answer towards whole or half pixels as parabola fits and forward gradients do. The slope over rows
lets windows lie on the ground.
"""

import dataclasses
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from ._image import check_pixels, gray_pair, inside
from ._patches import pad, sample_rows, shift_columns, shift_rows, spline_coefficients, windows


@dataclasses.dataclass(frozen=True)
class StereoOptions:
    """How points are matched along rows.

    Attributes:
        min_disparity_px: Smallest disparity accepted.
        max_disparity_px: Largest disparity searched.
        coarse_radius_px: Window radius of the search on half-size images, in pixels of those.
        radius_px: Window radius at full size.
        row_tolerance_px: Rows above and below that the full-size step looks at.
        min_correlation: Least correlation of the windows, after the sub-pixel step too.
        uniqueness: Largest ratio of (1 − correlation) between the best peak and the second best.
        left_right_px: Largest distance between a point and its match matched back.
        iterations: Sub-pixel iterations.
        row_sigma_px: Standard deviation of the row offset left over by rectification; 0 trusts the rows.
        slope_sigma: Standard deviation of the slope of disparity over rows, px per px; 0 keeps windows upright.
        sigma_floor_px: Part of the disparity's standard deviation that the window's residual does not show.
    """

    min_disparity_px: float = 0.5
    max_disparity_px: float = 128.0
    coarse_radius_px: int = 4
    radius_px: int = 5
    row_tolerance_px: int = 1
    min_correlation: float = 0.8
    uniqueness: float = 0.8
    left_right_px: float = 2.0
    iterations: int = 4
    row_sigma_px: float = 0.5
    slope_sigma: float = 0.3
    sigma_floor_px: float = 0.05

    def __post_init__(self) -> None:
        if not self.min_disparity_px < self.max_disparity_px:
            raise ValueError(
                f"min_disparity_px is {self.min_disparity_px} and max_disparity_px {self.max_disparity_px}: "
                "expected min < max"
            )
        if self.radius_px < 1 or self.coarse_radius_px < 1 or self.iterations < 1:
            raise ValueError(
                f"radius_px, coarse_radius_px, iterations are {self.radius_px}, {self.coarse_radius_px}, "
                f"{self.iterations}: expected at least 1"
            )


class StereoMatches(NamedTuple):
    """Disparities of points of the left image; row i belongs to row i of the input.

    Attributes:
        disparity: u_left − u_right in pixels; 0 where not valid.
        quality: Correlation of the windows, at most 1; 0 where not valid.
        sigma: Standard deviation of the disparity in pixels; 1 where not valid.
        valid: True where a unique and consistent match was found.
        row_offset: v_right − v_left in pixels, drawn towards 0 by `StereoOptions.row_sigma_px`; 0 where not valid.
            Sources of disparities without rows, such as depths, fill it with nan.
    """

    disparity: Float32[np.ndarray, "n"]
    quality: Float32[np.ndarray, "n"]
    sigma: Float32[np.ndarray, "n"]
    valid: Bool[np.ndarray, "n"]
    row_offset: Float32[np.ndarray, "n"]


def match_stereo_rows(
    left: np.ndarray, right: np.ndarray, pixels: np.ndarray, options: StereoOptions = StereoOptions()
) -> StereoMatches:
    """Find each point of the left image on the same row of the right one.

    Args:
        left: uint8 image of the left camera, rectified, grey or RGB.
        right: The right camera's, of the same size.
        pixels: Positions (u, v) `[n, 2]` in the left image.
        options: Search range, windows and checks.

    Returns:
        Sub-pixel disparities with quality, standard deviation and validity, in the order of `pixels`.

    Raises:
        ValueError: Images of different size or type, or `pixels` that are not `[n, 2]`.

    Degenerate input: windows without texture, repeated patterns and points near the border are not valid.

    References:
        Baker & Matthews, Lucas–Kanade 20 years on, IJCV 2004 (inverse compositional). Unser, Splines: a perfect
        fit for signal and image processing, 1999.
    """
    left, right = gray_pair(left, right, ("left", "right"))
    points = check_pixels(pixels)
    n = len(points)
    disparity, quality, valid = np.zeros(n, np.float32), np.zeros(n, np.float32), np.zeros(n, bool)
    sigma, rows = np.ones(n, np.float32), np.zeros(n, np.float32)
    index = np.flatnonzero(inside(points, left.shape, options.radius_px + 1))
    if len(index):
        coarse, ok = _search_coarse(left, right, points[index], options)
        index, coarse = index[ok], coarse[ok]
    border = options.radius_px + options.row_tolerance_px + 12
    left, right = pad(left, border), pad(right, border)
    if len(index):
        whole, row_offset, ok = _search_fine(left, right, border, points[index], coarse, options)
        index, whole, row_offset = index[ok], whole[ok], row_offset[ok]
    if len(index):
        left, right = spline_coefficients(left), spline_coefficients(right)
        found, correlation, deviation, row_offset, ok = _refine(
            left, right, border, points[index], whole, row_offset, options
        )
        disparity[index], quality[index], sigma[index], rows[index] = found, correlation, deviation, row_offset
        valid[index[ok]] = True
    return StereoMatches(
        np.where(valid, disparity, np.float32(0)), np.where(valid, quality, np.float32(0)),
        np.where(valid, sigma, np.float32(1)), valid, np.where(valid, rows, np.float32(0)),
    )  # fmt: skip


def _correlation(template: np.ndarray, strip: np.ndarray) -> np.ndarray:
    """Correlation of [n, h, w] windows with every offset into [n, h + r, w + s] strips: [r + 1, s + 1, n]."""
    n, height, width = template.shape
    template = template - template.mean(axis=(1, 2), keepdims=True)
    # Taking a common level off the strip keeps the running sums below exact in single precision.
    strip = strip - strip.mean(axis=(1, 2), keepdims=True)
    # Points on the last axis: every pass below is over long contiguous runs.
    template = np.ascontiguousarray(template.transpose(1, 2, 0))
    strip = np.ascontiguousarray(strip.transpose(1, 2, 0))
    rows, cols = strip.shape[0] - height + 1, strip.shape[1] - width + 1
    product = np.zeros((rows, cols, n), np.float32)
    scratch = np.empty_like(product)
    for row in range(height):
        for col in range(width):
            np.multiply(strip[row : row + rows, col : col + cols], template[row, col], out=scratch)
            product += scratch
    total = _box_sum(_box_sum(strip, height, 0), width, 1)
    energy = _box_sum(_box_sum(strip * strip, height, 0), width, 1)
    area = height * width
    energy -= total * total / area
    energy0 = np.square(template).sum(axis=(0, 1))
    # Less than half a grey level of contrast is no texture.
    usable = (energy > 0.25 * area) & (energy0 > 0.25 * area)
    return np.where(usable, product / np.sqrt(np.where(usable, energy * energy0, 1.0)), np.float32(-1))


def _box_sum(values: np.ndarray, length: int, axis: int) -> np.ndarray:
    """Sums of `length` consecutive values along an axis, by doubling (no cancellation)."""
    size = values.shape[axis] - length + 1

    def cut(array: np.ndarray, start: int, count: int) -> np.ndarray:
        return array[start : start + count] if axis == 0 else array[:, start : start + count]

    out: Any = None
    done, power, run = 0, 1, values
    while True:
        if length & power:
            part = cut(run, done, size)
            out = part.copy() if out is None else out + part
            done += power
        if done == length:
            return out
        count = run.shape[axis] - power
        run = cut(run, 0, count) + cut(run, power, count)
        power *= 2


def _search_coarse(left, right, points, options: StereoOptions):
    """Whole disparities from half-size images over the full range, unique and confirmed from right to left."""
    left, right = cv2.pyrDown(left), cv2.pyrDown(right)
    width, radius = left.shape[1], options.coarse_radius_px
    near = int(np.ceil(options.max_disparity_px / 2))
    far = int(np.floor(options.min_disparity_px / 2)) - 1
    size = 2 * radius + 1
    border = near - far + 2 * size
    left, right = pad(left, border), pad(right, border)
    col, row = np.rint(points / 2).astype(np.intp).T
    # Offset s of the strip stands for disparity near − s; a window must lie within the image.
    template = windows(left, border, row - radius, col - radius, size, size)
    strip = windows(right, border, row - radius, col - near - radius, size, size + near - far)
    score = _correlation(template, strip)[0]
    position = col - near + np.arange(near - far + 1)[:, None]
    score = np.where((position >= 0) & (position < width), score, np.float32(-1))
    best, ok = _unique_peak(score, options)
    match = col - near + best
    # Back: offset s stands for a point of the left image at match + far + s.
    kept = np.flatnonzero(ok)
    template = windows(right, border, row[kept] - radius, match[kept] - radius, size, size)
    strip = windows(left, border, row[kept] - radius, match[kept] + far - radius, size, size + near - far)
    score = _correlation(template, strip)[0]
    position = match[kept] + far + np.arange(near - far + 1)[:, None]
    score = np.where((position >= 0) & (position < width), score, np.float32(-1))
    back = match[kept] + far + np.argmax(score, axis=0)
    ok[kept] = np.abs(back - col[kept]) <= options.left_right_px / 2
    return (2.0 * (near - best)).astype(np.float32), ok


def _unique_peak(score: np.ndarray, options: StereoOptions) -> tuple[np.ndarray, np.ndarray]:
    best = np.argmax(score, axis=0)
    peak = np.take_along_axis(score, best[None], axis=0)[0]
    away = np.abs(np.arange(len(score))[:, None] - best) > 2
    second = np.max(np.where(away, score, np.float32(-1)), axis=0)
    # Half-size windows hold less detail: the threshold proper applies at full size. The 0.01 refuses two peaks that are
    # both perfect but for rounding.
    ok = (peak >= options.min_correlation - 0.1) & (1.01 - peak <= options.uniqueness * (1 - second))
    return best, ok


def _search_fine(left, right, border, points, disparity, options: StereoOptions):
    """Whole disparities and row offsets at full size around the coarse disparities."""
    radius, reach, rows = options.radius_px, 2, options.row_tolerance_px
    size = 2 * radius + 1
    col, row = np.rint(points).astype(np.intp).T
    guess = np.rint(disparity).astype(np.intp)
    template = windows(left, border, row - radius, col - radius, size, size)
    top, first = row - radius - rows, col - guess - reach - radius
    strip = windows(right, border, top, first, size + 2 * rows, size + 2 * reach)
    scores = _correlation(template, strip).reshape(-1, len(points))
    best = np.argmax(scores, axis=0)
    best_row, best_col = np.divmod(best, 2 * reach + 1)
    ok = np.take_along_axis(scores, best[None], axis=0)[0] >= options.min_correlation - 0.1
    return (guess + reach - best_col).astype(np.float32), (best_row - rows).astype(np.float32), ok


def _refine(left, right, border, points, disparity, row_offset, options: StereoOptions):
    """Sub-pixel disparity, correlation, standard deviation, row offset and acceptance."""
    radius, margin = options.radius_px, 4
    size = 2 * radius + 1
    n = len(points)
    whole = np.floor(points).astype(np.intp)
    fraction = (points - whole).astype(np.float32)
    block = windows(left, border, whole[:, 1] - radius - 2, whole[:, 0] - radius - 2, size + 5, size + 5)
    block = shift_columns(shift_rows(block, fraction[:, 1]), np.repeat(fraction[:, :1], size + 2, axis=1))
    window = block[:, 1:-1, 1:-1]
    along = 0.5 * (block[:, 1:-1, 2:] - block[:, 1:-1, :-2])
    across = 0.5 * (block[:, 2:, 1:-1] - block[:, :-2, 1:-1])
    offset = np.arange(-radius, radius + 1, dtype=np.float32)
    weight = np.exp(-0.5 * (offset / (0.6 * radius + 0.4)) ** 2)
    weight = (weight[:, None] * weight[None, :]).ravel().astype(np.float32)
    weight /= weight.sum()
    down = np.broadcast_to(offset[:, None], (size, size))
    level = (window.reshape(n, -1) @ weight)[:, None, None]
    parts = (window - level, np.ones_like(window), along, -across, along * down)
    design = np.stack([part.reshape(n, -1) for part in parts], axis=1)
    weighted = design * weight
    normal = (weighted @ design.transpose(0, 2, 1)).astype(np.float64)
    # Priors on the row offset and the slope weigh against the window as if it had two grey levels of noise.
    samples = (2 * radius + 1) ** 2 / 4
    sigmas = np.array([options.row_sigma_px, options.slope_sigma])
    prior = np.zeros(5)
    prior[3:] = (2.0 / np.maximum(sigmas, 1e-4)) ** 2 / samples
    ridge = 1e-7 * np.trace(normal, axis1=1, axis2=2)[:, None] + 1e-6
    inverse = np.linalg.inv(normal + (ridge + prior)[:, :, None] * np.eye(5)).astype(np.float32)
    solver = inverse @ weighted

    start = np.floor(points[:, 0] - disparity).astype(np.intp)
    reach = 2
    height, width = size + 3 + 2 * reach, size + 2 * margin + 1
    strip = windows(right, border, whole[:, 1] - radius - 1 - reach, start - radius - margin, height, width)
    base = (points[:, 0] - (start - radius - margin)).astype(np.float32)
    current, rows, slope = disparity.astype(np.float32), row_offset.astype(np.float32), np.zeros(n, np.float32)
    pull = inverse[:, 2:, 3:] * prior[3:].astype(np.float32)
    step: Any = None
    theta: Any = None
    sampled: Any = None
    gain: Any = None
    for iteration in range(options.iterations + 1):
        if iteration <= 2:
            # The row offset settles first; later it moves by less than the gradients' own error.
            at = np.clip(fraction[:, 1] + rows + reach, 0.0, 2 * reach + 0.999)
            at_whole = at.astype(np.intp)
            picked = strip[np.arange(n)[:, None], at_whole[:, None] + np.arange(size + 3)]
            shifted = shift_rows(picked, (at - at_whole).astype(np.float32))
        first = (base - current)[:, None] - radius - slope[:, None] * offset[None, :]
        sampled = sample_rows(shifted, first, size).reshape(n, -1) - level[:, :, 0]
        theta = (solver @ sampled[:, :, None])[:, :, 0]
        gain = np.maximum(theta[:, 0], 0.2)
        if iteration == options.iterations:
            break
        change = theta[:, 2:] / gain[:, None] - (pull @ np.stack([rows, slope], axis=1)[:, :, None])[:, :, 0]
        step = np.clip(change[:, 0], -1.0, 1.0)
        current = np.clip(current + step, disparity - margin + 2, disparity + margin - 2)
        if iteration < 2:
            rows = np.clip(rows + np.clip(change[:, 1], -0.5, 0.5), -reach + 0.5, reach - 0.5)
        slope = np.clip(slope + change[:, 2], -1.0, 1.0)
    residual = sampled - (design[:, :2].transpose(0, 2, 1) @ theta[:, :2, None])[:, :, 0]
    variance = (residual**2) @ weight
    # Correlation of the windows from the fit: explained over total.
    total = np.square(sampled - (sampled @ weight)[:, None]) @ weight
    correlation = np.sqrt(np.clip(1 - variance / np.maximum(total, 1e-6), 0, 1))
    # The weights sum to one, so the window counts as its effective number of samples.
    deviation = np.sqrt(np.maximum(variance, 0.25) * inverse[:, 2, 2] * np.square(weight).sum()) / gain
    deviation = np.sqrt(deviation**2 + options.sigma_floor_px**2)
    ok = (np.abs(step) < 0.05) & (theta[:, 0] > 0.4) & (theta[:, 0] < 2.5) & (correlation >= options.min_correlation)
    ok &= (
        (np.abs(current - disparity) < 1.5) & (np.abs(rows - row_offset) < 1.2) & (current >= options.min_disparity_px)
    )
    ok &= (current <= options.max_disparity_px) & (points[:, 0] - current >= radius)
    return (*(found.astype(np.float32) for found in (current, correlation, deviation, rows)), ok)
