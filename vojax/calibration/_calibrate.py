"""Calibration of one camera from views of a planar board."""

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
from vojax.ba._intrinsics import get_attribute
from vojax.cameras import BrownConrady
from vojax.lie import SE3

from ._initialization import start_single
from ._models import Free, free_parameters, parameter_names, template_of
from ._statistics import check_loss, rms, solve

CALIBRATION_OPTIONS = LMOptions(max_steps=100, initial_damping=1e-3)
# Fewer corners than these fix no pose of a plane.
MIN_CORNERS = 4
MIN_VIEWS = 3


class Calibration(eqx.Module):
    """A calibrated camera.

    Attributes:
        camera: The camera, free parameters estimated.
        cam_from_board: Pose of the board in every view; the identity for a view that was left out.
        residuals: Reprojected minus measured, in pixels; zero for corners that do not count.
        used: Views that took part: at least four corners, in general position.
        rms_px: Root mean square distance over all corners that count.
        view_rms_px: The same for each view.
        sigma_px: Standard deviation of a corner's coordinate, estimated (or as given).
        covariance: Of the free parameters, in the order of `names`.
        pose_covariance: Of the tangents ξ of the poses, exp(−ξ) @ cam_from_board.
        unconstrained: Parameters that the views do not fix: without information, or with a standard deviation that
            moves an observed corner by more than 1 % of the image's diagonal.
        view_angle: Largest angle between two boards, radians; with parallel boards nothing is known.
        cost: ½Σρ.
        iterations: Evaluations of the residuals.
        result: How it ended.
        names: Of the free parameters.
    """

    camera: Any
    cam_from_board: SE3
    residuals: Float[Array, "v n 2"]
    used: Bool[Array, " v"]
    rms_px: Float[Array, ""]
    view_rms_px: Float[Array, " v"]
    sigma_px: Float[Array, ""]
    covariance: Float[Array, "k k"]
    pose_covariance: Float[Array, "v 6 6"]
    unconstrained: Bool[Array, " k"]
    view_angle: Float[Array, ""]
    cost: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Result
    names: tuple[str, ...] = eqx.field(static=True)

    def values(self) -> Float[Array, " k"]:
        """The free parameters in the order of `names`."""
        first = [get_attribute(self.camera, name.split(" = ")[0]) for name in self.names]
        return jnp.stack(first) if first else jnp.zeros((0,), self.rms_px.dtype)

    def standard_deviations(self) -> Float[Array, " k"]:
        """Of the free parameters, in the order of `names`."""
        return jnp.sqrt(jnp.diagonal(self.covariance))


