"""Search of a rigid motion between points that each have a covariance: errors are Mahalanobis distances.

With e = y − (R x + t), an inlier has eᵀ (C₁ + R C₀ Rᵀ)⁻¹ e ≤ limit. A point from stereo is a hundred times less certain
along its ray than across: no single distance in metres is a threshold for both.

References: L. Matthies & S. Shafer, "Error modeling in stereo navigation", 1987; Chum, Matas & Kittler, "Locally
optimized RANSAC", 2003 (the shrinking threshold of the local optimisation).
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import propagated
from vojax._types import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray
from vojax.ba import GemanMcClure, RigidProblem, polish_model, whitening
from vojax.lie import SE3
from vojax.solvers import procrustes_anisotropic, rigid_three_point

from ._alignment import motion_of_entries
from ._engine import Consensus, search
from ._options import RansacOptions
from ._pairs import matrix_lanes

# A motion from three uncertain points is wrong by many deviations of the good ones: local optimisation looks at this
# many times the limit first.
_WIDENINGS = (8.0, 3.0, 1.0)
# Gauss–Newton steps at each width; the next one starts from there.
_STEPS = 3
# Variance of a point that does not count, in squares of the largest one that does.
_ABSENT = 1e6


class UncertainAlignmentEstimator(eqx.Module):
    """Rigid motions as the 12 entries of [R | t], row by row, against pairs of points and their covariances."""

    points0: Float[Array, "n 3"]
    points1: Float[Array, "n 3"]
    covariances0: Float[Array, "n 3 3"]
    covariances1: Float[Array, "n 3 3"]
    limit: float = eqx.field(static=True)
    model_size: int = eqx.field(static=True, default=12)
    sample_size: int = eqx.field(static=True, default=3)
    chunk_size: int = eqx.field(static=True, default=512)

    @property
    def observations(self) -> tuple[Array, ...]:
        """Components of both points, and of the lower triangles of both covariances."""
        points = (p[:, i] for p in (self.points0, self.points1) for i in range(3))
        covariances = (
            c[:, i, j] for c in (self.covariances0, self.covariances1) for i in range(3) for j in range(i + 1)
        )
        return (*points, *covariances)

    def hypothesize(self, sample: Int[Array, "m k"]) -> tuple[Float[Array, "12 k"], Bool[Array, " k"]]:
        """Three points on each sample."""
        points0, points1 = (jnp.moveaxis(points[sample], 1, -1) for points in (self.points0, self.points1))
        candidates = jax.vmap(rigid_three_point, in_axes=-1, out_axes=-1)(points0, points1)
        return matrix_lanes(candidates.models.wxyz_xyz[0]), candidates.valid[0]

    def squared_error(self, models: Float[Array, "12 *lanes"], observation: tuple[Array, ...]) -> Array:
        """Squared Mahalanobis distance; infinite where the covariance is not positive."""
        x, y = observation[:3], observation[3:6]
        c0, c1 = _rows(observation[6:12]), _rows(observation[12:])
        rows = (models[0:4], models[4:8], models[8:12])
        e = [y[i] - (rows[i][0] * x[0] + rows[i][1] * x[1] + rows[i][2] * x[2] + rows[i][3]) for i in range(3)]
        turned = [[sum(row[k] * c0[k][j] for k in range(3)) for j in range(3)] for row in rows]
        v = [[c1[i][j] + sum(turned[i][k] * rows[j][k] for k in range(3)) for j in range(3)] for i in range(3)]
        # e' V⁻¹ e by elimination: no differences of products of three, which float32 does not stand.
        a, b = v[1][0] / v[0][0], v[2][0] / v[0][0]
        d1 = v[1][1] - a * v[1][0]
        f = (v[2][1] - a * v[2][0]) / d1
        d2 = v[2][2] - b * v[2][0] - f * f * d1
        e1 = e[1] - a * e[0]
        e2 = e[2] - b * e[0] - f * e1
        squared = e[0] * e[0] / v[0][0] + e1 * e1 / d1 + e2 * e2 / d2
        return jnp.where((v[0][0] > 0) & (d1 > 0) & (d2 > 0), squared, jnp.inf)

    def polish(self, model: Float[Array, "12"], mask: Bool[Array, " n"]) -> Float[Array, "12"]:
        """Reweighted Gauss–Newton on what agrees within a shrinking limit."""

        def step(model: Array, widening: Array) -> tuple[Array, None]:
            rotation = model.reshape(3, 4)[:, :3]
            turned = propagated(rotation, self.covariances0)
            noise = whitening(self.covariances1 + turned, (mask.shape[0],), 3, model.dtype)
            refined = polish_model(
                motion_of_entries(model, with_scale=False),
                RigidProblem(self.points0, self.points1, noise),
                weight=mask.astype(model.dtype),
                loss=GemanMcClure(widening * self.limit**0.5),
                steps=_STEPS,
            )
            return matrix_lanes(refined.parameters()), None

        return jax.lax.scan(step, model, jnp.array(_WIDENINGS, model.dtype))[0]


def _rows(lower: tuple[Array, ...]) -> list[list[Array]]:
    a, b, c, d, e, f = lower
    return [[a, b, d], [b, c, e], [d, e, f]]


def weighted_alignment(
    points0: Float[Array, "n 3"],
    points1: Float[Array, "n 3"],
    covariances0: Float[Array, "n 3 3"],
    covariances1: Float[Array, "n 3 3"],
    weights: Float[Array, " n"],
    iterations: int,
) -> tuple[SE3, Bool[Array, ""]]:
    """`procrustes_anisotropic` with a weight on each squared distance.

    Args:
        points0: Points in frame 0.
        points1: The same points in frame 1.
        covariances0: Of `points0`.
        covariances1: Of `points1`.
        weights: Non-negative; 0 leaves a point out, whatever its coordinates and covariances.
        iterations: Gauss–Newton steps.

    Returns:
        `frame1_from_frame0`, and whether it converged; the identity where it has not.
    """
    scaled0, scaled1 = weighted_covariances(covariances0, covariances1, weights)
    present = (weights > 0)[:, None]
    candidates = procrustes_anisotropic(
        jnp.where(present, points0, 0.0), jnp.where(present, points1, 0.0), scaled0, scaled1, iterations
    )
    return SE3(candidates.models.wxyz_xyz[0]), candidates.valid[0]


def weighted_covariances(
    covariances0: Float[Array, "n 3 3"], covariances1: Float[Array, "n 3 3"], weights: Float[Array, " n"]
) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3 3"]]:
    """Covariances that make an unweighted sum of squared distances the weighted one."""
    traces = jnp.trace(covariances0 + covariances1, axis1=1, axis2=2)
    largest = jnp.max(jnp.where(weights > 0, traces, 0.0))
    absent = _ABSENT * jnp.where(largest > 0, largest, 1.0) * jnp.eye(3, dtype=traces.dtype)[None]
    factor = 1.0 / jnp.where(weights > 0, jnp.maximum(weights, 1.0 / _ABSENT), 1.0)[:, None, None]
    present = (weights > 0)[:, None, None]
    return jnp.where(present, factor * covariances0, absent), jnp.where(present, factor * covariances1, absent)


def search_rigid(
    points0: Float[Array, "n 3"],
    points1: Float[Array, "n 3"],
    covariances0: Float[Array, "n 3 3"],
    covariances1: Float[Array, "n 3 3"],
    mask: Bool[Array, " n"],
    quality: Float[ArrayLike, " n"] | None,
    key: PRNGKeyArray | Array,
    options: RansacOptions,
    *,
    max_mahalanobis: float = 4.0,
) -> tuple[SE3, Consensus]:
    """Search the rigid motion of points with covariances, for use inside jit.

    It runs in float32, so the points should not be far from the origin for their extent; nothing in it is
    differentiated.

    Args:
        points0: Points in frame 0.
        points1: The same points in frame 1.
        covariances0: Of `points0`, in frame 0.
        covariances1: Of `points1`, in frame 1; the sums must be positive definite.
        mask: False for padding.
        quality: Of each correspondence, higher is better; guides the sampling.
        key: Random key; the same key gives the same answer, bit for bit.
        options: Of the search; its thresholds are not read.
        max_mahalanobis: Largest distance of an inlier, standard deviations.

    Returns:
        `frame1_from_frame0`, the identity where nothing was found; and the consensus.

    Degenerate input: fewer than three points, or samples on lines only, leave no inliers; never NaN.
    References: see the module.
    """
    arrays = jax.tree.map(
        lambda x: jax.lax.stop_gradient(x).astype(jnp.float32), (points0, points1, covariances0, covariances1)
    )
    estimator = UncertainAlignmentEstimator(*arrays, limit=max_mahalanobis**2)
    quality = None if quality is None else jax.lax.stop_gradient(jnp.asarray(quality))
    consensus = search(estimator, mask, quality, key, options)
    motion = motion_of_entries(consensus.model, with_scale=False)
    assert isinstance(motion, SE3)
    return SE3(motion.wxyz_xyz.astype(points0.dtype)), consensus
