import functools

import jax
import numpy as np
import pytest

from tests.solvers.problems import lanes
from tests.solvers.vehicles import drive
from vojax.solvers import one_point_histogram


@functools.cache
def vote():
    return jax.jit(jax.vmap(one_point_histogram))


@pytest.mark.parametrize("mounted", [False, True])
def test_vote_stands_sixty_percent_outliers(dtype, mounted):
    world = drive(64, 200, seed=23, outliers=0.6, sigma=3e-4, mounted=mounted)
    found = vote()(*(world[x].astype(dtype) for x in ("rays0", "rays1", "forward", "up")))
    keep = np.abs(world["theta"]) < 0.48
    assert keep.sum() > 55
    assert np.asarray(found.valid).all()
    error = np.abs(np.asarray(found.theta, np.float64) - world["theta"])[keep]
    # 80 inliers of 3e-4 rad, and the outliers that agree by chance.
    assert np.median(error) < 1e-3
    assert error.max() < 5e-3
    share = np.asarray(found.inlier_share)[keep]
    assert share.min() > 0.38
    assert np.median(share) < 0.5
    inliers = np.asarray(found.inliers)[keep]
    assert inliers[~world["outliers"][keep]].mean() > 0.97
    assert inliers[world["outliers"][keep]].mean() < 0.15


def test_vote_without_noise_is_exact(x64):
    world = drive(16, 200, seed=24, outliers=0.3, theta=np.linspace(-0.45, 0.45, 16))
    found = vote()(world["rays0"], world["rays1"], world["forward"], world["up"])
    assert np.abs(np.asarray(found.theta) - world["theta"]).max() < 1e-3
    clean = drive(16, 200, seed=24, theta=np.linspace(-0.45, 0.45, 16))
    found = vote()(clean["rays0"], clean["rays1"], clean["forward"], clean["up"])
    np.testing.assert_allclose(found.theta, clean["theta"], atol=1e-12)
    np.testing.assert_allclose(found.inlier_share, 1.0)


def test_vote_finds_straight_motion_and_wide_turns(x64):
    wide = jax.jit(jax.vmap(functools.partial(one_point_histogram, max_turn=np.pi)))
    world = drive(16, 200, seed=25, theta=np.linspace(-3.0, 3.0, 16), outliers=0.2)
    found = wide(world["rays0"], world["rays1"], world["forward"], world["up"])
    assert np.abs(np.asarray(found.theta) - world["theta"]).max() < 2e-3
    straight = drive(16, 200, seed=26, theta=0.0)
    found = vote()(straight["rays0"], straight["rays1"], straight["forward"], straight["up"])
    assert np.abs(np.asarray(found.theta)).max() < 1e-12


def test_vote_of_the_unusable(dtype):
    world = drive(6, 200, seed=27, theta=0.1, sigma=1e-4)
    rays0, rays1, forward, up = (world[x].copy() for x in ("rays0", "rays1", "forward", "up"))
    rays0[0] = np.nan
    rays0[1, :, 1], rays1[1, :, 1] = 0.0, 0.0
    up[2] = forward[2]
    rays1[3] = 0.0
    rays0[4, :150], rays1[4, :50] = np.nan, np.inf
    found = vote()(*(x.astype(dtype) for x in (rays0, rays1, forward, up)))
    np.testing.assert_array_equal(found.valid, [False, False, False, False, True, True])
    np.testing.assert_array_equal(np.asarray(found.inliers).any(axis=-1), found.valid)
    np.testing.assert_array_equal(np.asarray(found.theta)[:4], 0.0)
    np.testing.assert_allclose(np.asarray(found.theta)[4:], 0.1, atol=1e-3)
    np.testing.assert_allclose(np.asarray(found.inlier_share)[4:], 1.0)
    assert not np.asarray(found.inliers)[4, :150].any()


def test_mask_leaves_correspondences_out(x64):
    world = drive(1, 200, seed=28, theta=0.2, outliers=0.6)
    found = one_point_histogram(world["rays0"][0], world["rays1"][0], mask=~world["outliers"][0])
    np.testing.assert_allclose(found.theta, 0.2, atol=1e-12)
    assert found.inlier_share == 1.0
    assert not found.inliers[world["outliers"][0]].any()
    none = one_point_histogram(world["rays0"][0], world["rays1"][0], mask=np.zeros(200, bool))
    assert not none.valid
    assert none.inlier_share == 0.0


@pytest.mark.slow
def test_gradient_of_the_vote(x64):
    world = drive(1, 40, seed=29, theta=0.1, outliers=0.25, sigma=2e-4, mounted=True)
    data = [world[x][0] for x in ("rays0", "rays1", "forward", "up")]
    angle = jax.jit(lambda *data: one_point_histogram(*data).theta)
    reverse = jax.jit(jax.grad(angle, range(4)))(*data)
    rng = np.random.default_rng(29)
    for index in range(4):
        direction = rng.normal(size=data[index].shape)
        ends = [angle(*data[:index], data[index] + s * direction, *data[index + 1 :]) for s in (1e-7, -1e-7)]
        numeric = (ends[0] - ends[1]) / 2e-7
        np.testing.assert_allclose(np.sum(reverse[index] * direction), numeric, rtol=1e-6, atol=1e-7)
        ahead = jax.jvp(angle, data, [direction if i == index else np.zeros_like(x) for i, x in enumerate(data)])[1]
        np.testing.assert_allclose(ahead, np.sum(reverse[index] * direction), rtol=1e-9, atol=1e-12)
    bad = [x.copy() for x in data]
    bad[0][3], bad[1][7] = np.nan, 0.0
    assert all(np.isfinite(x).all() for x in jax.jit(jax.grad(angle, range(4)))(*bad))


def test_vote_on_the_last_axis(x64):
    world = drive(8, 200, seed=30, outliers=0.4)
    data = [world[x] for x in ("rays0", "rays1", "forward", "up")]
    last = jax.vmap(one_point_histogram, in_axes=-1, out_axes=-1)(*lanes(*data, dtype=np.float64))
    first = vote()(*data)
    np.testing.assert_allclose(last.theta, first.theta, atol=1e-12)
    np.testing.assert_array_equal(np.moveaxis(np.asarray(last.inliers), -1, 0), first.inliers)
