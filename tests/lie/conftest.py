import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from vojax.lie import SE3, SO3, Sim3

# Angles at, near and between every branch: the origin, the series' ends (0.4 for log, 2 for the tangent, 4 for half of
# it) and half a turn.
ANGLES = (0.0, 1e-20, 1e-8, 1e-4, 1e-2, 0.39, 0.41, 1.5, 1.99, 2.01, 3.0, np.pi - 1e-3, np.pi - 1e-6)


@pytest.fixture(params=[SO3, SE3, Sim3], ids=["SO3", "SE3", "Sim3"])
def group(request):
    return request.param


@pytest.fixture
def tangents():
    """Factory of tangents `[13 * repeats, dim]` that meet every angle above, with ρ and log s of order one (or 0)."""

    def make(group, dtype, repeats=4, seed=0):
        rng = np.random.default_rng(seed)
        axes = rng.normal(size=(repeats, len(ANGLES), 3))
        axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
        phi = (axes * np.array(ANGLES)[None, :, None]).reshape(-1, 3)
        rho = rng.normal(size=phi.shape)
        sigma = rng.uniform(-1.5, 1.5, size=(len(phi), 1)) * rng.choice([0.0, 1e-8, 1e-3, 1.0, 2.0], size=(len(phi), 1))
        parts = {SO3: [phi], SE3: [rho, phi], Sim3: [rho, phi, sigma]}[group]
        return jnp.asarray(np.concatenate(parts, axis=1), dtype)

    return make


@pytest.fixture
def expm():
    """Oracle for exp: SciPy's matrix exponential of the generator, 3x3 for SO3 and 4x4 otherwise."""

    def one(xi):
        xi = np.asarray(xi, np.float64)
        x, y, z = xi if len(xi) == 3 else xi[3:6]
        skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        if len(xi) == 3:
            return scipy.linalg.expm(skew)
        generator = np.zeros((4, 4))
        generator[:3, :3] = skew + (xi[6] if len(xi) == 7 else 0.0) * np.eye(3)
        generator[:3, 3] = xi[:3]
        return scipy.linalg.expm(generator)

    return lambda batch: np.stack([one(xi) for xi in batch])


@pytest.fixture
def values():
    """Float64 copy on the host, whatever the precision of the array."""
    return lambda x: np.asarray(jax.device_get(x), np.float64)
