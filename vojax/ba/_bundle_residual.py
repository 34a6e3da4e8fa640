"""Residuals of a bundle, their Jacobian blocks and their exact Hessian blocks, one observation a lane.

Every observation touches one chain of poses, the intrinsics of one group and one landmark, so one product with a
tangent of ones for each of their parameters gives all blocks exactly.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, Float
from vojax.lie import SE3

from ._bundle_layout import BundleLayout
from ._bundle_priors import PriorBlocks, prior_blocks
from ._bundle_state import BundleData, BundleState, View, project, view
from ._intrinsics import add_to_camera
from ._losses import Loss, Squared, robustify
from ._whitening import whiten


class Blocks(eqx.Module):
    """Robustified residuals and their derivatives; `factors` are residuals and derivatives of the pose factors."""

    residual: Float[Array, "d s"]
    by_camera: Float[Array, "d k s"]
    by_landmark: Float[Array, "d 3 s"]
    priors: PriorBlocks
    factors: tuple[tuple[Array, Array], ...]

    @property
    def residuals(self) -> tuple[Array, ...]:
        """All residuals, as `residual` gives them."""
        return *self.residual, *self.priors.residuals, *(value for value, _ in self.factors)


def _white(raw: Sequence[Array], data: BundleData) -> tuple[Array, ...]:
    return whiten(data.whitening, tuple(raw))


def _raw_at_points(
    point: Sequence[Array], w: Array | None, theta: Sequence[Array], seen: View, data: BundleData
) -> list[Array]:
    camera = add_to_camera(seen.camera, data.free, theta) if len(theta) else seen.camera
    return [a - b for a, b in zip(project(camera, point, w), data.measured, strict=True)]


def _raw_of_user(
    xi: Sequence[Array], eta: Sequence[Array], theta: Sequence[Array], seen: View, data: BundleData
) -> list[Array]:
    """The user's residual of one camera and one landmark, mapped over the slots."""
    shape = seen.landmark[0].shape
    camera = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, shape), seen.camera)
    basis = None if seen.basis is None else jnp.stack([jnp.stack(column, -1) for column in seen.basis], -1)

    def one(
        poses: tuple[SE3, ...],
        xi: Array,
        landmark: Array,
        basis: Array | None,
        eta: Array,
        camera: Any,
        theta: Array,
        measured: Array,
    ) -> Array:
        chain = [SE3.exp(-part) @ pose for part, pose in zip(xi.reshape(-1, 6), poses, strict=True)]
        moved = chain[0] if len(chain) == 1 else chain[1] @ chain[0]
        landmark = landmark + eta if basis is None else landmark + jnp.sum(basis * eta[None], axis=1)
        return data.residual(moved, landmark, add_to_camera(camera, data.free, list(theta)), measured)  # type: ignore[misc]

    stack = lambda parts: jnp.stack(parts, -1) if len(parts) else jnp.zeros((*shape, 0), data.weight.dtype)  # noqa: E731
    columns = jax.vmap(one)(
        seen.groups, stack(xi), stack(seen.landmark), basis, stack(eta), camera, stack(theta), stack(data.measured)
    )
    return [columns[:, i] for i in range(columns.shape[1])]


def residual(state: BundleState, data: BundleData, loss: Loss, layout: BundleLayout) -> tuple[Array, ...]:
    """All residuals: whitened, robustified components by slots, priors, factors; ½‖·‖² is the cost."""
    factors = (factor.at(state.poses) for factor in data.factors)
    return *observation_residual(state, data, loss, layout), *prior_blocks(state, data, layout).residuals, *factors


def observation_residual(state: BundleState, data: BundleData, loss: Loss, layout: BundleLayout) -> tuple[Array, ...]:
    """Whitened, robustified residual components by slots."""
    seen = view(state, data, layout)
    if data.residual is None:
        raw = _raw_at_points(seen.chain()[-1], seen.w, (), seen, data)
    else:
        zero = jnp.zeros_like(seen.landmark[0])
        raw = _raw_of_user((zero,) * 6 * len(seen.motions), (zero,) * 3, (zero,) * len(data.free), seen, data)
    return robustify(_white(raw, data), loss, data.weight)


