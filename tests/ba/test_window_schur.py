"""Landmark elimination of windows against the dense normal equations in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.ba import _window_schur as schur

C, P, D = 4, 9, 3  # cameras, landmarks, residual components


def random_problem(seed, seen=None, d=D):
    """Dense J `[d·c·p, 6c + 3p]`, unknowns of the cameras ordered [6, c], of the landmarks [3, p], and r."""
    rng = np.random.default_rng(seed)
    seen = np.ones((C, P)) if seen is None else seen
    by_camera = rng.normal(size=(6, d, C, P)) * np.array([1, 1, 1, 30, 30, 30])[:, None, None, None] * seen
    by_landmark = rng.normal(size=(3, d, C, P)) * seen
    dense = np.zeros((d, C, P, 6 * C + 3 * P))
    for c in range(C):
        dense[:, c, :, c : 6 * C : C] = np.moveaxis(by_camera[:, :, c], 0, -1)
    for p in range(P):
        dense[:, :, p, 6 * C + p :: P] = np.moveaxis(by_landmark[:, :, :, p], 0, -1)
    return dense.reshape(-1, 6 * C + 3 * P), (rng.normal(size=(d, C, P)) * seen).ravel()


def arrow(dense, residual, dtype=np.float64, prior_rows=None):
    """The same as blocks; rows of a prior on the cameras make a coupling of its own."""
    hessian, gradient, coupling = dense.T @ dense, dense.T @ residual, None
    u = 6 * C
    blocks = hessian[:u, :u].reshape(6, C, 6, C)
    camera = np.stack([blocks[:, c, :, c] for c in range(C)], axis=-1)
    landmark = np.stack([hessian[u + p :: P, u + p :: P] for p in range(P)], axis=-1)
    cross = hessian[:u, u:].reshape(6, C, 3, P)
    if prior_rows is not None:
        added = prior_rows.T @ prior_rows
        hessian = hessian.copy()
        hessian[:u, :u] += added
        coupling = jnp.asarray(added.reshape(6, C, 6, C).astype(dtype))
    parts = (camera, landmark, cross, gradient[:u].reshape(6, C), gradient[u:].reshape(3, P))
    return schur.ArrowSystem(*(jnp.asarray(part.astype(dtype)) for part in parts), coupling), hessian, gradient


solve = jax.jit(schur.solve)
covariances = jax.jit(schur.camera_covariances)


def flat(step):
    return np.concatenate([np.asarray(part, np.float64).ravel() for part in step])


@pytest.mark.parametrize("with_prior", [False, True])
def test_the_step_is_the_dense_one(with_prior, x64):
    for seed in range(3):
        dense, residual = random_problem(seed)
        rows = np.random.default_rng(seed).normal(size=(10, 6 * C)) * 20 if with_prior else None
        system, hessian, gradient = arrow(dense, residual, prior_rows=rows)
        expected = np.linalg.solve(hessian, -gradient)
        assert np.abs(flat(solve(system)) - expected).max() <= 1e-10 * np.abs(expected).max()


def test_sparse_visibility_is_exact_too(x64):
    seen = np.random.default_rng(4).uniform(size=(C, P)) < 0.6
    seen[:, seen.sum(axis=0) < 2] = True
    dense, residual = random_problem(5, seen)
    system, hessian, gradient = arrow(dense, residual)
    expected = np.linalg.solve(hessian, -gradient)
    assert np.abs(flat(solve(system)) - expected).max() <= 1e-10 * np.abs(expected).max()


@pytest.mark.parametrize("with_prior", [False, True])
def test_damping_scales_the_whole_diagonal(with_prior, x64):
    dense, residual = random_problem(1)
    rows = np.random.default_rng(1).normal(size=(10, 6 * C)) * 20 if with_prior else None
    system, hessian, gradient = arrow(dense, residual, prior_rows=rows)
    expected = np.linalg.solve(hessian + 0.3 * np.diag(np.diag(hessian)), -gradient)
    found = flat(solve(system.damped(jnp.asarray(0.3))))
    assert np.abs(found - expected).max() <= 1e-10 * np.abs(expected).max()


def test_covariances_are_blocks_of_the_dense_inverse(x64):
    dense, residual = random_problem(2)
    rows = np.random.default_rng(2).normal(size=(10, 6 * C)) * 20
    system, hessian, _ = arrow(dense, residual, prior_rows=rows)
    inverse = np.linalg.inv(hessian)
    found, regular = covariances(system)
    assert regular
    for c in range(C):
        block = inverse[c : 6 * C : C, c : 6 * C : C]
        np.testing.assert_allclose(found[c], block, rtol=1e-8, atol=1e-12 * np.abs(block).max())


def test_float32_follows():
    # The residual J d + r of the step is what counts: close to the least squares minimum.
    for seed in range(3):
        dense, residual = random_problem(seed)
        system, hessian, gradient = arrow(dense, residual, np.float32)
        expected = np.linalg.solve(hessian, -gradient)
        found = flat(solve(system))
        best, ours = (np.sum((dense @ step + residual) ** 2) for step in (expected, found))
        assert ours <= best * (1 + 1e-4)


def test_what_has_no_information_does_not_move(x64):
    # Camera 1 is fixed, landmark 3 is never seen: zero blocks, zero steps, the rest as if they were not there.
    seen = np.ones((C, P))
    seen[1], seen[:, 3] = 0, 0
    dense, residual = random_problem(5, seen)
    system, hessian, gradient = arrow(dense, residual)
    kept = np.diag(hessian) > 0
    expected = np.zeros(len(gradient))
    expected[kept] = np.linalg.solve(hessian[np.ix_(kept, kept)], -gradient[kept])
    found = flat(solve(system))
    assert np.all(found[~kept] == 0)
    assert np.abs(found - expected).max() <= 1e-10 * np.abs(expected).max()
    found, regular = covariances(system)
    assert regular
    assert np.all(np.asarray(found[1]) == 0)


def test_singular_systems_give_finite_steps(dtype):
    # One component a residual: 36 equations for 51 unknowns.
    dense, residual = random_problem(6, d=1)
    indefinite = arrow(dense, residual, dtype)[0]
    zero = jax.tree.map(jnp.zeros_like, indefinite)
    broken = schur.ArrowSystem(
        -indefinite.camera,
        indefinite.landmark,
        indefinite.cross,
        indefinite.camera_gradient,
        indefinite.landmark_gradient,
        None,
    )
    for system in (indefinite, zero, broken):
        assert np.isfinite(flat(solve(system))).all()
        found, _ = covariances(system)
        assert np.isfinite(found).all()
    assert np.all(flat(solve(zero)) == 0)
