import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from scipy.spatial.transform import Rotation

from tests.solvers.problems import central_differences, lanes, pose_errors, solve_in_batches
from vojax.solvers import dlt_pnp, dlt_pnp_calibrated

pytestmark = pytest.mark.optimized

METHODS = ("svd", "fix_p23", "cross")
N = 8


def batched(method):
    solver = dlt_pnp_calibrated if method == "calibrated" else lambda x, y, w: dlt_pnp(x, y, w, method=method)
    return jax.jit(jax.vmap(solver, in_axes=-1, out_axes=-1))


SOLVE = {method: batched(method) for method in (*METHODS, "calibrated")}
KINDS = ["coplanar", "collinear", "one point", "five points", "weights", "negative weight", "mirrored", "nan", "inf"]


def problems(count, n=N, seed=0, sigma_px=0.0):
    """Points [count, n, 3], pixels, bearings, weights; and K, R, t. Pixel noise is in the bearings too."""
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-0.7, 0.7, (count, n, 2)), np.ones((count, n, 1))], axis=-1)
    cam = rays * rng.uniform(4.0, 8.0, (count, n, 1))
    rotation = Rotation.random(count, rng=rng).as_matrix()
    translation = rng.normal(size=(count, 3)) * 2.0
    points = np.einsum("bji,bnj->bni", rotation, cam - translation[:, None])
    k = np.zeros((count, 3, 3))
    k[:, 0, 0] = rng.uniform(400.0, 1200.0, count)
    k[:, 1, 1] = k[:, 0, 0] * rng.uniform(0.8, 1.2, count)
    k[:, 0, 1] = rng.normal(size=count) * 5.0
    k[:, 0, 2], k[:, 1, 2], k[:, 2, 2] = *rng.uniform(200.0, 800.0, (2, count)), 1.0
    pixels = np.einsum("bij,bnj->bni", k, rays)[..., :2] + sigma_px * rng.normal(size=(count, n, 2))
    homogeneous = np.concatenate([pixels, np.ones((count, n, 1))], axis=-1)
    rays = np.einsum("bij,bnj->bni", np.linalg.inv(k), homogeneous)
    bearings = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return (points, pixels, bearings, rng.uniform(0.5, 2.0, (count, n))), (k, rotation, translation)


def images(data, method):
    points, pixels, bearings, weights = data
    return points, (bearings if method == "calibrated" else pixels), weights


def solve(data, method, dtype):
    return solve_in_batches(SOLVE[method], *images(data, method), dtype=dtype)


def errors(candidates, truth, method):
    """Largest error of rotation, relative translation and relative calibration; infinite where invalid."""
    k, rotation, translation = truth
    pose = candidates.models if method == "calibrated" else candidates.models.cam_from_world
    error = pose_errors(pose.wxyz_xyz, rotation, translation)[:, 0]
    if method != "calibrated":
        of_k = np.abs(np.asarray(candidates.models.calibration[:, 0], np.float64) - k).max(axis=(1, 2)) / k[:, 0, 0]
        error = np.maximum(error, of_k)
    return np.where(candidates.valid[:, 0], error, np.inf)


def spoiled(data, kind):
    points, pixels, bearings, weights = (x.copy() for x in data)
    if kind == "coplanar":
        # Consistent images of a plane: its points moved there along their rays in a camera at the origin.
        points[..., 2] = 0.3 * points[..., 0] - 0.2 * points[..., 1] + 0.5
    elif kind == "collinear":
        points = points[:, :1] + (points[:, 1:2] - points[:, :1]) * np.linspace(0.0, 1.0, N)[:, None]
    elif kind == "one point":
        points[:] = points[:, :1]
    elif kind == "five points":
        points[:, 5:], pixels[:, 5:], bearings[:, 5:] = points[:, 4:5], pixels[:, 4:5], bearings[:, 4:5]
    elif kind == "weights":
        weights[:, 5:] = 0.0
    elif kind == "negative weight":
        weights[:, 3] = -1.0
    elif kind == "mirrored":
        pixels[..., 0], bearings[..., 0] = -pixels[..., 0], -bearings[..., 0]
    elif kind == "nan":
        points[:, 2, 1] = np.nan
    elif kind == "inf":
        pixels[:, 0, 1], bearings[:, 0, 1] = np.inf, np.inf
    elif kind == "zeros":
        points[:], pixels[:], bearings[:], weights[:] = 0.0, 0.0, 0.0, 0.0
    elif kind == "huge":
        points *= 1e30
    elif kind == "tiny":
        pixels *= 1e-30
        bearings *= 1e-30
    return points, pixels, bearings, weights


