"""Nonlinear triangulation: the maximum-likelihood point of N observations, its covariance, and whether to trust it.

The point is written X = anchor + n / rho, with the anchor at the first used camera centre, n a unit direction and rho
the inverse distance in units of the camera spread. A view then sees R n + rho (R anchor + t), which is smooth through
rho = 0: Gauss-Newton converges in a few steps for points at any distance, and parallel rays are an ordinary case.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import cholesky_solve, normalize, safe_divide, safe_norm, safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.cameras import Camera
from vojax.lie import SE3

from ._linear_triangulation import FAR_SPREADS


@dataclasses.dataclass(frozen=True)
class TriangulationOptions:
    """When to stop, and which points to call valid.

    Args:
        steps: Damped Gauss-Newton steps, a fixed number.
        min_angle_rad: Least angle between two of the used rays.
        max_relative_std: Largest standard deviation of the point, along its worst direction, over its distance from the
            nearest used camera.
    """

    steps: int = 5
    min_angle_rad: float = 0.005
    max_relative_std: float = 0.2


class Triangulation(eqx.Module):
    """A refined point.

    Args:
        point: In the world frame.
        covariance: Of the point, from the Gauss-Newton matrix and the given `sigma_px`.
        valid: In front of every used camera, and neither its angle too small nor its deviation too large.
        angle_rad: Largest angle between two used rays.
        rms_px: Root mean square of the used residuals' lengths, in pixels.
    """

    point: Float[Array, "3"]
    covariance: Float[Array, "3 3"]
    valid: Bool[Array, ""]
    angle_rad: Float[Array, ""]
    rms_px: Float[Array, ""]


class _Views(eqx.Module):
    """Everything the residuals depend on: differentiable inputs of the optimum."""

    pixels: Array
    camera: Camera
    rotations: Array  # [c, 3, 3], camera from world
    offsets: Array  # [c, 3], (R anchor + t) / spread
    weights: Array  # [c], mask over sigma


def _rays(views: _Views, direction: Array, inverse: Array) -> tuple[Array, Array, Array]:
    """Rays R n + rho offset of a point in every camera."""
    r, o = views.rotations, views.offsets
    x, y, z = direction[0], direction[1], direction[2]
    rotated = [r[:, i, 0] * x + r[:, i, 1] * y + r[:, i, 2] * z + inverse * o[:, i] for i in range(3)]
    return rotated[0], rotated[1], rotated[2]


def _project(camera: Camera, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    """Pixels [c]; the camera's leaves are scalars (one camera for all views) or carry a leading axis of views."""
    axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, camera)
    return jax.vmap(lambda one, *xyz: one.project_xyz(*xyz), in_axes=(axes, 0, 0, 0))(camera, x, y, z)


def _residuals(views: _Views, direction: Array, inverse: Array) -> Array:
    """Whitened residuals [2, c]; 0 in unused views."""
    u, v = _project(views.camera, *_rays(views, direction, inverse))
    used = views.weights > 0
    du = jnp.where(used, u - views.pixels[:, 0], 0.0) * views.weights
    dv = jnp.where(used, v - views.pixels[:, 1], 0.0) * views.weights
    return jnp.stack([du, dv])


def _tangent_basis(direction: Array) -> Array:
    """Two unit rows orthogonal to a unit vector (Duff et al., 2017), without derivative."""
    x, y, z = jax.lax.stop_gradient(direction)
    sign = jnp.where(z < 0, -1.0, 1.0).astype(direction.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    return jnp.stack([jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x]), jnp.stack([b, sign + y * y * a, -y])])


def _move(direction: Array, inverse: Array, basis: Array, step: Array) -> tuple[Array, Array]:
    moved = direction + step[0] * basis[0] + step[1] * basis[1]
    return moved / jnp.sqrt(jnp.sum(moved * moved)), inverse + step[2]


def _normal_equations(views: _Views, direction: Array, inverse: Array) -> tuple[Array, Array, Array]:
    """Gauss-Newton matrix, gradient and cost about a point."""
    basis = _tangent_basis(direction)

    def at(step):
        return _residuals(views, *_move(direction, inverse, basis, step))

    zero = jnp.zeros(3, direction.dtype)
    residuals, push = jax.linearize(at, zero)
    columns = jax.vmap(push)(jnp.eye(3, dtype=direction.dtype)).reshape(3, -1)
    gram = jnp.sum(columns[:, None, :] * columns[None, :, :], axis=2)
    gradient = jnp.sum(columns * residuals.reshape(1, -1), axis=1)
    return gram, gradient, jnp.sum(residuals * residuals)


