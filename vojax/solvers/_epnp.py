"""Absolute pose from four points or more at a cost linear in their number.

Points are combinations X_i = Σ_j α_ij C_j, Σ_j α_ij = 1, of four control points: the centroid and one along each
principal axis. The same α hold in the camera's frame. With S_i = I - f_i f_iᵀ across the bearing f_i,

    S_i Σ_j α_ij c_j = 0                                                                                          (1)

is linear in the twelve coordinates of c_1 … c_4, so these are a combination c = Σ_k β_k v_k of the least eigenvectors
v_k of a 12 x 12 matrix. The β are those that restore the distances between control points,

    |Σ_k β_k (v_k^i - v_k^j)|² = |C_i - C_j|²,                                                                     (2)

found for N = 1 … 4 eigenvectors by linearisation in the products β_k β_l and a few damped Gauss-Newton steps. Points on
a plane have no third axis: the fourth control point is held at zero and its distances are left out. Of the four poses
the one that fits the bearings best is the start for Gauss-Newton steps on

    C(R, t) = ½ Σ w_i |y_i / |y_i| - f_i|²,      y_i = R X_i + t,                                                  (3)

with Newton steps at the end, so that what is returned is a minimum of (3) to rounding, whose derivative is known.

Precondition: the points are not on a line.

References:
    V. Lepetit, F. Moreno-Noguer, P. Fua. EPnP: an accurate O(n) solution to the PnP problem. IJCV 2009.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from vojax._numerics import cross3, dot3, normalize
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import quaternion_from_rotation, rotate, sign, squared, vector3
from ._dlt_pnp import Data, across, clean, correspondences, gram_matrix
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last
from ._svd3 import svd3
from ._symmetric import diagonal_sum, least_eigenvectors, swept_inverse

_CASES = 4  # N = 1, 2, 3, 4 eigenvectors
_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
_PRODUCTS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (0, 3))
# Of these products of β, the ones that each case solves for.
_USED = ((1, 0, 0, 0, 0, 0), (1, 1, 1, 0, 0, 0), (1, 1, 1, 1, 1, 0), (1, 1, 0, 1, 0, 1))
# Thinner than this share of their length, points count as a plane for (1) and (2); for (3) they never do.
_FLAT = 0.02


def _betas(products: Array, distances: Array, weights: Array) -> Array:
    """Solve (2): β `[4, 4 cases, *lanes]` from D `[6 pairs, 4, 4, *lanes]` and squared distances `[6, *lanes]`."""
    lanes = distances.ndim - 1
    eps = float(jnp.finfo(distances.dtype).eps)
    columns = jnp.stack([(1.0 if k == j else 2.0) * products[:, k, j] for k, j in _PRODUCTS])  # [6, 6 pairs, *lanes]
    columns = columns * weights[None]
    normal = jnp.sum(columns[:, None] * columns[None], axis=2)
    rhs = jnp.sum(columns * (weights * distances)[None], axis=1)
    used = jnp.asarray(_USED, distances.dtype).T.reshape(6, _CASES, *(1,) * lanes)
    trace = diagonal_sum(normal)
    identity = jnp.eye(6, dtype=distances.dtype).reshape(6, 6, 1, *(1,) * lanes)
    # Products that a case leaves out are held at zero. The ridge makes underdetermined cases (planes) definite.
    normal = normal[:, :, None] * used[:, None] * used[None]
    normal = normal + identity * (trace[None, None, None] * ((1.0 - used)[:, None] + 64.0 * eps))
    inverse, _ = swept_inverse(normal)
    b = jnp.sum(inverse * (rhs[:, None] * used)[None], axis=1)
    b = b * sign(b[0])[None]
    first = jnp.sqrt(jnp.maximum(b[0], eps * jnp.max(jnp.abs(b), axis=0)))
    last_case = (jnp.arange(_CASES) == 3).reshape(_CASES, *(1,) * lanes)
    usable = first > 0
    divisor = jnp.where(usable, first, 1.0)
    second = jnp.where(last_case, b[1] / divisor, sign(b[1]) * jnp.sqrt(jnp.maximum(b[2], 0.0)))
    beta = jnp.stack([first, second, b[3] / divisor, b[5] / divisor])

    def refine(_: object, beta: Array) -> Array:
        along = jnp.sum(products[:, :, :, None] * beta[None, None], axis=2)  # D β, [6, 4, cases, *lanes]
        error = jnp.sum(along * beta[None], axis=1) - distances[:, None]
        jacobian = 2.0 * along * weights[:, None, None]
        normal = jnp.sum(jacobian[:, :, None] * jacobian[:, None], axis=0)
        gradient = jnp.sum(jacobian * (error * weights[:, None])[:, None], axis=0)
        damping = 1e-3 * diagonal_sum(normal)
        identity = jnp.eye(4, dtype=beta.dtype).reshape(4, 4, 1, *(1,) * lanes)
        inverse, _ = swept_inverse(normal + identity * damping[None, None])
        return beta - jnp.sum(inverse * gradient[None], axis=1)

    return jax.lax.fori_loop(0, 6, refine, beta)


def _start(x: Array, rays: Array, weights: Array, axes: Array, lengths: Array) -> tuple[Array, Array]:
    """For each case, quaternion `[4, cases, *lanes]` and camera position of the centroid `[3, cases, *lanes]`.

    Points x are relative to the centroid; `axes` [3, 3, *lanes] are their principal ones, one per row.
    """
    flat = lengths[2] < _FLAT * lengths[0]
    inverse = jnp.stack(
        [1.0 / lengths[0], 1.0 / lengths[1], jnp.where(flat, 0.0, 1.0 / jnp.where(flat, 1.0, lengths[2]))]
    )
    along = jnp.sum(x[:, None] * axes[None], axis=2) * inverse[None]
    alpha = jnp.concatenate([1.0 - jnp.sum(along, axis=1, keepdims=True), along], axis=1)
    gram = gram_matrix(across(rays, True), alpha, weights)
    trace = diagonal_sum(gram)
    fourth = jnp.diag(jnp.asarray([0.0, 0.0, 0.0, 1.0] * 3, x.dtype)).reshape(12, 12, *(1,) * trace.ndim)
    gram = gram + fourth * jnp.where(flat, trace, 0.0)[None, None]
    v = least_eigenvectors(gram, 4).reshape(4, 3, 4, *trace.shape)  # [k, coordinate, control point]
    # Below six points there is a null space, of which these are no special basis: each vector leads in turn.
    leaders = 4 if x.shape[0] < 6 else 1
    v = jnp.stack([jnp.roll(v, -leader, axis=0) for leader in range(leaders)], axis=3)
    edges = jnp.stack([v[:, :, i] - v[:, :, j] for i, j in _PAIRS])  # [pair, k, coordinate]
    products = jnp.sum(edges[:, :, None] * edges[:, None], axis=3)
    squares = lengths * lengths / jnp.sum(lengths * lengths, axis=0)[None]
    distances = [squares[j - 1] + (squares[i - 1] if i > 0 else 0.0) for i, j in _PAIRS]
    shares = [jnp.where(flat, 0.0, 1.0) if 3 in pair else jnp.ones_like(trace) for pair in _PAIRS]
    beta = _betas(products, jnp.stack(distances)[:, None], jnp.stack(shares).astype(x.dtype)[:, None])
    c = jnp.sum(beta[:, None, None] * v[:, :, :, None], axis=0)  # [coordinate, control point, case, leader]
    c = c.reshape(3, 4, _CASES * leaders, *trace.shape)
    c = c * jnp.sqrt(jnp.sum(lengths * lengths, axis=0))[None, None, None]
    # The sign for which the points are in front, Σ w f · y > 0; the sums over the points do not depend on the case.
    seen = jnp.sum((weights[:, None] * rays)[:, :, None] * alpha[:, None], axis=0)
    c = c * sign(jnp.sum(c * seen[:, :, None], axis=(0, 1)))[None, None]
    # Procrustes: the points' correlation is Σ_j (c_j - c_0) l_j axis_jᵀ, for α_j and α_k are uncorrelated.
    held = jnp.stack([lengths[0], lengths[1], jnp.where(flat, 0.0, lengths[2])])
    arms = (c[:, 1:] - c[:, :1]) * held[None, :, None]  # [coordinate, axis, case]
    m = jnp.sum(arms[:, :, None] * axes[None, :, :, None], axis=1)
    u, _, w = svd3([[m[i, j] for j in range(3)] for i in range(3)])
    rotation = [[u[0][i] * w[0][j] + u[1][i] * w[1][j] + u[2][i] * w[2][j] for j in range(3)] for i in range(3)]
    quaternion, position = jnp.stack(quaternion_from_rotation(rotation)), c[:, 0]
    return quaternion, position


def _best(
    quaternion: Array, position: Array, regular: Array, x: Array, rays: Array, weights: Array
) -> tuple[Array, Array, Array]:
    """Of the poses of all cases the one that fits the bearings best."""
    error = _misfit(quaternion, position, x[:, :, None], rays[:, :, None], weights[:, None])
    best = jnp.argmin(jnp.where(jnp.isnan(error), jnp.inf, error), axis=0)
    chosen = jnp.arange(error.shape[0]).reshape(-1, *(1,) * best.ndim) == best[None]
    quaternion, position = (jnp.sum(jnp.where(chosen[None], value, 0.0), axis=1) for value in (quaternion, position))
    return quaternion, position, jnp.any(chosen & regular, axis=0)


def _moved(quaternion: Array, position: Array, x: Array) -> tuple[Array, Array, Array]:
    """Points in the camera's frame, and turned only, `[3, n, *lanes]`; and the inverse distances."""
    turned = rotate(tuple(c[None] for c in quaternion), (x[:, 0], x[:, 1], x[:, 2]))
    y = tuple(t + p[None] for t, p in zip(turned, position, strict=True))
    squares = squared(y)
    return jnp.stack(y), jnp.stack(turned), 1.0 / jnp.sqrt(jnp.where(squares > 0, squares, 1.0))


