"""Iterative closest points: rigid motion between two point clouds without correspondences.

Every round matches each moved point R x_i + t of cloud 0 with the nearest point y_i of cloud 1 within `max_distance`,
and takes one step towards the least

    sum_i (R x_i + t - y_i)ᵀ A_i (R x_i + t - y_i),                                                              (1)

    point to point  A = I              the closed form of `procrustes`,
    point to line   A = I - d dᵀ       distance to the line through y with direction d,
    point to plane  A = n nᵀ           distance to the plane through y with normal n,

the last two by a Gauss-Newton step. They let surfaces slide along each other, which needs fewer rounds. The rounds are
fixed in number; the last matches are then solved for to the end, and the derivative is that of this last problem.

Precondition: a start from which most nearest points are right: a fraction of the size of the structure.

References:
    P. Besl, N. McKay. A method for registration of 3-D shapes. PAMI 1992.
    Y. Chen, G. Medioni. Object modelling by registration of multiple range images. IVC 1992 (point to plane).
    A. Censi. An ICP variant using a point-to-line metric. ICRA 2008.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vojax._numerics import cross3, normalize
from vojax._result import Result
from vojax._types import Array, ArrayLike, Bool, Float, Int
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import Components, Rows3, rotate
from ._implicit import implicit, perturb_camera
from ._information_alignment import damped_step, normal_equations, symmetric_rows, times, turn
from ._neighbours import POINTS, QUERIES, blocks_of, nearest_in_blocks, usable_points
from ._procrustes import alignment_kernel, procrustes

METHODS = ("point_to_point", "point_to_line", "point_to_plane")


class IcpResult(NamedTuple):
    """What an alignment of clouds found.

    Attributes:
        frame1_from_frame0: The motion, `cloud1 ≈ model @ cloud0` where they overlap.
        rms: Root mean square distance of the matches after the last alignment, from point to point.
        inlier_share: Share of the points of cloud 0 that have a match within the largest distance.
        matches: For each point of cloud 0 the point of cloud 1 it was matched with, -1 for none.
        result: How it ended: `Result[icp.result]` is a sentence.
    """

    frame1_from_frame0: SE3
    rms: Float[Array, ""]
    inlier_share: Float[Array, ""]
    matches: Int[Array, " n"]
    result: Result


class Clouds(NamedTuple):
    """Two clouds of one dtype, with zeros where a point is not there."""

    points0: Float[Array, "n 3"]
    points1: Float[Array, "m 3"]
    mask0: Bool[Array, " n"]
    mask1: Bool[Array, " m"]


# One round's step: pose parameters, places of the points in cloud 0 and of their matches in cloud 1, weights; to the
# pose and whether it may be used.
Step = Callable[[Array, Array, Array, Array], tuple[Array, Array]]


def clouds(
    points0: ArrayLike, points1: ArrayLike, mask0: ArrayLike | None, mask1: ArrayLike | None
) -> tuple[Clouds, jnp.dtype]:
    """Check shapes, agree on a dtype, and mask what is no number."""
    arrays = [jnp.asarray(points0), jnp.asarray(points1)]
    dtype = jnp.result_type(*arrays)
    points, masks = [], []
    for name, array, mask in zip(("points0", "points1"), arrays, (mask0, mask1), strict=True):
        if array.ndim != 2 or array.shape[1] != 3 or array.shape[0] == 0:
            raise ValueError(f"found {name} of shape {array.shape}; expected [n, 3] with at least one point")
        mask = jnp.ones(array.shape[:1], bool) if mask is None else jnp.asarray(mask)
        if mask.shape != array.shape[:1] or mask.dtype != bool:
            raise ValueError(f"found a mask of {mask.dtype}{list(mask.shape)}; expected bool{list(array.shape[:1])}")
        # `where` in both: a NaN must not reach a gradient by way of 0 · NaN.
        array, mask = usable_points(array.astype(dtype), mask)
        points.append(array)
        masks.append(mask)
    return Clouds(points[0], points[1], masks[0], masks[1]), dtype


def iterate_matches(
    data: Clouds, step: Step, start: Float[Array, "7"], max_distance: Float[Array, ""], iterations: int
) -> tuple[Float[Array, "7"], Int[Array, "n"], Bool[Array, "n"], Bool[Array, ""]]:
    """Match and step a number of times.

    Returns:
        The pose, a last round's matches and which of them are within the distance, and whether the last step was one
        of less than 1e-4 of the extent of cloud 0.
    """
    dtype = data.points0.dtype
    blocks = blocks_of(data.points1, data.mask1, POINTS)
    queries = blocks_of(data.points0, data.mask0, QUERIES)
    count, _, size = queries.points.shape
    order = queries.index.reshape(count * size)
    # Places that only fill the last block repeat point 0, and are not there.
    present = (data.mask0[order] & (jnp.arange(count * size) < data.points0.shape[0])).reshape(count, size)
    x = jnp.where(present.reshape(-1)[:, None], data.points0[order], 0.0)
    weights = present.reshape(-1).astype(dtype)
    total = jnp.maximum(jnp.sum(weights), 1.0)
    mean = jnp.sum(weights[:, None] * x, axis=0) / total
    spread2 = jnp.sum(weights[:, None] * (x - mean[None]) ** 2) / total
    to_points = blocks.index.reshape(-1)
    tiles = jnp.swapaxes(blocks.points, 1, 2).reshape(-1, 3)
    limit = jnp.broadcast_to((max_distance * max_distance).astype(dtype), (count, size))

    def match(pose: Array, place: Array) -> tuple[Array, Array]:
        moved = (SE3(pose) @ x).reshape(count, size, 3)
        # The last match is a good guess, and everything farther need not be looked at.
        gap = moved - tiles[place]
        guessed = jnp.minimum(jnp.sum(gap * gap, axis=2), limit)
        place, distance2 = nearest_in_blocks(jnp.swapaxes(moved, 1, 2), present, place, guessed, blocks)
        return place, present & (distance2 < limit)

    def one_round(state: tuple[Array, Array, Array], _: object) -> tuple[tuple[Array, Array, Array], None]:
        pose, place, _ = state
        place, near = match(pose, place)
        new, usable = step(pose, order, to_points[place.reshape(-1)], near.reshape(-1).astype(dtype))
        new = jnp.where(usable & jnp.all(jnp.isfinite(new)), new, pose)
        change = SE3(new) @ x - SE3(pose) @ x
        moved2 = jnp.sum(weights[:, None] * change * change) / total
        return (new, place, moved2 <= 1e-8 * spread2), None

    first = (start, jnp.zeros((count, size), jnp.int32), jnp.asarray(False))
    (pose, place, still), _ = jax.lax.scan(one_round, first, None, length=iterations)
    place, near = match(pose, place)
    # Back to the order of the caller; places that fill the last block write nowhere.
    n = data.points0.shape[0]
    target = jnp.where(jnp.arange(count * size) < n, order, n)
    matches = jnp.zeros(n + 1, jnp.int32).at[target].set(to_points[place.reshape(-1)].astype(jnp.int32))[:n]
    inliers = jnp.zeros(n + 1, bool).at[target].set(near.reshape(-1))[:n]
    return pose, matches, inliers, still


def moved_pose(pose: Array, middle: Array, step: Array) -> Array:
    """Pose parameters after a shift ρ and a turn φ about a point of frame 1, step = (ρ, φ)."""
    one, zero = jnp.ones_like(step[0]), jnp.zeros_like(step[0])
    phi = (step[3], step[4], step[5])
    turned = turn((one, zero, zero, zero), phi)
    arm = tuple(pose[4 + i] - middle[i] for i in range(3))
    arm = rotate(turned, (arm[0], arm[1], arm[2]))
    wxyz = turn((pose[0], pose[1], pose[2], pose[3]), phi)
    return jnp.stack([*wxyz, *(middle[i] + step[i] + arm[i] for i in range(3))])


def _information(method: str, directions: Array) -> Rows3:
    """A of (1) by components [n]: of unit directions [n, 3]."""
    outer = directions[:, :, None] * directions[:, None, :]
    if method == "point_to_line":
        outer = jnp.eye(3, dtype=directions.dtype)[None] - outer
    return symmetric_rows(outer)


def _about_middle(pose: Array, x: Array, y: Array, weights: Array) -> tuple[Components, Components, Array]:
    """Moved points about their weighted mean, residuals y - moved, by components [n], and the mean."""
    moved = SE3(pose) @ x
    middle = jnp.sum(weights[:, None] * moved, axis=0) / jnp.maximum(jnp.sum(weights), 1.0)
    p, e = moved - middle[None], y - moved
    # All in one place, to rounding: an arm that is noise would turn the cloud anywhere.
    rounding = 16.0 * float(jnp.finfo(x.dtype).eps) * jnp.max(jnp.abs(jnp.where(weights[:, None] > 0, moved, 0.0)))
    apart = jnp.max(jnp.where(weights > 0, jnp.max(jnp.abs(p), axis=1), 0.0)) > rounding
    p = jnp.where(jax.lax.stop_gradient(apart), p, 0.0)
    return (p[:, 0], p[:, 1], p[:, 2]), (e[:, 0], e[:, 1], e[:, 2]), middle


# Points 0, their matches, directions at the matches, weights, and the pose to start from.
_Matched = tuple[Array, Array, Array, Array, Array]


def _gauss_newton(method: str, data: _Matched) -> tuple[Array, Array]:
    """One step on (1); directions that it says nothing about are not moved along."""
    x, y, directions, weights, pose = data
    p, e, middle = _about_middle(pose, x, y, weights)
    a = _information(method, directions)
    step, regular = damped_step(*normal_equations((p[0], p[1], p[2]), times(a, (e[0], e[1], e[2])), a, weights))
    return moved_pose(pose, middle, step), regular


def _stationarity(method: str, model: SE3, data: _Matched) -> Array:
    """The gradient of (1): sum and torque of the weighted residuals."""
    x, y, directions, weights, _ = data
    p, e, _ = _about_middle(model.wxyz_xyz, x, y, weights)
    u = times(_information(method, directions), (e[0], e[1], e[2]))
    torque = cross3((p[0], p[1], p[2]), u)
    return jnp.stack([jnp.sum(weights * c) for c in (*u, *torque)])


@functools.cache
def _matched_solver(method: str) -> Callable[[_Matched], Candidates[SE3]]:
    """Minimum of (1) for given matches, with its derivative."""

    def solve(data: _Matched) -> Candidates[SE3]:
        x, y, directions, weights, start = data

        def one(_: object, state: tuple[Array, Array]) -> tuple[Array, Array]:
            return _gauss_newton(method, (x, y, directions, weights, state[0]))

        pose, regular = jax.lax.fori_loop(0, 6, one, (start, jnp.asarray(False)))
        ok = regular & jnp.all(jnp.isfinite(pose))
        identity = jnp.zeros(7, pose.dtype).at[0].set(1.0)
        return Candidates(models=SE3(jnp.where(ok, pose, identity)[None]), valid=ok[None])

    return implicit(solve, functools.partial(_stationarity, method), perturb_camera, 6)


def finished(
    data: Clouds,
    pose: Array,
    matches: Array,
    inliers: Array,
    still: Array,
    fewest: int,
    last: Callable[[Array, Array], Candidates[SE3]],
) -> IcpResult:
    """Solve for the last matches, and say how it went.

    Args:
        data: The clouds.
        pose: Where the rounds ended.
        matches: Of the last round.
        inliers: Which of them count.
        still: Whether the last step was next to none.
        fewest: Matches that determine a motion.
        last: From weights and the pose to the motion.
    """
    weights = inliers.astype(data.points0.dtype)
    count = jnp.sum(inliers)
    enough = count >= fewest
    solved = last(weights, pose)
    unique = enough & solved.valid[0]
    model = SE3(jnp.where(unique, solved.models.wxyz_xyz[0], pose))
    error = jnp.where(inliers[:, None], model @ data.points0 - data.points1[matches], 0.0)
    mean_square = jnp.sum(error * error) / jnp.maximum(count, 1).astype(error.dtype)
    positive = mean_square > 0
    rms = jnp.where(positive, jnp.sqrt(jnp.where(positive, mean_square, 1.0)), 0.0)
    result = Result.where(still, Result.success, Result.not_converged)
    result = Result.where(unique, result, Result.degenerate)
    result = Result.where(enough, result, Result.too_few)
    share = count.astype(error.dtype) / jnp.maximum(jnp.sum(data.mask0), 1).astype(error.dtype)
    return IcpResult(model, rms, share, jnp.where(inliers, matches, -1), result)


def start_pose(initial: SE3 | None, dtype: jnp.dtype) -> Float[Array, "7"]:
    """Parameters of the pose to start from; the identity where there is none or it is no pose."""
    identity = jnp.zeros(7, dtype).at[0].set(1.0)
    if initial is None:
        return identity
    start = jax.lax.stop_gradient(initial.normalize().wxyz_xyz).astype(dtype)
    if start.shape != (7,):
        raise ValueError(f"found an initial pose of batch shape {start.shape[:-1]}; expected one pose")
    return jnp.where(jnp.all(jnp.isfinite(start)), start, identity)


def icp(
    points0: Float[ArrayLike, "n 3"],
    points1: Float[ArrayLike, "m 3"],
    *,
    method: str = "point_to_point",
    normals1: Float[ArrayLike, "m 3"] | None = None,
    directions1: Float[ArrayLike, "m 3"] | None = None,
    iterations: int = 30,
    max_distance: float | Float[ArrayLike, ""] = float("inf"),
    initial: SE3 | None = None,
    mask0: Bool[ArrayLike, " n"] | None = None,
    mask1: Bool[ArrayLike, " m"] | None = None,
) -> IcpResult:
    """Align cloud 0 to cloud 1 by iterative closest points.

    `jax.vmap` over clouds padded to one size, with masks, aligns many pairs in one call.

    Args:
        points0: Cloud 0, one point per row. What is not finite counts as masked.
        points1: Cloud 1.
        method: "point_to_point", "point_to_line" or "point_to_plane".
        normals1: Normals of cloud 1, of any length, for point to plane.
        directions1: Directions of lines through the points of cloud 1, of any length, for point to line.
        iterations: Rounds of matching, all of which are run.
        max_distance: Matches farther apart than this do not count, in the unit of the points. Where the clouds overlap
            only in part it has to be set: at the start some times the misalignment is good.
        initial: `frame1_from_frame0` to start from; the identity by default.
        mask0: True for the points of cloud 0 that are there.
        mask1: True for those of cloud 1.

    Returns:
        See `IcpResult`. `result` is `not_converged` if the last round still moved the cloud by 1e-4 of its extent,
        `degenerate` if the matches do not determine the motion (a plane that slides), `too_few` if there are hardly
        any.

    Degenerate input: clouds without matches keep the initial pose, with `inlier_share` 0 and `result` `too_few`. Where
        matches leave a direction free, the cloud is not moved along it.

    Differentiability: both modes, in the points, normals and directions, for the matches that were found last: by the
        implicit function theorem through their alignment. Zero where `result` is `degenerate` or `too_few`.

    Raises:
        ValueError: If shapes do not match, the method is unknown or lacks its normals or directions.
    References: see the module.

    Example:
        >>> corner = jnp.stack(jnp.meshgrid(*[jnp.arange(4.0)] * 3), axis=-1).reshape(-1, 3) ** 1.3
        >>> found = icp(corner, corner + 0.1, iterations=5)
        >>> bool(jnp.allclose(found.frame1_from_frame0.translation(), 0.1, atol=1e-4))
        True
    """
    if method not in METHODS:
        raise ValueError(f"found method {method!r}; expected one of {', '.join(METHODS)}")
    data, dtype = clouds(points0, points1, mask0, mask1)
    start = start_pose(initial, dtype)
    directions = {"point_to_line": directions1, "point_to_plane": normals1}.get(method)
    if method == "point_to_point":
        vectors = jnp.zeros_like(data.points1)
    else:
        name = "normals1" if method == "point_to_plane" else "directions1"
        if directions is None:
            raise ValueError(f"found no {name}; expected them for {method}, one per point of cloud 1")
        vectors = jnp.asarray(directions).astype(dtype)
        if vectors.shape != data.points1.shape:
            raise ValueError(f"found {name} of shape {vectors.shape}; expected {data.points1.shape}")
        # A point without a direction is not matched.
        usable = jnp.all(jnp.isfinite(vectors), axis=1) & jnp.any(vectors != 0, axis=1)
        vectors = normalize(jnp.where(usable[:, None], vectors, 0.0))
        data = data._replace(mask1=data.mask1 & usable)
    distance = jax.lax.stop_gradient(jnp.asarray(max_distance, dtype))
    return _icp(method, iterations, data, vectors, start, distance)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _icp(method: str, iterations: int, data: Clouds, vectors: Array, start: Array, max_distance: Array) -> IcpResult:
    held, held_vectors = jax.lax.stop_gradient((data, vectors))
    closed_form = alignment_kernel(with_scale=False)

    def step(pose: Array, order: Array, index: Array, weights: Array) -> tuple[Array, Array]:
        x = held.points0[order]
        if method == "point_to_point":
            poses, valid = closed_form(x, held.points1[index], weights)
            return poses[0], valid[0]
        new, _ = _gauss_newton(method, (x, held.points1[index], held_vectors[index], weights, pose))
        return new, jnp.sum(weights) > 0

    pose, matches, inliers, still = iterate_matches(held, step, start, max_distance, iterations)

    def last(weights: Array, pose: Array) -> Candidates[SE3]:
        if method == "point_to_point" and data.points0.shape[0] >= 3:
            return procrustes(data.points0, data.points1[matches], weights)
        matched = (data.points0, data.points1[matches], vectors[matches], weights, pose)
        return _matched_solver("point_to_line" if method == "point_to_point" else method)(matched)

    return finished(data, pose, matches, inliers, still, 6 if method == "point_to_plane" else 3, last)
