import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation

from tests.solvers.derivatives import assert_derivatives
from tests.solvers.problems import lanes, recall, solve_in_batches
from vojax.solvers import generalized_relative_pose
from vojax.solvers._generalized_relative import correspondences

pytestmark = pytest.mark.optimized

N = 17
solve_last = jax.jit(jax.vmap(generalized_relative_pose, in_axes=-1, out_axes=-1))
DEGENERATE = ["one centre", "one correspondence", "zero ray", "zeros", "nan", "inf"]


def problems(count, seed=0, n=N, sigma=0.0, across=False):
    """Unit rays of both views, their centres [count, n, 3]; R and t of rig1_from_rig0.

    Four cameras half a unit from the middle; points 2.5 to 10 units away; turns of half a radian and motions of one
    unit. Each camera sees its points again, unless `across`.
    """
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.normal(size=(count, 3)) * 0.3).as_matrix()
    translation = rng.normal(size=(count, 3))
    translation /= np.linalg.norm(translation, axis=-1, keepdims=True)
    rig = rng.normal(size=(count, 4, 3))
    rig *= 0.5 / np.linalg.norm(rig, axis=-1, keepdims=True)
    camera = np.arange(n) % 4
    other = rng.permuted(np.tile(camera, (count, 1)), axis=1) if across else np.tile(camera, (count, 1))
    centers0 = rig[:, camera]
    centers1 = np.take_along_axis(rig, other[..., None], axis=1)
    direction = rng.normal(size=(count, n, 3))
    points = direction / np.linalg.norm(direction, axis=-1, keepdims=True) * rng.uniform(2.5, 10.0, (count, n, 1))
    rays0 = points - centers0
    rays1 = np.einsum("bij,bnj->bni", rotation, points) + translation[:, None] - centers1
    unit = [x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (rays0, rays1)]
    unit = [x + sigma * rng.normal(size=x.shape) for x in unit]
    return (*unit, centers0, centers1), rotation, translation


def solve(data, dtype):
    return solve_in_batches(solve_last, *data, dtype=dtype)


def spoiled(data, kind):
    rays0, rays1, centers0, centers1 = (x.copy() for x in data)
    if kind == "one centre":
        centers0[:], centers1[:] = centers0[:, :1], centers1[:, :1]
    elif kind == "one correspondence":
        rays0[:], rays1[:] = rays0[:, :1], rays1[:, :1]
        centers0[:], centers1[:] = centers0[:, :1], centers1[:, :1]
    elif kind == "zero ray":
        rays0[:, 3] = 0.0
    elif kind == "zeros":
        for x in (rays0, rays1, centers0, centers1):
            x[:] = 0.0
    elif kind == "nan":
        centers0[:, 2, 1] = np.nan
    elif kind == "inf":
        rays1[:, 5, 0] = np.inf
    elif kind == "no motion":
        rays1, centers1 = rays0.copy(), centers0.copy()
    elif kind == "huge":
        centers0, centers1 = centers0 * 1e30, centers1 * 1e30
    elif kind == "tiny":
        centers0, centers1 = centers0 * 1e-30, centers1 * 1e-30
    return rays0, rays1, centers0, centers1


def mixed(seed, count):
    data, *_ = problems(count, seed)
    kinds = [*DEGENERATE, "no motion", "huge", "tiny"]
    for part, kind in zip(np.array_split(np.arange(count // 2), len(kinds)), kinds, strict=True):
        for x, y in zip(data, spoiled([x[part] for x in data], kind), strict=True):
            x[part] = y
    return data


@pytest.mark.parametrize("across", [False, True], ids=["same camera", "across cameras"])
def test_finds_the_truth(dtype, across):
    data, rotation, translation = problems(2048, 1, across=across)
    candidates = solve(data, dtype)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-2) >= 0.98
    else:
        assert recall(candidates, rotation, translation, 1e-6) >= 0.995


@pytest.mark.slow
@pytest.mark.parametrize("n", [17, 20])
def test_finds_the_truth_in_many_problems(x64, n):
    data, rotation, translation = problems(100_000, 2, n=n)
    assert recall(solve(data, np.float64), rotation, translation, 1e-6) >= 0.99


def test_with_noise_it_is_a_minimum(x64):
    data, rotation, _ = problems(40, 3, sigma=3e-4)
    candidates = solve(data, np.float64)
    assert candidates.valid.mean() >= 0.9
    agreeing = 0
    for i in np.flatnonzero(candidates.valid[:, 0]):
        f0, f1, c0, c1 = (x[i] for x in data)
        f0, f1 = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (f0, f1))
        ours = candidates.models.wxyz_xyz[i, 0]
        start = Rotation.from_quat(ours[[1, 2, 3, 0]])

        def residual(v, f0=f0, f1=f1, c0=c0, c1=c1, start=start, ours=ours):
            turn = Rotation.from_rotvec(v[:3]) * start
            arm = turn.apply(c0) + ours[4:] + v[3:] - c1
            return np.sum(f1 * np.cross(arm, turn.apply(f0)), axis=-1)

        found = scipy.optimize.least_squares(residual, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert np.sum(residual(np.zeros(6)) ** 2) <= 2.0 * found.cost * (1.0 + 1e-8)
        agreeing += np.abs(start.as_matrix() - rotation[i]).max() < 0.1
    assert agreeing >= 34


def test_unit_of_length_and_far_origins(x64):
    (rays0, rays1, centers0, centers1), rotation, translation = problems(200, 4)
    for size in (1e-3, 1e3):
        candidates = solve((rays0, 5.0 * rays1, size * centers0, size * centers1), np.float64)
        assert recall(candidates, rotation, size * translation, 1e-6) >= 0.98
    away = np.array([10.0, -20.0, 5.0])
    candidates = solve((rays0, rays1, centers0, centers1 + away), np.float64)
    assert recall(candidates, rotation, translation + away, 1e-6) >= 0.98


@pytest.mark.parametrize("kind", DEGENERATE)
def test_impossible_problems_have_no_valid_slot(dtype, kind):
    data, *_ = problems(64, 9)
    candidates = solve(spoiled(data, kind), dtype)
    assert not candidates.valid.any()
    np.testing.assert_array_equal(candidates.models.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (64, 1, 7)))


def test_nothing_is_infinite(dtype):
    candidates = solve(mixed(8, 2048), dtype)
    poses = candidates.models.wxyz_xyz
    assert np.isfinite(poses).all()
    assert (poses[~candidates.valid] == np.eye(7)[0]).all()


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(4):
        assert np.isfinite(solve(mixed(seed, 125_000), dtype).models.wxyz_xyz).all()


@pytest.mark.slow
def test_gradients_equal_central_differences(x64):
    data, *_ = problems(1, 11, sigma=3e-4)
    assert_derivatives(generalized_relative_pose, solve_last, [x[0] for x in data])


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    def total(*data):
        return jnp.sum(generalized_relative_pose(*data).models.wxyz_xyz)

    for part in jax.jit(jax.vmap(jax.grad(total, (0, 1, 2, 3)), -1, -1))(*lanes(*mixed(12, 2048), dtype=np.float32)):
        assert np.isfinite(part).all()


def test_wrong_numbers_are_refused():
    with pytest.raises(ValueError, match="expected at least 17"):
        generalized_relative_pose(*(jnp.zeros((16, 3)),) * 4)
    with pytest.raises(ValueError, match="expected equal shapes"):
        correspondences(jnp.zeros((17, 3)), jnp.zeros((18, 3)), jnp.zeros((17, 3)), jnp.zeros((17, 3)))
