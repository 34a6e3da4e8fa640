"""The normal equations of a bundle, and their solution by eliminating the landmarks.

The matrix is the block arrow [[U, W], [Wᵀ, V]]: U block diagonal over cameras, V over landmarks, one block of W an
observation. With V = L Lᵀ and E = W L⁻ᵀ the cameras' system is S = U − E Eᵀ, and the landmarks follow from
Lᵀ η = −(L⁻¹ g + Eᵀ ξ) (Szeliski, "Computer Vision", section 11.4.3). The same elimination serves steps, covariances
and derivatives; only the blocks differ.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax._numerics import cholesky_factor
from vojax._types import Array, Bool, Float

from ._bundle_cholesky import CholeskyFactor, cholesky
from ._bundle_factors import FactorBlock
from ._bundle_layout import BundleLayout
from ._bundle_priors import PriorBlocks, landmark_root
from ._bundle_residual import Blocks
from ._bundle_state import BundleData

# Chunks of pairs multiplied at a time. A loop keeps what it gathers in the cache, and XLA from fusing the gather with
# the reshape behind it, element by element: 11 instead of 50 ms on Ladybug-49.
_PAIR_BATCH = 512


class BundleSystem(eqx.Module):
    """Blocks of the normal equations; cameras with all their parameters, whether free, fixed or shared."""

    camera: Float[Array, "c k k"]
    camera_gradient: Float[Array, "c k"]
    landmark: Float[Array, "3 3 l"]
    landmark_gradient: Float[Array, "3 l"]
    cross: Float[Array, "k 3 s"]
    factors: tuple[FactorBlock, ...]

    def damped(self, damping: Float[Array, ""]) -> "BundleSystem":
        """Scale the diagonal by 1 + λ."""
        grow = lambda matrix: matrix * (1.0 + damping * jnp.eye(matrix.shape[-1], dtype=damping.dtype)[None])  # noqa: E731
        landmark = self.landmark * (1.0 + damping * jnp.eye(3, dtype=damping.dtype)[:, :, None])
        factors = tuple(FactorBlock(grow(block.hessian), block.gradient) for block in self.factors)
        return eqx.tree_at(
            lambda system: (system.camera, system.landmark, system.factors),
            self,
            (grow(self.camera), landmark, factors),
        )

    def gradient(self, layout: BundleLayout) -> Float[Array, " u"]:
        """Gradient by the unknowns of the reduced system."""
        return layout.collapse(self.camera_gradient, [block.gradient for block in self.factors])


def normal_equations(blocks: Blocks, data: BundleData, layout: BundleLayout) -> BundleSystem:
    """Blocks of JᵀJ and of Jᵀr, priors included."""
    d, k, s = blocks.by_camera.shape
    rows = jnp.concatenate([blocks.by_camera, blocks.residual[:, None]], axis=1).reshape(d * (k + 1), s).T
    chunks = rows.at[layout.camera_slots].get(mode="fill", fill_value=0)
    chunks = chunks.reshape(chunks.shape[0], -1, k + 1)
    products = jnp.einsum("nai,naj->nij", chunks, chunks, precision="highest")
    cameras = jax.ops.segment_sum(products, layout.chunk_camera, layout.cameras, indices_are_sorted=True)
    free = layout.spread(layout.landmark_free.astype(rows.dtype))
    by_landmark = blocks.by_landmark * free[None, None]
    columns = by_landmark.swapaxes(0, 1)
    lower = [[jnp.sum(columns[i] * columns[j], axis=0) for j in range(i + 1)] for i in range(3)]
    system = BundleSystem(
        camera=cameras[:, :k, :k],
        camera_gradient=cameras[:, :k, k],
        landmark=layout.sum_landmarks(_symmetric(lower)),
        landmark_gradient=layout.sum_landmarks(jnp.sum(by_landmark * blocks.residual[:, None], axis=0)),
        cross=jnp.sum(blocks.by_camera[:, :, None] * by_landmark[:, None], axis=0),
        factors=tuple(_factor_block(*parts) for parts in blocks.factors),
    )
    return add_priors(system, blocks.priors, data, layout)


def add_priors(system: BundleSystem, blocks: PriorBlocks, data: BundleData, layout: BundleLayout) -> BundleSystem:
    """Add the Gauss–Newton terms of the priors; each touches one block."""
    camera, camera_gradient = system.camera, system.camera_gradient
    landmark, landmark_gradient = system.landmark, system.landmark_gradient
    if blocks.landmarks.size:
        root = landmark_root(data.priors, layout)
        landmark = landmark + jnp.sum(root[:, :, None] * root[:, None], axis=0)
        landmark_gradient = landmark_gradient + jnp.sum(root * blocks.landmarks[:, None], axis=0)
    if blocks.intrinsics.size and data.priors.intrinsics_root is not None:
        root, own = data.priors.intrinsics_root, jnp.arange(-blocks.intrinsics.shape[1], 0)
        camera = camera.at[layout.group_camera[:, None], own[None], own[None]].add(root * root, mode="drop")
        camera_gradient = camera_gradient.at[layout.group_camera[:, None], own[None]].add(
            root * blocks.intrinsics, mode="drop"
        )
    return BundleSystem(camera, camera_gradient, landmark, landmark_gradient, system.cross, system.factors)


def _factor_block(residual: Float[Array, "f r"], jacobian: Float[Array, "f r q"]) -> FactorBlock:
    return FactorBlock(
        jnp.sum(jacobian[:, :, :, None] * jacobian[:, :, None, :], axis=1),
        jnp.sum(jacobian * residual[:, :, None], axis=1),
    )


def _symmetric(lower: list[list[Array]]) -> Array:
    """Matrix [n, n, ...] from the rows of its lower triangle."""
    size = len(lower)
    return jnp.stack([jnp.stack([lower[max(i, j)][min(i, j)] for j in range(size)]) for i in range(size)])


class Eliminated(eqx.Module):
    """What is left of a system once its landmarks are gone."""

    camera: Float[Array, "c k k"]
    lower: tuple[Float[Array, " l"], ...]
    pivots: tuple[Float[Array, " l"], ...]
    cross: Float[Array, "3 k s"]
    factors: tuple[FactorBlock, ...]

    def forward(self, values: Float[Array, "3 l"]) -> Float[Array, "3 l"]:
        """L⁻¹ times a vector a landmark."""
        return jnp.stack(_forward(list(values), self.lower, self.pivots))

    def backward(self, values: Float[Array, "3 l"]) -> Float[Array, "3 l"]:
        """L⁻ᵀ times a vector a landmark."""
        (l10, l20, l21), (p0, p1, p2) = self.lower, self.pivots
        x, y, z = values
        z = z * p2
        y = (y - l21 * z) * p1
        return jnp.stack([(x - l10 * y - l20 * z) * p0, y, z])

    def to_cameras(self, values: Float[Array, "3 l"], layout: BundleLayout) -> Float[Array, "c k"]:
        """E times a vector a landmark."""
        return layout.sum_cameras(jnp.sum(self.cross * layout.spread(values)[:, None], axis=0).T)

    def to_landmarks(self, cameras: Float[Array, "c k"], layout: BundleLayout) -> Float[Array, "3 l"]:
        """Eᵀ times a vector a camera."""
        at_slots = cameras.T.at[:, layout.slot_camera].get(mode="clip")
        return layout.sum_landmarks(jnp.sum(self.cross * at_slots[None], axis=1))


def _forward(values: list[Array], lower: tuple[Array, ...], pivots: tuple[Array, ...]) -> list[Array]:
    (l10, l20, l21), (p0, p1, p2) = lower, pivots
    x = values[0] * p0
    y = (values[1] - l10 * x) * p1
    return [x, y, (values[2] - l20 * x - l21 * y) * p2]


def eliminate(system: BundleSystem, layout: BundleLayout) -> Eliminated:
    """Factor the landmarks' blocks; a direction of a landmark without information is left out."""
    columns, pivots, _ = cholesky_factor(system.landmark)
    lower = (columns[0][1], columns[0][2], columns[1][1])
    spread = layout.spread(jnp.stack([*lower, *pivots]))[:, None]
    cross = _forward([system.cross[:, j] for j in range(3)], tuple(spread[:3]), tuple(spread[3:]))
    return Eliminated(system.camera, lower, tuple(pivots), jnp.stack(cross), system.factors)


