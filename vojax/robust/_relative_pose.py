"""Robust relative pose of two calibrated views: five-point hypotheses, Sampson distances, refinement on SO3 × S².

References: D. Nistér. An efficient solution to the five-point relative pose problem. PAMI 2004; R. Hartley, A.
Zisserman. Multiple View Geometry in Computer Vision, 2nd edition, section 11.4.3.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax._numerics import cross3, dot3
from vojax._types import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray
from vojax.ba import (
    GaussianUniform,
    LMOptions,
    PixelRays,
    RelativePoseProblem,
    Tukey,
    epipolar_terms,
    polish_model,
    refine_model,
)
from vojax.geometry import essential_from_pose, pose_from_essential
from vojax.lie import SE3
from vojax.solvers import five_point
from vojax.solvers._essential_newton import motion_from_essential

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
    pair_rays,
    root_mean_square,
    single_precision,
    usable_noise,
)
from ._significance import SQRT_TAU, chance_near_line, even_odds

_SIDEWAYS = np.array([0, 0, 0, 0, 0, -1, 0, 1, 0], np.float32)  # [t]× of a motion to the right


class RelativePoseEstimator(eqx.Module):
    """Essential matrices, row by row, against rays with their derivatives by the pixels."""

    view0: PixelRays
    view1: PixelRays
    limit: float = eqx.field(static=True)
    local_steps: int = eqx.field(static=True)
    model_size: int = eqx.field(static=True, default=9)
    sample_size: int = eqx.field(static=True, default=5)
    chunk_size: int = eqx.field(static=True, default=128)

    @property
    def observations(self) -> tuple[Array, ...]:
        """Rays and their derivatives, of both views."""
        return (*self.view0.components, *self.view1.components)

    def hypothesize(self, sample: Int[Array, "m k"]) -> tuple[Float[Array, "9 ks"], Bool[Array, " ks"]]:
        """Five-point on each sample; ten lanes for the ten slots."""
        rays0, rays1 = (jnp.stack([c[sample] for c in view.ray], axis=1) for view in (self.view0, self.view1))
        candidates = jax.vmap(five_point, in_axes=-1, out_axes=-1)(rays0, rays1)
        models = jnp.moveaxis(candidates.models, 0, 2)
        return models.reshape(9, -1), candidates.valid.reshape(-1)

    def squared_error(self, models: Float[Array, "9 *lanes"], observation: tuple[Array, ...]) -> Array:
        """Squared Sampson distance in px²."""
        error, slope = epipolar_terms(matrix_rows(models), observation[:9], observation[9:])
        return error * error / jnp.maximum(slope, 1e-30)

    def polish(self, model: Float[Array, "9"], mask: Bool[Array, " n"]) -> Float[Array, "9"]:
        """A few steps of reweighted Gauss–Newton on SO3 × S²."""
        problem = RelativePoseProblem(self.view0, self.view1)
        # Any of the four motions has the same epipolar geometry. The unit of the residuals is the pixel.
        wxyz, t = motion_from_essential(model)
        start = SE3(jnp.stack([*wxyz, *t]))
        loss = Tukey(2.0 * self.limit**0.5)
        pose = polish_model(start, problem, weight=mask.astype(model.dtype), loss=loss, steps=self.local_steps)
        return essential_from_pose(pose).reshape(9)


def estimate_relative_pose(
    pixels0: Float[ArrayLike, "n 2"],
    pixels1: Float[ArrayLike, "n 2"],
    camera0: Any,
    camera1: Any,
    *,
    key: PRNGKeyArray | Array,
    options: RansacOptions = RansacOptions(threshold_px=1.5),
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    quality: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Estimate[SE3]:
    """Estimate how one calibrated view stands to another from matching pixels, some of which are wrong.

    Args:
        pixels0: Pixels of view 0.
        pixels1: The matching pixels of view 1.
        camera0: Camera of view 0, of `vojax.cameras`.
        camera1: Camera of view 1.
        key: Random key; the same key gives the same answer, bit for bit.
        options: Of the search. Inliers have a Sampson distance within `threshold_px` pixels.
        sigma_px: Noise of the pixels, which scales the covariance and weighs the last refinement: one standard
            deviation, one for each correspondence, or the covariances of both views `[n, 2, 2, 2]` in px².
        quality: Of each correspondence, higher is better; guides the sampling.
        mask: False for padding.

    Returns:
        `model` is `cam1_from_cam0` with |t| = 1; of the four motions of the essential matrix the one that has most
        points in front. `covariance` is that of the five-dimensional tangent (τ, φ): the true pose is
        exp(−(τ₁ b₁ + τ₂ b₂, φ)) @ model, with b₁, b₂ the columns of `translation_basis(model)`.

    Degenerate input: fewer valid correspondences than six, no more agreement than chance would give, or samples
        without solution end with a result code, the identity as model and zero covariance; never NaN. A pure rotation
        leaves the translation undetermined: the result is `degenerate`, or the covariance of the translation is huge.
    Differentiability: both modes, in pixels, cameras and noise, through the last refinement by the implicit function
        theorem with the exact Hessian; the choice of inliers is constant.

    Raises:
        ValueError: If shapes do not fit or there are fewer than five correspondences.
    References: see the module.
    """
    first, second = checked_pairs(pixels0, pixels1, 5, "a relative pose")
    return in_bucket(_estimate, (first, second), (camera0, camera1, key, options), sigma_px, quality, mask)


@eqx.filter_jit
def _estimate(
    pixels0: Array,
    pixels1: Array,
    camera0: Any,
    camera1: Any,
    key: Any,
    options: RansacOptions,
    sigma_px: Any,
    quality: Any,
    mask: Any,
) -> Estimate[SE3]:
    pixels0, pixels1, mask = masked_pairs(pixels0, pixels1, mask)
    sigma_px, mask = usable_noise(sigma_px, mask)
    unit = pair_rays(pixels0, pixels1, camera0, camera1)
    estimator = RelativePoseEstimator(
        *single_precision(unit), limit=options.threshold_px**2, local_steps=options.local_steps
    )
    consensus = search(estimator, mask, single_precision(quality), key, options)
    view0, view1 = noisy_rays(unit, sigma_px)
    rays0, rays1 = jax.lax.stop_gradient([jnp.stack(view.ray, axis=1) for view in (view0, view1)])
    weight = consensus.inliers.astype(pixels0.dtype)
    # A search without any hypothesis ends with zeros: give them a translation.
    essential = jnp.where(jnp.any(consensus.model != 0), consensus.model, _SIDEWAYS).reshape(3, 3)
    start, _ = pose_from_essential(essential.astype(pixels0.dtype), rays0, rays1, weight)
    start = jax.lax.stop_gradient(start)
    chance = chance_near_line(pixels1, mask, options.threshold_px)
    # All observations take part in the last refinement, weighted by how likely they are inliers: cutting them off at
    # the threshold would throw away what the tails of the noise say.
    sigma = root_mean_square(sigma_px, mask)
    cut = even_odds(
        jnp.sum(consensus.inliers), jnp.sum(mask), 1.0 / (sigma * SQRT_TAU), chance / (2.0 * options.threshold_px)
    )
    front = in_front(start, view0, view1)
    refined = refine_model(
        start,
        RelativePoseProblem(view0, view1),
        weight=(mask & front).astype(pixels0.dtype),
        loss=GaussianUniform(cut),
        options=LMOptions(max_steps=options.final_steps),
    )
    (distance,) = RelativePoseProblem(*unit).residual(refined.model)
    return conclude(
        refined.model,
        refined.covariance,
        refined.result,
        jnp.where(front, distance * distance, jnp.inf),
        placeholder=SE3.identity(dtype=pixels0.dtype),
        consensus=consensus,
        mask=mask,
        sample_size=5,
        chance=chance,
        limit=options.threshold_px**2,
    )


def in_front(cam1_from_cam0: SE3, view0: PixelRays, view1: PixelRays) -> Bool[Array, " n"]:
    """Which points lie in front of both cameras, or too far away for the noise to tell; constant to differentiation.

    A wrong match that happens to lie near its epipolar line is as often behind as in front, and one with a large
    parallax would pull harder at the pose than any true one.
    """
    cam1_from_cam0, view0, view1 = jax.lax.stop_gradient((cam1_from_cam0, view0, view1))
    r, t = cam1_from_cam0.rotation().as_matrix(), cam1_from_cam0.translation()
    p = tuple(dot3((r[i, 0], r[i, 1], r[i, 2]), view0.ray) for i in range(3))
    q, shift = view1.ray, (t[0], t[1], t[2])
    normal = cross3(p, q)
    distance0, distance1 = dot3(normal, cross3(q, shift)), dot3(normal, cross3(p, shift))
    # The variance of the angle between the rays, summed over both views; below 3 deviations (√8) it means nothing.
    noise = sum(dot3(x, x) for view in (view0, view1) for x in (view.by_u, view.by_v))
    far = (dot3(normal, normal) < 8.0 * noise) & (dot3(p, q) > 0)
    return far | ((distance0 > 0) & (distance1 > 0))
