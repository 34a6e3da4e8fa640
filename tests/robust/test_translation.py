"""The position of a camera whose rotation is known: truth, covariance, derivative, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from vojax import SE3, SO3, Result
from vojax.cameras import Pinhole
from vojax.datasets import simulate_absolute_pose
from vojax.metrics import nees
from vojax.robust import RansacOptions, estimate_absolute_pose, estimate_translation

pytestmark = pytest.mark.optimized

B, N = 200, 64  # one program serves nearly every test
CAMERA = {"fx": 800.0, "fy": 800.0, "cx": 639.5, "cy": 479.5}
THRESHOLD = 3.0


@jax.jit
def estimate(keys, points, pixels, rotations, spread, mask, sigma_px):
    camera, options = Pinhole(**CAMERA), RansacOptions(threshold_px=THRESHOLD)

    def one(key, points, pixels, wxyz, mask):
        return estimate_translation(
            points, pixels, camera, SO3(wxyz), rotation_covariance=spread,
            key=key, mask=mask, sigma_px=sigma_px, options=options,
        )  # fmt: skip

    return jax.vmap(one)(keys, points, pixels, rotations.wxyz, mask)


def simulate(seed, share, sigma_px=0.6):
    keys = jax.random.split(jax.random.key(seed), B)
    return jax.vmap(lambda key: simulate_absolute_pose(key, N, outlier_fraction=share, sigma_px=sigma_px))(keys)


def solve(problem, rotations=None, spread=None, mask=None, sigma_px=0.6, key=5):
    rotations = problem.cam_from_world.rotation() if rotations is None else rotations
    spread = jnp.zeros((3, 3)) if spread is None else spread
    mask = jnp.ones((B, N), bool) if mask is None else mask
    keys = jax.random.split(jax.random.key(key), B)
    return estimate(keys, problem.points_world, problem.pixels, rotations, spread, mask, jnp.float32(sigma_px))


def errors(found, problem):
    """ξ of `world_from_cam @ exp(ξ)`."""
    return jax.vmap(lambda estimated, true: (estimated @ true.inverse()).log())(found.model, problem.cam_from_world)


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_finds_the_position_and_its_inliers(share):
    problem = simulate(int(10 * share), share)
    found = solve(problem)
    good = np.linalg.norm(errors(found, problem)[:, :3], axis=1) < 0.1
    assert good.mean() >= 0.995
    assert np.all((found.result == Result.success)[good])
    assert np.mean(np.asarray(found.inliers == problem.inliers)[good]) > 0.995
    # Seven of ten wrong: 49 samples of two against 168 of three, and 128 are one chunk.
    assert np.all(np.asarray(found.num_hypotheses)[good] <= 256)


def test_the_rotation_stays_as_it_is():
    problem = simulate(1, 0.3)
    found = solve(problem)
    np.testing.assert_allclose(found.model.rotation().wxyz, problem.cam_from_world.rotation().wxyz, atol=1e-6)
    assert np.all(np.asarray(found.covariance[:, 3:]) == 0)
    assert np.all(np.asarray(found.covariance[:, :, 3:]) == 0)


def in_band(values, dof):
    """A mean of NEES within its 99.9 % band."""
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], dof * len(values)) / len(values)
    assert low < values.mean() < high, (low, values.mean(), high)


def test_errors_follow_the_covariance():
    problem = simulate(21, 0.3)
    found = solve(problem)
    assert np.all(found.result == Result.success)
    in_band(np.asarray(nees(errors(found, problem)[:, :3], found.covariance[:, :3, :3])), 3)


def test_an_uncertain_rotation_is_carried_into_the_position():
    problem = simulate(22, 0.3)
    deviations = jnp.float32([3e-4, 2e-4, 4e-4])  # a fifth of a pixel
    phi = deviations[None] * jax.random.normal(jax.random.key(3), (B, 3))
    # The true rotation is exp(−φ) @ rotation.
    rotations = SO3.exp(phi) @ problem.cam_from_world.rotation()
    found = solve(problem, rotations, jnp.diag(deviations**2))
    assert np.all(found.result == Result.success)
    in_band(np.asarray(nees(errors(found, problem), found.covariance)), 6)
    # Without its share the position is more certain than it should be.
    alone = solve(problem, rotations)
    assert np.mean(nees(errors(alone, problem)[:, :3], alone.covariance[:, :3, :3])) > 4.0


@pytest.mark.slow
def test_a_known_rotation_makes_the_position_more_certain():
    problem = simulate(23, 0.3)
    camera, options = Pinhole(**CAMERA), RansacOptions(threshold_px=THRESHOLD)
    keys = jax.random.split(jax.random.key(9), B)
    pose = jax.jit(
        jax.vmap(lambda k, x, p: estimate_absolute_pose(x, p, camera, key=k, options=options, sigma_px=0.6))
    )(keys, problem.points_world, problem.pixels)
    found = solve(problem)
    ours, theirs = (np.linalg.norm(errors(e, problem)[:, :3], axis=1) for e in (found, pose))
    assert np.median(ours) < 0.8 * np.median(theirs)


def test_gradients_are_those_of_the_refined_position():
    with jax.enable_x64(True):
        camera = Pinhole(**CAMERA)
        problem = simulate_absolute_pose(jax.random.key(4), 24, sigma_px=0.5, dtype=jnp.float64)
        weights = jnp.array([0.3, -0.5, 0.8])

        @jax.jit
        def position(points, pixels, turn):
            rotation = SO3.exp(turn) @ problem.cam_from_world.rotation()
            found = estimate_translation(points, pixels, camera, rotation, key=jax.random.key(0))
            return jnp.sum(weights * found.model.translation())

        at = (problem.points_world, problem.pixels, jnp.zeros(3))
        gradients = jax.jit(jax.grad(position, argnums=(0, 1, 2)))(*at)
        rng = np.random.default_rng(0)
        for i, gradient in enumerate(gradients):
            direction = rng.normal(size=gradient.shape)
            step = 1e-4 * direction
            ahead, behind = (position(*at[:i], at[i] + s * step, *at[i + 1 :]) for s in (1, -1))
            expected = float(ahead - behind) / 2e-4
            np.testing.assert_allclose(float(jnp.sum(gradient * direction)), expected, rtol=1e-5, atol=1e-8)


@pytest.mark.slow
def test_gradients_do_not_see_what_is_masked():
    camera = Pinhole(**CAMERA)
    problem = simulate_absolute_pose(jax.random.key(6), 24, sigma_px=0.5)
    points, pixels = problem.points_world.at[0].set(jnp.nan), problem.pixels.at[1].set(jnp.inf)

    def length(points, pixels, wxyz):
        found = estimate_translation(points, pixels, camera, SO3(wxyz), key=jax.random.key(0))
        return jnp.sum(found.model.translation() ** 2)

    gradients = jax.jit(jax.grad(length, argnums=(0, 1, 2)))(points, pixels, problem.cam_from_world.rotation().wxyz)
    assert all(np.isfinite(gradient).all() for gradient in gradients)
    assert np.all(np.asarray(gradients[0][:2]) == 0)
    assert np.any(np.asarray(gradients[0][2:]) != 0)


def test_bad_input_has_a_code_and_nothing_that_is_not_a_number():
    problem = simulate(1, 0.0)
    points, pixels, mask = np.array(problem.points_world), np.array(problem.pixels), np.ones((B, N), bool)
    wxyz = np.array(problem.cam_from_world.rotation().wxyz)
    mask[0], mask[1] = False, np.arange(N) < 2
    points[2] = np.nan
    pixels[3] = np.random.default_rng(0).uniform([0, 0], [1280, 960], (N, 2))
    points[4], pixels[4] = points[4, :1], pixels[4, :1]
    wxyz[5] = np.nan
    world_from_cam = problem.cam_from_world.inverse()
    points[6] = 2 * np.asarray(world_from_cam.translation())[6] - points[6]  # mirrored through the camera
    broken = problem._replace(points_world=jnp.asarray(points), pixels=jnp.asarray(pixels))
    found = solve(broken, SO3(jnp.asarray(wxyz)), mask=jnp.asarray(mask))
    codes = {
        0: Result.too_few, 1: Result.too_few, 2: Result.too_few, 3: Result.no_consensus,
        4: Result.degenerate, 5: Result.too_few,
    }  # fmt: skip
    for i, code in codes.items():
        assert (found.result == code)[i], i
        np.testing.assert_array_equal(found.model.wxyz_xyz[i], [1, 0, 0, 0, 0, 0, 0], err_msg=str(i))
        assert np.all(np.asarray(found.covariance[i]) == 0)
        assert found.num_inliers[i] == 0
    assert found.num_inliers[6] < 0.2 * N
    for leaf in jax.tree.leaves((found.model, found.covariance, found.score)):
        assert np.isfinite(leaf).all()
    assert np.all((found.result == Result.success)[7:])


def test_what_does_not_fit_is_said_in_one_line():
    camera, key, points, pixels = Pinhole(**CAMERA), jax.random.key(0), jnp.ones((8, 3)), jnp.ones((8, 2))
    one = SO3.identity()
    cases = [
        ((points, pixels[:-1], camera, one), {}),
        ((points[:2], pixels[:2], camera, one), {}),
        ((points, pixels, camera, SO3(jnp.ones((2, 4)))), {}),
        ((points, pixels, camera, one), {"rotation_covariance": jnp.eye(2)}),
        ((points, pixels, camera, one), {"mask": jnp.ones(7, bool)}),
        ((points, pixels, camera, one), {"sigma_px": 0.0}),
    ]
    for arguments, settings in cases:
        with pytest.raises((ValueError, TypeError)) as caught:
            estimate_translation(*arguments, key=key, **settings)
        assert not isinstance(caught.value, ValueError) or "\n" not in str(caught.value)


def test_two_points_far_from_the_origin():
    # Hypotheses are sought about the middle of the points: float32 sees no large coordinates.
    problem = simulate(31, 0.3)
    far = jnp.array([3000.0, -2000.0, 1000.0])
    rotation = problem.cam_from_world.rotation()
    moved = problem._replace(points_world=problem.points_world + far[None, None])
    found = solve(moved)
    true = problem.cam_from_world.translation() - rotation.apply(jnp.broadcast_to(far[None], (B, 3)))
    good = np.linalg.norm(found.model.translation() - true, axis=1) < 0.1
    assert good.mean() >= 0.99
    assert isinstance(found.model, SE3)
