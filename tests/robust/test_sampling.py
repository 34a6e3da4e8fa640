import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from vojax.robust import required_hypotheses
from vojax.robust._sampling import draw_samples, guided_pool, random_uniform, sampling_order

_draw = jax.jit(draw_samples)


def _samples(m, k, order, pool, seed=0):
    uniform = np.random.default_rng(seed).uniform(size=(m, k)).astype(np.float32)
    uniform = np.minimum(uniform, np.nextafter(np.float32(1), np.float32(0)))
    return np.asarray(_draw(uniform, jnp.asarray(order, jnp.int32), jnp.asarray(pool, jnp.int32)))


@pytest.mark.parametrize("m", [2, 3, 4, 5, 7, 8])
def test_required_hypotheses_is_the_formula(m, dtype):
    w = np.linspace(0.2, 0.95, 16)
    for p in (0.9, 0.99, 0.9999):
        expected = np.log(1 - p) / np.log(1 - w**m)
        count = np.asarray(required_hypotheses(jnp.asarray(w, dtype), m, p))
        assert count.dtype == dtype
        assert np.all(count == np.round(count))
        # Rounded up; where float32 knows 1 − w^m to 6e-8, the quotient is known to a relative 6e-8/w^m.
        assert np.all(count >= np.maximum(expected * (1 - 1e-3), 1))
        assert np.all(count <= expected * (1 + 1e-3) + 1)
        # The formula's meaning: the last sample is needed, and suffices.
        if dtype == jnp.float64:
            assert np.all((1 - w**m) ** count <= (1 - p) * (1 + 1e-9))
            needed = count > 1
            assert np.all((1 - w**m)[needed] ** (count - 1)[needed] > 1 - p)


def test_required_hypotheses_table():
    # Scaramuzza & Fraundorfer 2011, table: p = 0.99, half of the data wrong.
    assert [int(required_hypotheses(0.5, m, 0.99)) for m in (1, 2, 3, 5, 7, 8)] == [7, 17, 35, 146, 588, 1177]


def test_required_hypotheses_at_the_ends():
    assert required_hypotheses(1.0, 3, 0.99) == 1
    assert required_hypotheses(0.0, 3, 0.99) == jnp.inf
    tiny = required_hypotheses(jnp.float32(1e-4), 8, 0.99)  # w^m = 1e-32
    assert tiny > 1e30
    assert required_hypotheses(0.999, 3, 0.01) == 1
    # Infinite, and yet no NaN comes out of a derivative.
    gradient = jax.vmap(jax.grad(lambda w: required_hypotheses(w, 3, 0.99)))(jnp.array([0.0, 0.5, 1.0]))
    assert np.isfinite(gradient).all()


@settings(max_examples=60, deadline=None)
@given(
    m=st.sampled_from([3, 5]),
    pool=st.integers(0, 40),
    seed=st.integers(0, 2**31 - 1),
)
def test_samples_are_distinct_and_inside_their_pool(m, pool, seed):
    pool = max(pool, m)
    order = np.random.default_rng(seed).permutation(40)
    samples = _samples(m, 64, order, np.full(64, pool), seed)
    assert samples.shape == (m, 64)
    for column in samples.T:
        assert len(set(column)) == m
        assert set(column) <= set(order[:pool])


def test_each_hypothesis_has_its_own_pool():
    order = np.arange(40)[::-1]
    pools = np.arange(64) % 37 + 3
    samples = _samples(3, 64, order, pools)
    for column, pool in zip(samples.T, pools, strict=True):
        assert len(set(column)) == 3
        assert set(column) <= set(order[:pool])
    assert np.all(np.sort(samples[:, pools == 3], axis=0) == np.array([37, 38, 39])[:, None])


@pytest.mark.parametrize(("m", "pool"), [(2, 6), (3, 6), (5, 7)])
def test_all_subsets_are_equally_likely(m, pool):
    k = 60_000
    samples = np.sort(_samples(m, k, np.arange(40), np.full(k, pool), seed=11), axis=0)
    _, counts = np.unique((40 ** np.arange(m)) @ samples, return_counts=True)
    number = scipy.special.comb(pool, m, exact=True)
    assert len(counts) == number
    assert scipy.stats.chisquare(counts).pvalue > 1e-3


def test_the_largest_random_number_stays_inside_the_pool():
    uniform = jnp.full((3, 64), np.nextafter(np.float32(1), np.float32(0)))
    samples = np.asarray(_draw(uniform, jnp.arange(40), jnp.full(64, 9)))
    assert np.all(np.sort(samples, axis=0) == np.array([6, 7, 8])[:, None])


def test_a_pool_smaller_than_the_sample_stays_inside_the_data():
    for pool in (0, 1, 2):
        samples = _samples(3, 64, np.arange(40), np.full(64, pool))
        assert np.all((samples >= 0) & (samples < max(pool, 1)))


def test_order_puts_the_best_valid_observations_first():
    rng = np.random.default_rng(0)
    quality, mask = rng.permutation(30).astype(np.float32), rng.uniform(size=30) < 0.6
    order = np.asarray(sampling_order(jnp.asarray(mask), jnp.asarray(quality)))
    valid = mask.sum()
    assert sorted(order) == list(range(30))
    assert list(order[:valid]) == sorted(np.flatnonzero(mask), key=lambda i: -quality[i])
    assert list(np.asarray(sampling_order(jnp.asarray(mask), None))[:valid]) == list(np.flatnonzero(mask))


def test_the_guided_pool_grows_like_prosacs():
    count, m, total = 50, 3, 200_000
    drawn = jnp.arange(total)
    sizes = np.asarray(guided_pool(drawn, jnp.asarray(count), m))
    assert np.all(sizes[3::4] == count)  # every fourth is not guided
    guided, drawn = sizes[np.arange(total) % 4 != 3], np.arange(total)[np.arange(total) % 4 != 3]
    assert np.all(np.diff(guided) >= 0)
    assert guided[0] == m + 1
    assert guided[-1] == count
    # T_n = T_N C(n, m)/C(N, m) in the paper; (n/N)^m is its approximation, so sizes differ by few observations.
    n = np.arange(m + 1, count + 1)
    growth = total * scipy.special.comb(n, m) / scipy.special.comb(count, m)
    paper = np.minimum(n[np.minimum(np.searchsorted(growth, drawn + 1), len(n) - 1)], count)
    assert np.abs(guided - paper).max() <= m
    assert np.all(np.asarray(guided_pool(jnp.arange(10), jnp.asarray(2), m)) == 2)


def test_random_numbers_depend_on_key_and_chunk_only():
    key = jax.random.key(3)
    chunk = lambda i: np.asarray(random_uniform(key, jnp.asarray(i, jnp.int32), (3, 16)))  # noqa: E731
    assert np.array_equal(chunk(2), chunk(2))
    assert not np.any(chunk(0) == chunk(1))
    assert chunk(0).min() >= 0
    assert chunk(0).max() < 1
