"""Perspective cameras and points from tracks, by repeated affine factorisation.

A camera at cam_from_world = (R_i, t_i), t_i = (x0_i, 1) / s_i, sees normalised coordinates x_ij with

    (1 + ε_ij) x_ij            = x0_i + s_i (R_i X_j)_xy                 weak perspective,                          (1)
    (1 + ε_ij) x_ij - ε_ij x0_i = x0_i + s_i ((R_i X_j)_xy - x0_i (R_i X_j)_z)    paraperspective,                   (2)

and ε_ij = s_i (R_i X_j)_z. The right-hand sides are images by parallel projection. So: start with ε = 0, factor the
left-hand side, take ε from the result, and again. The fixed point is the perspective scene. Of the two reversals one
fits; the other is followed as well, for where perspective is weaker than the noise nothing tells them apart.

References:
    S. Christy, R. Horaud. Euclidean shape and motion from multiple perspective views by affine iterations. PAMI 1996.
"""

import functools
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._factorization import AffineScene, checked_tracks, factor
from ._metric_upgrade import MetricScene, Projection, metric_upgrade


class PerspectiveScene(NamedTuple):
    """Calibrated cameras and the points they see, up to scale.

    Attributes:
        cam_from_world: Pose of each view; the world is the frame of view 0.
        points: World points. Their centroid is one unit deep in view 0.
    """

    cam_from_world: SE3
    points: Float[Array, "*batch p 3"]


def perspective_factorization(
    normalized: Float[ArrayLike, "c p 2"],
    mask: Bool[ArrayLike, "c p"] | None = None,
    *,
    projection: Literal["weak_perspective", "paraperspective"] = "paraperspective",
    iterations: int = 20,
) -> Candidates[PerspectiveScene]:
    """Find calibrated cameras and points from tracks, for a scene that is not close compared with its size.

    Args:
        normalized: Where each view sees each point, on the plane z = 1.
        mask: True where a point was seen; what stands elsewhere is ignored. None where all were seen.
        projection: What the scene is factored by in each round, (1) or (2). The fixed point is the same.
        iterations: Rounds. A handful will do for a scene five times as far as it is large; see notebook 11.

    Returns:
        Two slots, the scene and what the reversed one became, in the order of their reprojection errors. Errors are
        weighted by depth, not those of the image: refine with `vojax.ba.adjust_bundle`.

    Degenerate input: as `metric_factorization`. A slot that has not settled by the last round (a change of ε above
        √eps), or has points behind a camera, is not valid; the reversed scene often is not.
    Differentiability: both modes, first order, through the rounds, whose derivative settles as they do.

    Raises:
        ValueError: Fewer than three views or four points, no round, unknown projection, arrays that do not match.
    References: see the module.
    """
    if projection not in ("weak_perspective", "paraperspective"):
        raise ValueError(f"found projection {projection!r}; expected weak_perspective or paraperspective")
    if iterations < 1:
        raise ValueError(f"found {iterations} iterations; expected at least one")
    tracks, seen = checked_tracks(normalized, mask)
    return _iterate(tracks, seen, mask is None, projection, iterations)


@functools.partial(jax.jit, static_argnames=("complete", "projection", "iterations"))
def _iterate(
    tracks: Array, seen: Array, complete: bool, projection: Projection, iterations: int
) -> Candidates[PerspectiveScene]:
    """`perspective_factorization` without its checks."""

    def upgraded(corrected: Array, start: Array | None) -> tuple[MetricScene, Array, Array]:
        scene, ok = factor(corrected, seen, complete, start)
        affine = AffineScene(*scene)
        candidates = metric_upgrade(affine, projection)
        return candidates.models, ok & candidates.valid[0], affine.matrices

    def one_round(state: tuple[Any, ...], _: object) -> tuple[tuple[Any, ...], None]:
        relative, offset, start, *_ = state
        slant = offset if projection == "paraperspective" else jnp.zeros_like(offset)
        corrected = (1.0 + relative[..., None]) * tracks - relative[..., None] * slant[:, None]
        scenes, ok, start = upgraded(corrected, start)
        both = _relative_depths(scenes)
        # The same of the two as before.
        chosen = jnp.where(jnp.sum(both[1] * relative) > jnp.sum(both[0] * relative), 1, 0)
        new = jnp.where(ok, both[chosen], relative)
        change = jnp.max(jnp.where(seen, jnp.abs(new - relative), 0.0))
        # In front of the camera, if only just: what is on its way may overshoot.
        new = jnp.maximum(new, -0.9)
        scene = jax.tree.map(lambda x: x[chosen], scenes)
        return (new, scene.offset, start, scene, ok, change), None

    def follow(first: Array, scene: MetricScene, start: Array, ok: Array) -> tuple[PerspectiveScene, Array, Array]:
        state = (first, scene.offset, start, scene, ok, jnp.asarray(jnp.inf, tracks.dtype))
        (relative, _, _, scene, ok, change), _ = jax.lax.scan(one_round, state, None, length=iterations - 1)
        found = _in_view_0(scene)
        settled = change < float(jnp.finfo(tracks.dtype).eps) ** 0.5
        in_front = jnp.all((relative > -0.9) | ~seen)
        return found, jnp.where(ok, _squared_error(found, tracks, seen), jnp.inf), ok & settled & in_front

    scenes, ok, start = upgraded(tracks, None)
    found, error, valid = jax.vmap(follow, in_axes=(0, 0, None, None))(
        jnp.maximum(_relative_depths(scenes), -0.9), scenes, start, ok
    )
    order = jnp.where(error[1] < error[0], jnp.array([1, 0]), jnp.array([0, 1]))
    return jax.tree.map(lambda x: x[order], Candidates(models=found, valid=valid))


def _relative_depths(scene: MetricScene) -> Float[Array, "*batch c p"]:
    """ε: depths of points relative to the centroid, over the depth of the centroid."""
    return scene.scale[..., None] * jnp.einsum(
        "...ck,...pk->...cp", scene.cam_from_world.as_matrix()[..., 2, :], scene.points
    )


def _in_view_0(scene: MetricScene) -> PerspectiveScene:
    """Poses and points in the frame of view 0."""
    scale = jnp.where(scene.scale > 0, scene.scale, 1.0)[:, None]
    center = jnp.concatenate([scene.offset, jnp.ones_like(scale)], axis=1) / scale
    turned = jnp.einsum("cij,j->ci", scene.cam_from_world.as_matrix(), center[0])
    poses = SE3.from_rotation_and_translation(scene.cam_from_world, center - turned)
    return PerspectiveScene(poses, scene.points + center[:1])


def _squared_error(found: PerspectiveScene, tracks: Array, seen: Array) -> Float[Array, ""]:
    """Sum of squared reprojection errors."""
    rotation, translation = found.cam_from_world.rotation().as_matrix(), found.cam_from_world.translation()
    points = jnp.einsum("cij,pj->cpi", rotation, found.points) + translation[:, None]
    z = points[..., 2:]
    error = jnp.where(seen[..., None], points[..., :2] / jnp.where(z > 1e-3, z, 1e-3) - tracks, 0.0)
    return jnp.sum(error * error)
