"""Stereo rectification: where each pixel of a pair with parallel image planes comes from.

Both cameras turn by half their relative rotation, towards each other, and then together so that the baseline is the x
axis, which is the least distortion. The maps hold, for every rectified pixel, the pixel of the camera to look at.

Reference: Bradski & Kaehler, "Learning OpenCV", 2008, chapter 12 (Bouguet's algorithm).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.core import Tracer

from vojax._numerics import normalize, safe_norm
from vojax._types import Array, Bool, Float
from vojax.lie import SE3, SO3

from ._components import onto_cone
from ._pinhole import Pinhole
from ._protocol import Camera
from ._stereo import RectifiedStereo


class Rectification(NamedTuple):
    """A rectified pair and the way to it.

    Attributes:
        stereo: The pair: two equal pinholes side by side. Points live in the rectified left camera's frame.
        rect_from_cam: Rotations from the cameras' frames to that frame, one leading axis `[2]`.
        maps: Pixel (u, v) of the original image for each rectified pixel, of the left and the right camera.
        valid: False where the original image has nothing to show there.
    """

    stereo: RectifiedStereo
    rect_from_cam: SO3
    maps: Float[Array, "2 h w 2"]
    valid: Bool[Array, "2 h w"]


def rectification_maps(
    camera0: Camera,
    camera1: Camera,
    cam1_from_cam0: SE3,
    size: tuple[int, int],
    *,
    rectified: Pinhole | None = None,
    rectified_size: tuple[int, int] | None = None,
) -> Rectification:
    """Rectify a stereo pair of any two camera models.

    Args:
        camera0: The left camera.
        camera1: The right camera.
        cam1_from_cam0: Its pose; the translation's unit is that of the rectified pair's baseline.
        size: Width and height of both images, in pixels.
        rectified: Intrinsics of the rectified pair. None keeps the smaller of the two resolutions at the image centres
            and centres the two views.
        rectified_size: Width and height of the rectified images; None for `size`.

    Returns:
        The rectified pair, rotations, maps and masks, in the dtype of `cam1_from_cam0`.

    Degenerate input: without a baseline the x axis of the half-way frame takes its place.
    Differentiability: both modes, in cameras and pose.

    Raises:
        ValueError: If a size is not positive, or if the right camera stands to the left of or above the left one (then
            swap the cameras, or turn the images).

    Example:
        >>> import jax.numpy as jnp
        >>> camera = Pinhole(fx=100.0, fy=100.0, cx=31.5, cy=23.5)
        >>> beside = SE3(jnp.array([1.0, 0, 0, 0, -0.1, 0, 0]))
        >>> pair = rectification_maps(camera, camera, beside, (64, 48))
        >>> pair.maps[1, 10, 20].round(4).tolist(), round(float(pair.stereo.baseline), 3)
        ([20.0, 10.0], 0.1)
    """
    rectified_size = size if rectified_size is None else rectified_size
    for given in (size, rectified_size):
        if len(given) != 2 or min(given) < 1:
            raise ValueError(f"image size {given}: expected (width, height) in pixels, both positive")
    rect_from_cam0, rect_from_cam1, baseline = _rotations(cam1_from_cam0)
    rotations = (rect_from_cam0, rect_from_cam1)
    if rectified is None:
        rectified = _common_pinhole((camera0, camera1), rotations, size, rectified_size)
    width, height = rectified_size
    dtype = baseline.dtype
    pixels = jnp.stack(jnp.meshgrid(jnp.arange(width, dtype=dtype), jnp.arange(height, dtype=dtype)), axis=-1)
    rays = rectified.unproject(pixels)
    last = jnp.asarray(size, dtype) - 1.0
    maps, valid = [], []
    for camera, rect_from_cam in zip((camera0, camera1), rotations, strict=True):
        rays_cam = rect_from_cam.inverse().apply(rays)
        source = camera.project(rays_cam)
        shown = jnp.all((source >= 0.0) & (source <= last.reshape(1, 1, 2)), axis=-1)
        maps.append(source)
        valid.append(shown & camera.in_domain(rays_cam))
    both = SO3(jnp.stack([rotation.wxyz for rotation in rotations]))
    return Rectification(RectifiedStereo(rectified, baseline), both, jnp.stack(maps), jnp.stack(valid))


def _rotations(cam1_from_cam0: SE3) -> tuple[SO3, SO3, Array]:
    """The rotations from each camera's frame to the rectified one, and the baseline."""
    half = 0.5 * cam1_from_cam0.rotation().log()
    middle_from_cam0, middle_from_cam1 = SO3.exp(half), SO3.exp(-half)
    # From camera 0's centre to camera 1's, in the axes half-way between them.
    offset = -middle_from_cam1.apply(cam1_from_cam0.translation())
    if not isinstance(offset, Tracer):
        x, y, z = (float(component) for component in offset)
        if x < 0 or x * x < y * y:
            raise ValueError(
                f"the right camera is at ({x:.3g}, {y:.3g}, {z:.3g}) from the left one, half-way rotated: expected it "
                "on the right; swap the cameras, or turn the images of a vertical pair"
            )
    x, y, z = normalize(offset)
    # The shortest rotation that takes the offset to the x axis: about (0, z, −y), by atan2 of its length and x.
    sine = safe_norm(jnp.stack([y, z]))
    angle_over_sine = jnp.where(sine > 0, jnp.arctan2(sine, x) / jnp.where(sine > 0, sine, 1.0), 1.0)
    rect_from_middle = SO3.exp(angle_over_sine * jnp.stack([jnp.zeros_like(z), z, -y]))
    return rect_from_middle @ middle_from_cam0, rect_from_middle @ middle_from_cam1, safe_norm(offset)


def _common_pinhole(
    cameras: tuple[Camera, Camera], rotations: tuple[SO3, SO3], size: tuple[int, int], rectified_size: tuple[int, int]
) -> Pinhole:
    """A pinhole with the resolution that the cameras have at their image centres, which it has in its middle."""
    dtype = rotations[0].wxyz.dtype
    centre = 0.5 * (jnp.asarray(size, dtype) - 1.0)
    focal, seen = [], []
    for camera, rect_from_cam in zip(cameras, rotations, strict=True):
        bearing = camera.unproject(centre)
        jacobian = jax.jacfwd(camera.project)(bearing)
        # Area of the image that a unit of solid angle covers: the derivative on the plane normal to the ray.
        normal = jnp.cross(jacobian[0], jacobian[1])
        focal.append(jnp.sqrt(jnp.abs(jnp.dot(normal, bearing))))
        seen.append(jnp.stack(onto_cone(*rect_from_cam.apply(bearing))))
    f = jnp.minimum(*focal)
    middle = 0.5 * (jnp.asarray(rectified_size, dtype) - 1.0)
    cx, cy = middle - f * 0.5 * (seen[0] + seen[1])
    return Pinhole(fx=f, fy=f, cx=cx, cy=cy)
