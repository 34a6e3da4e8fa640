"""RGB-D odometry: a depth is a disparity of a virtual stereo pair, and what is done for stereo serves as it is.

The noise of a structured-light depth grows with z², because the sensor itself measures a disparity with constant noise:
σ_z = c z² is σ_d = c f b of d = f b/z, the same for all points. References: Khoshelham & Elberink, "Accuracy and
resolution of Kinect depth data for indoor mapping applications", Sensors 2012.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax._types import Array, Float
from vojax.cameras import Camera, Pinhole, RectifiedStereo
from vojax.features import DescriptorOptions, DetectorOptions, StereoMatches, TrackerOptions, to_gray

from ._disparity_odometry import DisparityOdometry, Measured
from ._frame import FrameEstimate
from ._image_checks import ImageChecks
from ._keyframes import KeyframeOptions
from ._motion import MotionOptions
from ._sliding_window import WindowOptions
from ._tracks import padded


@dataclasses.dataclass(frozen=True)
class DepthOptions:
    """How depths are read at features.

    Attributes:
        sigma_per_m2: Standard deviation of a depth over its square, 1/m: 1.43e-3 is half a disparity unit of the
            Kinect, 4 cm at 5 m.
        baseline_m: Of the virtual pair; that of the Kinect.
        radius_px: Half the side of the window that a depth is the median of.
        max_spread_px: Largest standard deviation of the disparities in the window: more is an edge of an object, where
            the depth belongs to either side.
    """

    sigma_per_m2: float = 1.43e-3
    baseline_m: float = 0.075
    radius_px: int = 2
    max_spread_px: float = 1.0

    def __post_init__(self) -> None:
        for name in ("sigma_per_m2", "baseline_m", "max_spread_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}: expected a positive number")
        if self.radius_px < 0:
            raise ValueError(f"radius_px is {self.radius_px}: expected 0 or more")


@dataclasses.dataclass(frozen=True)
class RgbdOdometryOptions:
    """Stages of the pipeline.

    Attributes:
        window: Adjust the last keyframes together; False chains the motions as they are.
        min_inliers: With fewer, a frame counts as not tracked and the last motion bridges it.
        detector: Corners that are tracked, or (`DescriptorOptions`) features that are matched.
        tracker: From frame to frame; not read where features are matched.
        depth: Depths at corners.
        motion: Pose of the new frame.
        checks: When a frame is flagged.
        keyframes: Which frames enter the window.
        sliding_window: The window.
    """

    window: bool = True
    min_inliers: int = 12
    detector: DetectorOptions | DescriptorOptions = DetectorOptions(max_features=600)
    tracker: TrackerOptions = TrackerOptions()
    depth: DepthOptions = DepthOptions()
    motion: MotionOptions = MotionOptions(self_calibrate=False)
    checks: ImageChecks = ImageChecks()
    keyframes: KeyframeOptions = KeyframeOptions()
    sliding_window: WindowOptions = WindowOptions()


class RgbdOdometry:
    """Estimates the path of a camera from its images and their depths.

    Args:
        camera: Of `vojax.cameras`, any model; the depth images belong to it.
        options: Stages and their settings.
        seed: Of the random sampling; the same seed and images give the same path.

    Example:
        >>> odometry = RgbdOdometry(Pinhole(fx=500.0, fy=500.0, cx=319.5, cy=239.5))
        >>> blank = np.zeros((480, 640), np.uint8)
        >>> odometry.step(blank, None).world_from_cam.tolist() == np.eye(4).tolist()
        True
    """

    def __init__(self, camera: Camera, options: RgbdOdometryOptions = RgbdOdometryOptions(), *, seed: int = 0):
        self._camera = camera
        self._options = options
        self._pinhole = camera if isinstance(camera, Pinhole) else _pinhole_of(camera)
        self._size = -(-options.detector.max_features // 64) * 64
        stereo = RectifiedStereo(self._pinhole, baseline=options.depth.baseline_m)
        self._fb = float(self._pinhole.fx) * options.depth.baseline_m
        distort = None if isinstance(camera, Pinhole) else self._distort
        self._odometry = DisparityOdometry(stereo, options, seed=seed, distort=distort)

    def step(self, image: np.ndarray, depth: np.ndarray | None) -> FrameEstimate:
        """Take the next image.

        A frame without depth is tracked from the last one that had any, for as long as they share features.

        Args:
            image: uint8, grey or RGB.
            depth: Camera z at its pixels in metres, 0 (or not finite) where there is none; None for none at all.

        Returns:
            The new pose and what it rests on.

        Raises:
            ValueError: If image and depth do not fit together, or not to those before.
        """
        gray = to_gray(image)
        if depth is not None and np.shape(depth) != gray.shape:
            raise ValueError(
                f"depth has shape {np.shape(depth)} and the image {gray.shape}: expected one depth for each pixel"
            )

        def measure(pixels: np.ndarray) -> Measured:
            ideal, visible = self._ideal(pixels)
            matches = disparities_of_depths(depth, pixels, self._fb, self._options.depth)
            return Measured(ideal, matches._replace(valid=matches.valid & visible))

        return self._odometry.step(gray, measure)

    def skip(self) -> FrameEstimate:
        """Bridge a frame that cannot be read: the last motion is repeated.

        The next frame is tracked from the last one that could be read, so that its pose rests on no guess.

        Returns:
            The pose guessed, flagged `unreadable`.
        """
        return self._odometry.skip()

    def _ideal(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of the ideal pinhole, and which lie within its view."""
        if self._camera is self._pinhole:
            return pixels, np.ones(len(pixels), bool)
        ideal, ahead = _moved(jnp.asarray(padded(pixels, self._size)), self._camera, self._pinhole)
        ahead = np.asarray(ahead)[: len(pixels)]
        return np.where(ahead[:, None], np.asarray(ideal)[: len(pixels)], pixels), ahead

    def _distort(self, ideal: np.ndarray) -> np.ndarray:
        pixels, _ = _moved(jnp.asarray(padded(ideal, self._size)), self._pinhole, self._camera)
        pixels = np.asarray(pixels)[: len(ideal)]
        return np.where(np.isfinite(pixels), pixels, ideal)


