import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.solvers._null_space import eliminate, null_space, null_space_and_rank

EPS = {jnp.float32: 1.2e-7, jnp.float64: 2.3e-16}

basis_of = jax.jit(null_space)


def solve(rows, dtype):
    """Bases [count, q, n] of matrices [count, m, n], batch in the lanes."""
    return np.moveaxis(np.asarray(basis_of(np.moveaxis(rows, 0, -1).astype(dtype)), np.float64), -1, 0)


@pytest.mark.parametrize(("m", "n"), [(1, 3), (5, 9), (6, 9), (7, 9), (8, 9), (6, 10), (1, 2)])
def test_basis_is_orthonormal_and_annihilated(dtype, m, n):
    rows = np.random.default_rng(m * n).normal(size=(500, m, n)).astype(dtype)
    basis = solve(rows, dtype)
    assert basis.shape == (500, n - m, n)
    gram = np.einsum("bij,bkj->bik", basis, basis)
    assert np.abs(gram - np.eye(n - m)).max() < 40 * EPS[dtype]
    lengths = np.linalg.norm(rows, axis=-1)
    residual = np.einsum("bij,bkj->bik", rows.astype(np.float64), basis) / lengths[..., None]
    assert np.abs(residual).max() < 60 * EPS[dtype]


def test_spans_what_the_svd_spans(dtype):
    rows = np.random.default_rng(1).normal(size=(300, 5, 9)).astype(dtype)
    basis = solve(rows, dtype)
    expected = np.linalg.svd(rows.astype(np.float64))[2][:, 5:]
    projector = np.einsum("bij,bik->bjk", basis, basis) - np.einsum("bij,bik->bjk", expected, expected)
    # The space is as uncertain as the rows are dependent.
    condition = np.linalg.cond(rows.astype(np.float64))
    assert (np.abs(projector).max(axis=(-1, -2)) / condition).max() < 20 * EPS[dtype]


def test_badly_conditioned_rows_keep_small_residuals(x64):
    # Rows that agree to 1e-10: residuals relative to the rows stay at rounding.
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(300, 5, 9))
    rows[:, 1] = rows[:, 0] + 1e-10 * rng.normal(size=(300, 9))
    basis = solve(rows, np.float64)
    assert np.abs(np.einsum("bij,bkj->bik", rows, basis)).max() < 1e-14
    assert np.abs(np.einsum("bij,bkj->bik", basis, basis) - np.eye(4)).max() < 1e-14


def test_rows_of_very_different_size(dtype):
    rng = np.random.default_rng(3)
    rows = (rng.normal(size=(300, 4, 6)) * 10.0 ** rng.uniform(-6, 6, (300, 4, 1))).astype(dtype)
    basis = solve(rows, dtype)
    residual = np.einsum("bij,bkj->bik", rows.astype(np.float64), basis)
    assert (np.abs(residual) / np.linalg.norm(rows, axis=-1)[..., None]).max() < 100 * EPS[dtype]


@pytest.mark.parametrize("spoil", ["zero row", "equal rows", "combination", "all zero"])
def test_dependent_rows_give_vectors_of_the_larger_space(dtype, spoil):
    rows = np.random.default_rng(4).integers(-4, 5, (300, 5, 9)).astype(float)
    if spoil == "zero row":
        rows[:, 2] = 0.0
    elif spoil == "equal rows":
        rows[:, 3] = rows[:, 1]
    elif spoil == "combination":
        rows[:, 4] = rows[:, 0] - 2.0 * rows[:, 1]
    else:
        rows[:] = 0.0
    basis = solve(rows, dtype)
    assert np.abs(np.einsum("bij,bkj->bik", basis, basis) - np.eye(4)).max() < 100 * EPS[dtype]
    residual = np.abs(np.einsum("bij,bkj->bik", rows, basis))
    assert residual.max() < 1000 * EPS[dtype]


def test_basis_of_rows_along_an_axis(dtype):
    # x0 at its largest: the reflection must not cancel.
    for row in np.concatenate([np.eye(4), -np.eye(4)]):
        basis = solve(row[None, None], dtype)[0]
        assert np.abs(basis @ row).max() == 0.0
        np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=4 * EPS[dtype])


@pytest.mark.slow
def test_one_problem_equals_many(x64):
    rows = np.random.default_rng(5).normal(size=(20, 5, 9))
    many = solve(rows, np.float64)
    for i in range(20):
        np.testing.assert_allclose(null_space(jnp.asarray(rows[i])), many[i], atol=1e-13)


def test_gradient_of_the_projector(x64):
    # A basis is not unique, the projector on its space is: compare its derivative with differences.
    rows = np.random.default_rng(10).normal(size=(5, 9))
    weights = np.random.default_rng(11).normal(size=(9, 9))

    def function(rows):
        basis = null_space(rows)
        return jnp.sum(jnp.sum(basis[:, :, None] * basis[:, None, :], axis=0) * weights)

    reverse = jax.jit(jax.grad(function))(jnp.asarray(rows))
    value = jax.jit(function)
    for index in ((0, 0), (2, 5), (4, 8)):
        step = np.zeros_like(rows)
        step[index] = 1e-6
        numeric = (value(rows + step) - value(rows - step)) / 2e-6
        np.testing.assert_allclose(reverse[index], numeric, rtol=1e-6, atol=1e-8)
    zero = jax.jit(jax.grad(function))(jnp.zeros((5, 9)))
    assert np.isfinite(zero).all()


def test_rank_is_told(dtype):
    rows = np.random.default_rng(12).normal(size=(600, 5, 9))
    rows[:100, 2] = rows[:100, 0]
    rows[100:200, 4] = rows[100:200, 0] - 2.0 * rows[100:200, 3]
    rows[200:250, 1] = 0.0
    rows[250:300] = 0.0
    rows[300, 0, 0], rows[301, 4, 8] = np.nan, np.inf
    independent = np.asarray(jax.jit(null_space_and_rank)(np.moveaxis(rows, 0, -1).astype(dtype))[1])
    assert not independent[:302].any()
    assert independent[302:].all()


def test_elimination_equals_numpy(dtype):
    rows = np.random.default_rng(13).normal(size=(300, 6, 9))
    rows[:, 0, 0] = 0.0  # must pivot
    found = np.moveaxis(np.asarray(jax.jit(eliminate)(np.moveaxis(rows, 0, -1).astype(dtype)), np.float64), -1, 0)
    expected = np.linalg.solve(rows[..., :6], rows[..., 6:])
    condition = np.linalg.cond(rows[..., :6]) * np.abs(expected).max(axis=(-1, -2))
    assert (np.abs(found - expected).max(axis=(-1, -2)) / condition).max() < 20 * EPS[dtype]
