"""Pose of a camera from three features, points or lines: P3L, P2P1L and P1P2L.

A line of the image and the camera's centre span a plane with normal l, l · ray = 0. The points P and Q of the line in
space lie in it, and a point X lies on its ray, whose directions across are e:

    l · (R P + t) = 0,    l · (R Q + t) = 0,        e · (R X + t) = 0  (two of them).                              (1)

Three features are six equations linear in R and t: three quadrics in a quaternion (`_six_linear`), with up to eight
poses.

References:
    L. Zhou, J. Ye, M. Kaess. A stable algebraic camera pose estimation for minimal configurations of 2D/3D point and
    line correspondences. ACCV 2018. S. Ramalingam, S. Bouaziz, P. Sturm. Pose estimation using both points and lines
    for geo-localization. ICRA 2011.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import dot3, normalize
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import complement, rotate
from ._gp3p import unit_bearings
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last, one_kernel
from ._six_linear import six_linear_equations
from ._upright_three_point import placeholders

Data = tuple[Array, Array, Array, Array]


def _kernel(points: Array, bearings: Array, ends: Array, lines: Array) -> tuple[Array, Array]:
    """Poses [8, 7, *lanes] and validity from p points [p, 3, *lanes] and 3 - p lines [3 - p, 2, 3, *lanes]."""
    rays, proper = unit_bearings(bearings)
    unit, proper_lines = unit_bearings(lines)
    tangents = [jnp.stack(e, axis=1) for e in complement(rays)]
    normal = jnp.stack(unit, axis=1)
    normals = jnp.concatenate([*tangents, normal, normal])
    x = jnp.concatenate([points, points, ends[:, 0], ends[:, 1]])
    double = x.dtype == jnp.float64
    # Not zeros, which XLA would fold, at the size of the batch, for seconds.
    constants = 0.0 * normals[:, 0]
    model, valid = six_linear_equations(normals, x, constants, 4 if double else 3)
    valid = valid & (proper & proper_lines)[None]
    quaternion = tuple(model[:, i] for i in range(4))
    for n in range(points.shape[0]):
        moved = rotate(quaternion, tuple(jnp.broadcast_to(points[n, a][None], valid.shape) for a in range(3)))
        seen = tuple(moved[a] + model[:, 4 + a] for a in range(3))
        valid = valid & (dot3(tuple(c[n][None] for c in rays), seen) > 0)
    return placeholders((*quaternion, *(model[:, 4 + a] for a in range(3))), valid)


_solve = lanes_last(one_kernel(_kernel), chunk=128)


def _candidates(data: Data) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


def _equations(cam_from_world: SE3, data: Data) -> Array:
    """The six equations (1), directions scaled to one."""
    points, bearings, ends, lines = data
    directions = normalize(bearings)
    held = jax.lax.stop_gradient(directions)
    tangents = complement((held[:, 0], held[:, 1], held[:, 2]))
    error = normalize(cam_from_world @ points) - directions
    across = [jnp.sum(jnp.stack(tangent, axis=-1) * error, axis=-1) for tangent in tangents]
    moved = cam_from_world @ ends.reshape(-1, 3)
    inside = jnp.sum(moved.reshape(ends.shape) * normalize(lines)[:, None], axis=-1)
    return jnp.concatenate([*across, inside.reshape(-1)])


_point_line = implicit(_candidates, _equations, perturb_camera, 6)


def features(
    points_world: ArrayLike, bearings: ArrayLike, line_points_world: ArrayLike, lines: ArrayLike, points: int
) -> Data:
    """Arrays of one dtype; refuses other numbers of features."""
    arrays = tuple(jnp.asarray(x) for x in (points_world, bearings, line_points_world, lines))
    expected = ((points, 3), (points, 3), (3 - points, 2, 3), (3 - points, 3))
    for x, shape in zip(arrays, expected, strict=True):
        if x.shape != shape:
            raise ValueError(f"found an array of shape {x.shape}; expected {shape}")
    dtype = jnp.result_type(*(x for x in arrays if x.size))
    return tuple(x.astype(dtype) for x in arrays)  # type: ignore[return-value]


def p3l(line_points_world: Float[ArrayLike, "3 2 3"], lines: Float[ArrayLike, "3 3"]) -> Candidates[SE3]:
    """Find the camera poses that see three lines.

    For a batch, `jax.vmap(p3l, in_axes=-1, out_axes=-1)` is the fast layout on a CPU.

    Args:
        line_points_world: Two different points of each line, in world coordinates; any two, seen or not.
        lines: Where the lines are seen: l with `l · ray = 0` for the rays in the camera's frame that meet the line, of
            any length and sign. It is the cross product of two such rays.

    Returns:
        Eight slots of `cam_from_world` in the unit of the points. Valid slots are distinct and satisfy the equations to
        rounding; whether what was seen of a line is in front of the camera is not known here. The others hold the
        identity.

    Degenerate input: parallel lines, lines through one point in space or in the image, two equal lines or points, zero
        lines and anything not finite leave no slot valid, or with rounding mean nothing.
    Differentiability: both modes, any order, by the implicit function theorem; zero for slots that are not valid and
        at double roots.

    Raises:
        ValueError: If an array has another shape.
    References: see the module.
    """
    line_points_world, lines = jnp.asarray(line_points_world), jnp.asarray(lines)
    none = jnp.zeros((0, 3), lines.dtype)
    return _point_line(features(none, none, line_points_world, lines, 0))


def p2p1l(
    points_world: Float[ArrayLike, "2 3"],
    bearings: Float[ArrayLike, "2 3"],
    line_points_world: Float[ArrayLike, "1 2 3"],
    lines: Float[ArrayLike, "1 3"],
) -> Candidates[SE3]:
    """Find the camera poses that see two points and a line.

    Args:
        points_world: Points in world coordinates, one per row.
        bearings: Directions towards them in the camera's frame, of any positive length.
        line_points_world: As in `p3l`.
        lines: As in `p3l`.

    Returns:
        Eight slots of `cam_from_world`, as from `p3l`; valid ones have the points in front.

    Degenerate input: coincident points, a line through both points, parallel bearings, zeros and anything not finite
        leave no slot valid, or with rounding mean nothing.
    Differentiability: as `p3l`.

    Raises:
        ValueError: If an array has another shape.
    References: see the module.
    """
    return _point_line(features(points_world, bearings, line_points_world, lines, 2))


def p1p2l(
    points_world: Float[ArrayLike, "1 3"],
    bearings: Float[ArrayLike, "1 3"],
    line_points_world: Float[ArrayLike, "2 2 3"],
    lines: Float[ArrayLike, "2 3"],
) -> Candidates[SE3]:
    """Find the camera poses that see a point and two lines.

    Args:
        points_world: The point in world coordinates.
        bearings: The direction towards it in the camera's frame, of any positive length.
        line_points_world: As in `p3l`.
        lines: As in `p3l`.

    Returns:
        Eight slots of `cam_from_world`, as from `p3l`; valid ones have the point in front.

    Degenerate input: parallel or equal lines, the point on one of them, zeros and anything not finite leave no slot
        valid, or with rounding mean nothing.
    Differentiability: as `p3l`.

    Raises:
        ValueError: If an array has another shape.
    References: see the module.
    """
    return _point_line(features(points_world, bearings, line_points_world, lines, 1))
