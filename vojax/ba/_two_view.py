"""Two-view models against pairs of pixels: relative pose, fundamental matrix, homography.

Errors are first-order geometric distances (Sampson) in standard deviations of the pixels, for any camera: with rays
r(p) and J = dr/dp L at each pixel, where L Lᵀ is the covariance of its noise, the epipolar form e = r1ᵀ E r0 has the
distance

    |e| / sqrt(|J0ᵀ Eᵀ r1|² + |J1ᵀ E r0|²),                                                                      (1)

and the two equations δ of a homography the distance δᵀ (G Gᵀ)⁻¹ δ with G their derivative by both whitened pixels.

References: R. Hartley, A. Zisserman. Multiple View Geometry in Computer Vision, 2nd edition, sections 4.2.6 and 11.4.3.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import complement, cross3, dot3, safe_divide, safe_sqrt
from vojax._types import Array, Float
from vojax.lie import SE3

from ._retraction import step_pose

Components = tuple[Array, ...]


class PixelRays(eqx.Module):
    """What one view sees: rays and their derivatives by the whitened pixels, by components `[n]`."""

    ray: Components
    by_u: Components
    by_v: Components

    @property
    def components(self) -> Components:
        """All nine, in order."""
        return (*self.ray, *self.by_u, *self.by_v)

    def scaled(self, factor: Float[Array, "n 2 2"]) -> "PixelRays":
        """With other noise, from rays for a noise of one pixel.

        Args:
            factor: Lower-triangular square roots of the covariances, px.
        """
        first, across, second = factor[:, 0, 0], factor[:, 1, 0], factor[:, 1, 1]
        by_u = tuple(first * u + across * v for u, v in zip(self.by_u, self.by_v, strict=True))
        return PixelRays(self.ray, by_u, tuple(second * v for v in self.by_v))


def pixel_rays(camera: Any, pixels: Float[Array, "n 2"]) -> PixelRays:
    """Rays of pixels and how they move by one pixel.

    Args:
        camera: A camera of `vojax.cameras`.
        pixels: Observations.
    """
    ray, moved = jax.linearize(camera.unproject, pixels)
    by_u, by_v = (moved(jnp.zeros_like(pixels).at[:, k].set(1.0)) for k in range(2))
    return PixelRays(*(tuple(x[:, i] for i in range(3)) for x in (ray, by_u, by_v)))


def epipolar_terms(rows: Any, rays0: Components, rays1: Components) -> tuple[Array, Array]:
    """Form e and the squared length of its gradient for a matrix given by rows and nine components for each view."""
    r0, u0, v0 = rays0[0:3], rays0[3:6], rays0[6:9]
    r1, u1, v1 = rays1[0:3], rays1[3:6], rays1[6:9]
    line1 = tuple(dot3(row, r0) for row in rows)  # E r0
    line0 = tuple(rows[0][j] * r1[0] + rows[1][j] * r1[1] + rows[2][j] * r1[2] for j in range(3))  # Eᵀ r1
    error = dot3(r1, line1)
    slopes = (dot3(line0, u0), dot3(line0, v0), dot3(line1, u1), dot3(line1, v1))
    return error, slopes[0] * slopes[0] + slopes[1] * slopes[1] + slopes[2] * slopes[2] + slopes[3] * slopes[3]


class _Epipolar(eqx.Module):
    """Pairs of rays."""

    view0: PixelRays
    view1: PixelRays

    def sampson(self, rows: Any) -> tuple[Array, ...]:
        """Residuals (1)."""
        error, slope = epipolar_terms(rows, self.view0.components, self.view1.components)
        return (safe_divide(error, safe_sqrt(slope)),)


class RelativePoseProblem(_Epipolar):
    """`cam1_from_cam0` with |t| = 1 on SO3 × S².

    The tangent is (τ, φ): exp(−ξ) @ cam1_from_cam0 with ξ = (τ₁ b₁ + τ₂ b₂, φ), where b₁ and b₂ complete t to an
    orthonormal basis (`translation_basis`), and t scaled to length one again.
    """

    tangent_dim: ClassVar[int] = 5

    @staticmethod
    def retract(model: SE3, tangent: Array) -> SE3:
        """Turn the translation within its plane, and the rotation."""
        basis = translation_basis(model)
        along = tangent[0] * basis[:, 0] + tangent[1] * basis[:, 1]
        moved = step_pose(model, jnp.concatenate([along, tangent[2:]]))
        t = moved.translation()
        return SE3.from_rotation_and_translation(moved.rotation(), t / safe_sqrt(jnp.sum(t * t)))

    def residual(self, model: SE3) -> tuple[Array, ...]:
        """Sampson distances."""
        r, t = model.rotation().as_matrix(), model.translation()
        columns = [cross3((t[0], t[1], t[2]), (r[0, j], r[1, j], r[2, j])) for j in range(3)]
        return self.sampson([[columns[j][i] for j in range(3)] for i in range(3)])


def translation_basis(cam1_from_cam0: SE3) -> Float[Array, "3 2"]:
    """The two directions in which a unit translation can turn; constant to differentiation."""
    t = jax.lax.stop_gradient(cam1_from_cam0.translation())
    first, second = complement((t[0], t[1], t[2]))
    return jnp.stack([jnp.stack(first), jnp.stack(second)], axis=1)


class FundamentalProblem(_Epipolar):
    """Matrices of rank two and norm one; the tangent is in the basis of `fundamental_basis`."""

    tangent_dim: ClassVar[int] = 7

    @staticmethod
    def retract(model: Array, tangent: Array) -> Array:
        """Step in the tangent plane, then Newton's iteration back to rank two along the gradient of det."""
        step = fundamental_basis(model) @ tangent
        return to_rank_two(model + step.reshape(3, 3))

    def residual(self, model: Array) -> tuple[Array, ...]:
        """Sampson distances."""
        return self.sampson([[model[i, j] for j in range(3)] for i in range(3)])


