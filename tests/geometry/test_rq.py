import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation

from vojax.geometry import camera_from_projection, rq_decompose

decompose = jax.jit(jax.vmap(rq_decompose))
take_apart = jax.jit(jax.vmap(camera_from_projection))


def cameras(count, seed=0):
    rng = np.random.default_rng(seed)
    k = np.zeros((count, 3, 3))
    k[:, 0, 0], k[:, 1, 1], k[:, 2, 2] = rng.uniform(200.0, 2000.0, count), rng.uniform(200.0, 2000.0, count), 1.0
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = rng.normal(size=count), *rng.uniform(-500.0, 1500.0, (2, count))
    rotation = Rotation.random(count, rng=rng).as_matrix()
    return k, rotation, rng.normal(size=(count, 3)) * 3.0


def test_product_and_factors(dtype):
    matrices = np.random.default_rng(1).normal(size=(500, 3, 3))
    matrices *= np.sign(np.linalg.det(matrices))[:, None, None]
    upper, rotation = (np.asarray(x, np.float64) for x in decompose(matrices.astype(dtype)))
    tolerance = 1e-4 if dtype == jnp.float32 else 1e-11
    np.testing.assert_allclose(upper @ rotation, matrices, atol=tolerance)
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), rotation.shape), atol=tolerance
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=tolerance)
    assert (np.diagonal(upper, axis1=1, axis2=2) > 0).all()
    assert (np.tril(upper, -1) == 0).all()


def test_equals_scipy(x64):
    matrices = np.random.default_rng(2).normal(size=(200, 3, 3))
    matrices *= np.sign(np.linalg.det(matrices))[:, None, None]
    upper, rotation = decompose(matrices)
    for i in range(200):
        r, q = scipy.linalg.rq(matrices[i])
        signs = np.sign(np.diagonal(r))
        np.testing.assert_allclose(upper[i], r * signs[None], atol=1e-9)
        np.testing.assert_allclose(rotation[i], q * signs[:, None], atol=1e-9)


def test_negative_determinant_gives_the_negative(x64):
    matrices = np.random.default_rng(3).normal(size=(50, 3, 3))
    for ours, theirs in zip(decompose(matrices), decompose(-matrices), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_cameras_come_back(dtype):
    k, rotation, translation = cameras(500)
    scale = (
        np.random.default_rng(4).uniform(0.1, 10.0, (500, 1, 1))
        * np.where(np.arange(500) % 2, 1.0, -1.0)[:, None, None]
    )
    projection = scale * k @ np.concatenate([rotation, translation[..., None]], axis=-1)
    calibration, pose = take_apart(projection.astype(dtype))
    relative = np.abs(np.asarray(calibration, np.float64) - k).max(axis=(1, 2)) / k[:, 0, 0]
    moved = np.abs(np.asarray(pose.translation(), np.float64) - translation).max(axis=1)
    turned = np.abs(np.asarray(pose.rotation().as_matrix(), np.float64) - rotation).max(axis=(1, 2))
    assert relative.max() < (1e-4 if dtype == jnp.float32 else 1e-12)
    assert turned.max() < (1e-4 if dtype == jnp.float32 else 1e-12)
    assert moved.max() < (1e-3 if dtype == jnp.float32 else 1e-11)


def degenerate():
    rng = np.random.default_rng(5)
    matrices = rng.normal(size=(10, 3, 4))
    matrices[0] = 0.0
    matrices[1, 2, :3] = 0.0  # an affine camera
    matrices[2, 1, :3] = 2.0 * matrices[2, 2, :3]
    matrices[3, 0, :3] = matrices[3, 1, :3] - 3.0 * matrices[3, 2, :3]
    matrices[4, 0, 0] = np.nan
    matrices[5, 1, 1] = np.inf
    matrices[6, 0, 3] = np.nan
    matrices[7] *= 1e30
    matrices[8] *= 1e-30
    matrices[9, 0, :3] = 0.0
    return matrices


@pytest.mark.slow
def test_degenerate_matrices(dtype):
    projection = degenerate().astype(dtype)
    calibration, pose = take_apart(projection)
    upper, rotation = decompose(projection[:, :, :3])
    for x in (calibration, pose.wxyz_xyz, upper, rotation):
        assert np.isfinite(x).all()
    singular = [0, 1, 2, 3, 4, 5, 9]
    np.testing.assert_array_equal(upper[jnp.array(singular)], np.broadcast_to(np.eye(3), (7, 3, 3)))
    np.testing.assert_array_equal(rotation[jnp.array(singular)], np.broadcast_to(np.eye(3), (7, 3, 3)))
    singular.append(6)
    np.testing.assert_array_equal(calibration[jnp.array(singular)], np.broadcast_to(np.eye(3), (8, 3, 3)))
    np.testing.assert_array_equal(pose.wxyz_xyz[jnp.array(singular)], np.broadcast_to(np.eye(7)[0], (8, 7)))
    # Size does not matter.
    one, _ = take_apart(np.stack([projection[7] / dtype(1e30), projection[8] * dtype(1e30)]))
    np.testing.assert_allclose(calibration[7:9], one, rtol=1e-4, atol=1e-4)


def test_gradients_equal_central_differences(x64):
    rng = np.random.default_rng(6)
    factors = [rng.normal(size=s) for s in ((3, 3), (3, 3), (3, 3), 7)]

    @jax.jit
    def function(projection):
        upper, rotation = rq_decompose(projection[:, :3])
        calibration, pose = camera_from_projection(projection)
        values = (upper, rotation, calibration, pose.wxyz_xyz)
        return sum(jnp.sum(f * x) for f, x in zip(factors, values, strict=True))

    for projection in rng.normal(size=(5, 3, 4)):
        back, ahead = jax.grad(function)(projection), jax.jacfwd(function)(projection)
        numeric = np.zeros((3, 4))
        for entry in np.ndindex(3, 4):
            step = np.zeros((3, 4))
            step[entry] = 1e-6
            numeric[entry] = (function(projection + step) - function(projection - step)) / 2e-6
        np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())
        np.testing.assert_allclose(ahead, back, rtol=1e-10, atol=1e-10 * np.abs(numeric).max())


@pytest.mark.slow
def test_gradients_are_finite_everywhere(dtype):
    def total(projection):
        calibration, pose = camera_from_projection(projection)
        upper, rotation = rq_decompose(projection[:, :3])
        return sum(jnp.sum(x) for x in (calibration, pose.wxyz_xyz, upper, rotation))

    assert np.isfinite(jax.jit(jax.vmap(jax.grad(total)))(degenerate().astype(dtype))).all()
