"""Focal length and rotation from vanishing points of orthogonal directions.

The vanishing point of a direction d is v ~ K R d. For a camera with square pixels and principal point c, two
orthogonal directions give

    (v0 − c)·(v1 − c) + f² = 0,                                                                                    (1)

and with a third one c is the orthocentre of the triangle of vanishing points. The bearings of the vanishing points are
then the columns of the rotation.

References: Caprile & Torre, "Using vanishing points for camera calibration", IJCV 1990; Hartley & Zisserman, section
8.8.
"""

from typing import NamedTuple

import jax.numpy as jnp

from vojax._numerics import safe_divide, safe_norm, safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SO3


class VanishingCalibration(NamedTuple):
    """A camera from vanishing points.

    Attributes:
        focal: Focal length in pixels; 1 where it is not valid.
        principal_point: In pixels.
        cam_from_world: Rotation from the frame of the orthogonal directions; the identity where it is not valid.
        valid: False where no camera has these vanishing points.
    """

    focal: Float[Array, ""]
    principal_point: Float[Array, "2"]
    cam_from_world: SO3
    valid: Bool[Array, ""]


def vanishing_point(
    segments: Float[ArrayLike, "n 2 2"], weights: Float[ArrayLike, " n"] | None = None
) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """The point where the lines through image segments meet, in the least-squares sense.

    Minimises the distances of the point from the lines, with coordinates about the middle of the segments and scaled to
    their spread, where points at infinity are no exception.

    Args:
        segments: Ends of n ≥ 2 segments, pixels.
        weights: Of the segments; their lengths, if None: long ones have better directions.

    Returns:
        The point in homogeneous pixels, of norm one, and whether the lines determine it.

    Degenerate input: segments of length zero have no weight; fewer than two lines, or all the same, are not valid.
    Differentiability: both modes, where the point is determined.

    Raises:
        ValueError: If shapes do not match or there are fewer than two segments.
    """
    segments = jnp.asarray(segments)
    if segments.ndim != 3 or segments.shape[1:] != (2, 2) or segments.shape[0] < 2:
        raise ValueError(f"segments have shape {segments.shape}: expected [n, 2, 2], two ends for each of n >= 2")
    middle = jnp.mean(segments, axis=(0, 1))
    spread = jnp.sqrt(jnp.mean((segments - middle[None, None]) ** 2))
    proper = spread > 0
    scaled = (segments - middle[None, None]) / jnp.where(proper, spread, 1.0)
    one = jnp.ones_like(scaled[:, 0, :1])
    ends = [jnp.concatenate([scaled[:, i], one], axis=1) for i in range(2)]
    lines = jnp.cross(ends[0], ends[1])
    along = safe_norm(scaled[:, 1] - scaled[:, 0])
    lines = lines / jnp.where(along > 0, along, 1.0)[:, None]
    weights = along if weights is None else jnp.asarray(weights, segments.dtype)
    if weights.shape != along.shape:
        raise ValueError(f"weights have shape {weights.shape}: expected one for each segment, {along.shape}")
    weights = jnp.where(along > 0, weights, 0.0)
    values, vectors = jnp.linalg.eigh((lines * weights[:, None] ** 2).T @ lines)
    point = vectors[:, 0]
    valid = proper & (values[1] > 64.0 * float(jnp.finfo(values.dtype).eps) * values[2])
    homogeneous = jnp.append(spread * point[:2] + middle * point[2], point[2])
    return homogeneous / jnp.maximum(safe_norm(homogeneous), 1e-30), valid