def _cofactors(m: Array) -> Array:
    return jnp.stack([jnp.cross(m[1], m[2]), jnp.cross(m[2], m[0]), jnp.cross(m[0], m[1])])


def to_rank_two(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The matrix of rank two and norm one near a matrix near it."""

    def newton(_: object, matrix: Array) -> Array:
        gradient = _cofactors(matrix)
        determinant = jnp.sum(matrix[0] * gradient[0])
        length = jnp.sum(gradient * gradient)
        return matrix - gradient * safe_divide(determinant, length)

    matrix = jax.lax.fori_loop(0, 3, newton, matrix)
    return matrix * safe_divide(jnp.ones_like(matrix[0, 0]), safe_sqrt(jnp.sum(matrix * matrix)))


def fundamental_basis(model: Float[Array, "3 3"]) -> Float[Array, "9 7"]:
    """Orthonormal basis of the changes that keep norm and, to first order, rank two; constant to differentiation.

    Two Householder reflections take F and the gradient of its determinant to the first two axes; the other columns of
    their product are the basis.
    """
    model = jax.lax.stop_gradient(model)
    gradient = _cofactors(model).reshape(9)
    gradient = gradient * safe_divide(jnp.ones_like(gradient[0]), safe_sqrt(jnp.sum(gradient * gradient)))
    basis = jnp.eye(9, dtype=model.dtype)
    first = _reflector(model.reshape(9), 0)
    second = _reflector(gradient - first * jnp.sum(first * gradient), 1)
    for v in (second, first):
        basis = basis - v[:, None] * jnp.sum(v[:, None] * basis, axis=0)[None]
    return basis[:, 2:]


def _reflector(x: Array, axis: int) -> Array:
    """Vector v with |v|² = 2 such that x − v (v.x) lies along the axis, for unit x that has nothing on earlier axes."""
    x = jnp.where(jnp.arange(9) < axis, 0.0, x)
    v = x.at[axis].add(jnp.where(x[axis] < 0, -1.0, 1.0))
    return v * safe_divide(jnp.full_like(v[0], 2.0**0.5), safe_sqrt(jnp.sum(v * v)))


class HomographyProblem(eqx.Module):
    """3×3 matrices of norm one; the tangent is in the basis of `homography_basis`. Third components of rays are one."""

    view0: PixelRays
    view1: PixelRays

    tangent_dim: ClassVar[int] = 8

    @staticmethod
    def retract(model: Array, tangent: Array) -> Array:
        """Step on the sphere."""
        moved = model + (homography_basis(model) @ tangent).reshape(3, 3)
        return moved * safe_divide(jnp.ones_like(moved[0, 0]), safe_sqrt(jnp.sum(moved * moved)))

    def residual(self, model: Array) -> tuple[Array, ...]:
        """Whitened Sampson residuals, two for each pair."""
        rows = [[model[i, j] for j in range(3)] for i in range(3)]
        return homography_residual(rows, self.view0.components, self.view1.components)


def homography_residual(rows: Any, rays0: Components, rays1: Components) -> tuple[Array, Array]:
    """δ = (x1 h3.r0 − h1.r0, y1 h3.r0 − h2.r0), whitened by the Cholesky factor of G Gᵀ."""
    r0, u0, v0 = rays0[0:3], rays0[3:6], rays0[6:9]
    x1, y1 = rays1[0], rays1[1]
    h1, h2, h3 = (dot3(row, r0) for row in rows)
    by = [[dot3(row, moved) for row in rows] for moved in (u0, v0)]
    # Derivatives of the two equations by the four whitened coordinates.
    g1 = [x1 * by[0][2] - by[0][0], x1 * by[1][2] - by[1][0], h3 * rays1[3], h3 * rays1[6]]
    g2 = [y1 * by[0][2] - by[0][1], y1 * by[1][2] - by[1][1], h3 * rays1[4], h3 * rays1[7]]
    s11, s12, s22 = (sum(a * b for a, b in zip(p, q, strict=True)) for p, q in ((g1, g1), (g1, g2), (g2, g2)))
    d1, d2 = x1 * h3 - h1, y1 * h3 - h2
    share = safe_divide(s12, s11)  # type: ignore[arg-type]
    rest = s22 - share * s12
    return safe_divide(d1, safe_sqrt(s11)), safe_divide(d2 - share * d1, safe_sqrt(rest))  # type: ignore[arg-type]


def homography_basis(model: Float[Array, "3 3"]) -> Float[Array, "9 8"]:
    """Orthonormal basis of the changes that keep the norm; constant to differentiation."""
    v = _reflector(jax.lax.stop_gradient(model).reshape(9), 0)
    return (jnp.eye(9, dtype=model.dtype) - v[:, None] * v[None])[:, 1:]