def disparities_of_depths(
    depth: np.ndarray | None, pixels: np.ndarray, focal_baseline: float, options: DepthOptions = DepthOptions()
) -> StereoMatches:
    """Read depths at features as disparities of the virtual pair.

    Args:
        depth: Metres `[h, w]`, 0 where there is none; None for none at all.
        pixels: Features `[n, 2]` in the image of the depths.
        focal_baseline: fx times baseline, px m.
        options: Noise and window.

    Returns:
        Medians of windows around the features, f b/z, with the noise of the sensor and the spread of the window as
        standard deviation. Not valid: features outside the image, windows with less than half of their depths, and
        those across an edge.
    """
    n, radius = len(pixels), options.radius_px
    if depth is None or n == 0:
        zeros = np.zeros(n, np.float32)
        return StereoMatches(zeros, zeros, np.ones(n, np.float32), np.zeros(n, bool), zeros + np.nan)
    usable = np.where(np.isfinite(depth) & (depth > 0), depth, 0.0)
    usable = np.pad(usable, radius)
    columns, rows = np.rint(pixels).astype(np.intp).T
    within = (columns >= 0) & (rows >= 0) & (columns < depth.shape[1]) & (rows < depth.shape[0])
    offset = np.arange(2 * radius + 1)
    z = usable[
        np.where(within, rows, 0)[:, None, None] + offset[:, None], np.where(within, columns, 0)[:, None, None] + offset
    ].reshape(n, -1)
    there = z > 0
    counts = there.sum(axis=1)
    disparities = np.where(there, focal_baseline / np.where(there, z, 1.0), np.inf)
    # The median of what is there: missing ones are sorted to the end. On a slanted plane it is that of the centre.
    middle = np.take_along_axis(np.sort(disparities, axis=1), np.maximum((counts - 1) // 2, 0)[:, None], axis=1)[:, 0]
    centred = np.where(there, disparities - np.where(counts > 0, middle, 0.0)[:, None], 0.0)
    spread = np.sqrt(np.sum(centred**2, axis=1) / np.maximum(counts, 1))
    valid = within & (2 * counts >= z.shape[1]) & (spread <= options.max_spread_px)
    sigma = np.hypot(options.sigma_per_m2 * focal_baseline, spread)
    return StereoMatches(
        np.where(valid, middle, 0.0).astype(np.float32),
        valid.astype(np.float32),
        np.where(valid, sigma, 1.0).astype(np.float32),
        valid,
        np.full(n, np.nan, np.float32),
    )


@eqx.filter_jit
def _moved(pixels: Float[Array, "n 2"], camera0: Camera, camera1: Camera) -> tuple[Array, Array]:
    """Pixels of one camera in another at the same place, and which are less than 84° from its axis."""
    rays = camera0.unproject(pixels)
    ahead = rays[:, 2] > 0.1
    return camera1.project(jnp.where(ahead[:, None], rays, jnp.array([0.0, 0.0, 1.0])[None])), ahead


def _pinhole_of(camera: Camera) -> Pinhole:
    """The pinhole that equals a camera on its axis."""
    axis = jnp.array([0.0, 0.0, 1.0])
    (cx, cy), scale = camera.project(axis), jax.jacfwd(camera.project)(axis)
    return Pinhole(fx=scale[0, 0], fy=scale[1, 1], cx=cx, cy=cy)
