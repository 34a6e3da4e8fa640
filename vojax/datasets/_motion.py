"""The path of a virtual robot."""

import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, PRNGKeyArray
from vojax.lie import SE3

Motion = Literal["forward", "turning", "sideways", "random"]
Scalar = float | ArrayLike


def float_dtype(dtype: Any) -> Any:
    """The type asked for, or JAX's default."""
    return jnp.zeros(()).dtype if dtype is None else jnp.dtype(dtype)


@functools.partial(jax.jit, static_argnames=("frames", "motion", "dtype"))
def motion_profile(
    frames: int,
    *,
    key: PRNGKeyArray,
    motion: Motion = "turning",
    step: Scalar = 1.0,
    dtype: Any = None,
) -> SE3:
    """Drive a virtual robot for a number of frames.

    The motion is made of velocities in the camera's own frame (+z forward, +y down), so consecutive poses differ by
    about `step` whatever the path looks like from above.

    Args:
        frames: Number of poses, at least 1.
        key: Fixes the phase of the wobble, and the whole path of `"random"`.
        motion: `"forward"` (straight on, with a gentle sway and heave), `"turning"` (the same with bends of up to 4° a
            frame), `"sideways"` (along +x) or `"random"` (independent steps in all six degrees of freedom).
        step: Distance between consecutive positions, metres.
        dtype: Floating type; JAX's default where it is None.

    Returns:
        Poses `world_from_cam` with a leading frame axis; the first is the identity.

    Raises:
        ValueError: fewer than one frame, or a motion of another name.

    Example:
        >>> import jax
        >>> motion_profile(5, key=jax.random.key(0)).wxyz_xyz.shape
        (5, 7)
    """
    if frames < 1:
        raise ValueError(f"frames is {frames}; a path needs at least 1")
    if motion not in ("forward", "turning", "sideways", "random"):
        raise ValueError(f"motion is {motion!r}; expected 'forward', 'turning', 'sideways' or 'random'")
    dtype = float_dtype(dtype)
    phase_key, step_key = jax.random.split(key)
    if motion == "random":
        velocity = jax.random.normal(step_key, (frames - 1, 6), dtype)
        velocity = velocity * _columns([0.58 * step] * 3 + [0.05] * 3, dtype)
    else:
        phase = 2 * jnp.pi * jax.random.uniform(phase_key, (1, 6), dtype)
        period = jnp.array([[9.0, 7.0, 23.0, 11.0, 17.0, 13.0]], dtype)
        angle = 2 * jnp.pi * jnp.arange(frames - 1, dtype=dtype)[:, None] / period + phase
        amplitude = _columns([0.02 * step, 0.02 * step, 0.1 * step, 0.004, 0.004, 0.004], dtype)
        velocity = amplitude * jnp.sin(angle)
        along = 0 if motion == "sideways" else 2
        velocity = velocity.at[:, along].add(step)
        if motion == "turning":
            # Squared, so that straight stretches lie between the bends; the sign alternates.
            bend = jnp.sin(2 * jnp.pi * jnp.arange(frames - 1, dtype=dtype) / 60 + phase[0, 4])
            velocity = velocity.at[:, 4].add(0.07 * bend * jnp.abs(bend))

    def move(pose: SE3, tangent: Array) -> tuple[SE3, SE3]:
        pose = (pose @ SE3.exp(tangent)).normalize()
        return pose, pose

    first = SE3.identity(dtype=dtype)
    _, later = jax.lax.scan(move, first, velocity)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, later)


def _columns(values: list, dtype: Any) -> Array:
    return jnp.stack([jnp.asarray(value, dtype) for value in values])[None]
