"""Robust losses ρ(s) of a squared residual norm s, and the residual that turns each into least squares.

Convention: the cost of an observation with whitened residual r is ½ρ(‖r‖²), ρ(s) = s + O(s²) near 0. All are smooth at
s = 0 and elementwise, so they run in the lanes; `rho_over_s` = ρ(s)/s is what the optimiser needs, and is written so
that it has finite derivatives at s = 0.
"""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._numerics import safe_sqrt
from vojax._types import Array, ArrayLike, Bool, Float


@runtime_checkable
class Loss(Protocol):
    """A robust loss; frozen, and a pytree."""

    def rho(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Loss of a squared whitened residual norm."""
        ...

    def weight(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Derivative ρ′(s): the weight of iteratively reweighted least squares."""
        ...


class Squared(eqx.Module):
    """ρ(s) = s: maximum likelihood under Gaussian noise."""

    def rho(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Loss of a squared residual norm."""
        return s

    def weight(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Derivative of the loss."""
        return jnp.ones_like(s)


class Huber(eqx.Module):
    """Quadratic up to `delta` standard deviations, linear (the L1 of sums of absolute differences) beyond.

    References: Huber, "Robust estimation of a location parameter", 1964.
    """

    delta: Float[Array, ""] | float = 1.345

    def rho(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Loss of a squared residual norm."""
        inside = s <= self.delta**2
        return jnp.where(inside, s, 2 * self.delta * safe_sqrt(jnp.where(inside, 1.0, s)) - self.delta**2)

    def weight(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Derivative of the loss."""
        inside = s <= self.delta**2
        return jnp.where(inside, 1.0, self.delta / safe_sqrt(jnp.where(inside, 1.0, s)))


class Cauchy(eqx.Module):
    """ρ(s) = c² log(1 + s/c²): maximum likelihood under heavy-tailed Cauchy noise."""

    scale: Float[Array, ""] | float = 2.385

    def rho(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Loss of a squared residual norm."""
        return self.scale**2 * jnp.log1p(s / self.scale**2)

    def weight(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Derivative of the loss."""
        return 1.0 / (1.0 + s / self.scale**2)


class GemanMcClure(eqx.Module):
    """ρ(s) = s / (1 + s/c²): quadratic near 0 and flat (at c²) for outliers.

    References: Geman & McClure, "Bayesian image analysis", 1985; Szeliski, "Computer Vision", appendix B.3.
    """

    scale: Float[Array, ""] | float = 2.0

    def rho(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Loss of a squared residual norm."""
        return s / (1.0 + s / self.scale**2)

    def weight(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Derivative of the loss."""
        return 1.0 / (1.0 + s / self.scale**2) ** 2


class Tukey(eqx.Module):
    """Biweight: smooth, and flat beyond `scale` standard deviations, so that outliers have no weight at all.

    References: Beaton & Tukey, "The fitting of power series", 1974.
    """

    scale: Float[Array, ""] | float = 4.685

    def rho(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Loss of a squared residual norm."""
        rest = jnp.maximum(1.0 - s / self.scale**2, 0.0)
        return self.scale**2 / 3.0 * (1.0 - rest**3)

    def weight(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Derivative of the loss."""
        return jnp.maximum(1.0 - s / self.scale**2, 0.0) ** 2


class GaussianUniform(eqx.Module):
    """Maximum likelihood of Gaussian inliers among uniform outliers: ρ(s) = −2 log((e^(−s/2) + u) / (1 + u)).

    With u = e^(−cut²/2) an observation at `cut` standard deviations is as likely an outlier as an inlier; its weight
    there is ½, and 1/(1 + u) at zero. Marginalising the scale, as MAGSAC++ does, gives nearly the same weights.

    References: Torr & Zisserman, "MLESAC", 2000, eq. (4).
    """

    cut: Float[Array, ""] | float = 3.0

    def rho(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Loss of a squared residual norm."""
        low = -0.5 * self.cut**2
        return 2.0 * (jnp.logaddexp(0.0, low) - jnp.logaddexp(-0.5 * s, jnp.broadcast_to(low, s.shape)))

    def weight(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Derivative of the loss."""
        return jax.nn.sigmoid(0.5 * (self.cut**2 - s))


class Barron(eqx.Module):
    """The general robust loss, which passes through most others as its shape parameter moves.

    α = 2 is the squared loss, 1 the smoothed L1 (pseudo-Huber), 0 Cauchy's, −2 Geman–McClure's up to scale and −∞
    Welsch's. `alpha` may be a traced array, so it can be learnt.

    References: Barron, "A general and adaptive robust loss function", CVPR 2019, eq. (1), here times 2c².
    """

    alpha: Float[Array, ""] | float = 1.0
    scale: Float[Array, ""] | float = 1.0

    def _pieces(self, s: Float[Array, "*shape"]) -> tuple[Array, Array, Array, Array]:
        alpha = jnp.asarray(self.alpha, s.dtype)
        # The removable singularities at α = 0 and α = 2 are stepped over: the loss is continuous in α.
        gap = 2.0 * float(jnp.finfo(s.dtype).eps) ** 0.5
        alpha = jnp.where(jnp.abs(alpha) < gap, gap, alpha)
        alpha = jnp.where(jnp.abs(alpha - 2.0) < gap, 2.0 - gap, alpha)
        return alpha, jnp.abs(alpha - 2.0), s / self.scale**2, 0.5 * alpha

    def rho(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Loss of a squared residual norm."""
        alpha, beta, x, half = self._pieces(s)
        # ((x/β + 1)^(α/2) − 1) 2β/α without cancellation for small x or α.
        return 2.0 * self.scale**2 * beta / alpha * jnp.expm1(half * jnp.log1p(x / beta))

    def weight(self, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Derivative of the loss."""
        _, beta, x, half = self._pieces(s)
        return jnp.exp((half - 1.0) * jnp.log1p(x / beta))


def robustify(residual: tuple[Array, ...], loss: Loss, weight: Array | None = None) -> tuple[Array, ...]:
    """Scale residual components so that half their squared norm is half the loss.

    Args:
        residual: Components of one whitened residual, each elementwise over observations.
        loss: The robust loss.
        weight: Non-negative factor on the loss of each observation; 0 removes it.

    Returns:
        Components r̃ = r √(w ρ(s)/s), for which ½‖r̃‖² = ½ w ρ(‖r‖²): acceptance tests then see the true cost.

    Differentiability: both modes, twice, including at r = 0, where r̃ ≈ √(w ρ′(0)) r. So far out that derivatives of
        ρ(s)/s would overflow (10⁶ standard deviations in float32), that ratio counts as constant.
    """
    if isinstance(loss, Squared):
        scaled = None if weight is None else safe_sqrt(weight)
    else:
        s = jnp.asarray(sum(component * component for component in residual))
        limits = jnp.finfo(jnp.result_type(s))
        small, large = s < float(limits.eps) ** 0.5, s > float(limits.max) ** 0.3125
        safe = jnp.where(small | large, 1.0, s)
        far = jax.lax.stop_gradient(s)
        # Derivatives of ρ(s)/s divide by s³. To second order it is ρ′(s/2).
        near = loss.weight(0.5 * jnp.where(small, s, 0.0))
        ratio = jnp.where(large, loss.rho(far) / far, jnp.where(small, near, loss.rho(safe) / safe))
        scaled = safe_sqrt(ratio if weight is None else weight * ratio)
    return residual if scaled is None else tuple(component * scaled for component in residual)


def mad_scale(residuals: Float[ArrayLike, " n"], mask: Bool[ArrayLike, " n"] | None = None) -> Float[Array, ""]:
    """Estimate a standard deviation from scalar residuals by their median absolute deviation, times 1.4826.

    Args:
        residuals: Signed residuals, any unit.
        mask: True for the residuals that count. None counts all.

    Returns:
        The scale, in the unit of the residuals. 0 if no residual counts.

    Degenerate input: more than half equal residuals give 0.
    Differentiability: almost everywhere, through the middle residuals.
    References: Rousseeuw & Croux, "Alternatives to the median absolute deviation", 1993.
    """
    residuals = jnp.asarray(residuals)
    mask = jnp.ones(residuals.shape, bool) if mask is None else jnp.asarray(mask)
    center = _masked_median(residuals, mask)
    return 1.4826 * _masked_median(jnp.abs(residuals - center), mask)


def _masked_median(values: Float[Array, " n"], mask: Array) -> Float[Array, ""]:
    count = jnp.sum(mask)
    ordered = jnp.sort(jnp.where(mask, values, jnp.inf))
    last = values.shape[0] - 1
    lower = ordered[jnp.clip((count - 1) // 2, 0, last)]
    upper = ordered[jnp.clip(count // 2, 0, last)]
    return jnp.where(count > 0, 0.5 * (lower + upper), 0.0)
