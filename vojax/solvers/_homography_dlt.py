"""Homography from four or more points by the direct linear transform.

In each image the points are moved to their weighted mean and scaled to a mean square distance of 2 (Hartley). There
H p ~ q gives two equations linear in h, the nine entries of H,

    r_i = (h1.p - x' h3.p,  h2.p - y' h3.p),    q = (x', y', 1),                                                 (1)

and h minimises sum_i w_i |r_i|^2 over |h| = 1: it is the least eigenvector of G = sum_i w_i A_iᵀ A_i, found by inverse
iteration. Forming G squares the condition number, so the last steps are corrections, h <- h - (G + μ)⁻¹ (G h - λ h),
with G h summed from the residuals (1): in float32 that gives what a singular value decomposition of A would.

The error is algebraic, neither in pixels nor symmetric in the images; with this scaling it is close to the distance in
image 1.

Precondition: four of the points in general position.

References:
    R. Hartley. In defense of the eight-point algorithm. PAMI 1997.
    R. Hartley, A. Zisserman. Multiple View Geometry, 2nd edition, algorithm 4.2.
    G. Golub, C. Van Loan. Matrix Computations, 4th edition, section 8.2.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import safe_divide, safe_sqrt
from vojax._types import Array, ArrayLike, Float

from ._candidates import Candidates
from ._components import Components, floor
from ._homography_four_point import FramedHomography, in_frame, perturb_framed_homography
from ._implicit import implicit
from ._lanes import lanes_last
from ._matrix_models import unit_matrix

Correspondences = tuple[Array, Array, Array]


def _frame(pixels: Array, weights: Array, ok: Array) -> tuple[Components, Components, Array]:
    """Hartley's coordinates [n, *lanes] and frame (centre, size) of points, and whether both are numbers of use."""
    base = tuple(jnp.where(ok, pixels[0, i], 0.0) for i in range(2))
    relative = tuple(jnp.where(ok[None], pixels[:, i], 0.0) - base[i][None] for i in range(2))
    size = jnp.max(jnp.maximum(jnp.abs(relative[0]), jnp.abs(relative[1])), axis=0)
    reach = size + jnp.abs(base[0]) + jnp.abs(base[1])
    ok = ok & (size > 10.0 * floor(size)) & (reach < 0.1 / floor(size))
    size = jnp.where(ok, size, 1.0)
    total = jnp.where(ok, jnp.sum(weights, axis=0), 1.0)
    relative = tuple(jnp.where(ok[None], c, 0.0) / size[None] for c in relative)
    mean = tuple(jnp.sum(weights * c, axis=0) / total for c in relative)
    x, y = (c - m[None] for c, m in zip(relative, mean, strict=True))
    spread = jnp.sqrt(0.5 * jnp.sum(weights * (x * x + y * y), axis=0) / total)
    # Spread lost in the rounding of the coordinates: all weight on one place.
    ok = ok & (spread * size > 16.0 * float(jnp.finfo(size.dtype).eps) * reach)
    spread = jnp.where(ok, spread, 1.0)
    frame = (base[0] + mean[0] * size, base[1] + mean[1] * size, spread * size)
    return (
        (x / spread[None], y / spread[None]),
        tuple(jnp.where(ok, c, o) for c, o in zip(frame, (0.0, 0.0, 1.0), strict=True)),
        ok,
    )


def _gram(p: Components, q: Components, weights: Array) -> Array:
    """G of (1): arrays [n, *lanes] in, [9, 9, *lanes] out."""
    (x, y), (xx, yy) = p, q
    monomials = (x * x, x * y, x, y * y, y, jnp.ones_like(x))
    order = ((0, 1, 2), (1, 3, 4), (2, 4, 5))

    def block(factor: Array) -> Array:
        sums = [jnp.sum(factor * monomial, axis=0) for monomial in monomials]
        return jnp.stack([jnp.stack([sums[i] for i in row]) for row in order])

    s, sx, sy = block(weights), block(-weights * xx), block(-weights * yy)
    sr = block(weights * (xx * xx + yy * yy))
    zero = jnp.zeros_like(s)
    rows = ((s, zero, sx), (zero, s, sy), (sx, sy, sr))
    return jnp.concatenate([jnp.concatenate(row, axis=1) for row in rows])


