import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vojax.solvers import procrustes, umeyama

SOLVERS = pytest.mark.parametrize("solver", [procrustes, umeyama])
batched = {solver: jax.jit(jax.vmap(solver)) for solver in (procrustes, umeyama)}


def problems(count=200, n=10, noise=0.05, seed=0):
    """Points in two frames, weights, and the motions [count, 3, 3], [count, 3]."""
    rng = np.random.default_rng(seed)
    points0 = rng.normal(size=(count, n, 3))
    rotation = Rotation.random(count, rng=rng).as_matrix()
    translation = rng.normal(size=(count, 3)) * 3.0
    points1 = (
        np.einsum("bij,bnj->bni", rotation, points0) + translation[:, None] + noise * rng.normal(size=points0.shape)
    )
    return points0, points1, rng.uniform(0.1, 2.0, (count, n)), rotation, translation


def reference(points0, points1, weights, with_scale):
    """Umeyama's formulas with numpy's SVD."""
    w = weights / weights.sum()
    mean0, mean1 = w @ points0, w @ points1
    x, y = points0 - mean0, points1 - mean1
    u, s, vt = np.linalg.svd((w[:, None] * y).T @ x)
    signs = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = u @ np.diag(signs) @ vt
    scale = (s * signs).sum() / (w @ (x * x).sum(axis=1)) if with_scale else 1.0
    return rotation, mean1 - scale * rotation @ mean0, scale


def matrices(model):
    rotation = np.asarray(model.rotation().as_matrix(), np.float64)
    return rotation, np.asarray(model.translation(), np.float64), np.asarray(getattr(model, "scale", lambda: 1.0)())


@SOLVERS
def test_equals_the_reference(solver, dtype):
    points0, points1, weights, *_ = problems()
    if solver is umeyama:
        points1 = 2.5 * points1
    candidates = batched[solver](*(x.astype(dtype) for x in (points0, points1, weights)))
    assert candidates.valid.shape == (200, 1)
    assert candidates.valid.all()
    rotation, translation, scale = matrices(candidates.models)
    tolerance = 2e-4 if dtype == jnp.float32 else 1e-11
    for i in range(200):
        r, t, s = reference(points0[i], points1[i], weights[i], solver is umeyama)
        np.testing.assert_allclose(rotation[i, 0], r, atol=tolerance)
        np.testing.assert_allclose(translation[i, 0], t, atol=10 * tolerance)
        if solver is umeyama:
            np.testing.assert_allclose(scale[i, 0], s, atol=tolerance)


def test_equals_scipy(x64):
    points0, points1, weights, *_ = problems(count=1)
    w = weights[0] / weights[0].sum()
    expected, _ = Rotation.align_vectors(points1[0] - w @ points1[0], points0[0] - w @ points0[0], weights=w)
    found = procrustes(points0[0], points1[0], weights[0]).models.rotation().as_matrix()[0]
    np.testing.assert_allclose(found, expected.as_matrix(), atol=1e-12)


@SOLVERS
def test_recovers_exact_motions_from_three_points(solver, dtype):
    points0, points1, weights, rotation, translation = problems(noise=0.0)
    weights[:, 3:] = 0.0
    candidates = batched[solver](*(x.astype(dtype) for x in (points0, points1, weights)))
    found, moved, _ = matrices(candidates.models)
    assert candidates.valid.mean() > 0.98
    valid = np.asarray(candidates.valid)[:, 0]
    of_rotation = np.abs(found[:, 0] - rotation).max(axis=(-1, -2))[valid]
    of_translation = np.abs(moved[:, 0] - translation).max(axis=-1)[valid]
    assert np.quantile(of_rotation, 0.95) < (1e-4 if dtype == jnp.float32 else 1e-12)
    assert np.quantile(of_translation, 0.95) < (3e-4 if dtype == jnp.float32 else 1e-11)


@SOLVERS
def test_never_reflects(solver, x64):
    # Flat, noisy sets on which U Vᵀ, as first published, is often a reflection.
    points0, _, weights, rotation, _ = problems(seed=1)
    points0[..., 2] *= 0.01
    weights[:] = 0.0
    weights[:, :4] = 1.0
    rng = np.random.default_rng(2)
    points1 = np.einsum("bij,bnj->bni", rotation, points0) + 0.3 * rng.normal(size=points0.shape)
    naive = []
    for x, y in zip(points0[:, :4], points1[:, :4], strict=True):
        u, _, vt = np.linalg.svd((y - y.mean(axis=0)).T @ (x - x.mean(axis=0)))
        naive.append(np.linalg.det(u @ vt))
    assert np.mean(np.array(naive) < 0) > 0.2
    candidates = batched[solver](points0, points1, weights)
    assert candidates.valid.all()
    np.testing.assert_allclose(np.linalg.det(matrices(candidates.models)[0]), 1.0, atol=1e-12)


def test_weight_zero_ignores_an_outlier(x64):
    points0, points1, weights, rotation, _ = problems(noise=0.0)
    points1[:, 3] += 100.0
    weights[:100, 3] = 0.0
    found = matrices(batched[procrustes](points0, points1, weights).models)[0][:, 0]
    error = np.abs(found - rotation).max(axis=(-1, -2))
    assert error[:100].max() < 1e-12
    assert error[100:].min() > 0.01


