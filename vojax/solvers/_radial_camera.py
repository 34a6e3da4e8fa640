"""Cameras of which a pixel's direction from the centre of distortion is known better than its radius.

What `p4pfr` and `p5pfr` share. Both find the first two rows p1, p2 of s [R | t] from the radial alignment of points,

    u (r2 · X + t2) - v (r1 · X + t1) = 0,      u (r1 · X + t1) + v (r2 · X + t2) > 0.                             (1)

With λ = (u x + v y) / (u² + v²), x = r1 · X + t1, y = r2 · X + t2, the division model
(x, y) / z = (u, v) / (f (1 + k (u² + v²))) makes the rest linear, one equation per point for f, f k and t3:

    f λ + (f k) (u² + v²) λ - t3 = r3 · X.                                                                         (2)

References: R. Tsai. A versatile camera calibration technique. 1987 (radial alignment); A. Fitzgibbon. Simultaneous
linear estimation of multiple view geometry and lens distortion. CVPR 2001 (division model).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vojax._numerics import cross3, dot3, lane_max, lane_sum, safe_divide, symmetric_inverse
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._components import floor, quaternion_from_rotation, rotate, sign, squared
from ._implicit import perturb_camera

Data = tuple[Array, Array]


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


class Normalised(NamedTuple):
    """A problem of order one: X about its mean and pixels, with the units that were taken out."""

    x: Array  # [n, 3, *lanes]
    u: Array  # [n, 2, *lanes]
    mean: Array
    unit: Array
    radius: Array
    usable: Array

    @property
    def homogeneous(self) -> Array:
        """X with a one, [n, 4, *lanes]."""
        return jnp.concatenate([self.x, jnp.ones_like(self.x[:, :1])], axis=1)

    @property
    def alignment(self) -> Array:
        """Rows of (1), [n, 8, *lanes], for the eight entries of p1 and p2."""
        h = self.homogeneous
        return jnp.concatenate([-self.u[:, 1:] * h, self.u[:, :1] * h], axis=1)


def normalised(points: Array, pixels: Array) -> Normalised:
    """Take mean and unit out of points [n, 3, *lanes] and pixels [n, 2, *lanes]; zeros where they are not usable."""
    eps = float(jnp.finfo(points.dtype).eps)
    usable = jnp.all(jnp.isfinite(points), axis=(0, 1)) & jnp.all(jnp.isfinite(pixels), axis=(0, 1))
    points, pixels = (jnp.where(usable[None, None], a, 0.0) for a in (points, pixels))
    mean = points[0] + lane_sum(points - points[:1], axis=0) / float(points.shape[0])
    x = points - mean[None]
    spread, radius = jnp.max(jnp.abs(x), axis=(0, 1)), jnp.max(jnp.abs(pixels), axis=(0, 1))
    reach = jnp.max(jnp.abs(points), axis=(0, 1))
    usable = usable & (spread > 16.0 * eps * reach) & (spread > floor(spread) ** 2) & (radius > floor(radius) ** 2)
    usable = usable & (reach < 1.0 / floor(reach) ** 2) & (radius < 1.0 / floor(radius) ** 2)
    unit, radius = jnp.where(usable, spread, 1.0), jnp.where(usable, radius, 1.0)
    return Normalised(x / unit[None, None], pixels / radius[None, None], mean, unit, radius, usable)


def rows_from(basis: Array, point: Array) -> tuple[Array, Array, Array]:
    """p1 and p2 [2, 4, slots, *lanes] from coordinates [q, slots, *lanes] in null vectors [q, 2, 4, *lanes].

    Also their common length, and by how much they miss orthogonality and equal lengths.
    """
    p = lane_sum(basis[:, :, :, None] * point[:, None, None], axis=0)
    first, second = (squared((p[i, 0], p[i, 1], p[i, 2])) for i in range(2))
    gap = jnp.maximum(jnp.abs(first - second), jnp.abs(dot3((p[0, 0], p[0, 1], p[0, 2]), (p[1, 0], p[1, 1], p[1, 2]))))
    return p, jnp.sqrt(0.5 * (first + second)), gap


def cameras_from_rows(p: Array, size: Array, valid: Array, problem: Normalised) -> tuple[Array, Array, Array, Array]:
    """Complete p1, p2 to cameras.

    Args:
        p: Both rows, [2, 4, slots, *lanes], of either sign.
        size: Their length.
        valid: Slots that hold something, [slots, *lanes].
        problem: What was given.

    Returns:
        Poses [slots, 7, *lanes], focal lengths and distortions [2, slots, *lanes], which are possible, and the largest
        error of (2) in the unit of the points, [slots, *lanes].
    """
    x, u, h = problem.x, problem.u, problem.homogeneous
    eps = float(jnp.finfo(x.dtype).eps)
    size = jnp.where(valid, size, 1.0)
    along = jnp.stack(
        [
            sum((u[n, 0] * h[n, c])[None] * p[0, c] + (u[n, 1] * h[n, c])[None] * p[1, c] for c in range(4))
            for n in range(x.shape[0])
        ]
    )  # [n, slots, *lanes]: u x + v y, of one sign
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

    square = lane_sum(u * u, axis=1)  # [n, *lanes]
    centred = square > 64.0 * eps
    usable_square = jnp.where(centred, square, 1.0)
    # A pixel in the centre says nothing in (2).
    scaled = jnp.where(centred[:, None], along * (side / size)[None] / usable_square[:, None], 0.0)
    # Rows of (2) times u² + v², so that pixels near the centre do not rule; the unknowns are f, f k and t3.
    columns = jnp.stack(
        [scaled * square[:, None], scaled * (square * square)[:, None], -square[:, None] * jnp.ones_like(scaled)]
    )
    heights = jnp.stack([sum(third[c] * x[n, c][None] for c in range(3)) for n in range(x.shape[0])]) * square[:, None]
    scale = jnp.sqrt(lane_sum(columns * columns, axis=1))
    columns = columns / jnp.where(scale > 0, scale, 1.0)[:, None]
    normal = lane_sum(columns[:, None] * columns[None], axis=2)
    inverse, regular = symmetric_inverse(normal, lane_sum)
    solution = [jnp.zeros_like(size)] * 3
    for _ in range(2):  # the second time for what rounding left
        left = heights - sum(columns[c] * solution[c][None] for c in range(3))
        rhs = lane_sum(columns * left[None], axis=1)
        solution = [solution[c] + sum(inverse[c, d] * rhs[d] for d in range(3)) for c in range(3)]
    error = lane_max(jnp.abs(heights - sum(columns[c] * solution[c][None] for c in range(3))), axis=0)
    focal, product, depth = (solution[c] / jnp.where(scale[c] > 0, scale[c], 1.0) for c in range(3))
    valid = valid & regular & (focal > floor(focal))
    distortion = product / jnp.where(valid, focal, 1.0)
    # In front, and on the side of the distortion where radii are positive.
    stretch = 1.0 + distortion[None] * square[:, None]
    in_front = jnp.stack([sum(third[c] * x[n, c][None] for c in range(3)) + depth for n in range(x.shape[0])])
    valid = valid & jnp.all((stretch > 0) & (in_front > 0), axis=0)

    offset = rotate(quaternion, tuple(problem.mean[c][None] for c in range(3)))
    t = (p[0, 3], p[1, 3], depth)
    model = jnp.stack([*quaternion, *(problem.unit[None] * t[c] - offset[c] for c in range(3))], axis=1)
    focal = focal * problem.radius[None]
    distortion = distortion / (problem.radius * problem.radius)[None]
    valid = valid & jnp.all(jnp.isfinite(model), axis=1) & jnp.isfinite(focal) & jnp.isfinite(distortion)
    return model, jnp.stack([focal, distortion]), valid, error


def distinct(point: Array, valid: Array) -> Array:
    """Valid slots of unit vectors [q, slots, *lanes] but those that a slot before holds to rounding, of either sign."""
    eps = float(jnp.finfo(point.dtype).eps)
    inner = jnp.abs(lane_sum(point[:, :, None] * point[:, None], axis=0))
    near = 1.0 - inner < (0.5 if eps < 1e-10 else 2.0) * eps
    count = valid.shape[0]
    slots = jnp.arange(count)
    before = (slots[:, None] < slots[None]).reshape(count, count, *(1,) * (valid.ndim - 1))
    return valid & ~jnp.any(near & before & valid[:, None], axis=0)


def with_placeholders(model: Array, intrinsics: Array, valid: Array) -> tuple[Array, Array, Array]:
    """The identity, a focal length of one and no distortion in slots that are not valid."""
    identity = jnp.eye(7, dtype=model.dtype)[0].reshape(1, 7, *(1,) * (valid.ndim - 1))
    intrinsics = jnp.stack([jnp.where(valid, intrinsics[0], 1.0), jnp.where(valid, intrinsics[1], 0.0)])
    return jnp.where(valid[:, None], model, identity), intrinsics, valid


def perturb(model: RadialCamera, tangent: Array) -> RadialCamera:
    """Move a camera by a pose's tangent, and by f and f k in the unit of the pixels."""
    focal = model.focal * (1.0 + tangent[6])
    return RadialCamera(
        perturb_camera(model.cam_from_world, tangent[:6]), focal, model.distortion + tangent[7] / (model.focal**2)
    )


