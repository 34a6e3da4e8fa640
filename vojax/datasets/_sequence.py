"""What every recorded sequence offers."""

from typing import Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class FrameSequence(Protocol):
    """Frames of one camera or of a stereo pair, such as `KittiSequence`; images are read when asked for."""

    @property
    def name(self) -> str:
        """What to call it in a report."""
        ...

    @property
    def times(self) -> np.ndarray:
        """Seconds, one per frame, increasing."""
        ...

    @property
    def poses(self) -> np.ndarray | None:
        """`world_from_cam` of the first camera as `[n, 3, 4]`, metres; None without a truth.

        A frame whose true pose is not known has NaN in all twelve places.
        """
        ...

    @property
    def frame_names(self) -> list[str]:
        """A name for each frame, in order."""
        ...

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def images(self, k: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Frame `k` (negative ones count from the end): left image, and the right one or None.

        A damaged image is a ValueError, a frame that does not exist an IndexError; the other frames stay readable.
        """
        ...


@runtime_checkable
class DepthSequence(FrameSequence, Protocol):
    """Frames with a depth image each, such as `TumSequence`."""

    def depth(self, k: int) -> np.ndarray:
        """Depth (camera z, metres) of frame `k`, float32; 0 where there is none.

        Not NaN: a comparison or a product with 0 stays finite, and `depth > 0` is the mask.
        """
        ...
