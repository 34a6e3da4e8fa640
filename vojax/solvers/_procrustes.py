"""Rigid motion between two sets of corresponding points.

Minimises sum_i w_i |y_i - (R x_i + t)|^2: t takes the centroid of x to that of y, and R maximises the trace of
Rᵀ H with H = sum_i w_i (y_i - ȳ)(x_i - x̄)ᵀ = U diag(s) Vᵀ. Arun's R = U Vᵀ may be a reflection; with U and V proper
rotations (s2 then has a sign) it never is.

References:
    K. Arun, T. Huang, S. Blostein. Least-squares fitting of two 3-D point sets. PAMI 1987.
    S. Umeyama. Least-squares estimation of transformation parameters between two point patterns. PAMI 1991.
"""

from collections.abc import Callable

import jax.numpy as jnp

from vojax._numerics import Vector3, safe_divide
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import Components, difference, quaternion_from_rotation, rotate, squared, vector3
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last
from ._svd3 import svd3

Correspondences = tuple[Array, Array, Array]


def procrustes(
    points0: Float[ArrayLike, "n 3"], points1: Float[ArrayLike, "n 3"], weights: Float[ArrayLike, "n"] | None = None
) -> Candidates[SE3]:
    """Find the rigid motion that takes `points0` to `points1` in the least-squares sense.

    Args:
        points0: Points in frame 0, one per row, at least three.
        points1: The same points in frame 1.
        weights: One non-negative weight per point, as 1 / σ²; their common scale does not matter. All equal by default.

    Returns:
        One slot with `frame1_from_frame0`: `points1 ≈ model @ points0`. Always a rotation, never a reflection.

    Degenerate input: points that are coincident or collinear to rounding (in float32, thinner than about 1e-3 of their
        length), a mirrored set whose best rotation is not unique, negative weights and anything not finite leave the
        slot invalid with the identity in it.
    Differentiability: both modes, any order, in points and weights, by the implicit function theorem; exact where
        singular values coincide. Zero for an invalid slot.

    Raises:
        ValueError: If there are fewer than three points or the arrays do not match.
    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
        >>> candidates = procrustes(points, points + 1.0)
        >>> bool(jnp.allclose(candidates.models.translation(), 1.0, atol=1e-5))
        True
    """
    return _procrustes(correspondences(points0, points1, weights))


def correspondences(points0: ArrayLike, points1: ArrayLike, weights: ArrayLike | None) -> Correspondences:
    """Arrays of one dtype, weights filled in; refuses sets no 3-D alignment can use."""
    points0, points1 = jnp.asarray(points0), jnp.asarray(points1)
    if points0.shape != points1.shape:
        raise ValueError(
            f"found points of shapes {points0.shape} and {points1.shape}; expected two equal shapes [n, 3]"
        )
    if points0.shape[0] < 3:
        raise ValueError(f"found {points0.shape[0]} points; expected at least 3 to align two point sets")
    weights = jnp.ones(points0.shape[:1], points0.dtype) if weights is None else jnp.asarray(weights)
    if weights.shape != points0.shape[:1]:
        raise ValueError(f"found weights of shape {weights.shape}; expected one per point, {points0.shape[:1]}")
    dtype = jnp.result_type(points0, points1, weights)
    return points0.astype(dtype), points1.astype(dtype), weights.astype(dtype)


