"""Robust camera pose from points and pixels: P3P hypotheses, MSAC, local optimisation, refinement on the inliers.

References: Nistér, Naroditsky & Bergen, "Visual odometry", CVPR 2004; Scaramuzza & Fraundorfer, "Visual odometry, part
I", 2011, section "3-D-to-2-D".
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray
from vojax.ba import Cauchy, GaussianUniform, LMOptions, polish_absolute_pose, refine_absolute_pose
from vojax.lie import SE3, SO3
from vojax.solvers import p3p

from ._buckets import in_bucket
from ._conclude import conclude
from ._engine import Consensus, search
from ._estimate import Estimate
from ._options import RansacOptions
from ._pairs import about_middle, checked_observations, masked_pairs, matrix_lanes, root_mean_square, usable_noise
from ._significance import chance_in_image, even_odds_in_pixels


class AbsolutePoseEstimator(eqx.Module):
    """Poses as the 12 entries of [R | t], row by row, against points and pixels."""

    points: Float[Array, "n 3"]
    pixels: Float[Array, "n 2"]
    bearings: Float[Array, "n 3"]
    camera: Any
    limit: float = eqx.field(static=True)
    local_steps: int = eqx.field(static=True)
    model_size: int = eqx.field(static=True, default=12)
    sample_size: int = eqx.field(static=True, default=3)
    chunk_size: int = eqx.field(static=True, default=512)

    @property
    def observations(self) -> tuple[Array, ...]:
        """Components of points and pixels."""
        return (*(self.points[:, i] for i in range(3)), self.pixels[:, 0], self.pixels[:, 1])

    def hypothesize(self, sample: Int[Array, "m k"]) -> tuple[Float[Array, "12 ks"], Bool[Array, " ks"]]:
        """P3P on each sample; four lanes for the four slots."""
        points = jnp.moveaxis(self.points[sample], 1, -1)
        bearings = jnp.moveaxis(self.bearings[sample], 1, -1)
        candidates = jax.vmap(p3p, in_axes=-1, out_axes=-1)(points, bearings)
        parameters = jnp.moveaxis(candidates.models.wxyz_xyz, 1, 0).reshape(7, -1)
        return matrix_lanes(parameters), candidates.valid.reshape(-1)

    def squared_error(self, models: Float[Array, "12 *lanes"], observation: tuple[Array, ...]) -> Array:
        """Squared reprojection error in px²; points behind the camera are infinitely wrong."""
        x, y, z, u, v = observation
        rows = (models[0:4], models[4:8], models[8:12])
        xc, yc, zc = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows)
        pu, pv = self.camera.project_xyz(xc, yc, zc)
        return jnp.where(zc > 0, (pu - u) * (pu - u) + (pv - v) * (pv - v), jnp.inf)

    def polish(self, model: Float[Array, "12"], mask: Bool[Array, " n"]) -> Float[Array, "12"]:
        """A few steps of robust Gauss–Newton."""
        inliers = mask & (self.squared_error(model[:, None], self.observations) <= self.limit)
        refined = polish_absolute_pose(
            _pose(model),
            self.points,
            self.pixels,
            self.camera,
            sigma_px=self.limit**0.5 / 3.0,
            mask=inliers,
            loss=Cauchy(),
            steps=self.local_steps,
        )
        return matrix_lanes(refined.wxyz_xyz)


def _pose(model: Float[Array, "12"]) -> SE3:
    matrix = model.reshape(3, 4)
    # A search without any hypothesis ends with zeros: give them a rotation.
    empty = jnp.all(model == 0)
    rotation = jnp.where(empty, jnp.eye(3, dtype=model.dtype), matrix[:, :3])
    return SE3.from_rotation_and_translation(SO3.from_matrix(rotation), matrix[:, 3])


def estimate_absolute_pose(
    points_world: Float[ArrayLike, "n 3"],
    pixels: Float[ArrayLike, "n 2"],
    camera: Any,
    *,
    key: PRNGKeyArray | Array,
    options: RansacOptions = RansacOptions(),
    sigma_px: Float[ArrayLike, "..."] | float = 1.0,
    quality: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Estimate[SE3]:
    """Estimate a camera pose from points and their pixels, some of which are wrong.

    Args:
        points_world: Points, in the world frame.
        pixels: Where the camera sees them.
        camera: A camera of `vojax.cameras`.
        key: Random key; the same key gives the same answer, bit for bit.
        options: Of the search. Inliers are within `threshold_px` pixels.
        sigma_px: Noise of the pixels, which scales the covariance and weighs the last refinement: one standard
            deviation, one for each observation, or covariances `[n, 2, 2]` in px² (for uncertain points add J Σ_X Jᵀ).
        quality: Of each correspondence, higher is better; guides the sampling.
        mask: False for padding.

    Returns:
        `model` is `cam_from_world`; `covariance` that of the camera-frame tangent ξ, translation first, where the
        state is `world_from_cam @ exp(ξ)`.

    Degenerate input: fewer valid correspondences than four, all points behind the camera, points on a line, or no
        more agreement than chance would give end with a result code, the identity as model and zero covariance; never
        NaN.
    Differentiability: both modes, in points, pixels, camera and noise, through the last refinement by the implicit
        function theorem with the exact Hessian; the choice of inliers is constant.

    Raises:
        ValueError: If shapes do not fit or there are fewer than three correspondences.
    References: see the module.

    Example:
        >>> import jax, vojax
        >>> camera = vojax.cameras.Pinhole(fx=500.0, fy=500.0, cx=320.0, cy=240.0)
        >>> points = jax.random.uniform(jax.random.key(0), (50, 3), minval=-1.0).at[:, 2].add(5.0)
        >>> estimate = estimate_absolute_pose(points, camera.project(points), camera, key=jax.random.key(1))
        >>> int(estimate.num_inliers)
        50
    """
    points_world, pixels = checked_observations(points_world, pixels)
    return in_bucket(_estimate, (points_world, pixels), (camera, key, options), sigma_px, quality, mask)


@eqx.filter_jit
def _estimate(
    points_world: Array,
    pixels: Array,
    camera: Any,
    key: Any,
    options: RansacOptions,
    sigma_px: Any,
    quality: Any,
    mask: Any,
) -> Estimate[SE3]:
    points_world, pixels, mask = masked_pairs(points_world, pixels, mask)
    sigma_px, mask = usable_noise(sigma_px, mask)
    centered, center = about_middle(points_world, mask)
    start, consensus = search_absolute_pose(centered, pixels, camera, mask, quality, key, options)

    dtype = points_world.dtype
    # All observations in front take part, weighted by how likely they are inliers: what the threshold cuts off would be
    # missing from the covariance.
    sigma = root_mean_square(sigma_px, mask).astype(dtype)
    chance = chance_in_image(pixels, mask, options.threshold_px)
    cut = even_odds_in_pixels(consensus.inliers, mask, sigma, chance, options.threshold_px)
    front = jax.lax.stop_gradient(start.apply(centered)[:, 2] > 0)
    refined = refine_absolute_pose(
        start,
        centered,
        pixels,
        camera,
        sigma_px=sigma_px,
        mask=mask & front,
        loss=GaussianUniform(cut),
        options=LMOptions(max_steps=options.final_steps),
    )
    points_cam = refined.model.apply(centered)
    error = camera.project(points_cam) - pixels
    shift = SE3.from_rotation_and_translation(SO3.identity(dtype=dtype), -center)
    return conclude(
        refined.model @ shift,
        refined.covariance,
        refined.result,
        jnp.where(points_cam[:, 2] > 0, jnp.sum(error * error, axis=1), jnp.inf),
        placeholder=SE3.identity(dtype=dtype),
        consensus=consensus,
        mask=mask,
        sample_size=3,
        chance=chance,
        limit=options.threshold_px**2,
    )


def search_absolute_pose(
    points_world: Float[Array, "n 3"],
    pixels: Float[Array, "n 2"],
    camera: Any,
    mask: Bool[Array, " n"],
    quality: Float[ArrayLike, " n"] | None,
    key: PRNGKeyArray | Array,
    options: RansacOptions,
) -> tuple[SE3, Consensus]:
    """Search a pose without the last refinement: the first half of `estimate_absolute_pose`, for use inside jit.

    It runs in float32, so the points should not be far from the origin for their extent; nothing in it is
    differentiated.

    Returns:
        `cam_from_world` in the dtype of the points, the identity where nothing was found; and the consensus.
    """
    local, local_pixels, local_camera = jax.tree.map(
        lambda x: jax.lax.stop_gradient(x).astype(jnp.float32), (points_world, pixels, camera)
    )
    estimator = AbsolutePoseEstimator(
        local,
        local_pixels,
        local_camera.unproject(local_pixels),
        local_camera,
        limit=options.threshold_px**2,
        local_steps=options.local_steps,
    )
    quality = None if quality is None else jax.lax.stop_gradient(jnp.asarray(quality))
    consensus = search(estimator, mask, quality, key, options)
    return SE3(_pose(consensus.model).wxyz_xyz.astype(points_world.dtype)), consensus