class Reduced(NamedTuple):
    """The reduced system, scaled to unit diagonal of U and factored."""

    factor: CholeskyFactor
    scale: Float[Array, " u"]
    diagonal: Float[Array, " u"]

    @property
    def regular(self) -> Bool[Array, ""]:
        """Whether S is positive definite in working precision."""
        return self.factor.regular

    def solve(self, rhs: Float[Array, "u r"]) -> Float[Array, "u r"]:
        """Solve S x = rhs; zero for unknowns without information."""
        return self.scale[:, None] * self.factor.solve(self.scale[:, None] * rhs)


def reduced_matrix(eliminated: Eliminated, layout: BundleLayout) -> Float[Array, "u u"]:
    """S = U − E Eᵀ in the unknowns: fixed parameters left out, shared ones added up."""
    k, s = eliminated.cross.shape[1:]
    c = layout.cameras
    # One row a slot, and one of zeros for padding.
    rows = jnp.concatenate([eliminated.cross.reshape(3 * k, s), jnp.zeros((3 * k, 1), eliminated.cross.dtype)], axis=1)
    products = _pair_products(rows.T, layout, k)
    one, other = layout.block_cameras
    blocks = jnp.zeros((c, c, k, k), rows.dtype)
    blocks = blocks.at[other, one].set(-products.swapaxes(1, 2), mode="promise_in_bounds")
    blocks = blocks.at[one, other].set(-products, mode="promise_in_bounds")
    blocks = blocks.at[jnp.arange(c), jnp.arange(c)].add(eliminated.camera, mode="promise_in_bounds")
    full = blocks.swapaxes(1, 2).reshape(c * k, c * k)
    # Fixed parameters leave, shared ones add up: rows first, then columns.
    gather = lambda matrix: jax.ops.segment_sum(matrix, layout.columns.reshape(-1), layout.unknowns + 1)[:-1]  # noqa: E731
    matrix = gather(gather(full).T)
    for columns, block in zip(layout.factor_columns, eliminated.factors, strict=True):
        matrix = matrix.at[columns[:, :, None], columns[:, None, :]].add(block.hessian, mode="drop")
    return matrix


