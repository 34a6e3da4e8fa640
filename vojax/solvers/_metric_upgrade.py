"""From affine cameras to Euclidean ones: the metric constraints of factorisation.

Affine matrices are known up to M_i A. Parallel projection along the line of sight (u, v, 1) of the scene is

    M_i A = s_i [I | -(u, v)ᵀ] R_i = s_i G_i [I | 0] W_i R_i,                                                      (1)

with W_i the rotation that turns the line of sight to the axis and G_i a 2×2 matrix. With H_i = G_i⁻¹ M_i and the
symmetric Q = A Aᵀ, each view gives linear equations H_i Q H_iᵀ = s_i² I:

    orthographic (u = v = 0, s_i = 1)     three per view,
    weak perspective (u = v = 0)          two per view, homogeneous,
    paraperspective (u, v = offset_i)     two per view, homogeneous.

The six entries of Q are their linear least-squares solution; homogeneous ones with the mean of s_i² held at one, which
does not depend on the affine frame. A is the Cholesky factor of Q, and R_i the rotation nearest to s_i⁻¹ H_i A.
-A is as good as A: the scene turned inside out (Necker reversal) has the same images under parallel projection.

References:
    C. Tomasi, T. Kanade. IJCV 1992 (orthographic). C. Poelman, T. Kanade. A paraperspective factorization method for
    shape and motion recovery. PAMI 1997 (weak perspective and paraperspective).
"""

import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from vojax._numerics import complement, safe_divide, safe_sqrt, symmetric_inverse
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SO3

from ._candidates import Candidates
from ._factorization import AffineScene, affine_factorization

Projection = Literal["orthographic", "weak_perspective", "paraperspective"]
PROJECTIONS = ("orthographic", "weak_perspective", "paraperspective")
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class MetricScene(NamedTuple):
    """Cameras of parallel projection and the points they see, up to one scale.

    With (x, y, z) a point in the axes of a camera, relative to the world's origin, the image is
    `offset + scale * ((x, y) - slant * z)`.

    Attributes:
        cam_from_world: Rotation of each view; that of view 0 is the identity.
        scale: Image units per unit of length; one in view 0. (Perspective: focal length over depth.)
        offset: The image of the world's origin in each view.
        slant: Line of sight to the origin in paraperspective, else zero.
        points: World points, relative to their centroid.
    """

    cam_from_world: SO3
    scale: Float[Array, "*batch c"]
    offset: Float[Array, "*batch c 2"]
    slant: Float[Array, "*batch c 2"]
    points: Float[Array, "*batch p 3"]

    def project(self) -> Float[Array, "*batch c p 2"]:
        """Every point in every view."""
        rotated = self.cam_from_world.as_matrix() @ jnp.swapaxes(self.points, -1, -2)[..., None, :, :]
        rotated = jnp.swapaxes(rotated, -1, -2)
        seen = rotated[..., :2] - self.slant[..., None, :] * rotated[..., 2:]
        return self.offset[..., None, :] + self.scale[..., None, None] * seen


def metric_factorization(
    tracks: Float[ArrayLike, "c p 2"],
    mask: Bool[ArrayLike, "c p"] | None = None,
    *,
    projection: Projection = "weak_perspective",
) -> Candidates[MetricScene]:
    """Find cameras of parallel projection and points from tracks: `affine_factorization`, then `metric_upgrade`.

    Args:
        tracks: Where each view sees each point: pixels, or normalised image coordinates for "paraperspective".
        mask: True where a point was seen. None where all were.
        projection: As in `metric_upgrade`.

    Returns:
        Two slots, the scene and its reversal, whose images are the same.

    Degenerate input, Differentiability, Raises: those of `affine_factorization` and `metric_upgrade`. The derivative is
        that of the numbers, no affine freedom is left in it.
    References: see the module.
    """
    affine = affine_factorization(tracks, mask)
    upgraded = metric_upgrade(jax.tree.map(lambda x: x[0], affine.models), projection)
    return Candidates(models=upgraded.models, valid=upgraded.valid & affine.valid[0])


