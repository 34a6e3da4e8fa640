import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.derivatives import assert_derivatives
from tests.solvers.problems import lanes, recall, solve_in_batches
from vojax.solvers._point_line import features, p1p2l, p2p1l, p3l

lines_last = jax.jit(jax.vmap(p3l, in_axes=-1, out_axes=-1))
mixed_last = {
    1: jax.jit(jax.vmap(p1p2l, in_axes=-1, out_axes=-1)),
    2: jax.jit(jax.vmap(p2p1l, in_axes=-1, out_axes=-1)),
}
DEGENERATE = ["one line", "equal ends", "zero line", "zeros", "nan", "inf"]


def problems(count, seed=0, points=0):
    """Points, bearings, ends of lines and image lines, batch first; rotations and translations of cam_from_world."""
    rng = np.random.default_rng(seed)

    def cam(*shape):
        rays = np.concatenate([rng.uniform(-0.7, 0.7, (*shape, 2)), np.ones((*shape, 1))], axis=-1)
        return rays * rng.uniform(2.0, 10.0, (*shape, 1))

    seen, ends = cam(count, points), cam(count, 3 - points, 2)
    rotation = Rotation.random(count, rng=rng).as_matrix()
    translation = rng.normal(size=(count, 3)) * 2.0

    def world(x):
        return np.einsum("bji,b...j->b...i", rotation, x - translation.reshape(count, *(1,) * (x.ndim - 2), 3))

    lines = np.cross(ends[:, :, 0], ends[:, :, 1])
    lines /= np.linalg.norm(lines, axis=-1, keepdims=True)
    bearings = seen / np.linalg.norm(seen, axis=-1, keepdims=True)
    return (world(seen), bearings, world(ends), lines), rotation, translation


def solve(data, dtype):
    return solve_in_batches(lines_last, *data[2:], dtype=dtype)


def spoiled(data, kind):
    ends, lines = (x.copy() for x in data[2:])
    if kind == "one line":
        ends[:, 1:], lines[:, 1:] = ends[:, :1], lines[:, :1]
    elif kind == "equal ends":
        ends[:, 1, 1] = ends[:, 1, 0]
    elif kind == "zero line":
        lines[:, 2] = 0.0
    elif kind == "zeros":
        ends[:], lines[:] = 0.0, 0.0
    elif kind == "nan":
        ends[:, 0, 1, 2] = np.nan
    elif kind == "inf":
        lines[:, 1, 0] = np.inf
    elif kind == "parallel":
        ends[:, :, 1] = ends[:, :, 0] + (ends[:, :1, 1] - ends[:, :1, 0])
    elif kind == "huge":
        ends *= 1e30
    elif kind == "tiny":
        ends *= 1e-30
    return data[0], data[1], ends, lines


