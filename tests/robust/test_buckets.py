"""One compilation for all sizes of a bucket, and the same estimates as from rows that are masked by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vojax
from vojax.robust import RansacOptions, _absolute_pose, estimate_absolute_pose
from vojax.robust._buckets import bucket_size, in_bucket

CAMERA = vojax.cameras.Pinhole(fx=400.0, fy=400.0, cx=320.0, cy=240.0)
OPTIONS = RansacOptions(max_hypotheses=64, chunk_size=64)


def scene(n):
    points = jax.random.uniform(jax.random.key(0), (n, 3), minval=-1.0).at[:, 2].add(4.0)
    pixels = CAMERA.project(points) + 0.5 * jax.random.normal(jax.random.key(1), (n, 2))
    return points, pixels.at[: n // 5].add(80.0)


def test_sizes_are_few_and_near():
    sizes = {bucket_size(n) for n in range(3, 5000)}
    assert len(sizes) < 45
    assert all(n <= bucket_size(n) <= max(1.25 * n, 8) for n in range(3, 5000))


def test_another_size_of_a_bucket_is_not_traced_again(monkeypatch):
    traced = []
    original = _absolute_pose.masked_pairs
    monkeypatch.setattr(_absolute_pose, "masked_pairs", lambda *rows: traced.append(1) or original(*rows))
    options = RansacOptions(max_hypotheses=63, chunk_size=63)  # of no other test
    shapes = [
        estimate_absolute_pose(*scene(n), CAMERA, key=jax.random.key(2), options=options).inliers.shape
        for n in (57, 60, 64)
    ]
    assert shapes == [(57,), (60,), (64,)]
    assert len(traced) == 1
    estimate_absolute_pose(*scene(65), CAMERA, key=jax.random.key(2), options=options)
    assert len(traced) == 2


@pytest.mark.parametrize("stated", ["one", "each", "covariances"])
def test_filled_rows_do_not_count(stated):
    points, pixels = scene(57)
    sigma = {"one": 0.5, "each": jnp.full(57, 0.5), "covariances": 0.25 * jnp.broadcast_to(jnp.eye(2), (57, 2, 2))}
    found = estimate_absolute_pose(
        points, pixels, CAMERA, key=jax.random.key(3), options=OPTIONS, sigma_px=sigma[stated], quality=jnp.ones(57)
    )
    rows = jnp.arange(64) % 57
    by_hand = estimate_absolute_pose(
        points[rows],
        pixels[rows],
        CAMERA,
        key=jax.random.key(3),
        options=OPTIONS,
        sigma_px=sigma[stated] if stated == "one" else sigma[stated][rows],
        quality=jnp.ones(64),
        mask=jnp.arange(64) < 57,
    )
    assert int(found.num_inliers) == 46
    np.testing.assert_array_equal(found.inliers, by_hand.inliers[:57])
    np.testing.assert_allclose(found.model.wxyz_xyz, by_hand.model.wxyz_xyz, atol=1e-6)
    np.testing.assert_allclose(found.covariance, by_hand.covariance, rtol=1e-3)


def test_derivatives_have_the_rows_that_were_given():
    points, pixels = scene(57)

    def depth(pixels):
        return estimate_absolute_pose(
            points, pixels, CAMERA, key=jax.random.key(4), options=OPTIONS
        ).model.translation()[2]

    gradient = jax.grad(depth)(pixels)
    assert gradient.shape == (57, 2)
    assert bool(jnp.all(jnp.isfinite(gradient)))
    assert float(jnp.abs(gradient[:11]).max()) < 1e-6 * float(jnp.abs(gradient[11:]).max())  # outliers
    assert float(jnp.abs(gradient[11:]).min()) > 0.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mask": jnp.ones(56, bool)}, r"mask has shape \(56,\): expected one entry for each of 57 rows"),
        ({"quality": jnp.ones(64)}, r"quality has shape \(64,\): expected one entry for each of 57 rows"),
        ({"sigma": jnp.ones(64)}, r"the noise has shape \(64,\)"),
        ({"sigma": 0.0}, "the standard deviation is 0.0"),
    ],
)
def test_what_does_not_fit_is_refused_before_it_is_filled_up(settings, message):
    # Not through an estimator: under test, beartype would refuse the shapes first.
    noise = {"sigma": 1.0, "quality": None, "mask": None} | settings
    with pytest.raises(ValueError, match=message):
        in_bucket(_absolute_pose._estimate, scene(57), (), **noise)
