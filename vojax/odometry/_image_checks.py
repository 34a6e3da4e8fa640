"""What an image and its tracks lack: light, texture, overlap, motion or agreement, told without the truth.

Scaramuzza & Fraundorfer 2011 name what visual odometry assumes: enough light, texture, overlap between frames and a
scene that mostly stands still. Each check looks at one of them. Plain numpy, for any pipeline.
"""

import dataclasses
import math

import numpy as np

from ._frame import Flag


@dataclasses.dataclass(frozen=True)
class ImageChecks:
    """When an assumption counts as broken.

    Attributes:
        min_features: Fewest features of an image with texture: a motion needs twelve that agree, and as many again may
            be lost or wrong.
        clipped_margin: Grey levels from the end of the scale that count as clipped: 2 % of it, less than the contrast
            of a corner, so that nothing can be detected there.
        max_clipped: Largest share of clipped pixels: beyond one half, most of the image shows nothing.
        min_overlap: Least share of the features that must be found again: a fifth of the features is what a turn by
            four fifths of the field of view leaves.
        min_agreement: Least share of the usable tracks that must agree: below a third, two other motions may each
            explain as many.
        max_late: Largest time between the images of a pair, as a share of the time between frames, beyond which it is
            said once it is sure by five standard deviations. A path drifts by about that share of its length.
        sigma_px: Standard deviation of a tracked position. Of a camera at rest half of the tracks move by less than
            √(2 ln 2) = 1.18 of it, the median of a Rayleigh distribution.
    """

    min_features: int = 24
    clipped_margin: int = 5
    max_clipped: float = 0.5
    min_overlap: float = 0.2
    min_agreement: float = 1.0 / 3.0
    max_late: float = 0.02
    sigma_px: float = 0.25

    def __post_init__(self) -> None:
        for name in ("max_clipped", "min_overlap", "min_agreement", "max_late"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}: expected a share between 0 and 1")
        if not 0 <= self.clipped_margin < 128:
            raise ValueError(f"clipped_margin is {self.clipped_margin}: expected 0 to 127 grey levels")
        if not self.sigma_px > 0:
            raise ValueError(f"sigma_px is {self.sigma_px}: expected a positive number")


def image_flags(gray: np.ndarray, num_features: int, checks: ImageChecks = ImageChecks()) -> tuple[Flag, ...]:
    """Judge an image by itself.

    Args:
        gray: uint8 image, grey.
        num_features: Features it has, followed ones and new ones.
        checks: Thresholds.

    Returns:
        Those of `texture`, `dark` and `bright` that apply.
    """
    found = []
    if num_features < checks.min_features:
        found.append(Flag.texture)
    counts = np.bincount(gray.ravel(), minlength=256)
    if counts[: checks.clipped_margin + 1].sum() > checks.max_clipped * gray.size:
        found.append(Flag.dark)
    if counts[255 - checks.clipped_margin :].sum() > checks.max_clipped * gray.size:
        found.append(Flag.bright)
    return tuple(found)


def track_flags(
    pixels0: np.ndarray, pixels1: np.ndarray, num_before: int, checks: ImageChecks = ImageChecks()
) -> tuple[Flag, ...]:
    """Judge the tracks between two images.

    Args:
        pixels0: `[n, 2]` of the features that were followed, in the image before.
        pixels1: The same in this one.
        num_before: Features that the image before had, followed or lost.
        checks: Thresholds.

    Returns:
        Those of `overlap` and `static` that apply; both only to tracks there are.
    """
    found = []
    if len(pixels0) < checks.min_overlap * num_before:
        found.append(Flag.overlap)
    if is_static(pixels0, pixels1, checks):
        found.append(Flag.static)
    return tuple(found)


def is_static(pixels0: np.ndarray, pixels1: np.ndarray, checks: ImageChecks = ImageChecks()) -> bool:
    """Whether tracks `[n, 2]` move by no more than their noise; False for fewer than `min_features`."""
    if len(pixels0) < checks.min_features:
        return False
    moved = np.median(np.linalg.norm(np.asarray(pixels1, float) - np.asarray(pixels0, float), axis=1))
    return bool(moved < math.sqrt(2.0 * math.log(2.0)) * checks.sigma_px)


def consensus_flags(
    num_inliers: int, num_usable: int, min_inliers: int, checks: ImageChecks = ImageChecks()
) -> tuple[Flag, ...]:
    """Judge the agreement of the tracks with the motion found.

    Args:
        num_inliers: Tracks that agree with it.
        num_usable: Tracks that could have agreed.
        min_inliers: Fewest inliers that tell a motion.
        checks: Thresholds.

    Returns:
        `consensus` where too few agree, in number or in share.
    """
    enough = num_inliers >= min_inliers and num_inliers >= checks.min_agreement * num_usable
    return () if enough else (Flag.consensus,)


def synchrony_flags(late: float, deviation: float, checks: ImageChecks = ImageChecks()) -> tuple[Flag, ...]:
    """Judge the time between the images of a pair.

    Args:
        late: How much later the right one was taken, as a share of the time between frames.
        deviation: Its standard deviation.
        checks: Thresholds.

    Returns:
        `unsynchronised` where it is too long, and surely so.
    """
    return (Flag.unsynchronised,) if abs(late) > max(checks.max_late, 5.0 * deviation) else ()
