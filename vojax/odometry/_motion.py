"""Motion between two stereo frames: triangulate at k−1, solve the pose at k, weigh points by their depth's uncertainty.

A depth f b/d from a small disparity is uncertain and biased outwards. PnP that takes such points as exact inherits the
bias as scale. Here the point's covariance is carried into the measurement at k, Σ = Σ_k + J Σ_{k−1} Jᵀ, so that a far
point says much about rotation and little about distance (Matthies & Shafer 1987).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import propagated, symmetric_inverse
from vojax._types import Array, Bool, Float, Int
from vojax.ba import GemanMcClure, LMOptions, refine_absolute_pose
from vojax.cameras import RectifiedStereo, Rig
from vojax.lie import SE3, SO3
from vojax.robust import RansacOptions, search_generalized_pose

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


@dataclasses.dataclass(frozen=True)
class RigidMotionOptions:
    """Noise and thresholds of the motion between two frames, each triangulated by itself.

    Attributes:
        sigma_track_px: Standard deviation of a tracked position.
        sigma_detect_px: Standard deviation of the position that a track starts the frame from.
        max_depth_error: Largest relative standard deviation of a depth, σ_d/d. At a tenth the next term of its
            expansion is a tenth of the first: the noise still counts as Gaussian, its bias of a hundredth is taken out.
        search_depth_error: The same for points that make hypotheses.
        max_mahalanobis: Largest whitened residual of an inlier, standard deviations.
        self_calibrate: Estimate the disparity error that rectification left (`DisparityCalibration`).
        ransac: The search; its thresholds are not read.
    """

    sigma_track_px: float = 0.25
    sigma_detect_px: float = 0.1
    max_depth_error: float = 0.1
    search_depth_error: float = 0.02
    max_mahalanobis: float = 4.0
    self_calibrate: bool = True
    ransac: RansacOptions = RansacOptions(max_hypotheses=2048, chunk_size=512)


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
        num_usable: Features that could have agreed.
        depths: Of the features in the new frame, metres.
        calibration: With this frame's evidence.
    """

    cam1_from_cam0: SE3
    covariance: Float[Array, "6 6"]
    inliers: Bool[Array, " n"]
    num_inliers: Int[Array, ""]
    num_usable: Int[Array, ""]
    depths: Float[Array, " n"]
    calibration: DisparityCalibration


# Standard deviation of a disparity that was not measured: finite, and without influence.
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
    seen = jnp.stack([near, near & features1.has_disparity])
    rough, agreeing = _search_in_both_images(points0, second, seen, quality, stereo, key, options.ransac)
    found = jnp.sum(agreeing) > 3
    pose = SE3(jnp.where(found, rough.wxyz_xyz, guess.wxyz_xyz))

    residuals = TransferResiduals(first, second, features0, features1, options, stereo)

    def refine(pose: SE3, _: None) -> tuple[SE3, Array]:
        in_front = pose.apply(points0)[:, 2] > 0
        refined = refine_absolute_pose(
            pose,
            points0,
            residuals.observed(pose),
            stereo,
            sigma_px=residuals.covariances(pose)[0],
            mask=usable & in_front,
            loss=GemanMcClure(2.0),
            options=LMOptions(max_steps=10),
        )
        return refined.model, refined.covariance

    # The covariances depend on the pose a little: twice is enough.
    pose, all_covariances = jax.lax.scan(refine, pose, None, length=2)
    return residuals.conclude(pose, all_covariances[-1], usable, found, calibration, offsets)


def _search_in_both_images(
    points0: Float[Array, "n 3"],
    second: Float[Array, "n 3"],
    seen: Bool[Array, "2 n"],
    quality: Float[Array, " n"],
    stereo: RectifiedStereo,
    key: Array,
    options: RansacOptions,
) -> tuple[SE3, Bool[Array, " n"]]:
    """Generalised P3P on the left and the right image of the second frame; the points that agree in one of them."""
    zero = jnp.zeros_like(stereo.baseline)
    centers = jnp.stack([jnp.stack([zero, zero, zero]), jnp.stack([-stereo.baseline, zero, zero])])
    rig = Rig((stereo.camera, stereo.camera), SE3.from_rotation_and_translation(SO3.identity((2,)), centers))
    n = len(points0)
    rough, consensus = search_generalized_pose(
        jnp.concatenate([points0, points0]),
        jnp.concatenate([second[:, :2], second[:, 2:0:-1]]),
        jnp.repeat(jnp.arange(2), n),
        rig,
        seen.reshape(-1),
        jnp.concatenate([quality, quality]),
        key,
        options,
    )
    return rough, jnp.any(consensus.inliers.reshape(2, n), axis=0)


