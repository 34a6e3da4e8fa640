"""Steps that all camera models share."""

import math

import jax.numpy as jnp
import numpy as np

from vojax._numerics import safe_sqrt
from vojax._types import Array, ArrayLike, Float

# Rays beyond atan(100) = 89.4 degrees do not reach the plane z = 1 within this radius: r⁶ stays representable in
# float32.
MAX_RADIUS = 100.0
# Below this squared sine, and in front, angles come from the series.
_SERIES_LIMIT = 0.04
_ARCSINE = [math.comb(2 * k, k) / (4**k * (2 * k + 1)) for k in range(11)]


def as_parameter(value: float | int | np.number | ArrayLike) -> Array:
    """An intrinsic parameter as a strongly typed float array; float arrays keep their dtype."""
    if isinstance(value, float | int):
        return jnp.asarray(value, dtype=jnp.result_type(float))
    array = jnp.asarray(value)
    return array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(jnp.result_type(float))


def epsilon(x: Array) -> float:
    """The rounding of one in the dtype of `x`."""
    return float(jnp.finfo(x.dtype).eps)


def onto_plane(
    x: Float[Array, "*shape"], y: Float[Array, "*shape"], z: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Divide by depth; a depth within rounding of zero counts as that small positive depth.

    So a point on the plane z = 0 goes to a far, finite pixel in its own direction, with bounded gradients whose squares
    do not overflow float32.
    """
    floor = epsilon(z)
    inverse = 1.0 / jnp.where(jnp.abs(z) > floor, z, floor)
    return x * inverse, y * inverse


def bearing_on_plane(
    x: Float[Array, "*shape"], y: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Unit vector through (x, y, 1)."""
    inverse = 1.0 / jnp.sqrt(x * x + y * y + 1.0)
    return x * inverse, y * inverse, inverse


def bearings_on_plane(normalized: Float[Array, "*batch 2"]) -> Float[Array, "*batch 3"]:
    """Unit vectors through points of the plane z = 1."""
    return jnp.stack(bearing_on_plane(normalized[..., 0], normalized[..., 1]), axis=-1)


def onto_cone(
    x: Float[Array, "*shape"], y: Float[Array, "*shape"], z: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """The plane z = 1 of unit vectors, those beyond `MAX_RADIUS` or behind pulled onto that circle."""
    sine = safe_sqrt(x * x + y * y)
    wide = ~(z * MAX_RADIUS > sine)
    inverse = jnp.where(wide, MAX_RADIUS / jnp.maximum(sine, epsilon(z)), 1.0 / jnp.where(wide, 1.0, z))
    return x * inverse, y * inverse


def direction(
    x: Float[Array, "*shape"], y: Float[Array, "*shape"], z: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Scale vectors to unit length; those shorter than rounding only grow by as much as that."""
    floor = epsilon(z)
    squared = x * x + y * y + z * z
    usable = squared > floor * floor
    inverse = jnp.where(usable, 1.0 / jnp.sqrt(jnp.where(usable, squared, 1.0)), 1.0 / floor)
    return x * inverse, y * inverse, z * inverse


def has_direction(x: Float[Array, "*shape"], y: Float[Array, "*shape"], z: Float[Array, "*shape"]) -> Array:
    """Mask of the vectors that `direction` scales to unit length."""
    floor = epsilon(z)
    return x * x + y * y + z * z > floor * floor


def angle_over_sine(sine2: Float[Array, "*shape"], cosine: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """θ / sin θ of the angle θ in [0, π] of a unit vector, smooth on the axis.

    Within the square root of rounding of straight behind, where it is infinite, it is that of the rim of this cone.
    """
    series = (sine2 < _SERIES_LIMIT) & (cosine > 0)
    # Overlapping guards: fused code may evaluate the sine twice with different rounding.
    small = jnp.where((sine2 < 1.1 * _SERIES_LIMIT) & (cosine > 0), sine2, 0.0)
    large = jnp.where((sine2 > 0.9 * _SERIES_LIMIT) | ~(cosine > 0), jnp.maximum(sine2, epsilon(sine2)), 1.0)
    near = jnp.zeros_like(small)
    for coefficient in reversed(_ARCSINE):
        near = coefficient + small * near
    sine = jnp.sqrt(large)
    return jnp.where(series, near, jnp.arctan2(sine, cosine) / sine)


def edge_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root of at least rounding, for terms that vanish at the rim of a domain: its gradient stays bounded."""
    return jnp.sqrt(jnp.maximum(x, epsilon(x)))


def positive(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """A denominator of order one and at least rounding."""
    return jnp.maximum(x, epsilon(x))


def within_radius(
    x: Float[Array, "*shape"], y: Float[Array, "*shape"], inverse_limit2: Float[Array, "..."]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Pull points outside a circle onto it; also their squared radii. The limit is given as 1 / r², none if not > 0."""
    radius2 = x * x + y * y
    outside = radius2 * inverse_limit2 > 1.0
    scale = jnp.where(outside, 1.0 / jnp.sqrt(jnp.where(outside, radius2 * inverse_limit2, 1.0)), 1.0)
    x, y = x * scale, y * scale
    return x, y, x * x + y * y
