"""Stereo odometry, frame by frame.

Scaramuzza & Fraundorfer 2011, algorithms "VO from 3-D-to-2-D correspondences" and "VO from 3-D-to-3-D correspondences",
with stereo instead of two views: track features from k−1 to k, triangulate them from the stereo pair at k−1 (and, for
the second, at k), solve the pose at k, chain C_k = C_{k−1} T_k, and adjust the last keyframes together.
"""

import dataclasses

import numpy as np

from vojax.cameras import RectifiedStereo
from vojax.features import (
    DescriptorOptions,
    DetectorOptions,
    StereoOptions,
    TrackerOptions,
    match_stereo_rows,
    to_gray,
)

from ._disparity_odometry import DisparityOdometry, Measured, given_measurements
from ._frame import FrameEstimate
from ._image_checks import ImageChecks
from ._keyframes import KeyframeOptions
from ._motion import MotionOptions, RigidMotionOptions
from ._pair_rectifier import PairRectifier
from ._sliding_window import WindowOptions


@dataclasses.dataclass(frozen=True)
class StereoOdometryOptions:
    """Stages of the pipeline.

    Attributes:
        window: Adjust the last keyframes together; False chains the motions as they are. Tracks drift by a random
            walk, which the chain weighs rightly and the window, whose keyframes are fewer, does not: see the
            documentation for what it was measured to gain and to lose.
        min_inliers: With fewer, a frame counts as not tracked and the last motion bridges it.
        detector: Corners that are tracked, or (`DescriptorOptions`) features that are matched.
        tracker: From frame to frame; not read where features are matched.
        matcher: From left to right.
        motion: Pose of the new frame: from points to pixels (`MotionOptions`, 3-D-to-2-D) or from points to points
            (`RigidMotionOptions`, 3-D-to-3-D).
        checks: When a frame is flagged.
        keyframes: Which frames enter the window.
        sliding_window: The window.
    """

    window: bool = False
    min_inliers: int = 12
    detector: DetectorOptions | DescriptorOptions = DetectorOptions(max_features=600)
    tracker: TrackerOptions = TrackerOptions()
    matcher: StereoOptions = StereoOptions()
    motion: MotionOptions | RigidMotionOptions = MotionOptions()
    checks: ImageChecks = ImageChecks()
    keyframes: KeyframeOptions = KeyframeOptions()
    sliding_window: WindowOptions = WindowOptions()


class StereoOdometry:
    """Estimates the path of a stereo camera from its images.

    Args:
        stereo: The rig: a rectified pair, or the `PairRectifier` of any other.
        options: Stages and their settings.
        seed: Of the random sampling; the same seed and images give the same path.

    Example:
        >>> from vojax.cameras import Pinhole
        >>> odometry = StereoOdometry(RectifiedStereo(Pinhole(fx=400.0, fy=400.0, cx=319.5, cy=119.5), baseline=0.5))
        >>> blank = np.zeros((240, 640), np.uint8)
        >>> odometry.step(blank, blank).world_from_cam.tolist() == np.eye(4).tolist()
        True
    """

    def __init__(
        self,
        stereo: RectifiedStereo | PairRectifier,
        options: StereoOdometryOptions = StereoOdometryOptions(),
        *,
        seed: int = 0,
    ):
        self._options = options
        self._rectifier = stereo if isinstance(stereo, PairRectifier) else None
        rectified = stereo.stereo if isinstance(stereo, PairRectifier) else stereo
        self._odometry = DisparityOdometry(rectified, options, seed=seed)

    @property
    def disparity_offsets_px(self) -> np.ndarray:
        """The disparity error (a₀, a₁) estimated so far; see `DisparityCalibration`."""
        return np.asarray(self._odometry.calibration.estimate())

    @property
    def right_late(self) -> tuple[float, float]:
        """How much later than the left images the right ones were taken, and its standard deviation.

        In frame intervals, from all frames so far; (0, 1) where nothing is known, as of a camera at rest or of features
        given to `step_tracks`. Beyond `ImageChecks.max_late` frames are flagged `unsynchronised`.
        """
        return self._odometry.synchrony.late()

    def step(self, left: np.ndarray, right: np.ndarray) -> FrameEstimate:
        """Take the next stereo pair.

        Args:
            left: uint8 image of the left camera; rectified, unless the odometry was made with a `PairRectifier`.
            right: Of the right one, of the same size.

        Returns:
            The new pose of the left camera and what it rests on.

        Raises:
            ValueError: If the images do not fit together or to those before.
        """
        rectify = self._rectifier
        left, right = (to_gray(left), to_gray(right)) if rectify is None else rectify(left, right)

        def measure(pixels: np.ndarray) -> Measured:
            return Measured(pixels, match_stereo_rows(left, right, pixels, self._options.matcher))

        return self._as_taken(self._odometry.step(left, measure))

    def step_tracks(
        self, ids: np.ndarray, measurements: np.ndarray, sigma_disparity_px: float | np.ndarray = 0.25
    ) -> FrameEstimate:
        """Take the next pair by its features, followed by a front end of your own.

        Args:
            ids: A whole number for each feature `[n]`, the same in all frames.
            measurements: `(u_left, v, u_right)` of the rectified pair `[n, 3]`; u_right not finite where the right
                image has no match.
            sigma_disparity_px: Standard deviation of u_left − u_right, one or `[n]`.

        Returns:
            The new pose of the rectified left camera and what it rests on.

        Raises:
            ValueError: If the arrays do not fit together, a feature stands there twice, or images came before.
        """
        return self._odometry.step_tracks(ids, given_measurements(measurements, sigma_disparity_px))

    def skip(self) -> FrameEstimate:
        """Bridge a pair that cannot be read: the last motion is repeated.

        The next pair is tracked from the last one that could be read, so that its pose rests on no guess.

        Returns:
            The pose guessed, flagged `unreadable`.
        """
        return self._as_taken(self._odometry.skip())

    def _as_taken(self, estimate: FrameEstimate) -> FrameEstimate:
        """Pose and pixels of the left camera, where they are those of the rectified one."""
        rectifier = self._rectifier
        if rectifier is None:
            return estimate
        return dataclasses.replace(
            estimate,
            world_from_cam=rectifier.pose_of_left(estimate.world_from_cam),
            pixels=rectifier.pixels_of_left(estimate.pixels),
            previous_pixels=rectifier.pixels_of_left(estimate.previous_pixels),
        )
