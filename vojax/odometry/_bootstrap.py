"""The first motion of one camera: wait until two views tell it, then find where the frames between were.

Two views give no length, so the first baseline is one unit. They give no motion either while the camera stands, turns
in place or sees everything at infinity: the two-view model that explains the tracks best (an essential matrix, a plane
or a rotation) says which, and a plane leaves two motions that only a third view tells apart.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax._result import Result
from vojax._types import ArrayLike
from vojax.cameras import Camera
from vojax.geometry import decompose_homography
from vojax.lie import SE3
from vojax.robust import RansacOptions, TwoViewModel, estimate_relative_pose, select_two_view_model
from vojax.solvers import homography_dlt

from ._absolute_motion import AbsoluteMotionOptions, absolute_motion
from ._relative_motion import triangulate_pairs
from ._tracks import Features, padded, room_for, shared


@dataclasses.dataclass(frozen=True)
class BootstrapOptions:
    """When two views are enough.

    Attributes:
        min_parallax_rad: Least median angle between the rays of the landmarks.
        min_landmarks: Fewest landmarks to begin with.
        min_share: Share of the first view's features that must still be followed; with less, or with fewer than
            `min_landmarks`, a later view takes its place.
        sigma_px: Standard deviation of a tracked position.
        ransac: The search.
    """

    min_parallax_rad: float = 0.02
    min_landmarks: int = 40
    min_share: float = 0.3
    sigma_px: float = 0.5
    ransac: RansacOptions = RansacOptions(threshold_px=1.0, max_hypotheses=1024, chunk_size=128)


class Start(NamedTuple):
    """Where the camera was since the bootstrap began.

    Attributes:
        poses: `cam0_from_cam` `[m, 4, 4]` of every frame since it began, the newest last; cam0 is the first view, and
            its distance to the newest is 1.
        first: Features of the first view; the frames before it have the identity.
        inliers: Rows of the newest frame's features that agree.
    """

    poses: np.ndarray
    first: Features
    inliers: np.ndarray


class Bootstrap:
    """Collects frames until their first and last tell a motion.

    Args:
        camera: Of `vojax.cameras`.
        options: When they do.
        size: To which features are padded.
        key: Random key.
    """

    def __init__(self, camera: Camera, options: BootstrapOptions, size: int, key: jax.Array):
        self._camera = camera
        self._options = options
        self._size = size
        self._key = key
        self._frames: list[Features] = []  # from the first view on
        self._before = 0  # frames that came before the first view

    def add(self, features: Features) -> Start | None:
        """Take the next frame.

        Returns:
            The poses so far, or None to wait for another frame.
        """
        self._frames.append(features)
        self._size = room_for(len(features.ids), self._size)
        self._choose_first()
        first = self._frames[0]
        rows0, rows1 = shared(first.ids, features.ids)
        if len(self._frames) < 2 or len(rows0) < self._options.min_landmarks:
            return None
        pixels0, pixels1 = first.pixels[rows0], features.pixels[rows1]
        rays0, rays1 = (np.asarray(self._camera.unproject(padded(z, self._size)))[: len(z)] for z in (pixels0, pixels1))
        # Parallax needs at least as much motion of the rays.
        if np.median(np.linalg.norm(rays0 - rays1, axis=1)) < self._options.min_parallax_rad:
            return None
        arrays = [padded(z, self._size) for z in (pixels0, pixels1)]
        quality = padded(features.quality[rows1], self._size)
        mask = np.arange(self._size) < len(rows0)
        self._key, key = jax.random.split(self._key)
        motions, inliers = self._motions(arrays[0], arrays[1], quality, mask, key)
        found = [(*self._judge(motion, arrays[0], arrays[1], inliers), motion) for motion in motions]
        found = [x for x in found if self._enough(x[1], rays0, rays1, x[2])]
        if not found:
            return None
        between = self._frames[1:-1]
        if len(found) > 1 and not between:
            return None
        ids = first.ids[rows0]
        placed = [(motion, good, *self._place(ids, points, good, between)) for points, good, motion in found]
        motion, good, poses, _ = max(placed, key=lambda x: x[-1])
        newest = np.linalg.inv(np.asarray(motion.as_matrix(), np.float64))
        unknown = np.tile(np.eye(4), (self._before + 1, 1, 1))
        return Start(np.concatenate([unknown, poses, newest[None]]), first, rows1[good[: len(rows1)]])

    def _choose_first(self) -> None:
        """Let go of views that share too little with the newest."""
        newest = self._frames[-1]
        while len(self._frames) > 1:
            first = self._frames[0]
            enough = max(self._options.min_share * len(first.ids), self._options.min_landmarks)
            if len(shared(first.ids, newest.ids)[0]) >= enough:
                return
            self._frames.pop(0)
            self._before += 1

    def _motions(
        self, pixels0: np.ndarray, pixels1: np.ndarray, quality: np.ndarray, mask: np.ndarray, key: jax.Array
    ) -> tuple[list[SE3], np.ndarray]:
        """Motions with |t| = 1 that the two views allow, and the tracks that agree with them."""
        views: Any = (pixels0, pixels1, self._camera, self._camera)
        settings: dict[str, Any] = {
            "key": key,
            "options": self._options.ransac,
            "sigma_px": self._options.sigma_px,
            "quality": quality,
            "mask": mask,
        }
        general = estimate_relative_pose(*views, **settings)
        inliers = np.asarray(general.inliers)
        failed = not bool((general.result == Result.success) | (general.result == Result.not_converged))
        # The comparison of models costs three times as much to compile and to run: only where a simpler one may do.
        if not failed and not bool(_on_a_plane(pixels0, pixels1, inliers, self._camera, self._options)):
            return [general.model], inliers
        found = select_two_view_model(*views, **settings)
        if bool(found.model == TwoViewModel.general):
            return [found.relative_pose.model], np.asarray(found.relative_pose.inliers)
        if bool(found.model == TwoViewModel.planar):
            inliers = found.homography.inliers
            rays0 = self._camera.unproject(jnp.asarray(pixels0))
            allowed = decompose_homography(found.homography.model, rays0, inliers)
            matrices = np.asarray(allowed.cam1_from_cam0.as_matrix())[np.asarray(allowed.valid)]
            lengths = np.linalg.norm(matrices[:, :3, 3], axis=1)
            matrices, lengths = matrices[lengths > 0], lengths[lengths > 0]
            matrices[:, :3, 3] /= lengths[:, None]
            return [SE3.from_matrix(jnp.asarray(matrix)) for matrix in matrices], np.asarray(inliers)
        return [], np.zeros(self._size, bool)

    def _judge(
        self, motion: SE3, pixels0: np.ndarray, pixels1: np.ndarray, inliers: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        points, valid = _triangulate(motion, jnp.asarray(pixels0), jnp.asarray(pixels1), self._camera, self._options)
        return np.asarray(points), np.asarray(valid) & inliers

    def _enough(self, good: np.ndarray, rays0: np.ndarray, rays1: np.ndarray, motion: SE3) -> bool:
        good = good[: len(rays0)]
        if np.sum(good) < self._options.min_landmarks:
            return False
        rotation = np.asarray(motion.rotation().as_matrix())
        angle = np.linalg.norm(np.cross(rays0[good] @ rotation.T, rays1[good]), axis=1)
        return bool(np.median(angle) >= self._options.min_parallax_rad)

    def _place(
        self, ids: np.ndarray, points: np.ndarray, good: np.ndarray, frames: list[Features]
    ) -> tuple[np.ndarray, int]:
        """`cam0_from_cam` of frames by the new landmarks, and how many of these agree in all."""
        poses, total, guess = [], 0, SE3.identity()
        known = ids[good[: len(ids)]]
        where = points[: len(ids)][good[: len(ids)]]
        for k, frame in enumerate(frames):
            rows0, rows1 = shared(known, frame.ids)
            motion = absolute_motion(
                jnp.asarray(padded(where[rows0], self._size)),
                jnp.zeros((self._size, 3, 3), jnp.float32),
                jnp.asarray(padded(frame.pixels[rows1], self._size)),
                jnp.arange(self._size) < len(rows0),
                jnp.ones(self._size, jnp.float32),
                guess,
                self._camera,
                jax.random.fold_in(self._key, k),
                AbsoluteMotionOptions(sigma_px=self._options.sigma_px),
            )
            guess = motion.cam1_from_cam0
            total += int(motion.num_inliers)
            poses.append(np.linalg.inv(np.asarray(guess.as_matrix(), np.float64)))
        return np.array(poses).reshape(-1, 4, 4), total


@eqx.filter_jit
def _triangulate(motion: SE3, pixels0: jax.Array, pixels1: jax.Array, camera: Camera, options: BootstrapOptions):
    views = SE3(jnp.stack([SE3.identity(dtype=pixels0.dtype).wxyz_xyz, motion.wxyz_xyz]))
    points, _, valid = triangulate_pairs(pixels0, pixels1, views, camera, options.sigma_px)
    return points, valid


@eqx.filter_jit
def _on_a_plane(
    pixels0: ArrayLike, pixels1: ArrayLike, inliers: ArrayLike, camera: Camera, options: BootstrapOptions
) -> jax.Array:
    """Whether one homography moves the inliers to within three deviations: a plane, or a camera that turned."""
    pixels0, pixels1, inliers = map(jnp.asarray, (pixels0, pixels1, inliers))
    rays0, rays1 = camera.unproject(pixels0), camera.unproject(pixels1)
    ahead = inliers & (rays0[:, 2] > 0.1) & (rays1[:, 2] > 0.1)
    plane0, plane1 = (
        jnp.where(ahead[:, None], r[:, :2] / jnp.where(ahead, r[:, 2], 1.0)[:, None], 0.0) for r in (rays0, rays1)
    )
    homography = homography_dlt(plane0, plane1, ahead.astype(pixels0.dtype))
    moved = jnp.sum(
        homography.models[0][None] * jnp.concatenate([plane0, jnp.ones_like(plane0[:, :1])], axis=1)[:, None], axis=2
    )
    error = camera.project(moved * jnp.where(moved[:, 2:] < 0, -1.0, 1.0)) - pixels1
    square = jnp.where(ahead, jnp.sum(error * error, axis=1), 0.0)
    mean = jnp.sum(square) / jnp.maximum(jnp.sum(ahead), 1)
    return homography.valid[0] & (mean < 2.0 * (3.0 * options.sigma_px) ** 2)