def _pair_products(rows: Float[Array, "s e"], layout: BundleLayout, k: int) -> Float[Array, "n k k"]:
    """Sum of Eᵢ Eⱼᵀ over the common landmarks of every pair of cameras."""
    blocks = layout.block_cameras[0].shape[0]

    first, second = layout.pair_slots
    chunks, size = first.shape
    batch = min(_PAIR_BATCH, max(chunks, 1))
    batches = -(-chunks // batch)
    padding = batches * batch - chunks
    # Padding multiplies the row of zeros.
    first, second = (
        jnp.pad(slots, ((0, padding), (0, 0)), constant_values=rows.shape[0] - 1).reshape(batches, batch, size)
        for slots in (first, second)
    )
    block = jnp.pad(layout.chunk_block, (0, padding), mode="edge").reshape(batches, batch)

    def add(total: Array, part: tuple[Array, Array, Array]) -> tuple[Array, None]:
        one, other = (rows.at[slots].get(mode="clip").reshape(batch, -1, k) for slots in part[:2])
        products = jnp.einsum("nai,naj->nij", one, other, precision="highest")
        return total.at[part[2]].add(products, indices_are_sorted=True, mode="promise_in_bounds"), None

    blocks = layout.block_cameras[0].shape[0]
    return jax.lax.scan(add, jnp.zeros((blocks, k, k), rows.dtype), (first, second, block))[0]


def factor(eliminated: Eliminated, layout: BundleLayout) -> Reduced:
    """Form and factor the reduced system.

    Unknowns without information get zero. If S is not positive definite in working precision, `regular` is False and
    the factor is the identity.
    """
    matrix = reduced_matrix(eliminated, layout)
    dtype = matrix.dtype
    k = eliminated.camera.shape[-1]
    diagonal = layout.collapse(
        eliminated.camera[:, jnp.arange(k), jnp.arange(k)],
        [jnp.diagonal(block.hessian, axis1=1, axis2=2) for block in eliminated.factors],
    )
    informed = diagonal > 0
    # Jacobi scaling makes metres, radians and pixels comparable, which float32 needs.
    scale = jnp.where(informed, jax.lax.rsqrt(jnp.where(informed, diagonal, 1.0)), 0.0)
    scaled = scale[:, None] * matrix * scale[None, :] + jnp.diag(jnp.where(informed, 0.0, 1.0).astype(dtype))
    return Reduced(cholesky(scaled), scale, diagonal)


def solve(system: BundleSystem, layout: BundleLayout) -> tuple[Float[Array, " u"], Float[Array, "3 l"]]:
    """Solve the normal equations for −(camera, landmark) gradient.

    Where the reduced system cannot be factored, the answer is the diagonally scaled gradient step, which is finite.
    """
    eliminated = eliminate(system, layout)
    reduced = factor(eliminated, layout)
    landmark = eliminated.forward(system.landmark_gradient)
    gradient = system.gradient(layout)
    rhs = layout.collapse(eliminated.to_cameras(landmark, layout)) - gradient
    informed = reduced.diagonal > 0
    descent = -gradient / jnp.where(informed, reduced.diagonal, 1.0)
    unknowns = jnp.where(reduced.regular, reduced.solve(rhs[:, None])[:, 0], jnp.where(informed, descent, 0.0))
    return unknowns, substitute(eliminated, landmark, unknowns, layout)


def substitute(eliminated: Eliminated, landmark: Array, unknowns: Array, layout: BundleLayout) -> Float[Array, "3 l"]:
    """Landmarks from cameras; `landmark` is L⁻¹ of the landmarks' gradient."""
    return -eliminated.backward(landmark + eliminated.to_landmarks(layout.expand(unknowns), layout))


class Determined(NamedTuple):
    """Which free variables have information in all directions, the others taken as known."""

    poses: Bool[Array, " t"]
    landmarks: Bool[Array, " l"]


def determined(system: BundleSystem, layout: BundleLayout) -> Determined:
    """Look at the blocks of the diagonal. What is fixed counts as determined."""
    blocks = jnp.moveaxis(pose_blocks(system.camera, system.factors, layout), 0, -1)
    _, _, placed = cholesky_factor(blocks)
    _, _, known = cholesky_factor(system.landmark)
    return Determined(placed, known | (layout.landmark_free == 0))


def pose_blocks(
    camera: Float[Array, "c k k"], factors: Sequence[FactorBlock], layout: BundleLayout
) -> Float[Array, "t 6 6"]:
    """Diagonal blocks of the poses; those of fixed coordinates are the identity's."""
    poses = layout.pose_columns.shape[0]
    total = jax.ops.segment_sum(camera[:, :6, :6], layout.pose, poses)
    if layout.mount is not None:
        total = total + jax.ops.segment_sum(camera[:, 6:12, 6:12], layout.mount, poses)
    total = total + factor_blocks(factors, layout, total.dtype)
    free = layout.pose_columns < layout.unknowns
    both = free[:, :, None] & free[:, None, :]
    return jnp.where(both, total, jnp.eye(6, dtype=total.dtype)[None])


def factor_blocks(factors: Sequence[FactorBlock], layout: BundleLayout, dtype: np.dtype) -> Float[Array, "t 6 6"]:
    """What factors add to the diagonal blocks of the poses."""
    poses = layout.pose_columns.shape[0]
    total = jnp.zeros((poses, 6, 6), dtype)
    for index, block in zip(layout.factor_poses, factors, strict=True):
        for i in range(index.shape[1]):
            own = slice(6 * i, 6 * i + 6)
            total = total + jax.ops.segment_sum(block.hessian[:, own, own], index[:, i], poses)
    return total
