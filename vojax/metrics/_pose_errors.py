"""Errors of single poses: jittable, differentiable, over any batch."""

import jax.numpy as jnp

from vojax._numerics import normalize, safe_norm, safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SO3


def _angle(sine: Float[Array, "*batch"], cosine: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Angle from its sine >= 0 and cosine; finite gradient where both vanish."""
    defined = (sine > 0) | (cosine != 0)
    return jnp.arctan2(jnp.where(defined, sine, 0.0), jnp.where(defined, cosine, 1.0))


def rotation_error_deg(rotation: SO3, rotation_true: SO3) -> Float[Array, "*batch"]:
    """Compute the geodesic angle between two rotations.

    Args:
        rotation: Estimated rotations.
        rotation_true: True rotations of the same batch shape.

    Returns:
        Angles from 0 to 180 degrees.

    Degenerate input: none.

    Differentiability: both modes; the gradient is 0 where the rotations are equal.
    """
    wxyz = (rotation_true.inverse() @ rotation).parameters()
    return jnp.degrees(2.0 * _angle(safe_norm(wxyz[..., 1:]), jnp.abs(wxyz[..., 0])))


def axis_rotation_error_deg(rotation: SO3, rotation_true: SO3) -> Float[Array, "*batch"]:
    """Average the angles between the true and the estimated x, y and z axes.

    This is not the geodesic angle of `rotation_error_deg`, which bounds it from above: an axis near the axis of the
    error hardly moves.

    Args:
        rotation: Estimated rotations.
        rotation_true: True rotations of the same batch shape.

    Returns:
        Mean angles from 0 to 120 degrees (a half turn about one of the axes).

    Degenerate input: none.

    Differentiability: both modes; the gradient is 0 where the rotations are equal.
    """
    error = (rotation_true.inverse() @ rotation).as_matrix()
    angles = [
        _angle(
            safe_sqrt(error[..., (i + 1) % 3, i] ** 2 + error[..., (i + 2) % 3, i] ** 2),
            error[..., i, i],
        )
        for i in range(3)
    ]
    return jnp.degrees((angles[0] + angles[1] + angles[2]) / 3.0)


def translation_direction_error_deg(
    translation: Float[ArrayLike, "*batch 3"],
    translation_true: Float[ArrayLike, "*batch 3"],
    sign_agnostic: bool = False,
) -> Float[Array, "*batch"]:
    """Compute the angle between two directions of translation.

    Args:
        translation: Estimated translations, any scale.
        translation_true: True translations, any scale.
        sign_agnostic: Treat t and -t as equal, for results whose sign no cheirality test has settled.

    Returns:
        Angles from 0 to 180 degrees (to 90 if `sign_agnostic`).

    Degenerate input: a zero translation has no direction; its error is 90 degrees.

    Differentiability: both modes; the gradient is 0 where the directions are equal and for zero translations.
    """
    a, b = normalize(jnp.asarray(translation)), normalize(jnp.asarray(translation_true))
    sine = safe_norm(jnp.cross(a, b))
    cosine = jnp.sum(a * b, axis=-1)
    if sign_agnostic:
        cosine = jnp.abs(cosine)
    known = (sine > 0) | (cosine != 0)
    return jnp.where(known, jnp.degrees(_angle(sine, cosine)), 90.0)


def translation_error(
    translation: Float[ArrayLike, "*batch 3"], translation_true: Float[ArrayLike, "*batch 3"]
) -> Float[Array, "*batch"]:
    """Compute the distance between two translations.

    Args:
        translation: Estimated translations.
        translation_true: True translations, in the same unit.

    Returns:
        Distances in that unit.

    Degenerate input: none.

    Differentiability: both modes; the gradient is 0 where the translations are equal.
    """
    return safe_norm(jnp.asarray(translation) - jnp.asarray(translation_true))


def reprojection_rmse(
    pixels_projected: Float[ArrayLike, "*batch n 2"],
    pixels: Float[ArrayLike, "*batch n 2"],
    mask: Bool[ArrayLike, "*batch n"] | None = None,
) -> Float[Array, "*batch"]:
    """Compute the root mean square distance between projected and measured pixels.

    Args:
        pixels_projected: Projections of the points, pixels.
        pixels: Measurements, pixels.
        mask: True for the points that count; all by default.

    Returns:
        Root mean square over the points of the distance in the image, pixels.

    Degenerate input: 0 where no point counts.

    Differentiability: both modes; the gradient is 0 at a perfect fit.
    """
    difference = jnp.asarray(pixels_projected) - jnp.asarray(pixels)
    if mask is None:
        return safe_sqrt(jnp.mean(jnp.sum(difference * difference, axis=-1), axis=-1))
    counted = jnp.asarray(mask)
    # Masked entries may hold anything, so they leave before the square is taken.
    difference = jnp.where(counted[..., None], difference, 0.0)
    total = jnp.sum(difference * difference, axis=(-2, -1))
    return safe_sqrt(total / jnp.maximum(jnp.sum(counted, axis=-1), 1).astype(total.dtype))
