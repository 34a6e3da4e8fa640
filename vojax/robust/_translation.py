"""Robust camera position from points and pixels when the rotation is known: two points make a hypothesis.

A point X on a ray f says λ f = R X + t. With R known, t lies on the line through −R X along f; two lines meet in t, or
nearly: two points give four equations for three unknowns, and t is taken midway where the lines are nearest,

    λ0 f0 − λ1 f1 = R X0 − R X1,    t = ½ (λ0 f0 − R X0 + λ1 f1 − R X1).                                           (1)

Precondition: the rays are not parallel. The rotation comes from where it is known best: points at infinity, which turn
with the camera and do not see it move (`estimate_rotation`), an essential matrix, a gyroscope.

References: J.-P. Tardif, Y. Pavlidis, K. Daniilidis. Monocular visual odometry in urban environments using an
    omnidirectional camera. IROS 2008.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import cross3, dot3
from vojax._types import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray
from vojax.ba import GaussianUniform, LMOptions, Loss, Tukey, polish_model, refine_model, robustify, whiten, whitening
from vojax.lie import SE3, SO3

from ._buckets import in_bucket
from ._conclude import conclude
from ._engine import search
from ._estimate import Estimate
from ._options import RansacOptions
from ._pairs import about_middle, checked_observations, masked_pairs, root_mean_square, single_precision, usable_noise
from ._significance import chance_in_image, even_odds_in_pixels


class TranslationProblem(eqx.Module):
    """t of `cam_from_world` against points turned into the camera's axes; the tangent is the shift of the camera."""

    turned: Float[Array, "n 3"]
    pixels: Float[Array, "n 2"]
    camera: Any
    whitening: tuple[Array, ...]
    tangent_dim: ClassVar[int] = 3

    @staticmethod
    def retract(model: Array, tangent: Array) -> Array:
        """A camera that moves by ρ sees everything move by −ρ."""
        return model - tangent

    def residual(self, model: Array) -> tuple[Array, ...]:
        """Whitened reprojection errors."""
        return self.errors(*(self.turned[:, i] + model[i] for i in range(3)))

    def errors(self, x: Array, y: Array, z: Array) -> tuple[Array, ...]:
        """The same of points in the camera's frame."""
        u, v = self.camera.project_xyz(x, y, z)
        return whiten(self.whitening, (u - self.pixels[:, 0], v - self.pixels[:, 1]))


class TranslationEstimator(eqx.Module):
    """Translations as (t, 1) against turned points and pixels; zeros stand for none."""

    turned: Float[Array, "n 3"]
    pixels: Float[Array, "n 2"]
    bearings: Float[Array, "n 3"]
    camera: Any
    limit: float = eqx.field(static=True)
    local_steps: int = eqx.field(static=True)
    model_size: int = eqx.field(static=True, default=4)
    sample_size: int = eqx.field(static=True, default=2)
    chunk_size: int = eqx.field(static=True, default=128)

    @property
    def observations(self) -> tuple[Array, ...]:
        """Components of points and pixels."""
        return (*(self.turned[:, i] for i in range(3)), self.pixels[:, 0], self.pixels[:, 1])

    def hypothesize(self, sample: Int[Array, "m k"]) -> tuple[Float[Array, "4 k"], Bool[Array, " k"]]:
        """Where the two lines of each sample are nearest (1)."""
        (f0, f1), (x0, x1) = (
            [tuple(rows[sample[i], j] for j in range(3)) for i in range(2)] for rows in (self.bearings, self.turned)
        )
        normal = cross3(f0, f1)
        square = dot3(normal, normal)
        proper = square > 1e-8  # parallel lines meet nowhere: rays are to be 1e-4 rad apart
        inverse = 1.0 / jnp.where(proper, square, 1.0)
        edge = tuple(a - b for a, b in zip(x0, x1, strict=True))
        # λ0 = (edge × f1) · (f0 × f1) / |f0 × f1|², and λ1 with f0.
        depth0, depth1 = (dot3(cross3(edge, f), normal) * inverse for f in (f1, f0))
        t = [0.5 * (depth0 * f0[j] - x0[j] + depth1 * f1[j] - x1[j]) for j in range(3)]
        return jnp.stack([*t, jnp.ones_like(square)]), proper & (depth0 > 0) & (depth1 > 0)

    def squared_error(self, models: Float[Array, "4 *lanes"], observation: tuple[Array, ...]) -> Array:
        """Squared reprojection error in px²; points behind the camera are infinitely wrong."""
        x, y, z, u, v = observation
        xc, yc, zc = x + models[0], y + models[1], z + models[2]
        pu, pv = self.camera.project_xyz(xc, yc, zc)
        return jnp.where(zc > 0, (pu - u) * (pu - u) + (pv - v) * (pv - v), jnp.inf)

    def polish(self, model: Float[Array, "4"], mask: Bool[Array, " n"]) -> Float[Array, "4"]:
        """A few steps of reweighted Gauss–Newton."""
        problem = TranslationProblem(self.turned, self.pixels, self.camera, (jnp.ones((), model.dtype),))
        loss, weight = Tukey(2.0 * self.limit**0.5), mask.astype(model.dtype)
        t = polish_model(model[:3], problem, weight=weight, loss=loss, steps=self.local_steps)
        return jnp.concatenate([t, model[3:]])


