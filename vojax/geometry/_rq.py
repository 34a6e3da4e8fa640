"""A matrix as calibration times rotation, and a projection matrix as a camera.

M = K R with K upper triangular: the last row of M is k33 r3, its vector product with the row above points along r1, and
r2 completes the frame. What is left is K = M Rᵀ.

References: R. Hartley, A. Zisserman. Multiple View Geometry, sections 6.2.4 and A4.1.1.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import Vector3, cross3, dot3, safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SE3, SO3

Rows = tuple[Vector3, Vector3, Vector3]


def rq_components(m: Rows) -> tuple[tuple[Array, ...], Rows, Array, Array]:
    """RQ decomposition by components: arrays of any one shape in and out.

    Args:
        m: Rows of the matrix.

    Returns:
        (k11, k12, k13, k22, k23, k33) with a positive diagonal; the rows of the rotation; the sign of det M; and False
        where the matrix is singular to rounding or not finite. The product is sign · M.
    """
    size = jnp.zeros_like(m[0][0])
    for row in m:
        for entry in row:
            size = size + jnp.abs(entry)
    regular = jnp.isfinite(size) & (size > 0)
    # Held fixed: the result does not depend on it, and its derivative could overflow.
    scale = jax.lax.stop_gradient(jnp.where(regular, size, 1.0))
    m0, m1, m2 = (tuple(jnp.where(regular, entry / scale, 0.0) for entry in row) for row in m)
    eps = float(jnp.finfo(size.dtype).eps)
    length2, length3 = safe_sqrt(dot3(m1, m1)), safe_sqrt(dot3(m2, m2))
    normal = cross3(m1, m2)
    area = safe_sqrt(dot3(normal, normal))
    volume = dot3(m0, normal)
    sign = jnp.where(volume < 0, -1.0, 1.0).astype(size.dtype)
    # Rows to the length that rounding leaves of them: parallel ones and a first row in the plane of the others.
    regular = regular & (length3 > 0) & (area > 8.0 * eps * length2 * length3)
    length1 = safe_sqrt(dot3(m0, m0))
    regular = regular & (jnp.abs(volume) > 8.0 * eps * length1 * area)
    identity = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    r3 = tuple(
        jnp.where(regular, sign * c / jnp.where(regular, length3, 1.0), e) for c, e in zip(m2, identity[2], strict=True)
    )
    r1 = tuple(
        jnp.where(regular, c / jnp.where(regular, area, 1.0), e) for c, e in zip(normal, identity[0], strict=True)
    )
    r2 = cross3(r3, r1)
    upper = (dot3(m0, r1), dot3(m0, r2), dot3(m0, r3), dot3(m1, r2), dot3(m1, r3), dot3(m2, r3))
    placeholder = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    upper = tuple(jnp.where(regular, sign * scale * c, e) for c, e in zip(upper, placeholder, strict=True))
    return upper, (r1, r2, r3), sign, regular


def rq_decompose(matrix: Float[ArrayLike, "3 3"]) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
    """Write a matrix as an upper triangular one with positive diagonal times a rotation.

    Args:
        matrix: A regular matrix. Where its determinant is negative, -matrix is decomposed: projection matrices have no
            sign, and with a positive diagonal only a reflection could have it.

    Returns:
        The upper triangular factor and the rotation (determinant +1).

    Degenerate input: a matrix that is singular to rounding or not finite gives two identities.

    Differentiability: both modes, any order; zero where it is degenerate.

    References: see the module.

    Example:
        >>> upper, rotation = rq_decompose(jnp.array([[2.0, 3.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
        >>> bool(jnp.allclose(upper @ rotation, jnp.array([[2.0, 3.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, -1.0]])))
        True
        >>> [float(entry) for entry in jnp.diagonal(upper)]
        [3.0, 4.0, 1.0]
    """
    matrix = jnp.asarray(matrix)
    upper, rows, _, _ = _decomposed(matrix)
    return triangle(upper), jnp.stack([jnp.stack(row) for row in rows])


def camera_from_projection(projection: Float[ArrayLike, "3 4"]) -> tuple[Float[Array, "3 3"], SE3]:
    """Take a projection matrix K [R | t], at any scale and sign, apart.

    Args:
        projection: The matrix, from homogeneous world coordinates to homogeneous pixels.

    Returns:
        The calibration matrix K (upper triangular, positive diagonal, last entry 1) and the pose `cam_from_world`.

    Degenerate input: an affine camera, any other whose left 3x3 block is singular to rounding, and entries that are not
        finite give the identity for both.

    Differentiability: both modes, any order; zero where it is degenerate.

    References: see the module.

    Example:
        >>> calibration = jnp.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
        >>> pose = SE3(jnp.array([0.8, 0.6, 0.0, 0.0, 1.0, 2.0, 3.0]))
        >>> found, cam_from_world = camera_from_projection(-2.0 * calibration @ pose.as_matrix()[:3])
        >>> bool(jnp.allclose(found, calibration, rtol=1e-4, atol=1e-2))
        True
        >>> bool(jnp.allclose(cam_from_world.parameters(), pose.parameters(), atol=1e-4))
        True
    """
    projection = jnp.asarray(projection)
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(projection)))
    usable = jnp.isfinite(size) & (size > 0)
    projection = jnp.where(usable, projection / jnp.where(usable, size, 1.0), 0.0)
    upper, rows, sign, regular = _decomposed(projection[:, :3])
    k33 = upper[5]
    k11, k12, k13, k22, k23, _ = (entry / k33 for entry in upper)
    x, y, z = (jnp.where(regular, sign * projection[i, 3] / k33, 0.0) for i in range(3))
    y = (y - k23 * z) / k22
    x = (x - k12 * y - k13 * z) / k11
    rotation = SO3.from_matrix(jnp.stack([jnp.stack(row) for row in rows]))
    pose = SE3.from_rotation_and_translation(rotation, jnp.stack([x, y, z]))
    return triangle((k11, k12, k13, k22, k23, jnp.ones_like(k33))), pose


def triangle(upper: tuple[Array, ...]) -> Float[Array, "3 3 *lanes"]:
    """The matrix of (k11, k12, k13, k22, k23, k33)."""
    k11, k12, k13, k22, k23, k33 = upper
    zero = jnp.zeros_like(k11)
    return jnp.stack([jnp.stack([k11, k12, k13]), jnp.stack([zero, k22, k23]), jnp.stack([zero, zero, k33])])


def _decomposed(matrix: Array) -> tuple[tuple[Array, ...], Rows, Array, Bool[Array, ""]]:
    return rq_components(
        (
            (matrix[0, 0], matrix[0, 1], matrix[0, 2]),
            (matrix[1, 0], matrix[1, 1], matrix[1, 2]),
            (matrix[2, 0], matrix[2, 1], matrix[2, 2]),
        )
    )
