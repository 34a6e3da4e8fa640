"""Landmark elimination against the dense normal equations in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.ba import _schur

C, P, D = 4, 9, 3  # cameras, landmarks, residual components


def random_problem(seed, seen=None, d=D):
    """Dense J `[d·c·p, 6c + 3p]` and r, and the same as blocks of an arrow."""
    rng = np.random.default_rng(seed)
    seen = np.ones((C, P)) if seen is None else seen
    by_camera = rng.normal(size=(6, d, C, P)) * np.array([1, 1, 1, 30, 30, 30])[:, None, None, None] * seen
    by_landmark = rng.normal(size=(3, d, C, P)) * seen
    r = rng.normal(size=(d, C, P)) * seen
    dense = np.zeros((d, C, P, 6 * C + 3 * P))
    for c in range(C):
        dense[:, c, :, 6 * c : 6 * c + 6] = np.moveaxis(by_camera[:, :, c], 0, -1)
    for p in range(P):
        dense[:, :, p, 6 * C + 3 * p : 6 * C + 3 * p + 3] = np.moveaxis(by_landmark[:, :, :, p], 0, -1)
    dense, residual = dense.reshape(-1, 6 * C + 3 * P), r.ravel()
    return dense, residual, by_camera, by_landmark, r


def arrow(dense, residual, dtype=np.float64, prior=0.0):
    hessian = dense.T @ dense + prior * np.eye(dense.shape[1])
    gradient = dense.T @ residual
    cameras, landmarks = np.arange(6 * C).reshape(C, 6), 6 * C + np.arange(3 * P).reshape(P, 3)
    blocks = (
        np.stack([hessian[np.ix_(i, i)] for i in cameras], -1),
        np.stack([hessian[np.ix_(i, i)] for i in landmarks], -1),
        np.stack([np.stack([hessian[np.ix_(i, j)] for j in landmarks], -1) for i in cameras], -2),
        np.stack([gradient[i] for i in cameras], -1),
        np.stack([gradient[j] for j in landmarks], -1),
    )
    return _schur.ArrowSystem(*(jnp.asarray(block.astype(dtype)) for block in blocks)), hessian, gradient


solve = jax.jit(_schur.solve)
covariances = jax.jit(_schur.camera_covariances)


def flat(step):
    return np.concatenate([np.asarray(part, np.float64).ravel() for part in step])


@pytest.mark.parametrize("seed", range(3))
def test_the_step_is_the_dense_one(seed, x64):
    dense, residual, *_ = random_problem(seed)
    system, hessian, gradient = arrow(dense, residual)
    expected = np.linalg.solve(hessian, -gradient)
    assert np.abs(flat(solve(system)) - expected).max() <= 1e-10 * np.abs(expected).max()


def test_sparse_visibility_is_exact_too(x64):
    rng = np.random.default_rng(4)
    seen = (rng.uniform(size=(C, P)) < 0.8).astype(float)
    dense, residual, *_ = random_problem(4, seen, d=6)
    system, hessian, gradient = arrow(dense, residual, prior=1e-3)
    expected = np.linalg.solve(hessian, -gradient)
    assert np.abs(flat(solve(system)) - expected).max() <= 1e-10 * np.abs(expected).max()


def test_damping_scales_the_whole_diagonal(x64):
    dense, residual, *_ = random_problem(1)
    system, hessian, gradient = arrow(dense, residual)
    damped = hessian + 0.3 * np.diag(np.diag(hessian))
    expected = np.linalg.solve(damped, -gradient)
    found = flat(solve(system.damped(jnp.asarray(0.3))))
    assert np.abs(found - expected).max() <= 1e-10 * np.abs(expected).max()


def test_covariances_are_blocks_of_the_dense_inverse(x64):
    dense, residual, *_ = random_problem(2)
    system, hessian, _ = arrow(dense, residual)
    inverse = np.linalg.inv(hessian)
    found, regular = covariances(system)
    assert regular
    for c in range(C):
        block = inverse[6 * c : 6 * c + 6, 6 * c : 6 * c + 6]
        np.testing.assert_allclose(found[c], block, rtol=1e-8, atol=1e-12 * np.abs(block).max())


def test_float32_follows():
    # The residual J d + r of the step is what counts: within 1e-3 of the least squares minimum.
    for seed in range(3):
        dense, residual, *_ = random_problem(seed)
        system, hessian, gradient = arrow(dense, residual, np.float32)
        expected = np.linalg.solve(hessian, -gradient)
        found = flat(solve(system))
        best, ours = (np.sum((dense @ step + residual) ** 2) for step in (expected, found))
        assert ours <= best * (1 + 1e-4)


def test_what_has_no_information_does_not_move(x64):
    # Camera 1 is fixed, landmark 3 is never seen: zero blocks, zero steps, the rest as if they were not there.
    seen = np.ones((C, P))
    seen[1], seen[:, 3] = 0, 0
    dense, residual, *_ = random_problem(5, seen)
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
    dense, residual, *_ = random_problem(6, d=1)
    indefinite = arrow(dense, residual, dtype)[0]
    zero = jax.tree.map(jnp.zeros_like, indefinite)
    broken = _schur.ArrowSystem(
        -indefinite.camera,
        indefinite.landmark,
        indefinite.cross,
        indefinite.camera_gradient,
        indefinite.landmark_gradient,
    )
    for system in (indefinite, zero, broken):
        assert np.isfinite(flat(solve(system))).all()
        found, _ = covariances(system)
        assert np.isfinite(found).all()
    assert np.all(flat(solve(zero)) == 0)


def test_blocks_come_from_jacobian_products(x64):
    dense, residual, by_camera, by_landmark, r = random_problem(7)

    def jvp(tangent):
        cameras, landmarks = tangent
        change = np.einsum("idcp,ci->dcp", by_camera, cameras) + np.einsum("idcp,pi->dcp", by_landmark, landmarks)
        return tuple(jnp.asarray(component) for component in change)

    y = (jnp.zeros((C, 6)), jnp.zeros((P, 3)))
    found = _schur.arrow_system(y, tuple(jnp.asarray(component) for component in r), jvp)
    expected, *_ = arrow(dense, residual)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-10)