def linearize(state: BundleState, data: BundleData, loss: Loss, layout: BundleLayout) -> Blocks:
    """Residuals with the blocks of their Jacobian."""
    seen = view(state, data, layout)
    zero = jnp.zeros_like(seen.landmark[0])
    m, size = len(data.free), 6 * len(seen.motions)
    finish = lambda raw: robustify(_white(raw, data), loss, data.weight)  # noqa: E731
    if data.residual is None:
        chain = seen.chain()
        end = chain[-1] if seen.w is None else (*chain[-1], seen.w)
        components, columns = _columns(
            lambda *a: finish(_raw_at_points(a[:3], a[3] if seen.w is not None else None, a[len(end) :], seen, data)),
            (*end, *(zero,) * m),
        )
        rows = [_rows([column[i] for column in columns[: len(end)]], seen, chain) for i in range(len(components))]
        by_camera = [
            jnp.stack([*poses, *(column[i] for column in columns[len(end) :])]) for i, (poses, _) in enumerate(rows)
        ]
        by_landmark = [jnp.stack(row) for _, row in rows]
    else:
        components, columns = _columns(
            lambda *a: finish(_raw_of_user(a[:size], a[size + m :], a[size : size + m], seen, data)),
            (zero,) * (size + m + 3),
        )
        by_camera = [jnp.stack([column[i] for column in columns[: size + m]]) for i in range(len(components))]
        by_landmark = [jnp.stack([column[i] for column in columns[size + m :]]) for i in range(len(components))]
    factors = tuple(factor.linearize(state.poses) for factor in data.factors)
    priors = prior_blocks(state, data, layout)
    return Blocks(jnp.stack(components), jnp.stack(by_camera), jnp.stack(by_landmark), priors, factors)


def _rows(
    by_point: Sequence[Array], seen: View, chain: Sequence[Sequence[Array]]
) -> tuple[list[Array], Sequence[Array]]:
    """Derivatives by the tangents of the chain's poses and by the landmark's, from those by the point it ends in.

    exp(−ξ) moves (X, w) by (−w ρ + X × φ, 0), so the row by φ is (a, b, c) × X; a point moves the next one by R.
    """
    row, by_w = tuple(by_point[:3]), by_point[3] if seen.w is not None else None
    poses: list[Array] = []
    for motion, point in zip(seen.motions[::-1], chain[::-1], strict=True):
        shift = [-a for a in row] if seen.w is None else [-a * seen.w for a in row]
        poses = [*shift, *_cross(row, point), *poses]
        if by_w is not None:
            by_w = by_w + sum(a * t for a, t in zip(row, motion.translation, strict=True))
        row = motion.pull(row)
    if seen.basis is None or by_w is None:
        return poses, row
    return poses, [sum((a * b for a, b in zip(row, column, strict=False)), by_w * column[3]) for column in seen.basis]


def _columns(function: Callable[..., Any], at: Sequence[Array]) -> tuple[Any, list[Any]]:
    """Value and derivatives by each argument alone: arguments that stand still cost nothing."""
    columns, value = [], None
    for i in range(len(at)):
        along = lambda v, i=i: function(*at[:i], v, *at[i + 1 :])  # noqa: E731
        value, column = jax.jvp(along, (at[i],), (jnp.ones_like(at[i]),))
        columns.append(column)
    return value, columns


def costs(parameters: Sequence[Array], seen: View, data: BundleData, loss: Loss) -> Array:
    """½wρ of every slot, as a function of its own copies of (ξ, θ, η), right to second order at zero."""
    m, size = len(data.free), 6 * len(seen.motions)
    xi, theta, eta = parameters[:size], parameters[size : size + m], parameters[size + m :]
    if data.residual is None:
        point, w = _moved_landmark(seen, eta)
        for i, motion in enumerate(seen.motions):
            point = motion.apply(point, w)
            rho, phi = xi[6 * i : 6 * i + 3], xi[6 * i + 3 : 6 * i + 6]
            # exp(−ξ) X = X − (ρ + φ × X) + ½ φ × (ρ + φ × X) + O(ξ³).
            rho = rho if w is None else [w * part for part in rho]
            velocity = [r + c for r, c in zip(rho, _cross(phi, point), strict=True)]
            point = [p - v + 0.5 * b for p, v, b in zip(point, velocity, _cross(phi, velocity), strict=True)]
        raw = _raw_at_points(point, w, theta, seen, data)
    else:
        raw = _raw_of_user(xi, eta, theta, seen, data)
    white = _white(raw, data)
    s = sum((component * component for component in white), jnp.zeros_like(data.weight))
    return 0.5 * data.weight * (s if isinstance(loss, Squared) else loss.rho(s))


def _moved_landmark(seen: View, eta: Sequence[Array]) -> tuple[Sequence[Array], Array | None]:
    if seen.basis is None:
        return [p + e for p, e in zip(seen.landmark, eta, strict=True)], None
    moved = [
        p + sum(column[j] * e for column, e in zip(seen.basis, eta, strict=True)) for j, p in enumerate(seen.landmark)
    ]
    return moved[:3], moved[3]


def gradient_and_hessian(
    state: BundleState, data: BundleData, loss: Loss, layout: BundleLayout, tangent: tuple[BundleData, Loss] | None
) -> tuple[Float[Array, "n n s"], Float[Array, "n s"] | None]:
    """Exact Hessian of each slot's cost in its camera's and its landmark's parameters, k + 3 of them.

    Also the change of its gradient along a tangent of data and loss, where one is given; the view of the state stands
    still, but for the camera's parameters that are data.
    """
    zero = jnp.zeros_like(layout.spread(state.landmarks)[0])
    at = (zero,) * (layout.columns.shape[1] + 3)

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
