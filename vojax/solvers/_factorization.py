"""Structure and motion of affine cameras from point tracks: the factorisation of Tomasi and Kanade.

Affine cameras see x_ij = M_i X_j + t_i. With the origin at the centroid of the points, t_i is the mean of an image, and
the centred measurements, stacked to a matrix of 2c rows and p columns, have rank three:

    W = M X,      M = U,  X = Σ Vᵀ      (the three largest singular values),                                      (1)

which is the least-squares optimum. Where tracks are incomplete, M and t minimise what the best points leave over,

    f(M, t) = ½ Σ_seen |x_ij - M_i X_j(M, t) - t_i|²,                                                             (2)

by Levenberg-Marquardt (see `_variable_projection`). M and X are known up to an affine map of space;
`metric_upgrade` removes it.

References:
    C. Tomasi, T. Kanade. Shape and motion from image streams under orthography: a factorization method. IJCV 1992.
    T. Okatani, T. Yoshida, K. Deguchi. Efficient algorithm for low-rank matrix factorization with missing components
    and performance comparison of latest algorithms. ICCV 2011 (damped Wiberg).
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float

from ._candidates import Candidates
from ._variable_projection import minimize, normal_matrix, place_points, regular_inverse

ROUNDS = 10


class AffineScene(NamedTuple):
    """Affine cameras and the points they see: `pixels = matrices @ points + offsets`.

    Attributes:
        matrices: One 2×3 matrix per view.
        offsets: The image of the world's origin in each view.
        points: World points. From `affine_factorization`: of mean zero and covariance one, in no particular frame.
    """

    matrices: Float[Array, "*batch c 2 3"]
    offsets: Float[Array, "*batch c 2"]
    points: Float[Array, "*batch p 3"]

    def project(self) -> Float[Array, "*batch c p 2"]:
        """Every point in every view."""
        return jnp.einsum("...cik,...pk->...cpi", self.matrices, self.points) + self.offsets[..., None, :]


def affine_factorization(
    tracks: Float[ArrayLike, "c p 2"], mask: Bool[ArrayLike, "c p"] | None = None
) -> Candidates[AffineScene]:
    """Find affine cameras and points from tracks, in the least-squares sense.

    Args:
        tracks: Where each view sees each point, in pixels.
        mask: True where a point was seen; what stands elsewhere, NaN included, is ignored. None where all were seen.

    Returns:
        One slot, known up to an affine map of space: `matrices @ A`, `points @ A⁻ᵀ` is as good for every A.

    Degenerate input: points on a plane, or no motion but in the image plane, make a matrix of rank two; too few points
        in a view leave its camera open; anything not finite among what was seen: the slot is not valid, with zeros in
        it. With noise, rank two shows only in singular values: compare the third with the fourth. Nor is the slot valid
        if the iteration for incomplete tracks did not settle. Points that fewer than two views saw are at the origin.
    Differentiability: both modes, first order, in the tracks, by the implicit function theorem with the exact Hessian
        of (2); of all scenes that differ by a linear map, the derivative takes a near one. Zero for an invalid slot.

    Raises:
        ValueError: Fewer than three views or four points, or arrays that do not match.
    References: see the module.

    Example:
        >>> keys = jax.random.split(jax.random.key(0))
        >>> matrices, points = jax.random.normal(keys[0], (5, 2, 3)), jax.random.normal(keys[1], (20, 3))
        >>> tracks = jnp.einsum("cik,pk->cpi", matrices, points)
        >>> scene = jax.tree.map(lambda x: x[0], affine_factorization(tracks).models)
        >>> bool(jnp.allclose(scene.project(), tracks, atol=1e-4))
        True
    """
    tracks, seen = checked_tracks(tracks, mask)
    scene, valid = factor(tracks, seen, complete=mask is None)
    return Candidates(models=AffineScene(*(x[None] for x in scene)), valid=valid[None])


def checked_tracks(tracks: ArrayLike, mask: ArrayLike | None) -> tuple[Float[Array, "c p 2"], Bool[Array, "c p"]]:
    """Tracks with zeros where nothing was seen, and where something was."""
    tracks = jnp.asarray(tracks)
    if tracks.ndim != 3 or tracks.shape[2] != 2:
        raise ValueError(f"found tracks of shape {tracks.shape}; expected [views, points, 2]")
    if tracks.shape[0] < 3 or tracks.shape[1] < 4:
        raise ValueError(f"found {tracks.shape[0]} views of {tracks.shape[1]} points; expected at least 3 of 4")
    seen = jnp.ones(tracks.shape[:2], bool) if mask is None else jnp.asarray(mask)
    if seen.shape != tracks.shape[:2] or seen.dtype != bool:
        raise ValueError(f"found a mask of {seen.dtype}{list(seen.shape)}; expected bool{list(tracks.shape[:2])}")
    return jnp.where(seen[..., None], tracks, 0.0), seen


@functools.partial(jax.jit, static_argnames=("complete",))
def factor(
    tracks: Float[Array, "c p 2"], seen: Bool[Array, "c p"], complete: bool, start: Float[Array, "c 2 3"] | None = None
) -> tuple[tuple[Array, Array, Array], Bool[Array, ""]]:
    """Matrices, offsets and points of `affine_factorization`, and whether they are valid.

    `start` is a first guess of the matrices, for incomplete tracks.
    """
    views, count = seen.shape
    finite = jnp.all(jnp.isfinite(tracks))
    tracks = jnp.where(finite, tracks, 0.0)
    # A row per coordinate of a view: x of view 0, y of view 0, x of view 1, ...
    w = jnp.moveaxis(tracks, 2, 1).reshape(2 * views, count)
    # Points that one view saw say nothing about cameras.
    seen = seen & (jnp.sum(seen, axis=0) >= 2)[None]
    weights = jnp.repeat(seen, 2, axis=0).astype(w.dtype)
    mean, size = jax.lax.stop_gradient(_mean_and_size(w, weights))
    w = weights * (w - mean[:, None]) / size
    first = None if start is None else start.reshape(2 * views, 3)
    cameras, points, ok = _optimum(complete, w, weights, first)
    # Rounding of the coordinates themselves must not pass for a third dimension.
    rounding = 4.0 * float(jnp.finfo(w.dtype).eps) * jnp.max(jnp.abs(mean)) / size
    placed = jnp.sum(weights[::2], axis=0) > 0
    share = placed.astype(w.dtype)[:, None] / jnp.maximum(jnp.sum(placed), 1)
    shift = jnp.sum(share * points, axis=0)
    points = points - shift[None]
    # Constant factors: the axes of an affine frame are free.
    lower, solid = _spread(jax.lax.stop_gradient(points), share, rounding)
    ok = ok & finite & solid
    inverse = jax.scipy.linalg.solve_triangular(lower, jnp.eye(3, dtype=w.dtype), lower=True)
    matrices = size * (cameras[:, :3] @ lower)
    offsets = mean + size * (cameras[:, 3] + cameras[:, :3] @ shift)
    points = points @ inverse.T
    scene = AffineScene(
        matrices.reshape(views, 2, 3), offsets.reshape(views, 2), jnp.where(placed[:, None], points, 0.0)
    )
    return jax.tree.map(lambda x: jnp.where(ok, x, 0.0), scene), ok


def _mean_and_size(w: Array, weights: Array) -> tuple[Array, Array]:
    """The mean of each row over what was seen, and the root mean square of what is left."""
    mean = jnp.sum(weights * w, axis=1) / jnp.maximum(jnp.sum(weights, axis=1), 1.0)
    square = jnp.sum(weights * (w - mean[:, None]) ** 2) / jnp.maximum(jnp.sum(weights), 1.0)
    return mean, jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 1.0)


def _spread(points: Array, share: Array, rounding: Array) -> tuple[Array, Array]:
    """The Cholesky factor of the points' covariance, and whether they fill space."""
    covariance = (share * points).T @ points
    variances = jnp.linalg.eigvalsh(covariance)
    eps = float(jnp.finfo(points.dtype).eps)
    # Errors of the third singular value are eps of the first.
    solid = variances[0] > (32.0 * eps) ** 2 * variances[2] + rounding**2
    lower = jnp.linalg.cholesky(jnp.where(solid, covariance, jnp.eye(3, dtype=points.dtype)))
    return lower, solid & jnp.all(jnp.isfinite(lower))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _optimum(complete: bool, w: Array, weights: Array, start: Array | None) -> tuple[Array, Array, Array]:
    """Cameras [2c, 4], points [p, 3] and whether they are an optimum, for rows of size one; MᵀM = 2c I.

    `_spread` tells whether complete tracks have rank three, the iteration whether incomplete ones do.
    """
    rows = w.shape[0]
    root = rows**0.5
    if complete:
        u = jnp.linalg.svd(w, full_matrices=False)[0][:, :3]
        cameras = jnp.concatenate([root * u, jnp.zeros((rows, 1), w.dtype)], axis=1)
        return cameras, w.T @ u / root, jnp.all(jnp.isfinite(u))
    u = _first_guess(w, weights) if start is None else jnp.linalg.qr(start)[0]
    cameras = jnp.concatenate([root * u, jnp.zeros((rows, 1), w.dtype)], axis=1)
    cameras, settled = minimize(cameras, w, weights)
    points, _ = place_points(cameras, w, weights)
    return cameras, points, settled


