"""Robust motions between two sets of points, rigid or with scale: three-point hypotheses and least squares on inliers.

References: S. Umeyama. Least-squares estimation of transformation parameters between two point patterns. PAMI 1991.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray
from vojax.ba import (
    GaussianUniform,
    LMOptions,
    RigidProblem,
    SimilarityProblem,
    Tukey,
    polish_model,
    refine_model,
    whitening,
)
from vojax.lie import SE3, SO3, Sim3
from vojax.solvers import rigid_three_point, umeyama

from ._buckets import in_bucket
from ._conclude import conclude
from ._engine import search
from ._estimate import Estimate
from ._options import RansacOptions
from ._pairs import (
    about_middle,
    checked_pairs,
    masked_pairs,
    matrix_lanes,
    root_mean_square,
    single_precision,
    usable_noise,
)
from ._significance import SQRT_TAU, chance_in_box, even_odds


class AlignmentEstimator(eqx.Module):
    """Motions as the 12 entries of [s R | t], row by row, against pairs of points."""

    points0: Float[Array, "n 3"]
    points1: Float[Array, "n 3"]
    limit: float = eqx.field(static=True)
    local_steps: int = eqx.field(static=True)
    with_scale: bool = eqx.field(static=True)
    model_size: int = eqx.field(static=True, default=12)
    sample_size: int = eqx.field(static=True, default=3)
    chunk_size: int = eqx.field(static=True, default=512)

    @property
    def observations(self) -> tuple[Array, ...]:
        """Components of both points."""
        return (*(self.points0[:, i] for i in range(3)), *(self.points1[:, i] for i in range(3)))

    def hypothesize(self, sample: Int[Array, "m k"]) -> tuple[Float[Array, "12 k"], Bool[Array, " k"]]:
        """Three points on each sample."""
        points0, points1 = (jnp.moveaxis(points[sample], 1, -1) for points in (self.points0, self.points1))
        solver = umeyama if self.with_scale else rigid_three_point
        candidates = jax.vmap(solver, in_axes=-1, out_axes=-1)(points0, points1)
        (parameters,) = jax.tree.leaves(candidates.models)
        return matrix_lanes(parameters[0]), candidates.valid[0]

    def squared_error(self, models: Float[Array, "12 *lanes"], observation: tuple[Array, ...]) -> Array:
        """Squared distance."""
        x, y, z, *measured = observation
        total = jnp.zeros_like(x)
        for i in range(3):
            row = models[4 * i : 4 * i + 4]
            difference = row[0] * x + row[1] * y + row[2] * z + row[3] - measured[i]
            total = total + difference * difference
        return total

    def polish(self, model: Float[Array, "12"], mask: Bool[Array, " n"]) -> Float[Array, "12"]:
        """A few steps of reweighted Gauss–Newton."""
        kind = SimilarityProblem if self.with_scale else RigidProblem
        problem = kind(self.points0, self.points1, (jnp.ones((), model.dtype),))
        loss = Tukey(2.0 * self.limit**0.5)
        weight = mask.astype(model.dtype)
        start = motion_of_entries(model, self.with_scale)
        return matrix_lanes(polish_model(start, problem, weight=weight, loss=loss, steps=self.local_steps).parameters())


def motion_of_entries(entries: Float[Array, "12"], with_scale: bool) -> SE3 | Sim3:
    """The motion of a matrix [s R | t]; the identity for zeros, which a search without any hypothesis ends with."""
    matrix = entries.reshape(3, 4)
    empty = jnp.all(entries == 0)
    linear = jnp.where(empty, jnp.eye(3, dtype=entries.dtype), matrix[:, :3])
    scale = jnp.sqrt(jnp.sum(linear * linear) / 3.0)
    rotation = SO3.from_matrix(linear / scale)
    if not with_scale:
        return SE3.from_rotation_and_translation(rotation, matrix[:, 3])
    return Sim3(jnp.concatenate([rotation.wxyz, matrix[:, 3], scale[None]]))


def estimate_rigid(
    points0: Float[ArrayLike, "n 3"],
    points1: Float[ArrayLike, "n 3"],
    *,
    key: PRNGKeyArray | Array,
    options: RansacOptions = RansacOptions(),
    sigma: Float[ArrayLike, "..."] | float | None = None,
    quality: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Estimate[SE3]:
    """Estimate the rigid motion between two sets of corresponding points, some of which are wrong.

    Args:
        points0: Points in frame 0.
        points1: The same points in frame 1.
        key: Random key; the same key gives the same answer, bit for bit.
        options: Of the search. Inliers are within `threshold` in the unit of the points.
        sigma: Noise of the difference of a point and its transformed partner, in the unit of the points: one standard
            deviation of each component, one for each correspondence, or covariances `[n, 3, 3]` in frame 1. A third of
            the threshold when left out.
        quality: Of each correspondence, higher is better; guides the sampling.
        mask: False for padding.

    Returns:
        `model` is `frame1_from_frame0`; `covariance` that of the tangent ξ, translation first: the true motion is
        exp(−ξ) @ model.

    Degenerate input: fewer valid correspondences than four, no more agreement than chance would give, or samples on
        lines only end with a result code, the identity as model and zero covariance; never NaN.
    Differentiability: both modes, in points and noise, through the last refinement by the implicit function theorem
        with the exact Hessian; the choice of inliers is constant.

    Raises:
        ValueError: If shapes do not fit or there are fewer than three correspondences.
    References: see the module.
    """
    first, second = checked_pairs(points0, points1, 3, "a rigid motion", d=3)
    return in_bucket(_estimate, (first, second), (False, key, options), sigma, quality, mask)


def estimate_similarity(
    points0: Float[ArrayLike, "n 3"],
    points1: Float[ArrayLike, "n 3"],
    *,
    key: PRNGKeyArray | Array,
    options: RansacOptions = RansacOptions(),
    sigma: Float[ArrayLike, "..."] | float | None = None,
    quality: Float[ArrayLike, " n"] | None = None,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> Estimate[Sim3]:
    """Estimate the similarity between two sets of corresponding points, some of which are wrong.

    As `estimate_rigid`, with a scale: `model` is a Sim3, errors are measured in frame 1, and the tangent has the
    logarithm of the scale as its seventh coordinate.

    Args:
        points0: Points in frame 0.
        points1: The same points in frame 1.
        key: Random key.
        options: Of the search.
        sigma: Noise in frame 1.
        quality: Of each correspondence, higher is better.
        mask: False for padding.

    Raises:
        ValueError: If shapes do not fit or there are fewer than three correspondences.
    References: see the module.
    """
    first, second = checked_pairs(points0, points1, 3, "a similarity", d=3)
    return in_bucket(_estimate, (first, second), (True, key, options), sigma, quality, mask)


@eqx.filter_jit
def _estimate(
    points0: Array,
    points1: Array,
    with_scale: bool,
    key: Any,
    options: RansacOptions,
    sigma: Any,
    quality: Any,
    mask: Any,
) -> Estimate[Any]:
    points0, points1, mask = masked_pairs(points0, points1, mask)
    dtype = points0.dtype
    sigma, mask = usable_noise(options.threshold / 3.0 if sigma is None else sigma, mask)
    (x, center0), (y, center1) = about_middle(points0, mask), about_middle(points1, mask)
    estimator = AlignmentEstimator(
        *single_precision((x, y)),
        limit=options.threshold**2,
        local_steps=options.local_steps,
        with_scale=with_scale,
    )
    consensus = search(estimator, mask, single_precision(quality), key, options)
    start = jax.tree.map(lambda x: x.astype(dtype), motion_of_entries(consensus.model, with_scale))

    kind = SimilarityProblem if with_scale else RigidProblem
    chance = chance_in_box(y, mask, options.threshold)
    level = root_mean_square(sigma, mask).astype(dtype)
    ball = 4.0 / 3.0 * jnp.pi * options.threshold**3
    cut = even_odds(jnp.sum(consensus.inliers), jnp.sum(mask), 1.0 / (SQRT_TAU * level) ** 3, chance / ball)
    refined = refine_model(
        start,
        kind(x, y, whitening(sigma, (x.shape[0],), 3, dtype)),
        weight=mask.astype(dtype),
        loss=GaussianUniform(cut),
        options=LMOptions(max_steps=options.final_steps),
    )
    difference = refined.model.apply(x) - y
    model_kind = Sim3 if with_scale else SE3
    before = SE3.from_rotation_and_translation(SO3.identity(dtype=dtype), -center0)
    after = SE3.from_rotation_and_translation(SO3.identity(dtype=dtype), center1)
    if with_scale:
        before, after = (Sim3(jnp.concatenate([m.wxyz_xyz, jnp.ones((1,), dtype)])) for m in (before, after))
    adjoint = jax.lax.stop_gradient(after.adjoint())
    return conclude(
        after @ refined.model @ before,
        adjoint @ refined.covariance @ adjoint.T,
        refined.result,
        jnp.sum(difference * difference, axis=1),
        placeholder=model_kind.identity(dtype=dtype),
        consensus=consensus,
        mask=mask,
        sample_size=3,
        chance=chance,
        limit=options.threshold**2,
    )
