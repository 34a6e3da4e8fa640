"""Weights and centred coordinates of point sets, by components; shared by the solvers that align two sets."""

import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float

from ._components import Components, floor

Correspondences = tuple[Array, Array, Array]


def corresponding_points(
    points0: ArrayLike, points1: ArrayLike, weights: ArrayLike | None, fewest: int, dim: int = 3
) -> Correspondences:
    """Arrays of one dtype, weights filled in; refuses shapes that do not match and sets that are too small."""
    points0, points1 = jnp.asarray(points0), jnp.asarray(points1)
    if points0.shape != points1.shape or points0.ndim != 2 or points0.shape[1] != dim:
        raise ValueError(
            f"found points of shapes {points0.shape} and {points1.shape}; expected two equal shapes [n, {dim}]"
        )
    if points0.shape[0] < fewest:
        raise ValueError(f"found {points0.shape[0]} points; expected at least {fewest}")
    weights = jnp.ones(points0.shape[:1], points0.dtype) if weights is None else jnp.asarray(weights)
    if weights.shape != points0.shape[:1]:
        raise ValueError(f"found weights of shape {weights.shape}; expected one per point, {points0.shape[:1]}")
    dtype = jnp.result_type(points0, points1, weights)
    return points0.astype(dtype), points1.astype(dtype), weights.astype(dtype)


def normal_weights(
    weights: Float[Array, "n *lanes"], *points: Float[Array, "n d *lanes"]
) -> tuple[Float[Array, "n *lanes"], Bool[Array, "*lanes"]]:
    """Weights that sum to one, and whether they and the points are numbers of use; where not, the weights are zero."""
    largest = jnp.max(weights, axis=0)
    ok = jnp.all(weights >= 0, axis=0) & (largest > floor(largest) ** 3) & jnp.isfinite(largest)
    for array in points:
        ok = ok & jnp.all(jnp.isfinite(array), axis=(0, 1))
    weights = jnp.where(ok[None], weights, 0.0) / jnp.where(ok, largest, 1.0)[None]
    return weights / jnp.where(ok, jnp.sum(weights, axis=0), 1.0)[None], ok


def centred_components(
    points: Float[Array, "n d *lanes"], weights: Float[Array, "n *lanes"], ok: Bool[Array, "*lanes"]
) -> tuple[Components, Components]:
    """Components [n, *lanes] about the weighted mean, and the mean; zeros where not ok. The weights sum to one."""
    dim = points.shape[1]
    points = jnp.where(ok[None, None], points, 0.0)
    # Relative to one of the points first, so that far from the origin the mean does not round.
    relative = tuple(points[:, i] - points[0, i][None] for i in range(dim))
    offset = tuple(jnp.sum(weights * c, axis=0) for c in relative)
    mean = tuple(points[0, i] + offset[i] for i in range(dim))
    return tuple(relative[i] - offset[i][None] for i in range(dim)), mean


def largest_coordinate(points: Float[Array, "n d *lanes"], ok: Bool[Array, "*lanes"]) -> Float[Array, "*lanes"]:
    """What rounding of the coordinates is relative to; one where not ok."""
    return jnp.where(ok, jnp.max(jnp.abs(points), axis=(0, 1)), 1.0)
