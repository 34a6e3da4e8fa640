"""Motion between two stereo frames: triangulate at k−1, solve the pose at k, weigh points by their depth's uncertainty.

A depth f b/d from a small disparity is uncertain and biased outwards. PnP that takes such points as exact inherits the
bias as scale. Here the point's covariance is carried into the measurement at k, Σ = Σ_k + J Σ_{k−1} Jᵀ, so that a far
point says much about rotation and little about distance (Matthies & Shafer 1987).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import symmetric_inverse
from vojax._types import Array, Bool, Float, Int
from vojax.ba import GemanMcClure, LMOptions, refine_absolute_pose
from vojax.cameras import RectifiedStereo
from vojax.lie import SE3
from vojax.robust import RansacOptions, search_absolute_pose

from ._rectification import DisparityCalibration, corrected, disparity_terms


@dataclasses.dataclass(frozen=True)
class MotionOptions:
    """Noise and thresholds of the motion between two frames.

    Attributes:
        sigma_track_px: Standard deviation of a tracked position.
        sigma_detect_px: Standard deviation of the position that a track starts the frame from.
        min_disparity_px: Points with less are not used.
        ransac_min_disparity_px: Points with less make no hypotheses.
        max_mahalanobis: Largest whitened residual of an inlier, standard deviations.
        self_calibrate: Estimate the disparity error that rectification left (`DisparityCalibration`).
        ransac: The search.
    """

    sigma_track_px: float = 0.25
    sigma_detect_px: float = 0.1
    min_disparity_px: float = 1.0
    ransac_min_disparity_px: float = 8.0
    max_mahalanobis: float = 4.0
    self_calibrate: bool = True
    ransac: RansacOptions = RansacOptions(threshold_px=2.0, max_hypotheses=1024, chunk_size=128)


class StereoFeatures(eqx.Module):
    """Padded stereo measurements of one frame.

    Attributes:
        measurements: (u_left, v, u_right), px; finite everywhere.
        sigma_disparity: Standard deviation of u_left − u_right, px.
        has_position: False for padding.
        has_disparity: True where the right image was matched.
    """

    measurements: Float[Array, "n 3"]
    sigma_disparity: Float[Array, " n"]
    has_position: Bool[Array, " n"]
    has_disparity: Bool[Array, " n"]


class Motion(eqx.Module):
    """Motion from one frame to the next.

    Attributes:
        cam1_from_cam0: The pose; |t| in metres.
        covariance: Of its camera-frame tangent.
        inliers: Features that agree.
        num_inliers: How many.
        depths: Of the features in the new frame, metres.
        predicted: Pixels of the features in the frame after, should the motion repeat itself.
        calibration: With this frame's evidence.
    """

    cam1_from_cam0: SE3
    covariance: Float[Array, "6 6"]
    inliers: Bool[Array, " n"]
    num_inliers: Int[Array, ""]
    depths: Float[Array, " n"]
    predicted: Float[Array, "n 2"]
    calibration: DisparityCalibration


# Matches the standard deviation of a disparity that was not measured: finite, and without influence.
_UNKNOWN_PX = 100.0


def measurement_covariance(
    sigma_position: float, sigma_disparity: Float[Array, "*batch"]
) -> Float[Array, "*batch 3 3"]:
    """Covariance of (u_left, v, u_right) where u_left, v and the disparity u_left − u_right are independent."""
    position = jnp.full_like(sigma_disparity, sigma_position**2)
    zero = jnp.zeros_like(position)
    rows = [[position, zero, position], [zero, position, zero], [position, zero, position + sigma_disparity**2]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


@eqx.filter_jit
def stereo_motion(
    features0: StereoFeatures,
    features1: StereoFeatures,
    quality: Float[Array, " n"],
    guess: SE3,
    calibration: DisparityCalibration,
    stereo: RectifiedStereo,
    key: Array,
    options: MotionOptions,
) -> Motion:
    """Estimate the motion between two frames whose features correspond row by row.

    Args:
        features0: Of the first frame.
        features1: Of the second; rows without a partner in the first have `features0.has_position` False.
        quality: Of each correspondence, guides the sampling.
        guess: Motion of the frame before, kept where the search fails.
        calibration: Disparity error known so far.
        stereo: The rig.
        key: Random key.
        options: Noise and thresholds.
    """
    offsets = calibration.estimate() if options.self_calibrate else jnp.zeros(2)
    raw0, raw1 = features0.measurements, features1.measurements
    first, second = corrected(raw0, offsets, stereo), corrected(raw1, offsets, stereo)
    disparity0 = first[:, 0] - first[:, 2]
    pair = features0.has_position & features1.has_position & features0.has_disparity
    usable = pair & (disparity0 > options.min_disparity_px)
    points0 = stereo.unproject(first)

    near = usable & (disparity0 > options.ransac_min_disparity_px)
    # A scene without near points still makes hypotheses from what there is.
    near = jnp.where(jnp.sum(near) >= 20, near, usable)
    rough, consensus = search_absolute_pose(points0, second[:, :2], stereo.camera, near, quality, key, options.ransac)
    found = jnp.sum(consensus.inliers) > 3
    pose = SE3(jnp.where(found, rough.wxyz_xyz, guess.wxyz_xyz))

    sigma1 = jnp.where(features1.has_disparity, features1.sigma_disparity, _UNKNOWN_PX)
    noise0 = measurement_covariance(options.sigma_detect_px, features0.sigma_disparity)
    noise1 = measurement_covariance(options.sigma_track_px, sigma1)

    def predict(pose: SE3, measurement: Float[Array, "3"]) -> Float[Array, "3"]:
        return stereo.project(pose.apply(stereo.unproject(measurement)))

    def observed(pose: SE3) -> Array:
        """Measurements at k; where the right image has no match, the prediction stands in for it."""
        expected = jax.vmap(lambda m: predict(pose, m))(first)
        disparity = expected[:, 0] - expected[:, 2]
        right = jnp.where(features1.has_disparity, second[:, 2], second[:, 0] - disparity)
        return jnp.stack([second[:, 0], second[:, 1], right], axis=1)

    def covariances(pose: SE3) -> tuple[Array, Array]:
        jacobian = jax.vmap(jax.jacfwd(lambda m: predict(pose, m)))(first)
        carried = jnp.sum(jacobian[:, :, :, None] * noise0[:, None], axis=2)
        carried = jnp.sum(carried[:, :, None, :] * jacobian[:, None, :, :], axis=3)
        return noise1 + carried, jacobian

    def refine(pose: SE3, _: None) -> tuple[SE3, Array]:
        in_front = pose.apply(points0)[:, 2] > 0
        refined = refine_absolute_pose(
            pose,
            points0,
            observed(pose),
            stereo,
            sigma_px=covariances(pose)[0],
            mask=usable & in_front,
            loss=GemanMcClure(2.0),
            options=LMOptions(max_steps=10),
        )
        return refined.model, refined.covariance

    # The covariances depend on the pose a little: twice is enough.
    pose, all_covariances = jax.lax.scan(refine, pose, None, length=2)

    covariance, carried = covariances(pose)
    information = jnp.moveaxis(symmetric_inverse(jnp.moveaxis(covariance, 0, -1))[0], -1, 0)
    residual = jax.vmap(lambda m: predict(pose, m))(first) - observed(pose)
    squared = jnp.sum(jnp.sum(information * residual[:, None, :], axis=2) * residual, axis=1)
    points1 = pose.apply(points0)
    inliers = usable & found & (squared < options.max_mahalanobis**2) & (points1[:, 2] > 0)

    updated = calibration
    if options.self_calibrate:
        weight = jnp.where(inliers, GemanMcClure(2.0).weight(squared), 0.0)
        projection = jax.vmap(jax.jacfwd(stereo.project))(points1)  # [n, 3, 3]
        by_rotation = jnp.cross(projection, points1[:, None, :])
        terms0 = jnp.stack(disparity_terms(first[:, 0], stereo), axis=1)
        terms1 = jnp.stack(disparity_terms(second[:, 0], stereo), axis=1)
        # Offsets move u_right: down in the first frame, and where there is a match in the second.
        by_offsets = -carried[:, :, 2, None] * terms0[:, None, :]
        measured = features1.has_disparity.astype(first.dtype)[:, None] * terms1
        by_offsets = by_offsets.at[:, 2].add(measured)
        jacobian = jnp.concatenate([-projection, by_rotation, by_offsets], axis=2)  # [n, 3, 8]
        weighted = weight[:, None, None] * jnp.sum(information[:, :, :, None] * jacobian[:, None], axis=2)
        jacobian, weighted = jacobian.reshape(-1, 8), weighted.reshape(-1, 8)
        hessian = jnp.matmul(jacobian.T, weighted, precision="highest")
        gradient = jnp.sum(weighted * residual.reshape(-1, 1), axis=0)
        updated = calibration.add(hessian, gradient, offsets)

    points = stereo.unproject(second)
    depths = jnp.where(features1.has_disparity, points[:, 2], points1[:, 2])
    return Motion(
        pose,
        all_covariances[-1],
        inliers,
        jnp.sum(inliers),
        depths,
        jnp.where(
            (features1.has_disparity & (points[:, 2] > 0))[:, None],
            stereo.camera.project(pose.apply(points)),
            second[:, :2],
        ),
        updated,
    )
