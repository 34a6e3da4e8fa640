"""Samplers as public functions, and the quality that guides them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from vojax.datasets import simulate_rigid
from vojax.robust import RansacOptions, draw_minimal_samples, estimate_rigid, match_quality


def test_quality_is_the_weighted_sum_of_ranks():
    rng = np.random.default_rng(0)
    detector, matcher = rng.lognormal(size=50), -rng.exponential(size=50)
    detector[7] = detector[3]
    found = match_quality(jnp.float32(detector), jnp.float32(matcher), detector_weight=0.3, matcher_weight=0.7)
    ranks = [(scipy.stats.rankdata(x) - 1) / 49 for x in (detector, matcher)]
    np.testing.assert_allclose(found, 0.3 * ranks[0] + 0.7 * ranks[1], atol=1e-6)
    # A detector of another unit and gain changes nothing.
    again = match_quality(jnp.float32(1e4 * detector**3), jnp.float32(matcher), detector_weight=0.3, matcher_weight=0.7)
    np.testing.assert_allclose(again, found, atol=1e-6)


def test_padding_and_what_is_no_number_come_last():
    scores = jnp.array([3.0, 1.0, 2.0, jnp.nan, 100.0])
    mask = jnp.array([True, True, True, True, False])
    assert match_quality(scores, scores, mask=mask).tolist() == [1.0, 0.0, 0.5, 0.0, 0.0]
    assert np.isfinite(match_quality(jnp.full(3, jnp.nan), jnp.ones(3))).all()


def test_guided_samples_are_free_of_outliers_more_often():
    """Both scores say something about which match is right, and together more than either."""
    rng = np.random.default_rng(1)
    n, k, m = 200, 4000, 5
    right = rng.permutation(n) < 0.4 * n
    detector, matcher = (jnp.float32(rng.normal(size=n) + 1.0 * right) for _ in range(2))

    def share(quality):
        samples = draw_minimal_samples(jax.random.key(0), n, num_samples=k, sample_size=m, quality=quality)
        return np.mean(np.all(right[np.asarray(samples)], axis=1))

    uniform = share(None)
    assert abs(uniform - 0.4**5) < 4 * np.sqrt(0.4**5 / k)
    both = share(match_quality(detector, matcher))
    assert both > 5 * uniform
    assert both > max(share(detector), share(matcher))


@pytest.mark.slow
def test_a_search_that_is_guided_well_stops_sooner_and_one_that_is_misled_does_not():
    """A rigid motion, 30 % right: uniform samples of three need 253 for 99.9 %."""
    keys = jax.random.split(jax.random.key(4), 20)
    options = RansacOptions(chunk_size=32)
    problems = jax.vmap(lambda key: simulate_rigid(key, 200, outlier_fraction=0.7))(keys)

    @jax.jit
    @jax.vmap
    def search(problem, key, quality):
        found = estimate_rigid(problem.points0, problem.points1, key=key, options=options, quality=quality)
        error = (found.model.inverse() @ problem.cam1_from_cam0).log()
        return found.num_hypotheses, jnp.max(jnp.abs(error))

    noise = jax.random.normal(jax.random.key(5), (20, 200))
    drawn, error = search(problems, keys, problems.inliers + noise)
    misled, misled_error = search(problems, keys, noise - problems.inliers)
    assert np.median(drawn) == 32
    assert np.median(misled) >= 256
    assert max(np.max(error), np.max(misled_error)) < 0.05


def test_samples_are_distinct_and_of_what_counts():
    mask = np.random.default_rng(2).uniform(size=40) < 0.5
    for quality in (None, jnp.arange(40.0)):
        draw = jax.jit(
            lambda key, quality=quality: draw_minimal_samples(
                key, 40, num_samples=500, sample_size=3, quality=quality, mask=jnp.asarray(mask)
            )
        )
        samples = np.asarray(draw(jax.random.key(3)))
        assert samples.shape == (500, 3)
        assert mask[samples].all()
        assert all(len(set(sample)) == 3 for sample in samples)
        assert np.array_equal(samples, draw(jax.random.key(3)))


def test_bad_arguments_are_said_in_one_line():
    key = jax.random.key(0)
    for call in (
        lambda: draw_minimal_samples(key, 4, num_samples=1, sample_size=5),
        lambda: draw_minimal_samples(key, 4, num_samples=0, sample_size=2),
        lambda: draw_minimal_samples(key, 4, num_samples=1, sample_size=2, mask=jnp.ones(5, bool)),
        lambda: match_quality(jnp.ones(3), jnp.ones(4)),
        lambda: match_quality(jnp.ones(3), jnp.ones(3), detector_weight=-1.0),
        lambda: match_quality(jnp.ones(3), jnp.ones(3), mask=jnp.ones(2, bool)),
    ):
        with pytest.raises((ValueError, TypeError)) as caught:
            call()
        # The type checks of the tests stand before ours for some shapes.
        if "jaxtyping" not in type(caught.value).__module__:
            assert isinstance(caught.value, ValueError)
            assert "expected" in str(caught.value)
            assert "\n" not in str(caught.value)
