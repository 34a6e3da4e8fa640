"""Rigid motion from three points: the minimal case of `procrustes`, in closed form.

Minimises sum_i |y_i - (R x_i + t)|^2 over three points. Both triangles are flat, so R takes one plane onto the other
and turns within it. Let x_i, y_i be coordinates in orthonormal frames F0, F1 of the triangles, the third axis along
(p1 - p0) x (p2 - p0), about the centroids. Then

    R = F1 Rz(a) F0ᵀ,      tan a = sum_i (x_i x y_i) / sum_i (x_i . y_i),                                         (1)

and the other way to lay one plane onto the other, face down, is never better: the in-plane correlation
M = sum_i y_i x_iᵀ has det M = 4/3 A0 A1 > 0 for areas A0, A1. With the angle this is the least-squares optimum for
triangles that are not congruent; the frames alone would be exact along their first edge and leave all error to the
third point. It costs four products more. Unlike the singular value decomposition it squares no condition number: a
triangle 1e-5 of its length thin is still good in float32.

Precondition: the points of each set span a triangle.

References:
    K. Arun, T. Huang, S. Blostein. Least-squares fitting of two 3-D point sets. PAMI 1987.
    B. Horn, H. Hilden, S. Negahdaripour. Closed-form solution of absolute orientation using orthonormal matrices.
        JOSA A 1988 (section on coplanar points).
"""

import jax.numpy as jnp

from vojax._numerics import Vector3, cross3, dot3
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import Components, Rows3, difference, floor, quaternion_from_rotation, rotate, squared, vector3
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last
from ._procrustes import centred


def _triangle(p0: Vector3, p1: Vector3, p2: Vector3) -> tuple[Rows3, tuple[Array, Array], Vector3, Array]:
    """Axes of a triangle, its third corner in them in units of the first edge, its centroid, and whether it is one."""
    edge1, edge2 = difference(p1, p0), difference(p2, p0)
    edge12 = difference(edge2, edge1)
    normal = cross3(edge1, edge2)
    area, length2 = jnp.sqrt(squared(normal)), squared(edge1)
    longest = jnp.sqrt(length2 + squared(edge2) + squared(edge12))
    reach = longest + jnp.abs(p0[0]) + jnp.abs(p0[1]) + jnp.abs(p0[2])
    eps = float(jnp.finfo(area.dtype).eps)
    # Collinear to rounding: of the products, or of the coordinates far from the origin. A short first edge too.
    ok = (area > 10.0 * eps * longest * reach) & (length2 > floor(area) ** 3) & jnp.isfinite(longest * area)
    area, length2 = jnp.where(ok, area, 1.0), jnp.where(ok, length2, 1.0)
    length = jnp.sqrt(length2)
    first = (edge1[0] / length, edge1[1] / length, edge1[2] / length)
    third = (normal[0] / area, normal[1] / area, normal[2] / area)
    corner = (dot3(edge1, edge2) / length2, area / length2)
    centroid = tuple(p0[i] + (edge1[i] + edge2[i]) * (1.0 / 3.0) for i in range(3))
    return (first, cross3(third, first), third), corner, centroid, ok  # type: ignore[return-value]


def rigid_three_point_components(
    points0: tuple[Vector3, Vector3, Vector3], points1: tuple[Vector3, Vector3, Vector3]
) -> tuple[Components, Array]:
    """Equation (1) on components: arrays of any one shape in, the pose (w, x, y, z, tx, ty, tz) and validity out."""
    axes0, (u, h), centroid0, ok0 = _triangle(*points0)
    axes1, (uu, hh), centroid1, ok1 = _triangle(*points1)
    # Sums over (0, 0), (1, 0), (u, h) about the centroid.
    along = 1.0 + u * uu + h * hh - ((1.0 + u) * (1.0 + uu) + h * hh) * (1.0 / 3.0)
    across = u * hh - h * uu - ((1.0 + u) * hh - h * (1.0 + uu)) * (1.0 / 3.0)
    size = jnp.sqrt(along * along + across * across)
    ok = ok0 & ok1 & (size > 0)
    size = jnp.where(ok, size, 1.0)
    c, s = along / size, across / size
    first, second, third = axes1
    turned1 = tuple(c * first[i] + s * second[i] for i in range(3))
    turned2 = tuple(c * second[i] - s * first[i] for i in range(3))
    rotation = tuple(
        tuple(turned1[i] * axes0[0][j] + turned2[i] * axes0[1][j] + third[i] * axes0[2][j] for j in range(3))
        for i in range(3)
    )
    wxyz = quaternion_from_rotation(rotation)
    moved = rotate(wxyz, centroid0)
    model = (*wxyz, *difference(centroid1, moved))
    for component in model:
        ok = ok & jnp.isfinite(component)
    return tuple(jnp.where(ok, x, 1.0 if i == 0 else 0.0) for i, x in enumerate(model)), ok


def _kernel(points0: Array, points1: Array) -> tuple[Array, Array]:
    """Arrays [3, 3, *lanes]: pose [1, 7, *lanes] and validity [1, *lanes]."""
    corners0, corners1 = ((vector3(x[0]), vector3(x[1]), vector3(x[2])) for x in (points0, points1))
    model, valid = rigid_three_point_components(corners0, corners1)
    return jnp.stack(model, axis=0)[None], valid[None]


_solve = lanes_last(_kernel)


def _candidates(data: tuple[Array, Array]) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


def _stationarity(model: SE3, data: tuple[Array, Array]) -> Array:
    """Six equations: the torque of the residuals about the centroid, and their sum."""
    x, y, mean0, mean1, weights = centred((*data, jnp.ones_like(data[0][:, 0])))
    torque = jnp.sum(weights * jnp.cross(y, model.rotation() @ x), axis=0)
    return jnp.concatenate([torque, model @ mean0 - mean1])


_rigid_three_point = implicit(_candidates, _stationarity, perturb_camera, 6)


def rigid_three_point(points0: Float[ArrayLike, "3 3"], points1: Float[ArrayLike, "3 3"]) -> Candidates[SE3]:
    """Find the rigid motion that takes three points to three points, in the least-squares sense.

    The minimal solver of rigid alignment, equal to `procrustes` on three points and several times faster. For a batch,
    `jax.vmap(rigid_three_point, in_axes=-1, out_axes=-1)` on arrays [3, 3, batch] is the fast layout on a CPU.

    Args:
        points0: Points in frame 0, one per row.
        points1: The same points in frame 1.

    Returns:
        One slot with `frame1_from_frame0`: `points1 ≈ model @ points0`. Always a rotation; a mirrored triangle is the
        same triangle seen from its back, and is turned over.

    Degenerate input: a set that is collinear or coincident to rounding (thinner than 1e-6 of its length in float32, and
        more so far from the origin), lengths beyond 1e9 or below 1e-8 in float32, and anything not finite leave the
        slot invalid with the identity in it. Triangles that are not congruent are fitted, not refused.

    Differentiability: both modes, any order, by the implicit function theorem; zero for an invalid slot.

    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
        >>> candidates = rigid_three_point(points, points + 1.0)
        >>> bool(jnp.allclose(candidates.models.translation(), 1.0, atol=1e-5))
        True
    """
    points0, points1 = jnp.asarray(points0), jnp.asarray(points1)
    if points0.shape != (3, 3) or points1.shape != (3, 3):
        raise ValueError(f"found points of shapes {points0.shape} and {points1.shape}; expected two of (3, 3)")
    dtype = jnp.result_type(points0, points1)
    return _rigid_three_point((points0.astype(dtype), points1.astype(dtype)))
