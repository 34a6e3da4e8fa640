"""Pose of a rig of cameras from four points or more.

Four triples of the points, spread over all of them, give up to 32 poses by the generalised three-point problem
(`_six_linear`). The one that fits all points best starts damped Gauss-Newton steps on

    C(R, t) = ½ Σ w_i |y_i / |y_i| - f_i|²,      y_i = R X_i + t - c_i,                                            (1)

for rays that start at c_i and point along f_i. Minimal solutions need no parallax between the cameras and no special
treatment of planes; linear ones, in the twelve entries of R and t, need six points and lose the scale where the rays
meet in one point, which is where rigs are when they look at something far away.

References:
    L. Kneip, P. Furgale, R. Siegwart. Using multi-camera systems in robotics: efficient solutions to the NPnP problem.
    ICRA 2013 (the problem and its errors).
"""

import jax
import jax.numpy as jnp

from vojax._numerics import cross3, dot3, normalize
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import complement, rotate, squared
from ._dlt_pnp import clean
from ._gp3p import unit_bearings
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last
from ._six_linear import six_linear_equations
from ._symmetric import swept_inverse

Data = tuple[Array, Array, Array, Array]
_TRIPLES = 4


def _triples(x: Array, centers: Array, rays: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Points, centres and rays of the triples, each [3, 3, triples, *lanes], from points of positive weight."""
    used = weights > 0
    place = jnp.cumsum(used.astype(jnp.int32), axis=0) - 1
    count = jnp.maximum(jnp.sum(used.astype(jnp.int32), axis=0), 1)
    packed = jnp.concatenate([x, centers, rays], axis=1)  # [n, 9, *lanes]
    corners = []
    for corner in range(3):
        chosen = []
        for triple in range(_TRIPLES):
            target = (triple + corner * jnp.maximum(count // 3, 1)) % count
            here = used & (place == target[None])
            chosen.append(jnp.sum(jnp.where(here[:, None], packed, 0.0), axis=0))
        corners.append(jnp.stack(chosen, axis=1))
    every = jnp.stack(corners)  # [3, 9, triples, *lanes]
    return every[:, :3], every[:, 3:6], every[:, 6:]


def _start(x: Array, centers: Array, rays: Array, weights: Array) -> tuple[Array, Array]:
    """Of the poses [7, *lanes] of all triples the one with the least cost, and whether there is one."""
    points, origins, f = _triples(x, centers, rays, weights)
    tangents = [jnp.stack(e, axis=1) for e in complement((f[:, 0], f[:, 1], f[:, 2]))]
    normals = jnp.concatenate(tangents)
    constants = jnp.concatenate([jnp.sum(e * origins, axis=1) for e in tangents])
    models, valid = six_linear_equations(normals, jnp.concatenate([points, points]), constants, 2)
    models = jnp.moveaxis(models, 1, 0)  # [7, 8, triples, *lanes]
    models = models.reshape(7, -1, *models.shape[3:])
    valid = valid.reshape(-1, *valid.shape[2:])
    cost = _misfit(models, x[:, :, None], centers[:, :, None], rays[:, :, None], weights[:, None])
    cost = jnp.where(valid & (cost >= 0), cost, jnp.inf)
    best = jnp.argmin(cost, axis=0)[None] == jnp.arange(cost.shape[0]).reshape(-1, *(1,) * (cost.ndim - 1))
    return jnp.sum(jnp.where(best[None] & valid[None], models, 0.0), axis=1), jnp.any(best & valid, axis=0)


def _seen(model: Array, x: Array, centers: Array) -> tuple[Array, Array, Array]:
    """What the points are turned to, and unit directions to them, [3, n, ...]; and inverse distances."""
    turned = rotate(tuple(model[i][None] for i in range(4)), (x[:, 0], x[:, 1], x[:, 2]))
    y = tuple(turned[a] + model[4 + a][None] - centers[:, a] for a in range(3))
    squares = squared(y)
    inverse = 1.0 / jnp.sqrt(jnp.where(squares > 0, squares, 1.0))
    return jnp.stack(turned), jnp.stack([c * inverse for c in y]), inverse


def _misfit(model: Array, x: Array, centers: Array, rays: Array, weights: Array) -> Array:
    """Twice the cost (1)."""
    _, u, _ = _seen(model, x, centers)
    return jnp.sum(weights * squared(tuple(u[a] - rays[:, a] for a in range(3))), axis=0)


def _step(model: Array, x: Array, centers: Array, rays: Array, weights: Array, damping: Array) -> tuple[Array, Array]:
    """A damped Gauss-Newton step, and whether its matrix is regular."""
    turned, u, inverse = _seen(model, x, centers)
    zero, one = jnp.zeros_like(inverse), jnp.ones_like(inverse)
    axes = ((one, zero, zero), (zero, one, zero), (zero, zero, one))
    columns = []
    for direction in [*axes, *(cross3(axis, (turned[0], turned[1], turned[2])) for axis in axes)]:
        along = dot3(direction, (u[0], u[1], u[2]))
        columns.append(jnp.stack([(direction[a] - along * u[a]) * inverse for a in range(3)]))
    jacobian = jnp.stack(columns)  # [6, 3, n, *lanes]
    error = u - jnp.moveaxis(rays, 1, 0)
    normal = jnp.sum(jacobian[:, None] * (weights[None, None] * jacobian)[None], axis=(2, 3))
    gradient = jnp.sum(jacobian * (weights[None] * error)[None], axis=(1, 2))
    identity = jnp.eye(6, dtype=x.dtype).reshape(6, 6, *(1,) * damping.ndim)
    inverse6, regular = swept_inverse(normal * (1.0 + identity * damping[None, None]))
    change = -jnp.sum(inverse6 * gradient[None], axis=1)
    half = tuple(0.5 * change[3 + a] for a in range(3))
    axis = (model[1], model[2], model[3])
    vector = cross3(half, axis)
    quaternion = jnp.stack([model[0] - dot3(half, axis), *(axis[a] + half[a] * model[0] + vector[a] for a in range(3))])
    quaternion = quaternion / jnp.sqrt(jnp.sum(quaternion * quaternion, axis=0))[None]
    return jnp.concatenate([quaternion, model[4:] + change[:3]]), regular


def _polish(model: Array, x: Array, centers: Array, rays: Array, weights: Array, steps: int) -> tuple[Array, Array]:
    """Steps on (1), damped until they descend; and whether the last matrix is regular."""
    eps = float(jnp.finfo(x.dtype).eps)
    rounding = (8.0 * eps) ** 2 * jnp.sum(weights, axis=0)

    def step(k: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        model, misfit, damping, _ = state
        # At a minimum rounding decides which of two costs is less: the last steps are plain ones, nearly as good.
        last = k >= steps
        moved, regular = _step(model, x, centers, rays, weights, jnp.where(last, 0.0, damping))
        cost = _misfit(moved, x, centers, rays, weights)
        better = (cost <= misfit * jnp.where(last, 1.0 + eps**0.5, 1.0) + rounding) & regular
        return (
            jnp.where(better[None], moved, model),
            jnp.where(better, cost, misfit),
            jnp.clip(jnp.where(better, 0.1 * damping, 10.0 * damping), 1e-9, 1e6),
            regular,
        )

    misfit = _misfit(model, x, centers, rays, weights)
    state = (model, misfit, jnp.full_like(misfit, 1e-4), jnp.ones_like(misfit, dtype=bool))
    model, _, _, regular = jax.lax.fori_loop(0, steps + 4, step, state)
    return model, regular


def _kernel(points: Array, centers: Array, bearings: Array, weights: Array) -> tuple[Array, Array]:
    """Pose [1, 7, *lanes] and validity [1, *lanes]."""
    eps = float(jnp.finfo(points.dtype).eps)
    usable, (points, bearings), weights = clean((points, bearings), weights)
    size = jnp.max(jnp.abs(centers), axis=(0, 1))
    usable = usable & jnp.isfinite(size) & (jnp.sum(weights > 0, axis=0) >= 4)
    centers = jnp.where(usable[None, None], centers, 0.0)
    weights = jnp.where(usable[None], weights, 0.0)
    f, _ = unit_bearings(bearings)
    rays = jnp.stack(f, axis=1)
    length = jnp.max(jnp.abs(bearings), axis=1)
    usable = usable & jnp.all((weights == 0) | (length > 0), axis=0)
    total = jnp.where(usable, jnp.sum(weights, axis=0), 1.0)
    weights = weights / total[None]
    # Both frames about the middle of what is in them.
    mean, middle = (a[0] + jnp.sum(weights[:, None] * (a - a[:1]), axis=0) for a in (points, centers))
    x, c = points - mean[None], centers - middle[None]
    unit = jnp.max(jnp.abs(x) * (weights > 0)[:, None], axis=(0, 1))
    reach = jnp.max(jnp.abs(points), axis=(0, 1))
    usable = usable & (unit > 16.0 * eps * reach)
    unit = jnp.where(usable, unit, 1.0)
    x, c = x / unit[None, None], c / unit[None, None]
    model, found = _start(x, c, rays, weights)
    identity = jnp.eye(7, dtype=model.dtype)[0].reshape(7, *(1,) * found.ndim)
    model = jnp.where((found & usable)[None], model, identity)
    model, regular = _polish(model, x, c, rays, weights, 6)
    _, u, _ = _seen(model, x, c)
    cosine = sum(u[a] * rays[:, a] for a in range(3))
    ok = usable & found & regular & (jnp.sum(weights * cosine, axis=0) > 0)
    offset = rotate(tuple(model[i] for i in range(4)), (mean[0], mean[1], mean[2]))
    model = jnp.concatenate([model[:4], unit[None] * model[4:] + middle - jnp.stack(offset)])
    ok = ok & jnp.all(jnp.isfinite(model), axis=0)
    return jnp.where(ok[None], model, identity)[None], ok[None]


# 32 starts times n points: 256 lanes of them fit into the cache.
_solve = lanes_last(_kernel, chunk=256)


def _candidates(data: Data) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


def _stationarity(rig_from_world: SE3, data: Data) -> Array:
    """Six equations: the gradient of (1), as a force and as a torque about the origin of the rig."""
    points_world, centers, bearings, weights = data
    moved = rig_from_world @ points_world
    y = moved - centers
    directions, rays = normalize(y), normalize(bearings)
    squares = jnp.sum(y * y, axis=-1, keepdims=True)
    inverse = jnp.where(squares > 0, jax.lax.rsqrt(jnp.where(squares > 0, squares, 1.0)), 0.0)
    cosine = jnp.sum(directions * rays, axis=-1, keepdims=True)
    force = weights[:, None] * (rays - directions * cosine) * inverse
    return jnp.concatenate([jnp.sum(force, axis=0), jnp.sum(jnp.cross(moved, force), axis=0)])


_gpnp = implicit(_candidates, _stationarity, perturb_camera, 6)


def gpnp(
    points_world: Float[ArrayLike, "n 3"],
    centers: Float[ArrayLike, "n 3"],
    bearings: Float[ArrayLike, "n 3"],
    weights: Float[ArrayLike, "n"] | None = None,
) -> Candidates[SE3]:
    """Find the pose of a rig of calibrated cameras from four points or more.

    Args:
        points_world: Points in world coordinates, one per row, at least four; they may lie on a plane.
        centers: Where the ray to each point starts, in the rig's frame: the centre of the camera that sees it.
        bearings: Directions of the rays in the rig's frame, of any positive length.
        weights: One non-negative weight per point, as 1 / σ² of its bearing. All equal by default.

    Returns:
        One slot with `rig_from_world` in the unit of points and centres: a minimum of Σ w |direction - bearing|².

    Degenerate input: points on a line seen from one centre, coincident points, fewer than four with positive weight,
        negative weights, zero bearings and anything not finite leave the slot invalid, with the identity in it. Four
        points may have a second minimum that is as good.
    Differentiability: both modes, any order, in all arguments: that of the minimum, by the implicit function theorem,
        exact if the steps have converged (with a few pixels of noise they have). Zero for an invalid slot.

    Raises:
        ValueError: If there are fewer than four points or shapes do not match.
    References: see the module.
    """
    return _gpnp(correspondences(points_world, centers, bearings, weights))


def correspondences(
    points_world: ArrayLike, centers: ArrayLike, bearings: ArrayLike, weights: ArrayLike | None
) -> Data:
    """Arrays of one dtype, weights filled in; refuses what does not match or is too little."""
    arrays = tuple(jnp.asarray(x) for x in (points_world, centers, bearings))
    shape = arrays[0].shape
    for x in arrays[1:]:
        if x.shape != shape:
            raise ValueError(f"found points {shape} with centres or bearings {x.shape}; expected equal shapes")
    if shape[0] < 4:
        raise ValueError(f"found {shape[0]} points; expected at least 4: use gp3p for three")
    dtype = jnp.result_type(*arrays)
    weights = jnp.ones(shape[:1], dtype) if weights is None else jnp.asarray(weights)
    if weights.shape != shape[:1]:
        raise ValueError(f"found weights of shape {weights.shape}; expected one per point, {shape[:1]}")
    dtype = jnp.result_type(dtype, weights)
    return arrays[0].astype(dtype), arrays[1].astype(dtype), arrays[2].astype(dtype), weights.astype(dtype)