def _first_guess(w: Array, weights: Array) -> Array:
    """Basis [2c, 3] from a matrix whose gaps are filled, first by means, then by what the basis predicts.

    Tracks count by the fourth power of the share of views that saw them: of short ones most is invention.
    """
    share = jnp.mean(weights, axis=0) ** 4

    def basis(filled: Array) -> Array:
        mean = jnp.sum(share[None] * filled, axis=1, keepdims=True) / jnp.maximum(jnp.sum(share), 1e-3)
        u = jnp.linalg.svd(share[None] * (filled - mean), full_matrices=False)[0][:, :3]
        return jnp.concatenate([u, mean], axis=1)

    def refill(_: object, cameras: Array) -> Array:
        points, _ = place_points(cameras, w, weights)
        return basis(jnp.where(weights > 0, w, cameras[:, :3] @ points.T + cameras[:, 3:]))

    return jax.lax.fori_loop(0, ROUNDS, refill, basis(_filled(w, weights)))[:, :3]


def _filled(w: Array, weights: Array) -> Array:
    """Missing entries as if all points moved alike: row plus column means, alternated."""
    views = w.shape[0] // 2
    row, column = jnp.zeros_like(w[:, 0]), jnp.zeros((2, w.shape[1]), w.dtype)
    in_row, in_column = (jnp.maximum(jnp.sum(weights, axis=k), 1.0) for k in (1, 0))
    for _ in range(8):
        left = (weights * (w - row[:, None])).reshape(views, 2, -1)
        column = jnp.sum(left, axis=0) / (in_column / 2.0)[None]
        row = jnp.sum(weights * (w - jnp.tile(column, (views, 1))), axis=1) / in_row
    return jnp.where(weights > 0, w, row[:, None] + jnp.tile(column, (views, 1)))


@_optimum.defjvp
def _(complete, primals, tangents):
    """Solve H (da, dX) = -dg, the points eliminated, with H the exact Hessian of (2)."""
    w, weights, _ = primals
    found = cameras, points, ok = _optimum(complete, *primals)
    matrix, back, inverse = normal_matrix(cameras, points, w, weights, exact=True)
    solver, regular = regular_inverse(matrix)
    usable = ok & regular
    d_seen = weights * jnp.where(usable, tangents[0], 0.0)
    ones = jnp.ones_like(points[:, :1])
    d_cameras = (d_seen @ jnp.concatenate([points, ones], axis=1)).reshape(-1)
    d_points = (d_seen.T @ cameras[:, :3]).reshape(-1)
    placed = jnp.einsum("pkl,pl->pk", inverse, d_points.reshape(-1, 3))
    step = solver(d_cameras - back @ placed.reshape(-1))
    moved = (d_points - back.T @ step).reshape(-1, 3)
    moved = jnp.einsum("pkl,pl->pk", inverse, moved)
    step, moved = (jnp.where(usable, x, 0.0) for x in (step.reshape(cameras.shape), moved))
    return found, (step, moved, jnp.zeros(ok.shape, jax.dtypes.float0))