def calibrate(
    corners: Float[ArrayLike, "v n 2"],
    object_points: Float[ArrayLike, "n d"],
    image_size: tuple[int, int],
    *,
    model: Any = BrownConrady,
    mask: Bool[ArrayLike, "v n"] | None = None,
    free: Any = None,
    sigma_px: Float[ArrayLike, "..."] | float | None = None,
    loss: Loss = Squared(),
    options: LMOptions = CALIBRATION_OPTIONS,
) -> Calibration:
    """Estimate a camera from corners of a planar board in several views, with standard deviations.

    Starts from Zhang's closed form or a sweep over focal lengths, whichever fits better, and minimises the robust sum
    of squared reprojection errors over intrinsics and board poses by Levenberg–Marquardt.

    Args:
        corners: Measured pixels (integer pixel centres) of every point in every view.
        object_points: The points on the board, plane z = 0, `[n, 3]` or `[n, 2]`; their unit is that of the poses.
        image_size: Width and height of the images, pixels.
        model: Camera class; or a camera, whose values are where to start and whose fixed parameters are kept.
        mask: True for corners that were seen. None: all. Masked corners may hold anything.
        free: Names of the parameters to estimate; a tuple of names within it is one unknown, so
            `free=(("fx", "fy"), "cx", "cy")` keeps pixels square. None: all but the skew.
        sigma_px: Standard deviation of a corner's coordinate, one for all or one each `[v, n]`. None: estimated from
            the residuals; the loss then takes residuals in pixels.
        loss: Robust loss of the squared residual (in sigmas) of a corner.
        options: Of the optimiser.

    Returns:
        The calibration.

    Degenerate input: parallel boards leave focal length and principal point open, and few or small views parts of the
        distortion: `result` says `degenerate`, `unconstrained` names the parameters. A view without four corners in
        general position is left out (`used`).
    Differentiability: both modes, in corners, object points and `sigma_px`, by the implicit function theorem with the
        exact Hessian. Covariances and `sigma_px` are constants.

    Raises:
        ValueError: If shapes do not match, the board is not planar, a corner that counts is not finite or outside the
            image, or fewer than three views have four corners.

    References: Zhang, "A flexible new technique for camera calibration", PAMI 2000.

    Example:
        >>> from vojax.cameras import Pinhole
        >>> board = jnp.stack([*jnp.meshgrid(jnp.arange(4.0), jnp.arange(3.0)), jnp.zeros((3, 4))], -1).reshape(-1, 3)
        >>> turns = jnp.array([[0.3, 0.0, 0.0], [0.0, 0.3, 0.1], [-0.3, 0.2, 0.0], [0.2, 0.4, 0.3]])
        >>> poses = SE3.exp(jnp.concatenate([jnp.tile(jnp.array([[-1.5, -1.0, 6.0]]), (4, 1)), turns], axis=1))
        >>> truth = Pinhole(fx=500.0, fy=500.0, cx=320.0, cy=240.0)
        >>> corners = jax.vmap(lambda pose: truth.project(SE3(pose).apply(board)))(poses.wxyz_xyz)
        >>> found = calibrate(corners, board, (640, 480), model=Pinhole)
        >>> bool(abs(found.camera.fx - 500.0) < 0.1), bool(found.rms_px < 1e-2)
        (True, True)
    """
    corners, board = as_board(corners, object_points, ("v",))
    check_loss(loss)
    seen = as_mask(mask, corners)
    check_corners(corners, seen, image_size)
    template, given = template_of(model, corners.dtype)
    groups = free_parameters(template, free)
    enough_views(seen, 1 if not groups else MIN_VIEWS)
    sigma = as_sigma(sigma_px, seen.shape, corners.dtype)
    return _calibrate(
        template,
        given,
        corners,
        board,
        seen,
        sigma,
        sigma_px is not None,
        loss,
        groups,
        (image_size[0], image_size[1]),
        options,
    )


@eqx.filter_jit
def _calibrate(
    template: Any,
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
) -> Calibration:
    state, weight, used = start_state(template, given, corners, board, seen, image_size)
    data = BoardData(corners[None], board, weight[None], sigma[None], loss, groups)
    found = solve(state, data, used, sigma_given, image_size, options)
    return Calibration(
        camera=jax.tree.map(lambda leaf: leaf[0], found.state.cameras),
        cam_from_board=found.state.rig_from_board,
        residuals=found.residuals[0],
        used=used,
        rms_px=rms(found.residuals[0], weight, (0, 1)),
        view_rms_px=rms(found.residuals[0], weight, (1,)),
        sigma_px=found.sigma_px,
        covariance=found.covariance,
        pose_covariance=found.board_covariance,
        unconstrained=found.unconstrained,
        view_angle=found.view_angle,
        cost=found.cost,
        iterations=found.iterations,
        result=found.result,
        names=parameter_names(groups),
    )


def start_state(
    template: Any, given: bool, corners: Array, board: Array, seen: Array, image_size: tuple[int, int]
) -> tuple[BoardState, Float[Array, "v n"], Bool[Array, " v"]]:
    """Where to start with one camera, the weights of its corners, and the views that are used."""
    template, held, points = jax.lax.stop_gradient((template, corners, board))
    weight = seen.astype(corners.dtype)
    weight = weight * (jnp.sum(weight, axis=1, keepdims=True) >= MIN_CORNERS)
    camera, poses, valid = start_single(template, given, held, points, weight, image_size)
    weight = weight * valid[:, None]
    identity = SE3.identity((len(valid),), dtype=corners.dtype).wxyz_xyz
    poses = SE3(jnp.where(valid[:, None], poses.wxyz_xyz, identity))
    cameras = jax.tree.map(lambda leaf: leaf[None], camera)
    return BoardState(cameras, SE3.identity((1,), dtype=corners.dtype), poses), weight, valid


