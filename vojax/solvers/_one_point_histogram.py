"""One turn from all correspondences of a vehicle: every point votes for the angles that explain it.

A single angle θ is unknown (see the one-point solver), so that there is nothing to sample: all angles are tried. A
point votes for every bin that holds an angle at which its epipolar error

    r(θ) = (c (g_y f_x - f_y g_x) + s (g_y f_z + f_y g_z)) / |(f_x', f_y, g_x', g_y)|                               (1)

is within the threshold; f_x' and g_x' are seen from halfway along the arc. r is the error as an angle, shared between
both bearings (Sampson). A point near the horizon thus votes for many bins and one that tells the angle well for few,
where a histogram of the points' own angles would count both alike. The winning bin is divided again, and least squares
over the points within the threshold finish.

References:
    D. Scaramuzza, F. Fraundorfer, R. Siegwart. Real-time monocular visual odometry for on-road vehicles with 1-point
        RANSAC. ICRA 2009.
    D. Scaramuzza. 1-point-RANSAC structure from motion for vehicle-mounted cameras by exploiting non-holonomic
        constraints. IJCV 95, 2011.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vojax._numerics import safe_divide, safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float

from ._candidates import Candidates
from ._components import Components, Rows3
from ._implicit import implicit
from ._lanes import lanes_last
from ._one_point import FORWARD, epipolar_coefficients, vehicle_frame
from ._upright_three_point import NO_PARALLAX, UP, turn, unit_components, upright_bearings

_BINS = 128

Data = tuple[Array, Array, Array, Array, Array, Array]


class TurnVote(NamedTuple):
    """The turn that most correspondences agree with.

    Attributes:
        theta: Change of heading in radians, to the left; 0 where not valid.
        inliers: The correspondences that agree with it.
        inlier_share: Their share of the usable correspondences.
        valid: False where no correspondence tells the angle.
    """

    theta: Float[Array, ""]
    inliers: Bool[Array, "n"]
    inlier_share: Float[Array, ""]
    valid: Bool[Array, ""]


def _errors(f: Components, g: Components, theta: Array) -> Array:
    """(1), elementwise."""
    c, s = jnp.cos(0.5 * theta), jnp.sin(0.5 * theta)
    a, b = epipolar_coefficients(f, g)
    ahead, behind = turn(c, s, f), turn(c, -s, g)
    norm = safe_sqrt(ahead[0] * ahead[0] + f[1] * f[1] + behind[0] * behind[0] + g[1] * g[1])
    # A point in the direction of travel fits all angles.
    return safe_divide(c * a + s * b, norm)


def _with_slopes(f: Components, g: Components, theta: Array) -> tuple[Array, Array]:
    return jax.jvp(lambda theta: _errors(f, g, theta), (theta,), (jnp.ones_like(theta),))


def _bearings(rays: Array, axes: Rows3) -> tuple[Components, Array]:
    """Components [n, *lanes] in the vehicle's frame, zero for rays that are none, and which are some."""
    bearings, _ = upright_bearings(rays, axes)
    return bearings, unit_components((rays[:, 0], rays[:, 1], rays[:, 2]))[1]  # type: ignore[return-value]


def _vote(
    rays0: Array, rays1: Array, usable: Array, forward: Array, up: Array, threshold: Array, max_turn: Array
) -> tuple[Array, Array, Array]:
    """A first angle [*lanes], the points that agree with it and the usable ones, as 0 and 1 [n, *lanes]."""
    axes, _ = vehicle_frame(forward, up)
    f, proper0 = _bearings(rays0, axes)
    g, proper1 = _bearings(rays1, axes)
    usable = jnp.where(proper0 & proper1, usable, 0.0)
    every_f, every_g = (tuple(x[None] for x in y) for y in (f, g))
    places = (jnp.arange(_BINS, dtype=rays0.dtype) + 0.5) / _BINS * 2.0 - 1.0
    places = places.reshape(-1, *(1,) * max_turn.ndim)

    def search(centre: Array, half_width: Array) -> Array:
        theta = centre[None] + half_width[None] * places  # [bins, *lanes]
        error, slope = _with_slopes(every_f, every_g, jnp.broadcast_to(theta[:, None], (_BINS, *usable.shape)))
        # What a vote is worth falls with the error left at the nearest angle in the bin, as in MSAC.
        excess = jnp.abs(error) - jnp.abs(slope) * (half_width / _BINS)[None, None]
        excess = jnp.maximum(excess, 0.0) / threshold[None, None]
        votes = jnp.sum(usable[None] * jnp.maximum(1.0 - excess * excess, 0.0), axis=1)
        return jnp.sum(jnp.where(jnp.argmax(votes, axis=0)[None] == _ranks(votes), theta, 0.0), axis=0)

    theta = search(jnp.zeros_like(max_turn), max_turn)
    theta = search(theta, max_turn * (3.0 / _BINS))

    def refit(_: object, theta: Array) -> Array:
        error, slope = _with_slopes(f, g, jnp.broadcast_to(theta[None], usable.shape))
        weight = jnp.where(jnp.abs(error) <= threshold[None], usable, 0.0)
        return theta - safe_divide(jnp.sum(weight * error * slope, axis=0), jnp.sum(weight * slope * slope, axis=0))

    theta = jax.lax.fori_loop(0, 5, refit, theta)
    error = _errors(f, g, jnp.broadcast_to(theta[None], usable.shape))
    return theta, jnp.where(jnp.abs(error) <= threshold[None], usable, 0.0), usable


def _ranks(x: Array) -> Array:
    return jnp.arange(x.shape[0]).reshape(-1, *(1,) * (x.ndim - 1))


