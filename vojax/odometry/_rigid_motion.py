"""Motion between two stereo frames that are each triangulated: rigid alignment of 3-D points, "3-D-to-3-D".

Scaramuzza & Fraundorfer 2011, algorithm 2, with the noise that it needs (Matthies & Shafer 1987): a point's covariance
is that of (u_left, v, disparity) carried into space, a hundred times longer along the ray than across. Two biases of
triangulation are dealt with. A depth f b/d is too large on average by its relative variance: that is taken out. And a
covariance taken at the measured disparity says that points which noise moved nearer are the more certain ones: it is
taken where both measurements together put the point.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import propagated, symmetric_inverse
from vojax._types import Array, Float
from vojax.ba import GemanMcClure
from vojax.cameras import RectifiedStereo
from vojax.lie import SE3
from vojax.robust import search_rigid, weighted_alignment, weighted_covariances
from vojax.solvers import alignment_covariance

from ._motion import Motion, RigidMotionOptions, StereoFeatures, TransferResiduals
from ._rectification import DisparityCalibration, corrected

# Rounds of reweighting, and Gauss–Newton steps in each: at the search's answer the next round changes the pose by less
# than a thousandth of its standard deviation.
_ROUNDS = 4
_STEPS = 4
# Largest ratio of a covariance's axes: its square is a tenth of what float32 inverts.
_MAX_ELONGATION = 150.0


@eqx.filter_jit
def rigid_motion(
    features0: StereoFeatures,
    features1: StereoFeatures,
    quality: Float[Array, " n"],
    guess: SE3,
    calibration: DisparityCalibration,
    stereo: RectifiedStereo,
    key: Array,
    options: RigidMotionOptions,
) -> Motion:
    """Estimate the motion between two frames whose features correspond row by row and have disparities in both.

    Args:
        features0: Of the first frame.
        features1: Of the second.
        quality: Of each correspondence, guides the sampling.
        guess: Motion of the frame before, kept where the search fails.
        calibration: Disparity error known so far.
        stereo: The rig.
        key: Random key.
        options: Noise and thresholds.
    """
    offsets = calibration.estimate() if options.self_calibrate else jnp.zeros(2)
    first = corrected(features0.measurements, offsets, stereo)
    second = corrected(features1.measurements, offsets, stereo)
    residuals = TransferResiduals(first, second, features0, features1, options, stereo)
    noise0, noise1 = residuals.noise()
    points0, error0 = unbiased_points(first, noise0, stereo)
    points1, error1 = unbiased_points(second, noise1, stereo)
    usable = features0.has_position & features1.has_position & features0.has_disparity & features1.has_disparity
    error = jnp.maximum(error0, error1)
    usable = usable & (error < options.max_depth_error)
    # Padding has no disparity and would stand at the horizon.
    points0, points1 = (jnp.where(usable[:, None], points, 0.0) for points in (points0, points1))
    first, second = (jnp.where(usable[:, None], m, jnp.array([0.0, 0.0, -1.0])[None]) for m in (first, second))

    near = usable & (error < options.search_depth_error)
    # A scene without near points still makes hypotheses from what there is.
    near = jnp.where(jnp.sum(near) >= 20, near, usable)
    rough, consensus = search_rigid(
        points0,
        points1,
        point_covariances(first, noise0, stereo),
        point_covariances(second, noise1, stereo),
        near,
        quality,
        key,
        options.ransac,
        max_mahalanobis=options.max_mahalanobis,
    )
    found = jnp.sum(consensus.inliers) > 3
    pose = SE3(jnp.where(found, rough.wxyz_xyz, guess.wxyz_xyz))

    def covariances(pose: SE3) -> tuple[Array, Array]:
        """Of the points, where both measurements together put them."""
        predicted = stereo.project(pose.apply(stereo.unproject(first)))
        total, _ = residuals.covariances(pose)
        information = jnp.moveaxis(symmetric_inverse(jnp.moveaxis(total, 0, -1))[0], -1, 0)
        pull = jnp.sum(information * (predicted - second)[:, None, :], axis=2)
        both1 = second + jnp.sum(noise1 * pull[:, None, :], axis=2)
        both0 = stereo.project(pose.inverse().apply(stereo.unproject(both1)))
        return point_covariances(both0, noise0, stereo), point_covariances(both1, noise1, stereo)

    def weights_at(pose: SE3, covariances0: Array, covariances1: Array) -> Float[Array, " n"]:
        squared = mahalanobis(pose, points0, points1, covariances0, covariances1)
        return jnp.where(usable, GemanMcClure(2.0).weight(squared), 0.0)

    def refine(pose: SE3, _: None) -> tuple[SE3, None]:
        noise = covariances(pose)
        fitted, valid = weighted_alignment(points0, points1, *noise, weights_at(pose, *noise), _STEPS)
        return SE3(jnp.where(valid & found, fitted.wxyz_xyz, pose.wxyz_xyz)), None

    pose, _ = jax.lax.scan(refine, pose, None, length=_ROUNDS)
    noise = covariances(pose)
    covariance = alignment_covariance(pose, points0, points1, *weighted_covariances(*noise, weights_at(pose, *noise)))
    return residuals.conclude(pose, covariance, usable, found, calibration, offsets)


def unbiased_points(
    measurements: Float[Array, "n 3"], noise: Float[Array, "n 3 3"], stereo: RectifiedStereo
) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
    """Triangulate without the bias of f b/d, whose mean is (1 + σ²/d²) f b/d_true to second order.

    Args:
        measurements: (u_left, v, u_right).
        noise: Their covariances.
        stereo: The rig.

    Returns:
        Points, and σ/d of each: the relative error of its depth.
    """
    disparity = jnp.maximum(measurements[:, 0] - measurements[:, 2], 1e-3)
    variance = noise[:, 0, 0] + noise[:, 2, 2] - 2.0 * noise[:, 0, 2]
    relative = variance / (disparity * disparity)
    points = stereo.unproject(measurements)
    return points * (1.0 - jnp.minimum(relative, 0.5))[:, None], jnp.sqrt(relative)


def point_covariances(
    measurements: Float[Array, "n 3"], noise: Float[Array, "n 3 3"], stereo: RectifiedStereo
) -> Float[Array, "n 3 3"]:
    """Covariances of triangulated points to first order, J Σ Jᵀ."""
    jacobian = jax.vmap(jax.jacfwd(stereo.unproject))(measurements)
    covariance = propagated(jacobian, noise)
    # Longer than float32 can invert is cut: across the ray a point is not more certain than a part of its depth.
    across = covariance[:, 2, 2] / _MAX_ELONGATION**2
    return covariance + across[:, None, None] * jnp.eye(3, dtype=covariance.dtype)[None]


def mahalanobis(
    pose: SE3,
    points0: Float[Array, "n 3"],
    points1: Float[Array, "n 3"],
    covariances0: Float[Array, "n 3 3"],
    covariances1: Float[Array, "n 3 3"],
) -> Float[Array, " n"]:
    """Squared distances of aligned points, eᵀ (C₁ + R C₀ Rᵀ)⁻¹ e."""
    turned = propagated(pose.rotation().as_matrix(), covariances0)
    information = symmetric_inverse(jnp.moveaxis(covariances1 + turned, 0, -1))[0]
    e = jnp.moveaxis(points1 - pose.apply(points0), 1, 0)
    return jnp.sum(jnp.sum(information * e[None], axis=1) * e, axis=0)
