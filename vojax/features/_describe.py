"""Features with descriptors, and which of two images are the same."""

import dataclasses
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Shaped

from ._image import check_pixels, to_gray

KINDS = ("sift", "orb", "akaze", "kaze", "brisk")
"""What OpenCV may offer; which of them a build has differs from version to version."""


@dataclasses.dataclass(frozen=True)
class DescriptorOptions:
    """How features are described and matched.

    Attributes:
        kind: "sift", "orb", or another of `KINDS` where the installed OpenCV has it.
        max_features: Upper bound, the strongest first.
        max_ratio: Largest distance to the best match, relative to that to the second best.
        radius_px: Matches farther from where they are predicted are left out.
    """

    kind: str = "sift"
    max_features: int = 1000
    max_ratio: float = 0.8
    radius_px: float = 60.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind is {self.kind!r}: expected one of {', '.join(KINDS)}")
        if self.max_features < 1:
            raise ValueError(f"max_features is {self.max_features}: expected at least 1")
        if not 0 < self.max_ratio <= 1:
            raise ValueError(f"max_ratio is {self.max_ratio}: expected more than 0 and at most 1")
        if not self.radius_px > 0:
            raise ValueError(f"radius_px is {self.radius_px}: expected a positive number")


class Described(NamedTuple):
    """Features of an image, strongest first.

    Attributes:
        pixels: Positions (u, v).
        descriptors: One row for each: float32, or uint8 whose bits count.
    """

    pixels: Float32[np.ndarray, "n 2"]
    descriptors: Shaped[np.ndarray, "n d"]


class Matches(NamedTuple):
    """Pairs of features, each feature once, in the order of `rows0`.

    Attributes:
        rows0: Of the first image.
        rows1: Of the second.
        quality: 1 − (distance to the best) / (distance to the second best), higher is better.
    """

    rows0: np.ndarray
    rows1: np.ndarray
    quality: Float32[np.ndarray, "m"]


def describe(image: np.ndarray, options: DescriptorOptions = DescriptorOptions()) -> Described:
    """Find and describe features.

    Args:
        image: uint8 image, grey or RGB.
        options: Which, and how many.

    Returns:
        The features; none for an image without texture.

    Raises:
        ValueError: `image` is not a uint8 image, or the installed OpenCV does not have this kind.

    References:
        Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004. Rublee et al., ORB, ICCV 2011.

    Example:
        >>> describe(np.zeros((100, 200), np.uint8)).pixels.shape
        (0, 2)
    """
    gray = to_gray(image)
    detector = _detector(options)
    keypoints, descriptors = detector.detectAndCompute(gray, None)
    if descriptors is None or not keypoints:
        return Described(np.zeros((0, 2), np.float32), np.zeros((0, 1), np.float32))
    strength = np.array([keypoint.response for keypoint in keypoints])
    # A place with two directions is described twice; once is enough, and a second one would spoil the ratio.
    places = np.array([keypoint.pt for keypoint in keypoints], np.float32)
    order = np.argsort(-strength, kind="stable")
    _, first = np.unique(places[order], axis=0, return_index=True)
    kept = order[np.sort(first)][: options.max_features]
    return Described(places[kept], descriptors[kept])


def match_descriptors(
    first: Described,
    second: Described,
    options: DescriptorOptions = DescriptorOptions(),
    predicted: np.ndarray | None = None,
) -> Matches:
    """Pair features that are each other's nearest, and clearly so.

    Args:
        first: Of one image.
        second: Of the other.
        options: When a match is clear.
        predicted: Where the first image's features are expected in the second `[n, 2]`.

    Returns:
        The matches.

    Raises:
        ValueError: `predicted` does not have a row for each feature of the first image.
    """
    none = Matches(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0, np.float32))
    if predicted is not None and np.shape(predicted) != first.pixels.shape:
        raise ValueError(
            f"predicted has shape {np.shape(predicted)} and there are {len(first.pixels)} features: "
            "expected one row per feature"
        )
    if len(first.pixels) == 0 or len(second.pixels) < 2:
        return none
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING if first.descriptors.dtype == np.uint8 else cv2.NORM_L2)
    forward = matcher.knnMatch(first.descriptors, second.descriptors, k=2)
    best = np.array([pair[0].trainIdx for pair in forward])
    distance, runner_up = np.array([[match.distance for match in pair] for pair in forward], np.float32).T
    # Equal descriptors (distance 0 twice) tell nothing.
    ratio = np.where(runner_up > 0, distance / np.where(runner_up > 0, runner_up, 1.0), 1.0).astype(np.float32)
    back = np.array([pair[0].trainIdx for pair in matcher.knnMatch(second.descriptors, first.descriptors, k=1)])
    good = (back[best] == np.arange(len(best))) & (ratio < options.max_ratio)
    if predicted is not None:
        away = np.linalg.norm(second.pixels[best] - check_pixels(predicted, "predicted"), axis=1)
        good &= away <= options.radius_px
    rows = np.flatnonzero(good)
    return Matches(rows, best[rows], 1.0 - ratio[rows])


def _detector(options: DescriptorOptions) -> Any:
    create = getattr(cv2, f"{options.kind.upper()}_create", None)
    if create is None:
        there = ", ".join(kind for kind in KINDS if hasattr(cv2, f"{kind.upper()}_create"))
        raise ValueError(f"OpenCV {cv2.__version__} has no {options.kind.upper()}: it has {there}")
    return create(nfeatures=options.max_features) if options.kind in ("sift", "orb") else create()
