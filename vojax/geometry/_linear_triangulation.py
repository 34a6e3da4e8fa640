"""Triangulation without iterations: the point nearest to viewing rays, and the direct linear transform."""

import jax.numpy as jnp

from vojax._numerics import cholesky_solve, normalize, safe_divide, safe_norm, safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float

from ._null_vector import null_vector

# Parallel rays meet this many times the spread of their centres away.
FAR_SPREADS = 1e6


def _view_weights(count: int, dtype, weights, mask) -> Array:
    """Weights per view; masked views weigh 0."""
    w = jnp.ones(count, dtype) if weights is None else jnp.asarray(weights).astype(dtype)
    return w if mask is None else jnp.where(jnp.asarray(mask), w, 0.0)


def _frame_about(axis: Array) -> Array:
    """Rows: two unit vectors orthogonal to the unit `axis`, and the axis (Duff et al., 2017)."""
    x, y, z = axis[0], axis[1], axis[2]
    sign = jnp.where(z < 0, -1.0, 1.0).astype(axis.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    return jnp.stack(
        [
            jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x]),
            jnp.stack([b, sign + y * y * a, -y]),
            axis,
        ]
    )


def triangulate_rays(
    centers: Float[ArrayLike, "c 3"],
    bearings: Float[ArrayLike, "c 3"],
    weights: Float[ArrayLike, "c"] | None = None,
    *,
    mask: Bool[ArrayLike, "c"] | None = None,
) -> Float[Array, "3"]:
    """Place the point nearest to viewing rays: it minimises Σ w (distance to the ray's line)².

    Args:
        centers: Where the rays start, in any common frame.
        bearings: Unit direction of each ray, in the same frame.
        weights: Weight of each squared distance; all 1 when left out.
        mask: Which rays to use; all when left out.

    Returns:
        The point, in the frame and unit of the centres. For two rays it is the midpoint of their common perpendicular.

    Degenerate input: rays parallel to rounding meet 1e6 spreads of the centres away, in the rays' mean direction; rays
    with a common centre meet there; no rays give the origin. The lines extend behind the centres: check cheirality.

    Differentiability: both modes; the depth of parallel rays has gradient 0 with respect to the bearings.

    References: Scaramuzza & Fraundorfer, "Visual Odometry Part I", 2011, triangulation and keyframe selection.

    Example:
        >>> import jax.numpy as jnp
        >>> centers = jnp.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> bearings = jnp.array([[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]])
        >>> [round(float(x), 4) for x in triangulate_rays(centers, bearings)]
        [1.0, 0.0, 1.3333]
    """
    centers, bearings = jnp.asarray(centers), jnp.asarray(bearings)
    w = _view_weights(centers.shape[0], centers.dtype, weights, mask)
    w = safe_divide(w, jnp.full_like(w, jnp.sum(w)))
    # In a frame along the mean ray, I - b bᵀ is small where it is small: bx² + by² has no cancellation, so nearly
    # parallel rays keep their depth in float32.
    mean = jnp.sum(w[:, None] * bearings, axis=0)
    axis = normalize(jnp.where(safe_norm(mean) < 1e-3, bearings[jnp.argmax(w)], mean))
    frame = _frame_about(axis)
    origin = jnp.sum(w[:, None] * centers, axis=0)
    local = centers - origin[None, :]
    b = [jnp.sum(bearings * row[None, :], axis=1) for row in frame]
    c = [jnp.sum(local * row[None, :], axis=1) for row in frame]

    a_xx = jnp.sum(w * (b[1] * b[1] + b[2] * b[2]))
    a_yy = jnp.sum(w * (b[0] * b[0] + b[2] * b[2]))
    a_zz = jnp.sum(w * (b[0] * b[0] + b[1] * b[1]))
    a_yx, a_zx, a_zy = -jnp.sum(w * b[0] * b[1]), -jnp.sum(w * b[0] * b[2]), -jnp.sum(w * b[1] * b[2])
    along = b[0] * c[0] + b[1] * c[1] + b[2] * c[2]
    # The third row as b × (c × b) has no cancellation either.
    r_x = jnp.sum(w * (c[0] - b[0] * along))
    r_y = jnp.sum(w * (c[1] - b[1] * along))
    r_z = jnp.sum(w * ((b[0] * b[0] + b[1] * b[1]) * c[2] - b[2] * (b[0] * c[0] + b[1] * c[1])))
    matrix = jnp.stack([jnp.stack([a_xx, a_yx, a_zx]), jnp.stack([a_yx, a_yy, a_zy]), jnp.stack([a_zx, a_zy, a_zz])])
    solution = cholesky_solve(matrix, jnp.stack([r_x, r_y, r_z])[:, None])[0][:, 0]

    spread = safe_sqrt(jnp.sum(w[:, None] * local * local))
    resolution = 4.0 * float(jnp.finfo(centers.dtype).eps)
    parallel = a_zz < resolution * resolution
    far = FAR_SPREADS * spread
    depth = jnp.where(parallel, far, solution[2])
    x = jnp.where(parallel, 0.0, solution[0])
    y = jnp.where(parallel, 0.0, solution[1])
    return origin + x * frame[0] + y * frame[1] + depth * frame[2]


