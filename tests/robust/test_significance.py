"""When a consensus is more than chance: against exact enumeration and against simulated noise."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.robust._significance import chance_in_image, even_odds, is_significant


@pytest.mark.parametrize(("n", "p"), [(8, 0.01), (100, 2.3e-5), (1000, 2.3e-5), (1000, 0.01), (4138, 1e-4)])
def test_agrees_with_exact_integers(n, p):
    for k in range(min(n, 60) + 1):
        alarms = (n - 3) * math.comb(n, k) * math.comb(k, 3) * p ** (k - 3) if k > 3 else math.inf
        if 0.99 < alarms < 1.01:
            continue
        found = is_significant(jnp.asarray(k), jnp.asarray(n), 3, jnp.float32(p))
        assert bool(found) == (alarms < 1), (k, alarms)


def test_more_supporters_are_never_less_significant():
    counts = jnp.arange(0, 501)
    found = jax.vmap(lambda k: is_significant(k, jnp.asarray(500), 5, jnp.float32(1e-3)))(counts)
    assert not found[5]
    assert found[-1]
    assert np.all(np.diff(np.asarray(found).astype(int)) >= 0)


def test_few_observations_that_agree_exactly_are_enough():
    # Four points near a pixel each in a megapixel image: one of 3e4 wrong poses would do that.
    assert is_significant(jnp.asarray(4), jnp.asarray(4), 3, jnp.float32(2.3e-5))
    assert not is_significant(jnp.asarray(4), jnp.asarray(1000), 3, jnp.float32(2.3e-5))


def test_chance_is_the_share_of_the_box_within_the_threshold():
    rng = np.random.default_rng(0)
    pixels = np.vstack([rng.uniform([100, 50], [740, 530], (4000, 2)), [[100, 50], [740, 530], [np.inf, -9e9]]])
    mask = np.isfinite(pixels).all(axis=1)
    chance = chance_in_image(jnp.asarray(pixels, jnp.float32), jnp.asarray(mask), 40.0)
    inside = np.linalg.norm(pixels[:4000] - [420, 290], axis=1) < 40.0
    assert chance == pytest.approx(math.pi * 40**2 / (640 * 480), rel=1e-4)
    assert abs(inside.mean() - float(chance)) < 4 * math.sqrt(float(chance) / 4000)


def test_empty_and_flat_images_give_a_probability():
    for pixels, mask in ((np.zeros((5, 2)), np.zeros(5, bool)), (np.ones((5, 2)), np.ones(5, bool))):
        chance = chance_in_image(jnp.asarray(pixels, jnp.float32), jnp.asarray(mask), 3.0)
        assert 0.5 < chance <= 1


def test_the_distance_of_even_odds_is_constant_to_differentiation():
    """Also where nothing counts: the box of no pixels has no derivative."""
    pixels = jnp.array([[1.0, 2.0], [jnp.inf, 3.0], [4.0, 5.0]])
    for mask in (jnp.array([True, False, True]), jnp.zeros(3, bool)):

        def cut(pixels, mask=mask):
            chance = chance_in_image(pixels, mask, 3.0)
            return even_odds(jnp.sum(mask), jnp.asarray(3), jnp.float32(0.16), chance)

        assert 1.0 < cut(pixels) < 7.0
        np.testing.assert_array_equal(jax.grad(cut)(pixels), 0.0)
