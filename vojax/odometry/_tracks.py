"""The features of a sequence: followed from image to image, and topped up where they were lost."""

from typing import NamedTuple

import numpy as np

from vojax.features import DetectorOptions, TrackerOptions, detect, track


class Features(NamedTuple):
    """Features of an image: first those followed from the image before, then new ones.

    Attributes:
        image: Grey, uint8.
        ids: A number for each feature, the same in all images.
        pixels: `[n, 2]`.
        quality: Of the tracks, higher is better; 0 for new ones.
        rows: Which row of the image before each followed feature was, `[m]` with m ≤ n.
        missed: Features of the image before that were not found again.
    """

    image: np.ndarray
    ids: np.ndarray
    pixels: np.ndarray
    quality: np.ndarray
    rows: np.ndarray
    missed: int


class FeatureTracks:
    """Follows features by Lucas–Kanade, and detects new ones where there is room."""

    def __init__(self, detector: DetectorOptions, tracker: TrackerOptions):
        self._detector = detector
        self._tracker = tracker
        self._next_id = 0

    def step(self, image: np.ndarray, previous: Features | None, predicted: np.ndarray | None = None) -> Features:
        """Features of the next image.

        Args:
            image: Grey, uint8.
            previous: Of the image before; None starts with detection alone.
            predicted: Where they are expected now `[n, 2]`.
        """
        rows = np.zeros(0, np.intp)
        ids, pixels, quality = np.zeros(0, np.intp), np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
        if previous is not None:
            tracks = track(previous.image, image, previous.pixels, self._tracker, guess=predicted)
            rows = np.flatnonzero(tracks.valid)
            ids, pixels, quality = previous.ids[rows], tracks.pixels[rows], tracks.quality[rows]
        fresh = detect(image, self._detector, existing=pixels).pixels
        fresh = fresh[: max(0, self._detector.max_features - len(pixels))]
        new_ids = self._next_id + np.arange(len(fresh))
        self._next_id += len(fresh)
        return Features(
            image,
            np.concatenate([ids, new_ids]),
            np.concatenate([pixels, fresh]),
            np.concatenate([quality, np.zeros(len(fresh), np.float32)]),
            rows,
            0 if previous is None else len(previous.ids) - len(rows),
        )


def shared(ids0: np.ndarray, ids1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the features that two images share."""
    _, rows0, rows1 = np.intersect1d(ids0, ids1, assume_unique=True, return_indices=True)
    return rows0, rows1


def padded(array: np.ndarray, size: int) -> np.ndarray:
    """The array with rows of zeros up to a fixed number, so that one compilation serves all frames."""
    return np.pad(array, [(0, size - len(array))] + [(0, 0)] * (array.ndim - 1))
