"""Pose of a rig of cameras from three points: the generalised three-point problem.

Ray i starts at c_i, the centre of some camera of the rig, and points along f_i. With two unit vectors e across f_i,

    e · (R X_i + t) = e · c_i                                                                                      (1)

are six equations linear in R and t: three quadrics in a quaternion, with up to eight common points. For rays through
one point these are the four poses of the three-point problem and the four that see the points behind.

References:
    D. Nistér, H. Stewénius. A minimal solution to the generalised 3-point pose problem. JMIV 2007. L. Zhou, J. Ye,
    M. Kaess, 2018 (see `_six_linear`).
"""

import jax
import jax.numpy as jnp

from vojax._numerics import dot3, lane_sum, normalize
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import complement, floor, rotate, squared
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last, one_kernel
from ._six_linear import six_linear_equations
from ._upright_three_point import placeholders

Data = tuple[Array, Array, Array]


def unit_bearings(bearings: Float[Array, "n 3 *lanes"]) -> tuple[tuple[Array, Array, Array], Array]:
    """Unit components [n, *lanes] of rays, and whether all of them have a direction; those that do not point ahead."""
    size = jnp.max(jnp.abs(bearings), axis=1)
    usable = jnp.isfinite(size) & (size > floor(size) ** 2)
    scaled = bearings / jnp.where(usable, size, 1.0)[:, None]
    ahead = (0.0, 0.0, 1.0)
    x = tuple(jnp.where(usable, scaled[:, i], ahead[i]) for i in range(3))
    norm = jnp.sqrt(squared(x))
    return (x[0] / norm, x[1] / norm, x[2] / norm), jnp.all(usable, axis=0)


def _kernel(points: Array, centers: Array, bearings: Array) -> tuple[Array, Array]:
    """Poses [8, 7, *lanes] and validity [8, *lanes]."""
    f, proper = unit_bearings(bearings)
    # Relative to the rays' mean origin, so that a rig frame far away costs no digits.
    middle = centers[0] + lane_sum(centers - centers[:1], axis=0) / 3.0
    usable = jnp.all(jnp.isfinite(middle), axis=0)
    c = jnp.where(usable[None, None], centers - middle[None], 0.0)
    tangents = [jnp.stack(e, axis=1) for e in complement(f)]
    normals = jnp.concatenate(tangents)
    constants = jnp.concatenate([lane_sum(e * c, axis=1) for e in tangents])
    double = points.dtype == jnp.float64
    model, valid = six_linear_equations(normals, jnp.concatenate([points, points]), constants, 4 if double else 3)
    quaternion = tuple(model[:, i] for i in range(4))
    for i in range(3):
        moved = rotate(quaternion, tuple(jnp.broadcast_to(points[i, a][None], model[:, 0].shape) for a in range(3)))
        ray = tuple(moved[a] + model[:, 4 + a] - c[i, a][None] for a in range(3))
        valid = valid & (dot3(tuple(x[i][None] for x in f), ray) > 0)
    translation = [model[:, 4 + a] + middle[a][None] for a in range(3)]
    return placeholders((*quaternion, *translation), valid & (proper & usable)[None])


_solve = lanes_last(one_kernel(_kernel), chunk=128)


def _candidates(data: Data) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


def _equations(rig_from_world: SE3, data: Data) -> Array:
    """Six equations: the direction from each centre to its point minus the bearing, in the tangent plane of it."""
    points_world, centers, bearings = data
    directions = normalize(bearings)
    held = jax.lax.stop_gradient(directions)
    tangents = complement((held[:, 0], held[:, 1], held[:, 2]))
    error = normalize(rig_from_world @ points_world - centers) - directions
    return jnp.concatenate([jnp.sum(jnp.stack(tangent, axis=-1) * error, axis=-1) for tangent in tangents])


_gp3p = implicit(_candidates, _equations, perturb_camera, 6)


def gp3p(
    points_world: Float[ArrayLike, "3 3"], centers: Float[ArrayLike, "3 3"], bearings: Float[ArrayLike, "3 3"]
) -> Candidates[SE3]:
    """Find the poses of a rig of cameras that see three points along three rays, which need not meet.

    For a batch, `jax.vmap(gp3p, in_axes=-1, out_axes=-1)` on arrays [3, 3, batch] is the fast layout on a CPU.

    Args:
        points_world: Points in world coordinates, one per row.
        centers: Where the ray to each point starts, in the rig's frame: the centre of the camera that sees it.
        bearings: Directions of the rays in the rig's frame, of any positive length.

    Returns:
        Eight slots of `rig_from_world` in the unit of points and centres, which is one. Valid slots are distinct, have
        all points in front (positive distance along their ray) and satisfy the equations to rounding; the others hold
        the identity.

    Degenerate input: collinear or coincident points with rays through one centre, parallel rays, zero bearings and
        anything not finite leave no slot valid. Rays through one centre are fine. At a double root two solutions merge:
        they are found to the square root of the precision, as one, or not at all.
    Differentiability: both modes, any order, in all arguments, by the implicit function theorem; zero for slots that
        are not valid and at double roots.

    Raises:
        ValueError: If an array has another shape.
    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 4.0], [1.0, 0.0, 5.0], [0.0, 1.0, 6.0]])
        >>> centers = jnp.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, -0.5]])
        >>> candidates = gp3p(points, centers, points - centers)
        >>> errors = jnp.abs(candidates.models.translation()).max(axis=-1)
        >>> bool(jnp.any(candidates.valid & (errors < 1e-3)))
        True
    """
    return _gp3p(three_of_each(points_world, centers, bearings))


def three_of_each(points_world: ArrayLike, centers: ArrayLike, bearings: ArrayLike) -> Data:
    """Arrays of one dtype; refuses other shapes."""
    arrays = tuple(jnp.asarray(x) for x in (points_world, centers, bearings))
    for x in arrays:
        if x.shape != (3, 3):
            raise ValueError(f"found an array of shape {x.shape}; expected three points, centres and bearings, (3, 3)")
    dtype = jnp.result_type(*arrays)
    return arrays[0].astype(dtype), arrays[1].astype(dtype), arrays[2].astype(dtype)