def _residuals(h: Array, p: Components, q: Components) -> Components:
    """Equations (1), arrays [n, *lanes]."""
    (x, y), (xx, yy) = p, q
    g = [h[i][None] for i in range(9)]
    third = g[6] * x + g[7] * y + g[8]
    return g[0] * x + g[1] * y + g[2] - xx * third, g[3] * x + g[4] * y + g[5] - yy * third


def _cost(h: Array, p: Components, q: Components, weights: Array) -> Array:
    """What is minimised, hᵀ G h."""
    rx, ry = _residuals(h, p, q)
    return jnp.sum(weights * (rx * rx + ry * ry), axis=0)


def _gradient(h: Array, p: Components, q: Components, weights: Array) -> Array:
    """G h, summed over the residuals."""
    rx, ry = (weights * r for r in _residuals(h, p, q))
    rz = -(q[0] * rx + q[1] * ry)
    return jnp.stack([jnp.sum(r * m, axis=0) for r in (rx, ry, rz) for m in (p[0], p[1], jnp.ones_like(rx))])


def _unit(x: Array) -> Array:
    """Unit vectors along the first axis; what is next to zero stays so."""
    largest = jnp.maximum(jnp.max(jnp.abs(x), axis=0), floor(x) ** 3)
    x = x / largest[None]
    return x / jnp.sqrt(jnp.maximum(jnp.sum(x * x, axis=0), floor(x) ** 2))[None]


def _shifted_inverse(gram: Array, size: Array) -> Array:
    """Inverse of G + 2 eps tr(G), by Gauss-Jordan sweeps: in a loop, so that it compiles in no time."""
    shift = 2.0 * float(jnp.finfo(gram.dtype).eps) * size
    axis = jnp.arange(9).reshape(9, *(1,) * size.ndim)
    identity = jnp.eye(9, dtype=gram.dtype).reshape(9, *axis.shape)

    def sweep(k: Array, a: Array) -> Array:
        is_k = axis == k
        row = a[k]
        # Positive definite, hence no pivoting; the shift is above the rounding of G.
        pivot = jnp.maximum(row[k], 0.5 * shift)
        row = jnp.where(is_k, -1.0, row)
        return jnp.where(is_k[:, None] | is_k[None], 0.0, a) - row[:, None] * (row / pivot[None])[None]

    return -jax.lax.fori_loop(0, 9, sweep, gram + shift[None, None] * identity)


def _determinant(m: Array) -> Array:
    return m[0] * (m[4] * m[8] - m[5] * m[7]) + m[1] * (m[5] * m[6] - m[3] * m[8]) + m[2] * (m[3] * m[7] - m[4] * m[6])


