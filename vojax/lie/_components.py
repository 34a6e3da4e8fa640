"""Small vectors and matrices as tuples of components, so that a batch of any shape flows through elementwise.

A component is an array of batch shape; a vector is a tuple of components and a matrix a tuple of rows.
"""

import jax.numpy as jnp

from vojax._numerics import Vector3, cross3, dot3
from vojax._types import Array, ArrayLike

Row = tuple[Array | float, ...]
Matrix = tuple[Row, ...]


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


def bounded_rotation(phi: Array) -> tuple[Array, ...]:
    """Components of a rotation vector, clipped to ±1/eps radians: beyond, neighbouring floats are a radian apart."""
    limit = 1.0 / float(jnp.finfo(phi.dtype).eps)
    return split(jnp.clip(phi, -limit, limit))


def align(*arrays: Array) -> tuple[Array, ...]:
    """Give all arrays the same rank by leading axes of size one, which rank promotion would do silently."""
    rank = max(array.ndim for array in arrays)
    return tuple(array.reshape((1,) * (rank - array.ndim) + array.shape) for array in arrays)


def split(vector: Array) -> tuple[Array, ...]:
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


def stack_matrix(matrix: Matrix) -> Array:
    """Rows of components to one array `[*batch, rows, columns]`."""
    flat = stack(*(entry for row in matrix for entry in row))
    return flat.reshape((*flat.shape[:-1], len(matrix), len(matrix[0])))


def split_matrix(matrix: Array) -> tuple[tuple[Array, ...], ...]:
    """Components of the last two axes."""
    return tuple(tuple(matrix[..., i, j] for j in range(matrix.shape[-1])) for i in range(matrix.shape[-2]))


def hat(v: Vector3) -> Matrix:
    """Skew-symmetric matrix with `hat(v) p = v × p`."""
    x, y, z = v
    return ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))


def matmul(a: Matrix, b: Matrix) -> Matrix:
    """Matrix product of components."""
    columns = range(len(b[0]))
    return tuple(tuple(sum(a[i][k] * b[k][j] for k in range(len(b))) for j in columns) for i in range(len(a)))


def polynomial_in_hat(a: Array | float, b: Array, c: Array, phi: Vector3) -> Matrix:
    """Matrix `a I + b φ^ + c φ^²`, by φ^² = φφᵀ − |φ|² I."""
    x, y, z = phi
    bx, by, bz = b * x, b * y, b * z
    cxy, cxz, cyz = c * x * y, c * x * z, c * y * z
    return (
        (a - c * (y * y + z * z), cxy - bz, cxz + by),
        (cxy + bz, a - c * (x * x + z * z), cyz - bx),
        (cxz - by, cyz + bx, a - c * (x * x + y * y)),
    )


def polynomial_in_hat_times(a: Array | float, b: Array, c: Array, phi: Vector3, v: Vector3) -> Vector3:
    """Product of `a I + b φ^ + c φ^²` with a vector."""
    first = cross3(phi, v)
    second = cross3(phi, first)
    return tuple(a * v[i] + b * first[i] + c * second[i] for i in range(3))  # type: ignore[return-value]


def squared_norm(v: Vector3) -> Array:
    """Sum of squares of the components."""
    return dot3(v, v)
