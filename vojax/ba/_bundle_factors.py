"""Residuals of several poses and no landmark: motion models, relative measurements, constraints between frames.

They do not touch what is eliminated: their normal equations are added to those of the cameras.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, Float, Int
from vojax.lie import SE3


class PoseFactors(eqx.Module):
    """Residuals of one kind, each of the same number of poses.

    Attributes:
        residual: `(cam_from_world, data) -> [r]`, of poses `[n]` and one entry of `data`, in units of its standard
            deviation; differentiable twice.
        cameras: The poses of each. In a problem with rigs, numbers from the number of rig poses on are the poses of the
            cameras in the rig.
        data: Any pytree of arrays with a leading axis `[f]`; differentiable data of the problem.

    Example:
        A walk whose every step is about a metre forward:

        >>> steps = PoseFactors(
        ...     lambda poses, sigma: (SE3(poses.wxyz_xyz[0]) @ SE3(poses.wxyz_xyz[1]).inverse()).translation() / sigma
        ...     - jnp.array([0.0, 0.0, 1.0]) / sigma,
        ...     jnp.array([[0, 1], [1, 2]]),
        ...     jnp.array([0.1, 0.1]),
        ... )
        >>> steps.cameras.shape
        (2, 2)
    """

    residual: Callable[[SE3, Any], Array] = eqx.field(static=True)
    cameras: Int[Array, "f n"]
    data: Any

    def at(self, poses: SE3) -> Float[Array, "f r"]:
        """All residuals."""
        return jax.vmap(lambda pose, data: self.residual(SE3(pose), data))(poses.wxyz_xyz[self.cameras], self.data)

    def linearize(self, poses: SE3) -> tuple[Float[Array, "f r"], Float[Array, "f r q"]]:
        """Residuals and their derivatives by the tangents of the n poses, q = 6 n."""

        def one(pose: Array, data: Any) -> tuple[Array, Array]:
            along = jax.jacfwd(lambda xi: _twice(self._moved(xi, pose, data)), has_aux=True)
            jacobian, value = along(jnp.zeros(6 * pose.shape[0], pose.dtype))
            return value, jacobian

        return jax.vmap(one)(poses.wxyz_xyz[self.cameras], self.data)

    def gradient(self, xi: Float[Array, "f q"], poses: SE3) -> Float[Array, "f q"]:
        """Derivative of ½‖r‖² of every factor."""

        def one(xi: Array, pose: Array, data: Any) -> Array:
            return jax.grad(lambda xi: 0.5 * jnp.sum(self._moved(xi, pose, data) ** 2))(xi)

        return jax.vmap(one)(xi, poses.wxyz_xyz[self.cameras], self.data)

    def zero(self, dtype: Any) -> Float[Array, "f q"]:
        """Tangents of poses that stay."""
        f, n = self.cameras.shape
        return jnp.zeros((f, 6 * n), dtype)

    def _moved(self, xi: Array, pose: Array, data: Any) -> Array:
        return self.residual(SE3.exp(-xi.reshape(-1, 6)) @ SE3(pose), data)


class FactorBlock(NamedTuple):
    """Normal equations of factors in the tangents of their poses."""

    hessian: Float[Array, "f q q"]
    gradient: Float[Array, "f q"]


def pose_prior(mean: SE3, root: Float[Array, "c 6 6"]) -> PoseFactors:
    """Gaussian beliefs about single poses: L log(mean @ cam_from_world⁻¹)."""
    count = root.shape[0]
    return PoseFactors(_prior_residual, jnp.arange(count)[:, None], (mean.wxyz_xyz, root))


def _prior_residual(poses: SE3, data: tuple[Array, Array]) -> Array:
    mean, root = data
    delta = (SE3(mean) @ SE3(poses.wxyz_xyz[0]).inverse()).log()
    return jnp.sum(root * delta[None], axis=1)


def _twice(value: Array) -> tuple[Array, Array]:
    return value, value