def errors(model: RadialCamera, data: Data) -> tuple[Array, Array, Array, Array]:
    """Errors of (1) and of (2) times u² + v², one per point, with λ (u² + v²) and u² + v², for pixels of order one."""
    points_world, pixels = data
    radius = jax.lax.stop_gradient(jnp.max(jnp.abs(pixels)))
    usable = radius > 0
    inverse = jnp.where(usable, 1.0 / jnp.where(usable, radius, 1.0), 1.0)
    u = pixels * inverse
    focal, distortion = model.focal * inverse, safe_divide(model.distortion, inverse * inverse)
    y = model.cam_from_world @ points_world
    square = jnp.sum(u * u, axis=1)
    radial = u[:, 0] * y[:, 1] - u[:, 1] * y[:, 0]
    weighted = jnp.sum(u * y[:, :2], axis=1)
    return radial, focal * weighted * (1.0 + distortion * square) - y[:, 2] * square, weighted, square


def points_and_pixels(points_world: ArrayLike, pixels: ArrayLike, count: int, word: str) -> Data:
    """Arrays of one dtype; refuses other shapes than `count` of each."""
    points_world, pixels = jnp.asarray(points_world), jnp.asarray(pixels)
    if points_world.shape != (count, 3) or pixels.shape != (count, 2):
        raise ValueError(
            f"found points {points_world.shape} and pixels {pixels.shape}; expected {word} of each, ({count}, 3) and "
            f"({count}, 2)"
        )
    dtype = jnp.result_type(points_world, pixels)
    return points_world.astype(dtype), pixels.astype(dtype)