def _misfit(quaternion: Array, position: Array, x: Array, rays: Array, weights: Array) -> Array:
    """Twice the cost (3)."""
    y, _, inverse = _moved(quaternion, position, x)
    error = y * inverse[None] - jnp.moveaxis(rays, 1, 0)
    return jnp.sum(weights * squared(vector3(error)), axis=0)


def _step(
    quaternion: Array, position: Array, x: Array, rays: Array, weights: Array, damping: Array, newton: Array
) -> tuple[Array, Array, Array]:
    """A damped step of Gauss-Newton, or of Newton, on (3); and whether its matrix is regular."""
    y, turned, inverse = _moved(quaternion, position, x)
    f = jnp.moveaxis(rays, 1, 0)
    u = y * inverse[None]
    cosine = jnp.sum(f * u, axis=0)
    slope = (u * cosine[None] - f) * inverse[None]  # of the cost in y
    exact = jnp.where(newton, 1.0, 0.0).astype(x.dtype)
    # Second derivative in y: I - u uᵀ for Gauss-Newton, f uᵀ + u fᵀ + (f·u) (I - 3 u uᵀ) for Newton, over |y|².
    scale = weights * inverse * inverse
    diagonal = 1.0 + exact * (cosine - 1.0)
    along = -1.0 - exact * (3.0 * cosine - 1.0)

    def curvature(a: int, b: int) -> Array:
        entry = along * u[a] * u[b] + exact * (f[a] * u[b] + u[a] * f[b])
        return scale * (entry + diagonal) if a == b else scale * entry

    h = [[curvature(min(a, b), max(a, b)) for b in range(3)] for a in range(3)]
    zero = jnp.zeros_like(cosine)
    t = turned
    # y changes by δ + φ x turned: columns of the derivative with respect to φ.
    lever = ((zero, -t[2], t[1]), (t[2], zero, -t[0]), (-t[1], t[0], zero))
    h_lever = [[dot3(h[a], lever[b]) for b in range(3)] for a in range(3)]
    weighted = weights[None] * slope
    bend = [[0.5 * (weighted[a] * t[b] + weighted[b] * t[a]) for b in range(3)] for a in range(3)]
    inward = jnp.sum(weighted * t, axis=0)
    blocks = [
        [jnp.sum(h[a][b], axis=0) for b in range(3)] + [jnp.sum(h_lever[a][b], axis=0) for b in range(3)]
        for a in range(3)
    ]
    for a in range(3):
        turn = [
            jnp.sum(
                dot3(lever[a], [h_lever[c][b] for c in range(3)]) + exact * (bend[a][b] - (inward if a == b else 0.0)),
                axis=0,
            )
            for b in range(3)
        ]
        blocks.append([blocks[b][3 + a] for b in range(3)] + turn)
    matrix = jnp.stack([jnp.stack(row) for row in blocks])
    torque = cross3(vector3(t), vector3(weighted))
    gradient = jnp.stack(
        [*(jnp.sum(weighted[a], axis=0) for a in range(3)), *(jnp.sum(torque[a], axis=0) for a in range(3))]
    )
    identity = jnp.eye(6, dtype=x.dtype).reshape(6, 6, *(1,) * damping.ndim)
    inverse6, regular = swept_inverse(matrix * (1.0 + identity * damping[None, None]))
    change = -jnp.sum(inverse6 * gradient[None], axis=1)
    half = 0.5 * change[3:]
    small = (jnp.ones_like(half[0]), half[0], half[1], half[2])
    w, axis = quaternion[0], vector3(quaternion[1:])
    vector = cross3(vector3(half), axis)
    product = jnp.stack([w - dot3(vector3(half), axis), *(small[1 + i] * w + axis[i] + vector[i] for i in range(3))])
    product = product / jnp.sqrt(jnp.sum(product * product, axis=0))[None]
    return product, position + change[:3], regular


