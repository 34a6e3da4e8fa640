from fractions import Fraction
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np

from vojax.lie._coefficients import half_angle_over_sine, similarity_coefficients, stumpff

SQUARED_ANGLES = np.concatenate(
    [[0.0], np.geomspace(1e-30, 1e-2, 12), np.linspace(0.05, 9.9, 80), [3.9999, 4.0, 4.0001]]
)


def exact_stumpff(u, order):
    u = Fraction(float(u))
    return float(sum((-u) ** k / factorial(2 * k + order) for k in range(28)))


def test_stumpff_against_exact_series(dtype):
    u = jnp.asarray(SQUARED_ANGLES, dtype)
    found = jax.jit(stumpff)(u)
    slopes = jax.jit(jax.vmap(jax.jacfwd(stumpff)))(u)
    eps = float(jnp.finfo(dtype).eps)
    for order in range(6):
        exact = np.array([exact_stumpff(v, order) for v in np.asarray(u)])
        # Relative to c_n(0) = 1/n!; the measured worst case is c_5 just above the branch.
        np.testing.assert_allclose(
            np.asarray(found[order], np.float64), exact, rtol=0, atol=20 * eps / factorial(order)
        )
        # d c_n / du = (n c_{n+2} − c_{n+1}) / 2.
        slope = np.array(
            [(order * exact_stumpff(v, order + 2) - exact_stumpff(v, order + 1)) / 2 for v in np.asarray(u)]
        )
        np.testing.assert_allclose(
            np.asarray(slopes[order], np.float64), slope, rtol=0, atol=20 * eps / factorial(order)
        )


def test_half_angle_over_sine(dtype):
    half = np.concatenate([np.geomspace(1e-12, 1e-2, 9), np.linspace(0.02, np.pi / 2, 60)])
    # A common scale must not matter: quaternions drift off unit length.
    n, w = 1.5 * np.sin(half), 1.5 * np.cos(half)
    found = jax.jit(half_angle_over_sine)(jnp.asarray(n * n, dtype), jnp.asarray(w, dtype))
    np.testing.assert_allclose(np.asarray(found), 2 * half / n, rtol=16 * float(jnp.finfo(dtype).eps))


def test_similarity_coefficients_against_quadrature(x64):
    sigmas = np.array([0.0, 1e-12, -1e-4, 0.7, -1.999, 2.001, -6.0, 9.0])
    u = SQUARED_ANGLES[::4]
    nodes, weights = np.polynomial.legendre.leggauss(30)
    tau, weights = (nodes + 1) / 2, weights / 2
    growth = weights * np.exp(sigmas[:, None] * tau)
    s1 = np.array([[exact_stumpff(t * t * v, 1) for v in u] for t in tau])
    s2 = np.array([[exact_stumpff(t * t * v, 2) for v in u] for t in tau])
    expected = [growth.sum(1, keepdims=True) * np.ones_like(u), (growth * tau) @ s1, (growth * tau**2) @ s2]
    grid = np.broadcast_arrays(sigmas[:, None], u[None])
    found = jax.jit(similarity_coefficients)(*(jnp.asarray(values) for values in grid))
    np.testing.assert_allclose(np.stack(found), np.stack(expected), rtol=2e-14, atol=1e-15)
