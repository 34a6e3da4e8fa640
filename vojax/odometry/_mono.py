"""Odometry with one camera, frame by frame; scale is that of the first baseline.

Scaramuzza & Fraundorfer 2011: "VO from 3-D-to-2-D correspondences" (a pose from landmarks) and "VO from 2-D-to-2-D
correspondences" (an essential matrix, its scale from points in three views). Both follow tracks, begin with two views,
choose keyframes, triangulate and adjust the last keyframes alike; how the pose of a new frame is found is the only
difference between them, and a third way is the one-point model of a wheeled vehicle.
"""

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax.cameras import Camera
from vojax.features import DescriptorOptions, DetectorOptions, TrackerOptions, to_gray
from vojax.lie import SE3

from ._absolute_motion import AbsoluteMotionOptions, absolute_motion
from ._bootstrap import Bootstrap, BootstrapOptions, Start
from ._frame import Flag, FrameEstimate
from ._image_checks import ImageChecks, image_flags, track_flags
from ._keyframes import KeyframeOptions, is_keyframe
from ._mono_window import MonoKeyframe, MonoWindow, MonoWindowOptions
from ._planar_motion import PlanarMotionOptions, planar_motion
from ._relative_motion import RelativeMotionOptions, relative_motion
from ._sliding_window import orthonormal
from ._tracks import Features, front_end, given_features, padded, room_for, shared


@dataclasses.dataclass(frozen=True)
class MonoOdometryOptions:
    """Stages of the pipeline.

    Attributes:
        motion: How the pose of a frame is found: "absolute" (landmarks to pixels), "relative" (an essential matrix
            since the newest keyframe) or "planar" (the turn of a wheeled vehicle).
        window: Adjust the last keyframes together; False leaves the poses as the motions chain them.
        guided: Sample the best tracks first; False samples uniformly.
        min_inliers: With fewer, a frame counts as not tracked and the last motion bridges it.
        max_bridged: After more frames in a row than this the pipeline starts anew.
        detector: Corners that are tracked, or (`DescriptorOptions`) features that are matched.
        tracker: From frame to frame; not read where features are matched.
        checks: When a frame is flagged.
        bootstrap: The first motion.
        absolute: Motion from landmarks.
        relative: Motion from an essential matrix.
        planar: Motion of a vehicle.
        keyframes: Which frames enter the window.
        mono_window: The window.
    """

    motion: Literal["absolute", "relative", "planar"] = "absolute"
    window: bool = True
    guided: bool = True
    min_inliers: int = 15
    max_bridged: int = 3
    detector: DetectorOptions | DescriptorOptions = DetectorOptions(max_features=800)
    tracker: TrackerOptions = TrackerOptions()
    checks: ImageChecks = ImageChecks()
    bootstrap: BootstrapOptions = BootstrapOptions()
    absolute: AbsoluteMotionOptions = AbsoluteMotionOptions()
    relative: RelativeMotionOptions = RelativeMotionOptions()
    planar: PlanarMotionOptions = PlanarMotionOptions()
    keyframes: KeyframeOptions = KeyframeOptions()
    mono_window: MonoWindowOptions = MonoWindowOptions()

    def __post_init__(self) -> None:
        if self.motion not in ("absolute", "relative", "planar"):
            raise ValueError(f"motion is {self.motion!r}: expected 'absolute', 'relative' or 'planar'")


