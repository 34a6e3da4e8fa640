import inspect

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.problems import central_differences, lanes, matrix_recall, solve_in_batches, unit_matrices
from vojax.solvers import homography_dlt, homography_four_point

BATCH = 1024
N = 12
WIDTH, HEIGHT = 2000.0, 1500.0

four_last = jax.jit(jax.vmap(homography_four_point, in_axes=-1, out_axes=-1))
dlt_last = jax.jit(jax.vmap(homography_dlt, in_axes=-1, out_axes=-1))


def solve_four(pixels0, pixels1, dtype, size=BATCH):
    return solve_in_batches(four_last, pixels0, pixels1, dtype=dtype, size=size)


def solve_dlt(pixels0, pixels1, weights, dtype, size=BATCH):
    return solve_in_batches(dlt_last, pixels0, pixels1, weights, dtype=dtype, size=size)


def transferred(homography, pixels):
    moved = np.einsum("...ij,...nj->...ni", homography[..., :2], pixels) + homography[..., None, :, 2]
    return moved[..., :2] / moved[..., 2:]


def plane_views(count, n, seed=0, noise=0.0):
    """Pixels [count, n, 2] of planes 2.5 to 8 baselines away in two images of 2000 x 1500, and their homographies."""
    rng = np.random.default_rng(seed)
    calibration = np.array([[1000.0, 0.0, 1000.0], [0.0, 1000.0, 750.0], [0.0, 0.0, 1.0]])
    rotation = Rotation.from_rotvec(rng.normal(size=(count, 3)) * 0.2).as_matrix()
    translation = rng.normal(size=(count, 3, 1))
    translation /= np.linalg.norm(translation, axis=1, keepdims=True)
    normal = np.concatenate([rng.uniform(-0.5, 0.5, (count, 1, 2)), np.ones((count, 1, 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True) * rng.uniform(2.5, 8.0, (count, 1, 1))
    homography = calibration @ (rotation + translation * normal) @ np.linalg.inv(calibration)
    pixels0 = rng.uniform(0.0, 1.0, (count, n, 2)) * np.array([WIDTH, HEIGHT])
    pixels1 = transferred(homography, pixels0) + noise * rng.normal(size=pixels0.shape)
    return pixels0, pixels1, homography


def thickness(pixels):
    """Least height of the four triangles of four points, against the extent of the points: 0 if three are collinear."""
    heights = []
    for i in range(4):
        a, b, c = (pixels[:, j] for j in range(4) if j != i)
        u, v, w = b - a, c - a, c - b
        sides = [np.linalg.norm(x, axis=-1) for x in (u, v, w)]
        heights.append(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / np.max(sides, axis=0))
    return np.min(heights, axis=0) / np.max(np.ptp(pixels, axis=1), axis=-1)


def transfer_errors(candidates, homography, pixels):
    """Largest distance in pixels from where the true homography puts `pixels`; infinite if not valid."""
    valid = np.asarray(candidates.valid)[:, 0]
    found = np.where(valid[:, None, None], np.asarray(candidates.models, np.float64)[:, 0], np.eye(3))
    found = transferred(found, pixels)
    errors = np.linalg.norm(found - transferred(homography, pixels), axis=-1).max(axis=-1)
    return np.where(valid, errors, np.inf)


def mixed(seed, count, n):
    """Random problems, half of them degenerate in one of several ways or absurd."""
    pixels0, pixels1, _ = plane_views(count, n, seed)
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.1, 1.0, (count, n))
    kinds = np.array_split(rng.permutation(count)[: count // 2], 14)
    pixels0[kinds[0]] = pixels0[kinds[0], :1] + np.linspace(0.0, 1.0, n)[:, None] * np.array([300.0, 200.0])
    pixels1[kinds[1]] = pixels1[kinds[1], :1] + np.linspace(0.0, 1.0, n)[:, None] * np.array([300.0, 200.0])
    pixels0[kinds[2], 1:] = pixels0[kinds[2], :1]
    pixels1[kinds[3]] = 0.0
    pixels0[kinds[4]] = pixels1[kinds[4]] = 0.0
    pixels0[kinds[5], 0, 0] = np.nan
    pixels1[kinds[6], 2, 1] = np.inf
    pixels0[kinds[7]] *= 1e30
    pixels1[kinds[8]] *= 1e-30
    pixels0[kinds[9], 0] = 1e30
    pixels1[kinds[10], 1] = -1e30
    pixels0[kinds[11]] *= 1e30
    pixels1[kinds[11]] *= 1e30
    weights[kinds[12]] = 0.0
    weights[kinds[13], 0] = np.nan
    return pixels0, pixels1, weights


# --- Four points ---


def test_four_points_are_mapped(dtype):
    pixels0, pixels1, _ = plane_views(2000, 4)
    keep = np.minimum(thickness(pixels0), thickness(pixels1)) > 0.01
    assert keep.mean() > 0.9
    candidates = solve_four(pixels0[keep], pixels1[keep], dtype)
    assert candidates.valid.all()
    errors = np.linalg.norm(
        transferred(candidates.models[:, 0].astype(np.float64), pixels0[keep]) - pixels1[keep], axis=-1
    )
    # At most a hundredth of a pixel, and 1e-9 of it; rounding of the coordinates themselves is 1e-4 and 2e-13.
    assert errors.max() < (2e-2 if dtype == jnp.float32 else 2e-10)
    assert np.median(errors) < (3e-4 if dtype == jnp.float32 else 1e-12)
    np.testing.assert_allclose(candidates.models, unit_matrices(candidates.models), atol=2e-7)


def four_point_recall(count, dtype, seed):
    pixels0, pixels1, homography = plane_views(count, 4, seed)
    keep = np.minimum(thickness(pixels0), thickness(pixels1)) > 0.02
    candidates = solve_four(pixels0[keep], pixels1[keep], dtype)
    errors = transfer_errors(candidates, homography[keep], pixels0[keep])
    return np.mean(errors < (0.05 if dtype == jnp.float32 else 1e-9)), matrix_recall(
        candidates, unit_matrices(homography[keep]), 1e-3 if dtype == jnp.float32 else 1e-10
    )


def test_four_points_find_the_truth(dtype):
    assert min(four_point_recall(4000, dtype, seed=1)) >= 0.9999


@pytest.mark.slow
def test_four_points_find_the_truth_in_many_problems(dtype):
    recalls = four_point_recall(100_000, dtype, seed=2)
    print("four points", dtype, recalls)
    assert min(recalls) >= 0.9999


def test_four_points_equal_opencv(x64):
    # OpenCV rounds points to float32.
    pixels0, pixels1 = (x.astype(np.float32).astype(np.float64) for x in plane_views(200, 4, seed=3)[:2])
    keep = np.minimum(thickness(pixels0), thickness(pixels1)) > 0.02
    found = solve_four(pixels0[keep], pixels1[keep], np.float64).models[:, 0]
    for p, q, ours in zip(pixels0[keep], pixels1[keep], found, strict=True):
        theirs = cv2.findHomography(p, q, 0)[0]
        np.testing.assert_allclose(ours, unit_matrices(theirs), atol=1e-9)


def test_four_points_of_any_two_quadrangles(x64):
    # Not views of a plane in front: orientations of triangles differ, and H is right all the same.
    rng = np.random.default_rng(4)
    pixels0, pixels1 = rng.uniform(-1.0, 1.0, (2, 2000, 4, 2))
    keep = np.minimum(thickness(pixels0), thickness(pixels1)) > 0.02
    candidates = solve_four(pixels0[keep], pixels1[keep], np.float64)
    assert candidates.valid.all()
    error = transferred(candidates.models[:, 0], pixels0[keep]) - pixels1[keep]
    assert np.abs(error).max() < 1e-10


def test_four_points_keep_to_their_scale():
    pixels0, pixels1, homography = plane_views(500, 4, seed=5)
    keep = np.minimum(thickness(pixels0), thickness(pixels1)) > 0.02
    pixels0, pixels1, homography = pixels0[keep], pixels1[keep], homography[keep]
    for size0, size1 in ((1e-6, 1e-6), (1e4, 1e-4), (1e-3, 1e4)):
        scaled = np.diag([size1, size1, 1.0]) @ homography @ np.diag([1.0 / size0, 1.0 / size0, 1.0])
        candidates = solve_four(size0 * pixels0, size1 * pixels1, np.float32)
        assert (transfer_errors(candidates, scaled, size0 * pixels0) < 0.05 * size1).all()


@pytest.mark.parametrize("image", [0, 1])
@pytest.mark.parametrize(
    "spoil", ["collinear", "nearly collinear", "equal", "one point", "zeros", "nan", "inf", "huge", "tiny"]
)
def test_four_points_in_special_position_are_not_valid(dtype, image, spoil):
    problem = list(plane_views(64, 4, seed=6)[:2])
    pixels = problem[image]
    if spoil == "collinear":
        pixels[:, 1] = 0.3 * pixels[:, 3] + 0.7 * pixels[:, 2]
    elif spoil == "nearly collinear":
        # Off the line by an eighth of what the coordinates resolve.
        pixels[:, 0] = 0.25 * pixels[:, 1] + 0.75 * pixels[:, 2] + float(jnp.finfo(dtype).eps) * 250.0
    elif spoil == "equal":
        pixels[:, 3] = pixels[:, 1]
    elif spoil == "one point":
        pixels[:] = pixels[:, :1]
    elif spoil == "zeros":
        pixels[:] = 0.0
    elif spoil == "nan":
        pixels[:, 2, 1] = np.nan
    elif spoil == "inf":
        pixels[:, 0, 0] = np.inf
    else:
        pixels *= (1e30 if dtype == jnp.float32 else 1e100) ** (1.0 if spoil == "huge" else -1.0)
    candidates = solve_four(*problem, dtype)
    assert not candidates.valid.any()
    assert (candidates.models == 0.0).all()


# --- The direct linear transform ---


def reference_dlt(pixels0, pixels1, weights):
    """The same minimum by numpy's SVD of the equations, and its two least singular values over the greatest."""
    frames, points = [], []
    for pixels in (pixels0, pixels1):
        mean = weights @ pixels / weights.sum()
        size = np.sqrt(0.5 * weights @ np.sum((pixels - mean) ** 2, axis=1) / weights.sum())
        frames.append(np.array([[1.0, 0.0, -mean[0]], [0.0, 1.0, -mean[1]], [0.0, 0.0, size]]) / size)
        points.append(np.c_[(pixels - mean) / size, np.ones(len(pixels))])
    p, q = points
    rows = [np.c_[p, 0.0 * p, -q[:, :1] * p], np.c_[0.0 * p, p, -q[:, 1:2] * p]]
    _, s, vt = np.linalg.svd(np.concatenate([np.sqrt(weights)[:, None] * row for row in rows]))
    return unit_matrices(np.linalg.inv(frames[1]) @ vt[-1].reshape(3, 3) @ frames[0]), s / s[0]


@pytest.mark.slow
def test_dlt_is_the_least_singular_vector(dtype):
    pixels0, pixels1, _ = plane_views(300, N, seed=7, noise=2.0)
    weights = np.random.default_rng(7).uniform(0.1, 2.0, (300, N))
    candidates = solve_dlt(pixels0, pixels1, weights, dtype)
    assert candidates.valid.all()
    expected = np.array([reference_dlt(*x)[0] for x in zip(pixels0, pixels1, weights, strict=True)])
    np.testing.assert_allclose(candidates.models[:, 0], expected, atol=1e-4 if dtype == jnp.float32 else 1e-11)
    # A point of the images is transferred to within rounding of its coordinates.
    errors = transfer_errors(candidates, expected, pixels0)
    assert np.quantile(errors, 0.95) < (1e-3 if dtype == jnp.float32 else 1e-11)


def dlt_recall(count, dtype, seed):
    pixels0, pixels1, homography = plane_views(count, N, seed)
    # Views with a point near the horizon of the plane, which is at infinity in image 1, are left out.
    keep = np.abs(pixels1).max(axis=(1, 2)) < 5.0 * WIDTH
    candidates = solve_dlt(pixels0[keep], pixels1[keep], np.ones((keep.sum(), N)), dtype)
    errors = transfer_errors(candidates, homography[keep], pixels0[keep])
    return np.mean(errors < (0.05 if dtype == jnp.float32 else 1e-9)), matrix_recall(
        candidates, unit_matrices(homography[keep]), 1e-3 if dtype == jnp.float32 else 1e-10
    )


def test_dlt_finds_the_truth(dtype):
    assert min(dlt_recall(4000, dtype, seed=8)) >= 0.9999


@pytest.mark.slow
def test_dlt_finds_the_truth_in_many_problems(dtype):
    recalls = dlt_recall(100_000, dtype, seed=9)
    print("dlt", dtype, recalls)
    assert min(recalls) >= 0.9999


def test_dlt_of_four_points_is_the_exact_homography(x64):
    pixels0, pixels1, _ = plane_views(500, N, seed=10)
    weights = np.zeros((500, N))
    weights[:, :4] = 1.0
    keep = np.minimum(thickness(pixels0[:, :4]), thickness(pixels1[:, :4])) > 0.01
    exact = solve_four(pixels0[keep, :4], pixels1[keep, :4], np.float64)
    fitted = solve_dlt(pixels0[keep], pixels1[keep], weights[keep], np.float64)
    assert fitted.valid.all()
    np.testing.assert_allclose(fitted.models, exact.models, atol=1e-9)


def test_dlt_and_opencv_agree_up_to_the_cost(x64):
    # OpenCV refines the transfer error in image 1 after its own linear fit.
    pixels0, pixels1, _ = plane_views(100, N, seed=11, noise=0.5)
    candidates = solve_dlt(pixels0, pixels1, np.ones((100, N)), np.float64)
    theirs, refined = [], []
    for p, q in zip(pixels0, pixels1, strict=True):
        theirs.append(cv2.findHomography(p, q, 0)[0])
        refined.append(poselib.refine_homography(p, q, theirs[-1], {"loss_type": "TRIVIAL"})[0])
    for peer in (np.array(theirs), np.array(refined)):
        assert np.median(transfer_errors(candidates, peer, pixels0)) < 0.2
    of_ours, of_theirs = (
        np.sqrt(np.mean((transferred(h, pixels0) - pixels1) ** 2)) for h in (candidates.models[:, 0], np.array(theirs))
    )
    assert of_theirs <= of_ours < 1.02 * of_theirs


def test_dlt_masks_by_weight_and_scales_weights(dtype):
    pixels0, pixels1, homography = plane_views(500, N, seed=12)
    pixels1[:, 3] += 100.0
    weights = np.full((500, N), 1e-6)
    weights[:, 3] = 0.0
    errors = transfer_errors(solve_dlt(pixels0, pixels1, weights, dtype), homography, pixels0)
    assert np.mean(errors < (0.05 if dtype == jnp.float32 else 1e-8)) > 0.995
    weights[:, 3] = 1e-6
    assert np.median(transfer_errors(solve_dlt(pixels0, pixels1, weights, dtype), homography, pixels0)) > 1.0


def test_dlt_does_not_depend_on_where_the_images_are():
    # A small patch far from the origin, in float32: what counts is how the coordinates round.
    pixels0, pixels1, homography = plane_views(500, N, seed=13)
    middle = np.array([WIDTH, HEIGHT]) / 2.0
    pixels0 = middle + 0.1 * (pixels0 - middle)
    pixels1 = transferred(homography, pixels0)
    errors = transfer_errors(solve_dlt(pixels0, pixels1, np.ones((500, N)), np.float32), homography, pixels0)
    assert np.mean(errors < 1e-2) > 0.99


def test_noise_moves_homographies_smoothly(x64):
    homography = plane_views(500, N, seed=14)[2]
    medians = []
    for noise in (0.01, 0.1, 1.0):
        pixels0, pixels1, _ = plane_views(500, N, seed=14, noise=noise)
        medians.append(
            np.median(transfer_errors(solve_dlt(pixels0, pixels1, np.ones((500, N)), np.float64), homography, pixels0))
        )
    assert 9.0 < medians[1] / medians[0] < 11.0
    assert 8.0 < medians[2] / medians[1] < 12.0
    assert medians[2] < 3.0


def test_more_points_help(x64):
    errors = {}
    for n in (4, N):
        pixels0, pixels1, homography = plane_views(1000, N, seed=15, noise=1.0)
        weights = np.zeros((1000, N))
        weights[:, :n] = 1.0
        candidates = solve_dlt(pixels0, pixels1, weights, np.float64)
        errors[n] = np.median(transfer_errors(candidates, homography, pixels0))
    assert errors[N] < 0.3 * errors[4]


@pytest.mark.parametrize(
    "spoil",
    [
        "line",
        "line in image 1",
        "line and one",
        "one point",
        "three weights",
        "no weight",
        "negative",
        "nan",
        "inf",
        "huge",
    ],
)
def test_dlt_in_special_position_is_not_valid(dtype, spoil):
    pixels0, pixels1, homography = plane_views(64, N, seed=16)
    weights = np.ones((64, N))
    along = np.random.default_rng(16).uniform(0.0, 1.0, (64, N, 1))
    if spoil.startswith("line"):
        pixels0 = pixels0[:, :1] * along + pixels0[:, 1:2] * (1.0 - along)
        if spoil == "line and one":
            pixels0[:, 4] = np.array([20.0, 1400.0])
        pixels1 = transferred(homography, pixels0)
        if spoil == "line in image 1":
            # Seen edge-on: a homography of rank two.
            pixels0 = plane_views(64, N, seed=17)[0]
            flat = np.array([[1.0, 0.2, 30.0], [0.504, 0.108, 55.0], [1e-4, 2e-4, 1.0]])
            pixels1 = transferred(np.broadcast_to(flat, (64, 3, 3)), pixels0)
    elif spoil == "one point":
        pixels0[:] = pixels0[:, :1]
    elif spoil == "three weights":
        weights[:, 3:] = 0.0
    elif spoil == "no weight":
        weights[:] = 0.0
    elif spoil == "negative":
        weights[:, 5] = -1.0
    elif spoil == "nan":
        weights[:, 5] = np.nan
    elif spoil == "inf":
        pixels1[:, 5, 0] = np.inf
    else:
        pixels0 *= 1e30 if dtype == jnp.float32 else 1e100
    candidates = solve_dlt(pixels0, pixels1, weights, dtype)
    assert not candidates.valid.any()
    assert (candidates.models == 0.0).all()


# --- Both ---


@pytest.mark.slow
def test_vmap_equals_loop_on_either_axis(x64):
    pixels0, pixels1, _ = plane_views(8, N, seed=18, noise=0.5)
    last = solve_dlt(pixels0, pixels1, np.ones((8, N)), np.float64)
    first = jax.jit(jax.vmap(homography_dlt))(pixels0, pixels1, np.ones((8, N)))
    np.testing.assert_allclose(first.models, last.models, atol=1e-12)
    four = solve_four(pixels0[:, :4], pixels1[:, :4], np.float64)
    four_first = jax.jit(jax.vmap(homography_four_point))(pixels0[:, :4], pixels1[:, :4])
    np.testing.assert_allclose(four_first.models, four.models, atol=1e-12)
    for i in range(8):
        np.testing.assert_allclose(homography_dlt(pixels0[i], pixels1[i]).models, last.models[i], atol=1e-12)
        single = homography_four_point(pixels0[i, :4], pixels1[i, :4])
        np.testing.assert_allclose(single.models, four.models[i], atol=1e-12)


@pytest.mark.slow
def test_many_lanes_give_what_few_give():
    pixels0, pixels1, homography = plane_views(65_536, 4, seed=19)
    many, few = (solve_four(pixels0, pixels1, np.float32, size=size) for size in (65_536, BATCH))
    np.testing.assert_array_equal(many.valid, few.valid)
    assert np.abs(many.models - few.models).max() < 1e-4
    pixels0, pixels1, homography = plane_views(65_536, N, seed=20)
    many = solve_dlt(pixels0, pixels1, np.ones((65_536, N)), np.float32, size=65_536)
    assert np.mean(transfer_errors(many, homography, pixels0) < 0.05) > 0.998


def four_function(pixels0, pixels1):
    return jnp.sum(
        homography_four_point(pixels0, pixels1).models[0]
        * jnp.array([[1.0, -300.0, 0.4], [500.0, 0.7, 0.3], [2e5, -3e5, 700.0]])
    )


def dlt_function(pixels0, pixels1, weights):
    return jnp.sum(
        homography_dlt(pixels0, pixels1, weights).models[0]
        * jnp.array([[1.0, -300.0, 0.4], [500.0, 0.7, 0.3], [2e5, -3e5, 700.0]])
    )


grad_four_last = jax.jit(jax.vmap(jax.grad(four_function, (0, 1)), -1, -1))
grad_dlt_last = jax.jit(jax.vmap(jax.grad(dlt_function, (0, 1, 2)), -1, -1))


def check_gradients(function, arguments, steps):
    """Reverse mode against central differences in every entry, forward mode against it in one direction."""
    value, numbers = jax.jit(function), tuple(range(len(arguments)))

    @jax.jit
    def both(problem, directions):
        return jax.grad(function, numbers)(*problem), jax.jvp(function, problem, directions)[1]

    rng = np.random.default_rng(0)
    for problem in zip(*arguments, strict=True):
        directions = tuple(rng.normal(size=x.shape) for x in problem)
        reverse, forward = both(problem, directions)
        for index, back in enumerate(reverse):
            numeric = central_differences(value, problem, index, step=steps[index])
            np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())
        along = sum(np.sum(x * y) for x, y in zip(reverse, directions, strict=True))
        size = sum(np.abs(x * y).sum() for x, y in zip(reverse, directions, strict=True))
        np.testing.assert_allclose(forward, along, atol=1e-9 * size)


@pytest.mark.slow
def test_four_point_gradients_equal_central_differences(x64):
    pixels0, pixels1, _ = plane_views(20, 4, seed=21)
    keep = np.minimum(thickness(pixels0), thickness(pixels1)) > 0.1
    assert keep.sum() >= 3
    check_gradients(four_function, (pixels0[keep][:3], pixels1[keep][:3]), steps=(1e-3, 1e-3))


def test_dlt_gradients_equal_central_differences(x64):
    pixels0, pixels1, _ = plane_views(2, 6, seed=22, noise=1.0)
    weights = np.random.default_rng(22).uniform(0.5, 1.5, (2, 6))
    check_gradients(dlt_function, (pixels0, pixels1, weights), steps=(1e-3, 1e-3, 1e-5))


@pytest.mark.slow
def test_gradients_in_single_precision():
    # In pixels, not scaled: the derivative is taken in the frame of the points.
    pixels0, pixels1, _ = plane_views(BATCH, 4, seed=23)
    keep = np.minimum(thickness(pixels0), thickness(pixels1)) > 0.05
    pixels = [x.astype(np.float32) for x in (pixels0, pixels1)]
    single = grad_four_last(*lanes(*pixels, dtype=np.float32))
    with jax.enable_x64(True):
        double = grad_four_last(*lanes(*pixels, dtype=np.float64))
    for a, b in zip(*(map(np.asarray, parts) for parts in (single, double)), strict=True):
        errors = (np.abs(a - b).max(axis=(0, 1)) / np.abs(b).max(axis=(0, 1)))[keep]
        assert np.median(errors) < 1e-4
        assert errors.max() < 2e-2


def finite_everywhere(seed, count, dtype, gradients=True):
    pixels0, pixels1, weights = mixed(seed, count, N)
    candidates = solve_dlt(pixels0, pixels1, weights, dtype, size=count)
    assert np.isfinite(candidates.models).all()
    assert 0.45 < candidates.valid.mean() < 0.7
    if gradients:
        for part in grad_dlt_last(*lanes(pixels0, pixels1, weights, dtype=dtype)):
            assert np.isfinite(part).all()
    pixels0, pixels1, _ = mixed(seed, count, 4)
    candidates = solve_four(pixels0, pixels1, dtype, size=count)
    assert np.isfinite(candidates.models).all()
    assert 0.45 < candidates.valid.mean() < 0.75
    if gradients:
        for part in grad_four_last(*lanes(pixels0, pixels1, dtype=dtype)):
            assert np.isfinite(part).all()


@pytest.mark.slow
def test_values_and_gradients_are_finite_everywhere():
    finite_everywhere(24, BATCH, np.float32)


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(8):
        finite_everywhere(seed, 125_000, dtype, gradients=seed == 0)


def test_bad_shapes_raise():
    with pytest.raises(ValueError, match="at least 4"):
        homography_dlt(np.ones((3, 2)), np.ones((3, 2)))
    with pytest.raises(ValueError, match="one per point"):
        inspect.unwrap(homography_dlt)(np.ones((4, 2)), np.ones((4, 2)), np.ones(3))
    with pytest.raises(ValueError, match="two equal shapes"):
        inspect.unwrap(homography_dlt)(np.ones((4, 2)), np.ones((5, 2)))
    with pytest.raises(ValueError, match=r"expected \[4, 2\]"):
        inspect.unwrap(homography_four_point)(np.ones((5, 2)), np.ones((4, 2)))


def test_accepts_mixed_precision():
    pixels0, pixels1, _ = plane_views(1, 4, seed=25)
    candidates = homography_four_point(pixels0[0], pixels1[0].astype(np.float32))
    assert candidates.models.dtype == jnp.float32
    assert candidates.valid.all()
