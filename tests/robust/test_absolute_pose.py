"""The robust pose estimate: recall and accuracy against truth and PoseLib, bad input, covariance, derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from vojax import Result
from vojax.cameras import Pinhole
from vojax.datasets import simulate_absolute_pose
from vojax.metrics import nees
from vojax.robust import RansacOptions, estimate_absolute_pose

pytestmark = pytest.mark.optimized

B, N = 200, 100  # one program serves nearly every test: it solves B problems of N correspondences
CAMERA = {"fx": 800.0, "fy": 800.0, "cx": 639.5, "cy": 479.5}
THRESHOLD = 3.0


@jax.jit
def estimate(keys, points, pixels, mask, sigma_px):
    camera = Pinhole(**CAMERA)
    options = RansacOptions(threshold_px=THRESHOLD)

    def one(key, points, pixels, mask):
        return estimate_absolute_pose(points, pixels, camera, key=key, mask=mask, sigma_px=sigma_px, options=options)

    return jax.vmap(one)(keys, points, pixels, mask)


def simulate(seed, outlier_fraction, sigma_px=1.0):
    keys = jax.random.split(jax.random.key(seed), B)
    return jax.vmap(lambda key: simulate_absolute_pose(key, N, outlier_fraction=outlier_fraction, sigma_px=sigma_px))(
        keys
    )


def solve(problem, seed=0, mask=None, sigma_px=1.0):
    keys = jax.random.split(jax.random.key(100 + seed), B)
    mask = jnp.ones((B, N), bool) if mask is None else mask
    return estimate(keys, problem.points_world, problem.pixels, mask, jnp.float32(sigma_px))


def rotation_errors(matrices, truth):
    """Angles in radians between rotation matrices, accurate near zero."""
    return 2 * np.arcsin(np.clip(np.linalg.norm(matrices[:, :3, :3] - truth[:, :3, :3], axis=(1, 2)) / 8**0.5, 0, 1))


def pose_matrices(pose):
    return np.asarray(pose.as_matrix(), np.float64)


def centers(matrices):
    return -np.einsum("bji,bj->bi", matrices[:, :3, :3], matrices[:, :3, 3])


@pytest.fixture(scope="module")
def half_wrong():
    problem = simulate(1, 0.5)
    return problem, solve(problem)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_recalls_the_pose_and_its_inliers(share):
    problem = simulate(int(10 * share), share)
    found = solve(problem)
    matrices, truth = pose_matrices(found.model), pose_matrices(problem.cam_from_world)
    # With 30 good points at 1 px the rotation is known to about 0.05° and the position to 3 cm.
    good = (rotation_errors(matrices, truth) < np.radians(0.5)) & (
        np.linalg.norm(centers(matrices) - centers(truth), axis=1) < 0.3
    )
    assert np.mean(good) >= 0.995
    assert np.all((found.result == Result.success)[good])
    inliers, true = np.asarray(found.inliers), np.asarray(problem.inliers)
    # Noise of 1 px puts exp(−4.5) = 1.1 % of the inliers beyond 3 px; outliers come that near with 2e-5.
    assert 0.98 < inliers[good][true[good]].mean() < 0.998
    assert inliers[good][~true[good]].mean() < 1e-3
    assert np.array_equal(found.num_inliers, inliers.sum(axis=1))


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_is_as_accurate_as_poselib(share):
    import poselib

    problem = simulate(int(10 * share), share)
    found = pose_matrices(solve(problem).model)
    truth = pose_matrices(problem.cam_from_world)
    camera = {"model": "PINHOLE", "width": 1280, "height": 960, "params": list(CAMERA.values())}
    theirs = []
    for points, pixels in zip(np.asarray(problem.points_world, float), np.asarray(problem.pixels, float), strict=True):
        pose, _ = poselib.estimate_absolute_pose(pixels, points, camera, {"max_reproj_error": THRESHOLD}, {})
        theirs.append(np.vstack([pose.Rt, [0, 0, 0, 1]]))
    theirs = np.stack(theirs)
    assert np.median(rotation_errors(found, truth)) <= 1.1 * np.median(rotation_errors(theirs, truth))
    ours, peers = (np.linalg.norm(centers(pose) - centers(truth), axis=1) for pose in (found, theirs))
    assert np.median(ours) <= 1.1 * np.median(peers)


def test_the_same_key_gives_the_same_bits(half_wrong):
    problem, found = half_wrong
    again = solve(problem)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
        assert np.array_equal(one, other)


def test_another_key_gives_the_same_pose(half_wrong):
    problem, found = half_wrong
    other = solve(problem, seed=1)
    difference = rotation_errors(pose_matrices(found.model), pose_matrices(other.model))
    # A point at the threshold may change sides, which moves the pose by a fraction of its deviation.
    assert np.median(difference) < 1e-4
    assert np.mean(difference < 1e-3) >= 0.995
    assert np.mean(found.inliers == other.inliers) > 0.995


def test_what_is_masked_does_not_matter(half_wrong):
    problem, _ = half_wrong
    rng = np.random.default_rng(0)
    mask = rng.uniform(size=(B, N)) < 0.8
    found = solve(problem, mask=jnp.asarray(mask))
    assert not np.any(np.asarray(found.inliers) & ~mask)
    for filling in (0.0, 1e4, np.nan, np.inf):
        points = jnp.where(mask[..., None], problem.points_world, filling)
        pixels = jnp.where(mask[..., None], problem.pixels, filling)
        again = solve(problem._replace(points_world=points, pixels=pixels), mask=jnp.asarray(mask))
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
            assert np.array_equal(one, other), filling


def test_rows_that_are_not_numbers_count_as_masked(half_wrong):
    problem, _ = half_wrong
    broken = np.random.default_rng(1).uniform(size=(B, N)) < 0.1
    masked = solve(problem, mask=jnp.asarray(~broken))
    pixels = jnp.where(broken[..., None] & np.array([True, False])[None, None], jnp.nan, problem.pixels)
    unmasked = solve(problem._replace(pixels=pixels))
    for one, other in zip(jax.tree.leaves(masked), jax.tree.leaves(unmasked), strict=True):
        assert np.array_equal(one, other)


@pytest.mark.slow
def test_errors_follow_the_covariance():
    # A threshold of five deviations cuts no tail off, so NEES is χ² with six degrees of freedom: 99.9 % band of the
    # mean over 600 problems; seeds fixed.
    values = []
    for seed, share in ((21, 0.2), (22, 0.4), (23, 0.5)):
        problem = simulate(seed, share, sigma_px=THRESHOLD / 5)
        found = solve(problem, sigma_px=THRESHOLD / 5)
        assert np.all(found.result == Result.success)
        # ξ of `world_from_cam @ exp(ξ)`.
        xi = jax.vmap(lambda estimated, true: (estimated @ true.inverse()).log())(found.model, problem.cam_from_world)
        values.append(np.asarray(nees(xi, found.covariance)))
    values = np.concatenate(values)
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 6 * len(values)) / len(values)
    assert low < values.mean() < high
    assert scipy.stats.kstest(values, "chi2", args=(6,)).pvalue > 1e-3


@pytest.mark.slow
def test_the_stated_noise_scales_the_covariance(half_wrong):
    problem, found = half_wrong
    double = solve(problem, sigma_px=2.0)
    # It also says what is likely an outlier, so the pose moves, but by less than its noise.
    moved = jax.vmap(lambda a, b: (a @ b.inverse()).log())(double.model, found.model)
    assert np.max(nees(moved, double.covariance)) < 1.0
    ratio = np.trace(double.covariance, axis1=1, axis2=2) / np.trace(found.covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(ratio, 4.0, rtol=0.02)


# ---- bad input


@pytest.fixture(scope="module")
def broken():
    """Problems that have no answer, in the first places of one call; (problem, names, estimate)."""
    problem = simulate(1, 0.0)
    points, pixels = np.array(problem.points_world), np.array(problem.pixels)
    mask = np.ones((B, N), bool)
    names = ["nothing", "two", "three", "not a number", "infinite", "noise", "one point", "behind", "line"]
    mask[0] = False
    mask[1] = np.arange(N) < 2
    mask[2] = np.arange(N) < 3
    points[3] = np.nan
    truth = pose_matrices(problem.cam_from_world)
    points[7] = 2 * centers(truth)[7] - points[7]  # mirrored through the camera: right pixels, wrong side
    pixels[5] = np.random.default_rng(0).uniform([0, 0], [1280, 960], size=(N, 2))
    mask[5] = np.arange(N) < 6
    points[6], pixels[6] = points[6, :1], pixels[6, :1]
    along = np.linspace(-1, 1, N)[:, None] * np.array([[1.0, 0.3, 0.2]]) + np.array([[0.0, 0.0, 6.0]])
    points[8] = (along - truth[8, :3, 3]) @ truth[8, :3, :3]
    pixels[8] = along[:, :2] / along[:, 2:] * 800 + np.array([639.5, 479.5])
    pixels[4, 5:] = np.inf
    pixels[4, :2] = -np.inf
    problem = problem._replace(points_world=jnp.asarray(points), pixels=jnp.asarray(pixels))
    return problem, names, solve(problem, mask=jnp.asarray(mask))


def test_failures_have_a_code_and_an_empty_answer(broken):
    _, names, found = broken
    expected = {
        "nothing": Result.too_few,
        "two": Result.too_few,
        "three": Result.too_few,
        "not a number": Result.too_few,
        "infinite": Result.too_few,
        "noise": Result.no_consensus,
        "one point": Result.degenerate,
    }
    for i, name in enumerate(names[:7]):
        assert (found.result == expected[name])[i], name
        np.testing.assert_array_equal(found.model.wxyz_xyz[i], [1, 0, 0, 0, 0, 0, 0], err_msg=name)
        assert np.all(np.asarray(found.covariance[i]) == 0), name
        assert found.num_inliers[i] == 0
        assert not np.any(found.inliers[i])
    assert np.all((found.result == Result.success)[len(names) :])


def test_points_on_a_line_are_degenerate(broken):
    _, _, found = broken
    assert (found.result == Result.degenerate)[8]


def test_points_behind_the_camera_support_nothing(broken):
    problem, _, found = broken
    # Seen through the back of the camera a few points that are nearly in a plane agree with some pose in front of them.
    assert found.num_inliers[7] < 0.1 * N
    depths = problem.points_world[7] @ pose_matrices(found.model)[7, 2, :3] + pose_matrices(found.model)[7, 2, 3]
    assert np.all(np.asarray(depths)[np.asarray(found.inliers[7])] > 0)


def test_chance_is_no_consensus():
    assert np.mean(solve(simulate(77, 1.0)).result == Result.no_consensus) > 0.99


def test_nothing_is_ever_not_a_number(broken):
    _, _, found = broken
    for leaf in jax.tree.leaves((found.model, found.covariance, found.score)):
        assert np.isfinite(leaf).all()


def test_wrong_shapes_are_said_in_one_line():
    camera, key = Pinhole(**CAMERA), jax.random.key(0)
    cases = [
        ((8, 3), (7, 2), {}),
        ((8, 3), (8, 2), {"mask": np.ones(7, bool)}),
        ((8, 3), (8, 2), {"quality": np.ones(9, np.float32)}),
        ((8, 3), (8, 2), {"sigma_px": np.ones(9, np.float32)}),
        ((2, 3), (2, 2), {}),
    ]
    for points, pixels, more in cases:
        with pytest.raises((ValueError, TypeError)) as caught:
            estimate_absolute_pose(np.ones(points, np.float32), np.ones(pixels, np.float32), camera, key=key, **more)
        # Under pytest the type checker may speak first, at length.
        assert not isinstance(caught.value, ValueError) or "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("threshold_px", 0.0),
        ("threshold_px", -1.0),
        ("threshold_px", float("nan")),
        ("threshold", 0.0),
        ("confidence", 0.0),
        ("confidence", 1.0),
        ("max_hypotheses", 0),
        ("chunk_size", 0),
        ("top_k", 0),
        ("final_steps", -3),
    ],
)
def test_impossible_options_are_said_in_one_line(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}: expected") as caught:
        RansacOptions(**{name: value})
    assert "\n" not in str(caught.value)


def test_a_misspelt_option_is_an_error():
    with pytest.raises(TypeError, match="treshold_px"):
        RansacOptions(treshold_px=1.0)


# ---- programs of their own


@pytest.mark.slow
def test_quality_guides_the_sampling():
    # 80 % outliers and 64 samples: (1 − 0.2³)⁶⁴ = 60 % of the searches never draw three good points.
    problem = simulate(31, 0.8)
    keys = jax.random.split(jax.random.key(5), B)
    options = RansacOptions(threshold_px=THRESHOLD, max_hypotheses=64, chunk_size=64)

    @jax.jit
    def guided(points, pixels, quality):
        one = lambda key, x, u, q: estimate_absolute_pose(x, u, Pinhole(**CAMERA), key=key, quality=q, options=options)  # noqa: E731
        return jax.vmap(one)(keys, points, pixels, quality)

    noise = np.random.default_rng(0).normal(size=(B, N)).astype(np.float32)
    recall = {}
    for name, quality in (("informative", noise + 3.0 * np.asarray(problem.inliers)), ("noise", noise)):
        found = guided(problem.points_world, problem.pixels, jnp.asarray(quality, jnp.float32))
        errors = rotation_errors(pose_matrices(found.model), pose_matrices(problem.cam_from_world))
        recall[name] = np.mean(errors < np.radians(1.0))
    assert recall["noise"] < 0.55
    assert recall["informative"] > recall["noise"] + 0.2


@pytest.mark.slow
def test_padding_and_a_single_problem(half_wrong):
    problem, found = half_wrong
    points, pixels = np.asarray(problem.points_world[0]), np.asarray(problem.pixels[0])
    options = RansacOptions(threshold_px=THRESHOLD)
    key = jax.random.split(jax.random.key(100), B)[0]
    padded_points = np.concatenate([points, np.full((28, 3), np.nan, np.float32)])
    padded_pixels = np.concatenate([pixels, np.zeros((28, 2), np.float32)])
    mask = np.arange(N + 28) < N
    alone = estimate_absolute_pose(
        padded_points, padded_pixels, Pinhole(**CAMERA), key=key, options=options, mask=mask, sigma_px=1.0
    )
    assert np.array_equal(alone.inliers[:N], found.inliers[0])
    assert not np.any(alone.inliers[N:])
    np.testing.assert_allclose(alone.model.wxyz_xyz, found.model.wxyz_xyz[0], atol=2e-4)
    np.testing.assert_allclose(alone.covariance, found.covariance[0], rtol=0.02, atol=1e-8)


@pytest.fixture(scope="module")
def double():
    """A float64 problem, and value and gradient of a number that depends on the pose."""
    with jax.enable_x64(True):
        problem = simulate_absolute_pose(jax.random.key(3), 40, outlier_fraction=0.25, dtype=jnp.float64)
        weights = jnp.asarray(np.random.default_rng(0).normal(size=(3, 4)))

        def number(inputs):
            camera = Pinhole(fx=inputs["focal"], fy=inputs["focal"], cx=CAMERA["cx"], cy=CAMERA["cy"])
            found = estimate_absolute_pose(inputs["points"], inputs["pixels"], camera, key=jax.random.key(1))
            return jnp.sum(found.model.as_matrix()[:3] * weights), found

        inputs = {"points": problem.points_world, "pixels": problem.pixels, "focal": jnp.asarray(800.0)}
        return problem, inputs, jax.jit(jax.value_and_grad(number, has_aux=True))


@pytest.mark.slow
def test_float64_in_float64_out(double, x64):
    problem, inputs, value_and_grad = double
    (_, found), _ = value_and_grad(inputs)
    assert found.model.wxyz_xyz.dtype == found.covariance.dtype == jnp.float64
    xi = np.asarray((found.model @ problem.cam_from_world.inverse()).log())
    # Six degrees of freedom exceed 22.5 once in a thousand.
    assert xi @ np.linalg.solve(np.asarray(found.covariance), xi) < 22.5


@pytest.mark.slow
def test_the_derivative_is_that_of_the_pose_with_its_inliers_fixed(double, x64):
    _, inputs, value_and_grad = double
    (_, found), gradient = value_and_grad(inputs)
    inliers = np.asarray(found.inliers)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert np.all(np.asarray(gradient["pixels"])[~inliers] == 0)
    rng = np.random.default_rng(1)
    for name, h in (("points", 1e-3), ("pixels", 3e-2), ("focal", 3e-1)):
        direction = rng.normal(size=np.shape(inputs[name]))
        values = []
        for step in (h, -h):
            (value, other), _ = value_and_grad({**inputs, name: inputs[name] + step * direction})
            assert np.array_equal(other.inliers, inliers)
            values.append(float(value))
        # The search ends within 1e-7 of the optimum, which limits differences; tests/ba has them to 1e-6.
        terms = np.asarray(gradient[name]) * direction
        difference = (values[0] - values[1]) / (2 * h)
        assert abs(np.sum(terms) - difference) < 2e-4 * np.abs(terms).sum(), name
