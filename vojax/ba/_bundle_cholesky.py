"""Cholesky factorisation of a few hundred to a few thousand unknowns, by panels.

Nothing here calls LAPACK. Where it brings threads of its own, as OpenBLAS does, these wait for a processor in every
call once another program is busy: on two loaded cores a matrix of 441 unknowns took 1.2 or 500 ms there.
"""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp

from vojax._types import Array, Bool, Float

# Panels: of at least this width, and no more than this many, so that the program stays small.
_WIDTH = 48
_MOST_PANELS = 12


class CholeskyFactor(eqx.Module):
    """L of M = L Lᵀ in panels.

    Attributes:
        inverses: Inverses of the diagonal blocks of L.
        below: What is below each of them.
        regular: False if M is not positive definite in working precision; the factor is then the identity's.
    """

    inverses: tuple[Float[Array, "_ _"], ...]
    below: tuple[Float[Array, "_ _"], ...]
    regular: Bool[Array, ""]

    def half_solve(self, rhs: Float[Array, "u r"]) -> Float[Array, "u r"]:
        """L⁻¹ rhs."""
        solved, rest = [], rhs
        for inverse, below in zip(self.inverses, self.below, strict=True):
            width = inverse.shape[0]
            part = _multiply(inverse, rest[:width])
            rest = rest[width:] - _multiply(below, part)
            solved.append(part)
        return jnp.concatenate(solved) if solved else rhs

    def solve(self, rhs: Float[Array, "u r"]) -> Float[Array, "u r"]:
        """M⁻¹ rhs."""
        return self.half_solve_transposed(self.half_solve(rhs))

    def half_solve_transposed(self, rhs: Float[Array, "u r"]) -> Float[Array, "u r"]:
        """L⁻ᵀ rhs."""
        solved = rhs[:0]
        end = rhs.shape[0]
        for inverse, below in zip(self.inverses[::-1], self.below[::-1], strict=True):
            start = end - inverse.shape[0]
            part = _multiply(inverse.T, rhs[start:end] - _multiply(below.T, solved))
            solved = jnp.concatenate([part, solved])
            end = start
        return solved


def cholesky(matrix: Float[Array, "u u"]) -> CholeskyFactor:
    """Factor a symmetric matrix."""
    inverses, below = [], []
    rest, regular = matrix, jnp.array(True)
    for width in _widths(matrix.shape[0]):
        inverse, fine = _inverse_factor(rest[:width, :width])
        panel = _multiply(rest[width:, :width], inverse.T)
        rest = rest[width:, width:] - _multiply(panel, panel.T)
        regular = regular & fine
        inverses.append(inverse)
        below.append(panel)
    inverses = [jnp.where(regular, inverse, jnp.eye(len(inverse), dtype=matrix.dtype)) for inverse in inverses]
    below = [jnp.where(regular, panel, 0.0) for panel in below]
    return CholeskyFactor(tuple(inverses), tuple(below), regular)


def _inverse_factor(block: Float[Array, "b b"]) -> tuple[Float[Array, "b b"], Bool[Array, ""]]:
    """L⁻¹ of one diagonal block, a column and a row a turn; the identity where a pivot is not positive."""
    size = block.shape[0]
    index = jnp.arange(size)

    def turn(k: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        rest, inverse, fine = carry
        pivot = rest[k, k]
        positive = pivot > 0  # false for NaN too
        root = jax.lax.rsqrt(jnp.where(positive, pivot, 1.0))
        column = jnp.where(index > k, rest[:, k] * root, 0.0)
        # Rows below k of L⁻¹ still lack their products with the rows above, among them this one.
        row = inverse[k] * root
        inverse = inverse.at[k].set(row) - column[:, None] * row[None]
        return rest - column[:, None] * column[None], inverse, fine & positive

    start = (block, jnp.eye(size, dtype=block.dtype), jnp.array(True))
    _, inverse, fine = jax.lax.fori_loop(0, size, turn, start)
    return jnp.where(fine, inverse, jnp.eye(size, dtype=block.dtype)), fine


def _widths(size: int) -> Iterator[int]:
    width = max(_WIDTH, -(-size // _MOST_PANELS))
    for start in range(0, size, width):
        yield min(width, size - start)


def _multiply(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")
