"""Motions of the plane between two sets of points, by least squares on the transfer error in image 1.

Minimises sum_i w_i e_iᵀ C_i⁻¹ e_i with e_i = y_i - f(x_i; θ) over one of five families (Szeliski, table 8.1):

    translation   [1 0 tx; 0 1 ty]           ∂f = [1 0; 0 1]
    Euclidean     [c -s tx; s c ty]          ∂f = [1 0 -s x - c y; 0 1 c x - s y]
    similarity    [a -b tx; b a ty]          ∂f = [1 0 x -y; 0 1 y x]
    affine        [a00 a01 a02; a10 a11 a12] ∂f = [x y 1 0 0 0; 0 0 0 x y 1]
    projective    H with h22 = 1             ∂f = [x y 1 0 0 0 -x'x -x'y; 0 0 0 x y 1 -y'x -y'y] / D,
                                             D = h20 x + h21 y + 1,  (x', y') = f

with the normal equations (∂fᵀ C⁻¹ ∂f) δθ = ∂fᵀ C⁻¹ e. Three of them are linear and one step solves them, a second takes
rounding away; the Euclidean starts at the closed form for scalar weights, the projective at `homography_dlt`, and both
take Levenberg's damped steps. All in coordinates about the centroids and of unit spread, so that h22 is never near zero
and float32 is enough for pixels.

References:
    R. Szeliski. Computer Vision: Algorithms and Applications, 2nd edition, section 8.1.
    R. Hartley, A. Zisserman. Multiple View Geometry, 2nd edition, sections 4.2 and 4.5.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._homography_dlt import homography_dlt
from ._implicit import implicit
from ._lanes import lanes_last
from ._matrix_models import unit_matrix
from ._symmetric import diagonal_sum, swept_inverse
from ._weighted_points import centred_components, corresponding_points, largest_coordinate, normal_weights

# Points 0 and 1, weights, covariances of points 1.
Data = tuple[Array, Array, Array, Array]


class FramedMotion(NamedTuple):
    """A motion's matrix, and its parameters in coordinates (p - centre) / size, where it is found."""

    matrix: Array
    theta: Array
    frame0: Array  # centre and size
    frame1: Array


class _Family(NamedTuple):
    size: int
    fewest: int
    identity: tuple[float, ...]
    steps: int


_FAMILIES = {
    "translation": _Family(2, 1, (0.0, 0.0), 2),
    "euclidean": _Family(3, 2, (0.0, 0.0, 0.0), 10),
    "similarity": _Family(4, 2, (0.0, 0.0, 1.0, 0.0), 2),
    "affine": _Family(6, 3, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0), 2),
    "projective": _Family(8, 4, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), 12),
}


def _rows(family: str, theta: Array) -> list[list[Array]]:
    """The 3x3 matrix of parameters [d, *lanes], by components."""
    zero, one = jnp.zeros_like(theta[0]), jnp.ones_like(theta[0])
    if family == "translation":
        top = [[one, zero, theta[0]], [zero, one, theta[1]]]
    elif family == "euclidean":
        c, s = jnp.cos(theta[2]), jnp.sin(theta[2])
        top = [[c, -s, theta[0]], [s, c, theta[1]]]
    elif family == "similarity":
        top = [[theta[2], -theta[3], theta[0]], [theta[3], theta[2], theta[1]]]
    else:
        top = [[theta[0], theta[1], theta[2]], [theta[3], theta[4], theta[5]]]
    return [*top, [theta[6], theta[7], one] if family == "projective" else [zero, zero, one]]


def _parameters(family: str, matrix: Array) -> Array:
    """Parameters [d] of a matrix [3, 3] of the family."""
    if family == "translation":
        return matrix[:2, 2]
    if family == "euclidean":
        return jnp.stack([matrix[0, 2], matrix[1, 2], jnp.arctan2(matrix[1, 0], matrix[0, 0])])
    if family == "similarity":
        return jnp.stack([matrix[0, 2], matrix[1, 2], matrix[0, 0], matrix[1, 0]])
    if family == "affine":
        return matrix[:2].reshape(6)
    last = matrix[2, 2]
    usable = jnp.abs(last) > float(jnp.finfo(last.dtype).eps) * jnp.max(jnp.abs(matrix))
    return (matrix / jnp.where(usable, last, 1.0)).reshape(9)[:8]


