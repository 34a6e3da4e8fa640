"""Reprojection errors of one board that moves from view to view before the cameras of a rig.

A corner depends on the intrinsics and the place in the rig of its own camera, and on the board pose of its own view;
derivatives are formed by these few unknowns.

References: Zhang, "A flexible new technique for camera calibration", PAMI 2000.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax._numerics import cross3, dot3
from vojax._types import Array, Float
from vojax.lie import SE3

from ._intrinsics import Tied, add_to_camera, get_attribute
from ._losses import Loss, robustify


class BoardState(eqx.Module):
    """The unknowns.

    Attributes:
        cameras: One camera model whose arrays have a leading axis `[c]`.
        cam_from_rig: Poses of the cameras `[c]`; the first stays where it is.
        rig_from_board: Poses of the board `[v]`.
    """

    cameras: Any
    cam_from_rig: SE3
    rig_from_board: SE3


class BoardData(eqx.Module):
    """The observations.

    Attributes:
        corners: Measured pixels.
        board_points: The same points in the board's frame.
        weight: Factor on the loss of each corner; zero leaves it out.
        sigma_px: Standard deviation of the corners.
        loss: Robust loss of the squared whitened residual of a corner.
        free: Attributes of the cameras that are unknown.
    """

    corners: Float[Array, "c v n 2"]
    board_points: Float[Array, "n 3"]
    weight: Float[Array, "c v n"]
    sigma_px: Float[Array, "..."]
    loss: Loss
    free: tuple[Tied, ...] = eqx.field(static=True)


class Tangent(NamedTuple):
    """Increments: of the shared unknowns (intrinsics camera by camera, then poses in the rig), and of the boards."""

    shared: Float[Array, " d"]
    boards: Float[Array, "v 6"]


def parameter_vector(cameras: Any, free: tuple[Tied, ...]) -> Float[Array, "c k"]:
    """Values of the free intrinsics, by the first name of each group."""
    first = jax.tree.leaves(cameras)[0]
    return jnp.stack([get_attribute(cameras, names[0]) for names in free], 1) if free else first[:, None][:, :0]


def retract(state: BoardState, tangent: Tangent, free: tuple[Tied, ...]) -> BoardState:
    """Move the unknowns; poses in the frame they map to, as everywhere."""
    count = state.cam_from_rig.wxyz_xyz.shape[0]
    split = tangent.shared.shape[0] - 6 * (count - 1)
    change = tangent.shared[:split].reshape(count, -1)
    moves = jnp.concatenate([jnp.zeros((1, 6), change.dtype), tangent.shared[split:].reshape(-1, 6)])
    return BoardState(
        add_to_camera(state.cameras, free, change.T),
        _move(state.cam_from_rig, moves),
        _move(state.rig_from_board, tangent.boards),
    )


def _move(pose: SE3, tangent: Float[Array, "a 6"]) -> SE3:
    """exp(−ξ) @ pose to first order: the rotation by Cayley's map, which a compiler handles ten times faster.

    With g = −φ/2 the rotation is the unit quaternion along (1, g), and the translation R t − ρ.
    """
    w, x, y, z = pose.wxyz_xyz[:, :4].T
    t = tuple(pose.wxyz_xyz[:, 4:].T)
    rho, g = tuple(tangent[:, :3].T), tuple(-0.5 * tangent[:, 3:].T)
    gx, gy, gz = g
    norm2 = dot3(g, g)
    root = jax.lax.rsqrt(1.0 + norm2)
    turned = (w - gx * x - gy * y - gz * z, x + gx * w + gy * z - gz * y, y + gy * w + gz * x - gx * z,
              z + gz * w + gx * y - gy * x)  # fmt: skip
    # t + 2 (g × t + g × (g × t)) / (1 + |g|²)
    once = cross3(g, t)
    twice = cross3(g, once)
    factor = 2.0 * root * root
    translation = (a + factor * (b + c) - d for a, b, c, d in zip(t, once, twice, rho, strict=True))
    return SE3(jnp.stack([*(q * root for q in turned), *translation], axis=1))


def recentring(tangent: Float[Array, "a 6"]) -> Float[Array, "a 6 6"]:
    """Change of the increment about the moved pose by a change of the increment that moved it."""

    def one(y: Array) -> Array:
        rho, g = y[:3], -0.5 * y[3:]
        angular = (jnp.eye(3, dtype=y.dtype) + _skew(g)) / (1.0 + jnp.sum(g * g))
        upper = jnp.concatenate([jnp.eye(3, dtype=y.dtype), -_skew(rho) @ angular], axis=1)
        return jnp.concatenate([upper, jnp.concatenate([jnp.zeros_like(angular), angular], axis=1)])

    return jax.vmap(one)(tangent)


def _skew(a: Float[Array, "3"]) -> Float[Array, "3 3"]:
    x, y, z, o = a[0], a[1], a[2], jnp.zeros_like(a[0])
    return jnp.stack([jnp.stack([o, -z, y]), jnp.stack([z, o, -x]), jnp.stack([-y, x, o])])


def zero_tangent(state: BoardState, free: tuple[Tied, ...]) -> Tangent:
    """The increment that moves nothing."""
    vector = parameter_vector(state.cameras, free)
    c, v = state.cam_from_rig.wxyz_xyz.shape[0], state.rig_from_board.wxyz_xyz.shape[0]
    return Tangent(jnp.zeros((vector.size + 6 * (c - 1),), vector.dtype), jnp.zeros((v, 6), vector.dtype))


def projections(state: BoardState, board_points: Float[Array, "n 3"]) -> Float[Array, "c v n 2"]:
    """Pixels of the board's points in every camera and view."""
    points_rig = _transform(state.rig_from_board.wxyz_xyz, tuple(board_points.T[:, None]))

    def one(camera: Any, cam_from_rig: Array) -> Array:
        points_cam = _transform(cam_from_rig[None], points_rig)
        return jnp.stack(camera.project_xyz(*points_cam), axis=-1)

    return jax.vmap(one)(state.cameras, state.cam_from_rig.wxyz_xyz)


