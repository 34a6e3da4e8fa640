"""Which of the poses of three points is the true one: ask a fourth point.

Either the fourth point itself is compared with its bearing, or P3P is solved for a second triple of the four points and
the pose that both sets of solutions share is taken.

References: M. Fischler, R. Bolles. Random sample consensus. Communications of the ACM 1981.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import normalize
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SE3

from ._candidates import Candidates


def select_by_fourth_point(
    candidates: Candidates[SE3], point_world: Float[ArrayLike, "3"], bearing: Float[ArrayLike, "3"]
) -> Candidates[SE3]:
    """Keep the pose that sees one more point nearest to its bearing.

    Args:
        candidates: Poses `cam_from_world`, from `p3p` or any other solver.
        point_world: A point that was not used to find them.
        bearing: Direction towards it in the camera's frame, of any positive length.

    Returns:
        One slot: the valid pose with the least angle between the point and its bearing.

    Degenerate input: no valid pose, a zero bearing and anything not finite leave the slot invalid, the identity in it.
        A fourth point that coincides with one of the three decides nothing: any of the poses comes out.

    Differentiability: both modes, that of the pose that is chosen; the choice has none.

    Example:
        >>> from vojax.solvers import p3p
        >>> points = jnp.array([[0.0, 0.0, 4.0], [1.0, 0.0, 5.0], [0.0, 1.0, 6.0], [1.0, 1.0, 4.0]])
        >>> best = select_by_fourth_point(p3p(points[:3], points[:3]), points[3], points[3])
        >>> bool(jnp.abs(best.models.translation()).max() < 1e-3)
        True
    """
    point_world, bearing = jnp.asarray(point_world), jnp.asarray(bearing)
    usable = jnp.all(jnp.isfinite(point_world)) & jnp.all(jnp.isfinite(bearing)) & jnp.any(bearing != 0)
    # By the largest entry first, so that squares neither overflow nor vanish.
    bearing = jnp.where(usable, bearing, 1.0)
    bearing = normalize(bearing / jnp.max(jnp.abs(bearing)))
    point_cam = candidates.models @ jnp.where(usable, point_world, 0.0)[None]
    error = normalize(point_cam) - bearing[None]
    return _take(candidates, jnp.sum(error * error, axis=-1), candidates.valid & usable)


def select_by_second_p3p(
    candidates: Candidates[SE3], others: Candidates[SE3], points_world: Float[ArrayLike, "n 3"]
) -> Candidates[SE3]:
    """Keep the pose that two solutions of P3P share.

    Args:
        candidates: Poses `cam_from_world` from one triple of points.
        others: Poses from another triple of the same view.
        points_world: The points of both triples; poses are compared by where they put these.

    Returns:
        One slot: the pose of `candidates` from which some pose of `others` moves the points least.

    Degenerate input: a set without valid pose and points that are not finite leave the slot invalid, the identity
        in it. Four points in a symmetric arrangement may have several poses in common; one of them comes out.

    Differentiability: both modes, that of the pose that is chosen; the choice has none.

    Example:
        >>> from vojax.solvers import p3p
        >>> points = jnp.array([[0.0, 0.0, 4.0], [1.0, 0.0, 5.0], [0.0, 1.0, 6.0], [1.0, 1.0, 4.0]])
        >>> first, second = p3p(points[:3], points[:3]), p3p(points[1:], points[1:])
        >>> best = select_by_second_p3p(first, second, points)
        >>> bool(jnp.abs(best.models.translation()).max() < 1e-3)
        True
    """
    points_world = jnp.asarray(points_world)
    usable = jnp.all(jnp.isfinite(points_world))
    points_world = jnp.where(usable, points_world, 0.0)
    moved, moved_by_other = (jax.vmap(lambda pose: pose @ points_world)(c.models) for c in (candidates, others))
    apart = jnp.max(jnp.abs(moved[:, None] - moved_by_other[None]), axis=(-1, -2))
    together = jnp.where(others.valid[None], apart, jnp.inf)
    return _take(candidates, jnp.min(together, axis=1), candidates.valid & usable & jnp.any(others.valid))


def _take(candidates: Candidates[SE3], errors: Float[Array, "s"], valid: Bool[Array, "s"]) -> Candidates[SE3]:
    """The valid candidate with the least error, in one slot."""
    errors = jnp.where(valid & ~jnp.isnan(errors), jax.lax.stop_gradient(errors), jnp.inf)
    chosen = (jnp.arange(errors.shape[0]) == jnp.argmin(errors)) & valid
    found = jnp.any(chosen)
    parameters = jnp.sum(jnp.where(chosen[:, None], candidates.models.parameters(), 0.0), axis=0)
    identity = jnp.eye(7, dtype=parameters.dtype)[0]
    return Candidates(models=SE3(jnp.where(found, parameters, identity)[None]), valid=found[None])
