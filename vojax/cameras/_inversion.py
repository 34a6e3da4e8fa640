"""Inverting lenses: increasing functions of one variable, their end, and the derivative of their inverse."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

from vojax._types import Array, Float

Data = TypeVar("Data")

# Samples of a range in which a sign change is looked for, and how often the interval is divided by as many again.
_SAMPLES = 64
_ROUNDS = 3
# Below this slope an inverse counts as lost.
_MIN_SLOPE = 1e-3


def first_sign_change(
    function: Callable[[Array], Array], upper: float, shape: tuple[int, ...], dtype: jnp.dtype
) -> Float[Array, "*shape"]:
    """The end of the range [0, x] on which a function is positive, within upper / 64³ and from below.

    Two sign changes within upper / 64 are not seen.

    Args:
        function: Of arrays `[*shape]`, elementwise.
        upper: End of the search, and the answer where there is no sign change.
        shape: That of the function's parameters.
        dtype: Of the answer.
    """
    steps = (jnp.arange(1, _SAMPLES + 1, dtype=dtype) / _SAMPLES).reshape(-1, *(1 for _ in shape))
    lower, width = jnp.zeros(shape, dtype), jnp.full(shape, upper, dtype)
    for _ in range(_ROUNDS):
        changed = ~(jax.vmap(function)(lower[None] + width[None] * steps) > 0)
        first = jnp.where(jnp.any(changed, axis=0), jnp.argmax(changed, axis=0), _SAMPLES)
        lower, width = lower + width * first / _SAMPLES, width / _SAMPLES
        # Past the end there is nothing left to divide.
        width = jnp.where(lower >= upper, 0.0, width)
    return lower


def bracketed_newton(
    function: Callable[[Array], Array],
    lower: Float[Array, "*shape"],
    upper: Float[Array, "*shape"],
    start: Float[Array, "*shape"],
    steps: int,
) -> Float[Array, "*shape"]:
    """Find the zero of an increasing function between two bounds, elementwise, in a fixed number of steps.

    A Newton step that leaves the interval that must hold the zero is replaced by halving it. A function without a zero
    between the bounds ends at the nearer one.
    """

    def step(_, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, lower, upper = state
        value, slope = jax.jvp(function, (x,), (jnp.ones_like(x),))
        lower, upper = jnp.where(value < 0, x, lower), jnp.where(value < 0, upper, x)
        usable = slope > 0
        newton = x - value / jnp.where(usable, slope, 1.0)
        inside = usable & (newton >= lower) & (newton <= upper)
        return jnp.where(inside, newton, 0.5 * (lower + upper)), lower, upper

    state = (jnp.clip(start, lower, upper), lower, upper)
    return jax.lax.fori_loop(0, steps, step, state)[0]


def implicit_root(residual: Callable[[Array, Data], Array], solve: Callable[[Data], Array]) -> Callable[[Data], Array]:
    """Give the solution x(data) of residual(x, data) = 0, elementwise, its derivative; of any order and in both modes.

    The derivative is zero where the residual is not (nothing solves it) and where its slope is lost.

    Args:
        residual: Of order one, with a slope of order one in x.
        solve: Finds x; never differentiated.
    """

    @jax.custom_jvp
    def root(data: Data) -> Array:
        return solve(data)

    @root.defjvp
    def _(primals: tuple[Data], tangents: tuple[Data]) -> tuple[Array, Array]:
        (data,), (data_tangent,) = primals, tangents
        x = root(data)
        value, slope = jax.jvp(lambda x: residual(x, data), (x,), (jnp.ones_like(x),))
        moved = jax.jvp(lambda data: residual(x, data), (data,), (data_tangent,))[1]
        regular = (jnp.abs(value) < 1e-3) & (jnp.abs(slope) > _MIN_SLOPE)
        return x, jnp.where(regular, -moved / jnp.where(regular, slope, 1.0), 0.0)

    return root
