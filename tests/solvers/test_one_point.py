import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from tests.solvers.problems import solve_in_batches
from tests.solvers.upright_problems import check_finite_gradients, check_gradients, least_errors, unit
from tests.solvers.vehicles import drive
from vojax import SE3
from vojax.solvers import (
    arc_motion,
    one_point,
    planar_two_point,
    scale_from_turn,
    turn_angle,
)

solve_last = jax.jit(jax.vmap(one_point, in_axes=-1, out_axes=-1))
solve_first = jax.jit(jax.vmap(one_point))
planar_first = jax.jit(jax.vmap(planar_two_point))
scale_first = jax.jit(jax.vmap(scale_from_turn, in_axes=(0, 0, 0, 0)))


def one_point_data(world):
    return world["rays0"][:, 0], world["rays1"][:, 0], world["forward"], world["up"]


def solve(data, dtype, size=2048):
    return solve_in_batches(solve_last, *data, dtype=dtype, size=size)


def theta_of(candidates, up):
    """Angles of the only slot, from the rotation matrices by another route."""
    q = np.asarray(candidates.models.wxyz_xyz, np.float64)[:, 0, [1, 2, 3, 0]]
    return -np.sum(Rotation.from_quat(q).as_rotvec() * up, axis=-1)


@pytest.mark.parametrize("mounted", [False, True])
@pytest.mark.parametrize("reverse", [False, True])
def test_finds_the_truth(dtype, mounted, reverse):
    world = drive(4096, 1, seed=1, mounted=mounted, reverse=reverse)
    data = one_point_data(world)
    candidates = solve(data, dtype)
    errors = least_errors(candidates, world["rotation"], unit(world["translation"]))
    told = np.abs(np.sum(data[0] * data[3], axis=-1)) > 0.02  # a degree off the horizon
    assert told.mean() > 0.9
    if dtype == jnp.float32:
        assert (errors[told] < 1e-4).mean() >= 0.999
    else:
        assert (errors[told] < 1e-9).all()
        assert (errors < 1e-6).mean() >= 0.9999


def test_any_turn(x64):
    world = drive(2048, 1, seed=2, theta=np.random.default_rng(2).uniform(-np.pi, np.pi, 2048))
    candidates = solve(one_point_data(world), np.float64)
    errors = least_errors(candidates, world["rotation"], unit(world["translation"]))
    assert (errors < 1e-8).mean() > 0.999


def test_half_turn(x64):
    world = drive(256, 1, seed=3, theta=np.pi)
    errors = least_errors(solve(one_point_data(world), np.float64), world["rotation"], unit(world["translation"]))
    assert (errors < 1e-8).mean() > 0.99


def test_equals_the_formula_of_the_paper(x64):
    # Scaramuzza's axes: x ahead, y to the left, z up; his θ = -2 atan((y2 z1 - z2 y1) / (x2 z1 + z2 x1)) turns right.
    world = drive(512, 1, seed=4)
    x1, x2 = (np.stack([p[:, 2], -p[:, 0], -p[:, 1]]) for p in (world["rays0"][:, 0], world["rays1"][:, 0]))
    theirs = -2.0 * np.arctan((x2[1] * x1[2] - x2[2] * x1[1]) / (x2[0] * x1[2] + x2[2] * x1[0]))
    candidates = solve(one_point_data(world), np.float64)
    ours = np.asarray(turn_angle(SE3(candidates.models.wxyz_xyz[:, 0])))
    valid = candidates.valid[:, 0]
    assert valid.mean() > 0.99
    np.testing.assert_allclose(np.abs(ours[valid]), np.abs(theirs[valid]), atol=1e-9)
    np.testing.assert_allclose(ours[valid], world["theta"][valid], atol=1e-7)


def test_equals_a_numeric_root(x64):
    # Noise included: the epipolar equation of the arc, solved by bisection.
    world = drive(64, 1, seed=5, sigma=1e-3)
    data = one_point_data(world)
    candidates = solve(data, np.float64)

    def epipolar(theta, f, g):
        turned = Rotation.from_rotvec([0.0, theta, 0.0]).apply(f)
        return np.cross(turned, g) @ np.array([np.sin(theta / 2), 0.0, np.cos(theta / 2)])

    checked = 0
    for f, g, theta in zip(data[0], data[1], theta_of(candidates, data[3]), strict=True):
        grid = np.linspace(-2.0, 2.0, 401)
        values = [epipolar(x, f, g) for x in grid]
        roots = [
            brentq(epipolar, a, b, args=(f, g), xtol=1e-14)
            for a, b, va, vb in zip(grid[:-1], grid[1:], values[:-1], values[1:], strict=True)
            if va * vb < 0
        ]
        if len(roots) == 1 and theta != 0.0:
            checked += 1
            np.testing.assert_allclose(theta, roots[0], atol=1e-10)
    assert checked > 40


