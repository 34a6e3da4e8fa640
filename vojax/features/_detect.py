"""Corners, spread evenly over the image."""

import dataclasses
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from ._image import check_pixels, inside, to_gray


@dataclasses.dataclass(frozen=True)
class DetectorOptions:
    """How corners are found and spread.

    Attributes:
        detector: "gftt" (Shi–Tomasi: the smaller eigenvalue of the structure tensor) or "fast" (segment test).
        max_features: Upper bound on features in the image, existing ones included.
        cell_px: Side of the square grid cells; each cell gets an equal share of `max_features`.
        min_distance_px: Least distance (larger of the two coordinates) between features, existing ones included.
        border_px: Width of the margin without features.
        block_px: Window over which the structure tensor is summed (gftt).
        min_quality: Weakest response kept: for "gftt" the square root of the smaller eigenvalue, roughly the r.m.s.
            gradient across the weaker direction in grey levels per pixel; for "fast" the segment-test threshold in
            grey levels.
        subpixel: Refine to sub-pixel corners, by at most half a block. Off because tracking and stereo matching
            need no corners and are as accurate around whole pixels (measured on KITTI 06).
    """

    detector: Literal["gftt", "fast"] = "gftt"
    max_features: int = 600
    cell_px: int = 64
    min_distance_px: int = 7
    border_px: int = 8
    block_px: int = 5
    min_quality: float = 2.0
    subpixel: bool = False

    def __post_init__(self) -> None:
        if self.detector not in ("gftt", "fast"):
            raise ValueError(f"detector is {self.detector!r}: expected 'gftt' or 'fast'")
        for name in ("max_features", "cell_px", "min_distance_px", "block_px"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: expected at least 1")


class Keypoints(NamedTuple):
    """Detected features, best first.

    Attributes:
        pixels: Positions (u, v).
        quality: Response of the detector, higher is better; comparable within one detector only.
    """

    pixels: Float32[np.ndarray, "n 2"]
    quality: Float32[np.ndarray, "n"]


def detect(
    image: np.ndarray, options: DetectorOptions = DetectorOptions(), existing: np.ndarray | None = None
) -> Keypoints:
    """Find new corners where the image has room for them.

    Args:
        image: uint8 image, grey or RGB.
        options: Detector, budget and spacing.
        existing: Positions `[n, 2]` of features that are already followed: new ones keep their distance from them and
            each counts against the budget of its grid cell.

    Returns:
        The new features; none for an image without texture.

    Raises:
        ValueError: `image` is not a uint8 image, or `existing` is not `[n, 2]`.

    References:
        Shi & Tomasi, Good Features to Track, CVPR 1994. Rosten & Drummond, ECCV 2006 (FAST).

    Example:
        >>> detect(np.zeros((100, 200), np.uint8)).pixels.shape
        (0, 2)
    """
    gray = to_gray(image)
    taken = check_pixels(np.empty((0, 2)) if existing is None else existing, "existing")
    taken = taken[inside(taken, gray.shape)]
    response = _response(gray, options)
    candidates = _local_maxima(response, taken, options)
    chosen = _spread(candidates, response, taken, options)
    rows, cols = np.divmod(chosen, gray.shape[1])
    pixels = np.stack([cols, rows], axis=-1).astype(np.float32)
    quality = response.ravel()[chosen]
    if options.subpixel and len(pixels):
        pixels = _subpixel(gray, pixels, options.block_px)
    return Keypoints(pixels, quality)


def _response(gray: np.ndarray, options: DetectorOptions) -> np.ndarray:
    if options.detector == "gftt":
        eigenvalue = cv2.cornerMinEigenVal(gray, options.block_px, ksize=3)
        # OpenCV scales the Sobel sums by 1/(255·4·block) for 8-bit images, then sums block² products. Undone here: the
        # root mean square gradient (Sobel/8) in grey levels per pixel.
        return np.sqrt(np.maximum(eigenvalue, 0.0)) * np.float32(255.0 / 2.0)
    response = np.zeros(gray.shape, np.float32)
    fast = cv2.FastFeatureDetector.create(threshold=max(1, round(options.min_quality)), nonmaxSuppression=True)
    for keypoint in fast.detect(gray, None):
        response[round(keypoint.pt[1]), round(keypoint.pt[0])] = keypoint.response
    return response


def _local_maxima(response: np.ndarray, taken: np.ndarray, options: DetectorOptions) -> np.ndarray:
    """Flat indices of the admissible peaks, strongest first."""
    height, width = response.shape
    distance, border = options.min_distance_px, options.border_px
    neighbourhood = np.ones((2 * distance - 1, 2 * distance - 1), np.uint8)
    peak = (response >= cv2.dilate(response, neighbourhood)) & (response >= max(options.min_quality, 1e-6))
    allowed = np.zeros((height, width), bool)
    allowed[border : max(height - border, border), border : max(width - border, border)] = True
    if len(taken):
        occupied = np.zeros((height, width), np.uint8)
        cols, rows = np.rint(taken).astype(np.intp).T
        occupied[rows, cols] = 1
        allowed &= cv2.dilate(occupied, neighbourhood) == 0
    flat = np.flatnonzero(peak & allowed)
    flat = flat[np.argsort(-response.ravel()[flat], kind="stable")]
    # Equal responses next to each other are all peaks; the first in order suppresses the others.
    standing = np.zeros((height, width), np.float32)
    standing.ravel()[flat] = len(flat) - np.arange(len(flat), dtype=np.float32)
    return flat[(standing == cv2.dilate(standing, neighbourhood)).ravel()[flat]]


def _spread(candidates: np.ndarray, response: np.ndarray, taken: np.ndarray, options: DetectorOptions) -> np.ndarray:
    """The best candidates of each cell within its share, then the best of the rest up to the total."""
    height, width = response.shape
    columns = -(-width // options.cell_px)
    cells = columns * -(-height // options.cell_px)
    share = max(1, options.max_features // cells)
    rows, cols = np.divmod(candidates, width)
    cell = (rows // options.cell_px) * columns + cols // options.cell_px
    taken_cell = (np.rint(taken[:, 1]) // options.cell_px) * columns + np.rint(taken[:, 0]) // options.cell_px
    used = np.bincount(taken_cell.astype(np.intp), minlength=cells)
    # Rank of each candidate within its cell: candidates are sorted by strength and the sort by cell is stable.
    order = np.argsort(cell, kind="stable")
    counts = np.bincount(cell, minlength=cells)
    rank = np.empty(len(candidates), np.intp)
    rank[order] = np.arange(len(candidates)) - np.repeat(np.cumsum(counts) - counts, counts)
    within = used[cell] + rank < share
    room = max(0, options.max_features - len(taken))
    chosen = np.concatenate([candidates[within], candidates[~within]])[:room]
    return chosen[np.argsort(-response.ravel()[chosen], kind="stable")]


def _subpixel(gray: np.ndarray, pixels: np.ndarray, block_px: int) -> np.ndarray:
    """Corners where gradients point away from a common centre; those that run off stay where they were."""
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.01)
    refined = cv2.cornerSubPix(gray, pixels.reshape(-1, 1, 2).copy(), (3, 3), (-1, -1), criteria).reshape(-1, 2)
    # The response of a perfect corner is a plateau: its peak is up to half a block away.
    kept = np.all(np.abs(refined - pixels) <= (block_px + 1) / 2, axis=1, keepdims=True)
    return np.where(kept, refined, pixels).astype(np.float32)
