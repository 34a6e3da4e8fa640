"""Similarities of space: scale and rotation followed by a translation, with tangent (ρ, φ, log s)."""

import math
from collections.abc import Sequence
from typing import ClassVar, overload

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import dot3, safe_divide, safe_sqrt
from vojax._types import Array, ArrayLike, Float, PRNGKeyArray

from ._coefficients import inverse_coefficients, similarity_coefficients, stumpff
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


class Sim3(eqx.Module):
    """Similarity `p -> s R p + t`, or a batch of them, stored as (w, x, y, z, tx, ty, tz, s) with s > 0.

    Its matrix is [[s R, t], [0, 1]]. Tangents are (ρ, φ, σ) with σ = log s, and `exp` is the matrix exponential of
    [[σI + φ^, ρ], [0, 0]]; a small change is applied on the right, `T @ Sim3.exp(ξ)`.

    References: Strasdat, "Local Accuracy and Global Consistency for Efficient Visual SLAM", 2012, section 2.4; Eade,
    "Lie Groups for 2D and 3D Transformations", section 6.

    Example:
        >>> double = Sim3.from_rotation_translation_scale(SO3.identity(), jnp.zeros(3), jnp.array(2.0))
        >>> bool(jnp.allclose(double @ jnp.array([1.0, 2.0, 3.0]), jnp.array([2.0, 4.0, 6.0])))
        True
    """

    wxyz_xyz_scale: Float[Array, "*batch 8"] = eqx.field(converter=lambda x: as_floating(x, 8))

    tangent_dim: ClassVar[int] = 7
    parameters_dim: ClassVar[int] = 8

    @staticmethod
    def identity(batch_axes: Sequence[int] = (), dtype: jnp.dtype | type | None = None) -> "Sim3":
        """Similarity that leaves every point in place."""
        one, zero = jnp.ones(tuple(batch_axes), dtype), jnp.zeros(tuple(batch_axes), dtype)
        return Sim3(stack(one, *(zero,) * 6, one))

    @staticmethod
    def from_rotation_translation_scale(
        rotation: SO3, translation: Float[ArrayLike, "*batch 3"], scale: Float[ArrayLike, "*scales"] | float
    ) -> "Sim3":
        """Similarity `p -> scale · (rotation @ p) + translation`; leading axes broadcast."""
        return Sim3(join(rotation.wxyz, as_floating(translation, 3), as_floating(scale)[..., None]))

    def rotation(self) -> SO3:
        """Rotation part."""
        return SO3(self.wxyz_xyz_scale[..., :4])

    def translation(self) -> Float[Array, "*batch 3"]:
        """Translation part, in the unit of the points after scaling."""
        return self.wxyz_xyz_scale[..., 4:7]

    def scale(self) -> Float[Array, "*batch"]:
        """Factor by which lengths grow."""
        return self.wxyz_xyz_scale[..., 7]

    @staticmethod
    def exp(tangent: Float[ArrayLike, "*batch 7"]) -> "Sim3":
        """Similarity from its tangent (ρ, φ, log s).

        Degenerate input: as `SO3.exp`; log s is clipped to three quarters of the exponent range of the dtype (±66 in
        float32).
        Differentiability: both modes, any order, at zero rotation, zero log-scale and both.
        """
        rho, phi, sigma, _, (a, b, c) = _tangent_parts(tangent)
        translation = polynomial_in_hat_times(a, b, c, phi, rho)
        return Sim3(join(SO3.exp(phi).wxyz, translation, jnp.exp(sigma)[..., None]))

    def log(self) -> Float[Array, "*batch 7"]:
        """Tangent (ρ, φ, log s) of the similarity, |φ| ≤ π.

        Degenerate input: as `SO3.log`; a scale that is not positive counts as 1.
        Differentiability: both modes, at the identity and at half a turn as well (one-sided there).
        """
        phi = self.rotation().log()
        scale = self.scale()
        sigma = jnp.log(jnp.where(scale > 0, scale, 1.0))
        u = squared_norm(split(phi))
        coefficients = inverse_coefficients(*similarity_coefficients(sigma, u), u)
        return join(polynomial_in_hat_times(*coefficients, phi, self.translation()), phi, sigma[..., None])

    @staticmethod
    def from_matrix(matrix: Float[ArrayLike, "*batch 4 4"]) -> "Sim3":
        """Similarity from its matrix [[s R, t], [0, 1]]; the last row is taken to be (0, 0, 0, 1).

        Degenerate input: a zero linear part gives scale 0 and no rotation.
        Differentiability: both modes, for every rotation.
        """
        matrix = as_floating(matrix, 4, 4)
        linear = matrix[..., :3, :3]
        # ‖sR‖² = 3 s²: a root without a sign to choose, unlike that of the determinant.
        scale = safe_sqrt(jnp.sum(linear * linear, axis=(-2, -1)) / 3.0)
        rotation = safe_divide(linear, jnp.broadcast_to(scale[..., None, None], linear.shape))
        return Sim3.from_rotation_translation_scale(SO3.from_matrix(rotation), matrix[..., :3, 3], scale)

    def as_matrix(self) -> Float[Array, "*batch 4 4"]:
        """Homogeneous matrix [[s R, t], [0, 1]]."""
        return homogeneous(self.scale()[..., None, None] * self.rotation().as_matrix(), self.translation())

    def inverse(self) -> "Sim3":
        """Similarity back: `b_from_a.inverse()` is `a_from_b`."""
        rotation, scale = self.rotation().inverse(), self.scale()
        inverse_scale = safe_divide(jnp.ones_like(scale), scale)
        translation = -inverse_scale[..., None] * rotation.apply(self.translation())
        return Sim3.from_rotation_translation_scale(rotation, translation, inverse_scale)

    def apply(self, points: Float[ArrayLike, "*points 3"]) -> Float[Array, "*broadcast 3"]:
        """Scale, rotate and move points; leading axes of the similarity and of the points broadcast."""
        rotated, translation, scale = align(
            self.rotation().apply(points), self.translation(), self.wxyz_xyz_scale[..., 7:]
        )
        return scale * rotated + translation

    def multiply(self, other: "Sim3") -> "Sim3":
        """Composition: `c_from_b.multiply(b_from_a)` is `c_from_a`; leading axes broadcast."""
        scale, other_scale = align(self.wxyz_xyz_scale[..., 7:], other.wxyz_xyz_scale[..., 7:])
        return Sim3.from_rotation_translation_scale(
            self.rotation().multiply(other.rotation()),
            self.apply(other.translation()),
            (scale * other_scale)[..., 0],
        )

    @overload
    def __matmul__(self, other: "Sim3") -> "Sim3": ...
    @overload
    def __matmul__(self, other: ArrayLike) -> Array: ...
    def __matmul__(self, other):
        """Compose with a similarity, or map points."""
        return self.multiply(other) if isinstance(other, Sim3) else self.apply(other)

    def adjoint(self) -> Float[Array, "*batch 7 7"]:
        """Matrix with `T exp(ξ) T⁻¹ = exp(Ad ξ)`."""
        rotation, t = self.rotation().as_matrix(), self.translation()
        return _blocks(self.scale()[..., None, None] * rotation, matmul(hat(t), rotation), -t, rotation)

    def parameters(self) -> Float[Array, "*batch 8"]:
        """Stored numbers (w, x, y, z, tx, ty, tz, s)."""
        return self.wxyz_xyz_scale

    def normalize(self) -> "Sim3":
        """Same similarity with the quaternion scaled to unit length; the zero quaternion becomes the identity."""
        return Sim3.from_rotation_translation_scale(self.rotation().normalize(), self.translation(), self.scale())

    @staticmethod
    def jacobian_left(tangent: Float[ArrayLike, "*batch 7"]) -> Float[Array, "*batch 7 7"]:
        """Matrix with `exp(ξ + δ) ≈ exp(J δ) exp(ξ)` for small δ."""
        rho, phi, sigma, u, coefficients = _tangent_parts(tangent)
        _, _, c2, c3, *_ = stumpff(u)
        rotation = polynomial_in_hat(jnp.ones_like(u), c2, c3, phi)
        coupling, column = _coupling(rho, phi, sigma, u, rotation)
        return _blocks(polynomial_in_hat(*coefficients, phi), coupling, column, rotation)

    @staticmethod
    def jacobian_right(tangent: Float[ArrayLike, "*batch 7"]) -> Float[Array, "*batch 7 7"]:
        """Matrix with `exp(ξ + δ) ≈ exp(ξ) exp(J δ)` for small δ."""
        return Sim3.jacobian_left(-as_floating(tangent))

    @staticmethod
    def jacobian_left_inverse(tangent: Float[ArrayLike, "*batch 7"]) -> Float[Array, "*batch 7 7"]:
        """Inverse of `jacobian_left`.

        Degenerate input: no inverse exists at whole turns other than zero; the numbers returned there are finite.
        """
        rho, phi, sigma, u, coefficients = _tangent_parts(tangent)
        _, _, c2, c3, *_ = stumpff(u)
        one = jnp.ones_like(u)
        coupling, column = _coupling(rho, phi, sigma, u, polynomial_in_hat(one, c2, c3, phi))
        linear = inverse_coefficients(*coefficients, u)
        linear_inverse = polynomial_in_hat(*linear, phi)
        rotation_inverse = polynomial_in_hat(*inverse_coefficients(one, c2, c3, u), phi)
        coupling = matmul(matmul(linear_inverse, coupling), rotation_inverse)
        return _blocks(
            linear_inverse,
            -coupling,
            -polynomial_in_hat_times(*linear, phi, column),
            rotation_inverse,
        )

    @staticmethod
    def jacobian_right_inverse(tangent: Float[ArrayLike, "*batch 7"]) -> Float[Array, "*batch 7 7"]:
        """Inverse of `jacobian_right`."""
        return Sim3.jacobian_left_inverse(-as_floating(tangent))

    @staticmethod
    def sample_uniform(
        key: PRNGKeyArray | Array, batch_axes: Sequence[int] = (), dtype: jnp.dtype | type | None = None
    ) -> "Sim3":
        """Random similarities: rotation uniform, translation uniform in the cube [−1, 1]³, log s uniform in [−1, 1]."""
        key_rotation, key_rest = jax.random.split(key)
        rotation = SO3.sample_uniform(key_rotation, batch_axes, dtype)
        rest = jax.random.uniform(key_rest, (*batch_axes, 4), rotation.wxyz.dtype, -1.0, 1.0)
        return Sim3.from_rotation_translation_scale(rotation, rest[..., :3], jnp.exp(rest[..., 3]))

    def get_batch_axes(self) -> tuple[int, ...]:
        """Leading axes."""
        return self.wxyz_xyz_scale.shape[:-1]