def _solve(matrix: Array, rhs: Array) -> Array:
    return cholesky_solve(matrix, rhs[:, None])[0][:, 0]


@eqx.filter_custom_jvp
def _optimum(views: _Views, direction: Array, inverse: Array, *, steps: int) -> tuple[Array, Array]:
    """Minimise the cost by a fixed number of damped Gauss-Newton steps from (direction, inverse)."""

    def step(_, state):
        direction, inverse, damping, gram, gradient, cost = state
        scale = jnp.diagonal(gram)
        damped = gram + jnp.diag(damping * scale + float(jnp.finfo(gram.dtype).eps) * (1.0 + jnp.max(scale)))
        increment = _solve(damped, -gradient)
        # At most half a radian, and half the way to another scale of distance, at a time.
        length = safe_norm(increment[:2])
        increment = increment * jnp.minimum(1.0, safe_divide(jnp.full_like(length, 0.5), length) + (length == 0))
        candidate = _move(direction, inverse, _tangent_basis(direction), increment)
        new_gram, new_gradient, new_cost = _normal_equations(views, *candidate)
        # Rounding of the cost must not stop a step that still improves the point.
        better = new_cost <= cost * (1.0 + 4.0 * float(jnp.finfo(cost.dtype).eps))
        return (
            jnp.where(better, candidate[0], direction),
            jnp.where(better, candidate[1], inverse),
            jnp.where(better, 0.1 * damping, 10.0 * damping),
            jnp.where(better, new_gram, gram),
            jnp.where(better, new_gradient, gradient),
            jnp.where(better, new_cost, cost),
        )

    damping = jnp.full((), 1e-4, direction.dtype)
    start = (direction, inverse, damping, *_normal_equations(views, direction, inverse))
    found = jax.lax.fori_loop(0, steps, step, start)
    return found[0], found[1]


@_optimum.def_jvp
def _optimum_jvp(primals, tangents, *, steps):
    # The gradient of the cost vanishes at the optimum: H dx = -(dg/dviews) dviews, H the exact Hessian.
    views, *start = primals
    direction, inverse = _optimum(views, *start, steps=steps)
    basis = _tangent_basis(direction)

    def cost(step, views):
        residuals = _residuals(views, *_move(direction, inverse, basis, step))
        return 0.5 * jnp.sum(residuals * residuals)

    zero = jnp.zeros(3, direction.dtype)
    hessian = jax.jacfwd(jax.grad(cost))(zero, views)
    _, d_gradient = eqx.filter_jvp(lambda views: jax.grad(cost)(zero, views), (views,), (tangents[0],))
    moved = _solve(hessian, -d_gradient)
    return (direction, inverse), (moved[0] * basis[0] + moved[1] * basis[1], moved[2])


def _largest_angle(bearings: Array, used: Array) -> Array:
    """Largest angle between two used unit rays; small angles keep their digits in float32."""
    a = [bearings[:, i][:, None] for i in range(3)]
    b = [bearings[:, i][None, :] for i in range(3)]
    sine = safe_sqrt(
        (a[1] * b[2] - a[2] * b[1]) ** 2 + (a[2] * b[0] - a[0] * b[2]) ** 2 + (a[0] * b[1] - a[1] * b[0]) ** 2
    )
    cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    both = used[:, None] & used[None, :]
    # arctan2(0, 0) has no derivative: unused pairs, and rays of no length, get an angle of 0.
    usable = both & (sine + jnp.abs(cosine) > 0)
    return jnp.max(jnp.where(usable, jnp.arctan2(sine, jnp.where(usable, cosine, 1.0)), 0.0))


def _largest_std(covariance: Array) -> Array:
    """Upper bound, at most √3 too large, of the standard deviation along the worst direction."""
    return safe_sqrt(covariance[0, 0] + covariance[1, 1] + covariance[2, 2])


