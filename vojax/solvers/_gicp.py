"""Generalised ICP: both clouds are samples of surfaces, and every point may lie anywhere nearby on its surface.

Each point gets the covariance of its neighbourhood, flattened: with unit normal n,

    C = I - (1 - ε) n nᵀ,                                                                                        (1)

wide along the surface and thin across. The rounds of matching are those of `icp`; each takes two steps of
`procrustes_anisotropic` on sum_i e_iᵀ (C1_i + R C0_i Rᵀ)⁻¹ e_i, which is point to plane where one surface is certain
and plane to plane where both are.

References:
    A. Segal, D. Haehnel, S. Thrun. Generalized-ICP. RSS 2009.
"""

import functools

import jax
import jax.numpy as jnp

from vojax._numerics import Vector3
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import Rows3
from ._icp import Clouds, IcpResult, clouds, finished, iterate_matches, moved_pose, start_pose
from ._implicit import implicit, perturb_camera
from ._information_alignment import damped_step, normal_equations, symmetric_rows
from ._neighbours import POINTS, QUERIES, blocks_of, neighbours_in_blocks, usable_points
from ._procrustes_anisotropic import Data, exact_stationarity, whitened_residuals
from ._svd3 import svd3


def surface_normals(
    points: Float[ArrayLike, "n 3"], neighbours: int = 20, mask: Bool[ArrayLike, " n"] | None = None
) -> tuple[Float[Array, "n 3"], Bool[Array, " n"]]:
    """Normals of a cloud: the direction in which the nearest neighbours of a point vary least.

    Args:
        points: The cloud, one point per row.
        neighbours: How many of the nearest points to use, the point itself among them.
        mask: True for the points that are there.

    Returns:
        Unit normals, of either sign, and which are determined: not those of points with fewer than three neighbours
        or with neighbours on a line. Those are (0, 0, 1).

    Differentiability: none; normals are constants to what follows.

    Raises:
        ValueError: If fewer than three neighbours are asked for.
    """
    if neighbours < 3:
        raise ValueError(f"found neighbours={neighbours}; expected at least 3 to span a plane")
    mask = jnp.ones(points.shape[:1], bool) if mask is None else jnp.asarray(mask)
    return _surface_normals(neighbours, jax.lax.stop_gradient(jnp.asarray(points)), mask)


@functools.partial(jax.jit, static_argnums=0)
def _surface_normals(neighbours: int, points: Array, mask: Array) -> tuple[Array, Array]:
    cloud, present = usable_points(points, mask)
    blocks = blocks_of(cloud, present, POINTS)
    queries = blocks_of(cloud, present, QUERIES)
    count, _, size = queries.points.shape
    order = queries.index.reshape(-1)
    n = cloud.shape[0]
    asked = (present[order] & (jnp.arange(count * size) < n)).reshape(count, size)
    place, distance2 = neighbours_in_blocks(queries.points, asked, blocks, neighbours)
    found = jnp.isfinite(distance2).reshape(count * size, neighbours).T
    near = cloud[blocks.index.reshape(-1)[place.reshape(count * size, neighbours).T]]
    # About the point itself first, so that far from the origin nothing is lost.
    relative = jnp.where(found[..., None], near - cloud[order][None], 0.0)
    weights = found.astype(cloud.dtype)
    total = jnp.maximum(jnp.sum(weights, axis=0), 1.0)
    mean = jnp.sum(relative, axis=0) / total[:, None]
    x = jnp.where(found[..., None], relative - mean[None], 0.0)
    moments = tuple(tuple(jnp.sum(x[..., i] * x[..., j], axis=0) for j in range(3)) for i in range(3))
    (_, _, normal), s, _ = svd3(moments)
    determined = (total >= 3) & (s[1] > 64.0 * float(jnp.finfo(cloud.dtype).eps) * s[0]) & asked.reshape(-1)
    axis = jnp.asarray([0.0, 0.0, 1.0], cloud.dtype)
    normals = jnp.where(determined[:, None], jnp.stack(normal, axis=1), axis[None])
    # Places that fill the last block write nowhere.
    target = jnp.where(jnp.arange(count * size) < n, order, n)
    back = jnp.zeros((n + 1, 3), cloud.dtype).at[target].set(normals)[:n]
    return back, jnp.zeros(n + 1, bool).at[target].set(determined)[:n]


