"""Robust fundamental matrices and homographies of two images without calibration.

Both are searched and refined in coordinates of order one (Hartley) and handed out for pixels, norm 1 and fixed sign.

References: R. Hartley, A. Zisserman. Multiple View Geometry in Computer Vision, 2nd edition, sections 4.7 and 11.6.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray
from vojax.ba import (
    FundamentalProblem,
    GaussianUniform,
    HomographyProblem,
    LMOptions,
    PixelRays,
    Tukey,
    epipolar_terms,
    fundamental_basis,
    homography_basis,
    homography_residual,
    polish_model,
    refine_model,
    to_rank_two,
)
from vojax.solvers import homography_four_point, seven_point, unit_matrix

from ._buckets import in_bucket
from ._conclude import conclude
from ._engine import search
from ._estimate import Estimate
from ._options import RansacOptions
from ._pairs import (
    checked_pairs,
    masked_pairs,
    matrix_rows,
    noisy_rays,
    normalising_plane,
    pair_rays,
    root_mean_square,
    single_precision,
    usable_noise,
)
from ._significance import SQRT_TAU, chance_in_image, chance_near_line, even_odds


class FundamentalEstimator(eqx.Module):
    """Fundamental matrices, row by row, against homogeneous coordinates of order one."""

    view0: PixelRays
    view1: PixelRays
    limit: float = eqx.field(static=True)
    local_steps: int = eqx.field(static=True)
    model_size: int = eqx.field(static=True, default=9)
    sample_size: int = eqx.field(static=True, default=7)
    chunk_size: int = eqx.field(static=True, default=256)

    @property
    def observations(self) -> tuple[Array, ...]:
        """Coordinates and their derivatives by the pixels, of both views."""
        return (*self.view0.components, *self.view1.components)

    def hypothesize(self, sample: Int[Array, "m k"]) -> tuple[Float[Array, "9 ks"], Bool[Array, " ks"]]:
        """Seven points on each sample; three lanes for the three slots."""
        return _hypotheses(seven_point, self.view0, self.view1, sample)

    def squared_error(self, models: Float[Array, "9 *lanes"], observation: tuple[Array, ...]) -> Array:
        """Squared Sampson distance in px²."""
        error, slope = epipolar_terms(matrix_rows(models), observation[:9], observation[9:])
        return error * error / jnp.maximum(slope, 1e-30)

    def polish(self, model: Float[Array, "9"], mask: Bool[Array, " n"]) -> Float[Array, "9"]:
        """A few steps of reweighted Gauss–Newton on matrices of rank two."""
        problem = FundamentalProblem(self.view0, self.view1)
        loss = Tukey(2.0 * self.limit**0.5)
        weight = mask.astype(model.dtype)
        start = to_rank_two(model.reshape(3, 3))
        return polish_model(start, problem, weight=weight, loss=loss, steps=self.local_steps).reshape(9)


class HomographyEstimator(eqx.Module):
    """Homographies, row by row, against homogeneous coordinates of order one."""

    view0: PixelRays
    view1: PixelRays
    limit: float = eqx.field(static=True)
    local_steps: int = eqx.field(static=True)
    model_size: int = eqx.field(static=True, default=9)
    sample_size: int = eqx.field(static=True, default=4)
    chunk_size: int = eqx.field(static=True, default=512)

    @property
    def observations(self) -> tuple[Array, ...]:
        """Coordinates and their derivatives by the pixels, of both views."""
        return (*self.view0.components, *self.view1.components)

    def hypothesize(self, sample: Int[Array, "m k"]) -> tuple[Float[Array, "9 ks"], Bool[Array, " ks"]]:
        """Four points on each sample."""
        return _hypotheses(homography_four_point, self.view0, self.view1, sample)

    def squared_error(self, models: Float[Array, "9 *lanes"], observation: tuple[Array, ...]) -> Array:
        """Squared Sampson distance in px²; points on the horizon are infinitely wrong."""
        d1, d2 = homography_residual(matrix_rows(models), observation[:9], observation[9:])
        return d1 * d1 + d2 * d2

    def polish(self, model: Float[Array, "9"], mask: Bool[Array, " n"]) -> Float[Array, "9"]:
        """A few steps of reweighted Gauss–Newton."""
        problem = HomographyProblem(self.view0, self.view1)
        loss = Tukey(2.0 * self.limit**0.5)
        weight = mask.astype(model.dtype)
        return polish_model(model.reshape(3, 3), problem, weight=weight, loss=loss, steps=self.local_steps).reshape(9)


def _hypotheses(
    solver: Callable[..., Any], view0: PixelRays, view1: PixelRays, sample: Int[Array, "m k"]
) -> tuple[Array, Array]:
    points0, points1 = (jnp.stack([c[sample] for c in view.ray[:2]], axis=1) for view in (view0, view1))
    candidates = jax.vmap(solver, in_axes=-1, out_axes=-1)(points0, points1)
    return jnp.moveaxis(candidates.models, 0, 2).reshape(9, -1), candidates.valid.reshape(-1)


def estimate_fundamental(
    pixels0: Float[ArrayLike, "n 2"],
    pixels1: Float[ArrayLike, "n 2"],
    *,
    key: PRNGKeyArray | Array,
    options: RansacOptions = RansacOptions(threshold_px=1.5, max_hypotheses=16384),
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    quality: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Estimate[Float[Array, "3 3"]]:
    """Estimate the fundamental matrix of two images from matching pixels, some of which are wrong.

    Args:
        pixels0: Pixels of image 0, without distortion.
        pixels1: The matching pixels of image 1.
        key: Random key; the same key gives the same answer, bit for bit.
        options: Of the search. Inliers have a Sampson distance within `threshold_px` pixels.
        sigma_px: Noise of the pixels, which scales the covariance and weighs the last refinement: one standard
            deviation, one for each correspondence, or the covariances of both images `[n, 2, 2, 2]` in px².
        quality: Of each correspondence, higher is better; guides the sampling.
        mask: False for padding.

    Returns:
        `model` is F with `pixel1ᵀ F pixel0 = 0`, rank 2, norm 1, largest entry positive. `covariance` is that of the
        seven coordinates of a change of F in `vojax.ba.fundamental_basis(F)`.

    Degenerate input: fewer valid correspondences than eight, no more agreement than chance would give, or samples
        without solution end with a result code, the zero matrix as model and zero covariance; never NaN. Points on a
        plane leave F undetermined.
    Differentiability: both modes, in pixels and noise, through the last refinement by the implicit function theorem
        with the exact Hessian; the choice of inliers is constant.

    Raises:
        ValueError: If shapes do not fit or there are fewer than seven correspondences.
    References: see the module.
    """
    first, second = checked_pairs(pixels0, pixels1, 7, "a fundamental matrix")
    return in_bucket(_fundamental, (first, second), (key, options), sigma_px, quality, mask)


def estimate_homography(
    pixels0: Float[ArrayLike, "n 2"],
    pixels1: Float[ArrayLike, "n 2"],
    *,
    key: PRNGKeyArray | Array,
    options: RansacOptions = RansacOptions(),
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    quality: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Estimate[Float[Array, "3 3"]]:
    """Estimate the homography between two images from matching pixels, some of which are wrong.

    Args:
        pixels0: Pixels of image 0.
        pixels1: The matching pixels of image 1.
        key: Random key; the same key gives the same answer, bit for bit.
        options: Of the search. Inliers have a Sampson distance, which shares the error between both images, within
            `threshold_px` pixels.
        sigma_px: Noise of the pixels, which scales the covariance and weighs the last refinement: one standard
            deviation, one for each correspondence, or the covariances of both images `[n, 2, 2, 2]` in px².
        quality: Of each correspondence, higher is better; guides the sampling.
        mask: False for padding.

    Returns:
        `model` is H that takes pixels of image 0 to image 1, norm 1, largest entry positive. `covariance` is that of
        the eight coordinates of a change of H in `vojax.ba.homography_basis(H)`.

    Degenerate input: fewer valid correspondences than five, no more agreement than chance would give, or samples
        without solution end with a result code, the zero matrix as model and zero covariance; never NaN.
    Differentiability: both modes, in pixels and noise, through the last refinement by the implicit function theorem
        with the exact Hessian; the choice of inliers is constant.

    Raises:
        ValueError: If shapes do not fit or there are fewer than four correspondences.
    References: see the module.
    """
    first, second = checked_pairs(pixels0, pixels1, 4, "a homography")
    return in_bucket(_homography, (first, second), (key, options), sigma_px, quality, mask)


@eqx.filter_jit
def _fundamental(
    pixels0: Array, pixels1: Array, key: Any, options: RansacOptions, sigma_px: Any, quality: Any, mask: Any
) -> Estimate[Array]:
    pixels0, pixels1, mask = masked_pairs(pixels0, pixels1, mask)
    sigma_px, mask = usable_noise(sigma_px, mask)
    chance = chance_near_line(pixels1, mask, options.threshold_px)
    densities = (1.0 / SQRT_TAU, chance / (2.0 * options.threshold_px))

    def from_pixels(model: Array, plane0: Any, plane1: Any) -> Array:
        return plane1.matrix().T @ model @ plane0.matrix()

    kind = (FundamentalEstimator, FundamentalProblem, to_rank_two, from_pixels, fundamental_basis)
    return _estimate(kind, 1, pixels0, pixels1, key, options, sigma_px, quality, mask, chance, densities)


@eqx.filter_jit
def _homography(
    pixels0: Array, pixels1: Array, key: Any, options: RansacOptions, sigma_px: Any, quality: Any, mask: Any
) -> Estimate[Array]:
    pixels0, pixels1, mask = masked_pairs(pixels0, pixels1, mask)
    sigma_px, mask = usable_noise(sigma_px, mask)
    chance = chance_in_image(pixels1, mask, options.threshold_px)
    densities = (1.0 / SQRT_TAU**2, chance / (jnp.pi * options.threshold_px**2))

    def from_pixels(model: Array, plane0: Any, plane1: Any) -> Array:
        s, c = plane1.scale, plane1.center
        one, zero = jnp.ones_like(s), jnp.zeros_like(s)
        rows = [[1.0 / s, zero, c[0]], [zero, 1.0 / s, c[1]], [zero, zero, one]]
        return jnp.stack([jnp.stack(row) for row in rows]) @ model @ plane0.matrix()

    kind = (HomographyEstimator, HomographyProblem, lambda model: model, from_pixels, homography_basis)
    return _estimate(kind, 2, pixels0, pixels1, key, options, sigma_px, quality, mask, chance, densities)


def _estimate(
    kind: Any,
    dimension: int,
    pixels0: Array,
    pixels1: Array,
    key: Any,
    options: RansacOptions,
    sigma_px: Any,
    quality: Any,
    mask: Array,
    chance: Array,
    densities: tuple[float, Array],
) -> Estimate[Array]:
    estimator_kind, problem_kind, onto, from_pixels, basis = kind
    plane0, plane1 = normalising_plane(pixels0, mask), normalising_plane(pixels1, mask)
    unit = pair_rays(pixels0, pixels1, plane0, plane1)
    estimator = estimator_kind(*single_precision(unit), limit=options.threshold_px**2, local_steps=options.local_steps)
    consensus = search(estimator, mask, single_precision(quality), key, options)
    start = onto(consensus.model.astype(pixels0.dtype).reshape(3, 3))

    sigma = root_mean_square(sigma_px, mask).astype(pixels0.dtype)
    cut = even_odds(jnp.sum(consensus.inliers), jnp.sum(mask), densities[0] / sigma**dimension, densities[1])
    refined = refine_model(
        start,
        problem_kind(*noisy_rays(unit, sigma_px)),
        weight=mask.astype(pixels0.dtype),
        loss=GaussianUniform(cut),
        options=LMOptions(max_steps=options.final_steps),
    )
    distance = problem_kind(*unit).residual(refined.model)

    def for_pixels(model: Array) -> Array:
        return unit_matrix(from_pixels(model, plane0, plane1))[0]

    model = for_pixels(refined.model)
    # Coordinates of the pixels' matrix by those of the normalised one.
    tangent = jnp.zeros((problem_kind.tangent_dim,), model.dtype)
    change = jax.jacfwd(lambda y: for_pixels(problem_kind.retract(refined.model, y)))(tangent)
    chart = jax.lax.stop_gradient(basis(model).T @ change.reshape(9, -1))
    return conclude(
        model,
        chart @ refined.covariance @ chart.T,
        refined.result,
        sum(d * d for d in distance),  # type: ignore[arg-type]
        placeholder=jnp.zeros_like(model),
        consensus=consensus,
        mask=mask,
        sample_size=estimator.sample_size,
        chance=chance,
        limit=options.threshold_px**2,
    )
