"""The five-point solvers: against truth, each other and PoseLib; planes, rotations, impossible input; derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest

from tests.solvers.problems import (
    central_differences,
    essential_matrices,
    lanes,
    matrix_recall,
    relative_pose_problems,
    solve_in_batches,
)
from vojax.solvers import five_point, five_point_action_matrix

SOLVERS = {"five_point": five_point, "five_point_action_matrix": five_point_action_matrix}
jitted = {name: jax.jit(jax.vmap(solver, in_axes=-1, out_axes=-1)) for name, solver in SOLVERS.items()}


@functools.cache
def solved(name, dtype_name, count=4096, seed=1, planar=False):
    rays0, rays1, rotation, translation = relative_pose_problems(count, 5, seed, planar)
    with jax.enable_x64(dtype_name == "float64"):
        candidates = solve_in_batches(jitted[name], rays0, rays1, dtype=dtype_name)
    return rays0, rays1, essential_matrices(rotation, translation), candidates


# The second back-end is there to be compared with, which float64 does.
BOTH = [
    ("five_point", "float32"),
    ("five_point", "float64"),
    ("five_point_action_matrix", "float64"),
    pytest.param("five_point_action_matrix", "float32", marks=pytest.mark.slow),
]
both = pytest.mark.parametrize(("name", "dtype_name"), BOTH)


@both
def test_matrices_are_essential_and_satisfy_the_equations(name, dtype_name):
    rays0, rays1, _, candidates = solved(name, dtype_name)
    tolerance = 1e-4 if dtype_name == "float32" else 1e-12
    models = candidates.models.astype(np.float64)
    residual = np.abs(np.einsum("bni,bsij,bnj->bsn", rays1, models, rays0)).max(axis=-1)[candidates.valid]
    assert residual.max() < tolerance
    singular = np.linalg.svd(models[candidates.valid], compute_uv=False)
    assert np.abs(singular - np.array([0.5, 0.5, 0.0]) ** 0.5).max() < tolerance
    largest = np.take_along_axis(
        models.reshape(-1, 10, 9), np.abs(models.reshape(-1, 10, 9)).argmax(axis=-1)[..., None], axis=-1
    )
    assert np.all(largest[candidates.valid] > 0)
    np.testing.assert_array_equal(candidates.models[~candidates.valid], 0.0)


@both
def test_solutions_are_distinct(name, dtype_name):
    *_, candidates = solved(name, dtype_name)
    models = candidates.models.astype(np.float64).reshape(-1, 10, 9)
    gap = np.abs(models[:, :, None] - models[:, None]).max(axis=-1)
    both = candidates.valid[:, :, None] & candidates.valid[:, None] & ~np.eye(10, dtype=bool)
    assert np.mean(gap[both] < (1e-4 if dtype_name == "float32" else 1e-8)) < 1e-3


@both
def test_finds_the_truth(name, dtype_name):
    _, _, truth, candidates = solved(name, dtype_name)
    if dtype_name == "float32":
        assert matrix_recall(candidates, truth, 1e-3) >= 0.97
    else:
        assert matrix_recall(candidates, truth, 1e-6) >= 0.999


@both
@pytest.mark.slow
def test_finds_the_truth_in_many_problems(name, dtype_name):
    _, _, truth, candidates = solved(name, dtype_name, count=102_400, seed=2)
    if dtype_name == "float32":
        assert matrix_recall(candidates, truth, 1e-3) >= 0.98
    else:
        assert matrix_recall(candidates, truth, 1e-6) >= 0.999


@both
def test_points_on_a_plane_are_no_special_case(name, dtype_name):
    _, _, truth, candidates = solved(name, dtype_name, count=2048, seed=3, planar=True)
    if dtype_name == "float32":
        assert matrix_recall(candidates, truth, 1e-3) >= 0.93
    else:
        assert matrix_recall(candidates, truth, 1e-6) >= 0.995


def unsigned_gap(models, others):
    """Distances [.., s, t] between matrices up to sign."""
    a, b = models[..., :, None, :, :], others[..., None, :, :, :]
    return np.minimum(np.abs(a - b).max(axis=(-1, -2)), np.abs(a + b).max(axis=(-1, -2)))


def test_both_back_ends_find_the_same():
    first, second = (solved(name, "float64")[3] for name in SOLVERS)
    gap = unsigned_gap(first.models, second.models)
    gap = np.where(first.valid[:, :, None] & second.valid[:, None], gap, np.inf)
    for valid, axis in ((first.valid, 2), (second.valid, 1)):
        # The rest are close pairs of roots that one of them took for complex.
        assert np.mean(gap.min(axis=axis)[valid] < 1e-8) > 0.999


def test_finds_the_matrices_poselib_finds():
    rays0, rays1, _, candidates = solved("five_point", "float64")
    found = missed = ours = 0
    for i in range(500):
        poses = poselib.relpose_5pt(list(rays0[i]), list(rays1[i]))
        if not poses:
            continue
        theirs = essential_matrices(np.array([pose.R for pose in poses]), np.array([pose.t for pose in poses]))
        # One in fifty of PoseLib's answers satisfies the equations to 1e-8 only, and some to 1e-2.
        theirs = theirs[np.abs(np.einsum("ni,sij,nj->sn", rays1[i], theirs, rays0[i])).max(axis=1) < 1e-10]
        gap = unsigned_gap(candidates.models[i][candidates.valid[i]], theirs).min(axis=0, initial=np.inf)
        found += np.sum(gap < 1e-5)
        missed += np.sum(gap >= 1e-5)
        ours += candidates.valid[i].sum()
    assert found > 1000
    assert missed <= 1
    # PoseLib keeps only the motions that have all points in front: the matrices are more.
    assert ours > found


def test_number_of_solutions_is_even_and_at_most_ten():
    # Ten complex solutions, so an even number of real ones but for double roots.
    *_, candidates = solved("five_point", "float64")
    counts = candidates.valid.sum(axis=1)
    assert np.mean(counts % 2 == 0) > 0.99
    assert counts.max() in (8, 10)
    # The true one is there, unless it is next to a double root that rounding made complex.
    assert np.mean(counts >= 1) > 0.999


@pytest.mark.slow
def test_one_problem_alone(x64):
    rays0, rays1, _, candidates = solved("five_point", "float64")
    for i in range(3):
        single = five_point(rays0[i], rays1[i])
        np.testing.assert_array_equal(single.valid, candidates.valid[i])
        np.testing.assert_allclose(single.models, candidates.models[i], atol=1e-9)


@pytest.mark.slow
def test_many_lanes_give_what_few_give():
    rays0, rays1, rotation, translation = relative_pose_problems(65_536, 5, seed=6)
    many = jitted["five_point"](*lanes(rays0, rays1, dtype=np.float32))
    many = jax.tree.map(lambda x: np.moveaxis(np.asarray(x), -1, 0), many)
    few = solve_in_batches(jitted["five_point"], rays0, rays1, dtype=np.float32)
    assert (few.valid == many.valid).all(axis=-1).mean() > 0.99
    truth = essential_matrices(rotation, translation)
    assert abs(matrix_recall(many, truth, 1e-3) - matrix_recall(few, truth, 1e-3)) < 2e-3


def test_rays_of_any_length_and_behind_the_image_plane(x64):
    rays0, rays1, truth, _ = solved("five_point", "float64")
    rng = np.random.default_rng(0)
    count = 2048
    scaled = [rays[:count] * 10.0 ** rng.uniform(-3, 3, (count, 5, 1)) for rays in (rays0, rays1)]
    candidates = solve_in_batches(jitted["five_point"], *scaled, dtype=np.float64)
    assert matrix_recall(candidates, truth[:count], 1e-6) >= 0.999
    # A camera that sees all around: rays with z < 0 are ordinary.
    points = rng.normal(size=(count, 5, 3)) * 4.0
    _, _, rotation, translation = relative_pose_problems(count, 5, seed=9)
    moved = np.einsum("bij,bnj->bni", rotation, points) + translation[:, None]
    candidates = solve_in_batches(jitted["five_point"], points, moved, dtype=np.float64)
    assert matrix_recall(candidates, essential_matrices(rotation, translation), 1e-6) >= 0.999


def test_a_pure_rotation_leaves_the_translation_open(x64):
    # ray1 = R ray0: E = [t]× R solves for every t. What comes out satisfies the equations and says nothing of t.
    rays0, _, rotation, _ = relative_pose_problems(2048, 5, seed=4)
    rays1 = np.einsum("bij,bnj->bni", rotation, rays0)
    candidates = solve_in_batches(jitted["five_point"], rays0, rays1, dtype=np.float64)
    residual = np.abs(np.einsum("bni,bsij,bnj->bsn", rays1, candidates.models, rays0)).max(axis=-1)
    assert np.isfinite(candidates.models).all()
    assert residual[candidates.valid].max(initial=0.0) < 1e-9


@both
@pytest.mark.parametrize("spoil", ["twice", "one ray", "zero", "nan", "inf", "all zero"])
def test_impossible_problems_have_no_valid_slot(name, dtype_name, spoil):
    rays0, rays1, *_ = relative_pose_problems(64, 5, seed=5)
    if spoil == "twice":
        rays0[:, 4], rays1[:, 4] = rays0[:, 3], rays1[:, 3]
    elif spoil == "one ray":
        rays0[:], rays1[:] = rays0[:, :1], rays1[:, :1]
    elif spoil == "zero":
        rays0[:, 2] = 0.0
    elif spoil == "nan":
        rays1[:, 0, 1] = np.nan
    elif spoil == "inf":
        rays1[:, 3, 2] = np.inf
    else:
        rays0[:] = 0.0
    with jax.enable_x64(dtype_name == "float64"):
        candidates = solve_in_batches(jitted[name], rays0, rays1, dtype=dtype_name)
    assert np.isfinite(candidates.models).all()
    assert not candidates.valid.any()


def mixed(seed, count):
    """Random problems, half of them degenerate in one of several ways or absurd."""
    rays0, rays1, rotation, _ = relative_pose_problems(count, 5, seed)
    rng = np.random.default_rng(seed)
    kinds = np.array_split(rng.permutation(count)[: count // 2], 9)
    rays0[kinds[0], 4], rays1[kinds[0], 4] = rays0[kinds[0], 3], rays1[kinds[0], 3]
    rays0[kinds[1]] = rays0[kinds[1], :1]
    rays0[kinds[2], 1] = 0.0
    rays1[kinds[3], 2, 2] = np.nan
    rays1[kinds[4], 0, 0] = np.inf
    rays1[kinds[5]] = np.einsum("bij,bnj->bni", rotation[kinds[5]], rays0[kinds[5]])
    rays0[kinds[6]] *= 1e30
    rays1[kinds[7]] *= 1e-30
    rays1[kinds[8]] = rays0[kinds[8]]
    return rays0, rays1


@functools.cache
def weighted_sum():
    def function(rays0, rays1):
        candidates = five_point(rays0, rays1)
        factors = jnp.linspace(0.3, 1.7, 90).reshape(10, 3, 3)
        return jnp.sum(jnp.where(candidates.valid[:, None, None], candidates.models, 0.0) * factors)

    return jax.jit(function), jax.jit(jax.grad(function, (0, 1))), jax.jit(jax.jacfwd(function, (0, 1)))


@pytest.mark.slow
def test_gradients_equal_central_differences(x64):
    function, reverse, forward = weighted_sum()
    rays0, rays1, *_ = relative_pose_problems(3, 5, seed=11)
    for a, b in zip(rays0, rays1, strict=True):
        for index, (back, ahead) in enumerate(zip(reverse(a, b), forward(a, b), strict=True)):
            numeric = central_differences(function, (a, b), index)
            np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())
            np.testing.assert_allclose(ahead, back, rtol=1e-9, atol=1e-9 * np.abs(numeric).max())


@pytest.mark.slow
@pytest.mark.parametrize("dtype_name", ["float32", "float64"])
def test_nothing_is_ever_infinite(dtype_name):
    with jax.enable_x64(dtype_name == "float64"):
        for seed in range(8):
            rays0, rays1 = mixed(seed, 131_072)
            candidates = solve_in_batches(jitted["five_point"], rays0, rays1, dtype=dtype_name, size=16_384)
            assert np.isfinite(candidates.models).all()
        gradient = jax.jit(jax.vmap(jax.grad(lambda a, b: jnp.sum(five_point(a, b).models), (0, 1)), -1, -1))
        for part in gradient(*lanes(*mixed(20, 20_000), dtype=dtype_name)):
            assert np.isfinite(part).all()


@pytest.mark.parametrize("dtype_name", ["float32", "float64"])
def test_degenerate_problems_stay_finite(dtype_name):
    with jax.enable_x64(dtype_name == "float64"):
        candidates = solve_in_batches(jitted["five_point"], *mixed(8, 2048), dtype=dtype_name)
    assert np.isfinite(candidates.models).all()


def test_wrong_shapes_are_said_in_one_line():
    with pytest.raises((ValueError, TypeError)):
        five_point(np.ones((6, 3)), np.ones((6, 3)))
