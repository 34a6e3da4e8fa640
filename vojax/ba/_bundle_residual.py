"""Residuals of a bundle, their Jacobian blocks and their exact Hessian blocks, one observation a lane.

A camera's tangent is (ρ, φ) in its own frame, `exp(−ξ) @ cam_from_world`, and after it increments of its intrinsics.
Every observation touches one camera and one landmark, so one product with a tangent of ones for each of their
parameters gives all blocks exactly.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax._types import Array, Float
from vojax.lie import SE3

from ._bundle_layout import BundleLayout
from ._losses import Loss, Squared, robustify
from ._whitening import whiten

# Names of attributes of the camera that are one unknown: they change by the same increment.
Tied = tuple[str, ...]


class BundleState(eqx.Module):
    """What is solved for: poses, increments of the free intrinsics of each group, landmarks in the order of slots."""

    cam_from_world: SE3
    intrinsics: Float[Array, "g m"]
    landmarks: Float[Array, "3 l"]


class BundlePriors(eqx.Module):
    """Gaussian beliefs about single variables, each a mean and a square root L of its information, cost ½‖L δ‖².

    None leaves a kind out; a zero L leaves a variable out.

    Attributes:
        cam_from_world: Means of the poses; δ = log(mean @ cam_from_world⁻¹), the camera-frame tangent (ρ, φ).
        cam_root: Their L.
        landmarks: Means of the landmarks; δ = landmark − mean.
        landmark_root: Their L.
        intrinsics: Means of the free intrinsics of every group of cameras, in their order; δ = value − mean.
        intrinsics_root: Reciprocal standard deviations.
    """

    cam_from_world: SE3 | None = None
    cam_root: Float[Array, "c 6 6"] | None = None
    landmarks: Float[Array, "p 3"] | None = None
    landmark_root: Float[Array, "p 3 3"] | None = None
    intrinsics: Float[Array, "g m"] | None = None
    intrinsics_root: Float[Array, "g m"] | None = None


class BundleData(eqx.Module):
    """What is not solved for, by slots."""

    measured: tuple[Float[Array, " s"], ...]
    whitening: tuple[Array, ...]
    weight: Float[Array, " s"]
    camera: Any
    priors: BundlePriors
    free: tuple[Tied, ...] = eqx.field(static=True)
    residual: Callable[..., Array] | None = eqx.field(static=True)


class PriorBlocks(eqx.Module):
    """Residuals of the priors, and the derivative of the poses' ones by (ρ, φ); empty arrays where there is none."""

    cameras: Float[Array, "c1 6"]
    landmarks: Float[Array, "3 l1"]
    intrinsics: Float[Array, "g1 m1"]
    cameras_by_tangent: Float[Array, "c1 6 6"]

    @property
    def residuals(self) -> tuple[Array, ...]:
        """The three kinds, as they stand in the residual of the problem."""
        return self.cameras, self.landmarks, self.intrinsics


class Blocks(eqx.Module):
    """Robustified residuals and their derivatives."""

    residual: Float[Array, "d s"]
    by_camera: Float[Array, "d k s"]
    by_landmark: Float[Array, "d 3 s"]
    priors: PriorBlocks


def get_attribute(tree: Any, path: str) -> Any:
    """Attribute by a dotted path."""
    return functools.reduce(getattr, path.split("."), tree)


def add_to_camera(camera: Any, free: Sequence[Tied], increments: Sequence[Array]) -> Any:
    """The camera with each group of tied attributes increased."""
    for names, increment in zip(free, increments, strict=True):
        for name in names:
            camera = eqx.tree_at(
                lambda tree, name=name: get_attribute(tree, name), camera, get_attribute(camera, name) + increment
            )
    return camera


class _View(eqx.Module):
    """What each slot sees: its pose as rows of [R | t], its landmark, its camera."""

    rotation: tuple[tuple[Array, ...], ...]
    translation: tuple[Array, ...]
    landmark: tuple[Array, ...]
    camera: Any

    def points(self) -> tuple[Array, ...]:
        """Landmarks in the frames of the cameras."""
        return tuple(
            sum((row[j] * self.landmark[j] for j in range(3)), t)
            for row, t in zip(self.rotation, self.translation, strict=True)
        )