def estimate_translation(
    points_world: Float[ArrayLike, "n 3"],
    pixels: Float[ArrayLike, "n 2"],
    camera: Any,
    rotation: SO3,
    *,
    rotation_covariance: Float[ArrayLike, "3 3"] | None = None,
    key: PRNGKeyArray | Array,
    options: RansacOptions = RansacOptions(),
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    quality: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Estimate[SE3]:
    """Estimate where a camera stands from points and their pixels, some of which are wrong, when its rotation is known.

    Args:
        points_world: Points, in the world frame.
        pixels: Where the camera sees them.
        camera: A camera of `vojax.cameras`.
        rotation: That of `cam_from_world`; it stays as it is.
        rotation_covariance: Of its tangent φ in the camera, where the true rotation is exp(−φ) @ rotation, as
            `estimate_rotation` has it; nothing for a rotation that is exact.
        key: Random key; the same key gives the same answer, bit for bit.
        options: Of the search. Inliers are within `threshold_px` pixels: an error of the rotation counts in full.
        sigma_px: Noise of the pixels, as for `estimate_absolute_pose`.
        quality: Of each correspondence, higher is better; guides the sampling.
        mask: False for padding.

    Returns:
        `model` is `cam_from_world`; `covariance` that of the camera-frame tangent ξ = (ρ, φ), where the state is
        `world_from_cam @ exp(ξ)`. Its lower right block is `rotation_covariance`, which the others carry on to the
        translation; without one the rows and columns of φ are zero.

    Degenerate input: fewer valid correspondences than three, all points behind the camera, one ray for all points, or
        no more agreement than chance would give end with a result code, the identity as model and zero covariance;
        never NaN. Points on a line, or two of them far apart, are enough.
    Differentiability: both modes, in points, pixels, camera, rotation and noise, through the last refinement by the
        implicit function theorem with the exact Hessian; the choice of inliers is constant.

    Raises:
        ValueError: If shapes do not fit or there are fewer than three correspondences.
    References: see the module.

    Example:
        >>> import jax, vojax
        >>> camera = vojax.cameras.Pinhole(fx=500.0, fy=500.0, cx=320.0, cy=240.0)
        >>> points = jax.random.uniform(jax.random.key(0), (50, 3), minval=-1.0).at[:, 2].add(5.0)
        >>> pixels = camera.project(points.at[:, 0].add(0.5))
        >>> estimate = estimate_translation(points, pixels, camera, vojax.SO3.identity(), key=jax.random.key(1))
        >>> bool(abs(estimate.model.translation() - jax.numpy.array([0.5, 0.0, 0.0])).max() < 1e-4)
        True
    """
    points_world, pixels = checked_observations(points_world, pixels)
    shape = jnp.shape(rotation.wxyz)
    if shape != (4,):
        raise ValueError(f"rotation has shape {shape}: expected one quaternion, (4,)")
    if rotation_covariance is not None and jnp.shape(rotation_covariance) != (3, 3):
        raise ValueError(f"rotation_covariance has shape {jnp.shape(rotation_covariance)}: expected (3, 3)")
    spread = jnp.zeros((3, 3)) if rotation_covariance is None else jnp.asarray(rotation_covariance)
    others = (rotation, spread, camera, key, options)
    return in_bucket(_estimate, (points_world, pixels), others, sigma_px, quality, mask)


@eqx.filter_jit
def _estimate(
    points_world: Array,
    pixels: Array,
    rotation: SO3,
    rotation_covariance: Array,
    camera: Any,
    key: Any,
    options: RansacOptions,
    sigma_px: Any,
    quality: Any,
    mask: Any,
) -> Estimate[SE3]:
    dtype = points_world.dtype
    points_world, pixels, mask = masked_pairs(points_world, pixels, mask)
    sigma_px, mask = usable_noise(sigma_px, mask)
    # A rotation that is not a number leaves no row that counts.
    finite = jnp.all(jnp.isfinite(rotation.wxyz))
    rotation = SO3(jnp.where(finite, rotation.wxyz, SO3.identity(dtype=dtype).wxyz).astype(dtype))
    mask = mask & finite
    centered, center = about_middle(jnp.where(mask[:, None], rotation.apply(points_world), 0.0), mask)
    single = single_precision((centered, pixels, camera))
    estimator = TranslationEstimator(
        single[0],
        single[1],
        single[2].unproject(single[1]),
        single[2],
        limit=options.threshold_px**2,
        local_steps=options.local_steps,
    )
    consensus = search(estimator, mask, single_precision(quality), key, options)

    # All observations in front take part, weighted by how likely they are inliers, as for `estimate_absolute_pose`.
    sigma, chance = root_mean_square(sigma_px, mask).astype(dtype), chance_in_image(pixels, mask, options.threshold_px)
    cut = even_odds_in_pixels(consensus.inliers, mask, sigma, chance, options.threshold_px)
    start = consensus.model[:3].astype(dtype)
    front = jax.lax.stop_gradient(centered + start[None])[:, 2] > 0
    problem = TranslationProblem(centered, pixels, camera, whitening(sigma_px, mask.shape, 2, dtype))
    weight, loss = (mask & front).astype(dtype), GaussianUniform(cut)
    steps = LMOptions(max_steps=options.final_steps)
    refined = refine_model(start, problem, weight=weight, loss=loss, options=steps)
    points_cam = centered + refined.model[None]
    error = camera.project(points_cam) - pixels
    spread = rotation_covariance.astype(dtype)
    return conclude(
        SE3.from_rotation_and_translation(rotation, refined.model - center),
        _joint_covariance(refined.covariance, spread, problem, points_cam, weight, loss),
        refined.result,
        jnp.where(points_cam[:, 2] > 0, jnp.sum(error * error, axis=1), jnp.inf),
        placeholder=SE3.identity(dtype=dtype),
        consensus=consensus,
        mask=mask,
        sample_size=2,
        chance=chance,
        limit=options.threshold_px**2,
    )


def _joint_covariance(
    of_shift: Float[Array, "3 3"],
    of_turn: Float[Array, "3 3"],
    problem: TranslationProblem,
    points_cam: Float[Array, "n 3"],
    weight: Float[Array, " n"],
    loss: Loss,
) -> Float[Array, "6 6"]:
    """Covariance of (ρ, φ): a turn φ moves the best shift by −G φ with G = H_ρρ⁻¹ H_ρφ."""
    problem, points, loss = jax.lax.stop_gradient((problem, points_cam, loss))
    components = tuple(points[:, i] for i in range(3))
    one, zero = jnp.ones_like(weight), jnp.zeros_like(weight)
    _, moved = jax.linearize(lambda *xyz: robustify(problem.errors(*xyz), loss, weight), *components)
    # Rows of the two residuals by x, y, z.
    columns = [jnp.stack(moved(*(one if i == j else zero for i in range(3)))) for j in range(3)]
    by_point = jnp.stack(columns, axis=-1)  # [2, n, 3]
    # dX = −ρ + X × φ, so the row by φ is (row by X) × X.
    by_turn = jnp.cross(by_point, jnp.broadcast_to(points[None], by_point.shape))
    cross = -jnp.einsum("knc,knd->cd", by_point, by_turn, precision="highest")
    carried = of_shift @ cross @ of_turn
    shift = of_shift + carried @ cross.T @ of_shift.T
    return jnp.block([[shift, -carried], [-carried.T, of_turn]])
