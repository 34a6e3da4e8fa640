"""Unrectified stereo pairs, of any two camera models, for the stereo pipelines."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vojax._types import Array, Float
from vojax.cameras import Camera, RectifiedStereo, rectification_maps
from vojax.features import remap, to_gray
from vojax.lie import SE3


class PairRectifier:
    """Turns the images of an unrectified pair into those of a rectified one.

    Args:
        camera0: The left camera, distortion included.
        camera1: The right one; any other model.
        cam1_from_cam0: Its pose, translation in metres.
        size: Width and height of both images, pixels.

    Attributes:
        stereo: The rectified pair, for `StereoOdometry`.
        rect_from_cam0: Rotation `[3, 3]` from the left camera's frame to the rectified one.
        size: Width and height of the images, before and after.

    Raises:
        ValueError: A size that is not positive, or a right camera to the left of or above the left one.

    Example:
        >>> import jax.numpy as jnp
        >>> from vojax.cameras import Pinhole
        >>> camera = Pinhole(fx=100.0, fy=100.0, cx=31.5, cy=23.5)
        >>> rectify = PairRectifier(camera, camera, SE3(jnp.array([1.0, 0, 0, 0, -0.1, 0, 0])), (64, 48))
        >>> image = np.arange(64 * 48, dtype=np.uint8).reshape(48, 64)
        >>> left, right = rectify(image, image)
        >>> left.shape, round(float(rectify.stereo.baseline), 3)
        ((48, 64), 0.1)
    """

    stereo: RectifiedStereo
    rect_from_cam0: np.ndarray
    size: tuple[int, int]

    def __init__(self, camera0: Camera, camera1: Camera, cam1_from_cam0: SE3, size: tuple[int, int]):
        rectification = rectification_maps(camera0, camera1, cam1_from_cam0, size)
        self.size = (int(size[0]), int(size[1]))
        self.stereo = rectification.stereo
        self.rect_from_cam0 = np.asarray(rectification.rect_from_cam.as_matrix()[0], np.float64)
        self._maps = [np.asarray(one, np.float32) for one in rectification.maps]
        self._camera0, self._cam0_from_rect = camera0, jnp.asarray(self.rect_from_cam0.T, jnp.float32)

    def __call__(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rectify a pair of images.

        Args:
            left: uint8 image of the left camera, grey or RGB.
            right: Of the right one.

        Returns:
            Both rectified, grey.

        Raises:
            ValueError: An image of another size than the calibration is for.
        """
        images = []
        for name, image, source in zip(("left", "right"), (left, right), self._maps, strict=True):
            gray = to_gray(image)
            if gray.shape != self.size[::-1]:
                raise ValueError(
                    f"the {name} image is {gray.shape[1]}×{gray.shape[0]} px: expected {self.size[0]}×{self.size[1]}, "
                    "the size of its calibration"
                )
            images.append(remap(gray, source))
        return images[0], images[1]

    def pose_of_left(self, world_from_rect: np.ndarray) -> np.ndarray:
        """A pose `[4, 4]` of the rectified pair as that of the left camera; the first of either is the world."""
        turn = np.eye(4)
        turn[:3, :3] = self.rect_from_cam0
        return turn.T @ world_from_rect @ turn

    def pixels_of_left(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels `[n, 2]` of the rectified left image in the image as it was taken."""
        # Padded, so that one program serves every number of them.
        padded = np.zeros((-(-max(len(pixels), 1) // 1024) * 1024, 2), np.float32)
        padded[: len(pixels)] = pixels
        seen = _seen_by(jnp.asarray(padded), self.stereo, self._cam0_from_rect, self._camera0)
        return np.asarray(seen)[: len(pixels)]


@eqx.filter_jit
def _seen_by(
    pixels: Float[Array, "n 2"], stereo: RectifiedStereo, cam_from_rect: Float[Array, "3 3"], camera: Camera
) -> Float[Array, "n 2"]:
    rays = stereo.camera.unproject(pixels)
    return camera.project((cam_from_rect[None] * rays[:, None, :]).sum(axis=2))
