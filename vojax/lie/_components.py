"""Small vectors as tuples of components and small matrices as sums of outer products: elementwise over any batch.

A component is an array of batch shape. Matrices keep their two axes: as nine or more separate components they compiled
three to ten times slower, without running faster.
"""

import jax.numpy as jnp

from vojax._numerics import Vector3, cross3, dot3
from vojax._types import Array, ArrayLike


def as_floating(x: ArrayLike | float | list | tuple, *trailing: int) -> Array:
    """Device array of a floating type; integers become the default float.

    Raises:
        ValueError: If the last axes do not have the sizes `trailing`.
    """
    array = jnp.asarray(x)
    if array.shape[max(array.ndim - len(trailing), 0) :] != trailing:
        expected = ", ".join(["...", *map(str, trailing)])
        raise ValueError(f"found an array of shape {array.shape}; expected [{expected}]: check the last axes")
    return array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(jnp.zeros(()).dtype)


def bounded_rotation(phi: Array) -> Array:
    """Rotation vector clipped to ±1/eps radians: beyond, neighbouring floats are a radian apart."""
    limit = 1.0 / float(jnp.finfo(phi.dtype).eps)
    return jnp.clip(phi, -limit, limit)


def align(*arrays: Array) -> tuple[Array, ...]:
    """Give all arrays the same rank by leading axes of size one, which rank promotion would do silently."""
    rank = max(array.ndim for array in arrays)
    return tuple(array.reshape((1,) * (rank - array.ndim) + array.shape) for array in arrays)


def split(vector: Array) -> tuple:
    """Components along the last axis."""
    return tuple(vector[..., i] for i in range(vector.shape[-1]))


def stack(*components: Array | float) -> Array:
    """Components to one array with a new last axis; their shapes are broadcast, the result keeps their dtype."""
    dtype = jnp.result_type(*components)
    shape = jnp.broadcast_shapes(*(jnp.shape(component) for component in components))
    return jnp.stack([jnp.broadcast_to(jnp.asarray(component, dtype), shape) for component in components], axis=-1)


def join(*vectors: Array) -> Array:
    """Concatenation along the last axis; leading axes broadcast."""
    vectors = align(*vectors)
    shape = jnp.broadcast_shapes(*(vector.shape[:-1] for vector in vectors))
    return jnp.concatenate([jnp.broadcast_to(vector, (*shape, vector.shape[-1])) for vector in vectors], axis=-1)


def split_matrix(matrix: Array) -> tuple[tuple[Array, ...], ...]:
    """Components of the last two axes."""
    return tuple(tuple(matrix[..., i, j] for j in range(matrix.shape[-1])) for i in range(matrix.shape[-2]))


def hat(v: Array) -> Array:
    """Skew-symmetric matrix `[..., 3, 3]` with `hat(v) p = v × p`."""
    x, y, z = split(v)
    zero = jnp.zeros_like(x)
    flat = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1)
    return flat.reshape((*v.shape[:-1], 3, 3))


def outer(a: Array, b: Array) -> Array:
    """Matrix a bᵀ over the last axes."""
    return a[..., :, None] * b[..., None, :]


def eye_times(a: Array) -> Array:
    """Matrix a I, 3x3."""
    return a[..., None, None] * jnp.eye(3, dtype=a.dtype).reshape((1,) * a.ndim + (3, 3))


def matmul(a: Array, b: Array) -> Array:
    """Product of 3x3 matrices as three sums of outer products, which stay elementwise over the batch."""
    return sum((outer(a[..., :, k], b[..., k, :]) for k in range(1, 3)), outer(a[..., :, 0], b[..., 0, :]))


def polynomial_in_hat(a: Array, b: Array, c: Array, phi: Array) -> Array:
    """Matrix `a I + b φ^ + c φ^²`, by φ^² = φφᵀ − |φ|² I."""
    u = squared_norm(split(phi))
    return eye_times(a - c * u) + hat(b[..., None] * phi) + outer(c[..., None] * phi, phi)


def blocks(rows: list[list[Array]]) -> Array:
    """Matrix from its blocks; they share their leading axes."""
    return jnp.concatenate([jnp.concatenate(row, axis=-1) for row in rows], axis=-2)


def polynomial_in_hat_times(a: Array, b: Array, c: Array, phi: Array, vector: Array) -> Array:
    """Product of `a I + b φ^ + c φ^²` with a vector."""
    axis, v = split(phi), split(vector)
    first = cross3(axis, v)
    second = cross3(axis, first)
    return stack(*(a * v[i] + b * first[i] + c * second[i] for i in range(3)))


def squared_norm(v: Vector3) -> Array:
    """Sum of squares of the components."""
    return dot3(v, v)


def homogeneous(linear: Array, translation: Array) -> Array:
    """Matrix [[linear, translation], [0, 1]]."""
    last = jnp.broadcast_to(
        jnp.asarray([0.0, 0.0, 0.0, 1.0], linear.dtype).reshape((1,) * (linear.ndim - 1) + (4,)),
        (*linear.shape[:-2], 1, 4),
    )
    return jnp.concatenate([jnp.concatenate([linear, translation[..., None]], axis=-1), last], axis=-2)
