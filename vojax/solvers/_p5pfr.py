"""Pose, focal length and one coefficient of radial distortion from five points.

Radial distortion moves pixels (u, v) towards the principal point or away from it, so that whatever the focal length and
the distortion the point lies in the half plane of its pixel (radial alignment):

    u (r2 · X + t2) - v (r1 · X + t1) = 0,      u (r1 · X + t1) + v (r2 · X + t2) > 0.                             (1)

Five of these equations leave the first two rows of s [R | t] a combination of three null vectors, and

    p1 · p2 = 0,      |p1|² - |p2|² = 0                                                                            (2)

are two conics in its coefficients: a quartic. With λ = (u x + v y) / (u² + v²), x = r1 · X + t1, y = r2 · X + t2, the
division model (x, y) / z = (u, v) / (f (1 + k (u² + v²))) makes the rest linear,

    f λ + (f k) (u² + v²) λ - t3 = r3 · X,                                                                         (3)

five equations for f, f k and t3, solved in the least-squares sense.

Precondition: pixels relative to the centre of distortion, which is the principal point, and square.

References:
    Z. Kukelova, M. Bujnak, T. Pajdla. Real-time solution to the absolute pose problem with unknown radial distortion
    and focal length. ICCV 2013. R. Tsai. A versatile camera calibration technique. 1987 (radial alignment).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vojax._numerics import cross3, dot3, lane_sum, safe_divide, symmetric_inverse
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import floor, quaternion_from_rotation, rotate, sign, squared
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last, one_kernel
from ._null_space import null_space_and_rank
from ._roots import quartic_roots

Data = tuple[Array, Array]
SLOTS = 4
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class RadialCamera(NamedTuple):
    """A camera with square pixels and one coefficient of radial distortion, with its pose.

    Attributes:
        cam_from_world: The pose.
        focal: Focal length in pixels.
        distortion: k of the division model, (x, y) / z = (u, v) / (f (1 + k (u² + v²))), in pixels to the power -2.
    """

    cam_from_world: SE3
    focal: Float[Array, "*batch"]
    distortion: Float[Array, "*batch"]


def _conics(basis: Array) -> tuple[Array, Array]:
    """Coefficients [6, *lanes] of (2) for null vectors [3, 2, 4, *lanes], of length one."""
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
    dtype = points.dtype
    double = dtype == jnp.float64
    eps = float(jnp.finfo(dtype).eps)
    usable = jnp.all(jnp.isfinite(points), axis=(0, 1)) & jnp.all(jnp.isfinite(pixels), axis=(0, 1))
    points, pixels = (jnp.where(usable[None, None], a, 0.0) for a in (points, pixels))
    mean = points[0] + lane_sum(points - points[:1], axis=0) / 5.0
    x = points - mean[None]
    spread, radius = jnp.max(jnp.abs(x), axis=(0, 1)), jnp.max(jnp.abs(pixels), axis=(0, 1))
    reach = jnp.max(jnp.abs(points), axis=(0, 1))
    usable = usable & (spread > 16.0 * eps * reach) & (spread > floor(spread) ** 2) & (radius > floor(radius) ** 2)
    usable = usable & (reach < 1.0 / floor(reach) ** 2) & (radius < 1.0 / floor(radius) ** 2)
    unit, radius = jnp.where(usable, spread, 1.0), jnp.where(usable, radius, 1.0)
    x, u = x / unit[None, None], pixels / radius[None, None]

    h = jnp.concatenate([x, jnp.ones_like(x[:, :1])], axis=1)
    basis, independent = null_space_and_rank(jnp.concatenate([-u[:, 1:] * h, u[:, :1] * h], axis=1))
    basis = basis.reshape(3, 2, 4, *usable.shape)
    a, b = _conics(basis)
    point, valid = _meet(a, b)
    point = jax.lax.fori_loop(0, 4 if double else 3, lambda _, c: _newton(c, a, b), point)
    p = lane_sum(basis[:, :, :, None] * point[:, None, None], axis=0)  # [2, 4, slots, *lanes]
    norms = [jnp.sqrt(squared((p[i, 0], p[i, 1], p[i, 2]))) for i in range(2)]
    size = jnp.sqrt(0.5 * (norms[0] * norms[0] + norms[1] * norms[1]))
    valid = valid & (usable & independent)[None] & (size > 64.0 * eps)
    # (2) holds to rounding at a common point.
    tolerance = 4096.0 if double else 64.0
    gap = jnp.abs(norms[0] * norms[0] - norms[1] * norms[1])
    gap = jnp.maximum(gap, jnp.abs(dot3((p[0, 0], p[0, 1], p[0, 2]), (p[1, 0], p[1, 1], p[1, 2]))))
    valid = valid & (gap <= tolerance * eps)
    size = jnp.where(valid, size, 1.0)

    along = jnp.stack(
        [
            sum((u[n, 0] * h[n, c])[None] * p[0, c] + (u[n, 1] * h[n, c])[None] * p[1, c] for c in range(4))
            for n in range(5)
        ]
    )  # [5, slots, *lanes]: u x + v y, of one sign
    side = sign(along[0])
    valid = valid & jnp.all(along * side[None] > 0, axis=0)
    p = p * (side / size)[None, None]
    first = (p[0, 0], p[0, 1], p[0, 2])
    norm = jnp.sqrt(squared(first))
    first = tuple(c / jnp.where(valid, norm, 1.0) for c in first)
    second: tuple[Array, ...] = (p[1, 0], p[1, 1], p[1, 2])
    inner = dot3(first, second)
    second = tuple(c - inner * d for c, d in zip(second, first, strict=True))
    norm = jnp.sqrt(squared(second))
    second = tuple(c / jnp.where(valid, norm, 1.0) for c in second)
    third = cross3(first, second)
    quaternion = quaternion_from_rotation((first, second, third))

    square = lane_sum(u * u, axis=1)  # [5, *lanes]
    centred = square > 64.0 * eps
    usable_square = jnp.where(centred, square, 1.0)
    # A pixel in the centre says nothing in (3).
    scaled = jnp.where(centred[:, None], along * (side / size)[None] / usable_square[:, None], 0.0)
    # Rows of (3) times u² + v², so that pixels near the centre do not rule; the unknowns are f, f k and t3.
    columns = jnp.stack(
        [scaled * square[:, None], scaled * (square * square)[:, None], -square[:, None] * jnp.ones_like(scaled)]
    )
    heights = jnp.stack([sum(third[c] * x[n, c][None] for c in range(3)) for n in range(5)]) * square[:, None]
    scale = jnp.sqrt(lane_sum(columns * columns, axis=1))
    columns = columns / jnp.where(scale > 0, scale, 1.0)[:, None]
    normal = lane_sum(columns[:, None] * columns[None], axis=2)
    inverse, regular = symmetric_inverse(normal, lane_sum)
    solution = [jnp.zeros_like(size)] * 3
    for _ in range(2):  # the second time for what rounding left
        left = heights - sum(columns[c] * solution[c][None] for c in range(3))
        rhs = lane_sum(columns * left[None], axis=1)
        solution = [solution[c] + sum(inverse[c, d] * rhs[d] for d in range(3)) for c in range(3)]
    focal, product, depth = (solution[c] / jnp.where(scale[c] > 0, scale[c], 1.0) for c in range(3))
    valid = valid & regular & (focal > floor(focal))
    distortion = product / jnp.where(valid, focal, 1.0)
    # In front, and on the side of the distortion where radii are positive.
    reach5 = 1.0 + distortion[None] * square[:, None]
    in_front = jnp.stack([sum(third[c] * x[n, c][None] for c in range(3)) + depth for n in range(5)])
    valid = valid & jnp.all((reach5 > 0) & (in_front > 0), axis=0)

    offset = rotate(quaternion, tuple(mean[c][None] for c in range(3)))
    t = (p[0, 3], p[1, 3], depth)
    model = jnp.stack([*quaternion, *(unit[None] * t[c] - offset[c] for c in range(3))], axis=1)
    focal = focal * radius[None]
    distortion = distortion / (radius * radius)[None]
    valid = valid & jnp.all(jnp.isfinite(model), axis=1) & jnp.isfinite(focal) & jnp.isfinite(distortion)
    # A point met twice counts once.
    inner = jnp.abs(lane_sum(point[:, :, None] * point[:, None], axis=0))
    near = 1.0 - inner < (0.5 if double else 2.0) * eps
    slots = jnp.arange(SLOTS)
    before = (slots[:, None] < slots[None]).reshape(SLOTS, SLOTS, *(1,) * usable.ndim)
    valid = valid & ~jnp.any(near & before & valid[:, None], axis=0)
    identity = jnp.eye(7, dtype=dtype)[0].reshape(1, 7, *(1,) * usable.ndim)
    intrinsics = jnp.stack([jnp.where(valid, focal, 1.0), jnp.where(valid, distortion, 0.0)])
    return jnp.where(valid[:, None], model, identity), intrinsics, valid


_solve = lanes_last(one_kernel(_kernel), chunk=128)


def _candidates(data: Data) -> Candidates[RadialCamera]:
    poses, intrinsics, valid = _solve(*data)
    return Candidates(models=RadialCamera(SE3(poses), intrinsics[0], intrinsics[1]), valid=valid)


def _perturb(model: RadialCamera, tangent: Array) -> RadialCamera:
    # f and f k move in their own unit: that of the pixels.
    focal = model.focal * (1.0 + tangent[6])
    return RadialCamera(
        perturb_camera(model.cam_from_world, tangent[:6]), focal, model.distortion + tangent[7] / (model.focal**2)
    )


def _equations(model: RadialCamera, data: Data) -> Array:
    """Eight equations: five of (1), and the three normal equations of (3) weighted by u² + v²."""
    points_world, pixels = data
    radius = jax.lax.stop_gradient(jnp.max(jnp.abs(pixels)))
    usable = radius > 0
    inverse = jnp.where(usable, 1.0 / jnp.where(usable, radius, 1.0), 1.0)
    u = pixels * inverse
    focal, distortion = model.focal * inverse, safe_divide(model.distortion, inverse * inverse)
    y = model.cam_from_world @ points_world
    square = jnp.sum(u * u, axis=1)
    radial = u[:, 0] * y[:, 1] - u[:, 1] * y[:, 0]
    weighted = jnp.sum(u * y[:, :2], axis=1)  # λ (u² + v²)
    error = focal * weighted * (1.0 + distortion * square) - y[:, 2] * square
    return jnp.concatenate(
        [
            radial,
            jnp.sum(error * weighted)[None],
            jnp.sum(error * weighted * square)[None],
            jnp.sum(error * square)[None],
        ]
    )


_p5pfr = implicit(_candidates, _equations, _perturb, 8)


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
    return _p5pfr(five_of_each(points_world, pixels))


def five_of_each(points_world: ArrayLike, pixels: ArrayLike) -> Data:
    """Arrays of one dtype; refuses other shapes."""
    points_world, pixels = jnp.asarray(points_world), jnp.asarray(pixels)
    if points_world.shape != (5, 3) or pixels.shape != (5, 2):
        raise ValueError(
            f"found points {points_world.shape} and pixels {pixels.shape}; expected five of each, (5, 3) and (5, 2)"
        )
    dtype = jnp.result_type(points_world, pixels)
    return points_world.astype(dtype), pixels.astype(dtype)