def view(state: BundleState, data: BundleData, layout: BundleLayout) -> _View:
    """Bring cameras and landmarks to the slots: one gather of a table of all that a camera has."""
    matrix = state.cam_from_world.as_matrix()[:, :3].reshape(-1, 12).T
    shared = state.intrinsics.shape[0] == 1
    theta = [state.intrinsics[0, j] if shared else state.intrinsics[:, j] for j in range(len(data.free))]
    camera = add_to_camera(data.camera, data.free, theta)
    leaves, tree = jax.tree.flatten(camera)
    rows = [leaf[layout.camera_group] for leaf in leaves if leaf.ndim]
    table = jnp.concatenate([matrix, jnp.stack(rows)]) if rows else matrix
    table = table.at[:, layout.slot_camera].get(mode="clip")
    own = iter(table[12:])
    camera = jax.tree.unflatten(tree, [next(own) if leaf.ndim else leaf for leaf in leaves])
    landmark = layout.spread(state.landmarks)
    return _View(
        tuple((table[4 * i], table[4 * i + 1], table[4 * i + 2]) for i in range(3)),
        tuple(table[4 * i + 3] for i in range(3)),
        tuple(landmark),
        camera,
    )


def _pose_of(seen: _View) -> SE3:
    """Slots' poses as group elements, for residuals of the user."""
    rows = [jnp.stack([*row, t], axis=-1) for row, t in zip(seen.rotation, seen.translation, strict=True)]
    last = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0], rows[0].dtype), rows[0].shape)
    return SE3.from_matrix(jnp.stack([*rows, last], axis=-2))


def _white(raw: Sequence[Array], data: BundleData) -> tuple[Array, ...]:
    return whiten(data.whitening, tuple(raw))


def _raw_at_points(x: Array, y: Array, z: Array, theta: Sequence[Array], seen: _View, data: BundleData) -> list[Array]:
    camera = add_to_camera(seen.camera, data.free, theta) if len(theta) else seen.camera
    return [a - b for a, b in zip(camera.project_xyz(x, y, z), data.measured, strict=True)]


def _raw_of_user(
    xi: Sequence[Array], eta: Sequence[Array], theta: Sequence[Array], seen: _View, data: BundleData
) -> Any:
    """The user's residual of one camera and one landmark, mapped over the slots."""
    poses = _pose_of(seen)
    shape = seen.landmark[0].shape
    camera = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, shape), seen.camera)

    def one(pose: SE3, xi: Array, landmark: Array, eta: Array, camera: Any, theta: Array, measured: Array) -> Array:
        moved = SE3.exp(-xi) @ pose
        return data.residual(moved, landmark + eta, add_to_camera(camera, data.free, list(theta)), measured)  # type: ignore[misc]

    stack = lambda parts, size: jnp.stack(parts, -1) if size else jnp.zeros((*shape, 0), poses.wxyz_xyz.dtype)  # noqa: E731
    columns = jax.vmap(one)(
        poses,
        stack(xi, 6),
        stack(seen.landmark, 3),
        stack(eta, 3),
        camera,
        stack(theta, len(theta)),
        stack(data.measured, 2),
    )
    return [columns[:, i] for i in range(columns.shape[1])]


def residual(state: BundleState, data: BundleData, loss: Loss, layout: BundleLayout) -> tuple[Array, ...]:
    """All residuals: whitened, robustified components by slots, then those of the priors; ½‖·‖² is the cost."""
    return *observation_residual(state, data, loss, layout), *prior_blocks(state, data, layout).residuals


def observation_residual(state: BundleState, data: BundleData, loss: Loss, layout: BundleLayout) -> tuple[Array, ...]:
    """Whitened, robustified residual components by slots."""
    seen = view(state, data, layout)
    if data.residual is None:
        x, y, z = seen.points()
        raw = _raw_at_points(x, y, z, (), seen, data)
    else:
        zero = jnp.zeros_like(seen.landmark[0])
        raw = _raw_of_user((zero,) * 6, (zero,) * 3, (zero,) * len(data.free), seen, data)
    return robustify(_white(raw, data), loss, data.weight)


