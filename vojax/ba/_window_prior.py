"""What a window remembers of the keyframes that left it: a Gaussian over the poses that stay, as a square root."""

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SE3


class WindowPrior(eqx.Module):
    """A linear belief about the keyframes of a window, ½‖residual + factor · δ‖², δ the tangents from `world_from_cam`.

    Information is kept as a square root: float32 has digits for a factor whose square it could not tell from singular.

    Attributes:
        factor: Square root of the information, by rows; zero for keyframes that the belief is not about.
        residual: Its right-hand side, in standard deviations.
        world_from_cam: Where it was linearised: the first estimates of its keyframes.
        active: Keyframes that it is about.
    """

    factor: Float[Array, "m c 6"]
    residual: Float[Array, " m"]
    world_from_cam: SE3
    active: Bool[Array, " c"]

    @staticmethod
    def none(world_from_cam: SE3) -> "WindowPrior":
        """No belief about any of these keyframes, in the shape that one window hands to the next."""
        (c, _), dtype = world_from_cam.wxyz_xyz.shape, world_from_cam.wxyz_xyz.dtype
        zeros = jnp.zeros((6 * c, c, 6), dtype)
        return WindowPrior(zeros, jnp.zeros((6 * c,), dtype), world_from_cam, jnp.zeros((c,), bool))

    @staticmethod
    def of_first(world_from_cam: SE3, covariance: Float[ArrayLike, "6 6"]) -> "WindowPrior":
        """A belief about the first keyframe alone, in place of fixing it.

        Args:
            world_from_cam: Poses of the window `[c]`; the first is the mean.
            covariance: Of the first one's camera-frame tangent, translation first.
        """
        prior = WindowPrior.none(world_from_cam)
        covariance = jnp.asarray(covariance, prior.residual.dtype)
        scale = 1.0 / jnp.sqrt(jnp.diagonal(covariance))
        lower = jnp.linalg.cholesky(scale[:, None] * covariance * scale[None])
        root = jax.scipy.linalg.solve_triangular(lower, jnp.diag(scale), lower=True)
        return eqx.tree_at(
            lambda prior: (prior.factor, prior.active),
            prior,
            (prior.factor.at[:6, 0].set(root), prior.active.at[0].set(True)),
        )

    def tangents(self, world_from_cam: SE3) -> Float[Array, "c 6"]:
        """δ of given poses."""
        moved = (self.world_from_cam.inverse() @ world_from_cam).log()
        return jnp.where(self.active[:, None], moved, 0.0)

    def errors(self, world_from_cam: SE3) -> Float[Array, " m"]:
        """Residual at given poses, in standard deviations."""
        return self.residual + self._times(self.tangents(world_from_cam))

    def by_pose(self, world_from_cam: SE3) -> Float[Array, "m c 6"]:
        """Its derivative in the camera-frame tangents of the poses."""
        turning = SE3.jacobian_right_inverse(self.tangents(world_from_cam))
        return jnp.sum(self.factor[:, :, :, None] * turning[None], axis=2)

    def moved(self, frame_from_world: SE3) -> "WindowPrior":
        """The same belief in another frame: tangents in the cameras' frames do not change."""
        return eqx.tree_at(lambda prior: prior.world_from_cam, self, frame_from_world @ self.world_from_cam)

    def _times(self, tangents: Float[Array, "c 6"]) -> Float[Array, " m"]:
        rows = self.factor.reshape(self.factor.shape[0], -1)
        return jnp.matmul(rows, tangents.reshape(-1), precision="highest")
