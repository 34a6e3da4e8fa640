"""The same bad input for all estimators: a clear sentence at the boundary, or a result code and nothing that is NaN."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3, SO3, Result
from vojax.cameras import Pinhole, Rig
from vojax.robust import (
    RansacOptions,
    estimate_absolute_pose,
    estimate_fundamental,
    estimate_generalized_pose,
    estimate_homography,
    estimate_relative_pose,
    estimate_rigid,
    estimate_rotation,
    estimate_similarity,
    estimate_translation,
)

N = 24
CAMERA = Pinhole(fx=500.0, fy=500.0, cx=320.0, cy=240.0)
RIG = Rig((CAMERA, CAMERA), SE3(jnp.float32([[1, 0, 0, 0, 0, 0, 0], [1, 0, 0, 0, -0.5, 0, 0]])))
# Columns of the two arrays of observations, what comes after them, and the smallest sample.
KINDS = {
    estimate_absolute_pose: ((3, 2), (CAMERA,), 3),
    estimate_generalized_pose: ((3, 2), (np.arange(N) % 2, RIG), 3),
    estimate_translation: ((3, 2), (CAMERA, SO3.identity()), 2),
    estimate_relative_pose: ((2, 2), (CAMERA, CAMERA), 5),
    estimate_rotation: ((2, 2), (CAMERA, CAMERA), 2),
    estimate_fundamental: ((2, 2), (), 7),
    estimate_homography: ((2, 2), (), 4),
    estimate_rigid: ((3, 3), (), 3),
    estimate_similarity: ((3, 3), (), 3),
}
every = pytest.mark.parametrize("estimator", list(KINDS), ids=lambda e: e.__name__)


def observations(estimator, rows=N):
    widths, rest, _ = KINDS[estimator]
    rng = np.random.default_rng(0)
    first, second = (rng.uniform(1.0, 400.0, (rows, width)) for width in widths)
    rest = tuple(x[:rows] if isinstance(x, np.ndarray) else x for x in rest)
    return jnp.float32(first), jnp.float32(second), *rest


@every
def test_what_does_not_fit_is_said_in_one_line(estimator):
    first, second, *rest = observations(estimator)
    least = KINDS[estimator][2]
    few = observations(estimator, least - 1)
    sigma = "sigma" if estimator in (estimate_rigid, estimate_similarity) else "sigma_px"
    calls = [
        ((first, second[:-1], *rest), {}),
        ((first[:, :1], second, *rest), {}),
        ((first, second[:, :1], *rest), {}),
        ((first[0], second[0], *rest), {}),
        (few, {}),
        ((first, second, *rest), {"mask": jnp.ones(N + 1, bool)}),
        ((first, second, *rest), {"mask": jnp.ones(1, bool)}),
        ((first, second, *rest), {"quality": jnp.ones(N - 1)}),
        ((first, second, *rest), {sigma: jnp.ones(N + 1)}),
        ((first, second, *rest), {sigma: 0.0}),
        ((first, second, *rest), {sigma: -1.0}),
        ((first, second, *rest), {sigma: float("nan")}),
    ]
    for i, (arguments, settings) in enumerate(calls):
        with pytest.raises((ValueError, TypeError)) as caught:
            estimator(*arguments, key=jax.random.key(0), **settings)
        # The type checks of the tests stand before ours for some shapes.
        if "jaxtyping" not in type(caught.value).__module__:
            assert isinstance(caught.value, ValueError), (i, str(caught.value))
            assert "expected" in str(caught.value) or "needs" in str(caught.value), (i, str(caught.value))
            assert "\n" not in str(caught.value), (i, str(caught.value))


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["threshold_px", "threshold"])
def test_thresholds_are_positive_numbers(name, value):
    with pytest.raises(ValueError, match="expected a positive number"):
        RansacOptions(**{name: value})


def broken(estimator):
    """Problems, their names and the noise of each: one row of the batch for each way to be bad."""
    widths, rest, least = KINDS[estimator]
    rng = np.random.default_rng(1)
    # Points that a still camera sees: every model but the epipolar ones has an answer.
    points = np.concatenate([rng.uniform(-1, 1, (N, 2)), rng.uniform(3, 6, (N, 1))], axis=1)
    seen = points[:, :2] / points[:, 2:] * 500 + [320, 240]
    shift = np.where(np.arange(N) % 2, 0.5, 0.0) if estimator is estimate_generalized_pose else np.zeros(N)
    in_camera = points - np.stack([shift, 0 * shift, 0 * shift], axis=1)
    seen_first = in_camera[:, :2] / in_camera[:, 2:] * 500 + [320, 240]
    good = {
        (3, 2): (points, seen_first),
        (2, 2): (seen, seen),
        (3, 3): (points, points),
    }[widths]
    random = tuple(
        rng.uniform(0, [640, 480], (N, 2)) if w == 2 else rng.uniform(-3, 3, (N, 3)) + np.array([0, 0, 5])
        for w in widths
    )
    everything = np.ones(N, bool)
    line = np.linspace(0, 1, N)[:, None]
    problems = {
        "empty mask": (*good, everything & False, 1.0),
        "one too few": (*good, np.arange(N) < least, 1.0),
        "not a number": (good[0] * np.nan, good[1], everything, 1.0),
        "all alike": (good[0][:1] + 0 * good[0], good[1][:1] + 0 * good[1], everything, 1.0),
        "noise of zero": (*good, everything, 0.0),
        "noise of NaN": (*good, everything, np.nan),
        "wrong": (*random, everything, 1.0),
        "half infinite": (np.where(line < 0.5, np.inf, good[0]), good[1], everything, 1.0),
        "on a line": (good[0][:1] + line * (good[0][1:2] - good[0][:1]), good[1][:1] + line, everything, 1.0),
        "tiny": (good[0] * 1e-30, good[1] * 1e-30, everything, 1.0),
        "zero": (good[0] * 0, good[1] * 0, everything, 1.0),
    }
    arrays = [np.stack([problem[i] for problem in problems.values()]) for i in range(4)]
    return list(problems), [jnp.float32(arrays[0]), jnp.float32(arrays[1]), arrays[2], jnp.float32(arrays[3])], rest


@pytest.mark.slow
@every
def test_bad_numbers_have_a_code_and_nothing_is_nan(estimator):
    names, (first, second, mask, sigma), rest = broken(estimator)
    noise = "sigma" if estimator in (estimate_rigid, estimate_similarity) else "sigma_px"

    @jax.jit
    @jax.vmap
    def solve(key, first, second, mask, sigma):
        def number(first, second):
            found = estimator(first, second, *rest, key=key, mask=mask, **{noise: sigma})
            return sum(jnp.sum(x) for x in jax.tree.leaves((found.model, found.covariance))), found

        (_, found), gradient = jax.value_and_grad(number, argnums=(0, 1), has_aux=True)(first, second)
        return found, gradient

    keys = jax.random.split(jax.random.key(0), len(names))
    found, gradient = solve(keys, first, second, mask, sigma)
    for i, name in enumerate(names):
        for leaf in jax.tree.leaves((found.model, found.covariance, found.score, gradient)):
            assert np.isfinite(np.asarray(leaf)[i]).all(), name
    usable = np.asarray((found.result == Result.success) | (found.result == Result.not_converged))
    codes = dict(zip(names, usable, strict=True))
    for name in ("empty mask", "one too few", "not a number", "all alike", "noise of zero", "noise of NaN", "zero"):
        assert not codes[name], name
    assert not codes["wrong"]
    for name in ("empty mask", "one too few", "not a number", "noise of zero", "noise of NaN"):
        assert (found.result == Result.too_few)[names.index(name)], name
    assert np.array_equal(np.asarray(found.num_inliers) > 0, usable)
