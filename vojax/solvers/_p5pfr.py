"""Pose, focal length and one coefficient of radial distortion from five points.

Whatever the focal length and the distortion, a point lies in the half plane of its pixel (radial alignment). Five of
these equations leave the first two rows of s [R | t] a combination of three null vectors, and

    p1 · p2 = 0,      |p1|² - |p2|² = 0                                                                            (1)

are two conics in its coefficients: a quartic. The rest is linear, five equations for f, f k and t3, solved in the
least-squares sense; see `_radial_camera.py`.

Precondition: pixels relative to the centre of distortion, which is the principal point, and square.

References:
    Z. Kukelova, M. Bujnak, T. Pajdla. Real-time solution to the absolute pose problem with unknown radial distortion
    and focal length. ICCV 2013.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import cross3, dot3, lane_sum
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import floor, squared
from ._implicit import implicit
from ._lanes import lanes_last, one_kernel
from ._null_space import null_space_and_rank
from ._radial_camera import (
    Data,
    RadialCamera,
    cameras_from_rows,
    distinct,
    errors,
    normalised,
    perturb,
    points_and_pixels,
    rows_from,
    with_placeholders,
)
from ._roots import quartic_roots

SLOTS = 4
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _conics(basis: Array) -> tuple[Array, Array]:
    """Coefficients [6, *lanes] of (1) for null vectors [3, 2, 4, *lanes], of length one."""
    conics = []
    for mixed in (True, False):
        entries = []
        for k, m in _PAIRS:
            p, q = basis[k, :, :3], basis[m, :, :3]
            if mixed:
                entry = lane_sum(p[0] * q[1] + p[1] * q[0], axis=0) * (0.5 if k == m else 1.0)
            else:
                entry = lane_sum(p[0] * q[0] - p[1] * q[1], axis=0) * (1.0 if k == m else 2.0)
            entries.append(entry)
        size = jnp.sqrt(sum(x * x for x in entries) + floor(entries[0]) ** 2)  # type: ignore[arg-type]
        conics.append(jnp.stack([x / size for x in entries]))
    return conics[0], conics[1]


def _meet(a: Array, b: Array) -> tuple[Array, Array]:
    """Real common points of two conics, unit vectors [3, 4, *lanes], and which slots hold one.

    In (x, y, z) with z = 1 both are quadratics in y. Their resultant is a quartic in x, and at its roots their
    difference is linear in y.
    """

    def split(c: Array) -> tuple[Array, tuple[Array, Array], tuple[Array, Array, Array]]:
        return c[3], (c[4], c[1]), (c[5], c[2], c[0])  # of y², y and 1, ascending in x

    (a2, a1, a0), (b2, b1, b0) = split(a), split(b)
    p = [a2 * y - b2 * x for x, y in zip(a1, b1, strict=True)]  # of y when y² is gone
    q = [a2 * y - b2 * x for x, y in zip(a0, b0, strict=True)]
    r = [jnp.zeros_like(a2)] * 4  # a1 b0 - b1 a0
    for i in range(2):
        for j in range(3):
            r[i + j] = r[i + j] + a1[i] * b0[j] - b1[i] * a0[j]
    quartic = [jnp.zeros_like(a2)] * 5
    for i in range(3):
        for j in range(3):
            quartic[i + j] = quartic[i + j] + q[i] * q[j]
    for i in range(2):
        for j in range(4):
            quartic[i + j] = quartic[i + j] - p[i] * r[j]
    (u, v), valid = quartic_roots(jnp.stack(quartic))
    linear = p[0][None] * v + p[1][None] * u
    constant = q[0][None] * v * v + q[1][None] * u * v + q[2][None] * u * u
    point = jnp.stack([u * linear, -constant, v * linear])
    size = jnp.sqrt(lane_sum(point * point, axis=0))
    valid = valid & (size > floor(size))
    return point / jnp.where(valid, size, 1.0)[None], valid


def _newton(point: Array, a: Array, b: Array) -> Array:
    """One step on both conics along the unit sphere."""
    eps = float(jnp.finfo(point.dtype).eps)
    x = (point[0], point[1], point[2])
    values, gradients = [], []
    for c in (a, b):
        d = [entry[None] for entry in c]
        gradient = (
            2.0 * d[0] * x[0] + d[1] * x[1] + d[2] * x[2],
            d[1] * x[0] + 2.0 * d[3] * x[1] + d[4] * x[2],
            d[2] * x[0] + d[4] * x[1] + 2.0 * d[5] * x[2],
        )
        gradients.append(gradient)
        values.append(0.5 * dot3(gradient, x))
    # Rows: the two gradients and x itself, along which nothing moves.
    first, second, third = cross3(gradients[1], x), cross3(x, gradients[0]), cross3(gradients[0], gradients[1])
    determinant = dot3(third, x)
    usable = jnp.abs(determinant) > eps**0.75
    divisor = jnp.where(usable, -determinant, jnp.inf)
    step = tuple((values[0] * first[i] + values[1] * second[i]) / divisor for i in range(3))
    shrink = jnp.minimum(1.0, 0.5 / jnp.maximum(jnp.sqrt(squared(step)), 0.5))
    moved = tuple(x[i] + shrink * step[i] for i in range(3))
    norm = jnp.sqrt(squared(moved))
    return jnp.stack([c / norm for c in moved])


def _kernel(points: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Poses [4, 7, *lanes], focal lengths and distortions [2, 4, *lanes], and validity [4, *lanes]."""
    double = points.dtype == jnp.float64
    eps = float(jnp.finfo(points.dtype).eps)
    problem = normalised(points, pixels)
    basis, independent = null_space_and_rank(problem.alignment)
    basis = basis.reshape(3, 2, 4, *problem.usable.shape)
    a, b = _conics(basis)
    point, valid = _meet(a, b)
    point = jax.lax.fori_loop(0, 4 if double else 3, lambda _, c: _newton(c, a, b), point)
    rows, size, gap = rows_from(basis, point)
    # (1) holds to rounding at a common point.
    valid = valid & (problem.usable & independent)[None] & (size > 64.0 * eps)
    valid = valid & (gap <= (4096.0 if double else 64.0) * eps)
    model, intrinsics, valid, _ = cameras_from_rows(rows, size, valid, problem)
    return with_placeholders(model, intrinsics, distinct(point, valid))


