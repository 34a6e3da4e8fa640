"""The reduced system of many cameras by preconditioned conjugate gradients, without forming it.

A product with S = U − E Eᵀ goes from cameras to landmarks and back over the observations: its time and memory are
linear in them, whatever the number of cameras. The preconditioner is the inverse of the cameras' blocks of S.

References: Agarwal, Snavely, Seitz & Szeliski, "Bundle adjustment in the large", ECCV 2010, sections 3 and 4.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from vojax._numerics import symmetric_inverse
from vojax._types import Array, Float

from ._bundle_layout import BundleLayout
from ._bundle_schur import BundleSystem, Eliminated, eliminate, factor_blocks, substitute

Product = Callable[[Array], Array]


def solve_iteratively(
    system: BundleSystem, layout: BundleLayout, tolerance: float, max_iterations: int
) -> tuple[Float[Array, " u"], Float[Array, "3 l"]]:
    """Solve the normal equations for −(camera, landmark) gradient.

    Args:
        system: Positive definite, damped or not.
        layout: Of the problem.
        tolerance: Ends when the residual, in the norm of the preconditioner, has fallen to this share.
        max_iterations: Ends then at the latest.

    Differentiability: both modes in the right-hand side, by solving again.
    """
    eliminated = eliminate(system, layout)
    landmark = eliminated.forward(system.landmark_gradient)
    rhs = layout.collapse(eliminated.to_cameras(landmark, layout)) - system.gradient(layout)
    precondition = block_preconditioner(eliminated, layout)
    unknowns = jax.lax.custom_linear_solve(
        product(eliminated, layout),
        rhs,
        lambda multiply, rhs: _conjugate_gradients(multiply, rhs, precondition, tolerance, max_iterations),
        symmetric=True,
    )
    return unknowns, substitute(eliminated, landmark, unknowns, layout)


def product(eliminated: Eliminated, layout: BundleLayout) -> Product:
    """Multiplication by S."""

    def multiply(unknowns: Float[Array, " u"]) -> Float[Array, " u"]:
        cameras = layout.expand(unknowns)
        own = jnp.sum(eliminated.camera * cameras[:, None, :], axis=-1)
        factors = []
        for columns, block in zip(layout.factor_columns, eliminated.factors, strict=True):
            step = layout.take(unknowns, columns)
            factors.append(jnp.sum(block.hessian * step[:, None, :], axis=-1))
        return layout.collapse(own - eliminated.to_cameras(eliminated.to_landmarks(cameras, layout), layout), factors)

    return multiply


def block_preconditioner(eliminated: Eliminated, layout: BundleLayout) -> Product:
    """Multiplication by the inverses of the cameras' diagonal blocks of S."""
    _, k, s = eliminated.cross.shape
    squares = jnp.sum(eliminated.cross[:, :, None] * eliminated.cross[:, None], axis=0).reshape(k * k, s)
    blocks = eliminated.camera - layout.sum_cameras(squares.T).reshape(-1, k, k)
    if layout.mount is None:  # poses are in the order of the cameras
        blocks = blocks.at[:, :6, :6].add(factor_blocks(eliminated.factors, layout, blocks.dtype))
    # Fixed parameters are ones of the diagonal, and a shared one is spread over the cameras that share it.
    free = layout.columns < layout.unknowns
    blocks = jnp.where(free[:, :, None] & free[:, None, :], blocks, jnp.eye(k, dtype=blocks.dtype)[None])
    sharing = layout.expand(layout.collapse(free.astype(blocks.dtype)))
    share = jnp.where(free, 1.0 / jnp.maximum(sharing, 1.0), 0.0)
    inverses, _ = symmetric_inverse(jnp.moveaxis(blocks, 0, -1))

    def multiply(unknowns: Float[Array, " u"]) -> Float[Array, " u"]:
        spread = (layout.expand(unknowns) * share).T
        return layout.collapse(jnp.sum(inverses * spread[None], axis=1).T * share)

    return multiply


def _conjugate_gradients(
    multiply: Product, rhs: Array, precondition: Product, tolerance: float, max_iterations: int
) -> Float[Array, " u"]:
    """Textbook PCG; a direction without positive curvature ends it with what it has."""
    first = precondition(rhs)
    start = jnp.sum(rhs * first)

    def unfinished(carry: tuple[Array, ...]) -> Array:
        _, _, _, size, k, going = carry
        return going & (k < max_iterations) & (size > tolerance**2 * start)

    def turn(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        x, residual, direction, size, k, _ = carry
        image = multiply(direction)
        curvature = jnp.sum(direction * image)
        positive = (curvature > 0) & (size > 0)
        length = jnp.where(positive, size / jnp.where(positive, curvature, 1.0), 0.0)
        x, residual = x + length * direction, residual - length * image
        conditioned = precondition(residual)
        smaller = jnp.sum(residual * conditioned)
        direction = conditioned + smaller / jnp.where(positive, size, 1.0) * direction
        return x, residual, direction, smaller, k + 1, positive

    begin = (jnp.zeros_like(rhs), rhs, first, start, jnp.array(0), jnp.array(True))
    return jax.lax.while_loop(unfinished, turn, begin)[0]