def metric_upgrade(affine: AffineScene, projection: Projection = "weak_perspective") -> Candidates[MetricScene]:
    """Choose the affine frame in which cameras are rotations.

    Args:
        affine: Of `affine_factorization`; its world's origin at the centroid of the points.
        projection: "orthographic": equal scale in all views. "weak_perspective": a scale for each. "paraperspective":
            along the line of sight to the centroid; needs a calibrated camera, with offsets in normalised coordinates.

    Returns:
        Two slots, the scene and its reversal. Neither is preferred: perspective decides, `perspective_factorization`,
        or knowledge of one depth.

    Degenerate input: cameras that turned about less than two axes, two distinct directions of view, or none, leave Q
        open; noise or perspective can make it indefinite. Then the slots are not valid, and hold the scene of the
        nearest Q that is positive definite, finite in any case. The smaller the turn, the less certain the depth of the
        scene (bas-relief).
    Differentiability: both modes, any order.

    Raises:
        ValueError: Unknown projection.
    References: see the module.
    """
    if projection not in PROJECTIONS:
        raise ValueError(f"found projection {projection!r}; expected one of {', '.join(PROJECTIONS)}")
    return _upgrade(affine, projection)


@functools.partial(jax.jit, static_argnames=("projection",))
def _upgrade(affine: AffineScene, projection: Projection) -> Candidates[MetricScene]:
    """`metric_upgrade` without its check."""
    dtype = affine.points.dtype
    slant = affine.offsets if projection == "paraperspective" else jnp.zeros_like(affine.offsets)
    axes, skew = _line_of_sight(slant)
    h = _inverse2(skew) @ affine.matrices
    # Columns of unit length in all views together make the equations well conditioned, whatever the affine frame was.
    gram = jax.lax.stop_gradient(jnp.einsum("cik,cil->kl", h, h))
    solid = symmetric_inverse(gram)[1]
    lower = jnp.linalg.cholesky(jnp.where(solid, gram, jnp.eye(3, dtype=dtype)))
    h = h @ _inverse_lower(lower).T
    points = affine.points @ lower
    q, regular = _quadric(h, projection == "orthographic")
    q, positive = _nearest_positive(q)
    root = jnp.linalg.cholesky(q)
    rows, scale = _nearest_rows(h @ root)
    points = jax.scipy.linalg.solve_triangular(root, points.T, lower=True).T
    if projection == "orthographic":
        scale = jnp.ones_like(scale)
    else:
        unit = jnp.where(scale[0] > 0, scale[0], 1.0)
        scale, points = scale / unit, points * unit
    third = jnp.cross(rows[:, 0], rows[:, 1])[:, None]
    scenes = []
    for turn in (1.0, -1.0):
        rotations = axes @ jnp.concatenate([turn * rows, third], axis=1)
        # The axes of view 0 become those of the world.
        cam_from_world = SO3.from_matrix(jnp.einsum("cij,kj->cik", rotations, rotations[0]))
        scenes.append(MetricScene(cam_from_world, scale, affine.offsets, slant, turn * points @ rotations[0].T))
    ok = solid & regular & positive
    return Candidates(models=jax.tree.map(lambda *x: jnp.stack(x), *scenes), valid=jnp.stack([ok, ok]))


def _line_of_sight(slant: Float[Array, "c 2"]) -> tuple[Float[Array, "c 3 3"], Float[Array, "c 2 2"]]:
    """W_iᵀ and G_i of (1)."""
    length = jnp.sqrt(1.0 + slant[:, 0] ** 2 + slant[:, 1] ** 2)
    sight = (slant[:, 0] / length, slant[:, 1] / length, 1.0 / length)
    axes = jnp.stack([jnp.stack(axis, axis=1) for axis in (*complement(sight), sight)], axis=2)
    return axes, axes[:, :2, :2] - slant[:, :, None] * axes[:, None, 2, :2]


def _inverse2(m: Float[Array, "c 2 2"]) -> Float[Array, "c 2 2"]:
    """Inverse of 2×2 matrices."""
    adjugate = jnp.stack([jnp.stack([m[:, 1, 1], -m[:, 0, 1]], 1), jnp.stack([-m[:, 1, 0], m[:, 0, 0]], 1)], 1)
    return adjugate / (m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0])[:, None, None]


