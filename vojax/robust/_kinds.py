"""The kinds of model that the estimators know: how a model of each is judged against the estimator's observations."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, Bool, Float
from vojax.cameras import Rig
from vojax.geometry import essential_from_pose
from vojax.lie import SE3

from ._absolute_pose import AbsolutePoseEstimator, estimate_absolute_pose
from ._alignment import AlignmentEstimator, estimate_rigid, estimate_similarity
from ._generalized_pose import checked_rig_observations, estimate_generalized_pose
from ._matrix_models import FundamentalEstimator, HomographyEstimator, estimate_fundamental, estimate_homography
from ._pairs import Plane, checked_observations, checked_pairs, masked_pairs, matrix_lanes, pair_rays
from ._relative_pose import RelativePoseEstimator, estimate_relative_pose


class Judge(NamedTuple):
    """Observations, and the squared error of models in the lanes against them."""

    squared_error: Callable[[Array, tuple[Array, ...]], Array]
    observations: tuple[Array, ...]
    mask: Bool[Array, " n"]


class Kind(NamedTuple):
    """One kind of model.

    Attributes:
        judge: From the observations of the estimator, in its order.
        entries: Numbers `[d]` of one model, as `squared_error` takes them.
        threshold: Field of `RansacOptions` that bounds the error of an inlier.
    """

    judge: Callable[..., Judge]
    entries: Callable[[Any], Float[Array, " d"]]
    threshold: str


class _RigJudge(eqx.Module):
    """Reprojection errors in the cameras themselves, not in what stands for them in a search."""

    rig: Rig

    def squared_error(self, models: Float[Array, "12 *lanes"], observation: tuple[Array, ...]) -> Array:
        x, y, z, u, v, index = observation
        point = [models[i] * x + models[i + 1] * y + models[i + 2] * z + models[i + 3] for i in (0, 4, 8)]
        points_rig = jnp.stack(jnp.broadcast_arrays(*point), axis=-1)
        camera_index = jnp.broadcast_to(index, points_rig.shape[:1])
        projected = self.rig.project(points_rig, camera_index)
        du, dv = projected[:, 0] - u, projected[:, 1] - v
        in_front = self.rig.into_cameras(points_rig, camera_index)[:, 2] > 0
        return jnp.where(in_front, du * du + dv * dv, jnp.inf)


def _of(estimator: Any, mask: Bool[Array, " n"]) -> Judge:
    return Judge(estimator.squared_error, estimator.observations, mask)


# What a search needs of an estimator and a score does not.
_SEARCH = {"limit": 1.0, "local_steps": 1}


def _absolute_pose(points_world: Any, pixels: Any, camera: Any) -> Judge:
    points_world, pixels, mask = masked_pairs(*checked_observations(points_world, pixels), None)
    return _of(AbsolutePoseEstimator(points_world, pixels, camera.unproject(pixels), camera, **_SEARCH), mask)


def _generalized_pose(points_world: Any, pixels: Any, camera_index: Any, rig: Rig) -> Judge:
    points_world, pixels, camera_index = checked_rig_observations(points_world, pixels, camera_index)
    known = (camera_index >= 0) & (camera_index < len(rig.cameras))
    points_world, pixels, mask = masked_pairs(points_world, pixels, known)
    components = (
        *(points_world[:, i] for i in range(3)),
        pixels[:, 0],
        pixels[:, 1],
        jnp.where(known, camera_index, 0),
    )
    return Judge(_RigJudge(rig).squared_error, components, mask)


def _relative_pose(pixels0: Any, pixels1: Any, camera0: Any, camera1: Any) -> Judge:
    pixels0, pixels1, mask = masked_pairs(*checked_pairs(pixels0, pixels1, 1, "a score"), None)
    return _of(RelativePoseEstimator(*pair_rays(pixels0, pixels1, camera0, camera1), **_SEARCH), mask)


def _matrix(estimator: Any) -> Callable[..., Judge]:
    def judge(pixels0: Any, pixels1: Any) -> Judge:
        pixels0, pixels1, mask = masked_pairs(*checked_pairs(pixels0, pixels1, 1, "a score"), None)
        plane = Plane(jnp.zeros((2,), pixels0.dtype), jnp.ones((), pixels0.dtype))
        return _of(estimator(*pair_rays(pixels0, pixels1, plane, plane), **_SEARCH), mask)

    return judge


def _alignment(points0: Any, points1: Any) -> Judge:
    points0, points1, mask = masked_pairs(*checked_pairs(points0, points1, 1, "a score", d=3), None)
    return _of(AlignmentEstimator(points0, points1, with_scale=True, **_SEARCH), mask)


def _motion_entries(model: Any) -> Array:
    return matrix_lanes(model.parameters())


def _matrix_entries(model: Any) -> Array:
    entries = jnp.asarray(model).reshape(9)
    # Any scale means the same model; the search is used to norm one.
    return entries / jnp.sqrt(jnp.maximum(jnp.sum(entries * entries), jnp.finfo(entries.dtype).tiny))


def _epipolar_entries(model: Any) -> Array:
    return _matrix_entries(essential_from_pose(model) if isinstance(model, SE3) else model)


_KINDS: dict[Callable[..., Any], Kind] = {
    estimate_absolute_pose: Kind(_absolute_pose, _motion_entries, "threshold_px"),
    estimate_generalized_pose: Kind(_generalized_pose, _motion_entries, "threshold_px"),
    estimate_relative_pose: Kind(_relative_pose, _epipolar_entries, "threshold_px"),
    estimate_fundamental: Kind(_matrix(FundamentalEstimator), _matrix_entries, "threshold_px"),
    estimate_homography: Kind(_matrix(HomographyEstimator), _matrix_entries, "threshold_px"),
    estimate_rigid: Kind(_alignment, _motion_entries, "threshold"),
    estimate_similarity: Kind(_alignment, _motion_entries, "threshold"),
}


def kind_of(estimator: Callable[..., Any]) -> Kind:
    """What kind of model an estimator returns.

    Raises:
        ValueError: If it is none of the `estimate_*` functions.
    """
    kind = _KINDS.get(estimator) if callable(estimator) else None
    if kind is None:
        names = ", ".join(function.__name__ for function in _KINDS)
        raise ValueError(f"{getattr(estimator, '__name__', estimator)!r} is no estimator: expected one of {names}")
    return kind


def lanes_of(kind: Kind, models: Any) -> Float[Array, "d k"]:
    """Numbers of many models, models in the lanes."""
    return jax.vmap(kind.entries, out_axes=1)(models)
