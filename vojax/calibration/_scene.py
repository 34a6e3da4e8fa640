"""Calibration of a camera from one image of points whose places in the world are known."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._result import Result
from vojax._types import Array, ArrayLike, Bool, Float, Int
from vojax.ba import LMOptions, Loss, Squared
from vojax.ba._board_residual import BoardData, BoardState
from vojax.cameras import Camera, Pinhole
from vojax.lie import SE3
from vojax.solvers import dlt_pnp

from ._calibrate import CALIBRATION_OPTIONS, as_mask, as_sigma
from ._models import free_parameters, parameter_names, start_of_class, template_of
from ._statistics import check_loss, rms, solve


class SceneCalibration(eqx.Module):
    """A camera calibrated by a known scene.

    Attributes:
        camera: The camera, free parameters estimated.
        cam_from_world: Its pose.
        residuals: Reprojected minus measured, in pixels; zero for points that do not count.
        rms_px: Root mean square distance.
        sigma_px: Standard deviation of a pixel coordinate, estimated (or as given).
        covariance: Of the free parameters, in the order of `names`.
        pose_covariance: Of the tangent ξ of exp(−ξ) @ cam_from_world.
        iterations: Evaluations of the residuals.
        result: How it ended; `degenerate` for a scene that does not determine camera and pose.
        names: Of the free parameters.
    """

    camera: Any
    cam_from_world: SE3
    residuals: Float[Array, "n 2"]
    rms_px: Float[Array, ""]
    sigma_px: Float[Array, ""]
    covariance: Float[Array, "k k"]
    pose_covariance: Float[Array, "6 6"]
    iterations: Int[Array, ""]
    result: Result
    names: tuple[str, ...] = eqx.field(static=True)

    def standard_deviations(self) -> Float[Array, " k"]:
        """Of the free parameters, in the order of `names`."""
        return jnp.sqrt(jnp.diagonal(self.covariance))


def calibrate_from_scene(
    points_world: Float[ArrayLike, "n 3"],
    pixels: Float[ArrayLike, "n 2"],
    *,
    model: Any = Pinhole,
    mask: Bool[ArrayLike, " n"] | None = None,
    free: Any = None,
    sigma_px: Float[ArrayLike, "..."] | float | None = None,
    loss: Loss = Squared(),
    options: LMOptions = CALIBRATION_OPTIONS,
) -> SceneCalibration:
    """Estimate focal lengths, principal point and pose from one image of a known scene.

    A projection matrix by the direct linear transform, taken apart by RQ decomposition, is where Levenberg–Marquardt
    on the reprojection error starts.

    Args:
        points_world: Points of the scene, at least six, not in one plane.
        pixels: Their images.
        model: Camera class to fit. The start has no distortion; give lenses of little distortion only.
        mask: True for points that count. None: all.
        free: Names of the parameters to estimate, as in `calibrate`.
        sigma_px: Standard deviation of a pixel coordinate, one or `[n]`. None: estimated from the residuals.
        loss: Robust loss of the squared residual of a point.
        options: Of the optimiser.

    Returns:
        The calibration.

    Degenerate input: coplanar points, points on a twisted cubic with the camera and fewer than six that count give the
        result `degenerate` and zero covariances.

    Differentiability: both modes, in points, pixels and `sigma_px`, by the implicit function theorem with the exact
        Hessian. Covariances and `sigma_px` are constants.

    Raises:
        ValueError: For fewer than six points and shapes that do not match.

    References: Hartley & Zisserman, chapter 7.

    Example:
        >>> points = jnp.array([[0.0, 0, 4], [1, 0, 5], [0, 1, 6], [1, 1, 4], [-1, 0, 7], [0, -1, 5], [-1, 1, 5]])
        >>> found = calibrate_from_scene(points, 400.0 * points[:, :2] / points[:, 2:] + 300.0)
        >>> bool(abs(found.camera.fx - 400.0) < 0.1), bool(abs(found.camera.cx - 300.0) < 0.1)
        (True, True)
    """
    points, pixels = jnp.asarray(points_world), jnp.asarray(pixels)
    if points.ndim != 2 or points.shape[1] != 3 or pixels.shape != (points.shape[0], 2):
        raise ValueError(f"found points {points.shape} and pixels {pixels.shape}; expected [n, 3] and [n, 2]")
    if points.shape[0] < 6:
        raise ValueError(f"found {points.shape[0]} points; expected at least 6, not in one plane")
    check_loss(loss)
    dtype = jnp.result_type(points, pixels, jnp.float32)
    points, pixels = points.astype(dtype), pixels.astype(dtype)
    seen = as_mask(mask, pixels)
    template, _ = template_of(model if isinstance(model, type) else type(model), dtype)
    groups = free_parameters(template, free)
    sigma = as_sigma(sigma_px, seen.shape, dtype)
    return _calibrate_from_scene(template, points, pixels, seen, sigma, sigma_px is not None, loss, groups, options)


@eqx.filter_jit
def _calibrate_from_scene(
    template: Camera, points: Array, pixels: Array, seen: Array, sigma: Array, sigma_given: bool, loss: Loss,
    groups: Any, options: LMOptions,
) -> SceneCalibration:  # fmt: skip
    weight = seen.astype(pixels.dtype)
    held, images = jax.lax.stop_gradient((points, jnp.where(seen[:, None], pixels, 0.0)))
    linear = dlt_pnp(held, images, weight)
    valid = linear.valid[0]
    k = jnp.where(valid, linear.models.calibration[0], jnp.eye(3, dtype=pixels.dtype))
    camera = start_of_class(type(template), jnp.stack([k[0, 0], k[1, 1], k[0, 2], k[1, 2]]))
    start = BoardState(
        jax.tree.map(lambda leaf: leaf[None], camera),
        SE3.identity((1,), dtype=pixels.dtype),
        SE3(linear.models.cam_from_world.wxyz_xyz),
    )
    data = BoardData(pixels[None, None], points, (weight * valid)[None, None], sigma[None, None], loss, groups)
    found = solve(start, data, valid[None], sigma_given, (1, 1), options, several=False)
    return SceneCalibration(
        camera=jax.tree.map(lambda leaf: leaf[0], found.state.cameras),
        cam_from_world=SE3(found.state.rig_from_board.wxyz_xyz[0]),
        residuals=found.residuals[0, 0],
        rms_px=rms(found.residuals[0, 0], data.weight[0, 0], (0,)),
        sigma_px=found.sigma_px,
        covariance=found.covariance,
        pose_covariance=found.board_covariance[0],
        iterations=found.iterations,
        result=Result.where(valid, found.result, Result.degenerate),
        names=parameter_names(groups),
    )