def _polish(
    quaternion: Array, position: Array, x: Array, rays: Array, weights: Array, steps: int
) -> tuple[Array, Array, Array]:
    """Gauss-Newton steps, damped until they descend, and three Newton steps; and whether the last matrix is regular."""
    eps = float(jnp.finfo(x.dtype).eps)
    rounding = (8.0 * eps) ** 2 * jnp.sum(weights, axis=0)

    def step(k: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        quaternion, position, misfit, damping, _ = state
        newton = k >= steps
        new_quaternion, new_position, regular = _step(
            quaternion, position, x, rays, weights, jnp.where(newton, 0.0, damping), newton
        )
        new_misfit = _misfit(new_quaternion, new_position, x, rays, weights)
        # At a minimum rounding decides which of two misfits is less: the step that is nearly as good is taken.
        slack = jnp.where(newton, 1.0 + eps**0.5, 1.0)
        better = (new_misfit <= misfit * slack + rounding) & regular
        return (
            jnp.where(better[None], new_quaternion, quaternion),
            jnp.where(better[None], new_position, position),
            jnp.where(better, new_misfit, misfit),
            jnp.clip(jnp.where(better, 0.1 * damping, 10.0 * damping), 1e-9, 1e6),
            regular,
        )

    misfit = _misfit(quaternion, position, x, rays, weights)
    state = (quaternion, position, misfit, jnp.full_like(misfit, 1e-4), jnp.ones_like(misfit, dtype=bool))
    quaternion, position, _, _, regular = jax.lax.fori_loop(0, steps + 3 if steps > 0 else 0, step, state)
    return quaternion, position, regular


def _kernel_of(steps: int) -> Callable[..., tuple[Array, Array]]:
    def kernel(points: Array, bearings: Array, weights: Array) -> tuple[Array, Array]:
        usable, (points, bearings), weights = clean((points, bearings), weights)
        length = jnp.max(jnp.abs(bearings), axis=1)
        usable = usable & jnp.all((weights == 0) | (length > 0), axis=0) & (jnp.sum(weights > 0, axis=0) >= 4)
        rays = bearings / jnp.where(length > 0, length, 1.0)[:, None]
        rays = rays / jnp.sqrt(jnp.where(length > 0, jnp.sum(rays * rays, axis=1), 1.0))[:, None]
        total = jnp.where(usable, jnp.sum(weights, axis=0), 1.0)
        weights = weights / total[None]

        # Principal axes of the points about their centroid.
        relative = points - points[:1]
        mean = jnp.sum(weights[:, None] * relative, axis=0)
        x = relative - mean[None]
        centroid = points[0] + mean
        unit = jnp.max(jnp.abs(x), axis=(0, 1))
        usable = usable & (unit > 0)
        unit = jnp.where(usable, unit, 1.0)
        x = x / unit[None, None]
        moments = tuple(tuple(jnp.sum(weights * x[:, i] * x[:, j], axis=0) for j in range(3)) for i in range(3))
        axes, variances, _ = svd3(moments)
        lengths = jnp.sqrt(jnp.maximum(jnp.stack(variances), 0.0))
        eps = float(jnp.finfo(points.dtype).eps)
        reach = jnp.max(jnp.abs(points), axis=(0, 1)) / unit
        # On a line to rounding: of the moments, or of the coordinates far from the origin.
        usable = usable & (lengths[1] > 8.0 * eps**0.5 * lengths[0]) & (lengths[1] > 32.0 * eps * reach)
        lengths = jnp.where(usable[None], lengths, 1.0)

        start = _start(x, rays, weights, jnp.stack([jnp.stack(axis) for axis in axes]), lengths)
        if points.shape[0] < 6:
            # A null space of several dimensions: the best start need not lead to the best minimum.
            polished = _polish(*start, x[:, :, None], rays[:, :, None], weights[:, None], steps)
            quaternion, position, regular = _best(*polished, x, rays, weights)
        else:
            every = jnp.ones(start[0].shape[1:], dtype=bool)
            quaternion, position, _ = _best(*start, every, x, rays, weights)
            quaternion, position, regular = _polish(quaternion, position, x, rays, weights, steps)
        y, _, inverse = _moved(quaternion, position, x)
        cosine = jnp.sum(y * jnp.moveaxis(rays, 1, 0), axis=0) * inverse
        ok = usable & regular & (jnp.sum(weights * cosine, axis=0) > 0)
        moved = rotate(tuple(quaternion[i] for i in range(4)), vector3(centroid))
        model = jnp.concatenate([quaternion, unit[None] * position - jnp.stack(moved)])
        ok = ok & jnp.all(jnp.isfinite(model), axis=0)
        identity = jnp.eye(7, dtype=model.dtype)[0].reshape(7, *(1,) * ok.ndim)
        return jnp.where(ok[None], model, identity)[None], ok[None]

    return kernel


def _stationarity(cam_from_world: SE3, data: Data) -> Array:
    """Six equations: the gradient of (3), as a force and as a torque about the camera's centre."""
    points_world, bearings, weights = data
    y = cam_from_world @ points_world
    directions, rays = normalize(y), normalize(bearings)
    squares = jnp.sum(y * y, axis=-1, keepdims=True)
    inverse = jnp.where(squares > 0, jax.lax.rsqrt(jnp.where(squares > 0, squares, 1.0)), 0.0)
    weights = weights[:, None]
    cosine = jnp.sum(directions * rays, axis=-1, keepdims=True)
    force = jnp.sum(weights * (rays - directions * cosine) * inverse, axis=0)
    return jnp.concatenate([force, jnp.sum(weights * jnp.cross(directions, rays), axis=0)])


@functools.cache
def _solver(steps: int) -> Callable[[Data], Candidates[SE3]]:
    solve = lanes_last(_kernel_of(steps))

    def candidates(data: Data) -> Candidates[SE3]:
        models, valid = solve(*data)
        return Candidates(models=SE3(models), valid=valid)

    return implicit(candidates, _stationarity, perturb_camera, 6)


def epnp(
    points_world: Float[ArrayLike, "n 3"],
    bearings: Float[ArrayLike, "n 3"],
    weights: Float[ArrayLike, "n"] | None = None,
    gauss_newton_steps: int = 8,
) -> Candidates[SE3]:
    """Find the pose of a calibrated camera from four points or more, at a cost linear in their number.

    Args:
        points_world: Points in world coordinates, one per row, at least four; they may lie on a plane.
        bearings: Directions towards them in the camera's frame, of any positive length and in any direction.
        weights: One non-negative weight per point, as 1 / σ² of its bearing. All equal by default.
        gauss_newton_steps: Steps on the weighted squares of the bearings' errors, followed by three of Newton. With 0
            the pose of the control points comes out as it is: less accurate, and no minimum of anything.

    Returns:
        One slot with `cam_from_world` in the unit of the points: a minimum of Σ w |direction - bearing|².

    Degenerate input: points on a line or coincident, fewer than four with positive weight, negative weights, zero
        bearings, bearings that leave the pose undetermined and anything not finite leave the slot invalid, with the
        identity in it. Few points, or points on a distant plane, may have a second minimum nearly as good.

    Differentiability: both modes, any order, in points, bearings and weights: that of the minimum, by the implicit
        function theorem. It is exact if the steps have converged, as they do from 8 on but for the worst of problems;
        with 0 it is only exact without noise. Zero for an invalid slot.

    Raises:
        ValueError: If there are fewer than four points or shapes do not match.
    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 4.0], [1.0, 0.0, 5.0], [0.0, 1.0, 6.0], [1.0, 1.0, 4.0], [-1.0, 0.0, 7.0]])
        >>> candidates = epnp(points, points)
        >>> bool(jnp.abs(candidates.models.translation()).max() < 1e-3)
        True
    """
    if gauss_newton_steps < 0:
        raise ValueError(f"found gauss_newton_steps = {gauss_newton_steps}; expected 0 or more")
    return _solver(gauss_newton_steps)(correspondences(points_world, bearings, weights, 4))
