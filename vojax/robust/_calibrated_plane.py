"""Two calibrated views of a plane, or from one place: homographies of rays, of which rotations are a special case.

Both move rays linearly, ray1 ~ H ray0 with H = R + t nᵀ/d for a plane nᵀX = d and H = R for a camera that only turned,
and are judged by the same Sampson distance in pixels, whatever the cameras.

References: R. Hartley, A. Zisserman. Multiple View Geometry in Computer Vision, 2nd edition, sections 8.4.2 and 13.1.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import dot3
from vojax._types import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray
from vojax.ba import (
    GaussianUniform,
    HomographyProblem,
    LMOptions,
    PixelRays,
    Tukey,
    homography_basis,
    homography_residual,
    polish_model,
    refine_model,
    step_rotation,
)
from vojax.lie import SO3
from vojax.solvers import rotation_from_rays, unit_matrix

from ._buckets import in_bucket
from ._conclude import conclude
from ._engine import search
from ._estimate import Estimate
from ._matrix_models import HomographyEstimator
from ._options import RansacOptions
from ._pairs import (
    checked_pairs,
    masked_pairs,
    matrix_lanes,
    matrix_rows,
    noisy_rays,
    pair_rays,
    root_mean_square,
    single_precision,
    usable_noise,
)
from ._significance import chance_in_image, even_odds_in_pixels


class ImagePlane(eqx.Module):
    """A camera whose rays have third component one; rays that do not point forward are (0, 0, 1)."""

    camera: Any

    def unproject(self, pixels: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
        """Points on the plane z = 1."""
        rays = self.camera.unproject(pixels)
        depth = rays[:, 2:]
        forward = depth > 1e-3 * jnp.sqrt(jnp.sum(jax.lax.stop_gradient(rays) ** 2, axis=1, keepdims=True))
        onto = rays / jnp.where(forward, depth, 1.0)
        return jnp.where(forward, onto, jnp.array([0.0, 0.0, 1.0], rays.dtype)[None])

    def sees(self, pixels: Float[Array, "n 2"]) -> Bool[Array, " n"]:
        """Which rays point forward."""
        rays = jax.lax.stop_gradient(self.camera.unproject(pixels))
        return rays[:, 2] > 1e-3 * jnp.sqrt(jnp.sum(rays * rays, axis=1))


class RotationProblem(eqx.Module):
    """`cam1_from_cam0` of a camera that turned; the tangent φ is in camera 1. Rays of view 1 have third component 1."""

    view0: PixelRays
    view1: PixelRays
    tangent_dim: ClassVar[int] = 3

    @staticmethod
    def retract(model: SO3, tangent: Array) -> SO3:
        """exp(−φ) @ cam1_from_cam0."""
        return step_rotation(model, tangent)

    def residual(self, model: SO3) -> tuple[Array, ...]:
        """Whitened Sampson residuals, two for each pair."""
        r = model.as_matrix()
        rows = [(r[i, 0], r[i, 1], r[i, 2]) for i in range(3)]
        return homography_residual(rows, self.view0.components, self.view1.components)


class RotationEstimator(eqx.Module):
    """Rotations, row by row, against rays with their derivatives by the pixels."""

    view0: PixelRays
    view1: PixelRays
    limit: float = eqx.field(static=True)
    local_steps: int = eqx.field(static=True)
    model_size: int = eqx.field(static=True, default=9)
    sample_size: int = eqx.field(static=True, default=2)
    chunk_size: int = eqx.field(static=True, default=128)

    @property
    def observations(self) -> tuple[Array, ...]:
        """Rays and their derivatives, of both views."""
        return (*self.view0.components, *self.view1.components)

    def hypothesize(self, sample: Int[Array, "m k"]) -> tuple[Float[Array, "9 k"], Bool[Array, " k"]]:
        """Two rays on each sample."""
        rays0, rays1 = (jnp.stack([c[sample] for c in view.ray], axis=1) for view in (self.view0, self.view1))
        candidates = jax.vmap(rotation_from_rays, in_axes=-1, out_axes=-1)(rays0, rays1)
        return rotation_entries(candidates.models.wxyz[0]), candidates.valid[0]

    def squared_error(self, models: Float[Array, "9 *lanes"], observation: tuple[Array, ...]) -> Array:
        """Squared Sampson distance in px²; points that would be behind camera 1 are infinitely wrong."""
        rows = matrix_rows(models)
        d1, d2 = homography_residual(rows, observation[:9], observation[9:])
        return jnp.where(dot3(rows[2], observation[:3]) > 0, d1 * d1 + d2 * d2, jnp.inf)

    def polish(self, model: Float[Array, "9"], mask: Bool[Array, " n"]) -> Float[Array, "9"]:
        """A few steps of reweighted Gauss–Newton."""
        problem, loss = RotationProblem(self.view0, self.view1), Tukey(2.0 * self.limit**0.5)
        start, weight = _rotation(model), mask.astype(model.dtype)
        return rotation_entries(polish_model(start, problem, weight=weight, loss=loss, steps=self.local_steps).wxyz)


def rotation_entries(wxyz: Float[Array, "4 *lanes"]) -> Float[Array, "9 *lanes"]:
    """Matrices of quaternions in the lanes, row by row."""
    motion = matrix_lanes(jnp.concatenate([wxyz, jnp.zeros_like(wxyz[:3])]))
    return jnp.concatenate([motion[0:3], motion[4:7], motion[8:11]])


def _rotation(entries: Float[Array, "9"]) -> SO3:
    """The rotation of a matrix; the identity for zeros, which a search without any hypothesis ends with."""
    return SO3.from_matrix(jnp.where(jnp.all(entries == 0), jnp.eye(3, dtype=entries.dtype), entries.reshape(3, 3)))


def estimate_rotation(
    pixels0: Float[ArrayLike, "n 2"],
    pixels1: Float[ArrayLike, "n 2"],
    camera0: Any,
    camera1: Any,
    *,
    key: PRNGKeyArray | Array,
    options: RansacOptions = RansacOptions(),
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    quality: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Estimate[SO3]:
    """Estimate how a camera turned in place from matching pixels, some of which are wrong.

    Args:
        pixels0: Pixels of view 0.
        pixels1: The matching pixels of view 1.
        camera0: Camera of view 0, of `vojax.cameras`.
        camera1: Camera of view 1.
        key: Random key; the same key gives the same answer, bit for bit.
        options: Of the search. Inliers have a Sampson distance, which shares the error between both images, within
            `threshold_px` pixels.
        sigma_px: Noise of the pixels, as for `estimate_homography`.
        quality: Of each correspondence, higher is better; guides the sampling.
        mask: False for padding.

    Returns:
        `model` is `cam1_from_cam0`; `covariance` that of the tangent φ in camera 1: the true rotation is
        exp(−φ) @ model.

    Degenerate input: fewer valid correspondences than three, or no more agreement than chance would give end with a
        result code, the identity as model and zero covariance; never NaN. Pixels that do not look forward count as
        masked. A translation shows as errors, not in the result.
    Differentiability: both modes, in pixels, cameras and noise, through the last refinement by the implicit function
        theorem with the exact Hessian; the choice of inliers is constant.

    Raises:
        ValueError: If shapes do not fit or there are fewer than two correspondences.
    References: see the module.
    """
    first, second = checked_pairs(pixels0, pixels1, 2, "a rotation")
    return in_bucket(_estimate, (first, second), (True, camera0, camera1, key, options), sigma_px, quality, mask)


def estimate_calibrated_homography(
    pixels0: Array,
    pixels1: Array,
    camera0: Any,
    camera1: Any,
    *,
    key: PRNGKeyArray | Array,
    options: RansacOptions,
    sigma_px: Any,
    quality: Any,
    mask: Any,
) -> Estimate[Float[Array, "3 3"]]:
    """Estimate H with ray1 ~ H ray0, norm 1, largest entry positive: `estimate_homography` for any cameras.

    `covariance` is that of the coordinates of a change of H in `vojax.ba.homography_basis(H)`.
    """
    first, second = checked_pairs(pixels0, pixels1, 4, "a homography")
    return in_bucket(_estimate, (first, second), (False, camera0, camera1, key, options), sigma_px, quality, mask)


@eqx.filter_jit
def _estimate(
    pixels0: Array,
    pixels1: Array,
    rotates: bool,
    camera0: Any,
    camera1: Any,
    key: Any,
    options: RansacOptions,
    sigma_px: Any,
    quality: Any,
    mask: Any,
) -> Estimate[Any]:
    pixels0, pixels1, mask = masked_pairs(pixels0, pixels1, mask)
    plane0, plane1 = ImagePlane(camera0), ImagePlane(camera1)
    sigma_px, mask = usable_noise(sigma_px, mask)
    mask = mask & plane0.sees(pixels0) & plane1.sees(pixels1)
    dtype = pixels0.dtype
    unit = pair_rays(pixels0, pixels1, plane0, plane1)
    kind = RotationEstimator if rotates else HomographyEstimator
    estimator = kind(*single_precision(unit), limit=options.threshold_px**2, local_steps=options.local_steps)
    consensus = search(estimator, mask, single_precision(quality), key, options)
    entries = consensus.model.astype(dtype)
    start: Any = _rotation(entries) if rotates else entries.reshape(3, 3)

    sigma = root_mean_square(sigma_px, mask).astype(dtype)
    chance = chance_in_image(pixels1, mask, options.threshold_px)
    cut = even_odds_in_pixels(consensus.inliers, mask, sigma, chance, options.threshold_px)
    problem_kind: Any = RotationProblem if rotates else HomographyProblem
    refined = refine_model(
        start,
        problem_kind(*noisy_rays(unit, sigma_px)),
        weight=mask.astype(dtype),
        loss=GaussianUniform(cut),
        options=LMOptions(max_steps=options.final_steps),
    )
    model: Any = refined.model
    covariance = refined.covariance
    if not rotates:
        tangent = jnp.zeros((8,), dtype)
        change = jax.jacfwd(lambda y: unit_matrix(HomographyProblem.retract(refined.model, y))[0])(tangent)
        model = unit_matrix(model)[0]
        # The sign may change, and with it the basis.
        chart = jax.lax.stop_gradient(homography_basis(model).T @ change.reshape(9, -1))
        covariance = chart @ covariance @ chart.T
    entries = rotation_entries(model.wxyz) if rotates else model.reshape(9)
    judge = kind(*unit, limit=options.threshold_px**2, local_steps=options.local_steps)
    return conclude(
        model,
        covariance,
        refined.result,
        judge.squared_error(entries[:, None], judge.observations),
        placeholder=SO3.identity(dtype=dtype) if rotates else jnp.zeros_like(model),
        consensus=consensus,
        mask=mask,
        sample_size=estimator.sample_size,
        chance=chance,
        limit=options.threshold_px**2,
    )