def ray_distances(
    point: Float[ArrayLike, "3"], centers: Float[ArrayLike, "c 3"], bearings: Float[ArrayLike, "c 3"]
) -> Float[Array, "c"]:
    """Distance of a point from the line of each viewing ray, in the unit of the centres.

    Args:
        point: The point, in the frame of the centres.
        centers: Where the rays start.
        bearings: Unit direction of each ray.

    Differentiability: both modes; 0 where the distance is 0.
    """
    b = jnp.asarray(bearings)
    d = jnp.asarray(point)[None, :] - jnp.asarray(centers)
    return safe_norm(
        jnp.stack(
            [
                d[:, 1] * b[:, 2] - d[:, 2] * b[:, 1],
                d[:, 2] * b[:, 0] - d[:, 0] * b[:, 2],
                d[:, 0] * b[:, 1] - d[:, 1] * b[:, 0],
            ],
            axis=1,
        )
    )


def ray_distance_std(
    point: Float[ArrayLike, "3"],
    centers: Float[ArrayLike, "c 3"],
    bearings: Float[ArrayLike, "c 3"],
    weights: Float[ArrayLike, "c"] | None = None,
    *,
    mask: Bool[ArrayLike, "c"] | None = None,
) -> Float[Array, ""]:
    """Quality of a triangulated point: the standard deviation of its distances from the rays, about zero.

    The deviation is taken about the perfect distance 0. About the mean it would be 0 for every pair of rays, whose
    midpoint is equally far from both.

    Args:
        point: The point, in the frame of the centres.
        centers: Where the rays start.
        bearings: Unit direction of each ray.
        weights: Weight of each ray; all 1 when left out.
        mask: Which rays to use; all when left out.

    Returns:
        The deviation, in the unit of the centres; 0 without rays.

    Differentiability: both modes; 0 where the deviation is 0.

    References: Scaramuzza & Fraundorfer, "Visual Odometry Part I", 2011, triangulation and keyframe selection.
    """
    distances = ray_distances(point, centers, bearings)
    w = _view_weights(distances.shape[0], distances.dtype, weights, mask)
    return safe_sqrt(safe_divide(jnp.sum(w * distances * distances), jnp.sum(w)))


def _dlt_rows(projections, pixels, mask) -> Array:
    """Two rows of the system A h = 0 per view: u p3 - p1 and v p3 - p2."""
    projections, pixels = jnp.asarray(projections), jnp.asarray(pixels)
    third = projections[:, 2, :]
    rows = jnp.concatenate([pixels[:, :1] * third - projections[:, 0, :], pixels[:, 1:] * third - projections[:, 1, :]])
    return rows if mask is None else jnp.where(jnp.tile(jnp.asarray(mask), 2)[:, None], rows, 0.0)


def triangulate_dlt_homogeneous(
    projections: Float[ArrayLike, "c 3 4"],
    pixels: Float[ArrayLike, "c 2"],
    *,
    mask: Bool[ArrayLike, "c"] | None = None,
) -> Float[Array, "4"]:
    """Triangulate by the direct linear transform, to a homogeneous point.

    Args:
        projections: Matrices that project the world to `pixels`. In float32 prefer [R | t] with normalized coordinates:
            pixel units make the system ill-conditioned.
        pixels: The observations, pixels or normalized, as the matrices have it.
        mask: Which views to use; all when left out.

    Returns:
        Unit 4-vector (X, Y, Z, W), its sign such that the depths P₃·h are positive on the whole. W near 0 is a point
        near infinity in the direction (X, Y, Z); W < 0 is a point behind the cameras.

    Degenerate input: one view or none gives some vector of the solution space.

    Differentiability: both modes, first order.

    References: Hartley & Zisserman, section 12.2.
    """
    projections = jnp.asarray(projections)
    point = null_vector(_dlt_rows(projections, pixels, mask))
    depths = jnp.sum(projections[:, 2, :] * point[None, :], axis=1)
    if mask is not None:
        depths = jnp.where(jnp.asarray(mask), depths, 0.0)
    return point * jnp.where(jnp.sum(depths) < 0, -1.0, 1.0).astype(point.dtype)


def triangulate_dlt(
    projections: Float[ArrayLike, "c 3 4"],
    pixels: Float[ArrayLike, "c 2"],
    *,
    mask: Bool[ArrayLike, "c"] | None = None,
) -> Float[Array, "3"]:
    """Triangulate by the homogeneous direct linear transform.

    Args:
        projections: Matrices that project the world to `pixels`.
        pixels: The observations, pixels or normalized, as the matrices have it.
        mask: Which views to use; all when left out.

    Returns:
        The point in the world frame.

    Degenerate input: parallel rays give a finite far point in their direction.

    Differentiability: both modes, first order.

    References: Hartley & Zisserman, section 12.2.
    """
    h = triangulate_dlt_homogeneous(projections, pixels, mask=mask)
    floor = float(jnp.finfo(h.dtype).eps)
    return h[:3] / jnp.where(jnp.abs(h[3]) > floor, h[3], floor)


def triangulate_dlt_inhomogeneous(
    projections: Float[ArrayLike, "c 3 4"],
    pixels: Float[ArrayLike, "c 2"],
    *,
    mask: Bool[ArrayLike, "c"] | None = None,
) -> Float[Array, "3"]:
    """Triangulate by least squares with W = 1; for comparison, as it fails for nearly parallel rays.

    Args:
        projections: Matrices that project the world to `pixels`.
        pixels: The observations, pixels or normalized, as the matrices have it.
        mask: Which views to use; all when left out.

    Returns:
        The point in the world frame.

    Degenerate input: parallel rays leave the depth undetermined, and nearly parallel ones leave it to noise, even in
    sign; the answer is finite. Use `triangulate_dlt`.

    Differentiability: both modes.

    References: Hartley & Zisserman, section 12.2.
    """
    rows = _dlt_rows(projections, pixels, mask)
    gram = jnp.sum(rows[:, :, None] * rows[:, None, :], axis=0)
    return cholesky_solve(gram[:3, :3], -gram[:3, 3:])[0][:, 0]
