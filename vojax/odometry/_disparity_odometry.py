"""What stereo and RGB-D odometry share: everything that follows from pixels with a disparity.

A new frame is compared with a reference, which is the frame before where that could be tracked. A frame that says
nothing (unreadable, dark, without depth) or nothing new (the camera at rest) does not become the reference: the next
one is tracked across it, so that no error of a guess, and no sum of small ones, is inherited.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax.cameras import RectifiedStereo
from vojax.features import DescriptorOptions, DetectorOptions, StereoMatches, TrackerOptions
from vojax.lie import SE3

from ._frame import Flag, FrameEstimate
from ._image_checks import ImageChecks, consensus_flags, image_flags, synchrony_flags, track_flags
from ._keyframes import KeyframeOptions, is_keyframe
from ._motion import Motion, MotionOptions, RigidMotionOptions, StereoFeatures, predicted_pixels, stereo_motion
from ._rectification import DisparityCalibration
from ._rigid_motion import rigid_motion
from ._sliding_window import Keyframe, SlidingWindow, WindowOptions, orthonormal
from ._synchrony import Synchrony
from ._tracks import Features, front_end, given_features, room_for


@runtime_checkable
class Stages(Protocol):
    """Options that the pipelines share; see `StereoOdometryOptions`."""

    @property
    def window(self) -> bool: ...
    @property
    def min_inliers(self) -> int: ...
    @property
    def detector(self) -> DetectorOptions | DescriptorOptions: ...
    @property
    def tracker(self) -> TrackerOptions: ...
    @property
    def motion(self) -> MotionOptions | RigidMotionOptions: ...
    @property
    def checks(self) -> ImageChecks: ...
    @property
    def keyframes(self) -> KeyframeOptions: ...
    @property
    def sliding_window(self) -> WindowOptions: ...


class Measured(NamedTuple):
    """Features of an image in the ideal pair.

    Attributes:
        pixels: `[n, 2]` in the ideal left image.
        matches: Their disparities.
    """

    pixels: np.ndarray
    matches: StereoMatches

    def rows(self, rows: np.ndarray) -> "Measured":
        """Some of the features, in this order."""
        return Measured(self.pixels[rows], StereoMatches(*(field[rows] for field in self.matches)))


def given_measurements(measurements: np.ndarray, sigma_disparity_px: float | np.ndarray) -> Measured:
    """Features measured elsewhere, `(u_left, v, u_right)` [n, 3]; u_right not finite where there is none.

    Raises:
        ValueError: If the array has another shape.
    """
    measurements = np.asarray(measurements, np.float32)
    if measurements.ndim != 2 or measurements.shape[1] != 3:
        raise ValueError(f"measurements have shape {measurements.shape}: expected (u_left, v, u_right) [n, 3]")
    disparity = measurements[:, 0] - measurements[:, 2]
    valid = np.isfinite(disparity) & (disparity > 0)
    sigma = np.broadcast_to(np.asarray(sigma_disparity_px, np.float32), disparity.shape)
    matches = StereoMatches(
        np.where(valid, disparity, np.float32(0)),
        valid.astype(np.float32),
        np.where(valid, sigma, np.float32(1)),
        valid,
        np.full_like(disparity, np.nan),
    )
    return Measured(measurements[:, :2], matches)


class _Frame(NamedTuple):
    features: Features
    measured: Measured
    padded: StereoFeatures
    image_pixels: np.ndarray  # measured.pixels as they are in the image


class DisparityOdometry:
    """Estimates the path of a camera from features with disparities.

    Args:
        stereo: The pair, real or virtual, that the disparities are of.
        options: Stages and their settings.
        seed: Of the random sampling.
        distort: Pixels of the ideal left image `[n, 2]` to those of the image; None where they are the same.
    """

    def __init__(
        self,
        stereo: RectifiedStereo,
        options: Stages,
        *,
        seed: int,
        distort: Callable[[np.ndarray], np.ndarray] | None = None,
    ):
        self._stereo = stereo
        self._options = options
        self._key = jax.random.key(seed)
        self._distort = distort
        self._tracks = front_end(options.detector, options.tracker)
        self._size = -(-options.detector.max_features // 64) * 64
        self._window = SlidingWindow(stereo, options.sliding_window)
        self._reference: _Frame | None = None
        self._pose = np.eye(4)  # of the reference
        self._motion = SE3.identity()  # cam1_from_cam0 of one frame
        self._gap = 1  # frames from the reference to the next
        self._count = 0
        self.synchrony = Synchrony.prior()
        self.calibration = DisparityCalibration.prior()

    def skip(self) -> FrameEstimate:
        """Bridge a frame that cannot be read."""
        estimate = self._bridge((Flag.unreadable,))
        self._count += 1
        return estimate

    def step(self, gray: np.ndarray, measure: Callable[[np.ndarray], Measured]) -> FrameEstimate:
        """Take the next image.

        Args:
            gray: uint8, grey.
            measure: Gives the disparities of pixels of this image.

        Raises:
            ValueError: If the image is not like those before.
        """
        reference = self._reference
        before = None if reference is None else reference.features.image
        if before is not None and gray.shape != before.shape:
            raise ValueError(
                f"image {self._count} is {gray.shape[1]}×{gray.shape[0]} px, the one before was "
                f"{before.shape[1]}×{before.shape[0]}: a sequence has one size"
            )
        guess = self._guess()
        features = self._follow(gray, reference, guess)
        flags = image_flags(gray, len(features.pixels), self._options.checks)
        return self._take(features, measure(features.pixels), guess, flags)

    def step_tracks(self, ids: np.ndarray, measured: Measured) -> FrameEstimate:
        """Take the next frame by its features, followed elsewhere.

        Args:
            ids: A whole number for each feature, the same in all frames.
            measured: Where they are in the ideal pair.

        Raises:
            ValueError: If a feature stands there twice or nowhere, or images came before.
        """
        features, order = given_features(ids, measured.pixels, self._reference and self._reference.features)
        self._size = room_for(len(order), self._size)
        few = len(order) < self._options.checks.min_features
        flags = (Flag.texture,) if few else ()
        return self._take(features, measured.rows(order), self._guess(), flags)

    def _guess(self) -> SE3:
        """The motion since the reference, should the last one repeat itself."""
        return self._motion if self._gap == 1 else repeated(self._motion, float(self._gap))

    def _take(self, features: Features, measured: Measured, guess: SE3, flags: tuple[Flag, ...]) -> FrameEstimate:
        frame = _Frame(features, measured, padded_features(measured, self._size), features.pixels)
        reference = self._reference
        estimate = self._first(frame, flags) if reference is None else self._next(reference, frame, guess, flags)
        self._count += 1
        return estimate

    def _follow(self, gray: np.ndarray, reference: _Frame | None, guess: SE3) -> Features:
        if reference is None:
            return self._tracks.step(gray, None)
        predicted = np.asarray(predicted_pixels(reference.padded, guess, self._stereo))
        predicted = predicted[: len(reference.features.pixels)]
        if self._distort is not None:
            predicted = self._distort(predicted)
        return self._tracks.step(gray, reference.features, predicted)

    def _first(self, frame: _Frame, flags: tuple[Flag, ...]) -> FrameEstimate:
        self._add_keyframe(self._pose, frame, np.arange(len(frame.image_pixels)))
        self._reference = frame
        return FrameEstimate(self._pose, keyframe=True, disparity=np.zeros(0, np.float32), flags=flags)

    def _next(self, reference: _Frame, frame: _Frame, guess: SE3, flags: tuple[Flag, ...]) -> FrameEstimate:
        checks, rows = self._options.checks, frame.features.rows
        pixels0, pixels1 = reference.image_pixels[rows], frame.image_pixels[: len(rows)]
        # An image without content shares nothing with any other: no news.
        about_image = bool(flags)
        if not about_image:
            flags = track_flags(pixels0, pixels1, len(reference.image_pixels), checks)
        motion = self._estimate(reference, frame, guess)
        inliers = np.flatnonzero(np.asarray(motion.inliers)[: len(rows)])
        num_usable = int(motion.num_usable)
        if num_usable >= self._options.min_inliers:
            flags += consensus_flags(len(inliers), num_usable, self._options.min_inliers, checks)
        if len(inliers) < self._options.min_inliers:
            # Some flag says why: without tracks enough it is the overlap.
            reasons = flags if any(flag is not Flag.static for flag in flags) else (*flags, Flag.overlap)
            if about_image:
                return self._bridge(reasons)
            return self._start_again(frame, reasons)

        flags += self._check_synchrony(reference, frame, inliers)
        self.calibration = motion.calibration
        pose = orthonormal(self._pose @ np.asarray(inverse_matrix(motion.cam1_from_cam0), np.float64))
        static = Flag.static in flags
        # Only depths make a reference: landmarks are triangulated there.
        advance = not static and int(frame.measured.matches.valid.sum()) >= checks.min_features
        keyframe = False
        if static:
            self._motion, self._gap = SE3.identity(), 1
        else:
            moved = motion.cam1_from_cam0
            self._motion = moved if self._gap == 1 else repeated(moved, 1.0 / self._gap)
        if advance:
            keyframe = self._is_keyframe(pose, frame, inliers, motion)
            if keyframe:
                new = np.arange(len(rows), len(frame.image_pixels))
                pose = self._add_keyframe(pose, frame, np.concatenate([inliers, new]))
            self._reference, self._pose, self._gap = frame, pose, 1
        elif not static:
            self._gap += 1
        return FrameEstimate(
            pose,
            len(inliers),
            keyframe=keyframe,
            pixels=pixels1[inliers],
            previous_pixels=pixels0[inliers],
            disparity=frame.measured.matches.disparity[inliers],
            flags=flags,
        )

    def _estimate(self, reference: _Frame, frame: _Frame, guess: SE3) -> Motion:
        rows = frame.features.rows
        before = reference.measured.rows(rows)
        options, size = self._options.motion, self._size
        quality = frame.features.quality
        arguments = (
            padded_features(before, size),
            frame.padded,
            jnp.asarray(np.pad(quality, (0, size - len(quality)))),
            guess,
            self.calibration,
            self._stereo,
            jax.random.fold_in(self._key, self._count),
        )
        if isinstance(options, RigidMotionOptions):
            return rigid_motion(*arguments, options)
        return stereo_motion(*arguments, options)

    def _check_synchrony(self, reference: _Frame, frame: _Frame, inliers: np.ndarray) -> tuple[Flag, ...]:
        matches = frame.measured.matches
        matched = inliers[matches.valid[inliers] & np.isfinite(matches.row_offset[inliers])]
        pixels = frame.measured.pixels[matched]
        moved = pixels - reference.measured.pixels[frame.features.rows[matched]]
        self.synchrony = self.synchrony.add(pixels, moved[:, 1] / self._gap, matches.row_offset[matched])
        return synchrony_flags(*self.synchrony.late(), self._options.checks)

    def _ahead(self) -> np.ndarray:
        """The pose now, should the motion have repeated itself since the reference."""
        return orthonormal(self._pose @ np.asarray(inverse_matrix(self._guess()), np.float64))

    def _bridge(self, flags: tuple[Flag, ...]) -> FrameEstimate:
        """Repeat the last motion; the reference stays."""
        pose = self._pose if self._reference is None else self._ahead()
        self._gap += self._reference is not None
        return FrameEstimate(pose, bridged=True, disparity=np.zeros(0, np.float32), flags=flags)

    def _start_again(self, frame: _Frame, flags: tuple[Flag, ...]) -> FrameEstimate:
        """Repeat the last motion and go on from the new frame, as nothing connects it with the reference."""
        self._pose = self._ahead()
        self._window.clear()
        # What was followed may be wrong; only new features are to become landmarks.
        self._add_keyframe(self._pose, frame, np.arange(len(frame.features.rows), len(frame.image_pixels)))
        self._reference, self._gap = frame, 1
        return FrameEstimate(self._pose, bridged=True, keyframe=True, disparity=np.zeros(0, np.float32), flags=flags)

    def _add_keyframe(self, pose: np.ndarray, frame: _Frame, rows: np.ndarray) -> np.ndarray:
        matches = frame.measured.matches
        keyframe = Keyframe(
            pose,
            frame.features.ids[rows],
            _measurements(frame.measured)[rows],
            np.where(matches.valid, matches.sigma, 0.0)[rows],
        )
        offsets = self.calibration.estimate() if self._options.motion.self_calibrate else jnp.zeros(2)
        return self._window.add(keyframe, offsets, adjust=self._options.window)

    def _is_keyframe(self, pose: np.ndarray, frame: _Frame, inliers: np.ndarray, motion: Motion) -> bool:
        newest = self._window.newest
        if newest is None:
            return True
        shared = len(np.intersect1d(newest.ids, frame.features.ids[inliers]))
        distance = float(np.linalg.norm(pose[:3, 3] - newest.world_from_cam[:3, 3]))
        return is_keyframe(distance, np.asarray(motion.depths)[inliers], shared, self._options.keyframes)


@eqx.filter_jit
def inverse_matrix(pose: SE3) -> jax.Array:
    return pose.inverse().as_matrix()


@eqx.filter_jit
def repeated(motion: SE3, times: float) -> SE3:
    """A motion done some number of times, or a part of it."""
    return SE3.exp(motion.log() * times)


def _measurements(measured: Measured) -> np.ndarray:
    return np.column_stack([measured.pixels, measured.pixels[:, 0] - measured.matches.disparity]).astype(np.float32)


def padded_features(measured: Measured, size: int) -> StereoFeatures:
    n = len(measured.pixels)
    measurements = np.zeros((size, 3), np.float32)
    measurements[:n] = _measurements(measured)
    sigma = np.ones(size, np.float32)
    sigma[:n] = measured.matches.sigma
    position, disparity = np.zeros(size, bool), np.zeros(size, bool)
    position[:n], disparity[:n] = True, measured.matches.valid
    return StereoFeatures(*map(jnp.asarray, (measurements, sigma, position, disparity)))
