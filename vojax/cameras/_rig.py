"""Several cameras fixed to one another."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Float, Int
from vojax.lie import SE3

from ._protocol import Camera


class Rig(eqx.Module):
    """Cameras of any models, and where each stands in the rig's frame.

    Attributes:
        cameras: One for each view.
        cam_from_rig: Their poses, with one leading axis `[c]`.

    Degenerate input: a camera index out of range gives a finite result that means nothing; mask it.
    Differentiability: that of the camera models and poses, both modes, in all of both.

    Raises:
        ValueError: If there is not one pose for each camera.

    Example:
        >>> import jax.numpy as jnp
        >>> from vojax.cameras import Pinhole
        >>> camera = Pinhole(fx=500.0, fy=500.0, cx=320.0, cy=240.0)
        >>> side_by_side = SE3(jnp.array([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, -0.5, 0, 0]]))
        >>> rig = Rig((camera, camera), side_by_side)
        >>> rig.project(jnp.array([[0.0, 0.0, 5.0], [0.0, 0.0, 5.0]]), jnp.array([0, 1])).tolist()
        [[320.0, 240.0], [270.0, 240.0]]
    """

    cameras: tuple[Camera, ...]
    cam_from_rig: SE3

    def __check_init__(self) -> None:
        """Refuse another number of poses than of cameras."""
        shape = jnp.shape(self.cam_from_rig.wxyz_xyz)
        if len(self.cameras) == 0 or shape != (len(self.cameras), 7):
            raise ValueError(
                f"a rig of {len(self.cameras)} cameras with cam_from_rig of shape {shape}: expected at least one "
                "camera and one pose for each, (c, 7)"
            )

    def into_cameras(self, points_rig: Float[Array, "n 3"], camera_index: Int[ArrayLike, " n"]) -> Float[Array, "n 3"]:
        """Points of the rig's frame in the frames of the cameras that see them."""
        return self._poses(camera_index).apply(points_rig)

    def project(self, points_rig: Float[Array, "n 3"], camera_index: Int[ArrayLike, " n"]) -> Float[Array, "n 2"]:
        """Pixels of points of the rig's frame, each in its own camera."""
        points_cam = self.into_cameras(points_rig, camera_index)
        return self._each(lambda camera: camera.project(points_cam), camera_index)

    def rays(
        self, pixels: Float[Array, "n 2"], camera_index: Int[ArrayLike, " n"]
    ) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        """Where the rays of pixels start, and their unit directions, in the rig's frame."""
        bearings = self._each(lambda camera: camera.unproject(pixels), camera_index)
        rig_from_cam = self._poses(camera_index).inverse()
        return rig_from_cam.translation(), rig_from_cam.rotation().apply(bearings)

    def _poses(self, camera_index: Int[ArrayLike, " n"]) -> SE3:
        index = jnp.clip(jnp.asarray(camera_index), 0, len(self.cameras) - 1)
        return SE3(self.cam_from_rig.wxyz_xyz[index])

    def _each(self, function: Callable[[Camera], Array], camera_index: Int[ArrayLike, " n"]) -> Array:
        """What the observation's own camera gives; every camera is asked for all, as models differ."""
        index = jnp.asarray(camera_index)
        value = function(self.cameras[-1])
        for i, camera in enumerate(self.cameras[:-1]):
            value = jnp.where((index == i)[:, None], function(camera), value)
        return value
