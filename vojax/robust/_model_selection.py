"""Which geometry do two views have: a general scene, a plane, or a camera that only turned.

A more general model always fits better, so fit has to be weighed against what a model leaves open. Torr's geometric
robust information criterion does it for models that bind an observation to a manifold of d dimensions (of the four
numbers of a match) with k parameters:

    GRIC = Σ min(e²/σ², T) + n d log 4 + k log 4n,                                                                (1)

with d = 3 and k = 5 for an essential matrix, d = 2 and k = 8 for a homography, d = 2 and k = 3 for a rotation. Two
things are other than in the paper. T is the 99 % quantile of the χ² distribution of 4 − d degrees of freedom instead of
2 (4 − d), which cuts off one in six good matches and tells a plane from a scene with much of it in one plane less well.
And the sum is over the matches that at least one of the models explains, as T depends on d and with many wrong matches
that alone would decide. Matches that only the essential matrix explains count if there are more of them than chance
would give (a-contrario test).

References: P. Torr. Bayesian model estimation and selection for epipolar geometry and generic manifold fitting. IJCV
2002, eq. (44).
"""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._result import Result
from vojax._types import Array, ArrayLike, Bool, Float, PRNGKeyArray
from vojax.ba import HomographyProblem, RelativePoseProblem
from vojax.lie import SE3, SO3

from ._calibrated_plane import ImagePlane, RotationProblem, estimate_calibrated_homography, estimate_rotation
from ._estimate import Estimate
from ._noise_scale import noise_scale
from ._options import RansacOptions
from ._pairs import check_sigma, checked_pairs, masked_pairs, noisy_rays, pair_rays, root_mean_square, usable_noise
from ._relative_pose import estimate_relative_pose, in_front
from ._significance import chance_near_line, is_significant

_QUANTILE = {1: 6.635, 2: 9.210}  # of χ², 99 %
_ALIKE = 1.3  # ratio of measured deviations up to which they mean the same noise


class TwoViewModel(eqx.Enumeration):
    """What explains two views. `TwoViewModel[code]` is the sentence of a code; compare codes with `==`."""

    none = "No model had more supporters than chance would give it."
    general = "A camera that moved and a scene with depth: the relative pose."
    planar = "A camera that moved before a plane: the homography, and the relative pose."
    rotation = "A camera that turned in place, or far from the scene: the rotation; no translation can be told."


class TwoViewSelection(eqx.Module):
    """Three estimates of two views, and which of them to take.

    Attributes:
        model: The model with the lowest criterion.
        relative_pose: `cam1_from_cam0`, |t| = 1; as from `estimate_relative_pose`. Means nothing for a rotation.
        homography: H with ray1 ~ H ray0 (for `decompose_homography`); tangent as for `estimate_homography`.
        rotation: `cam1_from_cam0`; as from `estimate_rotation`.
        criterion: GRIC of the three in this order; infinite where there was no consensus.
        sigma_px: The noise that the criterion took, relative to the stated one where there is one of each match.
    """

    model: TwoViewModel
    relative_pose: Estimate[SE3]
    homography: Estimate[Float[Array, "3 3"]]
    rotation: Estimate[SO3]
    criterion: Float[Array, "3"]
    sigma_px: Float[Array, ""]


