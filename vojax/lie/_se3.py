"""Rigid motions of space: a rotation followed by a translation, with tangent (ρ, φ)."""

from collections.abc import Sequence
from typing import ClassVar, overload

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import dot3
from vojax._types import Array, ArrayLike, Float, PRNGKeyArray

from ._coefficients import inverse_coefficients, stumpff
from ._components import (
    align,
    as_floating,
    blocks,
    bounded_rotation,
    eye_times,
    hat,
    homogeneous,
    join,
    matmul,
    outer,
    polynomial_in_hat,
    polynomial_in_hat_times,
    split,
    squared_norm,
    stack,
)
from ._so3 import SO3


class SE3(eqx.Module):
    """Rigid motion, or a batch of them, stored as a unit quaternion and a translation (w, x, y, z, tx, ty, tz).

    Named by its frames, `b_from_a @ points_a` gives the points in frame b. Tangents are (ρ, φ), translation first;
    a small change is applied on the right, `T @ SE3.exp(ξ)`.

    References: Solà, Deray & Atchuthan, "A micro Lie theory for state estimation in robotics", 2018; Barfoot, "State
    Estimation for Robotics", section 7.1.

    Example:
        >>> cam_from_world = SE3.from_rotation_and_translation(SO3.identity(), jnp.array([0.0, 0.0, 2.0]))
        >>> bool(jnp.allclose(cam_from_world @ jnp.array([1.0, 0.0, 3.0]), jnp.array([1.0, 0.0, 5.0])))
        True
    """

    wxyz_xyz: Float[Array, "*batch 7"] = eqx.field(converter=lambda x: as_floating(x, 7))

    tangent_dim: ClassVar[int] = 6
    parameters_dim: ClassVar[int] = 7

    @staticmethod
    def identity(batch_axes: Sequence[int] = (), dtype: jnp.dtype | type | None = None) -> "SE3":
        """Motion that leaves every point in place."""
        one, zero = jnp.ones(tuple(batch_axes), dtype), jnp.zeros(tuple(batch_axes), dtype)
        return SE3(stack(one, *(zero,) * 6))

    @staticmethod
    def from_rotation_and_translation(rotation: SO3, translation: Float[ArrayLike, "*batch 3"]) -> "SE3":
        """Motion `p -> rotation @ p + translation`; leading axes broadcast."""
        return SE3(join(rotation.wxyz, as_floating(translation, 3)))

    def rotation(self) -> SO3:
        """Rotation part."""
        return SO3(self.wxyz_xyz[..., :4])

    def translation(self) -> Float[Array, "*batch 3"]:
        """Translation part, in the unit of the points."""
        return self.wxyz_xyz[..., 4:]

    @staticmethod
    def exp(tangent: Float[ArrayLike, "*batch 6"]) -> "SE3":
        """Motion reached in unit time at the constant body velocity (ρ, φ).

        Degenerate input: as `SO3.exp`.
        Differentiability: both modes, any order, at the zero tangent as well.
        """
        rho, phi, u, (_, _, c2, c3, *_) = _tangent_parts(tangent)
        translation = polynomial_in_hat_times(jnp.ones_like(u), c2, c3, phi, rho)
        return SE3(join(SO3.exp(phi).wxyz, translation))

    def log(self) -> Float[Array, "*batch 6"]:
        """Tangent (ρ, φ) of the motion, |φ| ≤ π.

        Degenerate input: as `SO3.log`.
        Differentiability: both modes, at the identity and at half a turn as well (one-sided there).
        """
        phi = self.rotation().log()
        u = squared_norm(split(phi))
        _, _, c2, c3, *_ = stumpff(u)
        coefficients = inverse_coefficients(jnp.ones_like(u), c2, c3, u)
        return join(polynomial_in_hat_times(*coefficients, phi, self.translation()), phi)

    @staticmethod
    def from_matrix(matrix: Float[ArrayLike, "*batch 4 4"]) -> "SE3":
        """Motion from its homogeneous matrix; the last row is taken to be (0, 0, 0, 1).

        Differentiability: both modes, for every rotation.
        """
        matrix = as_floating(matrix, 4, 4)
        return SE3.from_rotation_and_translation(SO3.from_matrix(matrix[..., :3, :3]), matrix[..., :3, 3])

    def as_matrix(self) -> Float[Array, "*batch 4 4"]:
        """Homogeneous matrix [[R, t], [0, 1]]."""
        return homogeneous(self.rotation().as_matrix(), self.translation())

    def inverse(self) -> "SE3":
        """Motion back: `b_from_a.inverse()` is `a_from_b`."""
        rotation = self.rotation().inverse()
        return SE3.from_rotation_and_translation(rotation, -rotation.apply(self.translation()))

    def apply(self, points: Float[ArrayLike, "*points 3"]) -> Float[Array, "*broadcast 3"]:
        """Move points; leading axes of the motion and of the points broadcast."""
        rotated, translation = align(self.rotation().apply(points), self.translation())
        return rotated + translation

    def multiply(self, other: "SE3") -> "SE3":
        """Composition: `c_from_b.multiply(b_from_a)` is `c_from_a`; leading axes broadcast."""
        return SE3.from_rotation_and_translation(
            self.rotation().multiply(other.rotation()), self.apply(other.translation())
        )

    @overload
    def __matmul__(self, other: "SE3") -> "SE3": ...
    @overload
    def __matmul__(self, other: ArrayLike) -> Array: ...
    def __matmul__(self, other):
        """Compose with a motion, or move points."""
        return self.multiply(other) if isinstance(other, SE3) else self.apply(other)

    def adjoint(self) -> Float[Array, "*batch 6 6"]:
        """Matrix with `T exp(ξ) T⁻¹ = exp(Ad ξ)`."""
        rotation = self.rotation().as_matrix()
        return _block_triangular(rotation, matmul(hat(self.translation()), rotation), rotation)

    def parameters(self) -> Float[Array, "*batch 7"]:
        """Stored numbers (w, x, y, z, tx, ty, tz)."""
        return self.wxyz_xyz

    def normalize(self) -> "SE3":
        """Same motion with the quaternion scaled to unit length; the zero quaternion becomes the identity."""
        return SE3.from_rotation_and_translation(self.rotation().normalize(), self.translation())

    @staticmethod
    def jacobian_left(tangent: Float[ArrayLike, "*batch 6"]) -> Float[Array, "*batch 6 6"]:
        """Matrix with `exp(ξ + δ) ≈ exp(J δ) exp(ξ)` for small δ."""
        rho, phi, u, (_, _, c2, c3, c4, c5) = _tangent_parts(tangent)
        rotation = polynomial_in_hat(jnp.ones_like(u), c2, c3, phi)
        return _block_triangular(rotation, _coupling(rho, phi, u, c2, c3, c4, c5), rotation)

    @staticmethod
    def jacobian_right(tangent: Float[ArrayLike, "*batch 6"]) -> Float[Array, "*batch 6 6"]:
        """Matrix with `exp(ξ + δ) ≈ exp(ξ) exp(J δ)` for small δ."""
        return SE3.jacobian_left(-as_floating(tangent))

    @staticmethod
    def jacobian_left_inverse(tangent: Float[ArrayLike, "*batch 6"]) -> Float[Array, "*batch 6 6"]:
        """Inverse of `jacobian_left`.

        Degenerate input: no inverse exists at whole turns other than zero; the numbers returned there are finite.
        """
        rho, phi, u, (_, _, c2, c3, c4, c5) = _tangent_parts(tangent)
        inverse = polynomial_in_hat(*inverse_coefficients(jnp.ones_like(u), c2, c3, u), phi)
        coupling = matmul(matmul(inverse, _coupling(rho, phi, u, c2, c3, c4, c5)), inverse)
        return _block_triangular(inverse, -coupling, inverse)

    @staticmethod
    def jacobian_right_inverse(tangent: Float[ArrayLike, "*batch 6"]) -> Float[Array, "*batch 6 6"]:
        """Inverse of `jacobian_right`."""
        return SE3.jacobian_left_inverse(-as_floating(tangent))

    @staticmethod
    def sample_uniform(
        key: PRNGKeyArray | Array, batch_axes: Sequence[int] = (), dtype: jnp.dtype | type | None = None
    ) -> "SE3":
        """Random motions: rotation uniform over its group, translation uniform in the cube [−1, 1]³."""
        key_rotation, key_translation = jax.random.split(key)
        rotation = SO3.sample_uniform(key_rotation, batch_axes, dtype)
        translation = jax.random.uniform(key_translation, (*batch_axes, 3), rotation.wxyz.dtype, -1.0, 1.0)
        return SE3.from_rotation_and_translation(rotation, translation)

    def get_batch_axes(self) -> tuple[int, ...]:
        """Leading axes."""
        return self.wxyz_xyz.shape[:-1]


