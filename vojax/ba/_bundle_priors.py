"""Residuals of the priors on landmarks and intrinsics; those on poses are pose factors."""

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, Float

from ._bundle_layout import BundleLayout
from ._bundle_state import BundleData, BundlePriors, BundleState, intrinsics_values


class PriorBlocks(eqx.Module):
    """Residuals of the priors; empty arrays where there is none."""

    landmarks: Float[Array, "3 l1"]
    intrinsics: Float[Array, "g1 m1"]

    @property
    def residuals(self) -> tuple[Array, ...]:
        """Both kinds, as they stand in the residual of the problem."""
        return self.landmarks, self.intrinsics


def prior_blocks(state: BundleState, data: BundleData, layout: BundleLayout) -> PriorBlocks:
    """Residuals of the priors."""
    priors, dtype = data.priors, state.landmarks.dtype
    landmarks, intrinsics = jnp.zeros((3, 0), dtype), jnp.zeros((0, 0), dtype)
    if priors.landmarks is not None and priors.landmark_root is not None:
        landmarks = landmark_deviation(state.landmarks, priors, layout)
    if priors.intrinsics is not None and priors.intrinsics_root is not None:
        intrinsics = intrinsics_deviation(state.intrinsics, data)
    return PriorBlocks(landmarks, intrinsics)


def landmark_deviation(
    landmarks: Float[Array, "3 l"], priors: BundlePriors, layout: BundleLayout
) -> Float[Array, "3 l"]:
    """Whitened deviation of the landmarks, in the order of the slots; zero for those that are fixed."""
    assert priors.landmarks is not None
    delta = landmarks - priors.landmarks[layout.landmark_order].T
    return jnp.sum(landmark_root(priors, layout) * delta[None], axis=1)


def landmark_root(priors: BundlePriors, layout: BundleLayout) -> Float[Array, "3 3 l"]:
    """Square roots of the landmarks' information, in the order of the slots."""
    assert priors.landmark_root is not None
    return jnp.moveaxis(priors.landmark_root[layout.landmark_order], 0, -1) * layout.landmark_free[None, None]


def intrinsics_deviation(increments: Float[Array, "g m"], data: BundleData) -> Float[Array, "g m"]:
    """Whitened deviation of the free intrinsics."""
    assert data.priors.intrinsics is not None
    assert data.priors.intrinsics_root is not None
    return data.priors.intrinsics_root * (intrinsics_values(increments, data) - data.priors.intrinsics)
