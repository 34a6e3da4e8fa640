"""The features of a sequence: followed from image to image, and topped up where they were lost."""

from typing import NamedTuple

import numpy as np

from vojax.features import (
    Described,
    DescriptorOptions,
    DetectorOptions,
    TrackerOptions,
    describe,
    detect,
    match_descriptors,
    track,
)


class Features(NamedTuple):
    """Features of an image: first those followed from the image before, then new ones.

    Attributes:
        image: Grey, uint8; None for features that were followed elsewhere.
        ids: A number for each feature, the same in all images.
        pixels: `[n, 2]`.
        quality: Of the tracks, higher is better; 0 for new ones.
        rows: Which row of the image before each followed feature was, `[m]` with m ≤ n.
        missed: Features of the image before that were not found again.
        descriptors: Of features that are matched, `[n, d]`.
    """

    image: np.ndarray | None
    ids: np.ndarray
    pixels: np.ndarray
    quality: np.ndarray
    rows: np.ndarray
    missed: int
    descriptors: np.ndarray | None = None


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
            if previous.image is None:
                raise ValueError("an image after tracks: a sequence has one or the other")
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


class FeatureMatches:
    """Finds features in every image by themselves, and those of the image before by their descriptors."""

    def __init__(self, options: DescriptorOptions):
        self._options = options
        self._next_id = 0

    def step(self, image: np.ndarray, previous: Features | None, predicted: np.ndarray | None = None) -> Features:
        """Features of the next image; see `FeatureTracks.step`."""
        found = describe(image, self._options)
        rows, again = np.zeros(0, np.intp), np.zeros(0, np.intp)
        ids, quality = np.zeros(0, np.intp), np.zeros(0, np.float32)
        if previous is not None:
            if previous.descriptors is None:
                raise ValueError("an image after tracks: a sequence has one or the other")
            before = Described(previous.pixels, previous.descriptors)
            rows, again, quality = match_descriptors(before, found, self._options, predicted)
            ids = previous.ids[rows]
        fresh = np.setdiff1d(np.arange(len(found.pixels)), again)
        new_ids = self._next_id + np.arange(len(fresh))
        self._next_id += len(fresh)
        order = np.concatenate([again, fresh])
        return Features(
            image,
            np.concatenate([ids, new_ids]),
            found.pixels[order],
            np.concatenate([quality, np.zeros(len(fresh), np.float32)]),
            rows,
            0 if previous is None else len(previous.ids) - len(rows),
            found.descriptors[order],
        )


def front_end(detector: DetectorOptions | DescriptorOptions, tracker: TrackerOptions) -> FeatureTracks | FeatureMatches:
    """Tracking of corners, or matching of descriptors."""
    if isinstance(detector, DescriptorOptions):
        return FeatureMatches(detector)
    return FeatureTracks(detector, tracker)


def given_features(ids: np.ndarray, pixels: np.ndarray, previous: Features | None) -> tuple[Features, np.ndarray]:
    """Features that were followed elsewhere.

    Args:
        ids: A whole number for each, the same in all images `[n]`.
        pixels: Where they are `[n, 2]`.
        previous: Of the image before; None at the start.

    Returns:
        The features, and where in the input each of them was.

    Raises:
        ValueError: The arrays do not fit together, a feature stands there twice, or a position is not finite.
    """
    ids, pixels = np.asarray(ids), np.asarray(pixels, np.float32)
    if ids.ndim != 1 or pixels.shape != (len(ids), 2):
        raise ValueError(f"ids have shape {ids.shape} and pixels {pixels.shape}: expected [n] and [n, 2]")
    if len(ids) and not np.issubdtype(ids.dtype, np.integer):
        raise ValueError(f"ids are of {ids.dtype}: expected whole numbers")
    ids = ids.astype(np.int64)
    if len(np.unique(ids)) < len(ids):
        values, counts = np.unique(ids, return_counts=True)
        raise ValueError(f"feature {values[counts.argmax()]} stands {counts.max()} times in a frame: expected once")
    if not np.isfinite(pixels).all():
        row = int(np.flatnonzero(~np.isfinite(pixels).all(axis=1))[0])
        raise ValueError(f"feature {ids[row]} is at ({pixels[row, 0]}, {pixels[row, 1]}): expected finite pixels")
    if previous is not None and previous.image is not None:
        raise ValueError("tracks after an image: a sequence has one or the other")
    rows, followed = shared(previous.ids, ids) if previous is not None else (np.zeros(0, np.intp),) * 2
    order = np.concatenate([followed, np.setdiff1d(np.arange(len(ids)), followed)])
    quality = (np.arange(len(ids)) < len(followed)).astype(np.float32)
    missed = 0 if previous is None else len(previous.ids) - len(rows)
    return Features(None, ids[order], pixels[order], quality, rows, missed), order


def room_for(count: int, size: int) -> int:
    """Rows of arrays for so many features, `size` where that is enough: few numbers, as each is a compilation."""
    return size if count <= size else 1 << (count - 1).bit_length()


def shared(ids0: np.ndarray, ids1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the features that two images share."""
    _, rows0, rows1 = np.intersect1d(ids0, ids1, assume_unique=True, return_indices=True)
    return rows0, rows1


def padded(array: np.ndarray, size: int) -> np.ndarray:
    """The array with rows of zeros up to a fixed number, so that one compilation serves all frames."""
    return np.pad(array, [(0, size - len(array))] + [(0, 0)] * (array.ndim - 1))