def mixed(count, seed):
    data, _ = problems(count, seed=seed)
    kinds = [*KINDS, "zeros", "huge", "tiny"]
    for part, kind in zip(np.array_split(np.arange(count // 2), len(kinds)), kinds, strict=True):
        for x, y in zip(data, spoiled([x[part] for x in data], kind), strict=True):
            x[part] = y
    return data


@pytest.mark.parametrize("method", SOLVE)
def test_finds_the_truth(dtype, method):
    data, truth = problems(4096, seed=1)
    error = errors(solve(data, method, dtype), truth, method)
    if dtype == jnp.float32:
        assert (error < 1e-3).mean() >= 0.998
    else:
        assert (error < 1e-8).mean() >= 0.9999


@pytest.mark.slow
@pytest.mark.parametrize("method", SOLVE)
def test_finds_the_truth_in_many_problems(dtype, method):
    data, truth = problems(100_000, seed=2)
    error = errors(solve(data, method, dtype), truth, method)
    assert (error < (1e-3 if dtype == jnp.float32 else 1e-8)).mean() >= (0.998 if dtype == jnp.float32 else 0.9999)


def reference(points, images, weights, method):
    """The same minimum with numpy's SVD and explicit rows; P in the original coordinates."""
    n = len(points)

    def normalised(x):
        mean = weights @ x / weights.sum()
        factor = np.sqrt(x.shape[1] * weights.sum() / (weights @ np.sum((x - mean) ** 2, axis=1)))
        matrix = np.diag([factor] * x.shape[1] + [1.0])
        matrix[:-1, -1] = -factor * mean
        return matrix

    u = normalised(points)
    t = np.eye(3) if method == "calibrated" else normalised(images)
    a = np.concatenate([points, np.ones((n, 1))], axis=1) @ u.T
    rays = images if method == "calibrated" else np.concatenate([images, np.ones((n, 1))], axis=1) @ t.T
    rows = []
    for x, q, w in zip(a, rays, weights, strict=True):
        if method in ("cross", "calibrated"):
            q = q / np.linalg.norm(q)
            matrix = np.array([[0, -q[2], q[1]], [q[2], 0, -q[0]], [-q[1], q[0], 0]])
        else:
            matrix = np.array([[1.0, 0.0, -q[0] / q[2]], [0.0, 1.0, -q[1] / q[2]]])
        rows.append(np.sqrt(w) * np.kron(matrix, x[None]))
    rows = np.concatenate(rows)
    if method == "fix_p23":
        p = np.append(np.linalg.lstsq(rows[:, :11], -rows[:, 11], rcond=None)[0], 1.0)
    else:
        p = np.linalg.svd(rows)[2][-1]
    return np.linalg.inv(t) @ p.reshape(3, 4) @ u


@pytest.mark.slow
@pytest.mark.parametrize("method", SOLVE)
def test_equals_the_reference_with_noise(x64, method):
    data, _ = problems(2048, seed=3, sigma_px=1.0)
    candidates = jax.tree.map(jnp.asarray, solve(data, method, np.float64))
    points, image, weights = images(data, method)
    compared = 0
    for i in range(100):
        if not candidates.valid[i, 0]:
            continue
        compared += 1
        p = reference(points[i], image[i], weights[i], method)
        p = p * np.sign(np.linalg.det(p[:, :3]))
        if method == "calibrated":
            left, singular, right = np.linalg.svd(p[:, :3])
            expected = np.concatenate([left @ right, p[:, 3:] / singular.mean()], axis=1)
            # The mean scale is taken in normalised coordinates, where the centroid is the origin.
            centre = weights[i] @ points[i] / weights[i].sum()
            at_centre = (p[:, :3] @ centre + p[:, 3]) / singular.mean()
            expected[:, 3] = at_centre - expected[:, :3] @ centre
            found = np.concatenate(
                [candidates.models.rotation().as_matrix()[i, 0], candidates.models.translation()[i, 0][:, None]], axis=1
            )
        else:
            upper, rotation = scipy.linalg.rq(p[:, :3])
            signs = np.sign(np.diagonal(upper))
            upper, rotation = upper * signs[None], rotation * signs[:, None]
            expected = np.concatenate([upper / upper[2, 2], rotation, np.linalg.solve(upper, p[:, 3:])], axis=1)
            pose = candidates.models.cam_from_world
            found = [candidates.models.calibration[i, 0], pose.rotation().as_matrix()[i, 0]]
            found = np.concatenate([*found, pose.translation()[i, 0][:, None]], axis=1)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    assert compared > 60


def test_the_three_forms_differ_with_noise(x64):
    # Their rows agree at the solution without noise: the solutions part with its square.
    data, truth = problems(2048, seed=4, sigma_px=2.0)
    found = [solve(data, method, np.float64) for method in METHODS]
    poses = [candidates.models.cam_from_world.wxyz_xyz[:, 0] for candidates in found]
    for other in poses[1:]:
        assert np.median(np.abs(other - poses[0]).max(axis=1)) > 1e-5
    for candidates, method in zip(found, METHODS, strict=True):
        assert np.median(errors(candidates, truth, method)) < 1.0


def test_left_block_is_no_rotation_and_refinement_helps(x64):
    # [R | t] of the linear solution, made orthonormal, does not minimise the reprojection error.
    data, (_, rotation, _) = problems(2048, seed=5, sigma_px=1.0)
    points, _, bearings, weights = data
    candidates = solve((points, bearings, bearings, np.ones_like(weights)), "calibrated", np.float64)
    linear, refined = [], []
    for i in range(20):
        p = reference(points[i], bearings[i], np.ones(N), "calibrated")
        singular = np.linalg.svd(p[:, :3])[1]
        assert singular[0] / singular[2] > 1.0 + 1e-4
        pose = candidates.models.wxyz_xyz[i, 0]
        start = np.concatenate([Rotation.from_quat(pose[[1, 2, 3, 0]]).as_rotvec(), pose[4:]])

        def residual(x, i=i):
            cam = points[i] @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:]
            return (cam / np.linalg.norm(cam, axis=1, keepdims=True) - bearings[i]).ravel()

        best = scipy.optimize.least_squares(residual, start).x
        for into, x in ((linear, start), (refined, best)):
            into.append(np.abs(Rotation.from_rotvec(x[:3]).as_matrix() - rotation[i]).max())
    assert np.median(refined) < np.median(linear)


def test_bearings_may_point_anywhere(x64):
    rng = np.random.default_rng(6)
    data, (_, rotation, translation) = problems(2048, seed=6)
    cam = rng.normal(size=(2048, N, 3)) * 5.0
    points = np.einsum("bji,bnj->bni", rotation, cam - translation[:, None])
    candidates = solve((points, cam, cam * rng.uniform(0.1, 3.0, (2048, N, 1)), data[3]), "calibrated", np.float64)
    error = errors(candidates, (None, rotation, translation), "calibrated")
    assert (error < 1e-8).mean() > 0.99


@pytest.mark.parametrize("kind", KINDS)
def test_impossible_problems_are_invalid(dtype, kind):
    data, (k, rotation, translation) = problems(256, seed=7)
    points, pixels, bearings, weights = spoiled(data, kind)
    if kind in ("coplanar", "collinear", "one point"):
        cam = np.einsum("bij,bnj->bni", rotation, points) + translation[:, None] + np.array([0.0, 0.0, 30.0])
        pixels = np.einsum("bij,bnj->bni", k, cam / cam[..., 2:])[..., :2]
        bearings = cam / np.linalg.norm(cam, axis=-1, keepdims=True)
    for method in SOLVE:
        candidates = solve((points, pixels, bearings, weights), method, dtype)
        assert not candidates.valid.any()
        pose = candidates.models if method == "calibrated" else candidates.models.cam_from_world
        np.testing.assert_array_equal(pose.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (256, 1, 7)))
        if method != "calibrated":
            np.testing.assert_array_equal(candidates.models.calibration, np.broadcast_to(np.eye(3), (256, 1, 3, 3)))


def test_far_from_the_origin_in_single_precision():
    data, (k, rotation, translation) = problems(2048, seed=8)
    points, *rest = data
    far = np.array([1000.0, -2000.0, 500.0])
    points = (points + far).astype(np.float32)
    truth = (k, rotation, translation - rotation @ far)
    assert np.median(errors(solve((points, *rest), "svd", np.float32), truth, "svd")) < 1e-3


def test_weight_zero_ignores_an_outlier(x64):
    data, truth = problems(2048, seed=9)
    points, pixels, bearings, weights = data
    points[:, 3] += 2.0
    weights[:, 3] = 0.0
    for method in SOLVE:
        assert (
            errors(solve((points, pixels, bearings, weights), method, np.float64), truth, method) < 1e-6
        ).mean() > 0.99


@pytest.mark.parametrize("method", SOLVE)
def test_nothing_is_infinite(dtype, method):
    candidates = solve(mixed(2048, seed=10), method, dtype)
    for x in jax.tree.leaves(candidates.models):
        assert np.isfinite(x).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["svd", "calibrated"])