def select_two_view_model(
    pixels0: Float[ArrayLike, "n 2"],
    pixels1: Float[ArrayLike, "n 2"],
    camera0: Any,
    camera1: Any,
    *,
    key: PRNGKeyArray | Array,
    options: RansacOptions = RansacOptions(threshold_px=1.5),
    sigma_px: Float[ArrayLike, "..."] | float | None = None,
    quality: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> TwoViewSelection:
    """Estimate relative pose, homography and rotation of two calibrated views, and say which one explains them.

    Args:
        pixels0: Pixels of view 0.
        pixels1: The matching pixels of view 1.
        camera0: Camera of view 0, of `vojax.cameras`.
        camera1: Camera of view 1.
        key: Random key; the same key gives the same answer, bit for bit.
        options: Of the searches. `threshold_px` bounds the distance from epipolar lines; that from a point, of
            homography and rotation, may be twice as much.
        sigma_px: Noise of the pixels, as for `estimate_relative_pose`. The choice depends on it: with half the true
            noise planes look general. None measures it, at the relative pose, or where there is none at the homography
            (`noise_scale`), and estimates the models with 1 px.
        quality: Of each correspondence, higher is better; guides the sampling.
        mask: False for padding.

    Returns:
        The three estimates, their criteria and the choice.

    Degenerate input: as of the estimators; where none has a consensus the model is `none`. A scene with more than about
        nine tenths of its matches in one plane, or a baseline that moves no match by more than its noise, is taken for
        the simpler model.
    Differentiability: the estimates as those of the estimators; the choice is constant.

    Raises:
        ValueError: If shapes do not fit or there are fewer than five correspondences.
    References: see the module.
    """
    first, second = checked_pairs(pixels0, pixels1, 5, "a relative pose")
    if sigma_px is not None:
        check_sigma(sigma_px, len(first))
    keys = jax.random.split(key, 3)
    stated = jnp.asarray(1.0 if sigma_px is None else sigma_px, first.dtype)
    views = (first, second, camera0, camera1)
    more = {"sigma_px": stated, "quality": quality, "mask": mask}
    wide = dataclasses.replace(options, threshold_px=2.0 * options.threshold_px)
    # Three programs, not one: each compiles in seconds.
    relative_pose = estimate_relative_pose(*views, key=keys[0], options=options, **more)
    homography = estimate_calibrated_homography(*views, key=keys[1], options=wide, **more)
    rotation = estimate_rotation(*views, key=keys[2], options=wide, **more)
    model, criterion, sigma = _select(*views, stated, mask, sigma_px is None, relative_pose, homography, rotation)
    return TwoViewSelection(model, relative_pose, homography, rotation, criterion, sigma)


@eqx.filter_jit
def _select(
    pixels0: Array,
    pixels1: Array,
    camera0: Any,
    camera1: Any,
    sigma_px: Any,
    mask: Any,
    measure: bool,
    relative_pose: Estimate[SE3],
    homography: Estimate[Array],
    rotation: Estimate[SO3],
) -> tuple[TwoViewModel, Array, Array]:
    pixels0, pixels1, mask = masked_pairs(pixels0, pixels1, mask)
    sigma_px, mask = usable_noise(sigma_px, mask)
    dtype = pixels0.dtype
    estimates = (relative_pose, homography, rotation)
    usable = jnp.stack([(x.result == Result.success) | (x.result == Result.not_converged) for x in estimates])
    views = noisy_rays(pair_rays(pixels0, pixels1, camera0, camera1), sigma_px)
    planes = ImagePlane(camera0), ImagePlane(camera1)
    plane_views = noisy_rays(pair_rays(pixels0, pixels1, *planes), sigma_px)
    forward = planes[0].sees(pixels0) & planes[1].sees(pixels1)

    def squared(problem: Any, model: Any, possible: Array) -> Array:
        error = sum(r * r for r in problem.residual(model))
        return jax.lax.stop_gradient(jnp.where(mask & possible, error, jnp.inf))

    front = in_front(relative_pose.model, *views)
    # Errors in standard deviations, components of the errors, parameters.
    judged = [
        (squared(RelativePoseProblem(*views), relative_pose.model, front), 1, 5),
        (squared(HomographyProblem(*plane_views), homography.model, forward), 2, 8),
        (squared(RotationProblem(*plane_views), rotation.model, forward), 2, 3),
    ]
    scale = jnp.ones((), dtype)
    if measure:
        by_pose, by_homography, by_rotation = (
            noise_scale(e, dimension=d, model_dof=k, mask=mask).sigma for e, d, k in judged
        )
        scale = jnp.where(
            usable[0], by_pose, jnp.where(usable[1], by_homography, jnp.where(usable[2], by_rotation, 1.0))
        )
        # Where a simpler model holds, many poses do, and the one that fits best has a little less than the noise.
        for ok, other in ((usable[1], by_homography), (usable[2], by_rotation)):
            scale = jnp.where(ok & (other < _ALIKE * scale), jnp.maximum(scale, other), scale)
        # Without noise at all the criterion would compare rounding.
        scale = jnp.maximum(scale, 1e-3)
    judged = [(error / (scale * scale), d, k) for error, d, k in judged]
    by_each = [ok & (e <= _QUANTILE[d]) for ok, (e, d, _) in zip(usable, judged, strict=True)]
    simple = by_each[1] | by_each[2]
    # On a plane or after a turn the epipole is free to explain wrong matches: two determine it, more do so by chance.
    sigma = scale * root_mean_square(sigma_px, mask).astype(dtype)
    chance = chance_near_line(pixels1, mask, _QUANTILE[1] ** 0.5 * sigma)
    alone = by_each[0] & ~simple
    counts = is_significant(jnp.sum(alone), jnp.sum(mask & ~simple), 2, chance)
    explained = simple | (alone & counts)
    n = jnp.sum(explained).astype(dtype)
    criteria = []
    for ok, (error, d, k) in zip(usable, judged, strict=True):
        fit = jnp.sum(jnp.where(explained, jnp.minimum(error, _QUANTILE[d]), 0.0))
        price = n * (4 - d) * math.log(4.0) + k * jnp.log(4.0 * jnp.maximum(n, 1.0))
        criteria.append(jnp.where(ok, fit + price, jnp.inf))
    criterion = jnp.stack(criteria)
    best = jnp.argmin(criterion)
    model = TwoViewModel.where(best == 1, TwoViewModel.planar, TwoViewModel.general)
    model = TwoViewModel.where(best == 2, TwoViewModel.rotation, model)
    model = TwoViewModel.where(jnp.any(usable), model, TwoViewModel.none)
    return model, criterion, scale