def test_straight_motion(dtype):
    world = drive(512, 1, seed=6, theta=0.0)
    candidates = solve(one_point_data(world), dtype)
    told = np.abs(world["rays0"][:, 0, 1]) > 0.02
    assert candidates.valid[told].all()
    assert np.abs(theta_of(candidates, world["up"])[told]).max() < (1e-4 if dtype == jnp.float32 else 1e-12)


def test_noise_spreads_the_angle_in_proportion(x64):
    spreads = []
    for sigma in (1e-6, 1e-5, 1e-4):
        world = drive(2048, 1, seed=7, sigma=sigma)
        error = theta_of(solve(one_point_data(world), np.float64), world["up"]) - world["theta"]
        spreads.append(np.median(np.abs(error)) / sigma)
    np.testing.assert_allclose(spreads, spreads[0], rtol=0.1)
    assert spreads[0] < 20.0


def test_lever_arm_biases_the_angle_as_said(x64):
    # The share l / Z of the angle, Z the depth: with l = 1 m and points 4 to 30 m away about a tenth.
    world = drive(2048, 1, seed=8, theta=0.05, lever_arm=1.0)
    candidates = solve(one_point_data(world), np.float64)
    valid = candidates.valid[:, 0]
    share = theta_of(candidates, world["up"])[valid] / 0.05 - 1.0
    assert 0.05 < np.median(np.abs(share)) < 0.2
    ahead = drive(2048, 1, seed=8, theta=0.05)
    exact = theta_of(solve(one_point_data(ahead), np.float64), ahead["up"])
    assert np.median(np.abs(exact - 0.05)) < 1e-12


@pytest.mark.parametrize("spoil", ["horizon", "still", "zero ray", "nan", "inf", "forward is up", "zero up"])
def test_impossible_problems_are_not_valid(dtype, spoil):
    world = drive(256, 1, seed=9, mounted=True)
    ray0, ray1, forward, up = one_point_data(world)
    if spoil == "horizon":
        ray0, ray1 = (x - np.sum(x * up, axis=-1, keepdims=True) * up for x in (ray0, ray1))
    elif spoil == "still":
        ray1 = 2.0 * ray0
    elif spoil == "zero ray":
        ray0 = 0.0 * ray0
    elif spoil == "nan":
        ray1[:, 1] = np.nan
    elif spoil == "inf":
        ray0[:, 2] = np.inf
    elif spoil == "zero up":
        up = 0.0 * up
    else:
        forward = -3.0 * up
    candidates = solve((ray0, ray1, forward, up), dtype)
    assert not candidates.valid.any()
    np.testing.assert_array_equal(candidates.models.wxyz_xyz[:, 0], np.tile(np.eye(7)[0], (256, 1)))


def test_point_that_passes_abeam_tells_nothing(x64):
    # Seen ahead and then as far behind: every turn explains it.
    rays0, rays1 = np.array([[1.0, 0.5, 1.0]]), np.array([[1.0, 0.5, -1.0]])
    assert not solve((rays0, rays1, np.eye(3)[2:], -np.eye(3)[1:2]), np.float64).valid.any()