def _tangent_parts(tangent):
    tangent = as_floating(tangent, 7)
    rho, phi = tangent[..., :3], bounded_rotation(tangent[..., 3:6])
    limit = 0.75 * math.log(float(jnp.finfo(tangent.dtype).max))
    sigma = jnp.clip(tangent[..., 6], -limit, limit)
    u = squared_norm(split(phi))
    return rho, phi, sigma, u, similarity_coefficients(sigma, u)


def _coupling(rho, phi, sigma, u, rotation_jacobian: Array) -> tuple[Array, Array]:
    """Blocks Q and w of the left Jacobian [[V, Q, w], [0, J, 0], [0, 0, 1]].

    exp moves the translation t = V(φ, σ) ρ by V dρ + Q dφ + w dσ + (dσ I + (J dφ)^) t in the left frame, hence
    Q = ∂t/∂φ + t^ J and w = ∂t/∂σ − t.
    """
    one, zero = jnp.ones_like(u), jnp.zeros_like(u)
    (a, b, c), (_, b_u, c_u) = jax.jvp(lambda v: similarity_coefficients(sigma, v), (u,), (one,))
    _, (a_s, b_s, c_s) = jax.jvp(lambda s: similarity_coefficients(s, u), (sigma,), (one,))
    t = polynomial_in_hat_times(a, b, c, phi, rho)
    # ∂(φ × (φ × ρ))/∂φ = φρᵀ + (φ·ρ)I − 2ρφᵀ, and ∂f(u)/∂φ = 2 f' φᵀ.
    along = polynomial_in_hat_times(zero, 2.0 * b_u, 2.0 * c_u, phi, rho) - 2.0 * c[..., None] * rho
    coupling = (
        eye_times(c * dot3(split(phi), split(rho)))
        - hat(b[..., None] * rho)
        + outer(c[..., None] * phi, rho)
        + outer(along, phi)
        + matmul(hat(t), rotation_jacobian)
    )
    return coupling, polynomial_in_hat_times(a_s, b_s, c_s, phi, rho) - t


def _blocks(upper: Array, corner: Array, column: Array, lower: Array) -> Array:
    """Array of [[upper, corner, column], [0, lower, 0], [0, 0, 1]]."""
    square, tall = jnp.zeros_like(upper), jnp.zeros_like(column)[..., None]
    wide = jnp.swapaxes(tall, -1, -2)
    return blocks(
        [[upper, corner, column[..., None]], [square, lower, tall], [wide, wide, jnp.ones_like(wide[..., :1])]]
    )
