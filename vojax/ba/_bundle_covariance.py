"""Covariances of an adjusted bundle from its reduced system."""

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float, Int
from vojax.lie import SE3

from . import _bundle_schur as schur
from ._bundle_layout import BundleLayout
from ._bundle_problem import BundleProblem
from ._bundle_residual import linearize
from ._bundle_state import landmark_basis
from ._losses import Loss, Squared


class BundleCovariance(eqx.Module):
    """Covariances at a point of a problem, in its gauge; made by `bundle_covariance`.

    Attributes:
        regular: False if a direction has no information, a free gauge for one: all covariances are zero then.
        basis: The directions that homogeneous landmarks move along; None for Euclidean ones.
    """

    inverse: Float[Array, "u u"]
    eliminated: schur.Eliminated
    layout: BundleLayout
    landmark_slot: Int[Array, " p"]
    cam_from_world: SE3
    regular: Bool[Array, ""]
    basis: Float[Array, "4 3 l"] | None = None

    def cameras(self, i: Int[ArrayLike, ""] | int, j: Int[ArrayLike, ""] | int | None = None) -> Float[Array, "k k"]:
        """Covariance of camera `i`, or the block between `i` and `j`.

        Returns:
            Of the tangent (ρ, φ) in the camera's frame, then of its free intrinsics; zero for what is fixed. With rigs,
            of the tangent of the rig's pose.
        """
        columns = self.layout.columns if self.layout.mount is None else self.layout.pose_columns
        return self._between(columns[i], columns[i if j is None else j])

    def extrinsics(self, i: Int[ArrayLike, ""] | int, j: Int[ArrayLike, ""] | int | None = None) -> Float[Array, "6 6"]:
        """Covariance of `cam_from_rig` of camera `i` of the rig, or the block between `i` and `j`."""
        columns = self.layout.pose_columns[self.layout.frames :]
        return self._between(columns[i], columns[i if j is None else j])

    def intrinsics(self, group: Int[ArrayLike, ""] | int = 0) -> Float[Array, "m m"]:
        """Covariance of a group's free intrinsics."""
        columns = self.layout.group_columns[group]
        return self._between(columns, columns)

    def landmark(self, j: Int[ArrayLike, ""] | int) -> Float[Array, "h h"]:
        """Covariance of a landmark in the world frame; zero for one that is fixed or unseen.

        Of a homogeneous one that of its four coordinates, of rank three.
        """
        slot = self.landmark_slot[j]
        known = (slot < self.layout.landmark_order.shape[0]) & self.regular
        (l10, l20, l21), pivots = self.eliminated.lower, jnp.stack(self.eliminated.pivots)
        zero = jnp.zeros_like(l10)
        lower = jnp.stack([jnp.stack([zero, zero, zero]), jnp.stack([l10, zero, zero]), jnp.stack([l20, l21, zero])])
        strict = lower[:, :, slot]
        p0, p1, p2 = pivots[:, slot]
        # Columns of L⁻¹ by forward substitution.
        root = jnp.stack([jnp.stack(self._forward(strict, (p0, p1, p2), e)) for e in jnp.eye(3, dtype=p0.dtype)], 1)
        # V⁻¹ + V⁻¹ Wᵀ S⁻¹ W V⁻¹, with E = W L⁻ᵀ of the landmark's own observations.
        of_slot = self.layout.spread(jnp.arange(self.layout.landmark_order.shape[0]))
        mine = self.eliminated.cross * (of_slot == slot)[None, None]
        by_camera = jnp.stack([self.layout.collapse(self.layout.sum_cameras(rows.T)) for rows in mine])
        inner = jnp.eye(3, dtype=p0.dtype) + by_camera @ self.inverse @ by_camera.T
        covariance = jnp.where(known, root.T @ inner @ root, 0.0)
        if self.basis is None:
            return covariance
        basis = self.basis[:, :, jnp.minimum(slot, self.basis.shape[2] - 1)]
        return basis @ covariance @ basis.T

    @staticmethod
    def _forward(strict: Array, pivots: tuple[Array, Array, Array], e: Array) -> list[Array]:
        x = e[0] * pivots[0]
        y = (e[1] - strict[1, 0] * x) * pivots[1]
        return [x, y, (e[2] - strict[2, 0] * x - strict[2, 1] * y) * pivots[2]]

    def relative_pose(self, i: Int[ArrayLike, ""] | int, j: Int[ArrayLike, ""] | int) -> Float[Array, "6 6"]:
        """Covariance of `cam_i_from_cam_j @ exp(ξ)`, the pose of camera `j` in the frame of camera `i`."""
        # Both perturbed in their frames: cam_i_from_cam_j becomes exp(−ξᵢ) cam_i_from_cam_j exp(ξⱼ).
        pose = lambda index: SE3(self.cam_from_world.wxyz_xyz[index])  # noqa: E731
        j_from_i = pose(j) @ pose(i).inverse()
        jacobian = jnp.concatenate([-j_from_i.adjoint(), jnp.eye(6, dtype=self.inverse.dtype)], axis=1)
        columns = jnp.concatenate([self.layout.pose_columns[i], self.layout.pose_columns[j]])
        return jacobian @ self._between(columns, columns) @ jacobian.T

    def _between(self, rows: Array, columns: Array) -> Array:
        if not self.layout.unknowns:
            return jnp.zeros((rows.shape[0], columns.shape[0]), self.inverse.dtype)
        block = self.inverse.at[rows].get(mode="fill", fill_value=0)
        return block.at[:, columns].get(mode="fill", fill_value=0)


