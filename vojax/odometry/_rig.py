"""Odometry of several stereo pairs that are fixed to one another and look wherever they like.

Each pair follows its own features; one motion of the rig explains them all (`_rig_motion.py`). A pair that sees nothing
(dark, covered, without texture) leaves the others to go on, and joins them again by itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vojax.cameras import RectifiedStereo
from vojax.features import match_stereo_rows, to_gray
from vojax.lie import SE3, SO3

from ._disparity_odometry import Measured, given_measurements, inverse_matrix, padded_features, repeated
from ._frame import Flag, FrameEstimate
from ._image_checks import consensus_flags, image_flags, track_flags
from ._motion import MotionOptions, StereoFeatures, predicted_pixels
from ._pair_rectifier import PairRectifier
from ._rectification import DisparityCalibration
from ._rig_motion import PairRig, RigMotion, rig_motion
from ._sliding_window import orthonormal
from ._stereo import StereoOdometryOptions
from ._tracks import Features, front_end, given_features, room_for


class _View(NamedTuple):
    """What one pair sees."""

    features: Features
    measured: Measured


class RigOdometry:
    """Estimates the path of a rig of stereo pairs from their images.

    Args:
        pairs: One or more rectified pairs, or the `PairRectifier` of any other two cameras.
        left_from_rig: Poses of their left cameras (as they are taken, before rectification) in the rig's frame `[k]`,
            translations in metres.
        options: As of `StereoOdometry`, for each pair alike; without window, from points to pixels.
        seed: Of the random sampling; the same seed and images give the same path.

    Degenerate input: a frame in which all pairs together have too few features that agree is bridged, as in
        `StereoOdometry`. The motion of each pair alone need not be determined.

    Raises:
        ValueError: If poses and pairs do not fit together, or the options are of another pipeline.

    Example:
        >>> from vojax.cameras import Pinhole
        >>> pair = RectifiedStereo(Pinhole(fx=400.0, fy=400.0, cx=319.5, cy=119.5), baseline=0.5)
        >>> backwards = SO3.exp(jnp.array([[0.0, 0.0, 0.0], [0.0, np.pi, 0.0]]))
        >>> odometry = RigOdometry([pair, pair], SE3.from_rotation_and_translation(backwards, jnp.zeros((2, 3))))
        >>> blank = np.zeros((240, 640), np.uint8)
        >>> odometry.step([(blank, blank), (blank, blank)]).world_from_cam.tolist() == np.eye(4).tolist()
        True
    """

    def __init__(
        self,
        pairs: Sequence[RectifiedStereo | PairRectifier],
        left_from_rig: SE3,
        options: StereoOdometryOptions = StereoOdometryOptions(),
        *,
        seed: int = 0,
    ):
        shape = jnp.shape(left_from_rig.wxyz_xyz)
        if len(pairs) == 0 or shape != (len(pairs), 7):
            raise ValueError(f"{len(pairs)} pairs with left_from_rig of shape {shape}: expected one pose for each pair")
        if options.window or not isinstance(options.motion, MotionOptions):
            raise ValueError("a rig is followed from points to pixels and without window: see StereoOdometryOptions")
        self._rectifiers = [pair if isinstance(pair, PairRectifier) else None for pair in pairs]
        ideal = [pair.stereo if isinstance(pair, PairRectifier) else pair for pair in pairs]
        turns = [np.eye(3) if rectifier is None else rectifier.rect_from_cam0 for rectifier in self._rectifiers]
        rect_from_left = SE3.from_rotation_and_translation(
            SO3.from_matrix(jnp.asarray(np.stack(turns), jnp.float32)), jnp.zeros((len(pairs), 3))
        )
        self._pairs = ideal
        self._rig = PairRig(jax.tree.map(lambda *x: jnp.stack(x), *ideal), rect_from_left @ left_from_rig)
        self._options = options
        self._motion_options = options.motion
        self._key = jax.random.key(seed)
        self._tracks = [front_end(options.detector, options.tracker) for _ in pairs]
        self._size = -(-options.detector.max_features // 64) * 64
        self._reference: list[_View] | None = None
        self._pose = np.eye(4)  # of the reference
        self._motion = SE3.identity()  # rig1_from_rig0 of one frame
        self._gap = 1  # frames from the reference to the next
        self._count = 0
        self._calibration = DisparityCalibration.prior(len(pairs))

    @property
    def disparity_offsets_px(self) -> np.ndarray:
        """The disparity errors (a₀, a₁) of the pairs `[k, 2]`, estimated so far; see `DisparityCalibration`."""
        return np.asarray(self._calibration.estimate()).reshape(-1, 2)

    def step(self, images: Sequence[tuple[np.ndarray, np.ndarray]]) -> FrameEstimate:
        """Take the next images.

        Args:
            images: The left and the right one of each pair, uint8; taken at the same time.

        Returns:
            The new pose of the rig, `world_from_cam` of the rig's frame, and what it rests on: `num_inliers` of all
            pairs, pixels and disparities of none. Image flags are of any pair, the others of all together.

        Raises:
            ValueError: If there is not a pair of images for each pair, or images do not fit together or to those
                before.
        """
        self._check_count(len(images), "pairs of images")
        guess = self._guess()
        views, flags = [], []
        for k, (left, right) in enumerate(images):
            rectify = self._rectifiers[k]
            left, right = (to_gray(left), to_gray(right)) if rectify is None else rectify(left, right)
            features = self._follow(k, left, guess)
            matches = match_stereo_rows(left, right, features.pixels, self._options.matcher)
            views.append(_View(features, Measured(features.pixels, matches)))
            flags.append(image_flags(left, len(features.pixels), self._options.checks))
        return self._take(views, guess, flags)

    def step_tracks(
        self,
        ids: Sequence[np.ndarray],
        measurements: Sequence[np.ndarray],
        sigma_disparity_px: float = 0.25,
    ) -> FrameEstimate:
        """Take the next frame by its features, followed by a front end of your own.

        Args:
            ids: A whole number for each feature of each pair `[n]`, the same in all frames.
            measurements: `(u_left, v, u_right)` of each rectified pair `[n, 3]`; u_right not finite where the right
                image has no match.
            sigma_disparity_px: Standard deviation of u_left − u_right.

        Returns:
            As `step`.

        Raises:
            ValueError: If there is not one array for each pair, the arrays do not fit together, a feature stands in a
                pair twice, or images came before.
        """
        self._check_count(len(ids), "arrays of ids")
        self._check_count(len(measurements), "arrays of measurements")
        views, flags = [], []
        for k in range(len(ids)):
            measured = given_measurements(measurements[k], sigma_disparity_px)
            before = None if self._reference is None else self._reference[k].features
            features, order = given_features(ids[k], measured.pixels, before)
            views.append(_View(features, measured.rows(order)))
            flags.append((Flag.texture,) if len(order) < self._options.checks.min_features else ())
        self._size = room_for(max(len(view.features.ids) for view in views), self._size)
        return self._take(views, self._guess(), flags)

    def skip(self) -> FrameEstimate:
        """Bridge a frame that cannot be read: the last motion is repeated.

        Returns:
            The pose guessed, flagged `unreadable`.
        """
        estimate = self._bridge((Flag.unreadable,))
        self._count += 1
        return estimate

    def _check_count(self, count: int, what: str) -> None:
        if count != len(self._pairs):
            raise ValueError(f"{count} {what} for a rig of {len(self._pairs)} pairs: expected one for each")

    def _follow(self, k: int, gray: np.ndarray, guess: SE3) -> Features:
        if self._reference is None:
            return self._tracks[k].step(gray, None)
        before = self._reference[k]
        if before.features.image is not None and gray.shape != before.features.image.shape:
            raise ValueError(
                f"image {self._count} of pair {k} is {gray.shape[1]}×{gray.shape[0]} px, the one before was "
                f"{before.features.image.shape[1]}×{before.features.image.shape[0]}: a sequence has one size"
            )
        motion = jax.tree.map(lambda x: x[k], self._rig.motions(guess))
        padded = padded_features(before.measured, self._size)
        predicted = np.asarray(predicted_pixels(padded, motion, self._pairs[k]))
        return self._tracks[k].step(gray, before.features, predicted[: len(before.features.pixels)])

    def _guess(self) -> SE3:
        """The motion since the reference, should the last one repeat itself."""
        return self._motion if self._gap == 1 else repeated(self._motion, float(self._gap))

    def _take(self, views: list[_View], guess: SE3, image_flags: list[tuple[Flag, ...]]) -> FrameEstimate:
        flags = tuple(dict.fromkeys(flag for one in image_flags for flag in one))
        if self._reference is None:
            self._reference = views
            estimate = FrameEstimate(self._pose, flags=flags)
        else:
            estimate = self._next(self._reference, views, guess, flags, blind=all(image_flags))
        self._count += 1
        return estimate

    def _next(
        self, reference: list[_View], views: list[_View], guess: SE3, flags: tuple[Flag, ...], blind: bool
    ) -> FrameEstimate:
        checks = self._options.checks
        rows = [view.features.rows for view in views]
        pixels0 = np.concatenate([view.features.pixels[r] for view, r in zip(reference, rows, strict=True)])
        pixels1 = np.concatenate([view.features.pixels[: len(r)] for view, r in zip(views, rows, strict=True)])
        if not blind:
            flags += track_flags(pixels0, pixels1, sum(len(view.features.ids) for view in reference), checks)
        motion = self._estimate(reference, views, guess)
        num_inliers, num_usable = int(motion.num_inliers), int(motion.num_usable)
        if num_usable >= self._options.min_inliers:
            flags += consensus_flags(num_inliers, num_usable, self._options.min_inliers, checks)
        if num_inliers < self._options.min_inliers:
            reasons = flags if any(flag is not Flag.static for flag in flags) else (*flags, Flag.overlap)
            estimate = self._bridge(reasons)
            if not blind:  # nothing connects the new frame with the reference: go on from it
                self._reference, self._pose, self._gap = views, estimate.world_from_cam, 1
            return estimate

        self._calibration = motion.calibration
        moved = motion.rig1_from_rig0
        pose = orthonormal(self._pose @ np.asarray(inverse_matrix(moved), np.float64))
        if Flag.static in flags:  # the reference stays: no sum of small errors
            self._motion, self._gap = SE3.identity(), 1
        else:
            self._motion = moved if self._gap == 1 else repeated(moved, 1.0 / self._gap)
            self._reference, self._pose, self._gap = views, pose, 1
        return FrameEstimate(pose, num_inliers, flags=flags)

    def _estimate(self, reference: list[_View], views: list[_View], guess: SE3) -> RigMotion:
        def stacked(measured: list[Measured]) -> StereoFeatures:
            return jax.tree.map(lambda *x: jnp.stack(x), *(padded_features(one, self._size) for one in measured))

        followed = [before.measured.rows(view.features.rows) for before, view in zip(reference, views, strict=True)]
        quality = [np.pad(view.features.quality, (0, self._size - len(view.features.quality))) for view in views]
        return rig_motion(
            stacked(followed),
            stacked([view.measured for view in views]),
            jnp.asarray(np.stack(quality)),
            guess,
            self._calibration,
            self._rig,
            jax.random.fold_in(self._key, self._count),
            self._motion_options,
        )

    def _bridge(self, flags: tuple[Flag, ...]) -> FrameEstimate:
        """Repeat the last motion; the reference stays."""
        if self._reference is None:
            return FrameEstimate(self._pose, bridged=True, flags=flags)
        pose = orthonormal(self._pose @ np.asarray(inverse_matrix(self._guess()), np.float64))
        self._gap += 1
        return FrameEstimate(pose, bridged=True, flags=flags)