def linearize(state: BundleState, data: BundleData, loss: Loss, layout: BundleLayout) -> Blocks:
    """Residuals with the blocks of their Jacobian."""
    seen = view(state, data, layout)
    zero = jnp.zeros_like(seen.landmark[0])
    m = len(data.free)
    finish = lambda raw: robustify(_white(raw, data), loss, data.weight)  # noqa: E731
    if data.residual is None:
        points = seen.points()
        components, columns = _columns(
            lambda x, y, z, *theta: finish(_raw_at_points(x, y, z, theta, seen, data)), (*points, *(zero,) * m)
        )
        x, y, z = points
        by_camera, by_landmark = [], []
        # X(ξ) = exp(−ξ) X has dX = −ρ + X × φ, so the row by φ is (a, b, c) × X; a landmark moves X by R η.
        for i in range(len(components)):
            a, b, c = (columns[j][i] for j in range(3))
            theta = [columns[3 + j][i] for j in range(m)]
            by_camera.append(jnp.stack([-a, -b, -c, b * z - c * y, c * x - a * z, a * y - b * x, *theta]))
            row = [a * p + b * q + c * r for p, q, r in zip(*seen.rotation, strict=True)]
            by_landmark.append(jnp.stack(row))
    else:
        components, columns = _columns(
            lambda *a: finish(_raw_of_user(a[:6], a[6 + m :], a[6 : 6 + m], seen, data)), (zero,) * (9 + m)
        )
        by_camera = [jnp.stack([column[i] for column in columns[: 6 + m]]) for i in range(len(components))]
        by_landmark = [jnp.stack([column[i] for column in columns[6 + m :]]) for i in range(len(components))]
    priors = prior_blocks(state, data, layout)
    return Blocks(jnp.stack(components), jnp.stack(by_camera), jnp.stack(by_landmark), priors)


def _columns(function: Callable[..., Any], at: Sequence[Array]) -> tuple[Any, list[Any]]:
    """Value and derivatives by each argument alone: arguments that stand still cost nothing."""
    columns, value = [], None
    for i in range(len(at)):
        along = lambda v, i=i: function(*at[:i], v, *at[i + 1 :])  # noqa: E731
        value, column = jax.jvp(along, (at[i],), (jnp.ones_like(at[i]),))
        columns.append(column)
    return value, columns


def costs(parameters: Sequence[Array], seen: _View, data: BundleData, loss: Loss) -> Array:
    """½wρ of every slot, as a function of its own copies of (ξ, θ, η), right to second order at zero."""
    m = len(data.free)
    xi, theta, eta = parameters[:6], parameters[6 : 6 + m], parameters[6 + m :]
    if data.residual is None:
        points = seen.points()
        moved = [p + sum(row[j] * eta[j] for j in range(3)) for p, row in zip(points, seen.rotation, strict=True)]
        rho, phi = xi[:3], xi[3:]
        # exp(−ξ) X = X − (ρ + φ × X) + ½ φ × (ρ + φ × X) + O(ξ³).
        velocity = [r + c for r, c in zip(rho, _cross(phi, moved), strict=True)]
        bend = _cross(phi, velocity)
        x, y, z = (p - v + 0.5 * b for p, v, b in zip(moved, velocity, bend, strict=True))
        raw = _raw_at_points(x, y, z, theta, seen, data)
    else:
        raw = _raw_of_user(xi, eta, theta, seen, data)
    white = _white(raw, data)
    s = sum((component * component for component in white), jnp.zeros_like(data.weight))
    return 0.5 * data.weight * (s if isinstance(loss, Squared) else loss.rho(s))


def gradient_and_hessian(
    state: BundleState, data: BundleData, loss: Loss, layout: BundleLayout, tangent: tuple[BundleData, Loss] | None
) -> tuple[Float[Array, "n n s"], Float[Array, "n s"] | None]:
    """Exact Hessian of each slot's cost in its camera's and its landmark's parameters, k + 3 of them.

    Also the change of its gradient along a tangent of data and loss, where one is given; the view of the state stands
    still, but for the camera's parameters that are data.
    """
    zero = jnp.zeros_like(layout.spread(state.landmarks)[0])
    at = (zero,) * (9 + len(data.free))

    def gradient(parameters: Sequence[Array], data: BundleData, loss: Loss) -> tuple[Array, ...]:
        seen = view(state, data, layout)
        return jax.grad(lambda p: jnp.sum(costs(p, seen, data, loss)))(parameters)

    _, columns = _columns(lambda *parameters: gradient(parameters, data, loss), at)
    change = None
    if tangent is not None:
        _, moved = jax.jvp(lambda *known: gradient(at, *known), (data, loss), tangent)
        change = jnp.stack(moved)
    return jnp.stack([jnp.stack(column) for column in columns]), change