def _kernel(pixels0: Array, pixels1: Array, weights: Array) -> tuple[Array, ...]:
    """Arrays [n, 2, *lanes], weights [n, *lanes]: parts of `FramedHomography`, slots first, and validity."""
    eps = float(jnp.finfo(pixels0.dtype).eps)
    largest = jnp.max(weights, axis=0)
    ok = jnp.all(weights >= 0, axis=0) & (largest > floor(largest) ** 2) & jnp.isfinite(largest)
    for pixels in (pixels0, pixels1):
        ok = ok & jnp.all(jnp.isfinite(pixels), axis=(0, 1))
    weights = jnp.where(ok[None], weights, 1.0) / jnp.where(ok, largest, 1.0)[None]
    weights = weights / jnp.sum(weights, axis=0)[None]
    p, frame0, ok0 = _frame(pixels0, weights, ok)
    q, frame1, ok1 = _frame(pixels1, weights, ok)
    ok = ok0 & ok1

    gram = _gram(p, q, weights)
    size = jnp.sum(jnp.stack([gram[i, i] for i in range(9)]), axis=0)
    lead = (9, *(1,) * ok.ndim)
    inverse = _shifted_inverse(gram, size)

    def apply(vector: Array) -> Array:
        return jnp.sum(inverse * vector[None], axis=1)

    def iterate(_: object, state: tuple[Array, Array]) -> tuple[Array, Array]:
        h, other = (_unit(apply(vector)) for vector in state)
        return h, other - h * jnp.sum(h * other, axis=0)[None]

    # Two irregular vectors: one becomes the least eigenvector, the next tells how well the first is determined.
    start = (jnp.cos(k * jnp.arange(1.0, 10.0, dtype=gram.dtype)).reshape(lead) for k in (1.3, 2.9))
    h, other = (jnp.broadcast_to(x, gram.shape[1:]) for x in start)
    h, other = jax.lax.fori_loop(0, 8 if gram.dtype == jnp.float64 else 5, iterate, (h, other))

    def correct(_: object, h: Array) -> Array:
        """Inverse iteration again, written as a correction by the residuals."""
        gradient = _gradient(h, p, q, weights)
        return _unit(h - apply(gradient - h * jnp.sum(h * gradient, axis=0)[None]))

    h = jax.lax.fori_loop(0, 2, correct, h)
    other = _unit(other - h * jnp.sum(h * other, axis=0)[None])
    gap = _cost(other, p, q, weights) - _cost(h, p, q, weights)
    ok = ok & (gap > 16.0 * eps * size)
    # A singular H, as far as the error of h, some eps sqrt(size / gap), allows to tell.
    ok = ok & (jnp.abs(_determinant(h)) * jnp.sqrt(jnp.maximum(gap, 0.0)) > 16.0 * eps * jnp.sqrt(size))
    h = jnp.where(ok[None], h, jnp.eye(3, dtype=h.dtype).reshape(9, *(1,) * ok.ndim))
    (x0, y0, s0), (x1, y1, s1) = frame0, frame1
    rows = [(h[3 * i], h[3 * i + 1], s0 * h[3 * i + 2] - h[3 * i] * x0 - h[3 * i + 1] * y0) for i in range(3)]
    rows = [
        *(tuple(s1 * rows[i][j] + c * rows[2][j] for j in range(3)) for i, c in enumerate((x1, y1))),
        rows[2],
    ]
    homography, usable = unit_matrix(jnp.stack([jnp.stack(row) for row in rows]))
    ok = ok & usable
    homography = jnp.where(ok[None, None], homography, 0.0)
    scaled = h.reshape(1, 3, 3, *ok.shape)
    return homography[None], scaled, jnp.stack(frame0)[None], jnp.stack(frame1)[None], ok[None]


_solve = lanes_last(_kernel)


def _candidates(data: Correspondences) -> Candidates[FramedHomography]:
    *parts, valid = _solve(*data)
    return Candidates(models=FramedHomography(*parts), valid=valid)


def _stationarity(model: FramedHomography, data: Correspondences) -> Array:
    """Eight equations: G h is along h, in the frames that Hartley's rule gives the points."""
    weights = data[2]
    weights = safe_divide(weights, jnp.broadcast_to(jnp.sum(weights), weights.shape))
    points, changes = [], []
    for pixels, frame in zip(data[:2], (model.frame0, model.frame1), strict=True):
        x = in_frame(pixels, frame)
        mean = jnp.sum(weights[:, None] * x, axis=0)
        x = x - mean[None]
        spread = safe_sqrt(0.5 * jnp.sum(weights[:, None] * x * x))
        spread = jnp.where(spread > 0, spread, 1.0)
        points.append(x / spread)
        zero, one = jnp.zeros_like(spread), jnp.ones_like(spread)
        changes.append(jnp.stack([spread, zero, mean[0], zero, spread, mean[1], zero, zero, one]).reshape(3, 3))
    change0, change1 = changes
    s1, mean1 = change1[0, 0], change1[:2, 2]
    h = model.scaled @ change0
    h = jnp.concatenate([(h[:2] - mean1[:, None] * h[2:]) / s1, h[2:]])
    h = h / jnp.sqrt(jnp.sum(h * h))
    # G h as in `_gradient`, on whole arrays.
    p, q = jnp.concatenate([points[0], jnp.ones_like(weights)[:, None]], axis=1), points[1]
    moved = p @ h.T
    r = weights[:, None] * (moved[:, :2] - q * moved[:, 2:])
    gradient = (jnp.concatenate([r, -jnp.sum(q * r, axis=1, keepdims=True)], axis=1).T @ p).reshape(9)
    h = h.reshape(9)
    gradient = gradient - jnp.sum(gradient * h) * h
    # Without the component along h: the reflection that takes h to the first axis.
    held = jax.lax.stop_gradient(h)
    v = held.at[0].add(jnp.where(held[0] < 0, -1.0, 1.0))
    return (gradient - v * (2.0 * jnp.sum(v * gradient) / jnp.sum(v * v)))[1:]


