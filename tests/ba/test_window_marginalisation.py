"""Marginalised windows against batch solutions, against dense normal equations, and against simulated truth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from vojax.ba import LMOptions, Squared, WindowPrior, adjust_window, marginalize_oldest
from vojax.cameras import Pinhole, RectifiedStereo
from vojax.datasets import motion_profile
from vojax.lie import SE3

C, NEW, TRACK, FRAMES = 4, 12, 3, 8  # window, landmarks that begin in a frame, frames that see one, frames
P = 2 * C * NEW  # slots of a window
TIGHT = LMOptions(max_steps=20, tolerance=1e-22)


def stereo(dtype):
    focal, cx, cy, baseline = (jnp.asarray(value, dtype) for value in (400.0, 319.5, 119.5, 0.54))
    return RectifiedStereo(Pinhole(fx=focal, fy=focal, cx=cx, cy=cy), baseline)


def drive(seed, sigma_px):
    """Poses, landmarks, measurements and mask of a short drive, float64; landmark j begins in frame j // NEW."""
    rng = np.random.default_rng(seed)
    poses = motion_profile(FRAMES, key=jax.random.key(seed), dtype=jnp.float64)
    count = FRAMES * NEW
    begin = np.arange(count) // NEW
    u, v, z = rng.uniform(120, 600, count), rng.uniform(0, 239, count), rng.uniform(6, 20, count)
    local = jnp.asarray(np.stack([(u - 319.5) / 400 * z, (v - 119.5) / 400 * z, z], axis=1))
    points = SE3(poses.wxyz_xyz[begin]).apply(local)
    exact = stereo(jnp.float64).project(SE3(poses.inverse().wxyz_xyz[:, None]).apply(points[None]))
    frames = np.arange(FRAMES)[:, None]
    mask = (frames >= begin) & (frames < begin + TRACK)
    return poses, np.asarray(points), np.asarray(exact) + sigma_px * rng.normal(size=exact.shape), mask


@jax.jit
def adjusted(poses, points, measurements, mask, prior, sigma_px):
    return adjust_window(
        poses, points, measurements, mask, stereo(points.dtype), sigma_px=sigma_px, prior=prior, loss=Squared(),
        options=TIGHT,
    )  # fmt: skip


@jax.jit
def marginalized(poses, points, measurements, mask, prior, sigma_px):
    return marginalize_oldest(
        poses, points, measurements, mask, stereo(points.dtype), sigma_px=sigma_px, prior=prior, loss=Squared()
    )


def slide(poses, points, measurements, mask, sigma_px, dtype=jnp.float64, noise=0.0):
    """Window after window along a drive; the last window, the prior it used, and the one it leaves."""
    estimate = np.array(poses.wxyz_xyz, float)
    points, alive, prior = np.array(points), np.ones(len(points), bool), None
    begin = np.arange(len(points)) // NEW
    rng = np.random.default_rng(99)
    for k in range(FRAMES - C + 1):
        frames, use = slice(k, k + C), np.flatnonzero((begin >= k - C) & (begin < k + C))
        pad = P - len(use)
        seen = np.pad((mask[frames] & alive)[:, use], ((0, 0), (0, pad)))
        window = SE3(jnp.asarray(estimate[frames], dtype))
        shake = noise * rng.normal(size=(C, 6)) * (np.arange(C) == C - 1)[:, None]
        window = window @ SE3.exp(jnp.asarray(shake, dtype))
        before = WindowPrior.none(window) if prior is None else prior
        data = (
            jnp.asarray(np.pad(measurements[frames][:, use], ((0, 0), (0, pad), (0, 0))), dtype),
            seen,
            before,
            jnp.asarray(sigma_px, dtype),
        )
        start = jnp.asarray(np.pad(points[use], ((0, pad), (0, 0)), constant_values=5.0), dtype)
        found = adjusted(window, start, *data)
        prior = marginalized(found.world_from_cam, found.points_world, *data)
        estimate[frames] = found.world_from_cam.wxyz_xyz
        points[use] = np.asarray(found.points_world)[: len(use)]
        alive[use[(seen[0] & ~seen[-1])[: len(use)]]] = False
    return found, before, prior


