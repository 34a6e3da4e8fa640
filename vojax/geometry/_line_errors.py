"""How far the projection of a line is from the line seen in an image."""

import jax.numpy as jnp

from vojax._numerics import safe_divide, safe_sqrt
from vojax._types import Array, ArrayLike, Float
from vojax.cameras import Camera
from vojax.lie import SE3


def line_reprojection_error(
    line_points_world: Float[ArrayLike, "*n 2 3"],
    lines: Float[ArrayLike, "*n 3"],
    camera: Camera,
    cam_from_world: SE3,
) -> Float[Array, "*n 2"]:
    """Signed distances, in pixels, of a line's two projected points from the line seen in the image.

    Args:
        line_points_world: Two points of each line in the world, usually the ends of what was seen.
        lines: The lines in the image, (a, b, c) with a u + b v + c = 0 in pixels, of any scale.
        camera: The camera that made the image.
        cam_from_world: Its pose.

    Returns:
        One distance for each of the two points, positive on the side (a, b) points to.

    Degenerate input: points at or behind the camera give finite residuals; mask them by depth. A line with a = b = 0
        has distance 0 from everything, with gradient 0.

    Differentiability: both modes.
    """
    pixels = camera.project(cam_from_world.apply(line_points_world))
    lines = jnp.asarray(lines)[..., None, :]
    offset = pixels[..., 0] * lines[..., 0] + pixels[..., 1] * lines[..., 1] + lines[..., 2]
    length = safe_sqrt(lines[..., 0] * lines[..., 0] + lines[..., 1] * lines[..., 1])
    return safe_divide(offset, jnp.broadcast_to(length, offset.shape))