def _inverse_lower(lower: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Inverse of a lower triangular matrix."""
    return jax.scipy.linalg.solve_triangular(lower, jnp.eye(3, dtype=lower.dtype), lower=True)


def _quadric(h: Float[Array, "c 2 3"], orthographic: bool) -> tuple[Float[Array, "3 3"], Bool[Array, ""]]:
    """Q by linear least squares, and whether the views determine it."""

    def form(i: int, j: int) -> Array:
        a, b = h[:, i], h[:, j]
        columns = [a[:, k] * b[:, m] + (a[:, m] * b[:, k] if k != m else 0.0) for k, m in _PAIRS]
        return jnp.stack(columns, axis=1)

    views = h.shape[0]
    n00, n01, n11 = form(0, 0), form(0, 1), form(1, 1)
    one, zero = jnp.ones(views, h.dtype), jnp.zeros(views, h.dtype)
    if orthographic:
        equations, rhs = jnp.concatenate([n00, n11, 2.0**0.5 * n01]), jnp.concatenate([one, one, zero])
    else:
        mean = jnp.sum(n00 + n11, axis=0, keepdims=True) * (0.5 / views**0.5)
        equations = jnp.concatenate([n00 - n11, 2.0 * n01, mean])
        rhs = jnp.concatenate([zero, zero, one[:1] * views**0.5])
    # With the mean of s² as one more equation the direction of Q is exact; its length is short with noise: so scale.
    inverse, regular = symmetric_inverse(equations.T @ equations)
    entries = jnp.where(regular, inverse @ (equations.T @ rhs), jnp.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0], h.dtype))
    if not orthographic:
        held = jnp.sum(n00 + n11, axis=0) @ entries / (2.0 * views)
        entries = entries / jnp.where(regular & (held > 0), held, 1.0)
    q = jnp.zeros((3, 3), h.dtype)
    for entry, (k, m) in zip(entries, _PAIRS, strict=True):
        q = q.at[k, m].set(entry).at[m, k].set(entry)
    return q, regular


def _nearest_positive(q: Float[Array, "3 3"]) -> tuple[Float[Array, "3 3"], Bool[Array, ""]]:
    """Q with eigenvalues of at least a thousandth of the largest, and whether it was positive definite."""
    values, vectors = jnp.linalg.eigh(jax.lax.stop_gradient(q))
    largest = jnp.where(values[2] > 0, values[2], 1.0)
    positive = values[0] > 64.0 * float(jnp.finfo(q.dtype).eps) * largest
    lifted = jnp.where(positive, 0.0, jnp.maximum(1e-3 * largest - values, 0.0))
    return q + (vectors * lifted[None]) @ vectors.T, positive


def _nearest_rows(b: Float[Array, "c 2 3"]) -> tuple[Float[Array, "c 2 3"], Float[Array, "c"]]:
    """Orthonormal rows nearest to s⁻¹ B, by the square root of the 2×2 matrix N = B Bᵀ, and s."""
    n = jnp.einsum("cik,cjk->cij", b, b)
    root_det = safe_sqrt(n[:, 0, 0] * n[:, 1, 1] - n[:, 0, 1] ** 2)
    trace = safe_sqrt(n[:, 0, 0] + n[:, 1, 1] + 2.0 * root_det)
    # N^½ = (N + √det I) / tr N^½, and its inverse is its adjugate over √det.
    adjugate = jnp.stack(
        [
            jnp.stack([n[:, 1, 1] + root_det, -n[:, 0, 1]], axis=1),
            jnp.stack([-n[:, 0, 1], n[:, 0, 0] + root_det], axis=1),
        ],
        axis=1,
    )
    factor = safe_divide(jnp.ones_like(trace), trace * root_det)
    rows = factor[:, None, None] * adjugate @ b
    flat = jnp.eye(2, 3, dtype=b.dtype)[None]
    return jnp.where((factor > 0)[:, None, None], rows, flat), 0.5 * trace
