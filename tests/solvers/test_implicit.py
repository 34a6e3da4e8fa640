import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.solvers import Candidates, implicit
from vojax.solvers._implicit import solve_square
from vojax.solvers._lanes import lanes_last


def square_roots(data):
    """x² = a by a loop nobody would differentiate; the second slot is the negative root."""
    a, _ = data
    root = jax.lax.fori_loop(0, 20, lambda _, x: 0.5 * (x + a / x), jnp.maximum(a, 1.0))
    root = jnp.where(a > 0, root, 0.0)
    valid = jnp.isfinite(a) & (a >= 0)
    roots = jnp.where(valid, root, 1.0)
    return Candidates(models=jnp.stack([roots, -roots])[:, None], valid=jnp.stack([valid, valid]))


def residual(model, data):
    a, exponent = data
    return model**exponent - a


solve = implicit(square_roots, residual, lambda model, tangent: model + tangent, 1)


def test_derivative_of_a_square_root(x64):
    exponent = jnp.asarray(2)
    value = lambda a: solve((a, exponent)).models[:, 0]  # noqa: E731
    expected = np.array([0.5, -0.5]) / np.sqrt(3.0)
    np.testing.assert_allclose(jax.jacfwd(value)(3.0), expected, rtol=1e-10)
    np.testing.assert_allclose(jax.jacrev(value)(3.0), expected, rtol=1e-10)
    np.testing.assert_allclose(jax.jacfwd(jax.jacrev(value))(3.0), -expected / 6.0, rtol=1e-10)
    np.testing.assert_allclose(jax.vmap(jax.jacrev(value))(jnp.array([3.0, 3.0])), [expected, expected], rtol=1e-10)


def test_invalid_and_singular_slots_have_zero_gradient(x64):
    value = lambda a: jnp.sum(solve((a, jnp.asarray(2))).models)  # noqa: E731
    assert jax.grad(value)(jnp.inf) == 0.0
    assert jax.grad(lambda a: solve((a, jnp.asarray(2))).models[0, 0])(0.0) == 0.0


@pytest.mark.parametrize("size", [1, 3, 6, 9])
def test_linear_solve(size, dtype):
    rng = np.random.default_rng(size)
    matrix = rng.normal(size=(50, size, size)) * 10.0 ** rng.uniform(-4, 4, size=(50, size, 1))
    matrix[0] = np.eye(size)[::-1]
    rhs = rng.normal(size=(50, size))
    found = jax.vmap(solve_square)(matrix.astype(dtype), rhs.astype(dtype))
    expected = np.linalg.solve(matrix, rhs[..., None])[..., 0]
    error = np.abs(found - expected).max(axis=1) / np.abs(expected).max(axis=1)
    condition = np.linalg.cond(matrix / np.abs(matrix).max(axis=2, keepdims=True))
    np.testing.assert_array_less(error, 50 * float(jnp.finfo(dtype).eps) * condition)


def test_linear_solve_of_a_singular_matrix(dtype):
    matrix = jnp.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [1.0, 0.0, 1.0]], dtype)
    rhs = jnp.array([1.0, 1.0, 1.0], dtype)
    for singular in (matrix, jnp.zeros_like(matrix), matrix * jnp.nan, matrix.at[0, 0].set(jnp.inf)):
        np.testing.assert_array_equal(solve_square(singular, rhs), 0.0)
        backward = jax.grad(lambda rhs, singular=singular: jnp.sum(solve_square(singular, rhs)))(rhs)
        np.testing.assert_array_equal(backward, 0.0)


def test_chunks_of_lanes_give_what_one_pass_gives():
    def kernel(x, y):
        return x[0] * y[0] + x[1], jnp.stack([x[0] - y[0], x[1] * 2.0])

    rng = np.random.default_rng(0)
    x, y = (rng.normal(size=(23, 2)).astype(np.float32) for _ in range(2))
    whole = jax.vmap(lanes_last(kernel))(jnp.asarray(x), jnp.asarray(y))
    for size in (4, 23, 64):  # the last piece is shorter; just one; less than one
        parts = jax.vmap(lanes_last(kernel, chunk=size))(jnp.asarray(x), jnp.asarray(y))
        for one, other in zip(whole, parts, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
    shared = jax.vmap(lanes_last(kernel, chunk=4), in_axes=(0, None))(jnp.asarray(x), jnp.asarray(y[0]))
    np.testing.assert_allclose(shared[0], x[:, 0] * y[0, 0] + x[:, 1], rtol=1e-6)
