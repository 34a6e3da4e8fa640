"""The algebra of the essential matrix: the motions it stands for, and which of them has the scene in front.

E = [t]× R with `ray1ᵀ E ray0 = 0` determines t up to sign and scale, and R up to half a turn about t. Both follow from
E without a singular value decomposition, whose derivative does not exist where two singular values are equal, as those
of every essential matrix are. With |t| = 1 and |E|² = 2,

    cof(E) = t (Rᵀt)ᵀ,        R = cof(E) - [t]× E,                                                              (1)

where cof(E) is the matrix of cofactors (Horn). The other three motions are (R, -t) and, with R' = (2 t tᵀ - I) R,
(R', t) and (R', -t).

For a matrix M near the manifold (1) is applied to the essential matrix next to it: with the vectors u and v of the
least singular value,

    ½ (M' + [u]× M' [v]×ᵀ),        M' = (I - u uᵀ) M,                                                            (2)

replaces the two other singular values by their mean (a 2×2 matrix plus its matrix of cofactors is a multiple of a
rotation).

References:
    B. Horn. Recovering baseline and orientation from essential matrix. 1990.
    R. Hartley, A. Zisserman. Multiple View Geometry in Computer Vision, 2nd edition, section 9.6.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import Vector3, cross3, dot3
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SE3, SO3


class EssentialMotions(eqx.Module):
    """The four motions of an essential matrix.

    Attributes:
        cam1_from_cam0: Four poses on the leading axis, |t| = 1: (Ra, t), (Ra, -t), (Rb, t), (Rb, -t). The largest
            component of t is positive; E is a positive multiple of [t]× Ra and a negative one of [t]× Rb.
        valid: False where the matrix has no two directions, is zero or not finite; the poses are the identity then.
    """

    cam1_from_cam0: SE3
    valid: Bool[Array, "*batch"]


def decompose_essential(essential: Float[ArrayLike, "3 3"]) -> EssentialMotions:
    """Find the four relative poses that have a given essential matrix.

    Args:
        essential: Matrix E with `ray1ᵀ E ray0 = 0`, of any scale and sign.

    Returns:
        The poses in a fixed order, and whether there are any. A matrix near the manifold is decomposed as the essential
        matrix next to it: up to (s2/s1)³ of its singular values where the third, s2, is not zero.

    Degenerate input: a zero matrix, one of rank 1 to rounding, and anything not finite give identities and
        `valid=False`.

    Differentiability: both modes, any order, although two singular values are equal; across the manifold it is the
        derivative of the nearest essential matrix. The sign of t and with it the order of the slots may jump.

    References: Horn, 1990; see the module.

    Example:
        >>> import jax.numpy as jnp
        >>> sideways = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, -2.0], [0.0, 2.0, 0.0]])
        >>> [int(t[0]) for t in decompose_essential(sideways).cam1_from_cam0.translation()]
        [1, -1, 1, -1]
    """
    matrix = jnp.asarray(essential)
    entries = [[matrix[i, j] for j in range(3)] for i in range(3)]
    sizes = [jnp.abs(jax.lax.stop_gradient(entry)) for row in entries for entry in row]
    largest = sizes[0]
    for size in sizes[1:]:
        largest = jnp.maximum(largest, size)
    # In two steps, as the reciprocal of a tiny number may overflow where the quotient does not.
    valid = jnp.isfinite(largest) & (largest > 0)
    scale = jnp.where(valid, largest, 1.0)
    sideways = ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))

    def proper(entries: list[list[Array]], valid: Array) -> list[list[Array]]:
        return [[jnp.where(valid, entries[i][j], sideways[i][j]) for j in range(3)] for i in range(3)]

    rows = [[entry / scale for entry in row] for row in proper(entries, valid)]
    cofactors = _cofactors(rows)
    magnitude = sum(jnp.abs(jax.lax.stop_gradient(x)) for row in cofactors for x in row)
    # s0 s1 against s0², of order one: rounding of the products.
    valid = valid & (magnitude > 16.0 * float(jnp.finfo(matrix.dtype).eps))
    rows = proper(rows, valid)

    u, v = _null_directions(_cofactors(rows))
    sign = jnp.where(_largest_component(u) < 0, -1.0, 1.0).astype(matrix.dtype)
    u, v = tuple(sign * x for x in u), tuple(sign * x for x in v)
    columns = [tuple(rows[i][j] for i in range(3)) for j in range(3)]
    crossed = [cross3(u, column) for column in columns]  # [u]× M
    twice = [cross3(u, column) for column in crossed]  # -M'
    mean = [cross3(v, (twice[0][i], twice[1][i], twice[2][i])) for i in range(3)]  # its rows times [v]×ᵀ
    turned = [[crossed[j][i] + mean[i][j] for j in range(3)] for i in range(3)]
    norm = jnp.sqrt(0.5 * sum(x * x for row in turned for x in row))
    rotation = jnp.stack([jnp.stack([u[i] * v[j] - turned[i][j] / norm for j in range(3)]) for i in range(3)])
    first = SO3.from_matrix(rotation).wxyz
    w, axis = first[0], (first[1], first[2], first[3])
    # Half a turn about t has the quaternion (0, t).
    across = cross3(u, axis)
    second = jnp.stack([-dot3(u, axis), *(w * u[i] + across[i] for i in range(3))])
    t = jnp.stack(u)
    poses = jnp.stack([jnp.concatenate([q, side * t]) for q in (first, second) for side in (1.0, -1.0)])
    identity = jnp.broadcast_to(jnp.eye(7, dtype=poses.dtype)[0][None], poses.shape)
    return EssentialMotions(SE3(jnp.where(valid, poses, identity)), valid)


def cheirality_votes(
    cam1_from_cam0: SE3,
    rays0: Float[ArrayLike, "n 3"],
    rays1: Float[ArrayLike, "n 3"],
    weights: Float[ArrayLike, "n"] | None = None,
) -> Float[Array, "*batch"]:
    """Count the correspondences whose point lies in front of both cameras, for one relative pose or several.

    In front means at positive distances along both rays (not z > 0), so fields of view beyond 180° are fine. The
    distances are those of the points where the two rays pass each other.

    Args:
        cam1_from_cam0: One pose, or poses with leading axes; the length of the translation does not matter.
        rays0: Directions in camera 0's frame, of any positive length.
        rays1: The matching ones in camera 1's frame.
        weights: What each correspondence counts, 1 when left out; 0 masks it.

    Returns:
        The sum of the weights of those in front, for each pose.

    Degenerate input: rays that are parallel to rounding and point the same way belong to a point at infinity, which is
        in front for either sign of the translation: half a vote. Zero rays, rays that are not finite, and rays along
        the translation have no vote.

    Differentiability: in the weights; otherwise the gradient is zero.

    References: Hartley & Zisserman, section 9.6.3.

    Example:
        >>> import jax.numpy as jnp
        >>> from vojax.lie import SE3
        >>> sideways = SE3(jnp.array([1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0]))
        >>> rays0, rays1 = jnp.array([[0.0, 0.0, 2.0], [0.3, 0.0, 1.0]]), jnp.array([[-0.5, 0.0, 1.0], [0.3, 0.0, 1.0]])
        >>> float(cheirality_votes(sideways, rays0, rays1))
        1.5
    """
    f0, f1 = (_unit_components(jax.lax.stop_gradient(jnp.asarray(rays))) for rays in (rays0, rays1))
    poses = jax.lax.stop_gradient(cam1_from_cam0)
    batch = poses.get_batch_axes()
    rotation = poses.rotation().as_matrix()[..., None]  # [*batch, 3, 3, 1]
    translation = poses.translation()[..., None]

    def over(x: Array) -> Array:
        return x.reshape((1,) * len(batch) + x.shape)

    first = [over(x) for x in f0]
    q = tuple(over(x) for x in f1)
    p = tuple(dot3([rotation[..., i, j, :] for j in range(3)], first) for i in range(3))
    t = tuple(translation[..., i, :] for i in range(3))
    normal = cross3(p, q)
    # d0 p + t = d1 q in the least-squares sense: the squared sine times each distance, without cancellation.
    distance0 = dot3(normal, cross3(q, t))
    distance1 = dot3(normal, cross3(p, t))
    eps = float(jnp.finfo(normal[0].dtype).eps)
    parallel = dot3(normal, normal) <= (8.0 * eps) ** 2
    in_front = jnp.where(~parallel & (distance0 > 0) & (distance1 > 0), 1.0, 0.0)
    # A zero ray has no direction to share.
    vote = jnp.where(parallel & (dot3(p, q) > 0), 0.5, in_front).astype(normal[0].dtype)
    if weights is None:
        return jnp.sum(vote, axis=-1)
    return jnp.sum(jnp.where(vote > 0, vote * over(jnp.asarray(weights)), 0.0), axis=-1)


def pose_from_essential(
    essential: Float[ArrayLike, "3 3"],
    rays0: Float[ArrayLike, "n 3"],
    rays1: Float[ArrayLike, "n 3"],
    weights: Float[ArrayLike, "n"] | None = None,
) -> tuple[SE3, Float[Array, ""]]:
    """Choose among the four motions of an essential matrix the one with most points in front of both cameras.

    Args:
        essential: Matrix E with `ray1ᵀ E ray0 = 0`, of any scale and sign.
        rays0: Directions in camera 0's frame, of any positive length.
        rays1: The matching ones in camera 1's frame.
        weights: What each correspondence counts, 1 when left out; 0 masks it.

    Returns:
        The pose `cam1_from_cam0` with |t| = 1, and its votes. Of equal votes the first in `decompose_essential`'s order
        wins.

    Degenerate input: a matrix that has no motions gives the identity and 0 votes.

    Differentiability: the pose as `decompose_essential`, through the chosen motion; the votes in the weights only.

    References: Hartley & Zisserman, section 9.6.3.
    """
    motions = decompose_essential(essential)
    votes = cheirality_votes(motions.cam1_from_cam0, rays0, rays1, weights)
    best, index = votes[0], jnp.zeros_like(votes[0], dtype=jnp.int32)
    for slot in (1, 2, 3):
        better = votes[slot] > best
        best, index = jnp.where(better, votes[slot], best), jnp.where(better, slot, index)
    poses = motions.cam1_from_cam0.wxyz_xyz
    chosen = poses[0]
    for slot in (1, 2, 3):
        chosen = jnp.where(index == slot, poses[slot], chosen)
    return SE3(chosen), jnp.where(motions.valid, best, 0.0)


def _cofactors(rows: list[list[Array]]) -> list[Vector3]:
    """Rows of the matrix of cofactors."""
    return [cross3(rows[1], rows[2]), cross3(rows[2], rows[0]), cross3(rows[0], rows[1])]


def _null_directions(cofactors: list[Vector3]) -> tuple[Vector3, Vector3]:
    """Unit vectors u and v of the least singular value, with cof ≈ σ u vᵀ, σ > 0.

    For rank 2 any row of cofactors is along v. Steps of the power method take out what a small third singular value
    adds, in the value to third order and so in the derivative altogether.
    """
    v, size = cofactors[0], dot3(cofactors[0], cofactors[0])
    for row in cofactors[1:]:
        squared = dot3(row, row)
        v = tuple(jnp.where(squared > size, new, old) for new, old in zip(row, v, strict=True))
        size = jnp.maximum(size, squared)
    columns = [(cofactors[0][j], cofactors[1][j], cofactors[2][j]) for j in range(3)]
    u = _unit(tuple(dot3(row, v) for row in cofactors))
    v = _unit(tuple(dot3(u, column) for column in columns))
    return _unit(tuple(dot3(row, v) for row in cofactors)), v


def _unit(x: Vector3) -> Vector3:
    norm = jnp.sqrt(dot3(x, x))
    return tuple(component / norm for component in x)


def _largest_component(x: Vector3) -> Array:
    largest = x[0]
    for component in x[1:]:
        largest = jnp.where(jnp.abs(component) > jnp.abs(largest), component, largest)
    return largest


def _unit_components(rays: Array) -> Vector3:
    """Columns of rays scaled to length 1; zero for rays that have no direction or are not finite."""
    x, y, z = rays[:, 0], rays[:, 1], rays[:, 2]
    largest = jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z))
    usable = jnp.isfinite(largest) & (largest > 0)
    scaled = tuple(jnp.where(usable, c / jnp.where(usable, largest, 1.0), 0.0) for c in (x, y, z))
    norm = jnp.sqrt(jnp.where(usable, dot3(scaled, scaled), 1.0))
    return tuple(c / norm for c in scaled)
