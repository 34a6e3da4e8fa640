import jax
import jax.numpy as jnp
import numpy as np

from vojax.solvers._symmetric import least_eigenvectors, swept_inverse


def spectra(values, count=200, seed=0):
    """Symmetric matrices [d, d, count] with given eigenvalues, and their eigenvectors [count, d, d] in columns."""
    d = len(values)
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, d, d)))[0]
    return np.moveaxis((q * np.asarray(values)) @ np.swapaxes(q, 1, 2), 0, -1), q


def test_inverse(dtype):
    matrices, _ = spectra(np.geomspace(1e-2, 1.0, 12))
    inverse, regular = jax.jit(swept_inverse)(jnp.asarray(matrices, dtype))
    assert regular.all()
    expected = np.moveaxis(np.linalg.inv(np.moveaxis(matrices, -1, 0)), 0, -1)
    np.testing.assert_allclose(inverse, expected, atol=2e-3 if dtype == jnp.float32 else 1e-11)


def test_singular_matrices_are_told(dtype):
    for values in ([0.0, 0.1, 0.5, 1.0, 2.0], [0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0, np.nan], [-1.0] * 5):
        inverse, regular = jax.jit(swept_inverse)(jnp.asarray(spectra(values)[0], dtype))
        assert not regular.any()
        assert np.isfinite(inverse).all()


def test_least_eigenvectors(dtype):
    values = np.array([0.0, 1e-3, 0.02, 0.3, 0.5, 0.7, 1.0, 1.0])
    matrices, q = spectra(values)
    vectors = np.moveaxis(np.asarray(least_eigenvectors(jnp.asarray(matrices, dtype), 3)), -1, 0)  # [count, 3, d]
    # Neighbouring eigenvalues part by their ratio in each of eight steps.
    aligned = np.abs(np.einsum("bkd,bdk->bk", vectors, q[:, :, :3]))
    assert aligned.min() > 1.0 - (1e-5 if dtype == jnp.float32 else 1e-7)
    products = np.einsum("bkd,bld->bkl", vectors, vectors)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-5)


def test_a_null_space_gets_a_basis(dtype):
    matrices, q = spectra([0.0, 0.0, 0.0, 0.0, 0.3, 0.5, 0.7, 1.0], seed=1)
    vectors = np.moveaxis(np.asarray(least_eigenvectors(jnp.asarray(matrices, dtype), 4)), -1, 0)
    assert np.abs(np.einsum("bkd,bdj->bkj", vectors, q[:, :, 4:])).max() < (1e-4 if dtype == jnp.float32 else 1e-12)
    products = np.einsum("bkd,bld->bkl", vectors, vectors)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(4), products.shape), atol=1e-5)


def test_the_zero_matrix(dtype):
    vectors = least_eigenvectors(jnp.zeros((6, 6, 3), dtype), 2)
    assert np.isfinite(vectors).all()
