"""Rotation between bearings of a camera that turned in place.

Minimises sum_i w_i |r1_i - R r0_i|^2 over rotations, for unit bearings r0, r1: R maximises the trace of Rᵀ B with
B = sum_i w_i r1_i r0_iᵀ = U diag(s) Vᵀ, which is R = U Vᵀ for proper rotations U and V (Wahba's problem; s2 has a
sign).
In a narrow field of view B has one large singular value and rounding of it would turn R about the line of sight; one
Gauss-Newton step on the residuals themselves, R <- exp(δ) R with

    sum_i w_i (|r_i|^2 I - r_i r_iᵀ) δ = sum_i w_i r_i x r1_i,    r_i = R r0_i,                                    (1)

takes that error away.

Precondition: two bearings that are not parallel, and no translation against the depth of the scene.

References:
    G. Wahba. A least squares estimate of satellite attitude. SIAM Review 1965.
    F. Markley. Attitude determination using vector observations and the singular value decomposition. JAS 1988.
"""

import jax.numpy as jnp

from vojax._numerics import cholesky_solve, cross3, normalize, safe_divide
from vojax._types import Array, ArrayLike, Float
from vojax.lie import SO3

from ._candidates import Candidates
from ._components import Components, difference, floor, quaternion_from_rotation, rotate
from ._implicit import implicit
from ._lanes import lanes_last
from ._svd3 import svd3

Correspondences = tuple[Array, Array, Array]


def _bearings(rays: Array, ok: Array) -> tuple[Components, Array]:
    """Unit vectors by components [n, *lanes], and whether all rays have a direction."""
    size = jnp.max(jnp.abs(rays), axis=1)
    ok = ok & jnp.all((size > floor(size) ** 3) & (size < 1.0 / floor(size) ** 3), axis=0)
    size = jnp.where(ok[None], size, 1.0)
    x, y, z = (jnp.where(ok[None], rays[:, i], 1.0) / size for i in range(3))
    norm = jnp.sqrt(x * x + y * y + z * z)
    return (x / norm, y / norm, z / norm), ok


def _kernel(rays0: Array, rays1: Array, weights: Array) -> tuple[Array, Array]:
    """Arrays [n, 3, *lanes], weights [n, *lanes]: quaternions [1, 4, *lanes] and validity [1, *lanes]."""
    eps = float(jnp.finfo(rays0.dtype).eps)
    largest = jnp.max(weights, axis=0)
    ok = jnp.all(weights >= 0, axis=0) & (largest > floor(largest) ** 2) & jnp.isfinite(largest)
    weights = jnp.where(ok[None], weights, 1.0) / jnp.where(ok, largest, 1.0)[None]
    weights = weights / jnp.sum(weights, axis=0)[None]
    r0, ok0 = _bearings(rays0, ok)
    r1, ok1 = _bearings(rays1, ok)
    ok = ok0 & ok1
    matrix = tuple(tuple(jnp.sum(weights * r1[i] * r0[j], axis=0) for j in range(3)) for i in range(3))
    u, s, v = svd3(matrix)
    wxyz = quaternion_from_rotation(
        tuple(tuple(u[0][i] * v[0][j] + u[1][i] * v[1][j] + u[2][i] * v[2][j] for j in range(3)) for i in range(3))
    )
    # R is unique if s1 + s2 > 0; s0 is at most one.
    ok = ok & (s[1] + s[2] > 16.0 * eps * s[0]) & (s[0] > 16.0 * eps)

    r = rotate(tuple(c[None] for c in wxyz), r0)
    # (1), with small differences on the right: r x r1 = r x (r1 - r).
    torque = cross3(r, difference(r1, r))
    rhs = jnp.stack([jnp.sum(weights * c, axis=0) for c in torque])[:, None]
    moments = {(i, j): jnp.sum(weights * r[i] * r[j], axis=0) for i in range(3) for j in range(i, 3)}
    trace = moments[0, 0] + moments[1, 1] + moments[2, 2]
    normal = jnp.stack(
        [
            jnp.stack([trace - moments[i, i] if i == j else -moments[min(i, j), max(i, j)] for j in range(3)])
            for i in range(3)
        ]
    )
    delta, regular = cholesky_solve(normal, rhs)
    half = tuple(0.5 * delta[i, 0] for i in range(3))
    # Beyond rounding it is the noise that (1) would move, towards an optimum the SVD has already found.
    small = regular & (half[0] * half[0] + half[1] * half[1] + half[2] * half[2] < eps)
    half = tuple(jnp.where(small, c, 0.0) for c in half)
    w, axis = wxyz[0], wxyz[1:]
    turned = cross3(half, axis)
    wxyz = (
        w - half[0] * axis[0] - half[1] * axis[1] - half[2] * axis[2],
        *(axis[i] + half[i] * w + turned[i] for i in range(3)),
    )
    norm = jnp.sqrt(wxyz[0] * wxyz[0] + wxyz[1] * wxyz[1] + wxyz[2] * wxyz[2] + wxyz[3] * wxyz[3])
    wxyz = tuple(jnp.where(ok, c / norm, p) for c, p in zip(wxyz, (1.0, 0.0, 0.0, 0.0), strict=True))
    return jnp.stack(wxyz)[None], ok[None]


