"""How far a model is from one correspondence: reprojection and epipolar errors.

Epipolar conventions: `ray1ᵀ E ray0 = 0` and `pixel1ᵀ F pixel0 = 0`. The line of point 0 in image 1 is l1 = M p0,
that of point 1 in image 0 is l0 = Mᵀ p1.
"""

import jax.numpy as jnp

from vojax._numerics import safe_divide, safe_sqrt
from vojax._types import Array, ArrayLike, Float
from vojax.cameras import Camera
from vojax.lie import SE3


def reprojection_error(
    points_world: Float[ArrayLike, "*n 3"],
    pixels: Float[ArrayLike, "*n 2"],
    camera: Camera,
    cam_from_world: SE3,
) -> Float[Array, "*n 2"]:
    """Projected minus observed pixel.

    Args:
        points_world: Points in the world frame.
        pixels: Their observations.
        camera: The camera that made them.
        cam_from_world: Its pose.

    Returns:
        Signed residuals in pixels (not squared).

    Degenerate input: points at or behind the camera give finite residuals; mask them by depth.

    Differentiability: both modes.
    """
    return camera.project(cam_from_world.apply(points_world)) - jnp.asarray(pixels)


def _epipolar_terms(matrix, points0, points1):
    """Residual p1ᵀ M p0 and the squared gradients of the lines l1 = M p0, l0 = Mᵀ p1, elementwise."""
    m = jnp.asarray(matrix)
    p0, p1 = jnp.asarray(points0), jnp.asarray(points1)
    x0, y0, x1, y1 = p0[..., 0], p0[..., 1], p1[..., 0], p1[..., 1]
    a1 = m[0, 0] * x0 + m[0, 1] * y0 + m[0, 2]
    b1 = m[1, 0] * x0 + m[1, 1] * y0 + m[1, 2]
    c1 = m[2, 0] * x0 + m[2, 1] * y0 + m[2, 2]
    a0 = m[0, 0] * x1 + m[1, 0] * y1 + m[2, 0]
    b0 = m[0, 1] * x1 + m[1, 1] * y1 + m[2, 1]
    return x1 * a1 + y1 * b1 + c1, a1 * a1 + b1 * b1, a0 * a0 + b0 * b0


def algebraic_error(
    matrix: Float[ArrayLike, "3 3"], rays0: Float[ArrayLike, "*n 3"], rays1: Float[ArrayLike, "*n 3"]
) -> Float[Array, "*n"]:
    """The epipolar form `ray1ᵀ M ray0`, signed and not squared.

    Args:
        matrix: Essential matrix with rays (any scale), or fundamental matrix with homogeneous pixels.
        rays0: Rays in camera 0, or homogeneous pixels of image 0.
        rays1: The matching ones of view 1.

    Returns:
        The form's value; it scales with the matrix and with both rays.

    Differentiability: both modes.

    References: Aufderheide, Krybus & Edwards, 2012, eq. (2).
    """
    m = jnp.asarray(matrix)
    r0, r1 = jnp.asarray(rays0), jnp.asarray(rays1)
    x0, y0, z0 = r0[..., 0], r0[..., 1], r0[..., 2]
    x1, y1, z1 = r1[..., 0], r1[..., 1], r1[..., 2]
    return (
        x1 * (m[0, 0] * x0 + m[0, 1] * y0 + m[0, 2] * z0)
        + y1 * (m[1, 0] * x0 + m[1, 1] * y0 + m[1, 2] * z0)
        + z1 * (m[2, 0] * x0 + m[2, 1] * y0 + m[2, 2] * z0)
    )


def sampson_residual(
    matrix: Float[ArrayLike, "3 3"], points0: Float[ArrayLike, "*n 2"], points1: Float[ArrayLike, "*n 2"]
) -> Float[Array, "*n"]:
    """First-order distance of a correspondence from the epipolar constraint, signed and not squared.

    Its square is `sampson_error`; least squares over it is least squares in the unit of the points.

    Args:
        matrix: Essential matrix with normalized points, or fundamental matrix with pixels. Its scale cancels.
        points0: Points of image 0.
        points1: The matching points of image 1.

    Returns:
        Signed residuals in the unit of the points.

    Degenerate input: a pair of epipoles gives 0, with gradient 0.

    Differentiability: both modes.

    References: Hartley & Zisserman, section 11.4.3.
    """
    residual, square1, square0 = _epipolar_terms(matrix, points0, points1)
    return safe_divide(residual, safe_sqrt(square1 + square0))


def sampson_error(
    matrix: Float[ArrayLike, "3 3"], points0: Float[ArrayLike, "*n 2"], points1: Float[ArrayLike, "*n 2"]
) -> Float[Array, "*n"]:
    """Sampson's error (p1ᵀ M p0)² / (|M p0|²₁₂ + |Mᵀ p1|²₁₂): a squared distance.

    Some texts print the numerator without its square; that is neither a distance nor invariant to the matrix's scale.

    Args:
        matrix: Essential matrix with normalized points, or fundamental matrix with pixels. Its scale cancels.
        points0: Points of image 0.
        points1: The matching points of image 1.

    Returns:
        Squared distances in the squared unit of the points: to first order, the least squared movement of the two
        points together that satisfies the constraint.

    Degenerate input: a pair of epipoles gives 0, with gradient 0.

    Differentiability: both modes.

    References: Hartley & Zisserman, eq. (11.9); Aufderheide, Krybus & Edwards, 2012, eq. (8).
    """
    residual, square1, square0 = _epipolar_terms(matrix, points0, points1)
    return safe_divide(residual * residual, square1 + square0)


def symmetric_epipolar_error(
    matrix: Float[ArrayLike, "3 3"], points0: Float[ArrayLike, "*n 2"], points1: Float[ArrayLike, "*n 2"]
) -> Float[Array, "*n"]:
    """Sum of the squared distances of both points from their epipolar lines.

    Args:
        matrix: Essential matrix with normalized points, or fundamental matrix with pixels. Its scale cancels.
        points0: Points of image 0.
        points1: The matching points of image 1.

    Returns:
        Squared distances, summed over the two images, in the squared unit of the points.

    Degenerate input: a point on its image's epipole has no line there and adds 0, with gradient 0.

    Differentiability: both modes.

    References: Hartley & Zisserman, eq. (11.10); Aufderheide, Krybus & Edwards, 2012, eq. (9).
    """
    residual, square1, square0 = _epipolar_terms(matrix, points0, points1)
    square = residual * residual
    return safe_divide(square, square1) + safe_divide(square, square0)
