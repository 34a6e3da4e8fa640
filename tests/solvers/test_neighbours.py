import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from vojax.solvers._neighbours import (
    POINTS,
    QUERIES,
    blocks_of,
    curve_order,
    nearest_in_blocks,
    neighbours_in_blocks,
    usable_points,
)

N, M, K = 700, 900, 8


@jax.jit
def nearest(queries, points, mask0, mask1, limit):
    """Nearest of the points to each query, in the order of the queries; -1 for none."""
    queries, mask0 = usable_points(queries, mask0)
    points, mask1 = usable_points(points, mask1)
    blocks, asked = blocks_of(points, mask1, POINTS), blocks_of(queries, mask0, QUERIES)
    order, size = asked.index.reshape(-1), asked.index.size
    present = (mask0[order] & (jnp.arange(size) < len(queries))).reshape(asked.index.shape)
    start = jnp.zeros(asked.index.shape, jnp.int32), jnp.full(asked.index.shape, limit**2, queries.dtype)
    place, distance2 = nearest_in_blocks(asked.points, present, *start, blocks)
    many, many2 = neighbours_in_blocks(asked.points, present, blocks, K)
    target = jnp.where(present.reshape(-1), order, len(queries))
    ids = blocks.index.reshape(-1)
    found = jnp.where(distance2 < limit**2, ids[place], -1).reshape(-1)
    one = jnp.full(len(queries) + 1, -1).at[target].set(found)[:-1]
    several = jnp.full((len(queries) + 1, K), -1).at[target].set(ids[many].reshape(-1, K))[:-1]
    distances = jnp.zeros((len(queries) + 1, K), queries.dtype).at[target].set(many2.reshape(-1, K))[:-1]
    return one, several, distances


def clouds(kind, seed=0):
    rng = np.random.default_rng(seed)
    if kind == "uniform":
        return rng.uniform(size=(N, 3)), rng.uniform(size=(M, 3))
    if kind == "clusters":
        centres = rng.normal(size=(5, 3)) * 100.0
        return tuple(centres[rng.integers(0, 5, n)] + rng.normal(size=(n, 3)) for n in (N, M))
    if kind == "line":
        return tuple(rng.uniform(size=(n, 1)) * np.array([[3.0, 2.0, -1.0]]) for n in (N, M))
    if kind == "apart":
        return rng.normal(size=(N, 3)), rng.normal(size=(M, 3)) + 50.0
    return np.round(rng.uniform(size=(N, 3)) * 4), np.round(rng.uniform(size=(M, 3)) * 4)  # many equal points


@pytest.mark.parametrize("kind", ["uniform", "clusters", "line", "apart", "grid"])
def test_equals_a_tree(kind, dtype):
    queries, points = (x.astype(dtype) for x in clouds(kind))
    one, several, distances = nearest(queries, points, np.ones(N, bool), np.ones(M, bool), dtype(np.inf))
    expected, places = cKDTree(points).query(queries, k=K)
    scale = 1e-5 if dtype == jnp.float32 else 1e-12
    np.testing.assert_allclose(np.linalg.norm(queries - points[one], axis=1), expected[:, 0], rtol=scale, atol=scale)
    np.testing.assert_allclose(np.sqrt(distances), expected, rtol=scale, atol=scale)
    if kind not in ("grid", "line"):
        assert (np.asarray(one) == places[:, 0]).mean() > 0.999
        assert (np.asarray(several) == places).mean() > 0.999
    assert all(len(set(row)) == K for row in np.asarray(several))


def test_masks_and_limits():
    queries, points = (x.astype(np.float32) for x in clouds("uniform", 1))
    rng = np.random.default_rng(2)
    mask0, mask1 = rng.uniform(size=N) < 0.7, rng.uniform(size=M) < 0.5
    points[~mask1] = queries[: np.sum(~mask1)]  # right where it would hurt
    queries[~mask0] = np.nan
    one, *_ = nearest(queries, points, mask0, mask1, np.float32(0.08))
    expected, places = cKDTree(points[mask1]).query(np.where(mask0[:, None], queries, 0.0))
    found = np.asarray(one)
    np.testing.assert_array_equal(found >= 0, mask0 & (expected < 0.08))
    assert 0.2 < (found[mask0] >= 0).mean() < 0.98
    np.testing.assert_array_equal(found[found >= 0], np.flatnonzero(mask1)[places[found >= 0]])


@pytest.mark.parametrize("kind", ["empty", "nan", "huge"])
def test_nothing_to_find(kind):
    queries, points = (x.astype(np.float32) for x in clouds("uniform", 3))
    mask1 = np.full(M, kind != "empty")
    if kind == "nan":
        points[:] = np.nan
    elif kind == "huge":
        points[:] = 1e30
    one, _, distances = nearest(queries, points, np.ones(N, bool), mask1, np.float32(10.0))
    assert (np.asarray(one) == -1).all()
    assert np.isinf(distances).all()


def test_fewer_points_than_neighbours():
    queries, points = (x.astype(np.float32) for x in clouds("uniform", 4))
    mask1 = np.arange(M) < 5
    *_, distances = nearest(queries, points, np.ones(N, bool), mask1, np.float32(np.inf))
    assert np.isfinite(distances[:, :5]).all()
    assert np.isinf(distances[:, 5:]).all()


def test_the_curve_keeps_points_together():
    points = clouds("uniform", 5)[1].astype(np.float32)
    order = np.asarray(jax.jit(curve_order)(points, np.ones(M, bool)))
    assert sorted(order) == list(range(M))
    steps = np.linalg.norm(np.diff(points[order], axis=0), axis=1)
    assert steps.mean() < 0.3 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()
