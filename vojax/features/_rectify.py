"""Images resampled by a map, as rectification needs it."""

import cv2
import numpy as np

from ._image import to_gray


def remap(image: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Look up every pixel of a new image in an old one, linearly between its pixels.

    Args:
        image: uint8 image, grey or RGB.
        source: Pixel (u, v) of `image` for each new pixel, `[h, w, 2]`; `vojax.cameras.rectification_maps` gives it.

    Returns:
        The new image, grey. Outside of the old one its edge is repeated: a black frame would be full of corners.

    Raises:
        ValueError: `image` is not a uint8 image, or `source` not `[h, w, 2]`.

    Example:
        >>> shifted = np.stack(np.meshgrid(np.arange(3) + 0.5, np.arange(1)), axis=-1)
        >>> remap(np.array([[0, 10, 20, 30]], np.uint8), shifted).tolist()
        [[5, 15, 25]]
    """
    source = np.ascontiguousarray(source, np.float32)
    if source.ndim != 3 or source.shape[2] != 2:
        raise ValueError(f"source has shape {source.shape}: expected [h, w, 2], a pixel for each new pixel")
    u, v = source[..., 0], source[..., 1]
    return cv2.remap(to_gray(image), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
