"""Pose and focal length from four points.

The projection P = diag(f, f, 1) [R | t], up to scale, satisfies eight linear equations u (P3 · X) = P1 · X and
v (P3 · X) = P2 · X in its twelve entries; their null space leaves P = Σ_k a_k N_k with a in P³. The first three entries
p1, p2, p3 of its rows are orthogonal, and |p1| = |p2|:

    p1 · p2 = 0,    p1 · p3 = 0,    p2 · p3 = 0,    |p1|² - |p2|² = 0.                                             (1)

Four quadrics in a are one more than there are unknowns (eight equations for six of the pose and one focal length). The
first three have up to eight common points (`three_quadrics`). Of these the two that come nearest to the fourth start a
Gauss-Newton iteration on all eight equations, and what is returned is a minimum over R, t and f of

    C = ½ Σ_i |f (x_i, y_i) / z_i - (u_i, v_i)|²,      (x, y, z)_i = R X_i + t.                                    (2)

Points on a plane need no other treatment: null vectors with p1, p2, p3 along its normal are among the N_k.

Precondition: pixels relative to the principal point, square pixels, no distortion.

References:
    M. Bujnak, Z. Kukelova, T. Pajdla. A general solution to the P4P problem for camera with unknown focal length. CVPR
    2008. Z. Kukelova, J. Heller, A. Fitzgibbon, 2016 (see `_three_quadrics`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vojax._numerics import cholesky_solve, cross3, dot3, lane_sum, safe_divide
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import Components, floor, quaternion_from_rotation, rotate, sign, squared
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last, one_kernel
from ._null_space import null_space_and_rank
from ._three_quadrics import PAIRS, SLOTS, orthonormal_rows, three_quadrics

Data = tuple[Array, Array]
_KEPT = 2
# A turn of the image that no tilt of a camera is likely to coincide with: if the normal of a plane is seen along an
# axis of the image, the first three equations of (1) have a curve in common.
_COSINE, _SINE = 0.83, 0.5577633906953737


class FocalCamera(NamedTuple):
    """A camera with square pixels and no distortion, with its pose.

    Attributes:
        cam_from_world: The pose.
        focal: Focal length in pixels.
    """

    cam_from_world: SE3
    focal: Float[Array, "*batch"]


def _quadrics(basis: Array) -> Array:
    """Coefficients [4, 10, *lanes] of (1) for a basis [4, 3, 4, *lanes] of projections."""
    rows: list[list[Array]] = [[], [], [], []]
    for k, m in PAIRS:
        p, q = basis[k], basis[m]

        def form(i: int, j: int, p: Array = p, q: Array = q) -> Array:
            return lane_sum(p[i, :3] * q[j, :3], axis=0)

        once = k == m
        for row, (i, j) in zip(rows, ((0, 1), (0, 2), (1, 2)), strict=False):
            row.append(form(i, j) if once else form(i, j) + form(j, i))
        rows[3].append((1.0 if once else 2.0) * (form(0, 0) - form(1, 1)))
    return jnp.stack([jnp.stack(row) for row in rows])


def _combined(basis: Array, a: Array) -> Array:
    """Projections [3, 4, slots, *lanes] with coefficients a [4, slots, *lanes]."""
    return lane_sum(basis[:, :, :, None] * a[:, None, None], axis=0)


def _nearest(points: Array, valid: Array, mismatch: Array) -> tuple[Array, Array]:
    """The valid points [4, slots, *lanes] of least mismatch, `_KEPT` of them."""
    left = jnp.where(valid, mismatch, jnp.inf)
    slots = jnp.arange(SLOTS).reshape(SLOTS, *(1,) * (valid.ndim - 1))
    taken, found = [], []
    for _ in range(_KEPT):
        best = slots == jnp.argmin(left, axis=0)[None]
        taken.append(lane_sum(jnp.where(best[None], points, 0.0), axis=1))
        found.append(jnp.any(best & (left < jnp.inf), axis=0))
        left = jnp.where(best, jnp.inf, left)
    return jnp.stack(taken, axis=1), jnp.stack(found)


def _camera(p: Array, depth_sign: Array) -> tuple[Components, Components, Array, Array]:
    """Quaternion, translation and focal length of projections [3, 4, slots, *lanes], and whether these are proper."""
    p = p * depth_sign[None, None]
    rows = [tuple(p[i, j] for j in range(3)) for i in range(3)]
    norms = [jnp.sqrt(squared(row)) for row in rows]
    proper = dot3(rows[0], cross3(rows[1], rows[2])) > 0
    for norm in norms:
        proper = proper & (norm > floor(norm))
    safe = [jnp.where(proper, norm, 1.0) for norm in norms]
    third = tuple(c / safe[2] for c in rows[2])
    along = dot3(rows[0], third)
    first = tuple(c - along * d for c, d in zip(rows[0], third, strict=True))
    length = jnp.sqrt(squared(first))
    proper = proper & (length > floor(length))
    first = tuple(c / jnp.where(proper, length, 1.0) for c in first)
    second = cross3(third, first)
    quaternion = quaternion_from_rotation((first, second, third))
    focal = jnp.sqrt(0.5 * (safe[0] * safe[0] + safe[1] * safe[1])) / safe[2]
    t = (p[0, 3] / (focal * safe[2]), p[1, 3] / (focal * safe[2]), p[2, 3] / safe[2])
    return quaternion, t, focal, proper


def _gauss_newton(state: Array, x: Array, pixels: Array) -> tuple[Array, Array]:
    """One step on (2) for states [8, slots, *lanes] of quaternion, translation and log f; and its relative size."""
    quaternion, t, focal = tuple(state[i] for i in range(4)), state[4:7], jnp.exp(state[7])
    residuals, columns = [], []
    for n in range(4):
        turned = rotate(quaternion, tuple(x[n, a][None] for a in range(3)))
        y = [turned[a] + t[a] for a in range(3)]
        z = jnp.where(jnp.abs(y[2]) > floor(y[2]), y[2], floor(y[2]))
        zero = jnp.zeros_like(z)
        for a in range(2):
            ratio, slope = y[a] / z, focal / z
            residuals.append(focal * ratio - pixels[n, a][None])
            of_y = (slope, zero, -slope * ratio) if a == 0 else (zero, slope, -slope * ratio)
            # y moves by δt + φ x turned.
            columns.append([*of_y, *cross3(turned, of_y), focal * ratio])
    jacobian = jnp.stack([jnp.stack(c) for c in columns], axis=1)  # [7, 8, slots, *lanes]
    residual = jnp.stack(residuals)
    scale = jnp.sqrt(lane_sum(jacobian * jacobian, axis=1)) + floor(residual)
    jacobian = jacobian / scale[:, None]
    normal = lane_sum(jacobian[:, None] * jacobian[None], axis=2)
    gradient = lane_sum(jacobian * residual[None], axis=1)
    step = -cholesky_solve(normal, gradient[:, None], lane_sum)[0][:, 0] / scale
    size = jnp.max(jnp.abs(step[3:]), axis=0)
    step = step / jnp.maximum(1.0, 2.0 * size)[None]
    half = [0.5 * step[3 + a] for a in range(3)]
    vector = cross3(half, quaternion[1:])
    w = quaternion[0] - dot3(half, quaternion[1:])
    moved = [w, *(quaternion[1 + a] + half[a] * quaternion[0] + vector[a] for a in range(3))]
    norm = jnp.sqrt(moved[0] * moved[0] + squared(moved[1:]))
    moved = [c / norm for c in moved]
    return jnp.stack([*moved, *(t[a] + step[a] for a in range(3)), state[7] + step[6]]), size


def _kernel(points: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Poses [2, 7, *lanes], focal lengths [2, *lanes] and validity [2, *lanes]."""
    dtype = points.dtype
    double = dtype == jnp.float64
    eps = float(jnp.finfo(dtype).eps)
    usable = jnp.all(jnp.isfinite(points), axis=(0, 1)) & jnp.all(jnp.isfinite(pixels), axis=(0, 1))
    points, pixels = (jnp.where(usable[None, None], a, 0.0) for a in (points, pixels))
    mean = points[0] + lane_sum(points - points[:1], axis=0) / 4.0
    x = points - mean[None]
    spread, radius = jnp.max(jnp.abs(x), axis=(0, 1)), jnp.max(jnp.abs(pixels), axis=(0, 1))
    reach = jnp.max(jnp.abs(points), axis=(0, 1))
    usable = usable & (spread > 16.0 * eps * reach) & (spread > floor(spread) ** 2) & (radius > floor(radius) ** 2)
    usable = usable & (reach < 1.0 / floor(reach) ** 2) & (radius < 1.0 / floor(radius) ** 2)
    unit, radius = jnp.where(usable, spread, 1.0), jnp.where(usable, radius, 1.0)
    x, u = x / unit[None, None], pixels / radius[None, None]
    turned = jnp.stack([_COSINE * u[:, 0] - _SINE * u[:, 1], _SINE * u[:, 0] + _COSINE * u[:, 1]], axis=1)

    h = jnp.concatenate([x, jnp.ones_like(x[:, :1])], axis=1)  # [4, 4, *lanes]
    zero = jnp.zeros_like(h)
    rows = [jnp.concatenate([h, zero, -turned[:, 0][:, None] * h], axis=1)]
    rows += [jnp.concatenate([zero, h, -turned[:, 1][:, None] * h], axis=1)]
    basis, independent = null_space_and_rank(jnp.concatenate(rows))
    basis = basis.reshape(4, 3, 4, *usable.shape)
    quadrics = _quadrics(basis)
    orthonormal, distinct = orthonormal_rows(quadrics[:3])
    a, valid, _ = three_quadrics(orthonormal, 3 if double else 2)
    p = _combined(basis, a)  # [3, 4, 8, *lanes]
    squares = [p[i, 0] * p[i, 0] + p[i, 1] * p[i, 1] + p[i, 2] * p[i, 2] for i in range(2)]
    depths = jnp.stack([sum(p[2, b] * h[n, b][None] for b in range(4)) for n in range(4)])  # type: ignore[misc]
    in_front = jnp.all(depths > 0, axis=0) | jnp.all(depths < 0, axis=0)
    mismatch = jnp.abs(squares[0] - squares[1]) / (squares[0] + squares[1] + floor(squares[0]))
    # Not mirrored: the determinant has the sign of the depths.
    rows3 = [tuple(p[i, j] for j in range(3)) for i in range(3)]
    upright = dot3(rows3[0], cross3(rows3[1], rows3[2])) * depths[0] > 0
    a, valid = _nearest(a, valid & in_front & upright & (usable & independent & distinct)[None], mismatch)
    p = _combined(basis, a)
    quaternion, t, focal, proper = _camera(p, sign(sum(p[2, b] * h[0, b][None] for b in range(4))))  # type: ignore[arg-type]
    valid = valid & proper & (focal > floor(focal)) & jnp.isfinite(focal)
    state = jnp.stack([*quaternion, *t, jnp.log(jnp.where(valid, focal, 1.0))])
    state = jnp.where(valid[None], state, jnp.eye(8, dtype=dtype)[0].reshape(8, *(1,) * valid.ndim))

    def step(_: object, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        return _gauss_newton(carry[0], x, turned)

    state, size = jax.lax.fori_loop(0, 7 if double else 4, step, (state, jnp.zeros_like(focal)))
    # Converged: the last step is rounding, up to the condition of the problem.
    valid = valid & (size < (1e-6 if double else 3e-5))
    # The image is turned back about the optical axis: by half of the angle in the quaternion.
    c, s = ((0.5 * (1.0 + _COSINE)) ** 0.5, -((0.5 * (1.0 - _COSINE)) ** 0.5))
    w, i, j, k = (state[n] for n in range(4))
    w, i, j, k = c * w - s * k, c * i - s * j, c * j + s * i, c * k + s * w
    t = (_COSINE * state[4] + _SINE * state[5], -_SINE * state[4] + _COSINE * state[5], state[6])
    focal = jnp.exp(state[7]) * radius[None]
    offset = rotate((w, i, j, k), tuple(mean[b][None] for b in range(3)))
    model = jnp.stack([w, i, j, k, *(unit[None] * t[b] - offset[b] for b in range(3))], axis=1)
    for n in range(4):
        turned_x = rotate((w, i, j, k), tuple(x[n, b][None] for b in range(3)))
        valid = valid & (turned_x[2] + state[6] > 0)
    # Two starts may lead to one minimum.
    same = jnp.abs(focal[1] - focal[0]) < 8.0 * eps**0.5 * focal[0]
    same = same & (1.0 - jnp.abs(lane_sum(model[0, :4] * model[1, :4], axis=0)) < 8.0 * eps)
    first = jnp.arange(_KEPT).reshape(_KEPT, *(1,) * same.ndim) == 0
    valid = valid & jnp.isfinite(focal) & jnp.all(jnp.isfinite(model), axis=1)
    valid = valid & (first | ~(same & valid[0])[None])
    identity = jnp.eye(7, dtype=dtype)[0].reshape(1, 7, *(1,) * same.ndim)
    return jnp.where(valid[:, None], model, identity), jnp.where(valid, focal, 1.0), valid


_solve = lanes_last(one_kernel(_kernel), chunk=128)


def _candidates(data: Data) -> Candidates[FocalCamera]:
    poses, focal, valid = _solve(*data)
    return Candidates(models=FocalCamera(SE3(poses), focal), valid=valid)


def _perturb(model: FocalCamera, tangent: Array) -> FocalCamera:
    return FocalCamera(perturb_camera(model.cam_from_world, tangent[:6]), model.focal * (1.0 + tangent[6]))


def _stationarity(model: FocalCamera, data: Data) -> Array:
    """Seven equations: the gradient of (2), as a force, a torque about the camera's centre, and that of log f."""
    points_world, pixels = data
    y = model.cam_from_world @ points_world
    ratio = safe_divide(y[:, :2], jnp.broadcast_to(y[:, 2:], (4, 2)))
    residual = model.focal * ratio - pixels
    push = safe_divide(model.focal * residual, jnp.broadcast_to(y[:, 2:], (4, 2)))
    pull = jnp.concatenate([push, -jnp.sum(push * ratio, axis=1, keepdims=True)], axis=1)
    torque = jnp.sum(jnp.cross(y, pull), axis=0)
    return jnp.concatenate([jnp.sum(pull, axis=0), torque, jnp.sum(residual * ratio)[None] * model.focal])


_p4pf = implicit(_candidates, _stationarity, _perturb, 7)


def p4pf(points_world: Float[ArrayLike, "4 3"], pixels: Float[ArrayLike, "4 2"]) -> Candidates[FocalCamera]:
    """Find the pose and the focal length of a camera from four points.

    For a batch, `jax.vmap(p4pf, in_axes=-1, out_axes=-1)` on arrays [4, 3, batch] is the fast layout on a CPU.

    Args:
        points_world: Points in world coordinates, one per row; they may lie on a plane.
        pixels: Where they are seen, relative to the principal point.

    Returns:
        Two slots of `cam_from_world` and `focal`. Valid slots are distinct, have all points in front, and are minima of
        the sum of squared reprojection errors (the four points give one equation too many); without noise one of them
        is exact. The others hold the identity and a focal length of one.

    Degenerate input: a plane seen frontally leaves focal length and distance undetermined: what comes out, if anything,
        means nothing. Points on a line, coincident points and anything not finite leave no slot valid.
    Differentiability: both modes, any order, in points and pixels: that of the minimum, by the implicit function
        theorem; zero for slots that are not valid.

    Raises:
        ValueError: If there are not four points and four pixels.
    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 4.0], [1.0, 0.0, 5.0], [0.0, 1.0, 6.0], [1.0, 1.5, 4.0]])
        >>> candidates = p4pf(points, 800.0 * points[:, :2] / points[:, 2:])
        >>> errors = jnp.abs(candidates.models.focal - 800.0)
        >>> bool(jnp.any(candidates.valid & (errors < 1.0)))
        True
    """
    points_world, pixels = jnp.asarray(points_world), jnp.asarray(pixels)
    if points_world.shape != (4, 3) or pixels.shape != (4, 2):
        raise ValueError(
            f"found points {points_world.shape} and pixels {pixels.shape}; expected four of each, (4, 3) and (4, 2)"
        )
    dtype = jnp.result_type(points_world, pixels)
    return _p4pf((points_world.astype(dtype), pixels.astype(dtype)))