_dlt = implicit(_candidates, _stationarity, perturb_framed_homography, 8)


def homography_dlt(
    pixels0: Float[ArrayLike, "n 2"], pixels1: Float[ArrayLike, "n 2"], weights: Float[ArrayLike, "n"] | None = None
) -> Candidates[Array]:
    """Fit the homography between four or more corresponding points by the normalised direct linear transform.

    Minimises the weighted sum of squares of the algebraic residuals `(u - x' w, v - y' w)`, (u, v, w) = H (pixels0, 1),
    in coordinates with mean zero and mean square distance 2, for H of norm 1 there. Where w varies little over the
    points that is nearly the transfer error in image 1; it is where to start from for the least transfer error.

    Args:
        pixels0: Points of image 0, in pixels or normalized coordinates, at least four.
        pixels1: The same points in image 1, in either unit too.
        weights: One non-negative weight per point, as 1 / σ²; their common scale does not matter, and zero leaves a
            point out. All equal by default.

    Returns:
        One slot: the matrix H [3, 3] from image 0 to image 1, `(pixels1, 1) ~ H (pixels0, 1)`, Frobenius norm 1, the
        entry of largest magnitude positive.

    Degenerate input: fewer than four points with weight, all of them on a line or all but one (in float32, within
        about 0.3 % of their extent), points of image 1 whose best H is singular, negative weights, coordinates
        beyond 3e8 or closer together than 4e-9 (float64: 1e75 and 2e-76) and anything not finite leave the slot
        invalid with zeros in it.

    Differentiability: both modes, any order, in points and weights, by the implicit function theorem; zero for an
        invalid slot.

    Raises:
        ValueError: If there are fewer than four points or the arrays do not match.

    References: see the module.

    Example:
        >>> square = jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.5]])
        >>> candidates = homography_dlt(square, 2.0 * square)
        >>> bool(jnp.allclose(candidates.models[0], jnp.diag(jnp.array([2.0, 2.0, 1.0])) / 3.0, atol=1e-5))
        True
    """
    pixels0, pixels1 = jnp.asarray(pixels0), jnp.asarray(pixels1)
    if pixels0.shape != pixels1.shape:
        raise ValueError(
            f"found points of shapes {pixels0.shape} and {pixels1.shape}; expected two equal shapes [n, 2]"
        )
    if pixels0.shape[0] < 4:
        raise ValueError(f"found {pixels0.shape[0]} points; expected at least 4 for a homography")
    weights = jnp.ones(pixels0.shape[:1], pixels0.dtype) if weights is None else jnp.asarray(weights)
    if weights.shape != pixels0.shape[:1]:
        raise ValueError(f"found weights of shape {weights.shape}; expected one per point, {pixels0.shape[:1]}")
    dtype = jnp.result_type(pixels0, pixels1, weights)
    candidates = _dlt((pixels0.astype(dtype), pixels1.astype(dtype), weights.astype(dtype)))
    return Candidates(models=candidates.models.homography, valid=candidates.valid)
