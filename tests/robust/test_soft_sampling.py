"""Gumbel sampling of minimal sets: frequencies and probabilities against sums over all orders."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from vojax.robust._soft_sampling import draw_gumbel_samples, sample_log_probability

_log_probability = jax.jit(sample_log_probability)
_draw = jax.jit(draw_gumbel_samples, static_argnames=("num_samples", "sample_size"))
_jacobian = jax.jit(jax.jacrev(sample_log_probability))


def plackett_luce(logits, subset):
    """Probability of a set, one order after the other, in float64."""
    weights = np.exp(np.asarray(logits, np.float64) - np.max(logits))
    total = 0.0
    for order in itertools.permutations(subset):
        probability, left = 1.0, list(range(len(weights)))
        for i in order:
            probability *= weights[i] / weights[left].sum()
            left.remove(i)
        total += probability
    return total


def all_subsets(n, m):
    return np.array(list(itertools.combinations(range(n), m)), np.int32)


@pytest.mark.parametrize("m", [1, 3, 5, 7])
def test_probability_is_the_sum_over_all_orders(m, dtype):
    n = 8
    logits = np.random.default_rng(m).normal(size=n) * 2.0
    subsets = all_subsets(n, m)
    if m == 7:
        subsets = subsets[:3]  # of 5040 orders each
    found = np.asarray(_log_probability(jnp.asarray(logits, dtype), subsets))
    assert found.dtype == dtype
    expected = np.log([plackett_luce(logits, s) for s in subsets])
    np.testing.assert_allclose(found, expected, atol=1e-12 if dtype == jnp.float64 else 1e-5)
    # The order of the indices does not matter, nor does a constant on all logits.
    again = _log_probability(jnp.asarray(logits + 3.0, dtype), subsets[:, ::-1])
    np.testing.assert_allclose(again, found, atol=1e-12 if dtype == jnp.float64 else 1e-5)


def test_probabilities_of_all_sets_sum_to_one(x64):
    logits = jnp.asarray(np.random.default_rng(0).normal(size=7) * 3.0)
    for m in (2, 6):
        assert abs(jnp.sum(jnp.exp(_log_probability(logits, all_subsets(7, m)))) - 1.0) < 1e-12


@pytest.mark.parametrize(("n", "m"), [(6, 3), (7, 5)])
def test_frequencies_are_the_probabilities(n, m):
    k = 60_000
    logits = np.random.default_rng(n + m).normal(size=n)
    samples, valid = _draw(jax.random.key(7), jnp.float32(logits), num_samples=k, sample_size=m)
    assert valid.all()
    code = np.asarray(samples) @ n ** np.arange(m)
    subsets = all_subsets(n, m)
    counts = np.array([np.sum(code == s @ n ** np.arange(m)) for s in subsets])
    assert counts.sum() == k  # ascending and distinct, or some would be missing
    expected = k * np.array([plackett_luce(logits, s) for s in subsets])
    assert expected.min() > 5
    assert scipy.stats.chisquare(counts, expected).pvalue > 1e-3


def test_padding_and_infinite_logits_are_never_drawn_and_change_nothing():
    rng = np.random.default_rng(1)
    logits = rng.normal(size=20).astype(np.float32)
    mask = np.arange(20) % 3 != 0
    logits[[1, 2, 4]] = np.nan, -np.inf, np.inf
    allowed = mask & np.isfinite(logits)
    draw = jax.jit(lambda key: draw_gumbel_samples(key, logits, num_samples=512, sample_size=4, mask=mask))
    samples, valid = draw(jax.random.key(0))
    assert valid.all()
    assert allowed[np.asarray(samples)].all()
    assert len(np.unique(samples)) == allowed.sum()
    compressed = np.cumsum(allowed) - 1
    found = _log_probability(logits, samples, mask=mask)
    expected = _log_probability(logits[allowed], compressed[np.asarray(samples)])
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_too_few_observations_are_said_and_have_no_gradient():
    logits = jnp.arange(6.0)

    @jax.jit
    @jax.value_and_grad
    def both(logits, samples, mask):
        return jnp.sum(sample_log_probability(logits, samples, mask=mask))

    for mask in (np.zeros(6, bool), np.arange(6) < 2):
        samples, valid = _draw(jax.random.key(0), logits, num_samples=8, sample_size=3, mask=mask)
        assert not valid.any()
        assert np.all((samples >= 0) & (samples < 6))
        value, gradient = both(logits, samples, mask)
        assert value == 0
        assert np.all(gradient == 0)
    # Exactly enough: there is one set, and it is certain.
    samples, valid = _draw(jax.random.key(0), logits, num_samples=8, sample_size=3, mask=np.arange(6) < 3)
    assert valid.all()
    assert np.all(np.asarray(samples) == np.arange(3))
    probability = _log_probability(logits, samples, mask=np.arange(6) < 3)
    np.testing.assert_allclose(probability, 0.0, atol=1e-6)


@pytest.mark.parametrize("m", [2, 5])
def test_gradient_equals_central_differences(m, x64):
    rng = np.random.default_rng(m)
    logits = jnp.asarray(rng.normal(size=9))
    samples = all_subsets(9, m)[rng.permutation(36)[:12]]
    factors = jnp.asarray(rng.normal(size=12))
    function = jax.jit(lambda x: jnp.sum(factors * sample_log_probability(x, samples)))
    gradient = jax.jit(jax.grad(function))(logits)
    step = 1e-6
    columns = np.eye(9) * step
    differences = [(function(logits + c) - function(logits - c)) / (2 * step) for c in columns]
    np.testing.assert_allclose(gradient, differences, atol=1e-8)
    assert abs(np.sum(gradient)) < 1e-12  # a constant changes nothing


@pytest.mark.slow
def test_float32_is_good_for_confident_logits():
    # Weights that span 34 decades: naively, 1 − Σ w of what was drawn before is rounding.
    logits = np.linspace(-60.0, 20.0, 16)
    samples = all_subsets(16, 4)
    expected = np.log([plackett_luce(logits, s) for s in samples])
    found = np.asarray(_log_probability(jnp.float32(logits), samples))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    extreme = jnp.linspace(-3e4, 3e4, 16)
    for x in (jnp.float32(logits), extreme):
        assert np.isfinite(_jacobian(x, samples)).all()


@pytest.mark.slow
def test_a_batch_is_a_loop():
    logits = jnp.asarray(np.random.default_rng(0).normal(size=(4, 12)), jnp.float32)
    keys = jax.random.split(jax.random.key(1), 4)

    def one(key, logits):
        samples, _ = draw_gumbel_samples(key, logits, num_samples=16, sample_size=3)
        return samples, sample_log_probability(logits, samples)

    samples, probability = jax.jit(jax.vmap(one))(keys, logits)
    for i in range(4):
        expected = jax.jit(one)(keys[i], logits[i])
        assert np.array_equal(samples[i], expected[0])
        np.testing.assert_allclose(probability[i], expected[1], atol=1e-5)


def test_wrong_arguments_are_said():
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="expected between 1 and 3"):
        draw_gumbel_samples(key, jnp.zeros(3), num_samples=2, sample_size=4)
    with pytest.raises(ValueError, match="at least 1"):
        draw_gumbel_samples(key, jnp.zeros(3), num_samples=0, sample_size=2)
    with pytest.raises((ValueError, TypeError)):
        draw_gumbel_samples(key, jnp.zeros(3), num_samples=2, sample_size=2, mask=jnp.ones(4, bool))