def as_board(corners: Any, object_points: Any, lead: tuple[str, ...]) -> tuple[Array, Array]:
    """Corners and board points `[n, 3]` of one floating dtype, checked."""
    corners, board = jnp.asarray(corners), jnp.asarray(object_points)
    shape = ", ".join((*lead, "n", "2"))
    if corners.ndim != len(lead) + 2 or corners.shape[-1] != 2:
        raise ValueError(f"corners have shape {corners.shape}: expected [{shape}], pixels of the n points in each view")
    if board.ndim != 2 or board.shape[1] not in (2, 3) or board.shape[0] != corners.shape[-2]:
        raise ValueError(
            f"object_points have shape {board.shape} for {corners.shape[-2]} corners in a view: expected one point [x, "
            "y, 0] for each"
        )
    dtype = jnp.result_type(corners, board)
    if not jnp.issubdtype(dtype, jnp.floating):
        dtype = jnp.result_type(float)
    corners, board = corners.astype(dtype), board.astype(dtype)
    if board.shape[1] == 2:
        board = jnp.concatenate([board, jnp.zeros_like(board[:, :1])], axis=1)
    if not isinstance(board, Tracer):
        points = np.asarray(board)
        if not np.isfinite(points).all():
            raise ValueError("object_points hold values that are not finite: expected metres or another unit of length")
        if np.abs(points[:, 2]).max(initial=0.0) > 1e-6 * np.abs(points).max(initial=0.0):
            raise ValueError("object_points leave the plane z = 0: expected a planar board, in its own frame")
    return corners, board


def as_mask(mask: Any, corners: Array) -> Array:
    """Which corners count."""
    seen = jnp.ones(corners.shape[:-1], bool) if mask is None else jnp.asarray(mask)
    if seen.shape != corners.shape[:-1] or seen.dtype != bool:
        raise ValueError(
            f"mask has shape {seen.shape} and dtype {seen.dtype}: expected booleans {corners.shape[:-1]}, one for each "
            "corner"
        )
    return seen


def as_sigma(sigma_px: Any, shape: tuple[int, ...], dtype: Any) -> Array:
    """Standard deviations of all corners."""
    sigma = jnp.asarray(1.0 if sigma_px is None else sigma_px, dtype)
    if sigma.shape not in ((), shape):
        raise ValueError(f"sigma_px has shape {sigma.shape}: expected one number, or one for each corner {shape}")
    if not isinstance(sigma, Tracer) and not bool(jnp.all(jnp.isfinite(sigma) & (sigma > 0))):
        raise ValueError("sigma_px is not positive and finite everywhere: expected pixels, 0.1 to 1 as a rule")
    return jnp.broadcast_to(sigma, shape)


def check_corners(corners: Array, seen: Array, image_size: Any) -> None:
    """Refuse corners that count and are no numbers, or lie far outside the image."""
    if len(image_size) != 2 or not all(float(side) >= 2 for side in image_size):
        raise ValueError(f"image_size is {image_size}: expected width and height in pixels")
    if isinstance(corners, Tracer) or isinstance(seen, Tracer):
        return
    counted = np.asarray(corners)[np.asarray(seen)]
    if not np.isfinite(counted).all():
        raise ValueError("corners that count are not finite: mask those that were not found")
    width, height = image_size
    inside = (counted >= -0.5 - 0.05 * width).all(1) & (counted <= np.array([1.05 * width, 1.05 * height])).all(1)
    if not inside.all():
        first = counted[~inside][0]
        raise ValueError(
            f"a corner at ({first[0]:.1f}, {first[1]:.1f}) lies outside an image of {width} x {height} pixels: check "
            "image_size (width, height) and the order (u, v) of the corners"
        )


def enough_views(seen: Array, least: int) -> None:
    """Refuse fewer views with corners than a calibration takes."""
    if isinstance(seen, Tracer):
        return
    views = int((np.asarray(seen).sum(axis=-1) >= MIN_CORNERS).sum())
    if views < least:
        raise ValueError(
            f"{views} views with at least {MIN_CORNERS} corners: expected {least} or more, with the board at different "
            "angles"
        )
