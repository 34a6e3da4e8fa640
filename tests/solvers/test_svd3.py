import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vojax.solvers._components import quaternion_from_rotation
from vojax.solvers._svd3 import svd3

decompose = jax.jit(lambda a: svd3([[a[i, j] for j in range(3)] for i in range(3)]))


@pytest.fixture
def matrices():
    """Random, orthogonal (equal singular values), rank two, rank one, zero, reflected and badly scaled matrices."""
    rng = np.random.default_rng(0)
    a = rng.normal(size=(1200, 3, 3))
    a[:200] = np.linalg.qr(a[:200])[0]
    a[200:300, :, 2] = a[200:300, :, 0] + a[200:300, :, 1]
    a[300:400] = a[300:400, :, :1] * a[300:400, :1, :]
    a[400] = 0.0
    a[401:500] *= 10.0 ** rng.uniform(-15, 15, size=(99, 1, 1))
    a[500:600] *= np.array([1.0, 1e-3, 1e-6])[None, None, :]
    a[600:700, 0] *= -1.0
    return a


def test_decomposition(dtype, matrices):
    a = matrices.astype(dtype)
    u, s, v = (np.asarray(x, np.float64) for x in decompose(np.moveaxis(a, 0, -1)))
    size = np.maximum(np.abs(a).max(axis=(1, 2)).astype(np.float64), np.finfo(dtype).tiny)
    tolerance = 2e-6 if dtype == jnp.float32 else 1e-14
    for rotation in (u, v):
        gram = np.einsum("ikb,jkb->bij", rotation, rotation)
        np.testing.assert_array_less(np.abs(gram - np.eye(3)[None]), tolerance)
        np.testing.assert_allclose(np.linalg.det(np.moveaxis(rotation, -1, 0)), 1.0, atol=tolerance)
    product = np.einsum("kib,kb,kjb->bij", u, s, v)
    np.testing.assert_array_less(np.abs(product - a).max(axis=(1, 2)) / size, tolerance)
    expected = np.linalg.svd(a.astype(np.float64), compute_uv=False)
    np.testing.assert_array_less(np.abs(np.abs(s.T) - expected).max(axis=1) / size, tolerance)
    assert (np.diff(np.abs(s), axis=0) <= tolerance * size).all()
    well = expected[:, 2] > 1e-3 * expected[:, 0]
    np.testing.assert_array_equal(np.sign(s[2])[well], np.sign(np.linalg.det(a.astype(np.float64)))[well])


def test_infinite_input_stays_outside_the_other_lanes():
    a = np.stack([np.full((3, 3), np.nan), np.eye(3)], axis=-1).astype(np.float32)
    _, s, _ = decompose(a)
    np.testing.assert_allclose(np.asarray(s)[:, 1], 1.0, atol=1e-6)


def test_the_rotation_nearest_to_a_multiple_of_one(dtype):
    # Columns of equal length: which is called longer must be the same for all that is computed from it, in a program
    # that uses the factors several times.
    rng = np.random.default_rng(1)
    rotations = np.linalg.qr(rng.normal(size=(20_000, 3, 3)))[0]
    rotations *= np.linalg.det(rotations)[:, None, None]
    scale = rng.uniform(0.1, 10.0, 20_000)

    @jax.jit
    def nearest(a):
        u, s, v = svd3([[a[i, j] for j in range(3)] for i in range(3)])
        r = [[u[0][i] * v[0][j] + u[1][i] * v[1][j] + u[2][i] * v[2][j] for j in range(3)] for i in range(3)]
        return jnp.stack([jnp.stack(row) for row in r]), (s[0] + s[1] + s[2]) / 3.0, quaternion_from_rotation(r)

    found, mean, quaternion = nearest(np.moveaxis(scale[:, None, None] * rotations, 0, -1).astype(dtype))
    tolerance = 2e-6 if dtype == jnp.float32 else 1e-14
    assert np.abs(np.moveaxis(np.asarray(found), -1, 0) - rotations).max() < tolerance
    np.testing.assert_allclose(mean, scale, rtol=tolerance)
    expected = Rotation.from_matrix(rotations).as_quat(scalar_first=True)
    assert np.abs(np.abs(np.sum(np.stack(quaternion, axis=-1) * expected, axis=1)) - 1.0).max() < tolerance