def relative(poses, i, j):
    return SE3(poses.wxyz_xyz[i]).inverse() @ SE3(poses.wxyz_xyz[j])


def difference(one, other):
    return np.abs(np.asarray((one.inverse() @ other).log())).max()


def null_space(prior):
    """Directions in which all keyframes of a prior move together."""
    rows = [
        SE3(pose).inverse().adjoint() * active
        for pose, active in zip(prior.world_from_cam.wxyz_xyz, prior.active, strict=True)
    ]
    return np.linalg.qr(np.concatenate([np.asarray(row, float) for row in rows]))[0]


@pytest.fixture(scope="module")
def slid():
    """By noise: error of the batch, and how far the last window is from it, newest against oldest keyframe."""
    with jax.enable_x64(True):
        results = {}
        for sigma_px in (1.0, 1e-2):
            poses, points, measurements, mask = drive(0, sigma_px)
            batch = adjusted(poses, points, measurements, mask, None, jnp.asarray(sigma_px))
            found, before, after = slide(poses, points, measurements, mask, sigma_px)
            expected = relative(batch.world_from_cam, -C, -1)
            error = difference(relative(poses, -C, -1), expected)
            results[sigma_px] = (error, difference(expected, relative(found.world_from_cam, 0, -1)), before, after)
        return results


@pytest.mark.slow
def test_the_last_window_is_that_of_the_whole_drive(slid):
    # What differs is of second order, linearisation at the estimates of then, and falls with the square of the noise.
    error, apart, *_ = slid[1.0]
    assert apart < 2e-3 * error
    error, apart, *_ = slid[1e-2]
    assert error > 1e-4
    assert apart < 1e-7


def test_the_prior_does_not_know_where_the_world_begins(slid, x64):
    # After five windows at a pixel of noise: six directions without information, and no more.
    _, _, before, after = slid[1.0]
    for prior in (before, after):
        rows = np.asarray(prior.factor).reshape(-1, 6 * C)
        together = null_space(prior)
        assert np.abs(rows @ together).max() < 1e-11 * np.abs(rows).max()
        values = np.linalg.svd(rows)[1]
        active = int(np.sum(prior.active))
        assert active >= 2
        assert values[6 * active - 7] > 1e-4 * values[0]
        assert values[6 * active - 6] < 1e-11 * values[0]


def test_rows_equal_the_schur_complement_of_dense_normal_equations(x64):
    # An independent route: JᵀJ of everything that leaves, by central differences, eliminated by a dense inverse.
    poses, points, measurements, mask = drive(1, 0.5)
    rows, use = slice(0, C), np.arange(P)
    window = SE3(poses.wxyz_xyz[rows])
    seen = mask[rows][:, use]
    data = (jnp.asarray(points[use]), jnp.asarray(measurements[rows][:, use]), seen)
    prior = marginalized(window, *data, WindowPrior.none(window), jnp.asarray(0.5))
    leaving = np.flatnonzero(seen[0] & ~seen[-1])
    assert len(leaving) == NEW

    @jax.jit
    def residual(y):
        moved = window @ SE3.exp(y[: 6 * C].reshape(C, 6))
        landmarks = jnp.asarray(points[use][leaving]) + y[6 * C :].reshape(-1, 3)
        seen_at = stereo(jnp.float64).project(SE3(moved.inverse().wxyz_xyz[:, None]).apply(landmarks[None]))
        weighted = (seen_at - measurements[rows][:, use][:, leaving]) / 0.5
        return (weighted * seen[:, leaving][..., None]).ravel()

    size = 6 * C + 3 * len(leaving)
    columns = [(residual(1e-6 * e) - residual(-1e-6 * e)) / 2e-6 for e in np.eye(size)]
    jacobian, r = np.stack(columns, axis=1), np.asarray(residual(np.zeros(size)))
    gone = np.r_[0:6, 6 * C : size]
    kept = np.r_[6 : 6 * C]
    hessian, gradient = jacobian.T @ jacobian, jacobian.T @ r
    eliminate = hessian[np.ix_(kept, gone)] @ np.linalg.pinv(hessian[np.ix_(gone, gone)], hermitian=True)
    expected = hessian[np.ix_(kept, kept)] - eliminate @ hessian[np.ix_(gone, kept)]
    factor = np.asarray(prior.factor).reshape(-1, 6 * C)[:, : 6 * (C - 1)]
    np.testing.assert_allclose(factor.T @ factor, expected, atol=1e-6 * np.abs(expected).max())
    right = gradient[kept] - eliminate @ gradient[gone]
    np.testing.assert_allclose(factor.T @ np.asarray(prior.residual), right, atol=1e-6 * np.abs(gradient).max())
    assert not prior.active[-1]
    assert np.all(np.asarray(prior.factor)[:, -1] == 0)