def test_equal_weights_by_default(x64):
    points0, points1, *_ = problems()
    expected = batched[procrustes](points0, points1, np.full((200, 10), 0.3)).models.wxyz_xyz[0]
    np.testing.assert_allclose(procrustes(points0[0], points1[0]).models.wxyz_xyz, expected, atol=1e-12)


def test_far_from_the_origin_in_single_precision():
    points0, points1, weights, rotation, _ = problems(noise=0.0)
    data = (x.astype(np.float32) for x in (points0 + 1000.0, points1, weights))
    candidates = batched[procrustes](*data)
    assert candidates.valid.all()
    assert np.abs(matrices(candidates.models)[0][:, 0] - rotation).max() < 1e-3


@SOLVERS
@pytest.mark.parametrize("spoil", ["collinear", "coincident", "far", "mirror", "nan", "inf", "negative", "no weight"])
def test_degenerate_sets(solver, spoil, dtype):
    points0, points1, weights, *_ = problems(count=200, n=10, noise=0.0)
    steps = np.linspace(-1.0, 1.0, 10)[None, :, None]
    if spoil == "collinear":
        points0, points1 = points0[:, :1] * steps + points0[:, 1:2], points1[:, :1] * steps + points1[:, 1:2]
    elif spoil == "coincident":
        points0[:] = points0[:, :1]
    elif spoil == "far":
        points0 = points0[:, :1] * steps + 1000.0 * points0[:, 1:2]
        points1 = points1[:, :1] * steps + 1000.0 * points1[:, 1:2]
    elif spoil == "mirror":
        # A regular octahedron against its mirror image: many rotations are equally good.
        octahedron = np.concatenate([np.eye(3), -np.eye(3), np.zeros((4, 3))])
        points0, points1, weights = (np.stack([x] * 200) for x in (octahedron, -octahedron, np.ones(10)))
    elif spoil == "nan":
        points0[:, 2, 1] = np.nan
    elif spoil == "inf":
        points1[:, 2, 1] = np.inf
    elif spoil == "negative":
        weights[:, 0] = -1.0
    else:
        weights[:] = 0.0
    data = tuple(x.astype(dtype) for x in (points0, points1, weights))
    candidates = batched[solver](*data)
    assert not candidates.valid.any()
    parameters = np.asarray(candidates.models.parameters())
    np.testing.assert_array_equal(parameters[..., 0], 1.0)
    np.testing.assert_array_equal(parameters[..., 1:7], 0.0)


def score(model):
    """Some number that depends on every part of a model, and not on the sign of a quaternion."""
    rotation = model.rotation().as_matrix()[..., 0, :, :]
    value = jnp.einsum("...ij,ij->...", rotation, jnp.arange(9.0).reshape(3, 3))
    value += model.translation()[..., 0, :] @ jnp.array([1.0, -2.0, 0.5])
    return value + 3.0 * model.scale()[..., 0] if hasattr(model, "scale") else value


@SOLVERS
def test_gradients_equal_central_differences(solver, x64):
    points0, points1, weights, *_ = problems(count=2, noise=0.2, seed=3)
    # The second problem has three equal singular values, where the derivative of an SVD is not a number.
    octahedron = np.concatenate([np.eye(3), -np.eye(3), np.zeros((4, 3))])
    points0[1], points1[1], weights[1] = octahedron, 2.0 * octahedron[:, [1, 2, 0]], 1.0
    reverse = jax.jit(jax.grad(lambda *data: score(solver(*data).models), (0, 1, 2)))
    forward = jax.jit(lambda *x: jax.jvp(lambda *data: score(solver(*data).models), x, x)[1])
    step = 1e-6
    for data in zip(points0, points1, weights, strict=True):
        flat = np.concatenate([x.ravel() for x in data])
        gradient = np.concatenate([np.ravel(x) for x in reverse(*data)])
        ends = []
        for change in (step, -step):
            moved = np.concatenate([flat + change * np.eye(70), np.stack([flat] * 130)])
            parts = moved[:, :30].reshape(200, 10, 3), moved[:, 30:60].reshape(200, 10, 3), moved[:, 60:]
            ends.append(np.asarray(score(batched[solver](*parts).models))[:70])
        numeric = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(gradient, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())
        if solver is procrustes:
            np.testing.assert_allclose(forward(*data), gradient @ flat, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@SOLVERS
def test_gradients_are_finite_at_degenerate_sets(solver):
    points0, points1, weights, *_ = problems(count=64, n=4, seed=5)
    points0[:8] = points0[:8, :1]
    points0[8:16] = 0.0
    points0[16:24, 0] = np.nan
    points1[24:32, 0] = np.inf
    weights[32:40] = 0.0
    points0[40:48] *= 1e25
    points1[40:48] *= 1e25
    gradient = jax.jit(jax.vmap(jax.grad(lambda *data: jnp.sum(solver(*data).models.parameters()), (0, 1, 2))))
    for part in gradient(*(x.astype(np.float32) for x in (points0, points1, weights))):
        assert np.isfinite(part).all()
        assert np.abs(part[48:]).max() > 0


@SOLVERS
def test_bad_shapes(solver):
    with pytest.raises(ValueError, match="at least 3"):
        solver(np.zeros((2, 3), np.float32), np.zeros((2, 3), np.float32))
