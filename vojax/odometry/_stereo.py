"""Stereo 3-D-to-2-D odometry, frame by frame.

Scaramuzza & Fraundorfer 2011, algorithm "VO from 3-D-to-2-D correspondences", with stereo instead of two views: track
features from k−1 to k, triangulate them at k−1 from the stereo pair, solve the pose at k, chain C_k = C_{k−1} T_k, and
adjust the last keyframes together.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vojax.cameras import RectifiedStereo
from vojax.features import (
    DetectorOptions,
    StereoMatches,
    StereoOptions,
    TrackerOptions,
    detect,
    match_stereo_rows,
    to_gray,
    track,
)
from vojax.lie import SE3

from ._frame import FrameEstimate
from ._keyframes import KeyframeOptions, is_keyframe
from ._motion import Motion, MotionOptions, StereoFeatures, stereo_motion
from ._rectification import DisparityCalibration
from ._sliding_window import Keyframe, SlidingWindow, WindowOptions, orthonormal


@dataclasses.dataclass(frozen=True)
class StereoOdometryOptions:
    """Stages of the pipeline.

    Attributes:
        window: Adjust the last keyframes together; False chains the motions as they are.
        min_inliers: With fewer, a frame counts as not tracked and the last motion bridges it.
        detector: Corners.
        tracker: From frame to frame.
        matcher: From left to right.
        motion: Pose of the new frame.
        keyframes: Which frames enter the window.
        sliding_window: The window.
    """

    window: bool = True
    min_inliers: int = 12
    detector: DetectorOptions = DetectorOptions(max_features=600)
    tracker: TrackerOptions = TrackerOptions()
    matcher: StereoOptions = StereoOptions()
    motion: MotionOptions = MotionOptions()
    keyframes: KeyframeOptions = KeyframeOptions()
    sliding_window: WindowOptions = WindowOptions()


class _Frame(NamedTuple):
    """Features of a frame, in the order of its arrays."""

    image: np.ndarray
    ids: np.ndarray
    pixels: np.ndarray
    stereo: StereoMatches
    predicted: np.ndarray  # pixels in the next frame


class StereoOdometry:
    """Estimates the path of a rectified stereo camera from its images.

    Args:
        stereo: The calibrated rig.
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
        self, stereo: RectifiedStereo, options: StereoOdometryOptions = StereoOdometryOptions(), *, seed: int = 0
    ):
        self._stereo = stereo
        self._options = options
        self._key = jax.random.key(seed)
        self._calibration = DisparityCalibration.prior()
        self._window = SlidingWindow(stereo, options.sliding_window)
        self._frame: _Frame | None = None
        self._pose = np.eye(4)
        self._motion = SE3.identity()  # cam1_from_cam0 of the last frame
        self._next_id = 0
        self._count = 0

    @property
    def disparity_offsets_px(self) -> np.ndarray:
        """The disparity error (a₀, a₁) estimated so far; see `DisparityCalibration`."""
        return np.asarray(self._calibration.estimate())

    def step(self, left: np.ndarray, right: np.ndarray) -> FrameEstimate:
        """Take the next stereo pair.

        Args:
            left: uint8 image of the left camera, rectified.
            right: Of the right one, of the same size.

        Returns:
            The new pose and what it rests on.

        Raises:
            ValueError: If the images do not fit together or to those before.
        """
        left, right = to_gray(left), to_gray(right)
        previous = self._frame
        if previous is not None and left.shape != previous.image.shape:
            raise ValueError(
                f"image {self._count} is {left.shape[1]}×{left.shape[0]} px, the one before was "
                f"{previous.image.shape[1]}×{previous.image.shape[0]}: a sequence has one size"
            )
        kept = np.zeros(0, int)
        if previous is not None:
            tracks = track(previous.image, left, previous.pixels, self._options.tracker, guess=previous.predicted)
            kept = np.flatnonzero(tracks.valid)
            carried, ids, quality = tracks.pixels[kept], previous.ids[kept], tracks.quality[kept]
        else:
            carried, ids, quality = np.zeros((0, 2), np.float32), np.zeros(0, int), np.zeros(0, np.float32)
        fresh = detect(left, self._options.detector, existing=carried).pixels
        fresh = fresh[: max(0, self._options.detector.max_features - len(carried))]
        pixels = np.concatenate([carried, fresh])
        ids = np.concatenate([ids, self._next_id + np.arange(len(fresh))])
        self._next_id += len(fresh)
        matches = match_stereo_rows(left, right, pixels, self._options.matcher)
        frame = _Frame(left, ids, pixels, matches, pixels)

        if previous is None:
            estimate = self._finish(frame, np.zeros(0, int), kept, None)
        else:
            motion = self._estimate(previous, frame, kept, quality)
            inliers = np.flatnonzero(np.asarray(motion.inliers)[: len(kept)])
            tracked = len(inliers) >= self._options.min_inliers
            frame = frame._replace(predicted=np.asarray(motion.predicted)[: len(pixels)])
            estimate = self._finish(frame, inliers, kept, motion if tracked else None)
        self._count += 1
        return estimate

    def _estimate(self, previous: _Frame, frame: _Frame, kept: np.ndarray, quality: np.ndarray) -> Motion:
        size = -(-self._options.detector.max_features // 64) * 64
        before = StereoMatches(*(field[kept] for field in previous.stereo))
        return stereo_motion(
            _padded(previous.pixels[kept], before, size),
            _padded(frame.pixels, frame.stereo, size),
            jnp.asarray(np.pad(quality, (0, size - len(quality)))),
            self._motion,
            self._calibration,
            self._stereo,
            jax.random.fold_in(self._key, self._count),
            self._options.motion,
        )

    def _finish(self, frame: _Frame, inliers: np.ndarray, kept: np.ndarray, motion: Motion | None) -> FrameEstimate:
        """Chain the motion, keep the books of the window and report."""
        previous, bridged = self._frame, motion is None and self._frame is not None
        if motion is not None:
            self._motion, self._calibration = motion.cam1_from_cam0, motion.calibration
        step = orthonormal(np.asarray(self._motion.inverse().as_matrix(), np.float64)) if previous else np.eye(4)
        pose = orthonormal(self._pose @ step)
        if bridged:
            self._window.clear()
        keyframe = self._is_keyframe(pose, frame, inliers, motion)
        if keyframe:
            # The first frame and one after a break have no inliers yet: everything they see may become a landmark.
            rows = inliers if motion is not None else np.arange(0)
            rows = np.concatenate([rows, np.arange(len(kept), len(frame.pixels))])
            pose = self._window.add(
                Keyframe(pose, frame.ids[rows], _measurements(frame.pixels, frame.stereo)[rows],
                         np.where(frame.stereo.valid, frame.stereo.sigma, 0.0)[rows]),
                self._calibration.estimate() if self._options.motion.self_calibrate else jnp.zeros(2),
                adjust=self._options.window,
            )  # fmt: skip
        self._pose, self._frame = pose, frame
        return FrameEstimate(
            pose,
            0 if bridged else len(inliers),
            bridged,
            keyframe,
            frame.pixels[inliers],
            previous.pixels[kept[inliers]] if previous else frame.pixels[inliers],
            frame.stereo.disparity[inliers],
        )

    def _is_keyframe(self, pose: np.ndarray, frame: _Frame, inliers: np.ndarray, motion: Motion | None) -> bool:
        newest = self._window.newest
        if newest is None or motion is None:
            return True
        shared = len(np.intersect1d(newest.ids, frame.ids[inliers]))
        distance = float(np.linalg.norm(pose[:3, 3] - newest.world_from_cam[:3, 3]))
        return is_keyframe(distance, np.asarray(motion.depths)[inliers], shared, self._options.keyframes)


def _measurements(pixels: np.ndarray, matches: StereoMatches) -> np.ndarray:
    return np.column_stack([pixels, pixels[:, 0] - matches.disparity]).astype(np.float32)


def _padded(pixels: np.ndarray, matches: StereoMatches, size: int) -> StereoFeatures:
    n = len(pixels)
    measurements = np.zeros((size, 3), np.float32)
    measurements[:n] = _measurements(pixels, matches)
    sigma = np.ones(size, np.float32)
    sigma[:n] = matches.sigma
    position, disparity = np.zeros(size, bool), np.zeros(size, bool)
    position[:n], disparity[:n] = True, matches.valid
    return StereoFeatures(*map(jnp.asarray, (measurements, sigma, position, disparity)))