@pytest.mark.slow
def test_without_measurements_the_prior_is_empty(dtype):
    window = SE3(jnp.tile(jnp.array([[1.0, 0, 0, 0, 0, 0, 0]], dtype), (C, 1)))
    prior = marginalize_oldest(
        window, jnp.ones((5, 3), dtype), jnp.zeros((C, 5, 3), dtype), np.zeros((C, 5), bool), stereo(dtype)
    )
    for leaf in jax.tree.leaves(prior):
        assert np.isfinite(np.asarray(leaf, float)).all()
    assert np.all(np.asarray(prior.factor) == 0)
    assert not np.any(prior.active)


def test_a_prior_on_the_first_pose_is_passed_on(x64):
    # Nobody is fixed; the second keyframe inherits what was known of the first.
    window = SE3(jnp.tile(jnp.array([[1.0, 0, 0, 0, 0, 0, 0]]), (C, 1)))
    covariance = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2
    prior = WindowPrior.of_first(window, covariance)
    information = np.asarray(prior.factor[:, 0].T @ prior.factor[:, 0])
    np.testing.assert_allclose(information, np.linalg.inv(covariance), rtol=1e-10)


@pytest.mark.slow
def test_errors_of_the_newest_keyframe_follow_its_covariance(x64):
    # NEES of newest against oldest keyframe in the last of five windows; 60 drives, a 99.9 % band, keys fixed.
    values = []
    for seed in range(100, 160):
        poses, points, measurements, mask = drive(seed, 0.3)
        found, *_ = slide(poses, points, measurements, mask, 0.3, noise=0.003)
        error = np.asarray((relative(found.world_from_cam, 0, -1).inverse() @ relative(poses, -C, -1)).log())
        values.append(error @ np.linalg.solve(np.asarray(found.pose_covariances[-1]), error))
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 6 * len(values)) / len(values)
    assert low < np.mean(values) < high


def test_float32_slides_ten_kilometres_from_the_origin(x64):
    poses, points, measurements, mask = drive(3, 0.5)
    shift = np.array([8192.0, 512.0, -6144.0])
    far = SE3(poses.wxyz_xyz.at[:, 4:].add(shift))
    double, *_ = slide(far, points + shift, measurements, mask, 0.5)
    single, _, prior = slide(far, points + shift, measurements, mask, 0.5, dtype=jnp.float32)
    assert single.world_from_cam.wxyz_xyz.dtype == jnp.float32
    ours, expected = relative(single.world_from_cam, 0, -1), relative(double.world_from_cam, 0, -1)
    apart = np.asarray((expected.inverse() @ ours).log())
    # Two positions as rounded there: at 8,192 m float32 counts in steps of 1 mm. Rotations do not know where they are.
    assert np.abs(apart[:3]).max() < np.spacing(np.float32(8192))
    assert np.abs(apart[3:]).max() < 1e-6
    rows = np.asarray(prior.factor, float).reshape(-1, 6 * C)
    assert np.abs(rows @ null_space(prior)).max() < 1e-3 * np.abs(rows).max()


def test_priors_that_do_not_fit_are_refused():
    window = SE3(jnp.tile(jnp.array([[1.0, 0, 0, 0, 0, 0, 0]]), (C, 1)))
    short = WindowPrior.none(SE3(window.wxyz_xyz[:2]))
    points, measurements, mask = np.ones((5, 3), np.float32), np.zeros((C, 5, 3), np.float32), np.zeros((C, 5), bool)
    with pytest.raises(ValueError, match="the prior is about 2 keyframes, the window has 4"):
        adjust_window(window, points, measurements, mask, stereo(jnp.float32), prior=short)
