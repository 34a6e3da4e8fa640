"""Fundamental matrix from seven pixels: seven linear equations pixel1ᵀ F pixel0 = 0 and det F = 0.

In Hartley's coordinates the linear equations leave F = u F1 + v F2, and the determinant is a cubic form in (u, v) with
one or three real roots. Roots are pairs, so F = F1 is as good a solution as any.

Precondition: the points are in general position and the camera moves.

References:
    R. Hartley. Projective reconstruction and invariants from multiple images. PAMI 1994.
    R. Hartley, A. Zisserman. Multiple View Geometry in Computer Vision, 2nd edition, section 11.1.2.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import cross3, dot3
from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._components import Rows3
from ._implicit import implicit
from ._lanes import lanes_last, one_kernel
from ._linear_epipolar import (
    algebraic_errors,
    centred_pixels,
    cofactors,
    congruent,
    dependent,
    epipolar_rows,
    matrix_rows,
    normalised_from_pixel,
    normalised_fundamental,
    null_space_and_least,
    pixel_rounding,
    two_views,
    unit_points,
)
from ._matrix_models import perturb_unit_matrix, unit_matrix
from ._roots import cubic_roots


def seven_point(
    pixels0: Float[ArrayLike, "7 2"], pixels1: Float[ArrayLike, "7 2"]
) -> Candidates[Float[Array, "3 3 3"]]:
    """Find the fundamental matrices that fit seven matching pixels.

    For a batch, `jax.vmap(seven_point, in_axes=-1, out_axes=-1)` on arrays [7, 2, batch] is the fast layout on a CPU.

    Args:
        pixels0: Pixels of image 0, one per row; without distortion.
        pixels1: The matching pixels of image 1.

    Returns:
        Three slots with F of rank 2, `pixel1ᵀ F pixel0 = 0`, Frobenius norm 1 and largest entry positive.

    Degenerate input: points on a plane, a pure rotation, coincident correspondences: the linear equations are dependent
        to rounding (their least singular value is below 4 eps times the error of the pixels), and no slot is valid.
        With noise in the pixels such sets are no longer exactly degenerate. Anything not finite has no valid slot.
        Invalid slots hold the zero matrix. A double root, as on some quadrics through the points and both cameras, is
        found to the square root of the precision, once or twice.
    Differentiability: both modes, any order, by the implicit function theorem; zero for slots that are not valid and
        at double roots.

    Raises:
        ValueError: If there are not seven correspondences.
    References: see the module.

    Example:
        >>> import numpy as np
        >>> points = np.random.default_rng(0).uniform((-2, -2, 4), (2, 2, 8), (7, 3)).astype(np.float32)
        >>> pixels0 = 500.0 * points[:, :2] / points[:, 2:]
        >>> pixels1 = 500.0 * (points[:, :2] + np.array([[1.0, 0.0]], np.float32)) / points[:, 2:]
        >>> candidates = seven_point(pixels0, pixels1)
        >>> sideways = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]) / np.sqrt(2.0)
        >>> likeness = jnp.abs(jnp.sum(candidates.models * sideways[None], axis=(1, 2)))
        >>> bool(jnp.any(candidates.valid & (likeness > 0.999)))
        True
    """
    pixels0, pixels1, _ = two_views(pixels0, pixels1, None, at_least=7)
    if pixels0.shape[0] != 7:
        raise ValueError(f"found {pixels0.shape[0]} correspondences; expected 7: use fundamental_eight_point for more")
    return _seven_point((pixels0, pixels1))


def _cofactor_rows(m: Rows3) -> Rows3:
    return tuple(cross3(m[1], m[2])), tuple(cross3(m[2], m[0])), tuple(cross3(m[0], m[1]))


def _inner(a: Rows3, b: Rows3) -> Array:
    return dot3(a[0], b[0]) + dot3(a[1], b[1]) + dot3(a[2], b[2])


def _kernel(pixels0: Array, pixels1: Array) -> tuple[Array, Array]:
    ones = jnp.ones_like(pixels0[:, 0])
    x0, transform0, proper0 = centred_pixels(pixels0, ones)
    x1, transform1, proper1 = centred_pixels(pixels1, ones)
    rounding = jnp.maximum(pixel_rounding(pixels0, transform0), pixel_rounding(pixels1, transform1))
    basis, least = null_space_and_least(epipolar_rows(unit_points(x0), unit_points(x1)))
    certain = ~dependent(least, rounding)
    f1, f2 = matrix_rows(basis[0]), matrix_rows(basis[1])
    cof1, cof2 = _cofactor_rows(f1), _cofactor_rows(f2)
    # det(u F1 + v F2); roots are u / v.
    cubic = jnp.stack([dot3(f2[0], cof2[0]), _inner(f1, cof2), _inner(f2, cof1), dot3(f1[0], cof1[0])])
    (u, v), real = cubic_roots(cubic)
    mixed = tuple(tuple(u * f1[i][j][None] + v * f2[i][j][None] for j in range(3)) for i in range(3))
    lifted = [tuple(c[None] for c in transform) for transform in (transform0, transform1)]
    rows = congruent(normalised_from_pixel(lifted[1]), (mixed[0], mixed[1], mixed[2]), normalised_from_pixel(lifted[0]))
    models, finite = unit_matrix(jnp.stack([jnp.stack(row) for row in rows]))
    valid = real & finite & (proper0 & proper1 & certain)[None]
    return jnp.moveaxis(jnp.where(valid[None, None], models, 0.0), 2, 0), valid


_solve = lanes_last(one_kernel(_kernel), chunk=128)


def _candidates(data: tuple[Array, Array]) -> Candidates[Array]:
    models, valid = _solve(*data)
    return Candidates(models=models, valid=valid)


def _equations(fundamental: Array, data: tuple[Array, Array]) -> Array:
    """Seven epipolar equations and the determinant, in Hartley's coordinates."""
    x, transforms = [], []
    for pixels in data:
        # Any coordinates give the same derivative; those of the data as they are remain fixed.
        ones = jnp.ones_like(pixels[:, 0])
        _, (s, cx, cy), _ = centred_pixels(jax.lax.stop_gradient(pixels), ones)
        x.append(jnp.concatenate([s * (pixels - jnp.stack([cx, cy])[None, :]), ones[:, None]], axis=1))
        transforms.append((s, cx, cy))
    f = normalised_fundamental(fundamental, *transforms)
    return jnp.concatenate([algebraic_errors(x[0], x[1], f), jnp.sum(f[0] * cofactors(f)[0])[None]])


_seven_point = implicit(_candidates, _equations, perturb_unit_matrix, 8)