def test_nothing_is_ever_infinite(dtype, method):
    for seed in range(8):
        for x in jax.tree.leaves(solve(mixed(125_000, seed), method, dtype).models):
            assert np.isfinite(x).all()


def weighted_sum(method):
    rng = np.random.default_rng(11)
    factors = jnp.asarray(rng.normal(size=7)), jnp.asarray(rng.normal(size=(3, 3)) * 1e-3)

    def function(points, image, weights):
        if method == "calibrated":
            return jnp.sum(dlt_pnp_calibrated(points, image, weights).models.wxyz_xyz[0] * factors[0])
        model = dlt_pnp(points, image, weights, method=method).models
        return jnp.sum(model.cam_from_world.wxyz_xyz[0] * factors[0]) + jnp.sum(model.calibration[0] * factors[1])

    return function


SLOWLY = pytest.mark.slow


@pytest.mark.parametrize(
    "method", ["svd", "calibrated", pytest.param("fix_p23", marks=SLOWLY), pytest.param("cross", marks=SLOWLY)]
)
@pytest.mark.slow
def test_gradients_equal_central_differences(x64, method):
    function = weighted_sum(method)
    both = jax.jit(lambda *x: (jax.grad(function, (0, 1, 2))(*x), jax.jacfwd(function, (0, 1, 2))(*x)))
    value = jax.jit(function)
    data, _ = problems(3, seed=12, sigma_px=0.5)
    for i in range(3):
        arguments = tuple(x[i] for x in images(data, method))
        reverse, forward = both(*arguments)
        for index, (back, ahead) in enumerate(zip(reverse, forward, strict=True)):
            numeric = central_differences(value, arguments, index, step=1e-5)
            scale = np.abs(numeric).max()
            np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=2e-6 * scale)
            np.testing.assert_allclose(ahead, back, rtol=1e-8, atol=1e-8 * scale)


