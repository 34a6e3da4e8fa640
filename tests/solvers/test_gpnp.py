import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation

from tests.solvers.derivatives import assert_derivatives
from tests.solvers.problems import lanes, recall, solve_in_batches
from vojax.solvers import gpnp
from vojax.solvers._gpnp import correspondences

N = 12
solve_last = jax.jit(jax.vmap(gpnp, in_axes=-1, out_axes=-1))
DEGENERATE = ["one point", "three weights", "negative weight", "zero ray", "one ray", "zeros", "nan", "inf"]


def problems(count, n, seed=0, sigma=0.0, baseline=0.5, planar=False):
    """Points, centres, bearings [count, 12, 3] and weights, of which n are positive; R and t of rig_from_world."""
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-0.7, 0.7, (count, n, 2)), np.ones((count, n, 1))], axis=-1)
    depths = rng.uniform(2.0, 10.0, (count, n, 1))
    if planar:
        normal = np.concatenate([rng.uniform(-0.5, 0.5, (count, 1, 2)), np.ones((count, 1, 1))], axis=-1)
        depths = rng.uniform(4.0, 8.0, (count, 1, 1)) / np.sum(rays * normal, axis=-1, keepdims=True)
    rig = rays * depths
    rotation = Rotation.random(count, rng=rng).as_matrix()
    translation = rng.normal(size=(count, 3)) * 2.0
    points = np.einsum("bji,bnj->bni", rotation, rig - translation[:, None])
    centers = rng.uniform(-baseline, baseline, (count, n, 3))
    bearings = rig - centers
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    bearings += sigma * rng.normal(size=bearings.shape)
    fill = ((0, 0), (0, N - n), (0, 0))
    padded = (np.pad(x, fill, mode="edge") for x in (points, centers, bearings))
    return (*padded, np.pad(np.ones((count, n)), ((0, 0), (0, N - n)))), rotation, translation


def solve(data, dtype):
    return solve_in_batches(solve_last, *data, dtype=dtype)


def spoiled(data, kind):
    points, centers, bearings, weights = (x.copy() for x in data)
    if kind == "one point":
        points[:] = points[:, :1]
    elif kind == "three weights":
        weights[:, 3:] = 0.0
    elif kind == "negative weight":
        weights[:, 1] = -1.0
    elif kind == "zero ray":
        bearings[:, 2] = 0.0
    elif kind == "one ray":
        bearings[:], centers[:] = bearings[:, :1], centers[:, :1]
    elif kind == "zeros":
        points[:], centers[:], bearings[:], weights[:] = 0.0, 0.0, 0.0, 0.0
    elif kind == "nan":
        points[:, 2, 1] = np.nan
    elif kind == "inf":
        centers[:, 0, 1] = np.inf
    elif kind == "huge":
        points *= 1e30
    elif kind == "tiny":
        points, centers = points * 1e-30, centers * 1e-30
    return points, centers, bearings, weights


def mixed(seed, count):
    data, *_ = problems(count, N, seed, sigma=0.01)
    kinds = [*DEGENERATE, "huge", "tiny"]
    for part, kind in zip(np.array_split(np.arange(count // 2), len(kinds)), kinds, strict=True):
        for x, y in zip(data, spoiled([x[part] for x in data], kind), strict=True):
            x[part] = y
    return data


@pytest.mark.parametrize(
    ("n", "baseline", "planar"), [(4, 0.5, False), (12, 0.5, False), (6, 0.0, False), (6, 0.5, True)]
)
def test_finds_the_truth(dtype, n, baseline, planar):
    data, rotation, translation = problems(2048, n, 1, baseline=baseline, planar=planar)
    candidates = solve(data, dtype)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-3) >= 0.995
    else:
        assert recall(candidates, rotation, translation, 1e-6) >= 0.998


@pytest.mark.slow
@pytest.mark.parametrize("n", [4, 6, 12])
def test_finds_the_truth_in_many_problems(dtype, n):
    data, rotation, translation = problems(100_000, n, 2)
    candidates = solve(data, dtype)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-3) >= 0.998
    else:
        assert recall(candidates, rotation, translation, 1e-6) >= 0.9995


def test_with_noise_it_is_the_minimum(x64):
    data, rotation, translation = problems(50, N, 3, sigma=3e-3)
    candidates = solve(data, np.float64)
    assert candidates.valid.all()
    for i in range(50):
        points, centers, bearings, _ = (x[i] for x in data)
        bearings = bearings / np.linalg.norm(bearings, axis=-1, keepdims=True)

        def residual(v, i=i, points=points, centers=centers, bearings=bearings):
            turn = Rotation.from_rotvec(v[:3]) * Rotation.from_matrix(rotation[i])
            rays = turn.apply(points) + translation[i] + v[3:] - centers
            return (rays / np.linalg.norm(rays, axis=-1, keepdims=True) - bearings).ravel()

        found = scipy.optimize.least_squares(residual, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        ours = candidates.models.wxyz_xyz[i, 0]
        turn = Rotation.from_quat(ours[[1, 2, 3, 0]]) * Rotation.from_matrix(rotation[i]).inv()
        mine = np.concatenate([turn.as_rotvec(), ours[4:] - translation[i]])
        np.testing.assert_allclose(mine, found.x, atol=1e-6)


@pytest.mark.parametrize("kind", DEGENERATE)
def test_impossible_problems_have_no_valid_slot(dtype, kind):
    data, *_ = problems(64, N, 9)
    candidates = solve(spoiled(data, kind), dtype)
    assert not candidates.valid.any()
    np.testing.assert_array_equal(candidates.models.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (64, 1, 7)))


def test_nothing_is_infinite(dtype):
    candidates = solve(mixed(8, 2000), dtype)
    poses = candidates.models.wxyz_xyz
    assert np.isfinite(poses).all()
    assert (poses[~candidates.valid] == np.eye(7)[0]).all()


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(4):
        assert np.isfinite(solve(mixed(seed, 125_000), dtype).models.wxyz_xyz).all()


@pytest.mark.slow
def test_gradients_equal_central_differences(x64):
    data, *_ = problems(1, N, 11, sigma=3e-3)
    assert_derivatives(gpnp, solve_last, [x[0] for x in data])


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    gradient = jax.jit(jax.vmap(jax.grad(lambda *x: jnp.sum(gpnp(*x).models.wxyz_xyz), (0, 1, 2, 3)), -1, -1))
    for part in gradient(*lanes(*mixed(12, 2048), dtype=np.float32)):
        assert np.isfinite(part).all()


def test_wrong_numbers_are_refused():
    with pytest.raises(ValueError, match="found 3 points; expected at least 4"):
        gpnp(jnp.zeros((3, 3)), jnp.zeros((3, 3)), jnp.zeros((3, 3)))
    with pytest.raises(ValueError, match="expected equal shapes"):
        correspondences(jnp.zeros((5, 3)), jnp.zeros((4, 3)), jnp.zeros((5, 3)), None)