def calibrate_from_vanishing_points(
    vanishing_points: Float[ArrayLike, "d 3"], principal_point: Float[ArrayLike, "2"] | None = None
) -> VanishingCalibration:
    """Find focal length and rotation of a camera with square pixels from two or three orthogonal vanishing points.

    Args:
        vanishing_points: Homogeneous pixels of the directions x and y of the world, or x, y and z; of any scale and
            sign.
        principal_point: In pixels. None takes it from three vanishing points, of which none is at infinity.

    Returns:
        The camera. The sign of a vanishing point says nothing of that of its direction: x and y are turned such that
        they lie ahead of the camera (z > 0), and z completes the right-handed frame.

    Degenerate input: a vanishing point at infinity (an axis parallel to the image) leaves the focal length of two
        open; vanishing points whose angle at the principal point is acute belong to no camera: not valid.
    Differentiability: both modes; zero where it is not valid.

    Raises:
        ValueError: If there are not two or three points, or two without a principal point.
    References: see the module.

    Example:
        >>> found = calibrate_from_vanishing_points(jnp.array([[820.0, 240.0, 1.0], [-180.0, 240.0, 1.0]]), \
jnp.array([320.0, 240.0]))
        >>> round(float(found.focal), 2)
        500.0
    """
    points = jnp.asarray(vanishing_points)
    if points.shape not in ((2, 3), (3, 3)):
        raise ValueError(f"vanishing_points have shape {points.shape}: expected [2, 3] or [3, 3], homogeneous pixels")
    if principal_point is None and len(points) == 2:
        raise ValueError("two vanishing points and no principal point: expected the principal point, or a third one")
    valid = jnp.all(jnp.isfinite(points))
    points = jnp.where(valid, points, 0.0)
    if principal_point is None:
        centre, known = _orthocentre(points)
        valid = valid & known
    else:
        centre = jnp.asarray(principal_point, points.dtype)
    # About the principal point (1) is homogeneous in the points: one at infinity leaves w0 w1 = 0.
    relative = points.at[:, :2].add(-centre[None] * points[:, 2:])
    size = jnp.maximum(safe_norm(relative), 1e-30)
    relative = relative / size[:, None]
    pairs = ((0, 1),) if len(points) == 2 else ((0, 1), (1, 2), (0, 2))
    above = jnp.stack([-jnp.sum(relative[i, :2] * relative[j, :2]) for i, j in pairs])
    below = jnp.stack([relative[i, 2] * relative[j, 2] for i, j in pairs])
    # Least squares of f² below = above over the pairs.
    square = safe_divide(jnp.sum(above * below), jnp.sum(below * below))
    valid = valid & (square > 0)
    focal = safe_sqrt(jnp.where(valid, square, 1.0))
    rays = jnp.stack([relative[:2, 0] / focal, relative[:2, 1] / focal, relative[:2, 2]], axis=1)
    rays = rays * jnp.where(rays[:, 2:] < 0, -1.0, 1.0)
    rays = jnp.where(valid, rays, jnp.eye(3, dtype=rays.dtype)[:2])
    rays = rays / jnp.maximum(safe_norm(rays), 1e-30)[:, None]
    # Both share what noise leaves of an angle other than a right one.
    total, difference = rays[0] + rays[1], rays[0] - rays[1]
    total, difference = (part / jnp.maximum(safe_norm(part), 1e-30) for part in (total, difference))
    x, y = (total + difference) * 0.5**0.5, (total - difference) * 0.5**0.5
    rotation = SO3.from_matrix(jnp.stack([x, y, jnp.cross(x, y)], axis=1))
    return VanishingCalibration(focal, centre, rotation, valid)


def _orthocentre(points: Float[Array, "3 3"]) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """Where the altitudes of the triangle meet."""
    finite = jnp.all(jnp.abs(points[:, 2]) > 1e-9 * jnp.max(jnp.abs(points), axis=1))
    corners = points[:, :2] / jnp.where(finite, points[:, 2], 1.0)[:, None]
    a, b, c = corners
    # (c - b)·(x - a) = 0 and (a - c)·(x - b) = 0
    m = jnp.stack([c - b, a - c])
    rhs = jnp.stack([jnp.sum((c - b) * a), jnp.sum((a - c) * b)])
    determinant = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    proper = finite & (jnp.abs(determinant) > 1e-9 * jnp.sum(m * m))
    inverse = 1.0 / jnp.where(proper, determinant, 1.0)
    x = (m[1, 1] * rhs[0] - m[0, 1] * rhs[1]) * inverse
    y = (m[0, 0] * rhs[1] - m[1, 0] * rhs[0]) * inverse
    return jnp.where(proper, jnp.stack([x, y]), 0.0), proper