@pytest.mark.parametrize("method", ["svd", "calibrated"])
@pytest.mark.slow
def test_gradients_are_finite_everywhere(method):
    function = weighted_sum(method)
    gradient = jax.jit(jax.vmap(jax.grad(function, (0, 1, 2)), -1, -1))
    for part in gradient(*lanes(*images(mixed(2048, seed=13), method), dtype=np.float32)):
        assert np.isfinite(part).all()


@pytest.mark.slow
def test_vmap_equals_loop_and_batch_axis_does_not_matter(x64):
    data, _ = problems(2048, seed=14)
    batch = solve(data, "svd", np.float64)
    sixteen = [x[:16] for x in images(data, "svd")]
    first, single = jax.jit(lambda *x: (jax.vmap(dlt_pnp)(*x), dlt_pnp(*(each[3] for each in x))))(*sixteen)
    for x, y, z in zip(*(jax.tree.leaves(c.models) for c in (single, batch, first)), strict=True):
        np.testing.assert_allclose(x, y[3], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(z, y[:16], rtol=1e-8, atol=1e-8)


def test_the_solution_moves_smoothly_with_noise(x64):
    medians = []
    for sigma in (1e-4, 1e-3):
        data, truth = problems(2048, seed=15, sigma_px=sigma)
        medians.append(np.median(errors(solve(data, "svd", np.float64), truth, "svd")))
    assert medians[0] < 1e-4
    np.testing.assert_allclose(medians[1] / medians[0], 10.0, rtol=0.05)


def test_bad_shapes_raise():
    points, pixels = jnp.zeros((5, 3)), jnp.zeros((5, 2))
    with pytest.raises(ValueError, match="found 5 points; expected at least 6"):
        dlt_pnp(points, pixels)
    with pytest.raises(ValueError, match="expected one of svd"):
        dlt_pnp(jnp.zeros((6, 3)), jnp.zeros((6, 2)), method="qr")
