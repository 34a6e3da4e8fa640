import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from tests.solvers.problems import central_differences
from vojax import SO3
from vojax.solvers import (
    AffineScene,
    affine_factorization,
    metric_factorization,
    metric_upgrade,
    perspective_factorization,
)

VIEWS, POINTS = 6, 14
PROJECTIONS = pytest.mark.parametrize("projection", ["orthographic", "weak_perspective", "paraperspective"])


def slot(candidates, k=0):
    return jax.tree.map(lambda x: x[k], candidates.models)


def scene(seed=0, views=VIEWS, count=POINTS, turn=0.3):
    """Rotations, that of view 0 the identity, and points in a cube about their centroid."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.normal(size=(views, 3)) * turn).as_matrix()
    points = rng.uniform(-1.0, 1.0, (count, 3))
    return rotation @ rotation[0].T, points - points.mean(axis=0)


def parallel_images(projection, seed=0, noise=0.0, **sizes):
    """Tracks, rotations, scales relative to view 0, and points in units of view 0."""
    rotation, points = scene(seed, **sizes)
    rng = np.random.default_rng(seed + 1000)
    scale = np.ones(len(rotation)) if projection == "orthographic" else rng.uniform(0.1, 0.3, len(rotation))
    offset = rng.uniform(-0.4, 0.4, (len(rotation), 2))
    seen = np.einsum("cij,pj->cpi", rotation, points)
    slant = offset if projection == "paraperspective" else np.zeros_like(offset)
    flat = seen[..., :2] - slant[:, None] * seen[..., 2:]
    tracks = offset[:, None] + scale[:, None, None] * flat
    return tracks + noise * rng.normal(size=tracks.shape), rotation, scale / scale[0], scale[0] * points


def perspective_images(distance, seed=0, noise=0.0, **sizes):
    """Normalised tracks, cam_from_world with view 0 at the origin, and points, one unit deep on average there."""
    rotation, points = scene(seed, **sizes)
    rng = np.random.default_rng(seed + 1000)
    translation = np.array([0.0, 0.0, 2.0 * distance]) + 0.2 * rng.normal(size=(len(rotation), 3))
    points = points + translation[0]
    translation = translation - np.einsum("cij,j->ci", rotation, translation[0])
    unit = points[:, 2].mean()
    points, translation = points / unit, translation / unit
    seen = np.einsum("cij,pj->cpi", rotation, points) + translation[:, None]
    tracks = seen[..., :2] / seen[..., 2:]
    return tracks + noise * rng.normal(size=tracks.shape), rotation, translation, points


def band(views, count, length):
    """Each point is seen by a run of views; the runs move from the first view to the last."""
    start = np.clip(np.linspace(-2, views - length + 2, count), 0, views - length).astype(int)
    return (np.arange(views)[:, None] >= start) & (np.arange(views)[:, None] < start + length)


def test_affine_is_numpy_rank_three_approximation(dtype):
    tracks = parallel_images("weak_perspective", noise=0.05)[0]
    found = affine_factorization(tracks.astype(dtype))
    assert found.valid.tolist() == [True]
    mean = tracks.mean(axis=1, keepdims=True)
    u, s, vt = np.linalg.svd((tracks - mean).transpose(0, 2, 1).reshape(2 * VIEWS, POINTS), full_matrices=False)
    best = ((u[:, :3] * s[:3]) @ vt[:3]).reshape(VIEWS, 2, POINTS).transpose(0, 2, 1) + mean
    tolerance = 1e-4 if dtype == jnp.float32 else 1e-10
    np.testing.assert_allclose(slot(found).project(), best, atol=tolerance)
    points = np.asarray(slot(found).points)
    np.testing.assert_allclose(points.mean(axis=0), np.zeros(3), atol=tolerance)
    np.testing.assert_allclose(points.T @ points / POINTS, np.eye(3), atol=tolerance)


@PROJECTIONS
def test_finds_the_scene_and_its_reversal(projection, dtype):
    tracks, rotation, scale, points = parallel_images(projection)
    found = metric_factorization(tracks.astype(dtype), projection=projection)
    assert found.valid.tolist() == [True, True]
    tolerance = 1e-4 if dtype == jnp.float32 else 1e-10
    errors = [np.abs(np.asarray(slot(found, k).points) - points).max() for k in range(2)]
    true = slot(found, int(np.argmin(errors)))
    np.testing.assert_allclose(true.points, points, atol=tolerance)
    np.testing.assert_allclose(true.cam_from_world.as_matrix(), rotation, atol=tolerance)
    np.testing.assert_allclose(true.scale, scale, atol=tolerance)
    for k in range(2):
        np.testing.assert_allclose(slot(found, k).project(), tracks, atol=tolerance)
    assert max(errors) > 0.1


def test_reversal_mirrors_depth_without_slant(x64):
    found = metric_factorization(parallel_images("weak_perspective", noise=0.01)[0])
    one, other = np.asarray(found.models.points)
    np.testing.assert_allclose(other, one * np.array([1.0, 1.0, -1.0]), atol=1e-12)


@PROJECTIONS
def test_the_affine_frame_does_not_matter(projection, x64):
    tracks = parallel_images(projection, noise=0.003)[0]
    affine = slot(affine_factorization(tracks))
    change = np.random.default_rng(5).normal(size=(3, 3))
    points = affine.points @ np.linalg.inv(change).T
    other = AffineScene(affine.matrices @ change, affine.offsets, points)
    expected, found = (metric_upgrade(a, projection) for a in (affine, other))
    order = np.argsort([np.abs(p - expected.models.points[0]).max() for p in np.asarray(found.models.points)])
    for k in range(2):
        np.testing.assert_allclose(found.models.points[order[k]], expected.models.points[k], atol=1e-8)


def test_missing_data_equal_full_data_when_nothing_is_missing(dtype):
    tracks = parallel_images("weak_perspective", noise=0.01)[0].astype(dtype)
    whole = slot(affine_factorization(tracks))
    masked = affine_factorization(tracks, np.ones(tracks.shape[:2], bool))
    assert masked.valid[0]
    np.testing.assert_allclose(slot(masked).project(), whole.project(), atol=1e-4 if dtype == jnp.float32 else 1e-10)


@pytest.mark.parametrize("kind", ["random", "band"])
def test_fills_gaps(kind, dtype):
    views, count = 12, 40
    tracks = parallel_images("weak_perspective", views=views, count=count)[0]
    mask = band(views, count, 7) if kind == "band" else np.random.default_rng(2).uniform(size=(views, count)) < 0.6
    gaps = np.where(mask[..., None], tracks, np.nan).astype(dtype)
    found = affine_factorization(gaps, mask)
    assert found.valid[0]
    np.testing.assert_allclose(slot(found).project(), tracks, atol=1e-4 if dtype == jnp.float32 else 1e-9)


def test_gaps_with_noise_are_a_least_squares_optimum(x64):
    """The gradient of the cost in all matrices, offsets and points vanishes."""
    tracks = parallel_images("weak_perspective", noise=0.02, views=8, count=25)[0]
    mask = np.random.default_rng(3).uniform(size=tracks.shape[:2]) < 0.7
    found = slot(affine_factorization(np.where(mask[..., None], tracks, np.nan), mask))
    gradient = jax.grad(lambda s: jnp.sum(jnp.where(mask[..., None], s.project() - tracks, 0.0) ** 2))(found)
    assert max(float(jnp.abs(x).max()) for x in gradient) < 1e-6


def test_a_point_that_one_view_saw_is_at_the_origin_and_changes_nothing(x64):
    tracks = parallel_images("orthographic", noise=0.01)[0]
    mask = np.ones(tracks.shape[:2], bool)
    expected = slot(affine_factorization(tracks, mask)).project()
    more = np.concatenate([tracks, np.full((VIEWS, 1, 2), 7.0)], axis=1)
    once = np.concatenate([mask, (np.arange(VIEWS) == 2)[:, None]], axis=1)
    found = affine_factorization(more, once)
    assert found.valid[0]
    np.testing.assert_allclose(slot(found).points[-1], np.zeros(3))
    np.testing.assert_allclose(slot(found).project()[:, :-1], expected, atol=1e-9)


@pytest.mark.parametrize("projection", ["weak_perspective", "paraperspective"])
def test_perspective_reaches_the_truth(projection, dtype):
    tracks, rotation, translation, points = perspective_images(4.0)
    found = perspective_factorization(tracks.astype(dtype), projection=projection)
    assert found.valid[0]
    tolerance = 1e-4 if dtype == jnp.float32 else 1e-9
    np.testing.assert_allclose(slot(found).points, points, atol=tolerance)
    np.testing.assert_allclose(slot(found).cam_from_world.rotation().as_matrix(), rotation, atol=tolerance)
    np.testing.assert_allclose(slot(found).cam_from_world.translation(), translation, atol=tolerance)


def test_five_rounds_are_enough_for_distant_scenes(x64):
    """At ten sizes five rounds leave less than 1e-5 of the depth, one round over 1e-3."""
    errors = {1: [], 5: []}
    for rounds, found_errors in errors.items():
        for seed in range(4):
            tracks, *_, points = perspective_images(10.0, seed)
            found = slot(perspective_factorization(tracks, iterations=rounds)).points
            found_errors.append(np.abs(np.asarray(found) - points).max())
    assert np.median(errors[5]) < 1e-5
    assert np.median(errors[1]) > 1e-3


@pytest.mark.slow
def test_perspective_with_gaps(x64):
    tracks, *_, points = perspective_images(5.0, views=8, count=25)
    mask = band(8, 25, 6)
    found = perspective_factorization(np.where(mask[..., None], tracks, np.nan), mask)
    assert found.valid[0]
    np.testing.assert_allclose(slot(found).points, points, atol=1e-7)


def outcome(function, weights):
    """A sum over what does not depend on an affine frame, or on the order of the reversals."""

    def total(tracks):
        found = function(tracks)
        return jnp.sum(jnp.sin(weights * slot(found).project()))

    return total


@pytest.mark.parametrize("gaps", [False, True])
def test_derivative_of_affine_factorization(gaps, x64):
    tracks = parallel_images("weak_perspective", noise=0.01)[0]
    mask = np.random.default_rng(7).uniform(size=tracks.shape[:2]) < 0.85 if gaps else None
    tracks = tracks if mask is None else np.where(mask[..., None], tracks, 0.0)
    weights = np.random.default_rng(6).normal(size=tracks.shape)
    function = jax.jit(outcome(lambda t: affine_factorization(t, mask), weights))
    numeric = central_differences(function, [tracks], 0, step=1e-6)
    found = jax.grad(function)(tracks)
    np.testing.assert_allclose(found, numeric, atol=1e-6 * np.abs(numeric).max())
    change = np.random.default_rng(8).normal(size=tracks.shape)
    forward = jax.jvp(function, (tracks,), (change,))[1]
    np.testing.assert_allclose(forward, np.sum(found * change), rtol=1e-9)


def true_slot_total(weights, points):
    """A sum over the points of the slot nearest to the truth."""

    def total(found, points_of):
        both = points_of(found)
        far = jnp.sum((both - points[None]) ** 2, axis=(1, 2))
        return jnp.sum(weights * both[jnp.argmin(far)])

    return total


@pytest.mark.parametrize(
    "projection",
    ["paraperspective", *(pytest.param(name, marks=pytest.mark.slow) for name in ("orthographic", "weak_perspective"))],
)
def test_derivative_of_metric_factorization(projection, x64):
    tracks, _, _, points = parallel_images(projection, noise=0.003)
    total = true_slot_total(np.random.default_rng(6).normal(size=points.shape), points)

    @jax.jit
    def function(tracks):
        return total(metric_factorization(tracks, projection=projection), lambda found: found.models.points)

    numeric = central_differences(function, [tracks], 0, step=1e-6)
    np.testing.assert_allclose(jax.grad(function)(tracks), numeric, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.slow
def test_derivative_of_perspective_factorization(x64):
    tracks, *_, points = perspective_images(8.0, noise=1e-4, views=4, count=6)
    weights = np.random.default_rng(6).normal(size=points.shape)

    @jax.jit
    def function(tracks):
        return jnp.sum(weights * slot(perspective_factorization(tracks, iterations=10)).points)

    numeric = central_differences(function, [tracks], 0, step=1e-6)
    np.testing.assert_allclose(jax.grad(function)(tracks), numeric, atol=1e-5 * np.abs(numeric).max())


@pytest.mark.slow
def test_batches_equal_a_loop(x64):
    tracks = np.stack([parallel_images("weak_perspective", seed=k, noise=0.01)[0] for k in range(3)])
    mask = np.random.default_rng(4).uniform(size=tracks.shape[:3]) < 0.8
    together = jax.vmap(metric_factorization)(tracks, mask)
    for k in range(3):
        alone = metric_factorization(tracks[k], mask[k])
        np.testing.assert_array_equal(together.valid[k], alone.valid)
        image = jax.tree.map(lambda x, k=k: x[k], together.models).project()
        np.testing.assert_allclose(image, alone.models.project(), atol=1e-8)


def spoiled(kind):
    tracks, rotation, *_ = parallel_images("orthographic")
    if kind == "plane":
        points = np.random.default_rng(0).normal(size=(POINTS, 3)) * np.array([1.0, 1.0, 0.0])
        return np.einsum("cij,pj->cpi", rotation[:, :2], points) + 3.0
    if kind == "no motion":
        return np.broadcast_to(tracks[:1], tracks.shape) + np.arange(VIEWS)[:, None, None]
    if kind == "turn in the image plane":
        spin = Rotation.from_rotvec(np.arange(VIEWS)[:, None] * np.array([[0.0, 0.0, 0.2]])).as_matrix()[:, :2, :2]
        return np.einsum("cij,pj->cpi", spin, tracks[0])
    if kind == "two directions of view":
        return np.concatenate([tracks[:2]] * 3)
    return tracks * {"nan": np.nan, "infinite": np.inf, "nothing": 0.0}[kind]


ALL_SEEN = np.ones((VIEWS, POINTS), bool)


@jax.jit
def scenes_and_gradient(tracks):
    """With and without a mask, and a gradient through everything that is returned."""

    def everything(tracks):
        found = [metric_factorization(tracks, mask, projection="orthographic") for mask in (None, ALL_SEEN)]
        return sum(jnp.sum(x) for x in jax.tree.leaves([f.models for f in found])), found

    (_, found), gradient = jax.value_and_grad(everything, has_aux=True)(tracks)
    return found, gradient


@pytest.mark.parametrize(
    "kind", ["plane", "no motion", "turn in the image plane", "two directions of view", "nan", "infinite", "nothing"]
)
def test_degenerate_input_is_not_valid_and_finite(kind, dtype):
    found, gradient = scenes_and_gradient(spoiled(kind).astype(dtype))
    assert not any(f.valid.any() for f in found)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
    assert np.isfinite(gradient).all()


def test_perspective_of_a_plane_or_of_nothing_is_not_valid_and_finite(x64):
    for kind in ("plane", "nan"):
        found = perspective_factorization(spoiled(kind), iterations=3)
        assert not found.valid.any()
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))


def test_views_with_too_few_points_are_not_valid(x64):
    tracks = parallel_images("weak_perspective")[0]
    mask = np.ones(tracks.shape[:2], bool)
    mask[2, 3:] = False
    assert not affine_factorization(tracks, mask).valid[0]


def test_indefinite_constraints_are_not_valid_and_finite(x64):
    """No rotations have these rows: noise as large as the images."""
    rng = np.random.default_rng(0)
    found = [metric_factorization(rng.normal(size=(3, 4, 2)), projection="orthographic") for _ in range(8)]
    assert any(not f.valid.any() for f in found)
    for f in found:
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(f))
        product = f.models.cam_from_world @ SO3(f.models.cam_from_world.wxyz).inverse()
        np.testing.assert_allclose(product.log(), np.zeros((2, 3, 3)), atol=1e-9)


def test_refuses_what_cannot_be_factored():
    with pytest.raises(ValueError, match="2 views of 6 points"):
        affine_factorization(np.zeros((2, 6, 2)))
    with pytest.raises(ValueError, match="5 views of 3 points"):
        metric_factorization(np.zeros((5, 3, 2)))
    with pytest.raises(ValueError, match="iterations"):
        perspective_factorization(np.ones((5, 6, 2)), iterations=0)
    # Called as without runtime type checks, which refuse these first.
    with pytest.raises(ValueError, match=r"expected .views, points, 2."):
        inspect.unwrap(affine_factorization)(np.zeros((5, 6)))
    with pytest.raises(ValueError, match="mask of"):
        inspect.unwrap(affine_factorization)(np.zeros((5, 6, 2)), np.ones((5, 6)))
    with pytest.raises(ValueError, match="projection 'fisheye'"):
        inspect.unwrap(metric_upgrade)(None, "fisheye")
    with pytest.raises(ValueError, match="projection 'fisheye'"):
        inspect.unwrap(perspective_factorization)(np.ones((5, 6, 2)), projection="fisheye")


@pytest.mark.data
def test_hotel(data_root, x64):
    data = loadmat(data_root / "hotel_factorization" / "tracks.mat")
    tracks = np.stack([data["track_x"].T, data["track_y"].T], axis=-1)
    mask = np.isfinite(tracks).all(axis=2)
    complete = mask.all(axis=0)
    found = metric_factorization(tracks[:, complete])
    assert found.valid.all()
    affine = slot(affine_factorization(tracks[:, complete]))

    def rms(scene, tracks, mask):
        error = np.where(mask[..., None], scene.project() - tracks, 0.0)
        return np.sqrt(np.sum(error**2) / (2 * mask.sum()))

    # 0.602 px, the singular values that are left out; constraints of a camera cost another part.
    assert rms(affine, tracks[:, complete], mask[:, complete]) < 0.61
    assert rms(slot(found), tracks[:, complete], mask[:, complete]) < 1.0
    often = mask.sum(axis=0) >= 2
    gaps = affine_factorization(tracks, mask)
    assert gaps.valid[0]
    assert rms(slot(gaps), tracks, mask & often[None]) < 0.61