_solve = lanes_last(_kernel)


def _candidates(data: Correspondences) -> Candidates[SO3]:
    models, valid = _solve(*data)
    return Candidates(models=SO3(models), valid=valid)


def _stationarity(model: SO3, data: Correspondences) -> Array:
    """Three equations: the torque of the residuals."""
    rays0, rays1, weights = data
    weights = safe_divide(weights, jnp.broadcast_to(jnp.sum(weights), weights.shape))
    turned = jnp.cross(model @ normalize(rays0), normalize(rays1))
    return jnp.sum(weights[:, None] * turned, axis=0)


def perturb_rotation(rotation: SO3, tangent: Float[Array, "3"]) -> SO3:
    """Turn by a small rotation in the target frame, exp(φ) R, to first order."""
    w, axis = rotation.wxyz[0], rotation.wxyz[1:]
    half = 0.5 * tangent
    change = jnp.concatenate([-jnp.dot(half, axis)[None], half * w + jnp.cross(half, axis)])
    return SO3(rotation.wxyz + change)


_rotation = implicit(_candidates, _stationarity, perturb_rotation, 3)


def rotation_from_rays(
    rays0: Float[ArrayLike, "n 3"], rays1: Float[ArrayLike, "n 3"], weights: Float[ArrayLike, "n"] | None = None
) -> Candidates[SO3]:
    """Find the rotation that takes the bearings of camera 0 to those of camera 1 in the least-squares sense.

    The motion of a camera that turned in place, or of one that moved little against the depth of what it sees: there
    the essential matrix is undefined. Translation shows as residuals.

    Args:
        rays0: Directions in camera 0, one per row, of any positive length; at least two.
        rays1: The same points' directions in camera 1.
        weights: One non-negative weight per ray, as 1 / σ²; their common scale does not matter. All equal by default.

    Returns:
        One slot with `cam1_from_cam0`: `bearings1 ≈ model @ bearings0`, minimising the weighted sum of squared
        differences of unit vectors.

    Degenerate input: rays that are parallel or antiparallel to rounding (of the squared angle between them: 1.4e-3
        radians apart in float32), bearings whose best rotation is not unique, zero rays, negative weights and anything
        not finite leave the slot invalid with the identity in it.
    Differentiability: both modes, any order, in rays and weights, by the implicit function theorem. Zero for an invalid
        slot.

    Raises:
        ValueError: If there are fewer than two rays or the arrays do not match.
    References: see the module.

    Example:
        >>> rays = jnp.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
        >>> turn = SO3.exp(jnp.array([0.0, 0.3, 0.0]))
        >>> candidates = rotation_from_rays(rays, turn @ rays)
        >>> bool(jnp.allclose(candidates.models.log()[0], turn.log(), atol=1e-5))
        True
    """
    rays0, rays1 = jnp.asarray(rays0), jnp.asarray(rays1)
    if rays0.shape != rays1.shape:
        raise ValueError(f"found rays of shapes {rays0.shape} and {rays1.shape}; expected two equal shapes [n, 3]")
    if rays0.shape[0] < 2:
        raise ValueError(f"found {rays0.shape[0]} ray; expected at least 2 for a rotation")
    weights = jnp.ones(rays0.shape[:1], rays0.dtype) if weights is None else jnp.asarray(weights)
    if weights.shape != rays0.shape[:1]:
        raise ValueError(f"found weights of shape {weights.shape}; expected one per ray, {rays0.shape[:1]}")
    dtype = jnp.result_type(rays0, rays1, weights)
    return _rotation((rays0.astype(dtype), rays1.astype(dtype), weights.astype(dtype)))