def _transfer(family: str, theta: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """F at points [n, *lanes] by components, and its derivative [2, d, n, *lanes]."""
    rows = _rows(family, theta)
    u, v, w = (row[0][None] * x + row[1][None] * y + row[2][None] for row in rows)
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    if family == "projective":
        least = float(jnp.finfo(x.dtype).eps)
        w = jnp.where(jnp.abs(w) > least, w, least)
        u, v = u / w, v / w
        a, b, c = x / w, y / w, one / w
        of_u = [a, b, c, zero, zero, zero, -u * a, -u * b]
        of_v = [zero, zero, zero, a, b, c, -v * a, -v * b]
    elif family == "affine":
        of_u, of_v = [x, y, one, zero, zero, zero], [zero, zero, zero, x, y, one]
    elif family == "similarity":
        of_u, of_v = [one, zero, x, -y], [zero, one, y, x]
    elif family == "euclidean":
        (c, _, _), (s, _, _), _ = rows
        of_u, of_v = [one, zero, -s[None] * x - c[None] * y], [zero, one, c[None] * x - s[None] * y]
    else:
        of_u, of_v = [one, zero], [zero, one]
    return u, v, jnp.stack([jnp.stack(of_u), jnp.stack(of_v)])


def _information(covariance: Array) -> tuple[Array, Array]:
    """Inverses [2, 2, n, *lanes] of covariances [n, 2, 2, *lanes], and which are positive definite."""
    c00, c01, c11 = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    size = c00 + c11
    ok = (c00 > 0) & (c11 > 0) & jnp.isfinite(size)
    size = jnp.where(ok, size, 1.0)
    a, b, c = (jnp.where(ok, x / size, 0.5 * (i == j)) for x, (i, j) in ((c00, (0, 0)), (c01, (0, 1)), (c11, (1, 1))))
    determinant = a * c - b * b
    ok = ok & (determinant > 16.0 * float(jnp.finfo(size.dtype).eps) * (a + c))
    scale = size * jnp.where(ok, determinant, 1.0)
    inverse = jnp.stack([jnp.stack([c, -b]), jnp.stack([-b, a])]) / scale[None, None]
    return jnp.where(ok[None, None], inverse, 0.0), ok


def _gradient(family: str, theta: Array, p: tuple[Array, ...], q: tuple[Array, ...], a: Array) -> tuple[Array, ...]:
    """Cost, ∂fᵀ A e [d, *lanes] and ∂fᵀ A ∂f [d, d, *lanes] for information A [2, 2, n, *lanes], weights included."""
    u, v, jacobian = _transfer(family, theta, p[0], p[1])
    e = jnp.stack([q[0] - u, q[1] - v])
    weighted = jnp.sum(a * e[None], axis=1)
    cost = jnp.sum(weighted * e, axis=(0, 1))
    half = jnp.sum(a[:, :, None] * jacobian[None], axis=1)
    normal = jnp.sum(half[:, :, None] * jacobian[:, None], axis=(0, 3))
    return cost, jnp.sum(jacobian * weighted[:, None], axis=(0, 2)), normal


def _frame(points: Array, weights: Array, ok: Array) -> tuple[tuple[Array, ...], Array, Array]:
    """Centred components of spread one, frame [3, *lanes] (centre and spread), and rounding of the points in it."""
    (x, y), mean = centred_components(points, weights, ok)
    largest = jnp.maximum(jnp.max(jnp.abs(x), axis=0), jnp.max(jnp.abs(y), axis=0))
    usable = (largest > 0) & jnp.isfinite(largest)
    largest = jnp.where(usable, largest, 1.0)
    x, y = x / largest[None], y / largest[None]
    spread = jnp.sqrt(0.5 * jnp.sum(weights * (x * x + y * y), axis=0))
    size = largest * jnp.where(spread > 0, spread, 1.0)
    rounding = 16.0 * float(jnp.finfo(size.dtype).eps) * largest_coordinate(points, ok) / size
    rounding = jnp.where(usable & (spread > 0), rounding, jnp.inf)
    x, y = x * (largest / size)[None], y * (largest / size)[None]
    return (x, y), jnp.stack([*mean, size]), rounding


def _kernel(
    family: str, points0: Array, points1: Array, weights: Array, covariance: Array, start: Array
) -> tuple[Array, ...]:
    """Arrays [n, 2, *lanes], [n, *lanes], [n, 2, 2, *lanes] and H [3, 3, *lanes]: `FramedMotion`, and validity."""
    spec = _FAMILIES[family]
    even, ok = normal_weights(weights, points0, points1)
    a, definite = _information(covariance)
    ok = ok & jnp.all(definite | (even == 0), axis=0)
    p, frame0, rounding0 = _frame(points0, even, ok)
    q, frame1, rounding1 = _frame(points1, even, ok)
    if family in ("translation", "euclidean"):
        # No scale: one unit for both images.
        ratio = frame1[2] / frame0[2]
        q, frame1 = tuple(c * ratio[None] for c in q), frame1.at[2].set(frame0[2])
    a = a * jnp.where(ok[None], even, 0.0)[None, None]
    largest = jnp.max(a[0, 0] + a[1, 1], axis=0)
    ok = ok & (largest > 0) & jnp.isfinite(largest)
    a = jnp.where(ok[None, None, None], a / jnp.where(ok, largest, 1.0)[None, None, None], 0.0)
    lead = (spec.size, *(1,) * ok.ndim)
    theta = jnp.broadcast_to(jnp.asarray(spec.identity, points0.dtype).reshape(lead), (spec.size, *ok.shape))
    if family == "euclidean":
        along = jnp.sum(even * (p[0] * q[0] + p[1] * q[1]), axis=0)
        across = jnp.sum(even * (p[0] * q[1] - p[1] * q[0]), axis=0)
        # Of no size, the correlation has no angle.
        ok = ok & (jnp.abs(along) + jnp.abs(across) > rounding0 + rounding1)
        theta = theta.at[2].set(jnp.arctan2(across, along))
    elif family == "projective":
        theta, finite = _in_frames(start, frame0, frame1)
        ok = ok & finite
    damped = family in ("euclidean", "projective")
    # At the minimum costs differ by rounding, and steps that take away the last digits must not be refused.
    slack = 1.0 + 64.0 * float(jnp.finfo(theta.dtype).eps)

    def iterate(_: object, state: tuple[Array, ...]) -> tuple[Array, ...]:
        theta, gradient, normal, cost, damping, _ = state
        diagonal = jnp.eye(spec.size, dtype=theta.dtype).reshape(spec.size, *lead) * normal
        inverse, regular = swept_inverse(normal + damping[None, None] * diagonal)
        trial = theta + jnp.sum(inverse * gradient[None], axis=1)
        new_cost, new_gradient, new_normal = _gradient(family, trial, p, q, a)
        better = (new_cost <= slack * cost) if damped else jnp.isfinite(new_cost)
        damping = jnp.where(better, 0.1 * damping, jnp.maximum(10.0 * damping, 1e-3)) if damped else damping
        parts = ((trial, theta), (new_gradient, gradient), (new_normal, normal), (new_cost, cost))
        kept = (jnp.where(better.reshape((1,) * (x.ndim - better.ndim) + better.shape), x, y) for x, y in parts)
        return (*kept, damping, regular)

    cost, gradient, normal = _gradient(family, theta, p, q, a)
    state = (theta, gradient, normal, cost, jnp.zeros_like(cost), jnp.zeros_like(ok))
    theta, _, normal, *_ = jax.lax.fori_loop(0, spec.steps, iterate, state)
    inverse, regular = swept_inverse(normal)
    ok = ok & regular & jnp.all(jnp.isfinite(theta), axis=0)
    if family != "translation":
        # Directions that only rounding of the coordinates tells apart: coincident points, for the last two a line.
        trace = diagonal_sum(inverse) * jnp.max(a[0, 0] + a[1, 1], axis=0)
        ok = ok & (trace * rounding0 * rounding0 < 1.0)
    theta = jnp.where(ok[None], theta, jnp.asarray(spec.identity, theta.dtype).reshape(lead))
    nothing = jnp.asarray([0.0, 0.0, 1.0], theta.dtype).reshape(3, *(1,) * ok.ndim)
    frame0, frame1 = (jnp.where(ok[None], frame, nothing) for frame in (frame0, frame1))
    return theta[None], frame0[None], frame1[None], ok[None]


def _in_frames(h: Array, frame0: Array, frame1: Array) -> tuple[Array, Array]:
    """Parameters [8, *lanes] of H [3, 3, *lanes] in centred coordinates, and whether it takes the centre somewhere."""
    (x0, y0, s0), (x1, y1, s1) = frame0, frame1
    rows = [[h[i, 0] * s0, h[i, 1] * s0, h[i, 0] * x0 + h[i, 1] * y0 + h[i, 2]] for i in range(3)]
    top = [[(rows[i][j] - c * rows[2][j]) / s1 for j in range(3)] for i, c in enumerate((x1, y1))]
    last = rows[2][2]
    usable = jnp.abs(last) > float(jnp.finfo(last.dtype).eps) * (jnp.abs(rows[2][0]) + jnp.abs(rows[2][1]))
    entries = jnp.stack([*top[0], *top[1], *rows[2][:2]]) / jnp.where(usable, last, 1.0)[None]
    return jnp.where(usable[None], entries, 0.0), usable


def _matrix(family: str, theta: Array, frame0: Array, frame1: Array) -> Array:
    """The matrix [3, 3] between the points themselves; of norm 1 if projective."""
    (x0, y0, s0), (x1, y1, s1) = frame0, frame1
    m = jnp.stack([jnp.stack(row) for row in _rows(family, theta)])
    zero, one = jnp.zeros_like(s0), jnp.ones_like(s0)
    # Divided by s0, multiplied by s1: their ratio only, so that translations and turns are exactly that.
    to0 = jnp.stack([one, zero, -x0, zero, one, -y0, zero, zero, s0]).reshape(3, 3)
    from1 = jnp.stack([s1 / s0, zero, x1 / s0, zero, s1 / s0, y1 / s0, zero, zero, one / s0]).reshape(3, 3)
    matrix = from1 @ m @ to0
    if family != "projective":
        return matrix.at[2].set(jnp.stack([zero, zero, one]))
    held = jax.lax.stop_gradient(matrix).reshape(9)
    sign = jnp.where(held[jnp.argmax(jnp.abs(held))] < 0, -1.0, 1.0)
    return matrix * (sign / jnp.sqrt(jnp.sum(matrix * matrix)))


@functools.cache
def _solver(family: str) -> Callable[[Data], Candidates[FramedMotion]]:
    """The solver of a family, with its derivative."""
    solve = lanes_last(functools.partial(_kernel, family))

    def candidates(data: Data) -> Candidates[FramedMotion]:
        points0, points1, weights, covariance = data
        start, valid = jnp.eye(3, dtype=points0.dtype)[None], jnp.ones(1, bool)
        if family == "projective":
            trace = covariance[:, 0, 0] + covariance[:, 1, 1]
            first = homography_dlt(
                points0, points1, jnp.where(trace > 0, weights / jnp.where(trace > 0, trace, 1.0), 0.0)
            )
            start, valid = first.models, first.valid
        theta, frame0, frame1, ok = solve(*data, start[0])
        matrix = _matrix(family, theta[0], frame0[0], frame1[0])
        ok = ok & valid & jnp.all(jnp.isfinite(matrix))
        if family == "projective":
            matrix = jnp.where(ok[0], unit_matrix(matrix)[0], 0.0)
        else:
            matrix = jnp.where(ok[0], matrix, jnp.eye(3, dtype=matrix.dtype))
        return Candidates(models=FramedMotion(matrix[None], theta, frame0, frame1), valid=ok)

    def stationarity(model: FramedMotion, data: Data) -> Array:
        p, q = (((x - f[None, :2]) / f[2]).T for x, f in zip(data[:2], (model.frame0, model.frame1), strict=True))
        a, _ = _information(data[3])
        return _gradient(family, model.theta, (p[0], p[1]), (q[0], q[1]), a * data[2][None, None])[1]

    def retract(model: FramedMotion, tangent: Array) -> FramedMotion:
        theta = model.theta + tangent
        return model._replace(theta=theta, matrix=_matrix(family, theta, model.frame0, model.frame1))

    return implicit(candidates, stationarity, retract, _FAMILIES[family].size)


def plane_motion(
    family: str, points0: ArrayLike, points1: ArrayLike, weights: ArrayLike | None, covariance1: ArrayLike | None
) -> Candidates[Array]:
    """Fit one of the families; `vojax.solvers.align_2d_translation` and so on say what comes out."""
    candidates = _solver(family)(_data(family, points0, points1, weights, covariance1))
    return Candidates(models=candidates.models.matrix, valid=candidates.valid)


def _data(
    family: str, points0: ArrayLike, points1: ArrayLike, weights: ArrayLike | None, covariance1: ArrayLike | None
) -> Data:
    points0, points1, weights = corresponding_points(points0, points1, weights, _FAMILIES[family].fewest, dim=2)
    n = points0.shape[0]
    if covariance1 is None:
        covariance1 = jnp.broadcast_to(jnp.eye(2, dtype=points0.dtype), (n, 2, 2))
    covariance1 = jnp.asarray(covariance1)
    if covariance1.shape != (n, 2, 2):
        raise ValueError(f"found covariances of shape {covariance1.shape}; expected {(n, 2, 2)}")
    dtype = jnp.result_type(points0, covariance1)
    return points0.astype(dtype), points1.astype(dtype), weights.astype(dtype), covariance1.astype(dtype)


def align_2d_covariance(
    family: str,
    matrix: Float[Array, "3 3"],
    points0: Float[ArrayLike, "n 2"],
    weights: Float[ArrayLike, "n"] | None = None,
    covariance1: Float[ArrayLike, "n 2 2"] | None = None,
) -> Float[Array, "d d"]:
    """Covariance of the parameters of an alignment: the inverse of its normal matrix.

    Args:
        family: "translation", "euclidean", "similarity", "affine" or "projective".
        matrix: The estimate, one slot of the solver's answer.
        points0: Points of image 0.
        weights: One per point, 1 / σ² of each coordinate in image 1: here their scale matters. One by default.
        covariance1: Covariances of the points of image 1, divided by the weights if both are given.

    Returns:
        Covariance of (tx, ty), (tx, ty, angle), (tx, ty, a, b), the first six entries of the matrix or the first eight
        of H / h22. Zero where a direction has no information.

    Raises:
        ValueError: If the family is unknown or the arrays do not match.
    """
    if family not in _FAMILIES:
        raise ValueError(f"found family {family!r}; expected one of {', '.join(_FAMILIES)}")
    points0, _, weights, covariance1 = _data(family, points0, points0, weights, covariance1)
    even, ok = normal_weights(weights, points0)
    p, frame0, _ = _frame(points0, even, ok)
    a, _ = _information(covariance1)
    # Image 1 keeps its unit, about the image of the centroid.
    moved = matrix @ jnp.concatenate([frame0[:2], jnp.ones_like(frame0[:1])])
    scale = jnp.where(moved[2] == 0, 1.0, moved[2])
    frame1 = jnp.stack([moved[0] / scale, moved[1] / scale, frame0[2]])
    theta, _ = _in_frames(matrix, frame0, frame1)
    entries = jnp.concatenate([theta, jnp.ones_like(theta[:1])]).reshape(3, 3)
    theta = _parameters(family, entries)
    _, _, normal = _gradient(family, theta, p, p, a * (weights * frame0[2] ** 2)[None, None])
    covariance, regular = swept_inverse(normal)
    by_theta = jax.jacfwd(lambda x: _parameters(family, _matrix(family, x, frame0, frame1)))(theta)
    covariance = by_theta @ covariance @ by_theta.T
    return jnp.where(ok & regular & jnp.all(jnp.isfinite(covariance)), covariance, 0.0)
