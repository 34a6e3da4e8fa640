"""Calibration of several cameras fixed to one another, from boards that they see together."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from vojax._result import Result
from vojax._types import Array, ArrayLike, Bool, Float, Int
from vojax.ba import LMOptions, Loss, Squared
from vojax.ba._board_residual import BoardData, BoardState
from vojax.cameras import BrownConrady, Rig
from vojax.lie import SE3

from ._calibrate import (
    CALIBRATION_OPTIONS,
    MIN_CORNERS,
    MIN_VIEWS,
    as_board,
    as_mask,
    as_sigma,
    check_corners,
    enough_views,
    start_state,
)
from ._models import Free, free_parameters, parameter_names, template_of
from ._statistics import check_loss, rms, solve

_POSE_NAMES = ("rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z")


class RigCalibration(eqx.Module):
    """Calibrated cameras and where they stand; the first camera's frame is the rig's.

    Attributes:
        rig: The cameras with their poses `cam_from_rig`.
        rig_from_board: Pose of the board in every view; the identity for a view that was left out.
        residuals: Reprojected minus measured, in pixels; zero for corners that do not count.
        used: Cameras and views that took part.
        rms_px: Root mean square distance over all corners that count.
        camera_rms_px: The same for each camera.
        sigma_px: Standard deviation of a corner's coordinate, estimated (or as given).
        covariance: Of intrinsics and poses of the cameras, in the order of `names`; the tangent ξ = (ρ, φ) of a pose
            is that of exp(−ξ) @ cam_from_rig.
        board_covariance: Of the tangents of `rig_from_board`.
        unconstrained: Parameters that the views do not fix, see `Calibration`.
        view_angle: Largest angle between two boards, radians.
        cost: ½Σρ.
        iterations: Evaluations of the residuals.
        result: How it ended.
        names: Of the parameters, `camera0.fx` … `camera1.phi_z`.
    """

    rig: Rig
    rig_from_board: SE3
    residuals: Float[Array, "c v n 2"]
    used: Bool[Array, "c v"]
    rms_px: Float[Array, ""]
    camera_rms_px: Float[Array, " c"]
    sigma_px: Float[Array, ""]
    covariance: Float[Array, "d d"]
    board_covariance: Float[Array, "v 6 6"]
    unconstrained: Bool[Array, " d"]
    view_angle: Float[Array, ""]
    cost: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Result
    names: tuple[str, ...] = eqx.field(static=True)

    def standard_deviations(self) -> Float[Array, " d"]:
        """Of the parameters, in the order of `names`."""
        return jnp.sqrt(jnp.diagonal(self.covariance))


def calibrate_rig(
    corners: Float[ArrayLike, "c v n 2"],
    object_points: Float[ArrayLike, "n d"],
    image_size: tuple[int, int],
    *,
    model: Any = BrownConrady,
    mask: Bool[ArrayLike, "c v n"] | None = None,
    free: Any = None,
    sigma_px: Float[ArrayLike, "..."] | float | None = None,
    loss: Loss = Squared(),
    options: LMOptions = CALIBRATION_OPTIONS,
) -> RigCalibration:
    """Estimate two or more cameras of one model and their poses in a rig, jointly, with standard deviations.

    Each camera starts on its own, the rig from the boards that cameras see in common, if need be by way of a third
    camera; then intrinsics, rig and board poses are adjusted together.

    Args:
        corners: Measured pixels of every point in every view of every camera; a view is one moment.
        object_points: The points on the board, plane z = 0; their unit is that of the poses.
        image_size: Width and height, the same for all cameras.
        model: Camera class; or one camera, or a sequence of one for each, to start from. Fixed parameters are kept.
        mask: True for corners that were seen. None: all.
        free: Names of the parameters to estimate in every camera, as in `calibrate`; `()` keeps the cameras.
        sigma_px: Standard deviation of a corner's coordinate, one for all or one each. None: estimated.
        loss: Robust loss of the squared residual of a corner.
        options: Of the optimiser.

    Returns:
        The calibration.

    Degenerate input: as for `calibrate`; a camera that is not connected to the first by common views leaves its pose
        open, and `result` says `degenerate`.

    Differentiability: both modes, in corners, object points and `sigma_px`, by the implicit function theorem with the
        exact Hessian. Covariances and `sigma_px` are constants.

    Raises:
        ValueError: As `calibrate`, for fewer than two cameras, cameras of several models, and a camera that shares no
            view with the others.
    """
    corners, board = as_board(corners, object_points, ("c", "v"))
    check_loss(loss)
    count = corners.shape[0]
    if count < 2:
        raise ValueError(f"corners of {count} camera: expected two or more; calibrate() is for one")
    seen = as_mask(mask, corners)
    check_corners(corners, seen, image_size)
    models = tuple(model) if isinstance(model, (tuple, list)) else (model,) * count
    if len(models) != count:
        raise ValueError(f"{len(models)} models for {count} cameras: expected one, or one for each")
    templates = [template_of(each, corners.dtype) for each in models]
    if len({jax.tree.structure(camera) for camera, _ in templates}) > 1:
        names = ", ".join(type(camera).__name__ for camera, _ in templates)
        raise ValueError(f"cameras of several models ({names}): expected one model for all cameras of a rig")
    groups = free_parameters(templates[0][0], free)
    _check_views(seen, 1 if not groups else MIN_VIEWS)
    sigma = as_sigma(sigma_px, seen.shape, corners.dtype)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(camera for camera, _ in templates))
    return _calibrate_rig(
        stacked, templates[0][1], corners, board, seen, sigma, sigma_px is not None, loss, groups,
        (image_size[0], image_size[1]), options,
    )  # fmt: skip


def _check_views(seen: Array, least: int) -> None:
    if isinstance(seen, Tracer):
        return
    for i in range(len(seen)):
        try:
            enough_views(seen[i], least)
        except ValueError as error:
            raise ValueError(f"camera {i}: {error}") from None
    together = np.asarray(seen).sum(axis=-1) >= MIN_CORNERS
    joined = {0}
    for _ in range(len(together)):
        joined |= {i for i in range(len(together)) if any((together[i] & together[j]).any() for j in joined)}
    if len(joined) < len(together):
        alone = min(set(range(len(together))) - joined)
        raise ValueError(
            f"camera {alone} has no view in common with camera 0, not even by way of others: expected boards that both "
            "see at one moment"
        )


@eqx.filter_jit
def _calibrate_rig(
    templates: Any,
    given: bool,
    corners: Array,
    board: Array,
    seen: Array,
    sigma: Array,
    sigma_given: bool,
    loss: Loss,
    groups: Free,
    image_size: tuple[int, int],
    options: LMOptions,
) -> RigCalibration:
    def alone(template: Any, corners: Array, seen: Array, sigma: Array) -> tuple[Any, Array, Array, Array]:
        state, weight, used = start_state(template, given, corners, board, seen, image_size)
        data = BoardData(corners[None], board, weight[None], sigma[None], loss, groups)
        found = solve(state, data, used, sigma_given, image_size, options).state
        return jax.tree.map(lambda leaf: leaf[0], found.cameras), found.rig_from_board.wxyz_xyz, weight, used

    cameras, cam_from_board, weight, used = jax.lax.map(
        lambda arguments: alone(*arguments), jax.lax.stop_gradient((templates, corners, seen, sigma))
    )
    cam_from_rig, rig_from_board, joined = _assemble(cam_from_board, jnp.sum(weight, axis=-1) * used)
    weight = weight * joined[:, None, None]
    start = BoardState(cameras, SE3(cam_from_rig), SE3(rig_from_board))
    data = BoardData(corners, board, weight, sigma, loss, groups)
    found = solve(start, data, jnp.any(used & joined[:, None], axis=0), sigma_given, image_size, options)
    own = tuple(jax.tree.map(lambda leaf, i=i: leaf[i], found.state.cameras) for i in range(len(corners)))
    return RigCalibration(
        rig=Rig(own, found.state.cam_from_rig),
        rig_from_board=found.state.rig_from_board,
        residuals=found.residuals,
        used=used & joined[:, None],
        rms_px=rms(found.residuals, weight, (0, 1, 2)),
        camera_rms_px=rms(found.residuals, weight, (1, 2)),
        sigma_px=found.sigma_px,
        covariance=found.covariance,
        board_covariance=found.board_covariance,
        unconstrained=found.unconstrained,
        view_angle=found.view_angle,
        cost=found.cost,
        iterations=found.iterations,
        result=found.result,
        names=rig_parameter_names(groups, len(corners)),
    )


def rig_parameter_names(groups: Free, count: int) -> tuple[str, ...]:
    """Intrinsics of all cameras, then poses of all but the first."""
    names = [f"camera{i}.{name}" for i in range(count) for name in parameter_names(groups)]
    return (*names, *(f"camera{i}.{name}" for i in range(1, count) for name in _POSE_NAMES))


def _assemble(
    cam_from_board: Float[Array, "c v 7"], share: Float[Array, "c v"]
) -> tuple[Float[Array, "c 7"], Float[Array, "v 7"], Bool[Array, " c"]]:
    """Rig and boards from the boards' poses in each camera.

    A camera that shares views with cameras whose place is known gets the pose that most of these views agree on.

    Args:
        cam_from_board: Poses.
        share: Corners behind each; zero where there is no pose.

    Returns:
        cam_from_rig, rig_from_board, and the cameras whose place is known.
    """
    count, views, _ = cam_from_board.shape
    identity = SE3.identity((), dtype=cam_from_board.dtype).wxyz_xyz
    cam_from_rig = jnp.tile(identity, (count, 1))
    joined = jnp.arange(count) == 0

    def boards(cam_from_rig: Array, joined: Array) -> tuple[Array, Array]:
        by_camera = jax.vmap(
            lambda cam, poses: (SE3(jnp.broadcast_to(cam, poses.shape)).inverse() @ SE3(poses)).wxyz_xyz
        )(cam_from_rig, cam_from_board)
        usable = share * joined[:, None]
        best = jnp.argmax(usable, axis=0)
        return by_camera[best, jnp.arange(views)], jnp.max(usable, axis=0) > 0

    for _ in range(count - 1):
        rig_from_board, known = boards(cam_from_rig, joined)
        candidates = SE3(cam_from_board) @ SE3(jnp.broadcast_to(rig_from_board, cam_from_board.shape)).inverse()
        good = (share > 0) & known[None]
        # The medoid: translations in units of their usual length.
        parameters = candidates.wxyz_xyz
        signed = parameters[..., :4] * jnp.where(parameters[..., :1] < 0, -1.0, 1.0)
        distance = jnp.linalg.norm(parameters[..., 4:], axis=-1)
        length = jnp.sum(jnp.where(good, distance, 0.0), axis=1) / jnp.maximum(jnp.sum(good, axis=1), 1) + 1e-6
        vectors = jnp.concatenate([2.0 * signed, parameters[..., 4:] / length[:, None, None]], axis=-1)
        apart = jnp.linalg.norm(vectors[:, :, None] - vectors[:, None], axis=-1)
        total = jnp.sum(jnp.where(good[:, None], apart, 0.0), axis=-1)
        middle = jnp.argmin(jnp.where(good, total, jnp.inf), axis=1)
        chosen = parameters[jnp.arange(count), middle]
        new = ~joined & jnp.any(good, axis=1)
        cam_from_rig = jnp.where(new[:, None], chosen, cam_from_rig)
        joined = joined | new
    rig_from_board, known = boards(cam_from_rig, joined)
    return cam_from_rig, jnp.where(known[:, None], rig_from_board, identity), joined
