"""Vectors, quaternions and rotations by components: arrays of any one shape in and out."""

from collections.abc import Sequence

import jax.numpy as jnp

from vojax._numerics import Vector3, cross3, dot3
from vojax._numerics import complement as complement
from vojax._types import Array

Components = tuple[Array, ...]
Rows3 = tuple[Vector3, Vector3, Vector3]


def vector3(x: Array) -> Vector3:
    """Components along the first axis of an array [3, *lanes]."""
    return (x[0], x[1], x[2])


def difference(a: Vector3, b: Vector3) -> Vector3:
    """Vector a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def squared(a: Vector3) -> Array:
    """Squared length."""
    return dot3(a, a)


def sign(x: Array) -> Array:
    """Sign that is +1 at zero."""
    return jnp.where(x < 0, -1.0, 1.0).astype(x.dtype)


def floor(x: Array) -> float:
    """Smallest magnitude whose fourth power is a normal number of the dtype."""
    return float(jnp.finfo(x.dtype).tiny) ** 0.25


def rotate(wxyz: Components, x: Vector3) -> Vector3:
    """Rotate a vector by a unit quaternion."""
    axis = (wxyz[1], wxyz[2], wxyz[3])
    c = cross3(axis, x)
    c = (2.0 * c[0], 2.0 * c[1], 2.0 * c[2])
    s = cross3(axis, c)
    return (x[0] + wxyz[0] * c[0] + s[0], x[1] + wxyz[0] * c[1] + s[1], x[2] + wxyz[0] * c[2] + s[2])


def quaternion_from_rotation(rotation: Sequence[Sequence[Array]]) -> Components:
    """Unit quaternion (w, x, y, z) of a matrix that is a rotation up to rounding.

    References: S. Shepperd. Quaternion from rotation matrix. JGCD 1978.
    """
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rotation
    # The columns of 4 q qᵀ; the one with the largest diagonal entry can be normalised without loss.
    wx, wy, wz = r21 - r12, r02 - r20, r10 - r01
    xy, xz, yz = r01 + r10, r02 + r20, r12 + r21
    ww, xx, yy, zz = 1.0 + r00 + r11 + r22, 1.0 + r00 - r11 - r22, 1.0 - r00 + r11 - r22, 1.0 - r00 - r11 + r22
    w_first, y_first = ww > xx, yy > zz
    outer = jnp.where(w_first, ww, xx) > jnp.where(y_first, yy, zz)
    q = tuple(
        jnp.where(outer, jnp.where(w_first, of_w, of_x), jnp.where(y_first, of_y, of_z))
        for of_w, of_x, of_y, of_z in ((ww, wx, wy, wz), (wx, xx, xy, xz), (wy, xy, yy, yz), (wz, xz, yz, zz))
    )
    # Quotients, not products with a reciprocal: XLA keeps a quotient instead of recomputing it in every consumer.
    norm = jnp.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return tuple(c / norm for c in q)
