"""Rotations of space as unit quaternions, and their tangent φ (axis times angle in radians)."""

from collections.abc import Sequence
from typing import ClassVar, overload

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import cross3
from vojax._types import Array, ArrayLike, Float, PRNGKeyArray

from ._coefficients import half_angle_over_sine, inverse_coefficients, stumpff
from ._components import (
    align,
    as_floating,
    bounded_rotation,
    polynomial_in_hat,
    split,
    split_matrix,
    squared_norm,
    stack,
)


class SO3(eqx.Module):
    """Rotation, or a batch of them, stored as a unit quaternion (w, x, y, z).

    Acts on points from the left, `b_from_a @ points_a`. `q` and `−q` are the same rotation. Nothing renormalises behind
    the caller's back: `normalize` undoes the drift of long products.

    References: Solà, Deray & Atchuthan, "A micro Lie theory for state estimation in robotics", 2018.

    Example:
        >>> quarter_turn = SO3.exp(jnp.array([0.0, 0.0, jnp.pi / 2]))
        >>> point = quarter_turn @ jnp.array([1.0, 0.0, 0.0])
        >>> bool(jnp.allclose(point, jnp.array([0.0, 1.0, 0.0]), atol=1e-6))
        True
    """

    wxyz: Float[Array, "*batch 4"] = eqx.field(converter=lambda x: as_floating(x, 4))

    tangent_dim: ClassVar[int] = 3
    parameters_dim: ClassVar[int] = 4

    @staticmethod
    def identity(batch_axes: Sequence[int] = (), dtype: jnp.dtype | type | None = None) -> "SO3":
        """Rotation that leaves every point in place."""
        one, zero = jnp.ones(tuple(batch_axes), dtype), jnp.zeros(tuple(batch_axes), dtype)
        return SO3(stack(one, zero, zero, zero))

    @staticmethod
    def exp(tangent: Float[ArrayLike, "*batch 3"]) -> "SO3":
        """Rotation about the direction of `tangent` by its length in radians.

        Degenerate input: components beyond 1/eps radians (8e6 in float32), where the angle is lost to rounding, are
        clipped.
        Differentiability: both modes, any order, at the zero tangent as well.
        """
        x, y, z = split(bounded_rotation(as_floating(tangent, 3)))
        # cos(θ/2) and sin(θ/2)/θ are even in θ, hence smooth functions of θ².
        cosine, sine_ratio, *_ = stumpff(0.25 * squared_norm((x, y, z)))
        half = 0.5 * sine_ratio
        return SO3(stack(cosine, half * x, half * y, half * z))

    def log(self) -> Float[Array, "*batch 3"]:
        """Tangent of the rotation, of length at most π: the shorter way round, also when w < 0.

        Degenerate input: at exactly half a turn either sign of the axis is right and one is returned; the zero
        quaternion gives zero.
        Differentiability: both modes, at the identity and at half a turn as well (one-sided there).
        """
        # q and −q are the same rotation; the one with w ≥ 0 has the angle in [0, π]. The barrier makes every component
        # see the same w: rounded differently in two places, it could have both signs at half a turn.
        w, x, y, z = split(jax.lax.optimization_barrier(self.wxyz))
        sign = jnp.where(w < 0, -1.0, 1.0).astype(w.dtype)
        factor = sign * half_angle_over_sine(squared_norm((x, y, z)), sign * w)
        return stack(factor * x, factor * y, factor * z)

    @staticmethod
    def from_matrix(matrix: Float[ArrayLike, "*batch 3 3"]) -> "SO3":
        """Rotation from its matrix.

        Args:
            matrix: Rotation matrix. The result is a unit quaternion for any finite input, and close to the nearest
                rotation for a matrix that is orthogonal up to rounding.

        Differentiability: both modes, for every rotation.
        References: Shepperd, "Quaternion from rotation matrix", 1978.
        """
        # The barrier makes all components select the same row where two are equally large.
        entries = jax.lax.optimization_barrier(as_floating(matrix, 3, 3))
        (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = split_matrix(entries)
        # Row i of 4 q qᵀ is 4 q_i q. The diagonal sums to 4, so its largest entry is at least 1 and the row is safe to
        # normalise; all four rows are formed, one is selected.
        rows = (
            (1.0 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01),
            (m21 - m12, 1.0 + m00 - m11 - m22, m10 + m01, m02 + m20),
            (m02 - m20, m10 + m01, 1.0 - m00 + m11 - m22, m21 + m12),
            (m10 - m01, m02 + m20, m21 + m12, 1.0 - m00 - m11 + m22),
        )
        best, largest = rows[0], rows[0][0]
        for i in (1, 2, 3):
            larger = rows[i][i] > largest
            largest = jnp.where(larger, rows[i][i], largest)
            best = tuple(jnp.where(larger, new, old) for new, old in zip(rows[i], best, strict=True))
        return SO3(stack(*best)).normalize()

    def as_matrix(self) -> Float[Array, "*batch 3 3"]:
        """Rotation matrix."""
        w, v = self.wxyz[..., 0], self.wxyz[..., 1:]
        return polynomial_in_hat(jnp.ones_like(w), 2.0 * w, jnp.full_like(w, 2.0), v)

    def inverse(self) -> "SO3":
        """Rotation the other way: the conjugate quaternion."""
        w, x, y, z = split(self.wxyz)
        return SO3(stack(w, -x, -y, -z))

    def apply(self, points: Float[ArrayLike, "*points 3"]) -> Float[Array, "*broadcast 3"]:
        """Rotate points; leading axes of the rotation and of the points broadcast."""
        wxyz, xyz = align(self.wxyz, as_floating(points, 3))
        w, x, y, z = split(wxyz)
        v, p = (x, y, z), split(xyz)
        # p + 2w (v × p) + 2 v × (v × p), cheaper than forming the matrix for each point.
        t = tuple(2.0 * component for component in cross3(v, p))
        s = cross3(v, t)
        return stack(*(p[i] + w * t[i] + s[i] for i in range(3)))

    def multiply(self, other: "SO3") -> "SO3":
        """Composition `self ∘ other`; leading axes broadcast."""
        left, right = align(self.wxyz, other.wxyz)
        w0, x0, y0, z0 = split(left)
        w1, x1, y1, z1 = split(right)
        return SO3(
            stack(
                w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
                w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
                w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
                w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
            )
        )

    @overload
    def __matmul__(self, other: "SO3") -> "SO3": ...
    @overload
    def __matmul__(self, other: ArrayLike) -> Array: ...
    def __matmul__(self, other):
        """Compose with a rotation, or rotate points."""
        return self.multiply(other) if isinstance(other, SO3) else self.apply(other)

    def adjoint(self) -> Float[Array, "*batch 3 3"]:
        """Matrix with `T exp(φ) T⁻¹ = exp(Ad φ)`: the rotation matrix itself."""
        return self.as_matrix()

    def parameters(self) -> Float[Array, "*batch 4"]:
        """Stored numbers (w, x, y, z)."""
        return self.wxyz

    def normalize(self) -> "SO3":
        """Same rotation with the quaternion scaled to unit length; the zero quaternion becomes the identity."""
        w, x, y, z = split(self.wxyz)
        squared = w * w + squared_norm((x, y, z))
        usable = squared > float(jnp.finfo(squared.dtype).tiny)
        inverse = jnp.where(usable, 1.0 / jnp.sqrt(jnp.where(usable, squared, 1.0)), 0.0)
        return SO3(stack(jnp.where(usable, w * inverse, 1.0), x * inverse, y * inverse, z * inverse))

    @staticmethod
    def jacobian_left(tangent: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
        """Matrix with `exp(φ + δ) ≈ exp(J δ) exp(φ)` for small δ."""
        phi = bounded_rotation(as_floating(tangent, 3))
        _, c1, c2, c3, *_ = stumpff(squared_norm(split(phi)))
        return polynomial_in_hat(jnp.ones_like(c1), c2, c3, phi)

    @staticmethod
    def jacobian_right(tangent: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
        """Matrix with `exp(φ + δ) ≈ exp(φ) exp(J δ)` for small δ."""
        return SO3.jacobian_left(-as_floating(tangent))

    @staticmethod
    def jacobian_left_inverse(tangent: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
        """Inverse of `jacobian_left`.

        Degenerate input: no inverse exists at whole turns other than zero; the numbers returned there are finite.
        """
        phi = bounded_rotation(as_floating(tangent, 3))
        u = squared_norm(split(phi))
        _, _, c2, c3, *_ = stumpff(u)
        return polynomial_in_hat(*inverse_coefficients(jnp.ones_like(u), c2, c3, u), phi)

    @staticmethod
    def jacobian_right_inverse(tangent: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
        """Inverse of `jacobian_right`."""
        return SO3.jacobian_left_inverse(-as_floating(tangent))

    @staticmethod
    def sample_uniform(
        key: PRNGKeyArray | Array, batch_axes: Sequence[int] = (), dtype: jnp.dtype | type | None = None
    ) -> "SO3":
        """Random rotations, uniform over the group.

        References: Marsaglia, "Choosing a point from the surface of a sphere", 1972 (normalised Gaussians).
        """
        dtype = jnp.zeros((), dtype).dtype
        return SO3(jax.random.normal(key, (*batch_axes, 4), dtype)).normalize()

    def get_batch_axes(self) -> tuple[int, ...]:
        """Leading axes."""
        return self.wxyz.shape[:-1]
