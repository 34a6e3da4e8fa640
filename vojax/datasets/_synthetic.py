"""A stereo drive through a made-up street, rendered on the spot: images, exact depth and exact poses, no download."""

import collections

import jax
import numpy as np

from vojax.cameras import Pinhole, RectifiedStereo

from . import _render, _street

_WINDOW = 256  # Lane grid cells passed to the renderer, per side.
_KEPT_FRAMES = 128
_EXPOSURES = 4  # pictures that a blurred one is averaged from


class SyntheticStereoSequence:
    """A stereo camera on a car: a straight, a bend of 70 to 85 degrees, a straight; 10 Hz, about 0.9 m a frame.

    Or laps around a block of houses (`lap`): four straights and four bends of 90 degrees in 500 frames, 450 m.

    It reads like a KITTI sequence. The pictures are made when asked for (on the device that JAX uses) and the last 128
    frames are kept. The same arguments give the same pictures; sequences of different lengths share their first frames.

    Each of the four assumptions that visual odometry makes can be broken: enough light (`lighting_amplitude`), a static
    scene (`moving_cars`), enough texture (`texture_contrast`) and enough overlap (`stride`); and that of stereo, one
    time for both pictures (`right_late`).

    Args:
        frames: Number of frames.
        width: Image width, pixels.
        height: Image height, pixels.
        seed: Fixes the path, the street and the sensor noise.
        focal_px: Focal length, pixels; 0.625 times the width where it is None.
        baseline: Distance between the cameras, metres.
        lap: Drive around the block, and on and on for more than 500 frames.
        shutter: Share of 0.1 s in which the shutter is open: the motion blur of a picture.
        right_late: Share of 0.1 s by which the right picture is taken after the left one; cars stay where they are.
        stride: Path steps of 0.1 s from one frame to the next.
        lighting_amplitude: Natural logarithm of the largest change of exposure, which swings once in 2.4 s.
        moving_cars: Number of cars driving along: the first goes ahead in the same lane, the second comes towards the
            camera, and so on in turn.
        texture_contrast: Factor on all variation of reflectance; 0 leaves nothing but shading.
        noise_gray: Standard deviation of the sensor noise, gray levels of 255.
        supersample: Rays per pixel along each axis.

    Attributes:
        name: "synthetic-" and the seed.
        camera: The left camera; the principal point is the centre of the image.
        stereo: The calibrated pair.
        times: Seconds from the first frame, `[n]`.
        poses: `[n, 3, 4]`, world_from_cam of the left camera, metres; the first is the identity.
        frame_names: Six digits per frame, counting path steps.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> sequence = SyntheticStereoSequence(frames=2)
        >>> left, right = sequence.images(1)
        >>> left.shape, left.dtype.name, sequence.depth(1).dtype.name
        ((240, 640), 'uint8', 'float32')
    """

    def __init__(
        self,
        frames: int = 48,
        width: int = 640,
        height: int = 240,
        seed: int = 0,
        *,
        focal_px: float | None = None,
        baseline: float = 0.54,
        lap: bool = False,
        shutter: float = 0.0,
        right_late: float = 0.0,
        stride: int = 1,
        lighting_amplitude: float = 0.0,
        moving_cars: int = 0,
        texture_contrast: float = 1.0,
        noise_gray: float = 1.5,
        supersample: int = 2,
    ):
        for name, value, least in (
            ("frames", frames, 1),
            ("width", width, 16),
            ("height", height, 16),
            ("seed", seed, 0),
            ("stride", stride, 1),
            ("moving_cars", moving_cars, 0),
            ("supersample", supersample, 1),
            ("noise_gray", noise_gray, 0),
            ("texture_contrast", texture_contrast, 0),
            ("baseline", baseline, 0),
            ("shutter", shutter, 0),
            ("right_late", right_late, 0),
        ):
            if value < least:
                raise ValueError(f"{name} is {value}; expected at least {least}")
        focal_px = 0.625 * width if focal_px is None else float(focal_px)
        self.width, self.height, self.seed, self.stride = width, height, seed, stride
        self.name = f"synthetic-{'lap-' if lap else ''}{seed}"
        self.camera = Pinhole(fx=focal_px, fy=focal_px, cx=(width - 1) / 2, cy=(height - 1) / 2)
        self.stereo = RectifiedStereo(self.camera, baseline=baseline)
        self._intrinsics = np.array([focal_px, focal_px, (width - 1) / 2, (height - 1) / 2], np.float32)
        self._baseline = baseline
        self._supersample = supersample
        self._noise = np.float32(noise_gray)
        self._lighting_amplitude = lighting_amplitude
        self._contrast = texture_contrast
        self._moving_cars = moving_cars
        self._shutter = shutter
        self._right_late = right_late

        steps = np.arange(frames) * stride
        self.times = steps * 0.1
        self.frame_names = [f"{step:06d}" for step in steps]
        self._path = _street.make_lap(seed) if lap else _street.make_path(int(steps[-1]) + 1, seed)
        self._street_from_cam = _street.street_from_camera(self._path, steps, seed)
        first_inverse = np.linalg.inv(self._street_from_cam[0])
        self.poses = (first_inverse @ self._street_from_cam)[:, :3, :]
        self.poses[0] = np.eye(4)[:3]
        self._boxes = _street.make_boxes(self._path, seed)
        grid, corner = _street.lane_grid(self._path)
        # A margin of off-road cells, so that a window fits around any camera.
        self._lane = np.stack(
            [np.pad(part, _WINDOW, constant_values=fill) for part, fill in zip(grid, (30.0, 0.0), strict=True)]
        ).astype(np.float32)
        self._lane_corner = corner - _WINDOW * _street.GRID_STEP
        azimuth = np.random.default_rng([seed, 4]).uniform(0, 2 * np.pi)
        elevation = np.deg2rad(48.0)
        self._sun = np.array(
            [np.sin(azimuth) * np.cos(elevation), -np.sin(elevation), np.cos(azimuth) * np.cos(elevation)], np.float32
        )
        self._kept: collections.OrderedDict[int, tuple[np.ndarray, np.ndarray]] = collections.OrderedDict()

    def __len__(self) -> int:
        return len(self.times)

    def images(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Left and right picture of frame `k`, uint8 `[height, width]`; treat them as read-only."""
        k = self._index(k)
        if k not in self._kept:
            key = jax.random.fold_in(jax.random.key(self.seed), k * self.stride)
            pair = tuple(
                _render.render_image(
                    self._exposure(k, eye),
                    jax.random.fold_in(key, eye),
                    self._noise,
                    width=self.width,
                    height=self.height,
                    supersample=self._supersample,
                )
                for eye in (0, 1)
            )
            self._kept[k] = (np.asarray(pair[0]), np.asarray(pair[1]))
            if len(self._kept) > _KEPT_FRAMES:
                self._kept.popitem(last=False)
        return self._kept[k]

    def depth(self, k: int) -> np.ndarray:
        """Exact depth (camera z, metres) through the pixel centres of the left picture of frame `k`; 0 for the sky."""
        k = self._index(k)
        view = self._view(k, 0, self._street_from_cam[k])
        return np.asarray(_render.render_depth(view, width=self.width, height=self.height))

    def _index(self, k: int) -> int:
        if not -len(self) <= k < len(self):
            raise IndexError(f"frame {k} of a sequence of {len(self)}")
        return k % len(self)

    def _scene(self, k: int) -> _street.Boxes:
        """The boxes at the time of frame `k`, moving ones first."""
        if not self._moving_cars:
            return self._boxes
        step = k * self.stride
        geometry, materials = [], []
        for car in range(self._moving_cars):
            rng = np.random.default_rng([self.seed, 5, car])
            here = self._path.distance[step % _street.LAP if self._path.closed else step]
            if car % 2 == 0:
                distance, lateral, turn = here + 9.0 + 5.0 * car + 2.5 * np.sin(2 * np.pi * step / 29 + car), 0.0, 0.0
            else:
                distance, lateral, turn = 20.0 + 22.0 * car - 0.8 * step, -3.5, np.pi
            x, z, heading = self._path.place(distance, lateral)
            for shape, material in _street.car_boxes(x, z, heading + turn, rng):
                geometry.append(shape)
                materials.append((material[0], 400.0 + len(materials), *material[1:]))
        return _street.Boxes(
            np.concatenate([np.array(geometry), self._boxes.geometry]),
            np.concatenate([np.array(materials), self._boxes.materials]),
        )

    def _exposure(self, k: int, eye: int) -> _render.View:
        """What the camera sees while the shutter is open, the middle of which is the frame's time."""
        late = eye * self._right_late
        if not self._shutter and not late:
            return self._view(k, eye, self._street_from_cam[k])
        part = (np.arange(_EXPOSURES) + 0.5) / _EXPOSURES - 0.5 if self._shutter else np.zeros(1)
        poses = _street.street_from_camera(self._path, k * self.stride + late + self._shutter * part, self.seed)
        return jax.tree.map(lambda *x: np.stack(x), *(self._view(k, eye, pose) for pose in poses))

    def _view(self, k: int, eye: int, pose: np.ndarray) -> _render.View:
        rotation, left = pose[:3, :3], pose[:3, 3]
        origin = left + eye * self._baseline * rotation[:, 0]
        scene = self._scene(k)
        chosen = self._choose(scene.geometry, left, rotation[:, 2])
        x, z, yaw, half_x, half_z, top, bottom = scene.geometry[chosen].T
        c, s = np.cos(yaw), -np.sin(yaw)
        dx, dz = origin[0] - x, origin[2] - z
        boxes = np.zeros((_render.MAX_BOXES, 8), np.float32)
        boxes[:, 2] = 1
        boxes[: len(chosen)] = np.stack(
            [c * dx + s * dz, c * dz - s * dx, c, s, half_x, half_z, top - origin[1], bottom - origin[1]], axis=1
        )
        materials = np.ones((_render.MAX_BOXES, scene.materials.shape[1]), np.float32)
        materials[: len(chosen)] = scene.materials[chosen]

        # The window of the lane grid reaches farther ahead than behind.
        middle = (left + 40.0 * rotation[:, 2])[[0, 2]]
        column, row = ((middle - self._lane_corner) / _street.GRID_STEP).astype(int) - _WINDOW // 2
        column = int(np.clip(column, 0, self._lane.shape[2] - _WINDOW))
        row = int(np.clip(row, 0, self._lane.shape[1] - _WINDOW))
        corner = self._lane_corner + np.array([column, row]) * _street.GRID_STEP
        gain = np.exp(self._lighting_amplitude * np.sin(2 * np.pi * k * self.stride / 24))
        return _render.View(
            rotation=rotation.astype(np.float32),
            intrinsics=self._intrinsics,
            boxes=boxes,
            materials=materials,
            ground=np.array([_street.GROUND_Y - origin[1], origin[0], origin[2]], np.float32),
            lane=np.ascontiguousarray(self._lane[:, row : row + _WINDOW, column : column + _WINDOW]),
            lane_origin=np.array([corner[0], corner[1], 1 / _street.GRID_STEP], np.float32),
            sun=self._sun,
            light=np.array([gain, self._contrast], np.float32),
        )

    def _choose(self, geometry: np.ndarray, position: np.ndarray, forward: np.ndarray) -> np.ndarray:
        """The boxes that matter most to a picture: large in the view first, then those near enough to cast a shadow."""
        offset = geometry[:, :2] - position[[0, 2]]
        ahead = offset @ forward[[0, 2]]
        aside = np.abs(offset @ np.array([forward[2], -forward[0]]))
        radius = np.hypot(geometry[:, 3], geometry[:, 4])
        half_view = (self.width / 2) / self._intrinsics[0]
        seen = (ahead + radius > 0) & (aside - 1.2 * radius < (ahead + radius) * half_view + 1.0)
        size = np.hypot(radius, geometry[:, 6] - geometry[:, 5]) / np.maximum(np.hypot(*offset.T) - radius, 1.0)
        score = np.where(seen, size, np.where(ahead > -25, 0.05 * size, -1.0))
        score[: 2 * self._moving_cars] = np.inf
        order = np.argsort(-score, kind="stable")[: _render.MAX_BOXES]
        return order[score[order] > 0]
