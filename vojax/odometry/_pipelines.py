"""The pipelines by name, and what each takes."""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from ._mono import MonoOdometry, MonoOdometryOptions
from ._motion import RigidMotionOptions
from ._rgbd import RgbdOdometry, RgbdOdometryOptions
from ._stereo import StereoOdometry, StereoOdometryOptions


class Pipeline(NamedTuple):
    """A way to estimate a path.

    An odometry has `step(*images) -> FrameEstimate` for the next frame and `skip() -> FrameEstimate` for one that
    cannot be read.

    Attributes:
        odometry: Its class, called with the camera (`RectifiedStereo` for a pair), the options and `seed=`.
        options: The class of its options; `window=False` chains the motions as they are.
        images: What a step takes: one image; the left and the right one of a rectified pair; an image and its depth
            (metres, 0 where there is none).
        scale: False where the path has an arbitrary scale.
    """

    odometry: Callable[..., Any]
    options: Callable[..., Any]
    images: Literal["one", "pair", "depth"]
    scale: bool = True


def _mono(motion: Literal["absolute", "relative", "planar"]) -> Pipeline:
    return Pipeline(MonoOdometry, functools.partial(MonoOdometryOptions, motion=motion), "one", scale=False)


PIPELINES: dict[str, Pipeline] = {
    "mono-2d2d": _mono("relative"),
    "mono-3d2d": _mono("absolute"),
    "planar-1pt": _mono("planar"),
    "stereo-3d2d": Pipeline(StereoOdometry, StereoOdometryOptions, "pair"),
    "stereo-3d3d": Pipeline(
        StereoOdometry, functools.partial(StereoOdometryOptions, motion=RigidMotionOptions()), "pair"
    ),
    "rgbd-3d2d": Pipeline(RgbdOdometry, RgbdOdometryOptions, "depth"),
}
