"""Absolute pose from two points and the vertical direction: four equations, up to two poses.

With unit bearings f_i and depths d_i, d_1 f_1 - d_0 f_0 = R (X_1 - X_0), where R is known up to a turn about the
vertical. Split along the vertical, which is known in both frames, into height and horizontal part (h),

    d_1 f_1z - d_0 f_0z = Z_1 - Z_0,             |d_1 f_1h - d_0 f_0h|² = |(X_1 - X_0)_h|²:                        (1)

a line in the plane of (d_0, d_1) meets a conic in up to two points. The turn about the vertical then takes the
horizontal part of X_1 - X_0 to that of d_1 f_1 - d_0 f_0.

Precondition: the points are not above one another, and the bearings are distinct and not both horizontal.

References:
    Z. Kukelova, M. Bujnak, T. Pajdla. Closed-form solutions to minimal absolute pose problems with known vertical
        direction. ACCV 2010.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import dot3, normalize
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import complement, difference, floor, quaternion_from_rotation, rotate, vector3
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last
from ._roots import quadratic_roots

Data = tuple[Array, Array, Array, Array]


def _unit(x: Array) -> tuple[Array, Array]:
    """Vectors `[k, 3, *lanes]` scaled to unit length, and whether all of them can be."""
    size = jnp.max(jnp.abs(x), axis=1)
    proper = jnp.all(jnp.isfinite(size) & (size > 0), axis=0)
    x = jnp.where(proper[None, None], x / jnp.where(proper[None], size, 1.0)[:, None], 1.0)
    return x / jnp.sqrt(jnp.sum(x * x, axis=1))[:, None], proper


def _kernel(points_world: Array, bearings: Array, up_world: Array, up_cam: Array) -> tuple[Array, Array]:
    """Arrays `[2, 3, *lanes]` and `[3, *lanes]` to poses `[2, 7, *lanes]` and their validity `[2, *lanes]`."""
    eps = float(jnp.finfo(points_world.dtype).eps)
    directions, proper = _unit(jnp.concatenate([bearings, up_world[None], up_cam[None]]))
    f0, f1, world_z, cam_z = (vector3(directions[i]) for i in range(4))
    world_x, world_y = complement(world_z)
    cam_x, cam_y = complement(cam_z)

    proper = proper & jnp.all(jnp.isfinite(points_world), axis=(0, 1))
    points = jnp.where(proper[None, None], points_world, 0.0)
    x0 = vector3(points[0])
    edge = points[1] - points[0]
    unit = jnp.max(jnp.abs(edge), axis=0)
    reach = jnp.max(jnp.abs(points), axis=(0, 1))
    proper = proper & (unit > floor(unit) ** 3) & (unit < 1.0 / floor(unit) ** 3)
    unit = jnp.where(proper, unit, 1.0)
    edge = vector3(edge / unit[None])
    height, along_x, along_y = dot3(edge, world_z), dot3(edge, world_x), dot3(edge, world_y)
    # |(X1 - X0)_h|: above one another to rounding, of the difference or of the coordinates far from the origin.
    horizontal = jnp.sqrt(along_x * along_x + along_y * along_y)
    proper = proper & (horizontal > 16.0 * eps * (1.0 + reach / unit))

    z0, z1 = dot3(f0, cam_z), dot3(f1, cam_z)
    # The line: (d0, d1) = height (-z0, z1) / norm2 + s (z1, z0).
    norm2 = z0 * z0 + z1 * z1
    proper = proper & (norm2 > (16.0 * eps) ** 2)
    norm2 = jnp.where(proper, norm2, 1.0)
    base0, base1 = -height * z0 / norm2, height * z1 / norm2
    fixed = tuple(base1 * dot3(f1, axis) - base0 * dot3(f0, axis) for axis in (cam_x, cam_y))
    moving = tuple(z0 * dot3(f1, axis) - z1 * dot3(f0, axis) for axis in (cam_x, cam_y))
    square = moving[0] * moving[0] + moving[1] * moving[1]
    # |z0 f1 - z1 f0|: zero for equal bearings.
    proper = proper & (square > (16.0 * eps) ** 2 * norm2)
    (s, w), real = quadratic_roots(
        jnp.stack(
            [
                fixed[0] * fixed[0] + fixed[1] * fixed[1] - horizontal * horizontal,
                2.0 * (fixed[0] * moving[0] + fixed[1] * moving[1]),
                square,
            ]
        )
    )
    s = s / jnp.where(w != 0, w, 1.0)
    d0, d1 = base0[None] + s * z1[None], base1[None] + s * z0[None]
    ok = proper[None] & real & (w != 0) & (d0 > 0) & (d1 > 0)
    # A double root counts once.
    same = jnp.abs(s[1] - s[0]) <= 0.5 * eps**0.5 * (jnp.abs(s[0]) + jnp.abs(s[1]))
    second = (jnp.arange(2) == 1).reshape((2,) + (1,) * same.ndim)
    ok = ok & ~(second & (same & ok[0])[None])

    # The turn takes (along_x, along_y) to the horizontal part of d1 f1 - d0 f0.
    image = tuple(d1 * dot3(f1, axis)[None] - d0 * dot3(f0, axis)[None] for axis in (cam_x, cam_y))
    cosine = image[0] * along_x[None] + image[1] * along_y[None]
    sine = image[1] * along_x[None] - image[0] * along_y[None]
    norm = jnp.sqrt(cosine * cosine + sine * sine)
    ok = ok & (norm > 0)
    cosine, sine = (jnp.where(ok, c / jnp.where(ok, norm, 1.0), e) for c, e in ((cosine, 1.0), (sine, 0.0)))
    turned_x = tuple(cosine * a[None] + sine * b[None] for a, b in zip(cam_x, cam_y, strict=True))
    turned_y = tuple(cosine * b[None] - sine * a[None] for a, b in zip(cam_x, cam_y, strict=True))
    rotation = tuple(
        tuple(
            turned_x[i] * world_x[j][None] + turned_y[i] * world_y[j][None] + (cam_z[i] * world_z[j])[None]
            for j in range(3)
        )
        for i in range(3)
    )
    quaternion = quaternion_from_rotation(rotation)
    moved = rotate(quaternion, tuple(c[None] for c in x0))
    translation = difference(tuple(unit[None] * d0 * c[None] for c in f0), moved)
    model = (*quaternion, *translation)
    for c in model:
        ok = ok & jnp.isfinite(c)
    return jnp.stack([jnp.where(ok, c, 1.0 if i == 0 else 0.0) for i, c in enumerate(model)], axis=1), ok


_solve = lanes_last(_kernel)


def _candidates(data: Data) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


def _equations(cam_from_world: SE3, data: Data) -> Array:
    """Six equations: both bearings and the vertical, each in the tangent plane of what was measured."""
    points_world, bearings, up_world, up_cam = data
    measured = normalize(jnp.concatenate([bearings, up_cam[None]]))
    up = cam_from_world.rotation() @ normalize(up_world)
    error = jnp.concatenate([normalize(cam_from_world @ points_world), up[None]]) - measured
    # Any basis of the tangent plane gives the same derivative at a solution, so that of the measurement is held fixed.
    held = jax.lax.stop_gradient(measured)
    tangents = complement((held[:, 0], held[:, 1], held[:, 2]))
    return jnp.concatenate([jnp.sum(jnp.stack(tangent, axis=-1) * error, axis=-1) for tangent in tangents])


_up2p = implicit(_candidates, _equations, perturb_camera, 6)


def up2p(
    points_world: Float[ArrayLike, "2 3"],
    bearings: Float[ArrayLike, "2 3"],
    up_world: Float[ArrayLike, "3"] | None = None,
    up_cam: Float[ArrayLike, "3"] | None = None,
) -> Candidates[SE3]:
    """Find the camera poses that see two points along two bearings while the vertical is known, from an accelerometer.

    Args:
        points_world: Points in world coordinates, one per row.
        bearings: Directions towards them in the camera's frame, one per row, of any positive length.
        up_world: The vertical in the world's frame, of any positive length; by default +z.
        up_cam: The same direction in the camera's frame; by default -y, up in the image of a level camera.

    Returns:
        Two slots of `cam_from_world` in the unit of the points. Valid slots are distinct and have both points in front
        (positive distance along their bearing); the others hold the identity.

    Degenerate input: points above one another or coincident, equal bearings, two bearings that are both horizontal,
        zero vectors and anything not finite leave no slot valid. Where the two solutions merge they are found to the
        square root of the precision, or as one.

    Differentiability: both modes, any order, in all four arguments, by the implicit function theorem; zero for slots
        that are not valid and at double roots.

    References: see the module.

    Example:
        >>> points = jnp.array([[1.0, 0.5, 4.0], [-1.0, 0.0, 5.0]])
        >>> candidates = up2p(points, points, up_world=jnp.array([0.0, -1.0, 0.0]))
        >>> errors = jnp.abs(candidates.models.translation()).max(axis=-1)
        >>> bool(jnp.any(candidates.valid & (errors < 1e-3)))
        True
    """
    points_world, bearings = jnp.asarray(points_world), jnp.asarray(bearings)
    up_world = jnp.array([0.0, 0.0, 1.0], points_world.dtype) if up_world is None else jnp.asarray(up_world)
    up_cam = jnp.array([0.0, -1.0, 0.0], points_world.dtype) if up_cam is None else jnp.asarray(up_cam)
    data = (points_world, bearings, up_world, up_cam)
    dtype = jnp.result_type(*data)
    points_world, bearings, up_world, up_cam = (x.astype(dtype) for x in data)
    return _up2p((points_world, bearings, up_world, up_cam))