def mixed(count, seed):
    ray0, ray1, forward, up = one_point_data(drive(count, 1, seed=seed, mounted=True))
    rng = np.random.default_rng(seed)
    kinds = np.array_split(rng.permutation(count)[: count // 2], 9)
    ray0[kinds[0]] = 0.0
    ray1[kinds[1]] = ray0[kinds[1]]
    ray1[kinds[2]] = -ray0[kinds[2]]
    ray0[kinds[3], 1] = np.nan
    ray1[kinds[4], 1] = np.inf
    up[kinds[5]] = forward[kinds[5]]
    forward[kinds[6], 0] = np.nan
    ray0[kinds[7]], up[kinds[7]] = ray0[kinds[7]] * 1e30, up[kinds[7]] * 1e-30
    for ray in (ray0, ray1):
        ray[kinds[8]] -= np.sum(ray[kinds[8]] * up[kinds[8]], axis=-1, keepdims=True) * up[kinds[8]]
    return ray0, ray1, forward, up


def test_degenerate_problems_give_finite_placeholders(dtype):
    candidates = solve(mixed(2048, seed=10), dtype)
    poses = candidates.models.wxyz_xyz
    assert np.isfinite(poses).all()
    np.testing.assert_array_equal(poses[~candidates.valid], np.tile(np.eye(7)[0], ((~candidates.valid).sum(), 1)))


def test_gradients_equal_central_differences(x64):
    check_gradients(one_point, one_point_data(drive(16, 1, seed=11, mounted=True)), 4)


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    check_finite_gradients(one_point, mixed(2048, seed=12), np.float32)


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(8):
        assert np.isfinite(solve(mixed(125_000, seed), dtype, size=25_000).models.wxyz_xyz).all()


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    world = drive(100_000, 1, seed=13, mounted=True)
    data = one_point_data(world)
    errors = least_errors(solve(data, dtype), world["rotation"], unit(world["translation"]))
    print("recall", dtype, [(errors < x).mean() for x in (1e-6, 1e-4, 1e-3, 1e-2)])
    assert (errors < (1e-3 if dtype == jnp.float32 else 1e-6)).mean() >= (0.998 if dtype == jnp.float32 else 0.9999)


@pytest.mark.slow
def test_vmap_equals_a_loop_on_either_axis(x64):
    data = one_point_data(drive(64, 1, seed=14, mounted=True))
    last, first = solve(data, np.float64), solve_first(*data)
    np.testing.assert_array_equal(first.valid, last.valid)
    np.testing.assert_allclose(first.models.wxyz_xyz, last.models.wxyz_xyz, atol=1e-11)
    for i in range(4):
        single = one_point(*(x[i] for x in data))
        np.testing.assert_allclose(single.models.wxyz_xyz, last.models.wxyz_xyz[i], atol=1e-11)


def test_many_lanes_give_what_few_give():
    data = one_point_data(drive(65_536, 1, seed=15))
    many, few = solve(data, np.float32, size=65_536), solve(data, np.float32)
    assert (few.valid == many.valid).mean() > 0.9999
    assert np.quantile(np.abs(few.models.wxyz_xyz - many.models.wxyz_xyz), 0.999) < 1e-4


def test_arc_motion_is_what_one_point_finds(x64):
    world = drive(32, 1, seed=16, mounted=True)
    for theta, forward, up, rotation, translation in zip(
        *(world[x] for x in ("theta", "forward", "up", "rotation", "translation")), strict=True
    ):
        pose = arc_motion(theta, forward, 2.0 * up)
        np.testing.assert_allclose(pose.rotation().as_matrix(), rotation, atol=1e-12)
        np.testing.assert_allclose(pose.translation(), unit(translation), atol=1e-12)
        np.testing.assert_allclose(turn_angle(pose, up), theta, atol=1e-12)
    assert np.isfinite(jax.grad(lambda x: jnp.sum(arc_motion(x).parameters()))(0.0))


# Scale from turns.


def poses_of(world):
    q = Rotation.from_matrix(world["rotation"]).as_quat()[:, [3, 0, 1, 2]]
    return SE3(jnp.asarray(np.concatenate([q, unit(world["translation"])], axis=1)))


def scales(world, lever_arm, poses=None):
    arms = np.broadcast_to(lever_arm, (len(world["theta"]),)).astype(float)
    found = scale_first(poses_of(world) if poses is None else poses, arms, world["forward"], world["up"])
    return jax.tree.map(np.asarray, found)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize(("lever_arm", "side"), [(1.5, 0.0), (0.8, 0.4), (-1.0, -0.3)])
def test_a_turn_shows_the_scale(x64, lever_arm, side, reverse):
    world = drive(512, 1, seed=17, lever_arm=lever_arm, side=side, mounted=True, reverse=reverse)
    found = scales(world, lever_arm)
    assert found.valid.all()
    np.testing.assert_allclose(found.scale, np.linalg.norm(world["translation"], axis=-1), rtol=1e-7)


def test_scale_from_two_points(x64):
    # The chain that a vehicle would use: two correspondences, then the scale.
    world = drive(1024, 2, seed=18, theta=0.3, lever_arm=1.5)
    candidates = planar_first(world["rays0"], world["rays1"], world["up"], world["up"])
    errors = []
    for slot in range(2):
        found = scales(world, 1.5, SE3(candidates.models.wxyz_xyz[:, slot]))
        usable = np.asarray(candidates.valid[:, slot]) & found.valid
        errors.append(np.where(usable, np.abs(found.scale - np.linalg.norm(world["translation"], axis=-1)), np.inf))
    assert (np.min(errors, axis=0) < 1e-6).mean() > 0.99


def test_sensitivity_predicts_the_error_of_the_scale(x64):
    # Noise of a tenth of a millirad on heading and direction, for turns of 2 to 20 degrees.
    rng = np.random.default_rng(19)
    for degrees in (2.0, 6.0, 20.0):
        world = drive(4000, 1, seed=19, theta=np.radians(degrees), lever_arm=1.5)
        truth = np.linalg.norm(world["translation"], axis=-1)
        turned = Rotation.from_rotvec(rng.normal(size=4000)[:, None] * [[0.0, 1e-4, 0.0]]).as_matrix()
        aside = Rotation.from_rotvec(rng.normal(size=4000)[:, None] * [[0.0, 1e-4, 0.0]]).as_matrix()
        world["rotation"] = np.einsum("bij,bjk->bik", turned, world["rotation"])
        # The direction is that in the half-way frame.
        half = Rotation.from_rotvec(0.5 * Rotation.from_matrix(turned).as_rotvec()).as_matrix()
        world["translation"] = np.einsum("bij,bjk,bk->bi", half, aside, world["translation"])
        found = scales(world, 1.5)
        relative = np.std(found.scale / truth - 1.0)
        np.testing.assert_allclose(relative, 1e-4 * np.median(found.sensitivity), rtol=0.1)


def test_straight_motion_shows_no_scale(dtype):
    for theta, lever_arm in ((0.0, 1.5), (0.2, 0.0), (1e-9, 1.5)):
        world = drive(64, 1, seed=20, theta=theta, lever_arm=lever_arm)
        poses = SE3(poses_of(world).parameters().astype(dtype))
        found = scale_first(
            poses, np.full(64, lever_arm).astype(dtype), world["forward"].astype(dtype), world["up"].astype(dtype)
        )
        if theta == 1e-9 and dtype == jnp.float64:
            assert np.asarray(found.sensitivity).min() > 1e8  # seen, and said to be worth nothing
        else:
            assert not np.asarray(found.valid).any()
            np.testing.assert_array_equal(found.scale, 0.0)
            np.testing.assert_array_equal(found.sensitivity, 0.0)


def test_contradictions_and_nonsense_show_no_scale(x64):
    world = drive(64, 1, seed=21, theta=0.2, lever_arm=1.5)
    assert not scales(world, -1.5).valid.any()  # it swings the other way
    for bad in (np.nan, np.inf, 0.0):
        found = scales(world, bad)
        assert not found.valid.any()
        assert np.isfinite(found.scale).all()
    poses = np.asarray(poses_of(world).parameters()).copy()
    poses[:, 4] = np.nan
    assert not scales(world, 1.5, SE3(jnp.asarray(poses))).valid.any()
    poses[:, 4:] = 0.0
    assert not scales(world, 1.5, SE3(jnp.asarray(poses))).valid.any()


def test_gradient_of_the_scale(x64):
    world = drive(4, 1, seed=22, theta=0.2, lever_arm=1.5)

    def scale(parameters, arm):
        return scale_from_turn(SE3(parameters), arm).scale

    for parameters in np.asarray(poses_of(world).parameters()):
        reverse = jax.grad(scale, (0, 1))(parameters, 1.5)
        steps = 1e-6 * np.eye(7)
        numeric = [(scale(parameters + s, 1.5) - scale(parameters - s, 1.5)) / 2e-6 for s in steps]
        np.testing.assert_allclose(reverse[0], numeric, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(reverse[1], scale(parameters, 1.5) / 1.5, rtol=1e-12)
    for nonsense in (np.zeros(7), np.eye(7)[0], np.full(7, np.nan)):
        assert all(np.isfinite(x).all() for x in jax.grad(scale, (0, 1))(jnp.asarray(nonsense), 1.5))