def _transform(poses: Float[Array, "a 7"], points: tuple[Array, ...]) -> tuple[Array, ...]:
    """Apply poses `[a]` to points given by components, `[a or 1, n]`."""
    rows = SE3(poses).rotation().as_matrix()
    return tuple(sum((rows[:, i, j, None] * points[j] for j in range(3)), poses[:, 4 + i, None]) for i in range(3))


def errors(state: BoardState, data: BoardData) -> Float[Array, "c v n 2"]:
    """Reprojection errors in pixels, zero where a corner does not count."""
    seen = (data.weight > 0)[..., None]
    return jnp.where(seen, projections(state, data.board_points) - jnp.where(seen, data.corners, 0.0), 0.0)


def _residual(state: BoardState, data: BoardData) -> tuple[Array, Array]:
    return _whitened_errors(projections(state, data.board_points), data)


def _whitened_errors(pixels: Float[Array, "c v n 2"], data: BoardData) -> tuple[Array, Array]:
    seen = data.weight > 0
    u, v = (
        jnp.where(seen, pixels[..., i] - jnp.where(seen, data.corners[..., i], 0.0), 0.0) / data.sigma_px
        for i in range(2)
    )
    ru, rv = robustify((u, v), data.loss, data.weight)
    return ru, rv


@jax.custom_jvp
def residual_at(tangent: Tangent, args: tuple[BoardState, BoardData]) -> tuple[Array, Array]:
    start, data = args
    return _residual(retract(start, tangent, data.free), data)


@residual_at.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    (y, (start, data)), (change, _) = primals, tangents
    residual, columns = _linearized(y, start, data)
    places = jnp.asarray(places_of(layout_of(data)), change.shared.dtype)
    shared = jnp.einsum("csd,d->sc", places, change.shared)[:, :, None, None]
    s = places.shape[1]

    def along(columns: Float[Array, "m c v n"]) -> Array:
        return jnp.sum(columns[:s] * shared, axis=0) + jnp.sum(columns[s:] * change.boards.T[:, None, :, None], axis=0)

    return residual, (along(columns[0]), along(columns[1]))


