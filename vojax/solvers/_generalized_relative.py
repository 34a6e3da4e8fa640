"""Motion of a rig of cameras from seventeen correspondences or more, with its scale.

A ray from c along f has the moment m = c x f. That rays 0 and 1 meet after the motion (R, t) is one equation,

    f1 · E f0 + f1 · R m0 + m1 · R f0 = 0,        E = [t]x R,                                                      (1)

linear in the eighteen entries of E and R. Where cameras see the same points before and after, as those of most rigs do,
E = 0 and R = I solve all of them, so that the least vector of the equations is no motion. The least vector for a given
length of E alone is: the nine columns of R are eliminated by reflections, and E is the least vector of what is left
(Li, Hartley & Kim). It has two rotations; for each of them (1) is linear in t,

    t · (R f0 x f1) = -(f1 · R m0 + m1 · R f0),                                                                    (2)

and the one that fits better starts Gauss-Newton steps on the sum of squares of (1) over R and t.

Preconditions: the rig moves, its cameras do not share one centre, and there is parallax.

References:
    R. Pless. Using many cameras as one. CVPR 2003. H. Li, R. Hartley, J. Kim. A linear approach to motion estimation
    using generalized camera models. CVPR 2008.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import Vector3, cross3, dot3, normalize, symmetric_inverse
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import Components, floor, quaternion_from_rotation, rotate, sign
from ._gp3p import unit_bearings
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last
from ._linear_epipolar import least_vector_and_second, matrix_rows
from ._svd3 import svd3
from ._symmetric import swept_inverse

Data = tuple[Array, Array, Array, Array]


def _without_first_columns(rows: Array, count: int) -> Array:
    """The rows [n - count, columns - count, *lanes] of an orthogonal transform whose first columns are zero.

    A column that depends on those before it is skipped; an equation goes with it.
    """
    eps = float(jnp.finfo(rows.dtype).eps)
    largest = jnp.max(jnp.sum(rows[:, :count] * rows[:, :count], axis=0), axis=0)
    for _ in range(count):
        x = rows[:, 0]
        length2 = jnp.sum(x * x, axis=0)
        usable = (length2 > (16.0 * eps) ** 2 * largest) & (length2 > floor(length2) ** 2)
        length = jnp.sqrt(jnp.where(usable, length2, 1.0))
        alpha = -sign(x[0]) * length
        v = jnp.concatenate([(x[0] - alpha)[None], x[1:]])
        beta = jnp.where(usable, 1.0 / (length * length - alpha * x[0]), 0.0)
        along = jnp.sum(rows[:, 1:] * v[:, None], axis=0) * beta[None]
        rows = (rows[:, 1:] - v[:, None] * along[None])[1:]
    return rows


def _rotations(essential: Array) -> tuple[Components, Components]:
    """Quaternions of the two rotations of E."""
    u, _, v = svd3(matrix_rows(essential))
    quaternions = []
    for side in (1.0, -1.0):
        # U W Vᵀ with the quarter turn W about the third axis.
        first, second = tuple(side * c for c in u[1]), tuple(-side * c for c in u[0])
        rotation = [[first[i] * v[0][j] + second[i] * v[1][j] + u[2][i] * v[2][j] for j in range(3)] for i in range(3)]
        quaternions.append(quaternion_from_rotation(rotation))
    return quaternions[0], quaternions[1]


def _terms(quaternion: Components, f0: Vector3, c0: Vector3) -> tuple[Vector3, Vector3]:
    lanes = tuple(c[None] for c in quaternion)
    return rotate(lanes, f0), rotate(lanes, c0)


def _translation(
    quaternion: Components, f0: Vector3, f1: Vector3, c0: Vector3, c1: Vector3
) -> tuple[Components, Array, Array]:
    """The t that fits (2) best, the sum of squares that is left, and whether t is determined."""
    b, a = _terms(quaternion, f0, c0)
    g = jnp.stack(cross3(b, f1))  # [3, n, *lanes]
    rhs = -dot3(tuple(x - y for x, y in zip(a, c1, strict=True)), vector(g))
    inverse, regular = symmetric_inverse(jnp.sum(g[:, None] * g[None], axis=2))
    t = jnp.zeros_like(g[:, 0])
    for _ in range(2):  # the second time for what rounding left
        left = rhs - jnp.sum(g * t[:, None], axis=0)
        t = t + jnp.sum(inverse * jnp.sum(g * left[None], axis=1)[None], axis=1)
    left = rhs - jnp.sum(g * t[:, None], axis=0)
    return (t[0], t[1], t[2]), jnp.sum(left * left, axis=0), regular


def vector(x: Array) -> Vector3:
    """Components along the first axis."""
    return (x[0], x[1], x[2])


def _gauss_newton(state: Array, f0: Vector3, f1: Vector3, c0: Vector3, c1: Vector3) -> tuple[Array, Array]:
    """One step on (1) for states [7, *lanes], and whether its matrix is regular and it has converged."""
    quaternion = tuple(state[i] for i in range(4))
    b, a = _terms(quaternion, f0, c0)
    d = tuple(a[i] + state[4 + i][None] - c1[i] for i in range(3))
    g = cross3(b, f1)
    # f1 · (d x R f0) = d · g; it changes by δt · g + φ · (R c0 x g + R f0 x (f1 x d)).
    turn = tuple(x + y for x, y in zip(cross3(a, g), cross3(b, cross3(f1, d)), strict=True))
    jacobian = jnp.stack([*g, *turn])
    residual = dot3(d, g)
    normal = jnp.sum(jacobian[:, None] * jacobian[None], axis=2)
    inverse, regular = swept_inverse(normal)
    step = -jnp.sum(inverse * jnp.sum(jacobian * residual[None], axis=1)[None], axis=1)
    half = tuple(0.5 * step[3 + i] for i in range(3))
    limit = jnp.maximum(1.0, 2.0 * jnp.sqrt(dot3(half, half)))
    half = tuple(c / limit for c in half)
    w, axis = quaternion[0], quaternion[1:]
    product = cross3(half, axis)
    moved = jnp.stack([w - dot3(half, axis), *(axis[i] + half[i] * w + product[i] for i in range(3))])
    moved = moved / jnp.sqrt(jnp.sum(moved * moved, axis=0))[None]
    # Converged: a step that no longer matters, in radians and in the unit of the centres.
    small = 1e-8 if state.dtype == jnp.float64 else 1e-3
    settled = jnp.max(jnp.abs(step), axis=0) < small * (1.0 + jnp.max(jnp.abs(state[4:]), axis=0))
    return jnp.concatenate([moved, state[4:] + step[:3]]), regular & settled


def _kernel(rays0: Array, rays1: Array, centers0: Array, centers1: Array) -> tuple[Array, Array]:
    """Pose [1, 7, *lanes] and validity [1, *lanes]."""
    double = rays0.dtype == jnp.float64
    eps = float(jnp.finfo(rays0.dtype).eps)
    f0, proper0 = unit_bearings(rays0)
    f1, proper1 = unit_bearings(rays1)
    usable = proper0 & proper1
    middles, arms = [], []
    for centers in (centers0, centers1):
        middle = centers[0] + jnp.sum(centers - centers[:1], axis=0) / centers.shape[0]
        usable = usable & jnp.all(jnp.isfinite(centers), axis=(0, 1)) & jnp.all(jnp.isfinite(middle), axis=0)
        middles.append(middle)
        arms.append(centers - middle[None])
    reach = jnp.maximum(jnp.max(jnp.abs(centers0), axis=(0, 1)), jnp.max(jnp.abs(centers1), axis=(0, 1)))
    unit = jnp.maximum(jnp.max(jnp.abs(arms[0]), axis=(0, 1)), jnp.max(jnp.abs(arms[1]), axis=(0, 1)))
    usable = usable & (unit > 64.0 * eps * reach) & (unit > floor(unit) ** 2) & (unit < 1.0 / floor(unit) ** 2)
    unit = jnp.where(usable, unit, 1.0)
    c0, c1 = ([jnp.where(usable, arm[:, i], 0.0) / unit[None] for i in range(3)] for arm in arms)
    m0, m1 = cross3(c0, f0), cross3(c1, f1)
    of_r = [f1[i] * m0[j] + m1[i] * f0[j] for i in range(3) for j in range(3)]
    of_e = [f1[i] * f0[j] for i in range(3) for j in range(3)]
    rows = _without_first_columns(jnp.stack([*of_r, *of_e], axis=1), 9)
    # Seventeen correspondences leave eight equations, which have a null vector; a square needs a ninth.
    if rows.shape[0] < 9:
        rows = jnp.concatenate([rows, jnp.zeros_like(rows[:1])])
    essential, _ = least_vector_and_second(rows, 6 if double else 4)
    essential = jnp.where(usable[None], essential, jnp.eye(9, dtype=rows.dtype)[1].reshape(9, *(1,) * usable.ndim))

    first, second = _rotations(essential)
    t_first, cost_first, regular_first = _translation(first, f0, f1, c0, c1)
    t_second, cost_second, regular_second = _translation(second, f0, f1, c0, c1)
    cost_first = jnp.where(regular_first, cost_first, jnp.inf)
    better = regular_second & (cost_second < cost_first)
    chosen = [jnp.where(better, y, x) for x, y in zip((*first, *t_first), (*second, *t_second), strict=True)]
    usable = usable & (regular_first | regular_second)
    identity = jnp.eye(7, dtype=rows.dtype)[0].reshape(7, *(1,) * usable.ndim)
    state = jnp.where(usable[None], jnp.stack(chosen), identity)

    def step(_: object, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        return _gauss_newton(carry[0], f0, f1, vector(jnp.stack(c0)), vector(jnp.stack(c1)))

    state, regular = jax.lax.fori_loop(0, 20 if double else 8, step, (state, usable))
    # Rotations are about the middles of the centres: R (c0 + o0) + t = c1 + o1.
    offset = rotate(tuple(state[i] for i in range(4)), vector(middles[0]))
    model = jnp.concatenate([state[:4], unit[None] * state[4:] + middles[1] - jnp.stack(offset)])
    ok = usable & regular & jnp.all(jnp.isfinite(model), axis=0)
    return jnp.where(ok[None], model, identity)[None], ok[None]


_solve = lanes_last(_kernel, chunk=256)


def _candidates(data: Data) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


def _stationarity(rig1_from_rig0: SE3, data: Data) -> Array:
    """Six equations: the gradient of half the sum of squares of (1)."""
    rays0, rays1, centers0, centers1 = data
    f0, f1 = normalize(rays0), normalize(rays1)
    b, a = rig1_from_rig0.rotation() @ f0, rig1_from_rig0 @ centers0
    d = a - centers1
    g = jnp.cross(b, f1)
    residual = jnp.sum(d * g, axis=-1, keepdims=True)
    # A turn about the origin of rig 1 moves R c0 + t as a whole.
    turn = jnp.cross(a, g) + jnp.cross(b, jnp.cross(f1, d))
    return jnp.concatenate([jnp.sum(residual * g, axis=0), jnp.sum(residual * turn, axis=0)])


_generalized = implicit(_candidates, _stationarity, perturb_camera, 6)


def generalized_relative_pose(
    rays0: Float[ArrayLike, "n 3"],
    rays1: Float[ArrayLike, "n 3"],
    centers0: Float[ArrayLike, "n 3"],
    centers1: Float[ArrayLike, "n 3"],
) -> Candidates[SE3]:
    """Find the motion of a rig of cameras, with its scale, from seventeen correspondences or more.

    Args:
        rays0: Directions of the rays in rig 0's frame, one per row, of any positive length.
        rays1: Those of the matching rays in rig 1's frame.
        centers0: Where the rays of view 0 start, in rig 0's frame: the centre of the camera that saw the point.
        centers1: Where those of view 1 start, in rig 1's frame.

    Returns:
        One slot with `rig1_from_rig0`, in the unit of the centres: a local minimum of the sum of squares of (1) for
        unit rays, exact without noise; invalid where the iteration has not settled, as after a bad linear start.

    Degenerate input: rays that all start at one point (the scale is unknown), no motion or a pure rotation about the
        middle of the centres, points without parallax, zero rays and anything not finite leave the slot invalid, with
        the identity in it, or with rounding mean nothing. Matches within each camera alone are fine, but then a rig
        that moves without turning, or on a circle about an axis through its cameras, has no scale.
    Differentiability: both modes, any order, in all arguments: that of the minimum, by the implicit function theorem;
        zero for an invalid slot.

    Raises:
        ValueError: If there are fewer than 17 correspondences or shapes do not match.
    References: see the module.
    """
    return _generalized(correspondences(rays0, rays1, centers0, centers1))


def correspondences(rays0: ArrayLike, rays1: ArrayLike, centers0: ArrayLike, centers1: ArrayLike) -> Data:
    """Arrays of one dtype; refuses what does not match or is too little."""
    arrays = tuple(jnp.asarray(x) for x in (rays0, rays1, centers0, centers1))
    shape = arrays[0].shape
    for x in arrays[1:]:
        if x.shape != shape:
            raise ValueError(f"found rays {shape} with rays or centres {x.shape}; expected equal shapes")
    if shape[0] < 17:
        raise ValueError(f"found {shape[0]} correspondences; expected at least 17")
    dtype = jnp.result_type(*arrays)
    return tuple(x.astype(dtype) for x in arrays)  # type: ignore[return-value]
