"""What a pipeline says of a frame."""

import dataclasses
import enum

import numpy as np


class Flag(enum.StrEnum):
    """What `FrameEstimate.flags` may say: one of the assumptions of visual odometry does not hold, or a new start."""

    texture = "hardly any texture"
    dark = "under-exposed"
    bright = "over-exposed"
    overlap = "too little overlap with the frame before"
    static = "the camera stands still"
    consensus = "the tracks agree on no motion"
    unsynchronised = "left and right were not taken at the same time"
    unreadable = "the frame could not be read"
    restarted = "started anew: the scale is that of the motion before, to its uncertainty"


@dataclasses.dataclass(frozen=True)
class FrameEstimate:
    """What is known after a frame.

    Attributes:
        world_from_cam: Pose `[4, 4]`, float64; the first frame is the world.
        num_inliers: Features that agree with the motion; 0 for the first frame and for a bridged one.
        bridged: True where the frame could not be tracked and the motion before it was repeated.
        keyframe: True where the frame entered the window.
        pixels: The inliers, in this image `[n, 2]`.
        previous_pixels: The same in the image before.
        disparity: The same, px; 0 where not matched; None without a right image or a depth.
        flags: What the frame lacks or what happened; empty for an ordinary frame.
        pending: True while a monocular pipeline waits for parallax: the pose is a placeholder.
        earlier: Poses `[m, 4, 4]` of the `m` pending frames directly before this one, now that they are known.
    """

    world_from_cam: np.ndarray
    num_inliers: int = 0
    bridged: bool = False
    keyframe: bool = False
    pixels: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 2), np.float32))
    previous_pixels: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 2), np.float32))
    disparity: np.ndarray | None = None
    flags: tuple[Flag, ...] = ()
    pending: bool = False
    earlier: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4, 4)))