def _tangent_parts(tangent):
    tangent = as_floating(tangent, 6)
    rho, phi = tangent[..., :3], bounded_rotation(tangent[..., 3:])
    u = squared_norm(split(phi))
    return rho, phi, u, stumpff(u)


def _coupling(rho, phi, u, c2, c3, c4, c5) -> Array:
    """Block Q of the left Jacobian [[J, Q], [0, J]] (Barfoot, eq. 7.86).

    With φ^ρ^ = ρφᵀ − (φ·ρ)I and φ^ρ^φ^ = −(φ·ρ)φ^ its eight triple products collapse to
    Q = c₂ ρ^ + c₃ (ρφᵀ + φρᵀ − 2(φ·ρ)I) + (φ·ρ) [(2c₄ − c₃) φ^ − (c₄ − 3c₅)(φφᵀ − |φ|²I)].
    """
    d = dot3(split(phi), split(rho))
    e = d * (c4 - 3.0 * c5)
    skew = hat(c2[..., None] * rho + (d * (2.0 * c4 - c3))[..., None] * phi)
    symmetric = outer(rho, phi) + outer(phi, rho)
    return skew + eye_times(e * u - 2.0 * c3 * d) + c3[..., None, None] * symmetric - outer(e[..., None] * phi, phi)


def _block_triangular(upper: Array, corner: Array, lower: Array) -> Array:
    """Array of [[upper, corner], [0, lower]]."""
    return blocks([[upper, corner], [jnp.zeros_like(upper), lower]])
