"""Motion of several stereo pairs that are fixed to one another: one pose for all of them, from all images at once.

What `_motion.py` does for one pair: points are triangulated in each pair at k−1, hypotheses come from generalised P3P
on all images at k, and the pose is refined on (u_left, v, u_right) of every pair, with each point's depth uncertainty
carried into its measurement.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, Bool, Float, Int
from vojax.ba import GemanMcClure, LMOptions, RigPoseProblem, refine_model, whiten, whitening
from vojax.cameras import RectifiedStereo, Rig
from vojax.lie import SE3
from vojax.robust import search_generalized_pose

from ._motion import Agreement, MotionOptions, StereoFeatures, TransferResiduals
from ._rectification import DisparityCalibration, corrected


class PairRig(eqx.Module):
    """Stereo pairs fixed to one another, stacked along a leading axis.

    Attributes:
        pairs: Rectified pairs, all numbers `[k]`.
        left_from_rig: Poses of their left cameras in the rig's frame `[k]`.
    """

    pairs: RectifiedStereo
    left_from_rig: SE3

    @property
    def size(self) -> int:
        """How many pairs."""
        return self.left_from_rig.wxyz_xyz.shape[0]

    def motions(self, rig1_from_rig0: SE3) -> SE3:
        """The same motion as each left camera makes it."""
        return self.left_from_rig @ (rig1_from_rig0 @ self.left_from_rig.inverse())

    def evidence(self, hessian: Float[Array, "k 8 8"], gradient: Float[Array, "k 8"]) -> tuple[Array, Array]:
        """Normal equations of the rig's pose and all disparity offsets, from those of each pair by its own pose."""
        total, right = jnp.zeros((6 + 2 * self.size,) * 2), jnp.zeros(6 + 2 * self.size)
        for k in range(self.size):
            adjoint = SE3(self.left_from_rig.wxyz_xyz[k]).adjoint()
            chart = jnp.zeros((8, 6 + 2 * self.size)).at[:6, :6].set(adjoint)
            chart = chart.at[6:, 6 + 2 * k : 8 + 2 * k].set(jnp.eye(2))
            total = total + jnp.matmul(jnp.matmul(chart.T, hessian[k], precision="highest"), chart, precision="highest")
            right = right + jnp.sum(chart * gradient[k][:, None], axis=0)
        return total, right

    def cameras(self) -> Rig:
        """All cameras: the left ones, then the right ones."""
        pairs = [jax.tree.map(lambda x, i=i: x[i], self.pairs) for i in range(self.size)]
        left = self.left_from_rig
        shift = jnp.stack([jnp.array([1.0, 0, 0, 0, 0, 0, 0]).at[4].set(-pair.baseline) for pair in pairs])
        poses = jnp.concatenate([left.wxyz_xyz, (SE3(shift) @ left).wxyz_xyz])
        return Rig(tuple(pair.camera for pair in pairs) * 2, SE3(poses))


class RigMotion(eqx.Module):
    """Motion of the rig from one frame to the next.

    Attributes:
        rig1_from_rig0: The pose; |t| in metres.
        covariance: Of its tangent in the rig's frame.
        inliers: Features that agree, of each pair.
        num_inliers: How many, of all pairs.
        num_usable: Features that could have agreed.
        calibration: Disparity errors of all pairs, with this frame's evidence.
    """

    rig1_from_rig0: SE3
    covariance: Float[Array, "6 6"]
    inliers: Bool[Array, "k n"]
    num_inliers: Int[Array, ""]
    num_usable: Int[Array, ""]
    calibration: DisparityCalibration


class RigTransferProblem(eqx.Module):
    """`rig1_from_rig0` against the measurements of all pairs in the second frame."""

    points_rig: Float[Array, "k n 3"]
    observed: Float[Array, "k n 3"]
    whitening: tuple[Array, ...]
    rig: PairRig
    tangent_dim: ClassVar[int] = 6

    @staticmethod
    def retract(model: SE3, tangent: Array) -> SE3:
        """exp(−ξ) @ rig1_from_rig0."""
        return RigPoseProblem.retract(model, tangent)

    def residual(self, model: SE3) -> tuple[Array, ...]:
        """Whitened errors of (u_left, v, u_right), pair after pair."""

        def pair(stereo: RectifiedStereo, left_from_rig: SE3, points: Array, observed: Array) -> Array:
            return stereo.project(left_from_rig.apply(model.apply(points))) - observed

        error = jax.vmap(pair)(self.rig.pairs, self.rig.left_from_rig, self.points_rig, self.observed)
        return whiten(self.whitening, tuple(error[..., i].reshape(-1) for i in range(3)))


