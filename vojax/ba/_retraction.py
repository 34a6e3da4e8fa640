"""Steps of optimisers on rotations, rigid motions and similarities.

An optimiser and the covariance at its end need steps that agree with exp(−ξ) @ model to first order, no more. These do,
for a fraction of the code of an exponential that is exact for steps of any size, which was nearly a third of the
operations of a local optimisation. A step of the size φ turns by 2 atan(|φ|/2): a wild one by less than half a turn.
"""

import jax.numpy as jnp

from vojax._numerics import cross3
from vojax._types import Array, Float
from vojax.lie import SE3, SO3, Sim3


def step_rotation(rotation: SO3, phi: Float[Array, "3"]) -> SO3:
    """exp(−φ) @ rotation, to second order in φ."""
    small = SO3(jnp.concatenate([jnp.ones_like(phi[:1]), -0.5 * phi]))
    return (small @ rotation).normalize()


def step_pose(pose: SE3, xi: Float[Array, "6"]) -> SE3:
    """exp(−ξ) @ pose to first order, ξ = (ρ, φ): the translation turns with φ and moves by −ρ."""
    rotation = step_rotation(pose.rotation(), xi[3:])
    return SE3.from_rotation_and_translation(rotation, _turned(pose.translation(), xi[3:]) - xi[:3])


def step_similarity(similarity: Sim3, xi: Float[Array, "7"]) -> Sim3:
    """exp(−ξ) @ similarity to first order, ξ = (ρ, φ, log s)."""
    rotation, shrunk = step_rotation(similarity.rotation(), xi[3:6]), jnp.exp(-xi[6])
    translation = shrunk * _turned(similarity.translation(), xi[3:6]) - xi[:3]
    return Sim3.from_rotation_translation_scale(rotation, translation, shrunk * similarity.scale())


def _turned(t: Float[Array, "3"], phi: Float[Array, "3"]) -> Float[Array, "3"]:
    """A vector turned by the rotation of the quaternion (1, −½φ)."""
    v, x = (-0.5 * phi[0], -0.5 * phi[1], -0.5 * phi[2]), (t[0], t[1], t[2])
    first = cross3(v, x)
    second = cross3(v, first)
    factor = 2.0 / (1.0 + v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return jnp.stack([x[i] + factor * (first[i] + second[i]) for i in range(3)])
