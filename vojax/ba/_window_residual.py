"""Residuals of a window on the grid [keyframes, landmarks], and their derivative in the observed points."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, Float
from vojax.lie import SE3

from ._losses import Loss, robustify
from ._whitening import whiten
from ._window_prior import WindowPrior


class WindowState(eqx.Module):
    """Poses `world_from_cam` and landmarks by components, in the frame of the oldest keyframe."""

    poses: SE3
    points: Float[Array, "3 p"]

    def moved(self, tangents: Float[Array, "6 c"], moves: Float[Array, "3 p"]) -> "WindowState":
        """After a step in the camera frames and of the landmarks."""
        return WindowState(self.poses @ SE3.exp(tangents.T), self.points + moves)


class WindowData(eqx.Module):
    """What was measured, by components `[c, p]`, and what is known beforehand."""

    measured: tuple[Array, ...]
    whitening: tuple[Array, ...]
    weight: Float[Array, "c p"]
    free: Float[Array, " c"]
    camera: Any
    prior: WindowPrior | None


class Blocks(NamedTuple):
    """Residuals and derivatives at a point.

    Every observation depends on its landmark in its camera's frame and through nothing else on pose and landmark, so
    these few numbers say all of the Jacobian.
    """

    residual: tuple[Array, ...]  # d components [c, p]
    by_point: Float[Array, "d 3 c p"]
    point: Float[Array, "3 c p"]  # in the camera's frame
    rotation: Float[Array, "3 3 c"]  # of cam_from_world
    free: Float[Array, " c"]
    prior_residual: Float[Array, " m"]
    prior_by_pose: Float[Array, "m 6 c"]

    def along(self, tangents: Float[Array, "6 c"], moves: Float[Array, "3 p"]) -> tuple[Array, ...]:
        """Change of all residuals along a step."""
        tangents = tangents * self.free[None]
        moved = jnp.sum(self.rotation[..., None] * moves[None, :, None], axis=1)
        moved = moved - tangents[:3, :, None] + cross(self.point, tangents[3:, :, None])
        change = jnp.sum(self.by_point * moved[None], axis=1)
        return *change, jnp.sum(self.prior_by_pose * tangents[None], axis=(1, 2))


def cross(a: Float[Array, "3 *a"], b: Float[Array, "3 *b"]) -> Float[Array, "3 *both"]:
    """Vector product by components; the other axes broadcast."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def dot(a: Float[Array, "_ *a"], b: Float[Array, "3 *b"]) -> Array:
    """Scalar product by the first three components; the other axes broadcast."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def observed(x: Array, y: Array, z: Array, data: WindowData, loss: Loss) -> tuple[Array, ...]:
    """Whitened, robustified residual components of points in the camera frames [c, p]."""
    projected = data.camera.project_xyz(x, y, z)
    # Intrinsics may be of a wider type than the window.
    raw = tuple((a - b).astype(b.dtype) for a, b in zip(projected, data.measured, strict=True))
    return robustify(whiten(data.whitening, raw), loss, data.weight)


def points_in_cameras(state: WindowState) -> tuple[Float[Array, "3 c p"], Float[Array, "3 3 c"]]:
    """Landmarks in every camera's frame, and the rotations that took them there."""
    cam_from_world = jnp.moveaxis(state.poses.inverse().as_matrix(), 0, -1)[..., None]
    points = state.points[:, None]
    # Components one by one: a sum over three is a loop of its own to XLA, and not one over landmarks.
    point = jnp.stack([dot(cam_from_world[i], points) + cam_from_world[i, 3] for i in range(3)])
    return point, cam_from_world[:3, :3, :, 0]


def residuals(state: WindowState, data: WindowData, loss: Loss) -> tuple[Array, ...]:
    """All residuals: those of the observations `[c, p]` by components, and the prior's."""
    point, _ = points_in_cameras(state)
    prior = () if data.prior is None else (data.prior.errors(state.poses),)
    return (*observed(point[0], point[1], point[2], data, loss), *prior)


def linearize(state: WindowState, data: WindowData, loss: Loss) -> Blocks:
    """Residuals and derivatives at a state."""
    point, rotation = points_in_cameras(state)
    residual, derivative = jax.linearize(lambda x, y, z: observed(x, y, z, data, loss), point[0], point[1], point[2])
    one, zero = jnp.ones_like(point[0]), jnp.zeros_like(point[0])
    columns = [derivative(*(one if i == j else zero for i in range(3))) for j in range(3)]
    # Stacked, and so written to memory once: as separate arrays XLA computes them anew in each of their uses.
    by_point = jnp.stack([jnp.stack(rows) for rows in zip(*columns, strict=True)])
    if data.prior is None:
        errors, by_pose = jnp.zeros((0,), one.dtype), jnp.zeros((0, 6, data.free.shape[0]), one.dtype)
    else:
        errors, by_pose = data.prior.errors(state.poses), jnp.moveaxis(data.prior.by_pose(state.poses), 1, 2)
    return Blocks(residual, by_point, point, rotation, data.free, errors, by_pose * data.free[None, None])


def cost(residual: tuple[Array, ...]) -> Float[Array, ""]:
    """½Σr²."""
    return 0.5 * sum(jnp.sum(component * component) for component in residual)  # type: ignore[return-value]
