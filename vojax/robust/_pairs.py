"""What the estimators share: checks and masks, noise, normalised pixels, and models as numbers in the lanes."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import cholesky_factor
from vojax._types import Array, Bool, Float
from vojax.ba import PixelRays, pixel_rays


class Plane(eqx.Module):
    """A camera for pixels of unknown calibration: moves and scales them to order one, rays have third component one."""

    center: Float[Array, "2"]
    scale: Float[Array, ""]

    def unproject(self, pixels: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
        """Homogeneous coordinates of order one."""
        x = (pixels - self.center[None]) * self.scale
        return jnp.concatenate([x, jnp.ones_like(x[:, :1])], axis=1)

    def matrix(self) -> Float[Array, "3 3"]:
        """The normalisation as a matrix that takes (u, v, 1) to what `unproject` returns."""
        zero, s = jnp.zeros_like(self.scale), self.scale
        rows = [[s, zero, -s * self.center[0]], [zero, s, -s * self.center[1]], [zero, zero, jnp.ones_like(s)]]
        return jnp.stack([jnp.stack(row) for row in rows])


def normalising_plane(pixels: Float[Array, "n 2"], mask: Bool[Array, " n"]) -> Plane:
    """Centre and scale of the pixels that count; constant to differentiation.

    References: Hartley, "In defense of the eight-point algorithm", PAMI 1997.
    """
    pixels = jax.lax.stop_gradient(pixels)
    count = jnp.maximum(jnp.sum(mask), 1).astype(pixels.dtype)
    center = jnp.sum(jnp.where(mask[:, None], pixels, 0.0), axis=0) / count
    spread = jnp.sum(jnp.where(mask[:, None], (pixels - center[None]) ** 2, 0.0)) / count
    return Plane(center, jnp.sqrt(2.0 / jnp.where(spread > 0, spread, 2.0)))


def noise_factors(sigma_px: Any, n: int, dtype: Any) -> tuple[Float[Array, "n 2 2"], Float[Array, "n 2 2"]]:
    """Lower-triangular square roots of the pixel covariances of both views.

    Args:
        sigma_px: Standard deviation in pixels: one for all `()`, one per correspondence `[n]`, or the covariances of
            both views `[n, 2, 2, 2]` in px², view first.
        n: Number of correspondences.
        dtype: Of the result.

    Raises:
        ValueError: If the shape of `sigma_px` is none of these.
    """
    sigma = jnp.asarray(sigma_px, dtype)
    if sigma.shape in ((), (n,)):
        factor = jnp.broadcast_to(sigma[..., None, None] * jnp.eye(2, dtype=dtype), (n, 2, 2))
        return factor, factor
    if sigma.shape != (n, 2, 2, 2):
        raise ValueError(
            f"sigma_px has shape {sigma.shape}: expected one standard deviation (), one for each correspondence "
            f"({n},), or the covariances of both views ({n}, 2, 2, 2)"
        )
    (first, second), _, _ = cholesky_factor(jnp.moveaxis(sigma, (-2, -1), (0, 1)))
    rows = [[first[0], jnp.zeros_like(first[0])], [first[1], second[0]]]
    factor = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    return factor[:, 0], factor[:, 1]


def check_sigma(sigma: Any, n: int) -> None:
    """Refuse noise that is a plain number and not positive (arrays may be traced), or of another number of rows.

    Raises:
        ValueError: If it is so.
    """
    if isinstance(sigma, (int, float)):
        if not 0 < sigma < float("inf"):
            raise ValueError(f"the standard deviation is {sigma}: expected a positive number")
    elif jnp.ndim(sigma) and jnp.shape(sigma)[0] != n:
        raise ValueError(f"the noise has shape {jnp.shape(sigma)}: expected () or one entry for each of {n} rows")


def usable_noise(sigma: Any, mask: Bool[Array, " n"]) -> tuple[Any, Bool[Array, " n"]]:
    """Noise that can be divided by, and which rows count: those whose noise is positive and finite.

    Args:
        sigma: One standard deviation, one for each row, or covariances `[n, ..., d, d]`.
        mask: Rows that count.

    Returns:
        The noise, one (or the identity) in rows that do not count, and those that do.

    Raises:
        ValueError: As `check_sigma`.
    """
    check_sigma(sigma, mask.shape[0])
    if isinstance(sigma, (int, float)):
        return sigma, mask
    sigma = jnp.asarray(sigma)
    if sigma.ndim < 2:
        good = mask & (sigma > 0) & jnp.isfinite(sigma)
        return jnp.where(good if sigma.ndim else jnp.any(good), sigma, 1.0), good
    d = sigma.shape[-1]
    axes = tuple(range(1, sigma.ndim))
    variances = jnp.diagonal(sigma, axis1=-2, axis2=-1)
    good = jnp.all(jnp.isfinite(sigma), axis=axes) & jnp.all(variances > 0, axis=axes[:-1])
    identity = jnp.broadcast_to(jnp.eye(d, dtype=sigma.dtype), sigma.shape)
    return jnp.where(good.reshape(-1, *(1 for _ in axes)), sigma, identity), mask & good


def root_mean_square(sigma_px: Any, mask: Bool[Array, " n"]) -> Float[Array, ""]:
    """One standard deviation that stands for all, whatever form they come in; constant to differentiation.

    Raises:
        ValueError: As `check_sigma`.
    """
    check_sigma(sigma_px, mask.shape[0])
    sigma = jax.lax.stop_gradient(jnp.asarray(sigma_px))
    if sigma.ndim == 0:
        return sigma
    if sigma.ndim == 1:
        square = sigma * sigma
    else:  # covariances: half the trace, averaged over the views if there are two
        square = jnp.trace(sigma, axis1=-2, axis2=-1) / sigma.shape[-1]
        square = jnp.mean(square.reshape(mask.shape[0], -1), axis=1)
    total = jnp.sum(jnp.where(mask, square, 0.0)) / jnp.maximum(jnp.sum(mask), 1)
    return jnp.sqrt(jnp.where(total > 0, total, 1.0))


def pair_rays(pixels0: Array, pixels1: Array, camera0: Any, camera1: Any) -> tuple[PixelRays, PixelRays]:
    """Rays of both views for a noise of one pixel."""
    return pixel_rays(camera0, pixels0), pixel_rays(camera1, pixels1)


def noisy_rays(unit: tuple[PixelRays, PixelRays], sigma_px: Any) -> tuple[PixelRays, PixelRays]:
    """The same rays with the noise that they have."""
    x = unit[0].ray[0]
    factors = noise_factors(sigma_px, x.shape[0], x.dtype)
    return unit[0].scaled(factors[0]), unit[1].scaled(factors[1])


def checked_pairs(
    pixels0: Any, pixels1: Any, least: int, what: str, d: int = 2
) -> tuple[Float[Array, "n d"], Float[Array, "n d"]]:
    """Arrays of one dtype and of shapes that fit.

    Raises:
        ValueError: If shapes do not fit or there are fewer rows than a minimal sample has.
    """
    first, second = jnp.asarray(pixels0), jnp.asarray(pixels1)
    name = "pixels" if d == 2 else "points"
    if first.ndim != 2 or first.shape[1] != d or first.shape != second.shape:
        raise ValueError(
            f"{name}0 has shape {first.shape} and {name}1 {second.shape}: expected (n, {d}) both, one row for each "
            "correspondence"
        )
    if first.shape[0] < least:
        raise ValueError(f"{first.shape[0]} correspondences: {what} needs at least {least}")
    dtype = jnp.result_type(first, second, jnp.float32)
    return first.astype(dtype), second.astype(dtype)


def checked_observations(points_world: Any, pixels: Any) -> tuple[Float[Array, "n 3"], Float[Array, "n 2"]]:
    """Points and pixels as arrays.

    Raises:
        ValueError: If shapes do not fit or there are fewer rows than a minimal sample has.
    """
    points_world, pixels = jnp.asarray(points_world), jnp.asarray(pixels)
    n = points_world.shape[0]
    if points_world.shape != (n, 3) or pixels.shape != (n, 2):
        raise ValueError(
            f"points_world has shape {points_world.shape} and pixels {pixels.shape}: expected (n, 3) and (n, 2), "
            "one row for each correspondence"
        )
    if n < 3:
        raise ValueError(f"{n} correspondences: a pose needs at least 3, and 4 to be unique")
    return points_world, pixels


def masked_pairs(first: Array, second: Array, mask: Any) -> tuple[Array, Array, Bool[Array, " n"]]:
    """Zeros in rows that do not count or are not finite, and which rows count.

    Raises:
        ValueError: If the mask does not fit the rows.
    """
    if mask is not None and jnp.shape(mask) != first.shape[:1]:
        raise ValueError(f"mask has shape {jnp.shape(mask)}: expected one entry for each of {len(first)} rows")
    finite = jnp.all(jnp.isfinite(first), axis=1) & jnp.all(jnp.isfinite(second), axis=1)
    mask = finite if mask is None else finite & jnp.asarray(mask)
    return jnp.where(mask[:, None], first, 0.0), jnp.where(mask[:, None], second, 0.0), mask


def about_middle(points: Float[Array, "n d"], mask: Bool[Array, " n"]) -> tuple[Float[Array, "n d"], Float[Array, "d"]]:
    """Points about the middle of those that count, wherever the origin is, and that middle.

    Rows that do not count are zero, before and after; the middle is constant to differentiation.
    """
    count = jnp.maximum(jnp.sum(mask), 1).astype(points.dtype)
    middle = jax.lax.stop_gradient(jnp.sum(points, axis=0) / count)
    return jnp.where(mask[:, None], points - middle[None], 0.0), middle


def single_precision(tree: Any) -> Any:
    """Constants in float32: what a search works on."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x).astype(jnp.float32), tree)


def matrix_rows(models: Float[Array, "9 *lanes"]) -> list[tuple[Array, Array, Array]]:
    """Rows of 3×3 matrices in the lanes."""
    return [(models[i], models[i + 1], models[i + 2]) for i in (0, 3, 6)]


def matrix_lanes(parameters: Float[Array, "p *lanes"]) -> Float[Array, "12 *lanes"]:
    """[s R | t] from quaternion, translation and perhaps scale, in the lanes."""
    w, x, y, z, *rest = parameters
    s = rest[3] if len(rest) > 3 else jnp.ones_like(w)
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z
    return jnp.stack(
        [
            *(s * (1 - 2 * (yy + zz)), s * 2 * (xy - wz), s * 2 * (xz + wy), rest[0]),
            *(s * 2 * (xy + wz), s * (1 - 2 * (xx + zz)), s * 2 * (yz - wx), rest[1]),
            *(s * 2 * (xz - wy), s * 2 * (yz + wx), s * (1 - 2 * (xx + yy)), rest[2]),
        ]
    )