def _fit(rays0: Array, rays1: Array, weights: Array, forward: Array, up: Array, start: Array) -> tuple[Array, Array]:
    """Least squares over the chosen points: the angle [1, *lanes] and whether they tell it [1, *lanes]."""
    axes, proper = vehicle_frame(forward, up)
    f, _ = _bearings(rays0, axes)
    g, _ = _bearings(rays1, axes)

    def step(_: object, state: tuple[Array, Array]) -> tuple[Array, Array]:
        theta, _ = state
        error, slope = _with_slopes(f, g, jnp.broadcast_to(theta[None], weights.shape))
        information = jnp.sum(weights * slope * slope, axis=0)
        return theta - safe_divide(jnp.sum(weights * error * slope, axis=0), information), information

    theta, information = jax.lax.fori_loop(0, 5, step, (start, jnp.zeros_like(start)))
    eps = float(jnp.finfo(theta.dtype).eps)
    valid = proper & jnp.isfinite(theta) & (information > (NO_PARALLAX * eps) ** 2)
    return jnp.where(valid, theta, 0.0)[None], valid[None]


_vote_lanes = jax.jit(lanes_last(_vote))
_fit_lanes = lanes_last(_fit)


def _candidates(data: Data) -> Candidates[Array]:
    theta, valid = _fit_lanes(*data)
    return Candidates(models=theta, valid=valid)


def _stationarity(theta: Array, data: Data) -> Array:
    """Half the derivative of the sum of squares over the chosen points."""
    rays0, rays1, weights, forward, up, _ = data
    axes, _ = vehicle_frame(forward, up)
    f, _ = _bearings(rays0, axes)
    g, _ = _bearings(rays1, axes)
    error, slope = _with_slopes(f, g, jnp.broadcast_to(theta[None], weights.shape))
    return jnp.sum(weights * error * slope)[None]


_histogram = implicit(_candidates, _stationarity, lambda theta, tangent: theta + tangent[0], 1)


def one_point_histogram(
    rays0: Float[ArrayLike, "n 3"],
    rays1: Float[ArrayLike, "n 3"],
    forward: Float[ArrayLike, "3"] = FORWARD,
    up: Float[ArrayLike, "3"] = UP,
    *,
    threshold: float | Float[ArrayLike, ""] = 2e-3,
    max_turn: float | Float[ArrayLike, ""] = 0.5,
    mask: Bool[ArrayLike, "n"] | None = None,
) -> TurnVote:
    """Find the turn of a vehicle that most correspondences agree with, without sampling.

    `arc_motion(theta, forward, up)` makes a pose of it. For a camera above a fixed axle, see `one_point`.

    Args:
        rays0: Directions in camera 0's frame, one per row, of any positive length.
        rays1: Directions to the same points in camera 1's frame.
        forward: The vehicle's direction of travel in the camera's frame; by default the optical axis, +z.
        up: The normal of the floor in the camera's frame; by default -y.
        threshold: Angle in radians within which a correspondence fits, by default that of 1.4 pixels at a focal length
            of 700.
        max_turn: Largest change of heading sought, in radians, up to π.
        mask: False for correspondences to leave out, such as padding; all are used by default.

    Returns:
        The angle, the least-squares one over its inliers, and who they are.

    Degenerate input: points at the height of the camera agree with every angle and decide none; if there are no others,
        if all are left out, if a direction of travel is along the vertical or not finite, the vote is not valid: angle
        0 and no inliers. Rays that are zero or not finite count as left out. Of two equally good angles any one wins.
    Differentiability: the angle in rays and directions, both modes, with the inliers held fixed; zero where not valid.

    Raises:
        ValueError: If the arrays do not match.
    References: see the module.

    Example:
        >>> rays = jnp.array([[0.5, 0.4, 2.0], [-0.6, 0.3, 3.0], [0.4, -0.5, 4.0]])
        >>> vote = one_point_histogram(rays, rays - jnp.array([0.0, 0.0, 0.5])[None])
        >>> bool(vote.valid), bool(jnp.abs(vote.theta) < 1e-5), float(vote.inlier_share)
        (True, True, 1.0)
    """
    rays0, rays1 = jnp.asarray(rays0), jnp.asarray(rays1)
    if rays0.shape != rays1.shape or rays0.ndim != 2 or rays0.shape[1:] != (3,):
        raise ValueError(f"found rays of shapes {rays0.shape} and {rays1.shape}; expected two equal shapes [n, 3]")
    count, dtype = rays0.shape[0], jnp.result_type(rays0, rays1)
    usable = jnp.ones(count, dtype) if mask is None else jnp.asarray(mask).astype(dtype)
    if usable.shape != (count,):
        raise ValueError(f"found a mask of shape {usable.shape}; expected one value per correspondence, ({count},)")
    rays0, rays1 = rays0.astype(dtype), rays1.astype(dtype)
    forward, up = jnp.asarray(forward).astype(dtype), jnp.asarray(up).astype(dtype)
    threshold, max_turn = (jnp.asarray(x).astype(dtype) for x in (threshold, max_turn))
    start, weights, usable = _vote_lanes(
        *jax.lax.stop_gradient((rays0, rays1, usable, forward, up, threshold, max_turn))
    )
    found = _histogram((rays0, rays1, weights, forward, up, start))
    inliers = (weights > 0) & found.valid[0]
    share = jnp.sum(inliers.astype(dtype)) / jnp.maximum(jnp.sum(usable), 1.0)
    return TurnVote(found.models[0], inliers, share, found.valid[0])
