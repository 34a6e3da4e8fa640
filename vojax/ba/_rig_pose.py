"""The pose of a rig against points and their pixels in its cameras."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, Float, Int
from vojax.cameras import Rig
from vojax.lie import SE3

from ._retraction import step_pose
from ._whitening import whiten


class RigPoseProblem(eqx.Module):
    """`rig_from_world`; the tangent is in the rig's frame, translation first."""

    points_world: Float[Array, "n 3"]
    pixels: Float[Array, "n 2"]
    camera_index: Int[Array, " n"]
    rig: Rig
    whitening: tuple[Array, ...]
    tangent_dim: ClassVar[int] = 6

    @staticmethod
    def retract(model: SE3, tangent: Array) -> SE3:
        """exp(−ξ) @ rig_from_world."""
        return step_pose(model, tangent)

    def residual(self, model: SE3) -> tuple[Array, ...]:
        """Whitened reprojection errors."""
        error = self.rig.project(model.apply(self.points_world), self.camera_index) - self.pixels
        return whiten(self.whitening, (error[:, 0], error[:, 1]))


class LocalRigPoseProblem(eqx.Module):
    """The same with every camera replaced, about each pixel, by the pinhole that agrees with it there to first order.

    An observation is then three linear forms of the point, whatever the camera: l = A (R X + t) + b, with the error
    (l1 / l0, l2 / l0) in pixels.
    """

    points_world: Float[Array, "n 3"]
    forms: tuple[Array, ...]  # A | b row by row, twelve of [n]
    tangent_dim: ClassVar[int] = 6

    @staticmethod
    def retract(model: SE3, tangent: Array) -> SE3:
        """exp(−ξ) @ rig_from_world."""
        return RigPoseProblem.retract(model, tangent)

    def residual(self, model: SE3) -> tuple[Array, ...]:
        """Errors in pixels."""
        y = model.apply(self.points_world)
        return local_error(self.forms, (y[:, 0], y[:, 1], y[:, 2]))[:2]


def local_error(forms: tuple[Array, ...], point: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Error in pixels along u and v, and l0: positive in front of the camera."""
    x, y, z = point
    l0, l1, l2 = (forms[i] * x + forms[i + 1] * y + forms[i + 2] * z + forms[i + 3] for i in (0, 4, 8))
    inverse = 1.0 / jnp.where(jnp.abs(l0) > float(jnp.finfo(l0.dtype).eps), l0, 1.0)
    return l1 * inverse, l2 * inverse, l0


def local_forms(rig: Rig, pixels: Float[Array, "n 2"], camera_index: Int[Array, " n"]) -> tuple[Array, ...]:
    """The linear forms of `LocalRigPoseProblem`."""

    def rays(pixels: Array) -> tuple[Array, Array]:
        return rig.rays(pixels, camera_index)

    (centers, ray), columns = rays(pixels), []
    for k in range(2):
        columns.append(jax.jvp(rays, (pixels,), (jnp.zeros_like(pixels).at[:, k].set(1.0),))[1][1])
    # Rows of the inverse of [ray, ∂ray/∂u, ∂ray/∂v].
    rows = (jnp.cross(columns[0], columns[1]), jnp.cross(columns[1], ray), jnp.cross(ray, columns[0]))
    volume = jnp.sum(ray * rows[0], axis=1)
    inverse = 1.0 / jnp.where(volume != 0, volume, 1.0)
    forms: list[Array] = []
    for row in rows:
        scaled = row * inverse[:, None]
        forms += [*(scaled[:, j] for j in range(3)), -jnp.sum(scaled * centers, axis=1)]
    return tuple(forms)
