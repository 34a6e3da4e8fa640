"""Matrices of two-view geometry, made from poses and calibrations."""

import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Float
from vojax.cameras import Pinhole
from vojax.lie import SE3


def essential_from_pose(cam1_from_cam0: SE3) -> Float[Array, "3 3"]:
    """The essential matrix E = [t]× R, for which `ray1ᵀ E ray0 = 0`.

    Args:
        cam1_from_cam0: Relative pose: ray1 ~ R ray0 + t / depth.

    Returns:
        The matrix, at the scale of the translation (Frobenius norm √2 |t|).

    Degenerate input: a zero translation gives the zero matrix.

    Differentiability: both modes.

    Example:
        >>> import jax.numpy as jnp
        >>> from vojax.lie import SE3
        >>> forward = SE3(jnp.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
        >>> [[int(entry) for entry in row] for row in essential_from_pose(forward)]
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]]
    """
    r = cam1_from_cam0.rotation().as_matrix()
    t = cam1_from_cam0.translation()
    tx, ty, tz = t[0], t[1], t[2]
    return jnp.stack([ty * r[2] - tz * r[1], tz * r[0] - tx * r[2], tx * r[1] - ty * r[0]])


def _inverse_calibration(camera: Pinhole) -> Float[Array, "3 3"]:
    zero, one = jnp.zeros_like(camera.fx), jnp.ones_like(camera.fx)
    shear = -camera.skew / (camera.fx * camera.fy)
    rows = [
        [1.0 / camera.fx, shear, -camera.cx / camera.fx - shear * camera.cy],
        [zero, 1.0 / camera.fy, -camera.cy / camera.fy],
        [zero, zero, one],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def fundamental_from_essential(
    essential: Float[ArrayLike, "3 3"], camera0: Pinhole, camera1: Pinhole
) -> Float[Array, "3 3"]:
    """The fundamental matrix F = K1⁻ᵀ E K0⁻¹, for which `pixel1ᵀ F pixel0 = 0`.

    Args:
        essential: Essential matrix between the views.
        camera0: Calibration of view 0.
        camera1: Calibration of view 1.

    Returns:
        The matrix, unscaled.

    Differentiability: both modes.
    """
    return _inverse_calibration(camera1).T @ jnp.asarray(essential) @ _inverse_calibration(camera0)


def essential_from_fundamental(
    fundamental: Float[ArrayLike, "3 3"], camera0: Pinhole, camera1: Pinhole
) -> Float[Array, "3 3"]:
    """The essential matrix E = K1ᵀ F K0 of calibrated views; its two singular values are not made equal.

    Args:
        fundamental: Fundamental matrix between the views.
        camera0: Calibration of view 0.
        camera1: Calibration of view 1.

    Returns:
        The matrix, unscaled.

    Differentiability: both modes.
    """
    return camera1.matrix().T @ jnp.asarray(fundamental) @ camera0.matrix()


def projection_matrix(cam_from_world: SE3, camera: Pinhole | None = None) -> Float[Array, "*batch 3 4"]:
    """The 3x4 matrix K [R | t]; without a camera [R | t], which projects to normalized coordinates.

    Args:
        cam_from_world: Pose, or a batch of poses.
        camera: Calibration, the same for all poses.

    Returns:
        Projection matrices.
    """
    extrinsic = cam_from_world.as_matrix()[..., :3, :]
    return extrinsic if camera is None else jnp.einsum("ij,...jk->...ik", camera.matrix(), extrinsic)
