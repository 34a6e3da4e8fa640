"""Triangulation in a rectified stereo pair, with its covariance."""

import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Float
from vojax.cameras import RectifiedStereo


def triangulate_rectified(
    measurement: Float[ArrayLike, "3"],
    stereo: RectifiedStereo,
    sigma_px: float | Float[ArrayLike, ""] = 1.0,
    *,
    covariance_px: Float[ArrayLike, "3 3"] | None = None,
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Point and covariance of one rectified stereo measurement.

    Args:
        measurement: `(u_left, v, u_right)` in pixels.
        stereo: The calibrated pair.
        sigma_px: Standard deviation of each of the three coordinates.
        covariance_px: Covariance of the measurement in px²; takes the place of `sigma_px`.

    Returns:
        The point in the left camera's frame (unit of the baseline), and its first-order covariance. The depth's
        standard deviation grows with its square: √2 sigma_px z² / (fx baseline).

    Degenerate input: a disparity below 1e-3 px counts as that; the point is far and its covariance vast, both finite.

    Differentiability: both modes.

    Example:
        >>> import jax.numpy as jnp
        >>> from vojax.cameras import Pinhole
        >>> stereo = RectifiedStereo(Pinhole(fx=500.0, fy=500.0, cx=320.0, cy=240.0), baseline=0.5)
        >>> point, covariance = triangulate_rectified(jnp.array([570.0, 240.0, 445.0]), stereo)
        >>> point.tolist()
        [1.0, 0.0, 2.0]
    """
    m = jnp.asarray(measurement)
    camera = stereo.camera
    x, y, z = stereo.unproject_xyz(m[0], m[1], m[2])
    disparity = camera.fx * stereo.baseline / z
    zero = jnp.zeros_like(z)
    # z falls with u_left and rises with u_right; x and y follow their ray.
    slope = z / disparity
    column_left = [z / camera.fx - x / disparity, -y / disparity, -slope]
    column_v = [-camera.skew * z / (camera.fx * camera.fy), z / camera.fy, zero]
    column_right = [x / disparity, y / disparity, slope]
    jacobian = jnp.stack([jnp.stack(column) for column in (column_left, column_v, column_right)], axis=1)
    if covariance_px is None:
        covariance = (jacobian @ jacobian.T) * jnp.asarray(sigma_px, jacobian.dtype) ** 2
    else:
        covariance = jacobian @ jnp.asarray(covariance_px) @ jacobian.T
    return jnp.stack([x, y, z]), 0.5 * (covariance + covariance.T)