def mixed(seed, count):
    data, *_ = problems(count, seed)
    kinds = [*DEGENERATE, "parallel", "huge", "tiny"]
    for part, kind in zip(np.array_split(np.arange(count // 2), len(kinds)), kinds, strict=True):
        for x, y in zip(data, spoiled([x[part] for x in data], kind), strict=True):
            x[part] = y
    return data


def test_finds_the_truth(dtype):
    data, rotation, translation = problems(4000, 1)
    candidates = solve(data, dtype)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-3) >= 0.98
    else:
        assert recall(candidates, rotation, translation, 1e-6) >= 0.998


@pytest.mark.slow
@pytest.mark.parametrize("points", [0, 1, 2])
def test_finds_the_truth_in_many_problems(dtype, points):
    data, rotation, translation = problems(100_000, 3, points)
    solver = mixed_last[points] if points else lines_last
    candidates = solve_in_batches(solver, *(data if points else data[2:]), dtype=dtype)
    if dtype == jnp.float32:
        assert recall(candidates, rotation, translation, 1e-3) >= 0.98
    else:
        assert recall(candidates, rotation, translation, 1e-6) >= 0.999


@pytest.mark.slow
@pytest.mark.parametrize("points", [0, 1, 2])
def test_finds_what_poselib_finds(x64, points):
    data, *_ = problems(300, 2, points)
    solver = mixed_last[points] if points else lines_last
    candidates = solve_in_batches(solver, *(data if points else data[2:]), dtype=np.float64)
    found = missed = 0
    for i in range(300):
        x, f, ends, lines = (a[i] for a in data)
        through, along = ends[:, 0], ends[:, 1] - ends[:, 0]
        along = along / np.linalg.norm(along, axis=-1, keepdims=True)
        if points == 0:
            theirs = poselib.p3ll(list(lines), list(through), list(along))
        else:
            solver = {1: poselib.p1p2ll, 2: poselib.p2p1ll}[points]
            theirs = solver(list(f), list(x), list(lines), list(through), list(along))
        ours = candidates.models.wxyz_xyz[i][candidates.valid[i]]
        for pose in theirs:
            cam = np.einsum("ij,nj->ni", pose.R, ends.reshape(-1, 3)) + pose.t
            exact = np.abs(np.sum(cam.reshape(ends.shape) * lines[:, None], axis=-1)).max() < 1e-8
            in_front = (np.sum(f * (x @ pose.R.T + pose.t), axis=-1) > 0).all()
            if exact and in_front:
                gap = np.abs(ours[:, 4:] - pose.t).max(axis=1) if len(ours) else np.full(1, np.inf)
                near = gap.min() < 1e-5 * (1.0 + np.abs(pose.t).max())
                found += near
                missed += not near
    assert found > 300
    assert missed <= 2


def test_valid_slots_solve_the_equations(x64):
    data, *_ = problems(2000, 4)
    candidates = solve(data, np.float64)
    poses = candidates.models.wxyz_xyz
    rotation = Rotation.from_quat(poses[..., [1, 2, 3, 0]].reshape(-1, 4)).as_matrix().reshape(2000, 8, 3, 3)
    cam = np.einsum("bsij,bnkj->bsnki", rotation, data[2]) + poses[:, :, None, None, 4:]
    error = np.abs(np.sum(cam * data[3][:, None, :, None], axis=-1)).max(axis=(2, 3))
    size = np.abs(cam).max(axis=(2, 3, 4))
    assert np.quantile((error / size)[candidates.valid], 0.99) < 1e-11
    assert (candidates.valid.sum(axis=1) > 1).mean() > 0.5  # lines alone leave a choice


@pytest.mark.parametrize("kind", DEGENERATE)
def test_impossible_problems_have_no_valid_slot(dtype, kind):
    data, *_ = problems(64, 9)
    candidates = solve(spoiled(data, kind), dtype)
    assert not candidates.valid.any()
    np.testing.assert_array_equal(candidates.models.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (64, 8, 7)))


def test_nothing_is_infinite(dtype):
    candidates = solve(mixed(8, 2000), dtype)
    poses = candidates.models.wxyz_xyz
    assert np.isfinite(poses).all()
    assert (poses[~candidates.valid] == np.eye(7)[0]).all()


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(8):
        assert np.isfinite(solve(mixed(seed, 125_000), dtype).models.wxyz_xyz).all()


@pytest.mark.slow
def test_gradients_equal_central_differences(x64):
    data, *_ = problems(1, 11)
    assert_derivatives(p3l, lines_last, (data[2][0], data[3][0]))


@pytest.mark.slow
@pytest.mark.parametrize("points", [1, 2])
def test_gradients_of_mixed_features(x64, points):
    data, *_ = problems(1, 12, points)
    assert_derivatives({1: p1p2l, 2: p2p1l}[points], mixed_last[points], [x[0] for x in data])


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    gradient = jax.jit(jax.vmap(jax.grad(lambda *x: jnp.sum(p3l(*x).models.wxyz_xyz), (0, 1)), -1, -1))
    for part in gradient(*lanes(*mixed(12, 2048)[2:], dtype=np.float32)):
        assert np.isfinite(part).all()


def test_wrong_numbers_are_refused():
    none = jnp.zeros((0, 3))
    with pytest.raises(ValueError, match="expected \\(3, 2, 3\\)"):
        features(none, none, jnp.zeros((2, 2, 3)), jnp.zeros((2, 3)), 0)