def surface_covariances(
    points: Float[ArrayLike, "n 3"],
    neighbours: int = 20,
    epsilon: float = 1e-3,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Float[Array, "n 3 3"]:
    """Covariances (1) of a cloud, of unit variance along the surface; the identity where there is no normal.

    Args:
        points: The cloud.
        neighbours: How many of the nearest points make a neighbourhood.
        epsilon: Variance across the surface, relative to that along it.
        mask: True for the points that are there.
    """
    normals, determined = surface_normals(points, neighbours, mask)
    outer = normals[:, :, None] * normals[:, None, :]
    flat = jnp.eye(3, dtype=normals.dtype)[None] - (1.0 - epsilon) * outer
    return jnp.where(determined[:, None, None], flat, jnp.eye(3, dtype=normals.dtype)[None])


def _steps(count: int, pose: Array, x: Array, y: Array, c0: Array, c1: Array, weights: Array) -> tuple[Array, Array]:
    """Gauss-Newton steps on the exact cost, about the middle of the points, and whether the last had one answer."""
    rows0, rows1 = symmetric_rows(c0), symmetric_rows(c1)
    centre = jnp.sum(weights[:, None] * x, axis=0) / jnp.maximum(jnp.sum(weights), 1.0)
    arm = x - centre[None]
    parts0: Vector3 = (arm[:, 0], arm[:, 1], arm[:, 2])
    zero = jnp.zeros_like(pose[0])

    # As in `procrustes_anisotropic` the residuals are carried, and the first round only fills them in.
    def one(_: object, state: tuple[Array, Array, tuple[Array, ...]]) -> tuple[Array, Array, tuple[Array, ...]]:
        pose, _, parts = state
        p, u, (a00, a01, a02, a11, a12, a22) = parts[:3], parts[3:6], parts[6:]
        weight: Rows3 = ((a00, a01, a02), (a01, a11, a12), (a02, a12, a22))
        step, regular = damped_step(*normal_equations((p[0], p[1], p[2]), (u[0], u[1], u[2]), weight, weights))
        pose = moved_pose(pose, SE3(pose) @ centre, step)
        error = y - (SE3(pose) @ centre)[None]
        wxyz = (pose[0], pose[1], pose[2], pose[3])
        p, u, weight, _ = whitened_residuals(
            wxyz, (zero, zero, zero), parts0, (error[:, 0], error[:, 1], error[:, 2]), rows0, rows1
        )
        return pose, regular, (*p, *u, *weight[0], *weight[1][1:], weight[2][2])

    nothing = tuple(jnp.zeros_like(weights) for _ in range(12))
    pose, regular, _ = jax.lax.fori_loop(0, count + 1, one, (pose, jnp.asarray(False), nothing))
    return pose, regular


def _from_pose(data: tuple[Array, Data]) -> Candidates[SE3]:
    """The minimum for given matches, from a pose that is close."""
    start, (x, y, c0, c1, weights) = data
    pose, regular = _steps(8, start, x, y, c0, c1, weights)
    ok = regular & jnp.all(jnp.isfinite(pose))
    identity = jnp.zeros(7, pose.dtype).at[0].set(1.0)
    return Candidates(models=SE3(jnp.where(ok, pose, identity)[None]), valid=ok[None])


_matched = implicit(_from_pose, lambda model, data: exact_stationarity(model, data[1]), perturb_camera, 6)


def gicp(
    points0: Float[ArrayLike, "n 3"],
    points1: Float[ArrayLike, "m 3"],
    *,
    covariance0: Float[ArrayLike, "n 3 3"] | None = None,
    covariance1: Float[ArrayLike, "m 3 3"] | None = None,
    neighbours: int = 20,
    epsilon: float = 1e-3,
    iterations: int = 20,
    max_distance: float | Float[ArrayLike, ""] = float("inf"),
    initial: SE3 | None = None,
    mask0: Bool[ArrayLike, " n"] | None = None,
    mask1: Bool[ArrayLike, " m"] | None = None,
) -> IcpResult:
    """Align cloud 0 to cloud 1 by generalised ICP, plane to plane.

    Args:
        points0: Cloud 0, one point per row. What is not finite counts as masked.
        points1: Cloud 1.
        covariance0: Covariances of cloud 0, in its frame; `surface_covariances` by default.
        covariance1: Covariances of cloud 1.
        neighbours: How many of the nearest points make a neighbourhood, for covariances that are not given.
        epsilon: Variance across a surface relative to that along it, for the same.
        iterations: Rounds of matching, all of which are run.
        max_distance: Matches farther apart than this do not count, in the unit of the points.
        initial: `frame1_from_frame0` to start from; the identity by default.
        mask0: True for the points of cloud 0 that are there.
        mask1: True for those of cloud 1.

    Returns:
        As `icp`.

    Degenerate input: as `icp`.
    Differentiability: both modes, in points and in covariances that are given, for the matches that were found last.

    Raises:
        ValueError: If shapes do not match.
    References: see the module.

    Example:
        >>> corner = jnp.stack(jnp.meshgrid(*[jnp.arange(4.0)] * 3), axis=-1).reshape(-1, 3) ** 1.3
        >>> found = gicp(corner, corner + 0.1, neighbours=6, iterations=5)
        >>> bool(jnp.allclose(found.frame1_from_frame0.translation(), 0.1, atol=1e-3))
        True
    """
    data, dtype = clouds(points0, points1, mask0, mask1)
    start = start_pose(initial, dtype)
    covariances, masks = [], []
    for name, given, points, mask in (
        ("covariance0", covariance0, data.points0, data.mask0),
        ("covariance1", covariance1, data.points1, data.mask1),
    ):
        if given is None:
            covariances.append(surface_covariances(points, neighbours, epsilon, mask))
            masks.append(mask)
            continue
        array = jnp.asarray(given).astype(dtype)
        if array.shape != (points.shape[0], 3, 3):
            raise ValueError(f"found {name} of shape {array.shape}; expected {(points.shape[0], 3, 3)}")
        mask = mask & jnp.all(jnp.isfinite(array), axis=(1, 2))
        covariances.append(jnp.where(mask[:, None, None], array, jnp.eye(3, dtype=dtype)[None]))
        masks.append(mask)
    c0, c1 = covariances
    data = data._replace(mask0=masks[0], mask1=masks[1])
    distance = jax.lax.stop_gradient(jnp.asarray(max_distance, dtype))
    return _gicp(iterations, data, c0, c1, start, distance)


@functools.partial(jax.jit, static_argnums=0)
def _gicp(iterations: int, data: Clouds, c0: Array, c1: Array, start: Array, max_distance: Array) -> IcpResult:
    held, held0, held1 = jax.lax.stop_gradient((data, c0, c1))

    def step(pose: Array, order: Array, index: Array, weights: Array) -> tuple[Array, Array]:
        pose, _ = _steps(2, pose, held.points0[order], held.points1[index], held0[order], held1[index], weights)
        return pose, jnp.sum(weights) > 0

    pose, matches, inliers, still = iterate_matches(held, step, start, max_distance, iterations)

    def last(weights: Array, pose: Array) -> Candidates[SE3]:
        return _matched((pose, (data.points0, data.points1[matches], c0, c1[matches], weights)))

    return finished(data, pose, matches, inliers, still, 3, last)