def _linearized(y: Tangent, start: BoardState, data: BoardData) -> tuple[Any, tuple[Array, Array]]:
    """Residuals at increments `y`, and their derivatives `[k + 12, c, v, n]` by the unknowns of each corner.

    By its camera's intrinsics and place in the rig, and by its board: only intrinsics and the point in the camera's
    frame are left to automatic differentiation.
    """
    count, k, _ = layout_of(data)
    state = retract(start, y, data.free)
    rig, boards = state.cam_from_rig.wxyz_xyz, state.rig_from_board.wxyz_xyz
    points_rig = _transform(boards, tuple(data.board_points.T[:, None]))
    points_cam = jax.vmap(lambda pose: jnp.stack(_transform(pose[None], points_rig)))(rig)

    def residual(change: Float[Array, "c k"], points: Float[Array, "c 3 v n"]) -> tuple[Array, Array]:
        moved = add_to_camera(state.cameras, data.free, change.T)
        pixels = jax.vmap(lambda camera, p: jnp.stack(camera.project_xyz(p[0], p[1], p[2]), axis=-1))(moved, points)
        return _whitened_errors(pixels, data)

    none = jnp.zeros((count, k), boards.dtype)
    value, derivative = jax.linearize(residual, none, points_cam)
    unit = jnp.eye(k + 3, dtype=boards.dtype)
    ones = jnp.ones_like(points_cam[:, :1])
    columns = jax.vmap(lambda e: derivative(jnp.broadcast_to(e[:k], none.shape), ones * e[None, k:, None, None]))(unit)
    by_rig = jnp.concatenate([jnp.zeros_like(rig[:1, :6]), y.shared[count * k :].reshape(-1, 6)])
    about_rig, about_boards = recentring(by_rig), recentring(y.boards)
    rotation = SE3(rig).rotation().as_matrix()

    def complete(columns: Float[Array, "m c v n"]) -> Array:
        by_point = columns[k:]
        in_cam = _by_pose(by_point, jnp.moveaxis(points_cam, 1, 0))
        in_rig = _by_pose(jnp.einsum("cij,icvn->jcvn", rotation, by_point), jnp.stack(points_rig)[:, None])
        return jnp.concatenate(
            [
                columns[:k],
                jnp.einsum("cij,icvn->jcvn", about_rig, in_cam),
                jnp.einsum("vij,icvn->jcvn", about_boards, in_rig),
            ]
        )

    return value, (complete(columns[0]), complete(columns[1]))


def _by_pose(by_point: Float[Array, "3 c v n"], points: Float[Array, "3 _ v n"]) -> Float[Array, "6 c v n"]:
    """Derivatives by ξ of exp(−ξ), which moves a point by −ρ − φ × p."""
    x, y, z = cross3(tuple(points), tuple(by_point))
    return -jnp.concatenate([by_point, jnp.stack([x, y, z])])


def cost(state: BoardState, data: BoardData) -> Float[Array, ""]:
    """½Σρ."""
    ru, rv = _residual(state, data)
    return 0.5 * jnp.sum(ru * ru + rv * rv)


def places_of(layout: tuple[int, int, int]) -> np.ndarray:
    """Ones where a shared unknown is the j-th of camera c, its intrinsics before its pose: `[c, k + 6, d]`."""
    count, k, d = layout
    places = np.zeros((count, k + 6, d))
    for c in range(count):
        places[c, range(k), range(c * k, (c + 1) * k)] = 1.0
        if c > 0:
            at = count * k + 6 * (c - 1)
            places[c, range(k, k + 6), range(at, at + 6)] = 1.0
    return places


def layout_of(data: BoardData) -> tuple[int, int, int]:
    count, k = data.weight.shape[0], len(data.free)
    return count, k, count * k + 6 * (count - 1)