class MonoOdometry:
    """Estimates the path of one camera from its images.

    The first frame is the world. Poses of the frames until the first baseline are not known when they come: their
    estimates are `pending`, and the one that ends the wait brings theirs in `earlier`. After a loss it waits in the
    same way, and goes on with the speed that it had before.

    Args:
        camera: Of `vojax.cameras`.
        options: Stages and their settings.
        seed: Of the random sampling; the same seed and images give the same path.

    Example:
        >>> from vojax.cameras import Pinhole
        >>> odometry = MonoOdometry(Pinhole(fx=400.0, fy=400.0, cx=319.5, cy=119.5))
        >>> odometry.step(np.zeros((240, 640), np.uint8)).world_from_cam.tolist() == np.eye(4).tolist()
        True
    """

    def __init__(self, camera: Camera, options: MonoOdometryOptions = MonoOdometryOptions(), *, seed: int = 0):
        self._camera = camera
        self._options = options
        self._key = jax.random.key(seed)
        self._tracks = front_end(options.detector, options.tracker)
        self._window = MonoWindow(camera, options.mono_window)
        self._size = -(-options.detector.max_features // 64) * 64
        self._features: Features | None = None
        self._predicted: np.ndarray | None = None
        self._bootstrap: Bootstrap | None = None
        self._pending = 0
        self._speed: float | None = None  # distance per frame before a loss
        self._pose = np.eye(4)  # of the last frame that was looked at
        self._origin = np.eye(4)  # world_from_cam where the bootstrap began
        self._motion = np.eye(4)  # cam1_from_cam0 of one frame
        self._skipped = 0  # frames that could not be read since
        self._bridged = 0  # in a row
        self._count = 0

    def step(self, image: np.ndarray) -> FrameEstimate:
        """Take the next image.

        Args:
            image: uint8, grey or RGB.

        Returns:
            The new pose and what it rests on.

        Raises:
            ValueError: If the image is not like those before.
        """
        gray, previous = to_gray(image), self._features
        before = None if previous is None else previous.image
        if before is not None and gray.shape != before.shape:
            raise ValueError(
                f"image {self._count} is {gray.shape[1]}×{gray.shape[0]} px, the one before was "
                f"{before.shape[1]}×{before.shape[0]}: a sequence has one size"
            )
        features = self._tracks.step(gray, previous, self._predicted)
        estimate = self._take(features, image_flags(gray, len(features.pixels), self._options.checks))
        self._predicted = self._predict(features)
        return estimate

    def step_tracks(self, ids: np.ndarray, pixels: np.ndarray) -> FrameEstimate:
        """Take the next frame by its features, followed by a front end of your own.

        Args:
            ids: A whole number for each feature `[n]`, the same in all frames.
            pixels: Where they are `[n, 2]`.

        Returns:
            The new pose and what it rests on.

        Raises:
            ValueError: If the arrays do not fit together, a feature stands there twice, or images came before.
        """
        features, _ = given_features(ids, pixels, self._features)
        self._size = room_for(len(features.ids), self._size)
        few = len(features.ids) < self._options.checks.min_features
        return self._take(features, (Flag.texture,) if few else ())

    def _take(self, features: Features, about_image: tuple[Flag, ...]) -> FrameEstimate:
        """A frame by its features; a flag does not change what becomes of it, and is never passed over."""
        previous, flags = self._features, about_image
        # An image without content shares nothing with any other: no news.
        if previous is not None and not about_image:
            before, now = previous.pixels[features.rows], features.pixels[: len(features.rows)]
            flags = track_flags(before, now, len(previous.ids), self._options.checks)
        if previous is None:
            self._begin()
            self._add_to_bootstrap(features)
            estimate = FrameEstimate(np.eye(4), keyframe=True)
        elif self._bootstrap is not None:
            estimate = self._wait(features)
        else:
            estimate = self._follow(previous, features)
        self._features, self._skipped = features, 0
        self._count += 1
        return dataclasses.replace(estimate, flags=(*flags, *estimate.flags)) if flags else estimate

    def skip(self) -> FrameEstimate:
        """Bridge a frame that cannot be read: the last motion is repeated, and tracks go on from the image before."""
        self._count += 1
        if self._bootstrap is not None:
            self._pending += self._features is not None
            return FrameEstimate(self._pose, bridged=True, flags=(Flag.unreadable,), pending=self._features is not None)
        self._skipped += 1
        return FrameEstimate(self._ahead(self._skipped), bridged=True, flags=(Flag.unreadable,))

    def _ahead(self, frames: int) -> np.ndarray:
        """The pose some frames on, should the motion repeat itself."""
        return orthonormal(self._pose @ np.linalg.inv(np.linalg.matrix_power(self._motion, frames)))

    def _begin(self) -> None:
        key = jax.random.fold_in(self._key, 2 * self._count + 1)
        self._bootstrap = Bootstrap(self._camera, self._options.bootstrap, self._size, key)
        self._origin = self._pose

    def _add_to_bootstrap(self, features: Features) -> Start | None:
        assert self._bootstrap is not None
        return self._bootstrap.add(features)

    def _wait(self, features: Features) -> FrameEstimate:
        """A frame of the bootstrap."""
        start = self._add_to_bootstrap(features)
        if start is None:
            self._pending += 1
            return FrameEstimate(self._pose, pending=True)
        restarted = self._speed is not None
        moved = len(start.poses) - 1
        scale = self._speed * moved if self._speed is not None else 1.0
        poses = start.poses.copy()
        poses[:, :3, 3] *= scale
        poses = self._origin @ poses
        self._window.clear()
        rows = start.inliers
        for pose, frame in ((self._origin, start.first), (poses[-1], features)):
            here = rows if frame is features else shared(start.first.ids, features.ids[rows])[0]
            self._window.add(MonoKeyframe(pose, frame.ids[here], frame.pixels[here]), adjust=False)
        self._bootstrap = None
        earlier, self._pending = poses[1:-1][-self._pending :] if self._pending else poses[:0], 0
        self._motion = np.linalg.inv(poses[-2]) @ poses[-1]
        self._motion = np.linalg.inv(self._motion)
        self._pose, self._bridged = poses[-1], 0
        return FrameEstimate(
            self._pose,
            len(rows),
            keyframe=True,
            pixels=features.pixels[rows],
            previous_pixels=self._before(features, rows),
            flags=(Flag.restarted,) if restarted else (),
            earlier=earlier,
        )

    def _before(self, features: Features, rows: np.ndarray) -> np.ndarray:
        """Where features were in the image before; where they are, for new ones."""
        pixels = features.pixels.copy()
        if self._features is not None:
            pixels[: len(features.rows)] = self._features.pixels[features.rows]
        return pixels[rows]

    def _follow(self, previous: Features, features: Features) -> FrameEstimate:
        """A frame with landmarks in view."""
        frames = self._skipped + 1
        absolute = self._options.motion == "absolute"
        pose, rows = self._by_landmarks(features, frames) if absolute else self._by_keyframe(features)
        bridged = pose is None or len(rows) < self._options.min_inliers
        if bridged or pose is None:
            self._bridged += frames
            if self._bridged > self._options.max_bridged:
                return self._restart(features)
            self._pose = self._ahead(frames)
            return FrameEstimate(self._pose, bridged=True, flags=(Flag.consensus,))
        pixels, before = features.pixels[rows], self._before(features, rows)
        landmarks, (at, of) = self._window.landmarks, shared(features.ids, self._window.landmarks.ids)
        cam_from_world = np.linalg.inv(pose)
        depths = landmarks.points[of] @ cam_from_world[2, :3] + cam_from_world[2, 3]
        newest = self._window.newest
        assert newest is not None
        distance = float(np.linalg.norm(pose[:3, 3] - newest.world_from_cam[:3, 3]))
        in_newest = len(shared(newest.ids, features.ids[rows])[0])
        keyframe = is_keyframe(distance, depths[depths > 0], in_newest, self._options.keyframes)
        if keyframe:
            # Landmarks that disagree are left out, by the frame; tracks without a landmark have a chance.
            outliers = np.setdiff1d(at, rows) if absolute else np.setdiff1d(shared(features.ids, newest.ids)[0], rows)
            kept = np.setdiff1d(np.arange(len(features.ids)), outliers)
            pose = self._window.add(
                MonoKeyframe(pose, features.ids[kept], features.pixels[kept]), adjust=self._options.window
            )
        step = np.linalg.inv(pose) @ self._pose
        self._motion = orthonormal(step) if frames == 1 else _root(step, frames)
        self._pose, self._bridged = pose, 0
        return FrameEstimate(pose, len(rows), keyframe=keyframe, pixels=pixels, previous_pixels=before)

    def _restart(self, features: Features) -> FrameEstimate:
        """Too long without a motion: begin anew at the place where the path was lost."""
        self._speed = float(np.linalg.norm(self._motion[:3, 3]))
        self._pose = self._ahead(self._skipped + 1)
        self._window.clear()
        self._begin()
        self._add_to_bootstrap(features)
        return FrameEstimate(self._pose, bridged=True, flags=(Flag.consensus,))

    def _by_landmarks(self, features: Features, frames: int) -> tuple[np.ndarray | None, np.ndarray]:
        landmarks = self._window.landmarks
        rows, of = shared(features.ids, landmarks.ids)
        if len(rows) < self._options.min_inliers:
            return None, rows
        cam_from_world = np.linalg.inv(self._pose)
        rotation = cam_from_world[:3, :3]
        points = landmarks.points[of] @ rotation.T + cam_from_world[:3, 3]
        covariances = rotation @ landmarks.covariances[of] @ rotation.T
        guess = np.linalg.matrix_power(self._motion, frames)
        found = absolute_motion(
            self._padded(points),
            self._padded(covariances),
            self._padded(features.pixels[rows]),
            jnp.arange(self._size) < len(rows),
            self._quality(features, rows),
            SE3.from_matrix(jnp.asarray(guess, jnp.float32)),
            self._camera,
            jax.random.fold_in(self._key, 2 * self._count),
            self._options.absolute,
        )
        moved = np.asarray(found.cam1_from_cam0.as_matrix(), np.float64)
        return orthonormal(self._pose @ np.linalg.inv(moved)), rows[np.asarray(found.inliers)[: len(rows)]]

    def _by_keyframe(self, features: Features) -> tuple[np.ndarray | None, np.ndarray]:
        newest, landmarks = self._window.newest, self._window.landmarks
        assert newest is not None
        in_newest, rows = shared(newest.ids, features.ids)
        if len(rows) < self._options.min_inliers:
            return None, rows
        cam_from_world = np.linalg.inv(newest.world_from_cam)
        points, std = np.zeros((len(rows), 3)), np.ones(len(rows))
        at, of = shared(newest.ids[in_newest], landmarks.ids)
        points[at] = landmarks.points[of] @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        std[at] = np.sqrt(np.maximum(np.trace(landmarks.covariances[of], axis1=1, axis2=2), 0.0))
        known = np.isin(np.arange(len(rows)), at)
        arrays = (
            self._padded(newest.pixels[in_newest]),
            self._padded(features.pixels[rows]),
            jnp.arange(self._size) < len(rows),
            self._padded(points),
            self._padded(std),
            jnp.asarray(padded(known, self._size)),
        )
        if self._options.motion == "planar":
            found = planar_motion(*arrays, self._camera, self._options.planar)
        else:
            key, quality = jax.random.fold_in(self._key, 2 * self._count), self._quality(features, rows)
            found = relative_motion(*arrays, quality, self._camera, key, self._options.relative)
        if not float(found.scale) > 0:
            return None, rows[:0]
        moved = np.asarray(found.cam1_from_cam0.as_matrix(), np.float64)
        return orthonormal(newest.world_from_cam @ np.linalg.inv(moved)), rows[np.asarray(found.inliers)[: len(rows)]]

    def _padded(self, array: np.ndarray) -> jax.Array:
        return jnp.asarray(padded(array.astype(np.float32), self._size))

    def _quality(self, features: Features, rows: np.ndarray) -> jax.Array | None:
        return self._padded(features.quality[rows]) if self._options.guided else None

    def _predict(self, features: Features) -> np.ndarray:
        """Where the features will be, should the motion repeat itself; those without a landmark at the usual depth."""
        if self._bootstrap is not None:
            return features.pixels
        landmarks = self._window.landmarks
        rows, of = shared(features.ids, landmarks.ids)
        cam_from_world = np.linalg.inv(self._pose)
        points = landmarks.points[of] @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        distances = np.full(len(features.ids), np.median(np.linalg.norm(points, axis=1)) if len(rows) else 1e3)
        distances[rows] = np.linalg.norm(points, axis=1)
        predicted = _moved(
            self._padded(features.pixels), self._padded(distances), jnp.asarray(self._motion, jnp.float32), self._camera
        )
        predicted = np.asarray(predicted)[: len(features.ids)]
        return np.where(np.isfinite(predicted), predicted, features.pixels)


@eqx.filter_jit
def _moved(pixels: jax.Array, distances: jax.Array, cam1_from_cam0: jax.Array, camera: Camera) -> jax.Array:
    points = SE3.from_matrix(cam1_from_cam0).apply(camera.unproject(pixels) * distances[:, None])
    return camera.project(points)


def _root(motion: np.ndarray, count: int) -> np.ndarray:
    """The motion that repeated `count` times gives a motion."""
    step = SE3.exp(SE3.from_matrix(jnp.asarray(motion, jnp.float32)).log() / count)
    return orthonormal(np.asarray(step.as_matrix(), np.float64))
