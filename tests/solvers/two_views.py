"""Problems and checks that the tests of the linear two-view solvers share."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.solvers.problems import (
    central_differences,
    essential_matrices,
    lanes,
    relative_pose_problems,
    unit_matrices,
)

CAMERA = np.array([[700.0, 0.0, 640.0], [0.0, 710.0, 360.0], [0.0, 0.0, 1.0]])


def bearing_problems(count, n, seed=0, planar=False):
    """Bearings of both views [count, n, 3] and the essential matrix."""
    rays0, rays1, rotation, translation = relative_pose_problems(count, n, seed, planar)
    return rays0, rays1, essential_matrices(rotation, translation)


def pixel_problems(count, n, seed=0, planar=False):
    """Pixels of both views [count, n, 2] in an image of 1280 × 720, and the fundamental matrix."""
    rays0, rays1, essential = bearing_problems(count, n, seed, planar)
    inverse = np.linalg.inv(CAMERA)
    fundamental = unit_matrices(np.einsum("ji,bjk,kl->bil", inverse, essential, inverse))
    pixels0, pixels1 = ((rays / rays[..., 2:] @ CAMERA.T)[..., :2] for rays in (rays0, rays1))
    return pixels0, pixels1, fundamental


def calibrated(fundamental):
    """Kᵀ F K at norm 1, in which errors mean the same for every entry; zero matrices stay zero."""
    matrices = np.einsum("ji,...jk,kl->...il", CAMERA, np.asarray(fundamental, np.float64), CAMERA)
    norm = np.linalg.norm(matrices, axis=(-1, -2), keepdims=True)
    return matrices / np.where(norm > 0, norm, 1.0)


def matrix_errors(models, valid, truth):
    """Distance [count] of the best valid slot from the truth, up to sign; inf where no slot is valid."""
    inner = np.sum(models * truth[:, None], axis=(-1, -2), keepdims=True)
    errors = np.linalg.norm(models - np.where(inner < 0, -1.0, 1.0) * truth[:, None], axis=(-1, -2))
    return np.where(valid, errors, np.inf).min(axis=-1)


def epipolar_errors(models, first, second):
    """second₁ᵀ M first₀ of unit vectors [count, slots, n], for matrices [count, slots, 3, 3]."""
    return np.einsum("bni,bsij,bnj->bsn", second, models, first)


def spoiled(first, second, seed):
    """A share of the problems degenerate in one of several ways, or absurd."""
    first, second = first.copy(), second.copy()
    count = len(first)
    rng = np.random.default_rng(seed)
    kinds = np.array_split(rng.permutation(count)[: count // 2], 12)
    first[kinds[0]] = 0.0
    first[kinds[1]], second[kinds[1]] = first[kinds[1], :1], second[kinds[1], :1]
    first[kinds[2], 1], second[kinds[2], 1] = first[kinds[2], 0], second[kinds[2], 0]
    second[kinds[3]] = first[kinds[3]]
    first[kinds[4], 0, 0] = np.nan
    second[kinds[5], 2, 1] = np.inf
    first[kinds[6]] *= 1e30
    second[kinds[7]] *= 1e-30
    first[kinds[8]], second[kinds[8]] = 0.0, 0.0
    second[kinds[9], 3] = 1e30
    first[kinds[10], :, 0] = 1.0
    second[kinds[11]] = rng.normal(size=second[kinds[11]].shape)
    return first, second


def assert_finite_with_zero_placeholders(candidates):
    models, valid = np.asarray(candidates.models), np.asarray(candidates.valid)
    assert np.isfinite(models).all()
    assert (models[~valid] == 0).all()
    np.testing.assert_allclose(np.linalg.norm(models[valid], axis=(-1, -2)), 1.0, atol=1e-5)


def assert_finite_gradients(solver, first, second, dtype):
    def function(a, b):
        return jnp.sum(solver(a, b).models * jnp.arange(1.0, 10.0, dtype=dtype).reshape(1, 3, 3))

    gradient = jax.jit(jax.vmap(jax.grad(function, (0, 1)), -1, -1))
    for part in gradient(*lanes(first, second, dtype=dtype)):
        assert np.isfinite(part).all()


def numeric_gradient(function, arguments, index, step):
    """Central differences of two steps, extrapolated: rounding and curvature leave eight digits or more."""
    coarse, fine = (central_differences(function, arguments, index, h) for h in (step, 0.5 * step))
    return (4.0 * fine - coarse) / 3.0