_solve = lanes_last(one_kernel(_kernel), chunk=128)


def _candidates(data: Data) -> Candidates[RadialCamera]:
    poses, intrinsics, valid = _solve(*data)
    return Candidates(models=RadialCamera(SE3(poses), intrinsics[0], intrinsics[1]), valid=valid)


def _equations(model: RadialCamera, data: Data) -> Array:
    """Eight equations: five of radial alignment, and the normal equations of the others."""
    radial, error, weighted, square = errors(model, data)
    normal = [jnp.sum(error * weighted), jnp.sum(error * weighted * square), jnp.sum(error * square)]
    return jnp.concatenate([radial, jnp.stack(normal)])


_p5pfr = implicit(_candidates, _equations, perturb, 8)


def p5pfr(points_world: Float[ArrayLike, "5 3"], pixels: Float[ArrayLike, "5 2"]) -> Candidates[RadialCamera]:
    """Find pose, focal length and radial distortion of a camera from five points.

    For a batch, `jax.vmap(p5pfr, in_axes=-1, out_axes=-1)` on arrays [5, 3, batch] is the fast layout on a CPU.

    Args:
        points_world: Points in world coordinates, one per row, not on a plane.
        pixels: Where they are seen, distorted, relative to the principal point.

    Returns:
        Four slots of `cam_from_world`, `focal` and `distortion`. Valid slots are distinct, satisfy the radial alignment
        of all points, have positive focal length and all points in front; focal length, distortion and depth are the
        least-squares solution of five linear equations for three unknowns, exact without noise. The others hold the
        identity, a focal length of one and no distortion.

    Degenerate input: points on a plane (with these the first two rows of the pose are not determined), an optical axis
        through a point, coincident points and anything not finite leave no slot valid, or with rounding mean nothing.
    Differentiability: both modes, any order, in points and pixels, by the implicit function theorem; zero for slots
        that are not valid.

    Raises:
        ValueError: If there are not five points and five pixels.
    References: see the module.
    """
    return _p5pfr(points_and_pixels(points_world, pixels, 5, "five"))
