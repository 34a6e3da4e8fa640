"""Steps that all camera models share."""

import jax.numpy as jnp
import numpy as np

from vojax._types import Array, ArrayLike, Float


def as_parameter(value: float | int | np.number | ArrayLike) -> Array:
    """An intrinsic parameter as a strongly typed float array; float arrays keep their dtype."""
    if isinstance(value, float | int):
        return jnp.asarray(value, dtype=jnp.result_type(float))
    array = jnp.asarray(value)
    return array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(jnp.result_type(float))


def onto_plane(
    x: Float[Array, "*shape"], y: Float[Array, "*shape"], z: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Divide by depth; a depth within rounding of zero counts as that small positive depth.

    So a point on the plane z = 0 goes to a far, finite pixel in its own direction, with bounded gradients whose squares
    do not overflow float32.
    """
    floor = float(jnp.finfo(z.dtype).eps)
    inverse = 1.0 / jnp.where(jnp.abs(z) > floor, z, floor)
    return x * inverse, y * inverse


def bearings_on_plane(normalized: Float[Array, "*batch 2"]) -> Float[Array, "*batch 3"]:
    """Unit vectors through points of the plane z = 1."""
    x, y = normalized[..., 0], normalized[..., 1]
    inverse = 1.0 / jnp.sqrt(x * x + y * y + 1.0)
    return jnp.stack([x * inverse, y * inverse, inverse], axis=-1)
