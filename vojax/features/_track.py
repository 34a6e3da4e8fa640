"""Features from one image to the next by pyramidal Lucas–Kanade."""

import dataclasses
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from ._image import check_pixels, gray_pair, inside


@dataclasses.dataclass(frozen=True)
class TrackerOptions:
    """How features are followed.

    Attributes:
        window_px: Side of the square window.
        levels: Pyramid levels above the full resolution.
        max_iterations: Iterations per level.
        epsilon_px: Step below which a level is finished.
        forward_backward_px: Largest distance between a feature and its track back into the first image.
        max_residual: Largest mean absolute grey-level difference between the windows.
        min_eigenvalue: Smallest eigenvalue of the window's structure tensor that counts as textured (OpenCV's scale).
        border_px: Width of the margin that tracks may not enter.
    """

    window_px: int = 15
    levels: int = 3
    max_iterations: int = 10
    epsilon_px: float = 0.03
    forward_backward_px: float = 0.5
    max_residual: float = 20.0
    min_eigenvalue: float = 1e-4
    border_px: int = 4

    def __post_init__(self) -> None:
        if self.window_px < 3 or self.levels < 0 or self.max_iterations < 1:
            raise ValueError(
                f"window_px, levels, max_iterations are {self.window_px}, {self.levels}, {self.max_iterations}: "
                "expected at least 3, 0 and 1"
            )


class Tracks(NamedTuple):
    """Where features went; row i belongs to row i of the input.

    Attributes:
        pixels: Positions (u, v) in the current image; the last known position where not valid.
        quality: In (0, 1], higher is better: 1 / (1 + mean absolute grey-level difference); 0 where not valid.
        valid: False for features that were lost.
    """

    pixels: Float32[np.ndarray, "n 2"]
    quality: Float32[np.ndarray, "n"]
    valid: Bool[np.ndarray, "n"]


def track(
    previous: np.ndarray,
    current: np.ndarray,
    pixels: np.ndarray,
    options: TrackerOptions = TrackerOptions(),
    guess: np.ndarray | None = None,
) -> Tracks:
    """Follow features from the previous image into the current one.

    Each feature is tracked forward and back again; it is kept when it returns to where it began.

    Args:
        previous: uint8 image, grey or RGB.
        current: Image of the same size.
        pixels: Positions `[n, 2]` in the previous image.
        options: Window, pyramid and checks.
        guess: Predicted positions `[n, 2]` in the current image, for instance from a motion model.

    Returns:
        Positions in the current image with quality and validity, in the order of `pixels`.

    Raises:
        ValueError: Images of different size or type, or `pixels` and `guess` that are not both `[n, 2]`.

    References:
        Bouguet, Pyramidal implementation of the Lucas–Kanade feature tracker, 2000. Kalal et al., Forward-backward
        error, ICPR 2010.
    """
    gray0, gray1 = gray_pair(previous, current, ("previous", "current"))
    start = check_pixels(pixels)
    n = len(start)
    if guess is not None and np.shape(guess) != np.shape(pixels):
        raise ValueError(
            f"guess has shape {np.shape(guess)} and pixels {np.shape(pixels)}: expected one row per feature"
        )
    usable = inside(start, gray0.shape)
    end, quality, valid = np.where(usable[:, None], start, np.float32(0)), np.zeros(n, np.float32), np.zeros(n, bool)
    if not usable.any():
        return Tracks(end, quality, valid)
    size = (options.window_px, options.window_px)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, options.max_iterations, options.epsilon_px)
    settings = {"winSize": size, "maxLevel": options.levels, "criteria": criteria}
    settings["minEigThreshold"] = options.min_eigenvalue
    first = start[usable]
    aim = first if guess is None else check_pixels(guess, "guess")[usable]
    aim = np.where(inside(aim, gray1.shape)[:, None], aim, first)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    forward, found, residual = cv2.calcOpticalFlowPyrLK(gray0, gray1, first, aim.copy(), flags=flags, **settings)
    ok = (found.ravel() == 1) & inside(forward, gray1.shape, options.border_px)
    ok &= residual.ravel() <= options.max_residual
    if ok.any():
        # Starting the way back at the original position makes it cheap; a wrong forward track still ends elsewhere.
        back, found, _ = cv2.calcOpticalFlowPyrLK(gray1, gray0, forward[ok], first[ok].copy(), flags=flags, **settings)
        distance = np.linalg.norm(back - first[ok], axis=1)
        ok[ok] = (found.ravel() == 1) & (distance <= options.forward_backward_px)
    index = np.flatnonzero(usable)[ok]
    end[index] = forward[ok]
    quality[index] = 1.0 / (1.0 + residual.ravel()[ok])
    valid[index] = True
    return Tracks(end, quality, valid)