def bundle_covariance(
    problem: BundleProblem,
    cam_from_world: SE3,
    landmarks: Float[ArrayLike, "p h"],
    camera: object,
    loss: Loss = Squared(),
    cam_from_rig: SE3 | None = None,
) -> BundleCovariance:
    """Covariances by the Gauss–Newton matrix, under the problem's `sigma_px`.

    Args:
        problem: As adjusted; its gauge is where covariances are zero. With a free gauge there are none.
        cam_from_world: The adjusted poses.
        landmarks: The adjusted landmarks.
        camera: The adjusted camera.
        loss: As in the adjustment.
        cam_from_rig: The adjusted poses of the cameras in the rig. None: the problem's.

    Returns:
        An object that gives any block; the reduced system is inverted once.

    Degenerate input: a landmark's direction without information, such as the depth of one seen once, counts as known
        where it is, as in the elimination.
    Differentiability: both modes, except at degenerate points.

    Raises:
        ValueError: The problem was made for conjugate gradients.
    """
    from ._bundle import slot_data, start_state

    at = eqx.tree_at(
        lambda problem: (problem.cam_from_world, problem.landmarks, problem.camera),
        problem,
        (cam_from_world, jnp.asarray(landmarks), camera),
    )
    if cam_from_rig is not None:
        at = eqx.tree_at(lambda problem: problem.cam_from_rig, at, cam_from_rig)
    layout, data, state = at.layout, slot_data(at), start_state(at)
    if not layout.has_pairs:
        raise ValueError("covariances need the reduced system: make the problem with solver='dense'")
    system = schur.normal_equations(linearize(state, data, loss, layout), data, layout)
    eliminated = schur.eliminate(system, layout)
    reduced = schur.factor(eliminated, layout)
    identity = jnp.eye(layout.unknowns, dtype=reduced.scale.dtype)
    scaled = reduced.factor.solve(identity)
    # Of the matrix with unit diagonal, the trace of the inverse bounds the condition number.
    resolved = jnp.trace(scaled) < 1.0 / (32.0 * float(jnp.finfo(scaled.dtype).eps))
    regular = reduced.regular & resolved & jnp.all(reduced.diagonal > 0)
    inverse = jnp.where(regular, reduced.scale[:, None] * scaled * reduced.scale[None], 0.0)
    count = layout.landmark_order.shape[0]
    slot = jnp.full((problem.landmarks.shape[0],), count).at[layout.landmark_order].set(jnp.arange(count))
    basis = landmark_basis(state.landmarks, data) if len(state.landmarks) == 4 else None
    return BundleCovariance(inverse, eliminated, layout, slot, cam_from_world, regular, basis)
