"""The last keyframes and the landmarks they share, adjusted together.

Host-side bookkeeping around `vojax.ba.adjust_window`: keyframes come and go, the arrays keep their shape.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vojax._result import Result
from vojax._types import Array, ArrayLike, Float
from vojax.ba import GemanMcClure, LMOptions, Window, adjust_window
from vojax.cameras import RectifiedStereo
from vojax.lie import SE3

from ._motion import measurement_covariance
from ._rectification import corrected


@dataclasses.dataclass(frozen=True)
class WindowOptions:
    """Size and noise of the sliding window.

    Attributes:
        keyframes: How many are adjusted together.
        max_landmarks: Most landmarks, those seen most often first.
        sigma_px: Standard deviation of a tracked position.
        max_steps: Most steps of Levenberg–Marquardt.
    """

    keyframes: int = 6
    max_landmarks: int = 512
    sigma_px: float = 0.25
    max_steps: int = 12


class Keyframe(NamedTuple):
    """A keyframe: pose and raw stereo measurements by landmark id."""

    world_from_cam: np.ndarray
    ids: np.ndarray
    measurements: np.ndarray  # [n, 3]: u_left, v, u_right
    sigma_disparity: np.ndarray  # 0 where the right image had no match


class SlidingWindow:
    """Keeps the last keyframes and adjusts them when one is added."""

    def __init__(self, stereo: RectifiedStereo, options: WindowOptions):
        self._stereo = stereo
        self._options = options
        self._keyframes: list[Keyframe] = []

    @property
    def newest(self) -> Keyframe | None:
        """The last keyframe."""
        return self._keyframes[-1] if self._keyframes else None

    def clear(self) -> None:
        """Forget all keyframes: after a break in the tracks nothing connects them."""
        self._keyframes = []

    def add(self, keyframe: Keyframe, offsets: Float[Array, "2"], adjust: bool) -> np.ndarray:
        """Add a keyframe and adjust the window.

        Args:
            keyframe: The new one.
            offsets: Disparity error (a₀, a₁) to take out of all measurements.
            adjust: False only keeps the books.

        Returns:
            The new keyframe's `world_from_cam` [4, 4], adjusted.
        """
        self._keyframes = [*self._keyframes, keyframe][-self._options.keyframes :]
        if adjust and len(self._keyframes) >= 2:
            self._adjust(offsets)
        return self._keyframes[-1].world_from_cam

    def _adjust(self, offsets: Float[Array, "2"]) -> None:
        c, p = self._options.keyframes, self._options.max_landmarks
        frames = self._keyframes
        ids, counts = np.unique(np.concatenate([frame.ids for frame in frames]), return_counts=True)
        shared = counts >= 2
        order = np.argsort(-counts[shared], kind="stable")[:p]
        landmarks = np.sort(ids[shared][order])
        if len(landmarks) < 10:
            return
        measurements, sigma = np.zeros((c, p, 3), np.float32), np.ones((c, p), np.float32)
        mask, matched = np.zeros((c, p), bool), np.zeros((c, p), bool)
        anchor = np.linalg.inv(frames[0].world_from_cam)
        poses = np.tile(np.eye(4), (c, 1, 1))
        for i, frame in enumerate(frames):
            poses[i] = anchor @ frame.world_from_cam
            found, rows, columns = np.intersect1d(frame.ids, landmarks, assume_unique=True, return_indices=True)
            del found
            measurements[i, columns] = frame.measurements[rows]
            mask[i, columns] = True
            matched[i, columns] = frame.sigma_disparity[rows] > 0
            sigma[i, columns] = np.where(matched[i, columns], frame.sigma_disparity[rows], 1.0)
        # A landmark that no keyframe has matched in the right image has no place to start from.
        mask &= np.any(matched, axis=0, keepdims=True)
        fixed = ~np.any(mask, axis=1)  # padding, and keyframes that share nothing with the others
        fixed[0] = True
        window = _adjust(
            SE3.from_matrix(jnp.asarray(poses, jnp.float32)), measurements, sigma, mask, matched, fixed, offsets,
            self._stereo, self._options,
        )  # fmt: skip
        if not bool((window.result == Result.success) | (window.result == Result.not_converged)):
            return
        adjusted = np.asarray(window.world_from_cam.as_matrix(), np.float64)
        for i, frame in enumerate(frames):
            # Stay on the manifold: float32 poses leave it by rounding, and thousands of them are chained.
            pose = frames[0].world_from_cam @ adjusted[i]
            frames[i] = frame._replace(world_from_cam=orthonormal(pose))


def orthonormal(pose: np.ndarray) -> np.ndarray:
    """The rigid motion nearest to a 4 × 4 matrix."""
    u, _, vt = np.linalg.svd(pose[:3, :3])
    pose = pose.copy()
    pose[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return pose


@eqx.filter_jit
def _adjust(
    poses: SE3,
    measurements: ArrayLike,
    sigma: ArrayLike,
    mask: ArrayLike,
    matched: ArrayLike,
    fixed: ArrayLike,
    offsets: Array,
    stereo: RectifiedStereo,
    options: WindowOptions,
) -> Window:
    sigma, mask, matched = jnp.asarray(sigma), jnp.asarray(mask), jnp.asarray(matched)
    measurements = corrected(jnp.asarray(measurements), offsets, stereo)
    # Landmarks start where the first keyframe that matched them saw them.
    first = jnp.argmax(matched, axis=0)
    start = measurements[first, jnp.arange(measurements.shape[1])]
    points = SE3(poses.wxyz_xyz[first]).apply(stereo.unproject(start))
    # Without a match the right column carries no information: a vast sigma about the starting point's own prediction.
    predicted = stereo.project(SE3(poses.inverse().wxyz_xyz[:, None]).apply(points[None]))
    right = measurements[..., 0] - (predicted[..., 0] - predicted[..., 2])
    measurements = measurements.at[..., 2].set(jnp.where(matched, measurements[..., 2], right))
    measurements = jnp.where(mask[..., None], measurements, 0.0)
    covariance = measurement_covariance(options.sigma_px, jnp.where(matched, sigma, 100.0))
    return adjust_window(
        poses,
        points,
        measurements,
        mask,
        stereo,
        sigma_px=covariance,
        fixed=jnp.asarray(fixed),
        loss=GemanMcClure(2.0),
        options=LMOptions(max_steps=options.max_steps),
    )