def alignment_kernel(with_scale: bool) -> Callable[..., tuple[Array, Array]]:
    """Closed-form alignment on arrays `[n, 3, *lanes]` and weights `[n, *lanes]`; shared with `umeyama`."""

    def kernel(points0: Array, points1: Array, weights: Array) -> tuple[Array, Array]:
        eps = float(jnp.finfo(points0.dtype).eps)
        usable = jnp.all(weights >= 0, axis=0) & (jnp.sum(weights, axis=0) > 0)
        for array in (points0, points1):
            usable = usable & jnp.all(jnp.isfinite(array), axis=(0, 1))
        largest = jnp.where(usable, jnp.max(weights, axis=0), 1.0)
        weights = weights / largest[None]
        total = jnp.sum(weights, axis=0)
        # Relative to one of the points first, so that far from the origin the mean does not round.
        base0, base1 = vector3(points0[0]), vector3(points1[0])
        x, offset0 = _centre(points0, base0, weights, total)
        y, offset1 = _centre(points1, base1, weights, total)
        columns = tuple(tuple(jnp.sum(weights * y[i] * x[j], axis=0) for j in range(3)) for i in range(3))
        matrix = tuple(tuple(jnp.where(usable, entry, 0.0) for entry in row) for row in columns)
        u, s, v = svd3(matrix)
        rotation = tuple(
            tuple(u[0][i] * v[0][j] + u[1][i] * v[1][j] + u[2][i] * v[2][j] for j in range(3)) for i in range(3)
        )
        wxyz = quaternion_from_rotation(rotation)
        # The rotation is unique if s1 + s2 > 0. Rounding of H is eps s0, that of the coordinates eps |p| each.
        magnitude = jnp.max(jnp.abs(points0), axis=(0, 1)) * jnp.max(jnp.abs(points1), axis=(0, 1))
        rounding = 16.0 * eps * s[0] + (16.0 * eps) ** 2 * total * magnitude
        ok = usable & (s[1] + s[2] > rounding)
        spread = jnp.sum(weights * squared(x), axis=0)
        scale = (s[0] + s[1] + s[2]) / jnp.where(ok, spread, 1.0) if with_scale else jnp.ones_like(total)
        anchor0 = tuple(base0[i] + offset0[i] for i in range(3))
        anchor1 = tuple(base1[i] + offset1[i] for i in range(3))
        moved = rotate(wxyz, anchor0)
        translation = difference(anchor1, tuple(scale * c for c in moved))
        model: Components = (*wxyz, *translation, *((scale,) if with_scale else ()))
        for c in model:
            ok = ok & jnp.isfinite(c)
        placeholder = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        model = tuple(jnp.where(ok, c, p) for c, p in zip(model, placeholder, strict=False))
        return jnp.stack(model, axis=0)[None], ok[None]

    return kernel


def _centre(points: Array, base: Vector3, weights: Array, total: Array) -> tuple[Components, Components]:
    """Components [n, *lanes] relative to the weighted mean, and that mean relative to `base`."""
    relative = tuple(points[:, i] - base[i][None] for i in range(3))
    mean = tuple(jnp.sum(weights * c, axis=0) / jnp.where(total > 0, total, 1.0) for c in relative)
    return tuple(relative[i] - mean[i][None] for i in range(3)), mean


def centred(data: Correspondences) -> tuple[Array, Array, Array, Array, Array]:
    """Points relative to their weighted means, the means, and weights that sum to one."""
    points0, points1, weights = data
    weights = safe_divide(weights, jnp.broadcast_to(jnp.sum(weights), weights.shape))[:, None]
    mean0, mean1 = jnp.sum(weights * points0, axis=0), jnp.sum(weights * points1, axis=0)
    return points0 - mean0[None, :], points1 - mean1[None, :], mean0, mean1, weights


def _stationarity(model: SE3, data: Correspondences) -> Array:
    """Six equations: the torque of the residuals about the centroid, and their sum."""
    x, y, mean0, mean1, weights = centred(data)
    torque = jnp.sum(weights * jnp.cross(y, model.rotation() @ x), axis=0)
    return jnp.concatenate([torque, model @ mean0 - mean1])


_rigid = lanes_last(alignment_kernel(with_scale=False))


def _candidates(data: Correspondences) -> Candidates[SE3]:
    models, valid = _rigid(*data)
    return Candidates(models=SE3(models), valid=valid)


_procrustes = implicit(_candidates, _stationarity, perturb_camera, 6)