def _cross(a: Sequence[Array], b: Sequence[Array]) -> list[Array]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def retract(state: BundleState, unknowns: Float[Array, " u"], landmarks: Array, layout: BundleLayout) -> BundleState:
    """Move a state along a step."""
    cameras = layout.expand(unknowns)[:, :6]
    return BundleState(
        (SE3.exp(-cameras) @ state.cam_from_world).normalize(),
        state.intrinsics + layout.expand_groups(unknowns),
        state.landmarks + landmarks,
    )


def prior_blocks(state: BundleState, data: BundleData, layout: BundleLayout) -> PriorBlocks:
    """Residuals and derivatives of the priors."""
    priors, dtype = data.priors, state.landmarks.dtype
    zeros = lambda *shape: jnp.zeros(shape, dtype)  # noqa: E731
    cameras, landmarks, intrinsics, by_tangent = zeros(0, 6), zeros(3, 0), zeros(0, 0), zeros(0, 6, 6)
    if priors.cam_from_world is not None and priors.cam_root is not None:
        delta = lambda xi: pose_deviation(xi, state.cam_from_world, priors)  # noqa: E731
        at = jnp.zeros((layout.cameras, 6), dtype)
        cameras, columns = _columns(lambda *xi: delta(jnp.stack(xi, axis=-1)), tuple(at.T))
        by_tangent = jnp.stack(columns, axis=-1)
    if priors.landmarks is not None and priors.landmark_root is not None:
        landmarks = landmark_deviation(state.landmarks, priors, layout)
    if priors.intrinsics is not None and priors.intrinsics_root is not None:
        intrinsics = intrinsics_deviation(state.intrinsics, data)
    return PriorBlocks(cameras, landmarks, intrinsics, by_tangent)


def pose_deviation(xi: Float[Array, "c 6"], cam_from_world: SE3, priors: BundlePriors) -> Float[Array, "c 6"]:
    """Whitened deviation of the poses `exp(−ξ) @ cam_from_world` from their means."""
    assert priors.cam_from_world is not None
    assert priors.cam_root is not None
    delta = (priors.cam_from_world @ (SE3.exp(-xi) @ cam_from_world).inverse()).log()
    return jnp.sum(priors.cam_root * delta[:, None, :], axis=-1)


def landmark_deviation(
    landmarks: Float[Array, "3 l"], priors: BundlePriors, layout: BundleLayout
) -> Float[Array, "3 l"]:
    """Whitened deviation of the landmarks, in the order of the slots; zero for those that are fixed."""
    assert priors.landmarks is not None
    delta = landmarks - priors.landmarks[layout.landmark_order].T
    return jnp.sum(landmark_root(priors, layout) * delta[None], axis=1)


def landmark_root(priors: BundlePriors, layout: BundleLayout) -> Float[Array, "3 3 l"]:
    """Square roots of the landmarks' information, in the order of the slots."""
    assert priors.landmark_root is not None
    return jnp.moveaxis(priors.landmark_root[layout.landmark_order], 0, -1) * layout.landmark_free[None, None]


def intrinsics_deviation(increments: Float[Array, "g m"], data: BundleData) -> Float[Array, "g m"]:
    """Whitened deviation of the free intrinsics."""
    assert data.priors.intrinsics is not None
    assert data.priors.intrinsics_root is not None
    return data.priors.intrinsics_root * (intrinsics_values(increments, data) - data.priors.intrinsics)


def intrinsics_values(increments: Float[Array, "g m"], data: BundleData) -> Float[Array, "g m"]:
    """Values of the free intrinsics of each group, of tied ones the first."""
    groups = increments.shape[:1]
    start = [jnp.broadcast_to(get_attribute(data.camera, tied[0]), groups) for tied in data.free]
    return increments + jnp.stack(start, axis=-1) if start else increments


def zero_like_unknowns(layout: BundleLayout, dtype: np.dtype | type) -> tuple[Array, Array]:
    """A step of length zero: unknowns of the reduced system and moves of the landmarks."""
    return jnp.zeros((layout.unknowns,), dtype), jnp.zeros((3, layout.landmark_order.shape[0]), dtype)
