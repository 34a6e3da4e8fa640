"""Which frames become keyframes.

Scaramuzza & Fraundorfer 2011: a frame is one when the distance to the last keyframe is 10 to 20 % of the average depth
of the points; nearer than that, triangulated points are too uncertain.
"""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class KeyframeOptions:
    """When a frame becomes a keyframe.

    Attributes:
        distance_over_depth: Least distance to the last keyframe over the mean depth of the tracked points.
        min_shared: Fewest landmarks of the last keyframe still in view: with fewer, the frame is one.
    """

    distance_over_depth: float = 0.1
    min_shared: int = 60


def is_keyframe(distance: float, depths: np.ndarray, shared: int, options: KeyframeOptions = KeyframeOptions()) -> bool:
    """Decide before the motion is accepted into the window.

    Args:
        distance: From the last keyframe, metres.
        depths: Of the points now tracked, metres.
        shared: Landmarks of the last keyframe that are still tracked.
        options: Thresholds.
    """
    if shared < options.min_shared:
        return True
    return len(depths) > 0 and distance > options.distance_over_depth * float(np.mean(depths))
