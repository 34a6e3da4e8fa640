"""Windowed bundle adjustment against dense least squares in numpy and against simulated truth."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.stats

from vojax import SE3, Result
from vojax.ba import GemanMcClure, Huber, LMOptions, Squared, adjust_window
from vojax.cameras import Pinhole, RectifiedStereo
from vojax.datasets import simulate_stereo_window

C, P, B = 3, 20, 16  # one shape for all windows
FOCAL, CENTER, BASELINE = 400.0, np.array([319.5, 119.5]), 0.54
TIGHT = LMOptions(max_steps=60, tolerance=1e-22)


@functools.partial(jax.jit, static_argnames=("options", "pixels_only"))
def adjust(window, loss, options=LMOptions(), pixels_only=False):
    """Adjust B windows."""
    camera = Pinhole(fx=FOCAL, fy=FOCAL, cx=CENTER[0], cy=CENTER[1])

    def one(window):
        return adjust_window(
            window["poses"],
            window["points"],
            window["measurements"][..., :2] if pixels_only else window["measurements"],
            window["mask"],
            camera if pixels_only else RectifiedStereo(camera, BASELINE),
            fixed=window["fixed"],
            loss=loss,
            options=options,
        )

    return jax.vmap(one)(window)


def simulate(seed, sigma_px=1.0, outlier_fraction=0.0, dtype=jnp.float32, spread=0.05):
    """B windows, started from poses and landmarks beside the truth; (windows, truth)."""
    keys = jax.random.split(jax.random.key(seed), B)
    simulated = jax.vmap(
        lambda key: simulate_stereo_window(
            key, C, P, sigma_px=sigma_px, outlier_fraction=outlier_fraction, depth_range=(4.0, 20.0), dtype=dtype
        )
    )(keys)
    rng = np.random.default_rng(seed)
    xi = rng.normal(size=(B, C, 6)) * spread * np.array([1, 1, 1, 0.2, 0.2, 0.2])
    xi[:, 0] = 0  # the first keyframe is fixed, at the truth
    noise = rng.normal(size=(B, P, 3)) * 2 * spread
    return {
        "poses": simulated.world_from_cam @ SE3.exp(jnp.asarray(xi, dtype)),
        "points": simulated.landmarks_world + jnp.asarray(noise, dtype),
        "measurements": simulated.observations,
        "mask": simulated.visible,
        "fixed": jnp.tile((jnp.arange(C) == 0)[None], (B, 1)),
    }, simulated


def matrices(pose):
    return np.asarray(pose.as_matrix(), np.float64)


def hat(xi):
    (a, b, c), matrix = xi[3:], np.zeros((4, 4))
    matrix[:3, :3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]]
    matrix[:3, 3] = xi[:3]
    return matrix


def tangent(world_from_cam, other):
    """ξ with `world_from_cam @ exp(ξ) == other`."""
    matrix = scipy.linalg.logm(np.linalg.inv(world_from_cam) @ other).real
    return np.array([*matrix[:3, 3], matrix[2, 1], matrix[0, 2], matrix[1, 0]])


# ---- the oracle: all unknowns at once, in numpy


class Dense:
    """Residuals of window i as a function of (ξ of the free cameras, landmark moves) about given values."""

    def __init__(self, windows, i, rho, poses=None, points=None):
        self.poses = matrices(windows["poses"])[i] if poses is None else poses
        self.points = np.asarray(windows["points"], float)[i] if points is None else points
        self.measurements, self.mask = np.asarray(windows["measurements"], float)[i], np.asarray(windows["mask"])[i]
        self.free = np.flatnonzero(~np.asarray(windows["fixed"])[i])
        self.seen = np.flatnonzero(self.mask.any(0))
        self.rho = rho
        self.size = 6 * len(self.free) + 3 * len(self.seen)

    def state(self, y):
        poses, points = self.poses.copy(), self.points.copy()
        for j, c in enumerate(self.free):
            poses[c] = poses[c] @ scipy.linalg.expm(hat(y[6 * j : 6 * j + 6]))
        points[self.seen] += y[6 * len(self.free) :].reshape(-1, 3)
        return poses, points

    def __call__(self, y):
        poses, points = self.state(y)
        inverse = np.linalg.inv(poses)
        x, y_, z = np.moveaxis(np.einsum("cij,pj->cpi", inverse[:, :3, :3], points) + inverse[:, None, :3, 3], -1, 0)
        projected = np.stack(
            [FOCAL * x / z + CENTER[0], FOCAL * y_ / z + CENTER[1], FOCAL * (x - BASELINE) / z + CENTER[0]], -1
        )
        raw = (projected - self.measurements)[self.mask]
        s = np.sum(raw**2, axis=1)
        return (raw * np.sqrt(self.rho(s) / np.maximum(s, 1e-300))[:, None]).ravel()

    def jacobian(self, y, h=1e-6):
        steps = h * np.eye(self.size)
        return np.stack([(self(y + e) - self(y - e)) / (2 * h) for e in steps], axis=1)


def squared(s):
    return s


def huber(s):
    return np.where(s <= 1.345**2, s, 2 * 1.345 * np.sqrt(s) - 1.345**2)


@pytest.fixture(scope="module")
def noisy():
    """Windows in float64 with noise of 1 px, and their adjustment."""
    with jax.enable_x64(True):
        windows, truth = simulate(0, dtype=jnp.float64)
        return windows, truth, adjust(windows, Squared(), TIGHT)


def check_optimum(windows, found, i, rho):
    dense = Dense(windows, i, rho)
    start = dense(np.zeros(dense.size))
    assert found.initial_cost[i] == pytest.approx(0.5 * start @ start, rel=1e-9)
    solution = scipy.optimize.least_squares(
        dense, np.zeros(dense.size), jac=dense.jacobian, method="lm", ftol=1e-15, xtol=1e-15, gtol=1e-15, x_scale="jac"
    )
    poses, points = dense.state(solution.x)
    assert found.cost[i] == pytest.approx(solution.cost, rel=1e-9)
    for c in range(C):
        assert np.abs(tangent(poses[c], matrices(found.world_from_cam)[i, c])).max() < 1e-6
    np.testing.assert_allclose(found.points_world[i], points, atol=1e-5)


def test_the_optimum_is_that_of_dense_least_squares(noisy, x64):
    windows, _, found = noisy
    for i in (0, 5):
        assert (found.result == Result.success)[i]
        check_optimum(windows, found, i, squared)


@pytest.mark.slow
def test_the_robust_optimum_too(x64):
    windows, _ = simulate(1, sigma_px=1.5, dtype=jnp.float64)
    found = adjust(windows, Huber(), TIGHT)
    for i in (0, 5):
        check_optimum(windows, found, i, huber)


def test_covariances_are_blocks_of_the_dense_inverse(noisy, x64):
    windows, _, found = noisy
    poses, points = matrices(found.world_from_cam)[3], np.asarray(found.points_world)[3]
    dense = Dense(windows, 3, squared, poses, points)
    rows = dense.jacobian(np.zeros(dense.size))
    inverse = np.linalg.inv(rows.T @ rows)
    for j, c in enumerate(dense.free):
        block = inverse[6 * j : 6 * j + 6, 6 * j : 6 * j + 6]
        scale = np.sqrt(np.outer(np.diag(block), np.diag(block)))
        np.testing.assert_allclose(np.asarray(found.pose_covariances[3, c]) / scale, block / scale, atol=1e-5)
    assert np.all(np.asarray(found.pose_covariances[3, 0]) == 0)


def test_fixed_keyframes_do_not_move(noisy, x64):
    windows, _, found = noisy
    np.testing.assert_allclose(matrices(found.world_from_cam)[:, 0], matrices(windows["poses"])[:, 0], atol=1e-14)
    other = {**windows, "fixed": jnp.tile(jnp.array([[True, False, True]]), (B, 1))}
    found = adjust(other, Squared(), TIGHT)
    before, after = matrices(windows["poses"]), matrices(found.world_from_cam)
    np.testing.assert_allclose(after[:, [0, 2]], before[:, [0, 2]], atol=1e-14)
    assert np.abs(after[:, 1] - before[:, 1]).max(axis=(1, 2)).min() > 1e-4
    assert np.all(np.asarray(found.pose_covariances)[:, [0, 2]] == 0)


def test_without_noise_the_truth_comes_back(x64):
    windows, truth = simulate(2, sigma_px=0.0, dtype=jnp.float64)
    found = adjust(windows, Squared(), TIGHT)
    assert np.all(found.cost < 1e-16)
    np.testing.assert_allclose(matrices(found.world_from_cam), matrices(truth.world_from_cam), atol=1e-9)
    seen = np.asarray(windows["mask"]).any(1)
    np.testing.assert_allclose(np.asarray(found.points_world)[seen], np.asarray(truth.landmarks_world)[seen], atol=1e-7)


@pytest.mark.slow
def test_errors_follow_the_covariance(x64):
    # The last keyframe's NEES over 320 windows, against the 99.9 % band of χ² with six degrees of freedom; seeds fixed.
    # Half a pixel, so that linearisation at a few metres of depth does not show.
    values = []
    for seed in range(40, 60):
        windows, truth = simulate(seed, sigma_px=0.5, dtype=jnp.float64)
        found = adjust(windows, Squared(), TIGHT)
        assert np.all(found.result == Result.success)
        ours, true = matrices(found.world_from_cam)[:, -1], matrices(truth.world_from_cam)[:, -1]
        # The measurements were taken as 1 px: the covariance of 0.5 px is a quarter.
        covariances = 0.25 * np.asarray(found.pose_covariances)[:, -1]
        for pose, expected, covariance in zip(ours, true, covariances, strict=True):
            error = tangent(pose, expected)
            values.append(error @ np.linalg.solve(covariance, error))
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 6 * len(values)) / len(values)
    assert low < np.mean(values) < high


# ---- float32, one program with Huber's loss


@pytest.fixture(scope="module")
def single():
    windows, truth = simulate(3)
    return windows, truth, adjust(windows, Huber())


@pytest.mark.slow
def test_float32_converges(single):
    _, truth, found = single
    assert np.all(found.result == Result.success)
    assert np.all(found.cost < found.initial_cost)
    errors = [
        np.abs(tangent(pose, expected)).max()
        for pose, expected in zip(
            matrices(found.world_from_cam)[:, -1], matrices(truth.world_from_cam)[:, -1], strict=True
        )
    ]
    assert np.median(errors) < 0.1


def test_masked_entries_do_not_matter(single):
    windows, _, found = single
    mask = np.asarray(windows["mask"])
    unseen = ~mask.any(1)
    windows = {
        **windows,
        "measurements": jnp.where(mask[..., None], windows["measurements"], 777.0),
        "points": jnp.where(unseen[..., None], 55.0, windows["points"]),
    }
    again = adjust(windows, Huber())
    for one, other in zip(
        jax.tree.leaves((found.world_from_cam, found.cost, found.pose_covariances)),
        jax.tree.leaves((again.world_from_cam, again.cost, again.pose_covariances)),
        strict=True,
    ):
        assert np.array_equal(one, other)
    # A landmark that nothing saw is where it was.
    np.testing.assert_allclose(np.asarray(again.points_world)[unseen], 55.0, atol=1e-4)


@pytest.mark.slow
def test_padding_changes_nothing(single):
    windows, _, found = single
    padded = {
        **windows,
        "points": jnp.pad(windows["points"], ((0, 0), (0, 8), (0, 0)), constant_values=3.0),
        "measurements": jnp.pad(windows["measurements"], ((0, 0), (0, 0), (0, 8), (0, 0))),
        "mask": jnp.pad(windows["mask"], ((0, 0), (0, 0), (0, 8))),
    }
    again = adjust(padded, Huber())
    np.testing.assert_allclose(again.cost, found.cost, rtol=1e-4)
    np.testing.assert_allclose(matrices(again.world_from_cam), matrices(found.world_from_cam), atol=5e-4)
    np.testing.assert_allclose(again.points_world[:, P:], 3.0, atol=1e-5)


def test_the_answer_does_not_depend_on_where_the_world_begins(single):
    windows, _, found = single
    # 5 km away float32 resolves 0.5 mm. The shift is a multiple of it, so the start differs only by that rounding.
    shift = jnp.array([4096.0, -2560.0, 128.0])
    move = lambda wxyz_xyz: wxyz_xyz.at[..., 4:].add(shift)  # noqa: E731
    far = {**windows, "poses": SE3(move(windows["poses"].wxyz_xyz)), "points": windows["points"] + shift[None, None]}
    again = adjust(far, Huber())
    assert np.all(again.result == Result.success)
    ours, expected = matrices(again.world_from_cam), matrices(found.world_from_cam)
    np.testing.assert_allclose(ours[..., :3, :3], expected[..., :3, :3], atol=1e-4)
    np.testing.assert_allclose(ours[..., :3, 3] - np.asarray(shift), expected[..., :3, 3], atol=1e-3)
    np.testing.assert_allclose(again.cost, found.cost, rtol=1e-3)
    scale = np.sqrt(np.trace(found.pose_covariances, axis1=2, axis2=3))[..., None, None] ** 2 + 1e-12
    np.testing.assert_allclose(again.pose_covariances / scale, found.pose_covariances / scale, atol=1e-2)


@pytest.fixture(scope="module")
def degenerate(single):
    """Windows that lack something, in the first places; (windows, adjusted)."""
    windows, _, _ = single
    mask = np.array(windows["mask"])
    mask[0] = False
    mask[1, 2] = False  # a free keyframe that sees nothing
    mask[2] &= np.arange(P) < 1
    points = np.array(windows["points"])
    points[3] = points[3, :1]
    points[4] = -points[4]  # behind
    measurements = np.array(windows["measurements"])
    measurements[5] = 0.0
    measurements[6] = 1e6
    changed = {"mask": jnp.asarray(mask), "points": jnp.asarray(points), "measurements": jnp.asarray(measurements)}
    windows = {**windows, **changed}
    return windows, adjust(windows, Huber())


def test_degenerate_windows_stay_finite(degenerate):
    windows, found = degenerate
    for leaf in jax.tree.leaves((found.world_from_cam, found.points_world, found.pose_covariances, found.cost)):
        assert np.isfinite(leaf).all()
    rotation = matrices(found.world_from_cam)[..., :3, :3]
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, -1, -2), np.tile(np.eye(3), (B, C, 1, 1)), atol=1e-5)
    # Nothing seen, nothing moved; a keyframe that sees nothing stays.
    ours, before = matrices(found.world_from_cam), matrices(windows["poses"])
    np.testing.assert_allclose(ours[0], before[0], atol=1e-5)
    np.testing.assert_allclose(found.points_world[0], windows["points"][0], atol=1e-4)
    np.testing.assert_allclose(ours[1, 2], before[1, 2], atol=1e-5)
    for i in (0, 1):
        assert np.all(np.asarray(found.pose_covariances[i, 2]) == 0)
    assert np.all((found.result == Result.success)[7:])


@pytest.mark.parametrize("index", [0, 1], ids=["nothing seen", "one blind keyframe"])
def test_undetermined_keyframes_are_reported(index, degenerate):
    _, found = degenerate
    assert (found.result == Result.degenerate)[index]


def test_a_window_with_one_landmark_is_reported(degenerate):
    _, found = degenerate
    assert (found.result == Result.degenerate)[2]
    assert np.all(np.asarray(found.pose_covariances[2]) == 0)


@pytest.mark.slow
def test_pixels_alone_leave_the_scale_free(x64):
    windows, _ = simulate(4, dtype=jnp.float64)
    found = adjust(windows, Squared(), TIGHT, pixels_only=True)
    assert np.all(found.result == Result.degenerate)
    two = {**windows, "fixed": jnp.tile(jnp.array([[True, True, False]]), (B, 1))}
    found = adjust(two, Squared(), TIGHT, pixels_only=True)
    assert np.mean(found.result == Result.success) > 0.8


@pytest.mark.slow
def test_a_robust_loss_resists_outliers(single):
    windows, truth = simulate(6, outlier_fraction=0.1)
    expected = matrices(truth.world_from_cam)[:, -1]

    def error(loss, start=windows):
        found = adjust(start, loss)
        poses = matrices(found.world_from_cam)[:, -1]
        return found, np.array([np.linalg.norm(tangent(a, b)[:3]) for a, b in zip(poses, expected, strict=True)])

    _, plain = error(Squared())
    first, huber_ = error(Huber())
    start = {**windows, "poses": first.world_from_cam, "points": first.points_world}
    _, redescending = error(GemanMcClure(4.0), start)
    assert np.median(huber_) < 0.5 * np.median(plain)
    assert np.median(redescending) < 0.2


@pytest.mark.slow
def test_the_derivative_is_that_of_the_optimum(x64):
    windows, _ = simulate(0, dtype=jnp.float64)
    rng = np.random.default_rng(0)
    by_pose, by_point = rng.normal(size=(C, 3, 4)), rng.normal(size=(P, 3))
    window = jax.tree.map(lambda x: x[:1], windows)

    @jax.jit
    @jax.value_and_grad
    def readout(measurements):
        found = adjust({**window, "measurements": measurements[None]}, Huber(), TIGHT)
        poses = found.world_from_cam.as_matrix()[0, :, :3]
        return jnp.sum(poses * jnp.asarray(by_pose)) + 0.1 * jnp.sum(found.points_world[0] * jnp.asarray(by_point))

    measurements = window["measurements"][0]
    _, gradient = readout(measurements)
    assert np.all(np.asarray(gradient)[~np.asarray(window["mask"])[0]] == 0)
    for _ in range(3):
        direction = rng.normal(size=measurements.shape)
        h = 1e-3
        values = [float(readout(measurements + step * direction)[0]) for step in (h, -h, h / 2, -h / 2)]
        difference = (4 * (values[2] - values[3]) / h - (values[0] - values[1]) / (2 * h)) / 3
        assert np.sum(np.asarray(gradient) * direction) == pytest.approx(difference, rel=1e-6)


def test_shapes_that_do_not_fit_are_said_in_one_line():
    camera = RectifiedStereo(Pinhole(fx=FOCAL, fy=FOCAL, cx=CENTER[0], cy=CENTER[1]), BASELINE)
    poses = SE3(jnp.tile(jnp.array([[1.0, 0, 0, 0, 0, 0, 0]]), (2, 1)))
    measurements, mask = np.zeros((3, 5, 3), np.float32), np.ones((3, 5), bool)
    with pytest.raises(ValueError, match="window shapes do not fit") as caught:
        adjust_window(poses, np.zeros((5, 3), np.float32), measurements, mask, camera)
    assert "\n" not in str(caught.value)


def test_more_windows_than_lanes_end_as_they_do_a_few_at_a_time():
    parts = [simulate(seed, spread=spread)[0] for seed, spread in ((31, 0.0), (32, 0.3), (33, 0.05))]
    together = adjust(jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts), Squared())
    apart = [adjust(part, Squared()) for part in parts]
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *apart)
    assert np.ptp(joined.iterations) >= 2  # lanes are taken over at different times
    assert np.max(np.abs(together.iterations - joined.iterations)) <= 1  # rounding differs between the two programs
    np.testing.assert_array_equal(together.result == Result.success, joined.result == Result.success)
    resolved = 256 * float(jnp.finfo(jnp.float32).eps)  # the tolerance at which a float32 solve ends
    np.testing.assert_allclose(together.cost, joined.cost, rtol=resolved)
    np.testing.assert_allclose(together.world_from_cam.wxyz_xyz, joined.world_from_cam.wxyz_xyz, atol=2e-5)


@pytest.mark.slow
def test_many_windows_may_start_from_the_same_poses():
    window, _ = simulate(34)
    stereo = RectifiedStereo(Pinhole(fx=FOCAL, fy=FOCAL, cx=CENTER[0], cy=CENTER[1]), BASELINE)
    poses, points = jax.tree.map(lambda leaf: leaf[0], (window["poses"], window["points"]))
    measured = window["measurements"][0][None] + jnp.arange(20.0)[:, None, None, None] * 0.01

    def cost(poses, measurements):
        return adjust_window(poses, points, measurements, window["mask"][0], stereo).cost

    shared = jax.vmap(cost, in_axes=(None, 0))(poses, measured)
    alone = jax.vmap(cost)(jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (20, *leaf.shape)), poses), measured)
    np.testing.assert_allclose(shared, alone, rtol=1e-6)
