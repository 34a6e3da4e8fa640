"""Motions between two sets of points: the residuals R p0 + t − p1, with or without scale."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, Float
from vojax.lie import SE3, Sim3

from ._retraction import step_pose, step_similarity
from ._whitening import whiten


class _AlignmentProblem(eqx.Module):
    points0: Float[Array, "n 3"]
    points1: Float[Array, "n 3"]
    whitening: tuple[Array, ...]

    def residual(self, model: SE3 | Sim3) -> tuple[Array, ...]:
        """Whitened differences in frame 1."""
        difference = model.apply(self.points0) - self.points1
        return whiten(self.whitening, tuple(jnp.moveaxis(difference, -1, 0)))


class RigidProblem(_AlignmentProblem):
    """`frame1_from_frame0` in SE(3)."""

    tangent_dim: ClassVar[int] = 6

    @staticmethod
    def retract(model: SE3, tangent: Array) -> SE3:
        """exp(−ξ) @ frame1_from_frame0: ξ is in frame 1."""
        return step_pose(model, tangent)


class SimilarityProblem(_AlignmentProblem):
    """`frame1_from_frame0` in Sim(3)."""

    tangent_dim: ClassVar[int] = 7

    @staticmethod
    def retract(model: Sim3, tangent: Array) -> Sim3:
        """exp(−ξ) @ frame1_from_frame0: ξ is in frame 1."""
        return step_similarity(model, tangent)
