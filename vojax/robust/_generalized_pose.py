"""Robust pose of a rig: generalised P3P hypotheses, reprojection errors, refinement over all cameras at once.

References: D. Nistér, H. Stewénius. A minimal solution to the generalised 3-point pose problem. JMIV 2007.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray
from vojax.ba import (
    GaussianUniform,
    LMOptions,
    LocalRigPoseProblem,
    RigPoseProblem,
    Tukey,
    local_error,
    local_forms,
    polish_model,
    refine_model,
    whitening,
)
from vojax.cameras import Rig
from vojax.lie import SE3, SO3
from vojax.solvers import gp3p

from ._alignment import motion_of_entries
from ._buckets import in_bucket
from ._conclude import conclude
from ._engine import Consensus, search
from ._estimate import Estimate
from ._options import RansacOptions
from ._pairs import (
    about_middle,
    checked_observations,
    masked_pairs,
    matrix_lanes,
    root_mean_square,
    single_precision,
    usable_noise,
)
from ._significance import chance_in_image, even_odds_in_pixels


class GeneralizedPoseEstimator(eqx.Module):
    """Poses of a rig as the 12 entries of [R | t], row by row, against points and the forms of their pixels."""

    points: Float[Array, "n 3"]
    forms: tuple[Array, ...]
    centers: Float[Array, "n 3"]
    bearings: Float[Array, "n 3"]
    limit: float = eqx.field(static=True)
    local_steps: int = eqx.field(static=True)
    model_size: int = eqx.field(static=True, default=12)
    sample_size: int = eqx.field(static=True, default=3)
    chunk_size: int = eqx.field(static=True, default=128)

    @property
    def observations(self) -> tuple[Array, ...]:
        """Components of the points, then the forms of the pixels."""
        return (*(self.points[:, i] for i in range(3)), *self.forms)

    def hypothesize(self, sample: Int[Array, "m k"]) -> tuple[Float[Array, "12 ks"], Bool[Array, " ks"]]:
        """Generalised P3P on each sample; eight lanes for the eight slots."""
        data = (jnp.moveaxis(x[sample], 1, -1) for x in (self.points, self.centers, self.bearings))
        candidates = jax.vmap(gp3p, in_axes=-1, out_axes=-1)(*data)
        parameters = jnp.moveaxis(candidates.models.wxyz_xyz, 1, 0).reshape(7, -1)
        return matrix_lanes(parameters), candidates.valid.reshape(-1)

    def squared_error(self, models: Float[Array, "12 *lanes"], observation: tuple[Array, ...]) -> Array:
        """Squared reprojection error in px²; points behind their camera are infinitely wrong."""
        x, y, z, *forms = observation
        rows = (models[0:4], models[4:8], models[8:12])
        point = tuple(row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows)
        du, dv, depth = local_error(tuple(forms), point)  # type: ignore[arg-type]
        return jnp.where(depth > 0, du * du + dv * dv, jnp.inf)

    def polish(self, model: Float[Array, "12"], mask: Bool[Array, " n"]) -> Float[Array, "12"]:
        """A few steps of reweighted Gauss–Newton."""
        problem = LocalRigPoseProblem(self.points, self.forms)
        loss = Tukey(2.0 * self.limit**0.5)
        start = motion_of_entries(model, with_scale=False)
        pose = polish_model(start, problem, weight=mask.astype(model.dtype), loss=loss, steps=self.local_steps)
        return matrix_lanes(pose.parameters())


def estimate_generalized_pose(
    points_world: Float[ArrayLike, "n 3"],
    pixels: Float[ArrayLike, "n 2"],
    camera_index: Int[ArrayLike, " n"],
    rig: Rig,
    *,
    key: PRNGKeyArray | Array,
    options: RansacOptions = RansacOptions(),
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    quality: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Estimate[SE3]:
    """Estimate the pose of a rig from points and their pixels in its cameras, some of which are wrong.

    Args:
        points_world: Points, in the world frame.
        pixels: Where they are seen.
        camera_index: In which camera of the rig.
        rig: The cameras and their poses in the rig, in the unit of the points.
        key: Random key; the same key gives the same answer, bit for bit.
        options: Of the search. Inliers are within `threshold_px` pixels.
        sigma_px: Noise of the pixels, which scales the covariance and weighs the last refinement: one standard
            deviation, one for each observation, or covariances `[n, 2, 2]` in px².
        quality: Of each correspondence, higher is better; guides the sampling.
        mask: False for padding.

    Returns:
        `model` is `rig_from_world`; `covariance` that of the rig-frame tangent ξ, translation first, where the state is
        `world_from_rig @ exp(ξ)`.

    Degenerate input: fewer valid correspondences than four, points on a line seen by one camera, or no more agreement
        than chance would give end with a result code, the identity as model and zero covariance; never NaN. A camera
        index that the rig does not have counts as masked.
    Differentiability: both modes, in points, pixels, cameras, their poses and noise, through the last refinement by the
        implicit function theorem with the exact Hessian; the choice of inliers is constant.

    Raises:
        ValueError: If shapes do not fit or there are fewer than three correspondences.
    References: see the module.
    """
    observations = checked_rig_observations(points_world, pixels, camera_index)
    return in_bucket(_estimate, observations, (rig, key, options), sigma_px, quality, mask)


def checked_rig_observations(
    points_world: Any, pixels: Any, camera_index: Any
) -> tuple[Float[Array, "n 3"], Float[Array, "n 2"], Int[Array, " n"]]:
    """Points, pixels and the cameras that saw them as arrays.

    Raises:
        ValueError: If shapes do not fit or there are fewer rows than a minimal sample has.
    """
    points_world, pixels = checked_observations(points_world, pixels)
    camera_index = jnp.asarray(camera_index)
    if camera_index.shape != points_world.shape[:1] or not jnp.issubdtype(camera_index.dtype, jnp.integer):
        raise ValueError(
            f"camera_index has shape {camera_index.shape} and dtype {camera_index.dtype}: expected one integer for "
            f"each of {len(points_world)} correspondences"
        )
    return points_world, pixels, camera_index


@eqx.filter_jit
def _estimate(
    points_world: Array,
    pixels: Array,
    camera_index: Array,
    rig: Rig,
    key: Any,
    options: RansacOptions,
    sigma_px: Any,
    quality: Any,
    mask: Any,
) -> Estimate[SE3]:
    known = (camera_index >= 0) & (camera_index < len(rig.cameras))
    points_world, pixels, mask = masked_pairs(
        points_world, pixels, known if mask is None else known & jnp.asarray(mask)
    )
    sigma_px, mask = usable_noise(sigma_px, mask)
    dtype = points_world.dtype
    centered, center = about_middle(points_world, mask)

    start, consensus = search_generalized_pose(centered, pixels, camera_index, rig, mask, quality, key, options)

    sigma = root_mean_square(sigma_px, mask)
    # Each camera's image counts for chance as if all pixels were in one.
    chance = chance_in_image(pixels, mask, options.threshold_px)
    cut = even_odds_in_pixels(consensus.inliers, mask, sigma, chance, options.threshold_px)
    front = rig.into_cameras(start.apply(centered), camera_index)[:, 2] > 0
    problem = RigPoseProblem(centered, pixels, camera_index, rig, whitening(sigma_px, pixels.shape[:1], 2, dtype))
    refined = refine_model(
        start,
        problem,
        weight=(mask & jax.lax.stop_gradient(front)).astype(dtype),
        loss=GaussianUniform(cut),
        options=LMOptions(max_steps=options.final_steps),
    )
    points_rig = refined.model.apply(centered)
    error = rig.project(points_rig, camera_index) - pixels
    in_front = rig.into_cameras(points_rig, camera_index)[:, 2] > 0
    shift = SE3.from_rotation_and_translation(SO3.identity(dtype=dtype), -center)
    return conclude(
        refined.model @ shift,
        refined.covariance,
        refined.result,
        jnp.where(in_front, jnp.sum(error * error, axis=1), jnp.inf),
        placeholder=SE3.identity(dtype=dtype),
        consensus=consensus,
        mask=mask,
        sample_size=3,
        chance=chance,
        limit=options.threshold_px**2,
    )


def search_generalized_pose(
    points_world: Float[Array, "n 3"],
    pixels: Float[Array, "n 2"],
    camera_index: Int[Array, " n"],
    rig: Rig,
    mask: Bool[Array, " n"],
    quality: Float[ArrayLike, " n"] | None,
    key: PRNGKeyArray | Array,
    options: RansacOptions,
) -> tuple[SE3, Consensus]:
    """Search a rig's pose without the last refinement: the first half of `estimate_generalized_pose`, for use in jit.

    It runs in float32, so the points should not be far from the origin for their extent; nothing in it is
    differentiated.

    Returns:
        `rig_from_world` in the dtype of the points, the identity where nothing was found; and the consensus.
    """
    local, local_pixels, local_rig = single_precision((points_world, pixels, rig))
    estimator = GeneralizedPoseEstimator(
        local,
        local_forms(local_rig, local_pixels, camera_index),
        *local_rig.rays(local_pixels, camera_index),
        limit=options.threshold_px**2,
        local_steps=options.local_steps,
    )
    consensus = search(estimator, mask, single_precision(quality), key, options)
    pose: Any = motion_of_entries(consensus.model.astype(points_world.dtype), with_scale=False)
    return pose, consensus