def triangulate_refine(
    point0: Float[ArrayLike, "3"],
    pixels: Float[ArrayLike, "c 2"],
    camera: Camera,
    cam_from_world: SE3,
    sigma_px: float | Float[ArrayLike, ""] | Float[ArrayLike, "c"] = 1.0,
    *,
    mask: Bool[ArrayLike, "c"] | None = None,
    options: TriangulationOptions = TriangulationOptions(),
) -> Triangulation:
    """Refine a point until its reprojection errors are least, and judge it.

    Args:
        point0: Start, in the world frame; a rough depth is enough.
        pixels: One observation per view.
        camera: The camera of all views, or a stack of cameras (leaves with a leading axis of views).
        cam_from_world: Poses, batch axis of views.
        sigma_px: Standard deviation of both pixel coordinates, one for all views or one per view.
        mask: Which views saw the point; all when left out.
        options: Number of steps and the limits behind `valid`.

    Returns:
        Point, covariance, validity and what it was judged by.

    Degenerate input: parallel or diverging rays give a finite point at most 1e6 spreads of the camera centres from the
    first of them, with `valid` False; so do fewer than two views and a single common centre. Outliers are the caller's.

    Differentiability: the point in both modes by the implicit function theorem, with the exact Hessian; the start gets
    gradient 0. The covariance follows the point and the geometry.

    References: Hartley & Zisserman, section 12.3; Civera, Davison & Montiel, "Inverse depth parametrization for
    monocular SLAM", 2008.
    """
    pixels = jnp.asarray(pixels)
    count = pixels.shape[0]
    used = jnp.ones(count, bool) if mask is None else jnp.asarray(mask)
    rotations, translations = cam_from_world.rotation().as_matrix(), cam_from_world.translation()
    dtype = jnp.result_type(pixels, rotations, jnp.asarray(point0))
    pixels, rotations, translations = pixels.astype(dtype), rotations.astype(dtype), translations.astype(dtype)
    point0 = jax.lax.stop_gradient(jnp.asarray(point0).astype(dtype))

    centers = -jnp.sum(rotations * translations[:, :, None], axis=1)
    anchor = centers[jnp.argmax(used)]
    separations = jnp.where(used[:, None], centers - anchor[None, :], 0.0)
    views_used = jnp.sum(used).astype(dtype)
    spread = safe_sqrt(safe_divide(jnp.sum(separations * separations), views_used))
    distinct = spread > 0
    spread = jax.lax.stop_gradient(jnp.where(distinct, spread, 1.0))
    offsets = (jnp.sum(rotations * anchor[None, None, :], axis=2) + translations) / spread
    sigma = jnp.broadcast_to(jnp.asarray(sigma_px, dtype), (count,))
    views = _Views(pixels, camera, rotations, offsets, jnp.where(used, 1.0 / sigma, 0.0))

    ray0 = (point0 - jax.lax.stop_gradient(anchor)) / spread
    distance0 = safe_norm(ray0)
    ahead = jax.lax.stop_gradient(rotations[jnp.argmax(used), 2, :])
    start = jnp.where(distance0 > 0, normalize(ray0), ahead)
    inverse0 = 1.0 / jnp.where(distance0 > 0, jnp.maximum(distance0, 1e-3), 1.0)
    direction, inverse = _optimum(views, start, inverse0, steps=options.steps)

    nearest = 1.0 / FAR_SPREADS
    near_enough = inverse > nearest
    distance = spread / jnp.where(near_enough, inverse, nearest)
    point = anchor + distance * direction

    gram, _, _ = _normal_equations(views, direction, inverse)
    # This holds only what rounding would leave undetermined: the covariance of such a point is vast, not 0.
    floor = 16 * float(jnp.finfo(dtype).eps) * (jnp.max(jnp.diagonal(gram)) + float(jnp.finfo(dtype).eps))
    gram = gram + floor * jnp.eye(3, dtype=dtype)
    basis = _tangent_basis(direction)
    # dX = distance (B dn - n distance / spread drho)
    chart = jnp.stack([basis[0], basis[1], -direction * (distance / spread)], axis=1) * distance
    covariance = chart @ cholesky_solve(gram, chart.T)[0]
    covariance = 0.5 * (covariance + covariance.T)

    x, y, z = _rays(views, direction, inverse)
    in_front = jnp.all(jnp.where(used, z > 0, True)) & near_enough
    to_point = normalize(point[None, :] - centers)
    angle = _largest_angle(to_point, used)
    nearest_camera = jnp.min(jnp.where(used, safe_norm(point[None, :] - centers), jnp.inf))
    nearest_camera = jnp.where(jnp.isfinite(nearest_camera), nearest_camera, 0.0)
    certain = _largest_std(covariance) < options.max_relative_std * nearest_camera
    u, v = _project(camera, x, y, z)
    square = jnp.where(used, (u - pixels[:, 0]) ** 2 + (v - pixels[:, 1]) ** 2, 0.0)
    return Triangulation(
        point=point,
        covariance=covariance,
        valid=in_front & certain & (angle > options.min_angle_rad) & distinct,
        angle_rad=angle,
        rms_px=safe_sqrt(safe_divide(jnp.sum(square), views_used)),
    )
