"""Models that are 3×3 matrices up to scale: their representative, and charts of the manifolds they live on.

E, F and H come with Frobenius norm 1 and their largest entry positive. Charts are correct to first order, which is
what `implicit` needs.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import lane_sum
from vojax._types import Array, Bool, Float

from ._components import complement, floor


def unit_matrix(matrix: Float[Array, "3 3 *lanes"]) -> tuple[Float[Array, "3 3 *lanes"], Bool[Array, "*lanes"]]:
    """Scale to Frobenius norm 1 with the entry of largest magnitude positive; False where that is impossible.

    The zero matrix and matrices that are not finite come back as zeros.
    """
    entries = [matrix[i, j] for i in range(3) for j in range(3)]
    size = sum(jnp.abs(entry) for entry in entries)
    valid = jnp.isfinite(size) & (size > floor(size))  # type: ignore[arg-type]
    entries = [jnp.where(valid, entry / jnp.where(valid, size, 1.0), 0.0) for entry in entries]
    norm2 = sum(entry * entry for entry in entries)
    largest = entries[0]
    for entry in entries[1:]:
        largest = jnp.where(jnp.abs(entry) > jnp.abs(largest), entry, largest)
    scale = jnp.where(largest < 0, -1.0, 1.0) / jnp.sqrt(jnp.where(valid, norm2, 1.0))
    return jnp.stack([jnp.stack([entries[3 * i + j] * scale for j in range(3)]) for i in range(3)]), valid


def perturb_unit_matrix(matrix: Float[Array, "3 3"], tangent: Float[Array, "8"]) -> Float[Array, "3 3"]:
    """Move a matrix of norm 1 within the sphere of such matrices: eight degrees of freedom, as a homography has.

    The basis is the Householder reflection that takes the matrix to a unit vector, without its first column.
    """
    m = jax.lax.stop_gradient(matrix).reshape(9)
    v = m.at[0].add(jnp.where(m[0] < 0, -1.0, 1.0))
    step = jnp.concatenate([jnp.zeros_like(tangent[:1]), tangent])
    step = step - v * (2.0 * jnp.sum(v * step) / jnp.maximum(jnp.sum(v * v), 1e-6))
    return matrix + step.reshape(3, 3)


def perturb_essential(essential: Float[Array, "3 3"], tangent: Float[Array, "5"]) -> Float[Array, "3 3"]:
    """Move an essential matrix within its manifold: E ↦ (I + [α]×) E (I + [β]×), five degrees of freedom.

    α (first two coordinates) is perpendicular to the translation, whose direction it turns; β turns the rotation. With
    E = [t]× R this is SO3 × S² at norm |E|.
    """
    held = jax.lax.stop_gradient(essential)
    # tᵀE = 0: the longest of the cross products of columns is along t.
    crosses = jnp.stack([jnp.cross(held[:, i], held[:, (i + 1) % 3]) for i in range(3)])
    squares = lane_sum(crosses * crosses, axis=1)
    t = crosses[jnp.argmax(squares)]
    length = jnp.sqrt(jnp.max(squares))
    usable = length > 0
    t = jnp.where(usable, t / jnp.where(usable, length, 1.0), jnp.eye(3, dtype=t.dtype)[2])
    first, second = (jnp.stack(direction) for direction in complement((t[0], t[1], t[2])))
    alpha = tangent[0] * first + tangent[1] * second
    turned = jnp.cross(alpha[:, None], essential, axis=0)  # [α]× E
    # E [β]×: row i is eᵢ × β.
    return essential + turned + jnp.cross(essential, tangent[2:][None, :], axis=1)
