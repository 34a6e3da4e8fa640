"""Interpolation between two group elements and concatenation of a chain of them."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from vojax._types import ArrayLike, Float

from ._components import align, as_floating
from ._se3 import SE3
from ._sim3 import Sim3
from ._so3 import SO3

Group = TypeVar("Group", SO3, SE3, Sim3)


def interpolate(T0: Group, T1: Group, alpha: Float[ArrayLike, "*batch"] | float) -> Group:
    """Point at parameter `alpha` of the geodesic from `T0` to `T1`: `T0 @ exp(alpha · log(T0⁻¹ T1))`.

    Args:
        T0: Element at `alpha` = 0.
        T1: Element at `alpha` = 1, of the same group.
        alpha: Parameter; outside [0, 1] the motion is continued. Leading axes of all three broadcast.

    Degenerate input: equal ends give that element; ends half a turn apart take one of the two shortest ways.
    Differentiability: both modes in all arguments, also where `T0` equals `T1`.
    """
    tangent, weight = align(T0.inverse().multiply(T1).log(), as_floating(alpha)[..., None])
    kind: Any = type(T0)  # the constrained type variable does not reach through type()
    return T0.multiply(kind.exp(weight * tangent))


def cumulative_compose(increments: Group, start: Group | None = None, *, include_start: bool = False) -> Group:
    """Concatenate motions, `C_k = C_{k−1} T_k`, in logarithmic depth.

    Args:
        increments: Motions T_1 … T_n along the first leading axis; for a trajectory of `world_from_cam` poses these are
            `cam{k−1}_from_cam{k}`.
        start: C_0, without the axis of n; the identity by default.
        include_start: Whether the result begins with C_0.

    Returns:
        C_1 … C_n along the first leading axis (C_0 … C_n with `include_start`). Quaternions are renormalised on the
        way, so float32 chains of any length stay rotations.

    Raises:
        ValueError: If `increments` has no leading axis.
    """
    batch_axes = increments.get_batch_axes()
    if not batch_axes:
        raise ValueError("increments has no leading axis; expected parameters of shape [n, ..., k]: stack the motions")
    kind: Any = type(increments)
    first = kind.identity(batch_axes[1:], increments.parameters().dtype) if start is None else start
    chain = jax.lax.associative_scan(lambda left, right: left.multiply(right).normalize(), increments)
    poses: Any = chain if start is None else start.multiply(chain).normalize()
    if not include_start:
        return poses
    head = jnp.broadcast_to(first.parameters()[None], (1, *poses.parameters().shape[1:]))
    return kind(jnp.concatenate([head, poses.parameters()]))