class TransferResiduals(eqx.Module):
    """Measurements of one frame carried into the next, against what was measured there.

    Attributes:
        first: Of the first frame, the disparity error taken out.
        second: Of the second.
        features0: Their noise, and which there are.
        features1: The same of the second.
        options: Noise and thresholds.
        stereo: The rig.
    """

    first: Float[Array, "n 3"]
    second: Float[Array, "n 3"]
    features0: StereoFeatures
    features1: StereoFeatures
    options: MotionOptions | RigidMotionOptions = eqx.field(static=True)
    stereo: RectifiedStereo

    def noise(self) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3 3"]]:
        """Covariances of the measurements of both frames."""
        sigma1 = jnp.where(self.features1.has_disparity, self.features1.sigma_disparity, _UNKNOWN_PX)
        return (
            measurement_covariance(self.options.sigma_detect_px, self.features0.sigma_disparity),
            measurement_covariance(self.options.sigma_track_px, sigma1),
        )

    def predict(self, pose: SE3, measurement: Float[Array, "3"]) -> Float[Array, "3"]:
        """Carry one measurement into the second frame."""
        return self.stereo.project(pose.apply(self.stereo.unproject(measurement)))

    def observed(self, pose: SE3) -> Float[Array, "n 3"]:
        """Measurements at k; where the right image has no match, the prediction stands in for it."""
        expected = jax.vmap(lambda m: self.predict(pose, m))(self.first)
        disparity = expected[:, 0] - expected[:, 2]
        right = jnp.where(self.features1.has_disparity, self.second[:, 2], self.second[:, 0] - disparity)
        return jnp.stack([self.second[:, 0], self.second[:, 1], right], axis=1)

    def covariances(self, pose: SE3) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3 3"]]:
        """Of the residuals, Σ_k + J Σ_{k−1} Jᵀ; and J."""
        noise0, noise1 = self.noise()
        jacobian = jax.vmap(jax.jacfwd(lambda m: self.predict(pose, m)))(self.first)
        return noise1 + propagated(jacobian, noise0), jacobian

    def agreement(self, pose: SE3, usable: Bool[Array, " n"]) -> "Agreement":
        """Tell inliers from outliers at the final pose, and what they say of the disparity error.

        Args:
            pose: `cam1_from_cam0`.
            usable: Features that can agree.
        """
        stereo, first, second = self.stereo, self.first, self.second
        matched = self.features1.has_disparity
        covariance, carried = self.covariances(pose)
        information = jnp.moveaxis(symmetric_inverse(jnp.moveaxis(covariance, 0, -1))[0], -1, 0)
        residual = jax.vmap(lambda m: self.predict(pose, m))(first) - self.observed(pose)
        squared = jnp.sum(jnp.sum(information * residual[:, None, :], axis=2) * residual, axis=1)
        points1 = pose.apply(stereo.unproject(first))
        inliers = usable & (squared < self.options.max_mahalanobis**2) & (points1[:, 2] > 0)

        weight = jnp.where(inliers, GemanMcClure(2.0).weight(squared), 0.0)
        projection = jax.vmap(jax.jacfwd(stereo.project))(points1)  # [n, 3, 3]
        by_rotation = jnp.cross(projection, points1[:, None, :])
        terms0 = jnp.stack(disparity_terms(first[:, 0], stereo), axis=1)
        terms1 = jnp.stack(disparity_terms(second[:, 0], stereo), axis=1)
        # Offsets move u_right: down in the first frame, and where there is a match in the second.
        by_offsets = -carried[:, :, 2, None] * terms0[:, None, :]
        by_offsets = by_offsets.at[:, 2].add(matched.astype(first.dtype)[:, None] * terms1)
        jacobian = jnp.concatenate([-projection, by_rotation, by_offsets], axis=2)  # [n, 3, 8]
        weighted = weight[:, None, None] * jnp.sum(information[:, :, :, None] * jacobian[:, None], axis=2)
        jacobian, weighted = jacobian.reshape(-1, 8), weighted.reshape(-1, 8)
        hessian = jnp.matmul(jacobian.T, weighted, precision="highest")
        gradient = jnp.sum(weighted * residual.reshape(-1, 1), axis=0)
        depths = jnp.where(matched, stereo.unproject(second)[:, 2], points1[:, 2])
        return Agreement(inliers, depths, hessian, gradient)

    def conclude(
        self,
        pose: SE3,
        pose_covariance: Float[Array, "6 6"],
        usable: Bool[Array, " n"],
        found: Bool[Array, ""],
        calibration: DisparityCalibration,
        offsets: Float[Array, "2"],
    ) -> Motion:
        """The motion with its inliers, and what they add to the calibration.

        Args:
            pose: `cam1_from_cam0`.
            pose_covariance: Its covariance.
            usable: Features that can agree.
            found: False where the search failed.
            calibration: Disparity error known so far.
            offsets: What has been taken out of the measurements.
        """
        agreed = self.agreement(pose, usable & found)
        if self.options.self_calibrate:
            calibration = calibration.add(agreed.hessian, agreed.gradient, offsets)
        count, num_usable = jnp.sum(agreed.inliers), jnp.sum(usable)
        return Motion(pose, pose_covariance, agreed.inliers, count, num_usable, agreed.depths, calibration)


class Agreement(eqx.Module):
    """What the features of a pair say at the final pose.

    Attributes:
        inliers: Features that agree.
        depths: Of the features in the new frame, metres.
        hessian: Gauss–Newton matrix by the pose (first six) and the disparity offsets.
        gradient: Its right-hand side Jᵀr.
    """

    inliers: Bool[Array, " n"]
    depths: Float[Array, " n"]
    hessian: Float[Array, "8 8"]
    gradient: Float[Array, "8"]


@eqx.filter_jit
def predicted_pixels(features: StereoFeatures, cam1_from_cam0: SE3, stereo: RectifiedStereo) -> Float[Array, "n 2"]:
    """Where a motion would put the features; those without a disparity stay where they are.

    Args:
        features: Of the first frame.
        cam1_from_cam0: The motion expected.
        stereo: The rig.
    """
    points = cam1_from_cam0.apply(stereo.unproject(features.measurements))
    known = features.has_disparity & (points[:, 2] > 0)
    points = jnp.where(known[:, None], points, jnp.array([0.0, 0.0, 1.0])[None])
    return jnp.where(known[:, None], stereo.camera.project(points), features.measurements[:, :2])
