"""The last keyframes of one camera and the landmarks between them: triangulated, and adjusted together.

There is no other map: a landmark is what the keyframes of the window tell of a track. The two oldest keyframes hold the
gauge, scale included.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax._result import Result
from vojax._types import Array, ArrayLike
from vojax.ba import GemanMcClure, LMOptions, adjust_window
from vojax.cameras import Camera
from vojax.geometry import TriangulationOptions, triangulate_rays, triangulate_refine
from vojax.lie import SE3

from ._sliding_window import orthonormal
from ._tracks import shared


@dataclasses.dataclass(frozen=True)
class MonoWindowOptions:
    """Size and noise of the window, and what makes a landmark.

    Attributes:
        keyframes: How many there are.
        max_landmarks: Most landmarks, those seen most often first.
        sigma_px: Standard deviation of a tracked position.
        max_rms_px: Largest reprojection error of a landmark, root mean square over the keyframes.
        min_angle_rad: Least angle between two of a landmark's rays.
        max_relative_std: Largest standard deviation of a landmark over its distance.
        max_steps: Most steps of Levenberg–Marquardt.
    """

    keyframes: int = 8
    max_landmarks: int = 512
    sigma_px: float = 0.3
    max_rms_px: float = 1.5
    min_angle_rad: float = 0.005
    max_relative_std: float = 0.2
    max_steps: int = 10


class MonoKeyframe(NamedTuple):
    """A keyframe: pose, and where it sees which track."""

    world_from_cam: np.ndarray
    ids: np.ndarray
    pixels: np.ndarray


class Landmarks(NamedTuple):
    """Triangulated tracks.

    Attributes:
        ids: Of the tracks, increasing.
        points: `[n, 3]`, world frame, float64.
        covariances: `[n, 3, 3]`, given the poses.
    """

    ids: np.ndarray
    points: np.ndarray
    covariances: np.ndarray

    @classmethod
    def none(cls) -> "Landmarks":
        """Before any keyframe."""
        return cls(np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros((0, 3, 3)))


class MonoWindow:
    """Keeps the last keyframes, and the landmarks that they tell.

    Args:
        camera: A camera of `vojax.cameras`.
        options: Size, noise and thresholds.
    """

    def __init__(self, camera: Camera, options: MonoWindowOptions):
        self._camera = camera
        self._options = options
        self._keyframes: list[MonoKeyframe] = []
        self.landmarks = Landmarks.none()

    @property
    def newest(self) -> MonoKeyframe | None:
        """The last keyframe."""
        return self._keyframes[-1] if self._keyframes else None

    def clear(self) -> None:
        """Forget everything: after a break nothing connects old and new."""
        self._keyframes, self.landmarks = [], Landmarks.none()

    def add(self, keyframe: MonoKeyframe, adjust: bool) -> np.ndarray:
        """Add a keyframe, triangulate what its tracks tell, and adjust the window.

        Args:
            keyframe: The new one, its tracks free of gross errors.
            adjust: False triangulates alone and leaves the poses as they are.

        Returns:
            The new keyframe's `world_from_cam` [4, 4].
        """
        self._keyframes = [*self._keyframes, keyframe][-self._options.keyframes :]
        if len(self._keyframes) >= 2:
            self._update(adjust)
        return self._keyframes[-1].world_from_cam

    def _update(self, adjust: bool) -> None:
        c, p = self._options.keyframes, self._options.max_landmarks
        frames = self._keyframes
        ids, counts = np.unique(np.concatenate([frame.ids for frame in frames]), return_counts=True)
        # Of equally long tracks those that are still followed serve longer.
        rank = counts + 0.5 * np.isin(ids, frames[-1].ids)
        order = np.argsort(-rank, kind="stable")[:p]
        order = order[counts[order] >= 2]
        landmarks = np.sort(ids[order])
        pixels, mask = np.zeros((c, p, 2), np.float32), np.zeros((c, p), bool)
        anchor = np.linalg.inv(frames[0].world_from_cam)
        poses = np.tile(np.eye(4), (c, 1, 1))
        for i, frame in enumerate(frames):
            poses[i] = anchor @ frame.world_from_cam
            rows, columns = shared(frame.ids, landmarks)
            pixels[i, columns], mask[i, columns] = frame.pixels[rows], True
        start, known = np.zeros((p, 3), np.float32), np.zeros(p, bool)
        rows, columns = shared(self.landmarks.ids, landmarks)
        start[columns] = self.landmarks.points[rows] @ anchor[:3, :3].T + anchor[:3, 3]
        known[columns] = True
        fixed = np.arange(c) >= len(frames)
        fixed[:2] = True
        found = _update(
            SE3.from_matrix(jnp.asarray(poses, jnp.float32)), start, known, pixels, mask, fixed, self._camera,
            self._options, adjust,
        )  # fmt: skip
        adjusted, points, covariances, valid = jax.tree.map(lambda x: np.asarray(x, np.float64), found)
        world_from_anchor = frames[0].world_from_cam
        if adjust:
            for i, frame in enumerate(frames):
                # Stay on the manifold: float32 poses leave it by rounding, and thousands of them are chained.
                frames[i] = frame._replace(world_from_cam=orthonormal(world_from_anchor @ adjusted[i]))
        kept = np.flatnonzero(valid[: len(landmarks)])
        rotation = world_from_anchor[:3, :3]
        self.landmarks = Landmarks(
            landmarks[kept],
            points[kept] @ rotation.T + world_from_anchor[:3, 3],
            rotation @ covariances[kept] @ rotation.T,
        )


@eqx.filter_jit
def _update(
    world_from_cam: SE3,
    start: ArrayLike,
    known: ArrayLike,
    pixels: ArrayLike,
    mask: ArrayLike,
    fixed: ArrayLike,
    camera: Camera,
    options: MonoWindowOptions,
    adjust: bool,
) -> tuple[Array, Array, Array, Array]:
    """Poses as matrices, points, their covariances, and which points can be trusted."""
    start, known, pixels, mask = map(jnp.asarray, (start, known, pixels, mask))
    by_point, seen = jnp.swapaxes(pixels, 0, 1), mask.T
    limits = TriangulationOptions(min_angle_rad=options.min_angle_rad, max_relative_std=options.max_relative_std)

    def triangulated(poses: SE3, start: Array) -> tuple[Array, Array, Array]:
        cam_from_world = poses.inverse()
        found = jax.vmap(
            lambda point, z, used: triangulate_refine(
                point, z, camera, cam_from_world, options.sigma_px, mask=used, options=limits
            )
        )(start, by_point, seen)
        return found.point, found.covariance, found.valid & (found.rms_px < options.max_rms_px)

    bearings = SE3(world_from_cam.wxyz_xyz[:, None]).rotation().apply(camera.unproject(pixels))
    centers = world_from_cam.translation()
    linear = jax.vmap(lambda b, used: triangulate_rays(centers, b, mask=used))(jnp.swapaxes(bearings, 0, 1), seen)
    points, covariances, valid = triangulated(world_from_cam, jnp.where(known[:, None], start, linear))
    if not adjust:
        return world_from_cam.as_matrix(), points, covariances, valid
    used = mask & valid[None, :]
    window = adjust_window(
        world_from_cam,
        points,
        jnp.where(used[..., None], pixels, 0.0),
        used,
        camera,
        sigma_px=options.sigma_px,
        fixed=jnp.asarray(fixed) | ~jnp.any(used, axis=1),
        loss=GemanMcClure(3.0),
        options=LMOptions(max_steps=options.max_steps),
    )
    better = (window.result == Result.success) | (window.result == Result.not_converged)
    poses = SE3(jnp.where(better, window.world_from_cam.wxyz_xyz, world_from_cam.wxyz_xyz))
    points, covariances, valid = triangulated(poses, jnp.where(better, window.points_world, points))
    return poses.as_matrix(), points, covariances, valid
