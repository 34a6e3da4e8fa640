"""What a calibration file holds: named cameras, their image sizes, and how they stand to each other."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from vojax.lie import SE3

from ._protocol import Camera
from ._rig import Rig

# Compiled whole: step by step, each operation would be compiled on its own.
_poses_of_matrices = jax.jit(SE3.from_matrix)
_matrices_of_poses = jax.jit(lambda poses: poses.as_matrix())


def poses_of(matrices: Sequence[np.ndarray]) -> SE3:
    """Poses `[c]` of 4x4 matrices, in JAX's default precision."""
    return _poses_of_matrices(jnp.asarray(np.stack(matrices)))


def matrices_of(poses: SE3) -> np.ndarray:
    """The 4x4 matrices of poses, in double precision."""
    return np.asarray(_matrices_of_poses(poses), np.float64)


@dataclasses.dataclass(frozen=True)
class CameraSet:
    """Cameras as a file names them.

    Attributes:
        cameras: By name, in the file's order.
        sizes: Width and height of their images in pixels, of those that are known.
        cam_from_rig: Poses `[c]` in the same order; None where the file does not tell.

    Raises:
        ValueError: If there is no camera, one holds several, a size belongs to none or is not positive, or there is not
            one pose for each.

    Example:
        >>> from vojax.cameras import Pinhole
        >>> CameraSet({"cam0": Pinhole(500.0, 500.0, 320.0, 240.0)}, {"cam0": (640, 480)})["cam0"].fx.item()
        500.0
    """

    cameras: dict[str, Camera]
    sizes: dict[str, tuple[int, int]] = dataclasses.field(default_factory=dict)
    cam_from_rig: SE3 | None = None

    def __post_init__(self) -> None:
        if not self.cameras:
            raise ValueError("a set of cameras without a camera: expected at least one")
        for name, camera in self.cameras.items():
            if any(jnp.ndim(leaf) for leaf in jax.tree.leaves(camera)):
                raise ValueError(f"camera {name!r} has parameters that are arrays: expected one number for each")
        for name, size in self.sizes.items():
            if name not in self.cameras:
                raise ValueError(f"an image size for camera {name!r}: expected one of {', '.join(self.cameras)}")
            if len(size) != 2 or min(size) < 1:
                raise ValueError(f"camera {name!r} has image size {size}: expected (width, height), both positive")
        if self.cam_from_rig is not None and jnp.shape(self.cam_from_rig.wxyz_xyz) != (len(self.cameras), 7):
            raise ValueError(
                f"{len(self.cameras)} cameras with poses of shape {jnp.shape(self.cam_from_rig.wxyz_xyz)}: expected "
                f"({len(self.cameras)}, 7)"
            )

    def __getitem__(self, name: str) -> Camera:
        """The camera of a name."""
        return self.cameras[name]

    def pose(self, name: str) -> SE3 | None:
        """`cam_from_rig` of one camera; None where it is not known."""
        if self.cam_from_rig is None:
            return None
        return SE3(jnp.asarray(np.asarray(self.cam_from_rig.wxyz_xyz)[list(self.cameras).index(name)]))

    def rig(self) -> Rig:
        """The cameras as a rig.

        Raises:
            ValueError: If their poses are not known. A single camera is a rig whose frame is its own.
        """
        poses = self.cam_from_rig
        if poses is None:
            if len(self.cameras) > 1:
                raise ValueError(f"the poses of cameras {', '.join(self.cameras)} are not known: expected cam_from_rig")
            poses = SE3.identity((1,))
        return Rig(tuple(self.cameras.values()), poses)
