import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.derivatives import assert_derivatives
from tests.solvers.problems import essential_matrices, lanes, solve_in_batches
from vojax.solvers import focal_from_fundamental, shared_focal_from_fundamental

both_last = jax.jit(jax.vmap(focal_from_fundamental, in_axes=-1, out_axes=-1))
shared_last = jax.jit(jax.vmap(shared_focal_from_fundamental, in_axes=-1, out_axes=-1))
SOLVERS = pytest.mark.parametrize("solver", [both_last, shared_last], ids=["both", "shared"])
DEGENERATE = ["zeros", "nan", "inf", "rank one"]


def problems(count, seed=0, shared=False, motion="general"):
    """F, principal points [count, 2] and focal lengths [count, 2]."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.normal(size=(count, 3)) * 0.4)
    translation = rng.normal(size=(count, 3))
    if motion == "coplanar":
        # Turns about y and moves in the plane of the axes.
        rotation = Rotation.from_rotvec(rng.uniform(0.2, 0.8, (count, 1)) * np.array([[0.0, 1.0, 0.0]]))
        translation[:, 1] = 0.0
    elif motion == "parallel":
        rotation = Rotation.from_rotvec(np.zeros((count, 3)))
    essential = essential_matrices(rotation.as_matrix(), translation)
    focal = rng.uniform(500.0, 1500.0, (count, 2))
    focal = focal[:, :1] * np.ones(2) if shared else focal
    centres = rng.uniform(300.0, 700.0, (2, count, 2))
    inverse = np.zeros((2, count, 3, 3))
    for k in range(2):
        inverse[k, :, 0, 0] = inverse[k, :, 1, 1] = 1.0 / focal[:, k]
        inverse[k, :, :2, 2] = -centres[k] / focal[:, k, None]
        inverse[k, :, 2, 2] = 1.0
    fundamental = np.einsum("bji,bjk,bkl->bil", inverse[1], essential, inverse[0])
    fundamental /= np.linalg.norm(fundamental, axis=(1, 2), keepdims=True)
    return (fundamental, centres[0], centres[1]), focal


def best_errors(candidates, focal):
    errors = np.abs(candidates.models.reshape(*candidates.valid.shape, -1) / focal[:, None] - 1.0).max(axis=-1)
    return np.where(candidates.valid, errors, np.inf).min(axis=1)


def spoiled(data, kind):
    fundamental, point0, point1 = (x.copy() for x in data)
    if kind == "zeros":
        fundamental[:] = 0.0
    elif kind == "nan":
        fundamental[:, 1, 2] = np.nan
    elif kind == "inf":
        point0[:, 1] = np.inf
    elif kind == "rank one":
        fundamental = fundamental[:, :, :1] * fundamental[:, :1, :]
    elif kind == "huge":
        fundamental *= 1e30
    elif kind == "tiny":
        fundamental *= 1e-30
    elif kind == "far":
        point1 *= 1e12
    return fundamental, point0, point1


def mixed(seed, count):
    data, _ = problems(count, seed)
    kinds = [*DEGENERATE, "huge", "tiny", "far"]
    for part, kind in zip(np.array_split(np.arange(count // 2), len(kinds)), kinds, strict=True):
        for x, y in zip(data, spoiled([x[part] for x in data], kind), strict=True):
            x[part] = y
    return data


def test_two_focal_lengths(dtype):
    data, focal = problems(4000, 1)
    errors = best_errors(solve_in_batches(both_last, *data, dtype=dtype), focal)
    if dtype == jnp.float32:
        assert (errors < 1e-2).mean() >= 0.97
    else:
        assert (errors < 1e-6).mean() >= 0.999


def test_shared_focal_length(dtype):
    data, focal = problems(4000, 2, shared=True)
    errors = best_errors(solve_in_batches(shared_last, *data, dtype=dtype), focal[:, :1])
    if dtype == jnp.float32:
        assert (errors < 1e-2).mean() >= 0.97
    else:
        assert (errors < 1e-6).mean() >= 0.997


@pytest.mark.slow
def test_many_problems(x64):
    data, focal = problems(100_000, 3)
    assert (best_errors(solve_in_batches(both_last, *data, dtype=np.float64), focal) < 1e-6).mean() >= 0.9995
    data, focal = problems(100_000, 4, shared=True)
    errors = best_errors(solve_in_batches(shared_last, *data, dtype=np.float64), focal[:, :1])
    assert (errors < 1e-6).mean() >= 0.998


def test_agrees_with_poselib(x64):
    data, _ = problems(200, 5)
    candidates = solve_in_batches(both_last, *data, dtype=np.float64)
    compared = 0
    for i in range(200):
        cameras = poselib.focals_from_fundamental(*(x[i] for x in data))
        theirs = np.array([camera.focal() for camera in cameras])
        if candidates.valid[i, 0]:
            np.testing.assert_allclose(candidates.models[i, 0], theirs, rtol=1e-5)
            compared += 1
    assert compared > 190


def test_axes_in_one_plane(x64):
    # They meet: two focal lengths do not follow, a shared one does up to a choice of two.
    data, focal = problems(500, 6, shared=True, motion="coplanar")
    assert not solve_in_batches(both_last, *data, dtype=np.float64).valid.any()
    candidates = solve_in_batches(shared_last, *data, dtype=np.float64)
    assert (best_errors(candidates, focal[:, :1]) < 1e-5).mean() > 0.98


def test_parallel_axes_have_no_two_focal_lengths(x64):
    data, _ = problems(500, 7, motion="parallel")
    assert not solve_in_batches(both_last, *data, dtype=np.float64).valid.any()


@SOLVERS
@pytest.mark.parametrize("kind", DEGENERATE)
def test_impossible_problems_have_no_valid_slot(solver, kind, dtype):
    data, _ = problems(64, 9)
    candidates = solve_in_batches(solver, *spoiled(data, kind), dtype=dtype)
    assert not candidates.valid.any()
    assert (candidates.models == 1.0).all()


@SOLVERS
def test_nothing_is_infinite(solver, dtype):
    candidates = solve_in_batches(solver, *mixed(8, 4000), dtype=dtype)
    assert np.isfinite(candidates.models).all()
    assert (candidates.models[~candidates.valid] == 1.0).all()


def in_units_of_the_image(data):
    """One problem with pixels and focal lengths of the order of one, for the sake of the differences."""
    fundamental, point0, point1 = (x[0] for x in data)
    unit = np.diag([1000.0, 1000.0, 1.0])
    fundamental = unit @ fundamental @ unit
    return fundamental / np.linalg.norm(fundamental), point0 / 1000.0, point1 / 1000.0


def test_gradients_equal_central_differences(x64):
    data, _ = problems(1, 11)
    assert_derivatives(focal_from_fundamental, both_last, in_units_of_the_image(data))


@pytest.mark.slow
def test_gradients_of_a_shared_focal_length(x64):
    data, _ = problems(1, 12, shared=True)
    assert_derivatives(shared_focal_from_fundamental, shared_last, in_units_of_the_image(data))


@pytest.mark.slow
@pytest.mark.parametrize("solver", [focal_from_fundamental, shared_focal_from_fundamental])
def test_gradients_are_finite_everywhere(solver):
    gradient = jax.jit(jax.vmap(jax.grad(lambda *x: jnp.sum(solver(*x).models), (0, 1, 2)), -1, -1))
    for part in gradient(*lanes(*mixed(13, 2048), dtype=np.float32)):
        assert np.isfinite(part).all()
