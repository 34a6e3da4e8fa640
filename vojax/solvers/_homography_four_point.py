"""Homography from four points: eight equations, one matrix.

With p_i and q_i homogeneous, H p_i ~ q_i. Four points in general position are a projective basis, and H takes the basis
of image 0 to that of image 1. Origins moved to the last point of each image, u_i = p_i - p_3 and v_i = q_i - q_3, with

    a_i = u_j x u_k,    b_i = v_j x v_k,    (i, j, k) cyclic in 0, 1, 2                                          (1)

twice the signed areas of the triangles that the last point forms with the others, sum_i a_i u_i = sum_i b_i v_i = 0 and

    H ~ sum_i (b_i / a_i) [v_i; 1] [u_j x u_k as a line: y_j - y_k, x_k - x_j, a_i],                             (2)

whose last column is (0, 0, b_0 + b_1 + b_2). Nothing is eliminated, and as only like quantities are added, no scaling
is needed for precision: the shift is the whole normalisation.

Precondition: no three points of an image are collinear; then H is regular.

References:
    R. Hartley, A. Zisserman. Multiple View Geometry, 2nd edition, section 4.1.
    P. Heckbert. Fundamentals of texture mapping and image warping. Master's thesis, UC Berkeley, 1989.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._components import Components, floor
from ._implicit import implicit
from ._lanes import lanes_last
from ._matrix_models import perturb_unit_matrix


class FramedHomography(NamedTuple):
    """A homography, and the same in the well-scaled coordinates (p - centre) / size, where it is differentiated."""

    homography: Array
    scaled: Array
    frame0: Array  # centre and size
    frame1: Array


def four_point_components(
    p: tuple[Components, ...], q: tuple[Components, ...]
) -> tuple[Components, Array, Components, Components]:
    """Nine entries of H by components, its validity, its scaled entries, and the frames (centre, size) of both images.

    Args:
        p: Four points (x, y) of image 0.
        q: Four points of image 1.
    """
    u = tuple((p[i][0] - p[3][0], p[i][1] - p[3][1]) for i in range(3))
    v = tuple((q[i][0] - q[3][0], q[i][1] - q[3][1]) for i in range(3))
    eps = float(jnp.finfo(u[0][0].dtype).eps)
    cyclic = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    ok = jnp.ones_like(u[0][0], dtype=bool)
    areas, sizes = [], []
    for w, last in ((u, p[3]), (v, q[3])):
        area = [w[j][0] * w[k][1] - w[j][1] * w[k][0] for _, j, k in cyclic]
        area.append(area[0] + area[1] + area[2])
        size = jnp.abs(w[0][0])
        for c in (w[0][1], *w[1], *w[2]):
            size = jnp.maximum(size, jnp.abs(c))
        smallest = jnp.abs(area[0])
        for c in area[1:]:
            smallest = jnp.minimum(smallest, jnp.abs(c))
        # Collinear to rounding: of the products, or of the coordinates far from the origin.
        reach = size + jnp.abs(last[0]) + jnp.abs(last[1])
        ok = ok & (smallest > 16.0 * eps * size * reach) & (size > 10.0 * floor(size)) & (reach < 0.1 / floor(size))
        areas.append(area)
        sizes.append(size)
    a, b = areas
    s0, s1 = (jnp.where(ok, size, 1.0) for size in sizes)
    # b_i / a_i of images scaled to size one, so that nothing overflows. XLA keeps these three quotients, and recomputes
    # the few products that follow in each of their consumers.
    ratio = (s0 / s1) * (s0 / s1)
    r = tuple(jnp.where(ok, ratio * b[i], 0.0) / jnp.where(ok, a[i], 1.0) for i in range(3))
    b3 = jnp.where(ok, ratio * b[3], 0.0)

    x = tuple(r[i] * (u[j][1] - u[k][1]) for i, j, k in cyclic)
    y = tuple(r[i] * (u[k][0] - u[j][0]) for i, j, k in cyclic)
    # Rows of the homography between the shifted images, whose last column is (0, 0, b3).
    gx, gy = x[0] + x[1] + x[2], y[0] + y[1] + y[2]
    (ex, ey), (fx, fy) = (
        (v[0][c] * x[0] + v[1][c] * x[1] + v[2][c] * x[2], v[0][c] * y[0] + v[1][c] * y[1] + v[2][c] * y[2])
        for c in range(2)
    )
    (px, py), (qx, qy) = p[3], q[3]
    g = b3 - gx * px - gy * py
    entries = (
        *(ex + qx * gx, ey + qx * gy, qx * g - ex * px - ey * py),
        *(fx + qy * gx, fy + qy * gy, qy * g - fx * px - fy * py),
        *(gx, gy, g),
    )
    # Quotients again: recomputed for the norm, entries that cancel would round differently there.
    entries = tuple(entry / s1 for entry in entries)
    scale = _unit_scale(entries)
    unit = tuple(jnp.where(ok, entry / scale, 0.0) for entry in entries)
    scaled = (ex * s0, ey * s0, 0.0 * s0, fx * s0, fy * s0, 0.0 * s0, gx * s0 * s1, gy * s0 * s1, b3 * s1)
    scale = _unit_scale(scaled)
    identity = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    scaled = tuple(jnp.where(ok, entry / scale, one) for entry, one in zip(scaled, identity, strict=True))
    centres = tuple(jnp.where(ok, c, 0.0) for c in (px, py, qx, qy))
    return unit, ok, scaled, (*centres[:2], s0, *centres[2:], s1)


def _unit_scale(entries: Components) -> Array:
    """What to divide by for Frobenius norm 1 with the entry of largest magnitude positive; never zero."""
    largest = entries[0]
    for entry in entries[1:]:
        largest = jnp.where(jnp.abs(entry) > jnp.abs(largest), entry, largest)
    largest = jnp.where(jnp.abs(largest) > float(jnp.finfo(largest.dtype).tiny), largest, 1.0)
    relative = tuple(entry / largest for entry in entries)
    return largest * jnp.sqrt(sum(entry * entry for entry in relative[1:]) + relative[0] * relative[0])


def _kernel(pixels0: Array, pixels1: Array) -> tuple[Array, ...]:
    """Arrays [4, 2, *lanes] to the parts of `FramedHomography`, slots first, and validity [1, *lanes]."""
    p, q = (tuple((x[i, 0], x[i, 1]) for i in range(4)) for x in (pixels0, pixels1))
    unit, ok, scaled, frames = four_point_components(p, q)
    matrices = (jnp.stack(m).reshape(1, 3, 3, *ok.shape) for m in (unit, scaled))
    return (*matrices, jnp.stack(frames[:3])[None], jnp.stack(frames[3:])[None], ok[None])


_solve = lanes_last(_kernel)


def _candidates(data: tuple[Array, Array]) -> Candidates[FramedHomography]:
    *parts, valid = _solve(*data)
    return Candidates(models=FramedHomography(*parts), valid=valid)


def perturb_framed_homography(model: FramedHomography, tangent: Float[Array, "8"]) -> FramedHomography:
    """Move the scaled matrix on the sphere of unit matrices, and the homography with it."""
    scaled = perturb_unit_matrix(model.scaled, tangent)
    (x0, y0, s0), (x1, y1, s1) = model.frame0, model.frame1
    zero, one = jnp.zeros_like(x0), jnp.ones_like(x0)
    to0 = jnp.stack([one, zero, -x0, zero, one, -y0, zero, zero, s0]).reshape(3, 3)
    from1 = jnp.stack([s1, zero, x1, zero, s1, y1, zero, zero, one]).reshape(3, 3)
    matrix = from1 @ scaled @ to0
    held = jax.lax.stop_gradient(matrix).reshape(9)
    sign = jnp.where(held[jnp.argmax(jnp.abs(held))] < 0, -1.0, 1.0)
    return model._replace(homography=matrix * (sign / jnp.sqrt(jnp.sum(matrix * matrix))), scaled=scaled)


def in_frame(pixels: Float[Array, "n 2"], frame: Float[Array, "3"]) -> Float[Array, "n 2"]:
    """Well-scaled coordinates of pixels."""
    return (pixels - frame[None, :2]) / frame[2]


def _transfer(model: FramedHomography, data: tuple[Array, Array]) -> Array:
    """Eight equations: H p is along q."""
    p, q = in_frame(data[0], model.frame0), in_frame(data[1], model.frame1)
    moved = p @ model.scaled[:, :2].T + model.scaled[None, :, 2]
    return (moved[:, :2] - q * moved[:, 2:]).reshape(8)


_four_point = implicit(_candidates, _transfer, perturb_framed_homography, 8)


def homography_four_point(pixels0: Float[ArrayLike, "4 2"], pixels1: Float[ArrayLike, "4 2"]) -> Candidates[Array]:
    """Find the homography that takes four points to four points.

    For a batch, `jax.vmap(homography_four_point, in_axes=-1, out_axes=-1)` on arrays [4, 2, batch] is the fast layout
    on a CPU.

    Args:
        pixels0: Points of image 0, in pixels or normalized coordinates.
        pixels1: The same points in image 1, in either unit too.

    Returns:
        One slot: the matrix H [3, 3] from image 0 to image 1, `(pixels1, 1) ~ H (pixels0, 1)`, Frobenius norm 1, the
        entry of largest magnitude positive. Exact for any four points in general position. Two cameras on one side of a
        plane see every triple of its points turn the same way: where a triangle of `pixels1` is turned against that of
        `pixels0`, H is right in algebra, but no two such cameras have it.

    Degenerate input: three points of an image that are collinear to rounding, coincident points, coordinates beyond
        3e8, configurations smaller than 4e-9 (float64: 1e75 and 2e-76) and anything not finite leave the slot invalid
        with zeros in it.

    Differentiability: both modes, any order, by the implicit function theorem; zero for an invalid slot.

    Raises:
        ValueError: If there are not four points in each image.

    References: see the module.

    Example:
        >>> square = jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> candidates = homography_four_point(square, 2.0 * square)
        >>> bool(jnp.allclose(candidates.models[0], jnp.diag(jnp.array([2.0, 2.0, 1.0])) / 3.0, atol=1e-6))
        True
    """
    pixels0, pixels1 = jnp.asarray(pixels0), jnp.asarray(pixels1)
    if pixels0.shape != (4, 2) or pixels1.shape != (4, 2):
        raise ValueError(f"found points of shapes {pixels0.shape} and {pixels1.shape}; expected [4, 2] in both images")
    dtype = jnp.result_type(pixels0, pixels1)
    candidates = _four_point((pixels0.astype(dtype), pixels1.astype(dtype)))
    return Candidates(models=candidates.models.homography, valid=candidates.valid)
