"""Robust pose of a rig: truth, one camera as a special case, covariance, derivatives, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.spatial.transform import Rotation

from vojax import SE3, Result
from vojax.cameras import BrownConrady, Pinhole, Rig
from vojax.metrics import nees
from vojax.robust import RansacOptions, estimate_absolute_pose, estimate_generalized_pose

B, N, SIGMA = 100, 80, 0.5
OPTIONS = RansacOptions(threshold_px=2.0)


def rig(dtype=np.float32):
    """Two different cameras, half a metre apart and turned outwards."""
    turns = Rotation.from_euler("y", [[-20.0], [20.0]], degrees=True)
    rotation = np.roll(turns.as_quat(), 1, axis=-1)
    poses = np.concatenate([rotation, [[0.25, 0.0, 0.0], [-0.25, 0.1, 0.0]]], axis=1)
    number = {name: jnp.asarray(value, dtype) for name, value in dict(fx=500.0, fy=510.0, cx=320.0, cy=240.0).items()}
    bent = {name: jnp.asarray(value, dtype) for name, value in dict(k1=-0.2, k2=0.05, p1=1e-3).items()}
    return Rig((Pinhole(**number), BrownConrady(**number, **bent)), SE3(jnp.asarray(poses, dtype)))


def problems(seed, share, dtype=np.float32, batch=B):
    """Points, pixels, indices, which are right, and the true poses."""
    rng = np.random.default_rng(seed)
    index = rng.integers(0, 2, (batch, N))
    turn = np.roll(Rotation.random(batch, rng=rng).as_quat(), 1, axis=-1)
    truth = np.concatenate([turn, rng.normal(size=(batch, 3)) * 3.0], axis=1)
    plane = rng.uniform(-0.5, 0.5, (batch, N, 2)) * [1.2, 0.9]
    points_cam = np.concatenate([plane, np.ones((batch, N, 1))], axis=2) * rng.uniform(2.0, 8.0, (batch, N, 1))
    with jax.enable_x64(True):
        exact = rig(np.float64)
        rig_from_cam = SE3(exact.cam_from_rig.wxyz_xyz[index]).inverse()
        points_rig = rig_from_cam.apply(jnp.asarray(points_cam))
        points = SE3(jnp.asarray(truth)[:, None]).inverse().apply(points_rig)
        pixels = np.asarray(jax.vmap(exact.project)(points_rig, jnp.asarray(index)))
        points = np.asarray(points)
    pixels = pixels + SIGMA * rng.normal(size=pixels.shape)
    right = np.arange(N) >= round(share * N)
    pixels = np.where(right[:, None], pixels, rng.uniform([0, 0], [640, 480], pixels.shape))
    return points.astype(dtype), pixels.astype(dtype), index.astype(np.int32), right, truth


@jax.jit
@jax.vmap
def solve_all(key, points, pixels, index, mask):
    return estimate_generalized_pose(points, pixels, index, rig(), key=key, options=OPTIONS, sigma_px=SIGMA, mask=mask)


def solve(points, pixels, index, mask=None):
    mask = np.ones((B, N), bool) if mask is None else mask
    return solve_all(jax.random.split(jax.random.key(3), B), points, pixels, index, mask)


def tangents(model, truth):
    """ξ with truth = exp(−ξ) @ model."""
    with jax.enable_x64(True):
        model = SE3(jnp.asarray(np.asarray(model.wxyz_xyz, np.float64))).normalize()
        return -np.asarray((SE3(jnp.asarray(truth)) @ model.inverse()).log())


def test_recalls_the_pose_among_wrong_pixels():
    points, pixels, index, right, truth = problems(0, 0.5)
    found = solve(points, pixels, index)
    assert np.all(found.result == Result.success)
    xi = tangents(found.model, truth)
    assert np.abs(xi[:, 3:]).max() < 0.01
    assert np.abs(xi[:, :3]).max() < 0.05
    inliers = np.asarray(found.inliers)
    assert inliers[:, right].mean() > 0.99
    assert inliers[:, ~right].mean() < 0.01


@pytest.mark.slow
def test_the_covariance_is_that_of_the_errors():
    values = []
    for seed in range(5):
        points, pixels, index, _, truth = problems(10 + seed, 0.0)
        found = solve(points, pixels, index)
        values.append(np.asarray(nees(tangents(found.model, truth), np.asarray(found.covariance, np.float64))))
    values = np.concatenate(values)
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 6 * len(values)) / len(values)
    assert low < values.mean() < high


@pytest.mark.slow
def test_a_rig_of_one_camera_is_a_camera():
    camera = rig().cameras[1]
    rng = np.random.default_rng(2)
    points = (rng.uniform(-0.5, 0.5, (N, 3)) * [1.2, 0.9, 2.0] + [0.0, 0.0, 3.0]).astype(np.float32)
    pixels = np.asarray(camera.project(points)) + SIGMA * rng.normal(size=(N, 2)).astype(np.float32)
    identity = SE3(jnp.eye(7, dtype=jnp.float32)[:1])
    noise = {"key": jax.random.key(0), "options": OPTIONS, "sigma_px": SIGMA}
    several = estimate_generalized_pose(points, pixels, np.zeros(N, np.int32), Rig((camera,), identity), **noise)
    one = estimate_absolute_pose(points, pixels, camera, **noise)
    np.testing.assert_allclose(several.covariance, one.covariance, rtol=0.05, atol=1e-9)
    # They differ in what the last refinement makes of errors of three deviations: by less than a deviation together.
    assert nees((several.model @ one.model.inverse()).log()[None], one.covariance[None])[0] < 1.0


@pytest.mark.slow
def test_derivatives_are_those_of_the_estimate():
    points, pixels, index, _, _ = problems(4, 0.2, np.float64, batch=1)
    with jax.enable_x64(True):
        data = (jnp.asarray(points[0]), jnp.asarray(pixels[0]))
        cameras = rig(np.float64)

        @jax.jit
        def pose(points, pixels, rig):
            found = estimate_generalized_pose(
                points, pixels, index[0], rig, key=jax.random.key(0), options=OPTIONS, sigma_px=SIGMA
            )
            return found.model.wxyz_xyz

        rng = np.random.default_rng(0)
        direction = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), (*data, cameras))
        _, change = jax.jvp(pose, (*data, cameras), direction)
        h = 1e-6
        ahead, behind = (jax.tree.map(lambda x, d, s=s: x + s * h * d, (*data, cameras), direction) for s in (1, -1))
        difference = (pose(*ahead) - pose(*behind)) / (2 * h)
    np.testing.assert_allclose(change, difference, rtol=1e-5, atol=1e-6)


def test_bad_input_has_a_code_and_an_empty_answer():
    points, pixels, index, _, _ = problems(1, 0.0)
    mask = np.ones((B, N), bool)
    mask[0] = False
    mask[1] = np.arange(N) < 3
    points[2] = np.nan
    points[3], pixels[3] = points[3, :1], pixels[3, :1]
    index[4] = 7
    rng = np.random.default_rng(5)
    pixels[5] = rng.uniform(0, 480, pixels[5].shape)
    found = solve(points, pixels, index, mask)
    expected = [Result.too_few, Result.too_few, Result.too_few, Result.degenerate, Result.too_few, Result.no_consensus]
    for i, code in enumerate(expected):
        assert (found.result == code)[i], i
    assert np.all((found.result == Result.success)[6:])
    assert not np.asarray(found.inliers)[:6].any()
    for leaf in jax.tree.leaves((found.model, found.covariance, found.score)):
        assert np.isfinite(leaf).all()


@pytest.mark.parametrize("shapes", [((8, 2), (8, 2), (8,)), ((8, 3), (8, 2), (7,)), ((2, 3), (2, 2), (2,))])
def test_wrong_shapes_are_refused(shapes):
    points, pixels = (np.zeros(shape, np.float32) for shape in shapes[:2])
    # Under pytest the type checker may speak first.
    with pytest.raises((ValueError, TypeError)):
        estimate_generalized_pose(points, pixels, np.zeros(shapes[2], np.int32), rig(), key=jax.random.key(0))


def test_a_rig_has_a_pose_for_each_camera():
    with pytest.raises(ValueError, match="one pose for each"):
        Rig(rig().cameras, SE3(rig().cam_from_rig.wxyz_xyz[:1]))