@eqx.filter_jit
def rig_motion(
    features0: StereoFeatures,
    features1: StereoFeatures,
    quality: Float[Array, "k n"],
    guess: SE3,
    calibration: DisparityCalibration,
    rig: PairRig,
    key: Array,
    options: MotionOptions,
) -> RigMotion:
    """Estimate the motion between two frames of all pairs, whose features correspond row by row.

    Args:
        features0: Of the first frame, every field with a leading axis of pairs.
        features1: Of the second.
        quality: Of each correspondence, guides the sampling.
        guess: Motion of the frame before, kept where the search fails.
        calibration: Disparity errors known so far, of all pairs.
        rig: The pairs.
        key: Random key.
        options: Noise and thresholds.
    """
    offsets = calibration.estimate().reshape(rig.size, 2)
    offsets = offsets if options.self_calibrate else jnp.zeros_like(offsets)
    first = jax.vmap(corrected)(features0.measurements, offsets, rig.pairs)
    second = jax.vmap(corrected)(features1.measurements, offsets, rig.pairs)
    points_rig = jax.vmap(lambda pose, stereo, m: pose.inverse().apply(stereo.unproject(m)))(
        rig.left_from_rig, rig.pairs, first
    )
    disparity0 = first[..., 0] - first[..., 2]
    pair = features0.has_position & features1.has_position & features0.has_disparity
    usable = pair & (disparity0 > options.min_disparity_px)
    near = usable & (disparity0 > options.ransac_min_disparity_px)
    # A scene without near points still makes hypotheses from what there is.
    near = jnp.where(jnp.sum(near) >= 20, near, usable)

    k, n = usable.shape
    twice = jnp.stack([points_rig, points_rig]).reshape(-1, 3)
    rough, consensus = search_generalized_pose(
        twice,
        jnp.stack([second[..., :2], second[..., 2:0:-1]]).reshape(-1, 2),
        jnp.repeat(jnp.arange(2 * k), n),
        rig.cameras(),
        jnp.stack([near, near & features1.has_disparity]).reshape(-1),
        jnp.stack([quality, quality]).reshape(-1),
        key,
        options.ransac,
    )
    found = jnp.sum(jnp.any(consensus.inliers.reshape(2, -1), axis=0)) > 3
    pose = SE3(jnp.where(found, rough.wxyz_xyz, guess.wxyz_xyz))
    measurements = (first, second, features0, features1, rig.pairs)

    def residuals_of(one: tuple) -> TransferResiduals:
        first, second, features0, features1, stereo = one
        return TransferResiduals(first, second, features0, features1, options, stereo)

    def refine(pose: SE3, _: None) -> tuple[SE3, Array]:
        def measured(one: tuple, pose: SE3) -> tuple[Array, Array, Array]:
            residuals = residuals_of(one)
            in_front = pose.apply(residuals.stereo.unproject(residuals.first))[:, 2] > 0
            return residuals.observed(pose), residuals.covariances(pose)[0], in_front

        observed, covariances, in_front = jax.vmap(measured)(measurements, rig.motions(pose))
        factors = whitening(covariances.reshape(-1, 3, 3), (k * n,), 3, pose.wxyz_xyz.dtype)
        refined = refine_model(
            pose,
            RigTransferProblem(points_rig, observed, factors, rig),
            weight=(usable & in_front).reshape(-1).astype(pose.wxyz_xyz.dtype),
            loss=GemanMcClure(2.0),
            options=LMOptions(max_steps=10),
        )
        return refined.model, refined.covariance

    # The covariances depend on the pose a little: twice is enough.
    pose, all_covariances = jax.lax.scan(refine, pose, None, length=2)

    def conclude(one: tuple, pose: SE3, usable: Array) -> Agreement:
        return residuals_of(one).agreement(pose, usable & found)

    agreed = jax.vmap(conclude)(measurements, rig.motions(pose), usable)
    if options.self_calibrate:
        calibration = calibration.add(*rig.evidence(agreed.hessian, agreed.gradient), offsets.reshape(-1))
    return RigMotion(
        pose,
        all_covariances[-1],
        agreed.inliers,
        jnp.sum(agreed.inliers),
        jnp.sum(usable),
        calibration,
    )
