"""Soft selection: weights against closed forms, gradients against differences and exact expectations."""

import functools
import itertools
import subprocess
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from vojax.datasets import simulate_absolute_pose, simulate_relative_pose, simulate_rigid
from vojax.geometry import essential_from_pose, sampson_error
from vojax.robust._soft import (
    argmax_weights,
    draw_hypotheses,
    expected_loss,
    soft_inlier_count,
    softmax_weights,
    sparsemax_weights,
)
from vojax.robust._soft_sampling import sample_log_probability
from vojax.solvers import five_point, homography_four_point, p3p, rigid_three_point

SELECTIONS = [softmax_weights, sparsemax_weights, argmax_weights]


def closed_form_sparsemax(x):
    """Martins & Astudillo 2016, algorithm 1, in float64."""
    x = np.asarray(x, np.float64)
    z = np.sort(x)[::-1]
    support = np.flatnonzero(1 + (np.arange(z.size) + 1) * z > np.cumsum(z))[-1] + 1
    threshold = (z[:support].sum() - 1) / support
    return np.maximum(x - threshold, 0.0)


def central_differences(function, x, step=1e-6):
    columns = np.eye(x.size).reshape(x.size, *x.shape) * step
    return np.array([(function(x + c) - function(x - c)) / (2 * step) for c in columns]).reshape(x.shape)


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0, 1e4])
def test_sparsemax_is_the_closed_form_and_jaxopts(scale, dtype):
    from jaxopt.projection import projection_simplex

    rng = np.random.default_rng(0)
    for h in (1, 2, 7, 200):
        scores = jnp.asarray(rng.normal(size=h) * scale + 5.0, dtype)
        found = np.asarray(sparsemax_weights(scores))
        assert found.dtype == dtype
        # Scores of 1e4 are known to 1e-3 in float32.
        tolerance = 1e-12 * max(scale, 1) if dtype == jnp.float64 else 2e-6 * max(scale, 1)
        np.testing.assert_allclose(found, closed_form_sparsemax(scores), atol=tolerance)
        np.testing.assert_allclose(found, projection_simplex(scores), atol=tolerance)
        assert abs(found.sum() - 1) < (1e-12 if dtype == jnp.float64 else 1e-5)


def test_sparsemax_gradient_is_that_of_the_support(x64):
    rng = np.random.default_rng(3)
    scores = jnp.asarray(rng.normal(size=12) * 0.4)
    support = np.asarray(sparsemax_weights(scores, temperature=0.7)) > 0
    assert 1 < support.sum() < 12
    # Martins & Astudillo, eq. (9): diag(s) − s sᵀ/|S|.
    s = support.astype(float)
    expected = (np.diag(s) - np.outer(s, s) / s.sum()) / 0.7
    found = jax.jacrev(lambda x: sparsemax_weights(x, temperature=0.7))(scores)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    forward = jax.jacfwd(lambda x: sparsemax_weights(x, temperature=0.7))(scores)
    np.testing.assert_allclose(forward, expected, atol=1e-12)


def test_softmax_and_argmax_weights(dtype, tolerance):
    scores = jnp.asarray(np.random.default_rng(1).normal(size=50) * 20.0, dtype)
    expected = scipy.special.softmax(np.asarray(scores, np.float64) / 3.0)
    np.testing.assert_allclose(softmax_weights(scores, temperature=3.0), expected, atol=tolerance)
    np.testing.assert_array_equal(argmax_weights(scores), np.arange(50) == np.argmax(scores))
    assert not np.any(jax.jacrev(argmax_weights)(scores))


@pytest.mark.parametrize("select", SELECTIONS)
def test_hypotheses_that_are_none_have_no_weight(select):
    scores = np.random.default_rng(2).normal(size=12).astype(np.float32)
    valid = np.arange(12) % 3 > 0
    scores[[0, 1, 2, 3, 4]] = 1e30, np.nan, np.inf, -1e30, -np.inf
    usable = valid & np.isfinite(scores)
    weights = np.asarray(select(scores, valid))
    np.testing.assert_allclose(weights[usable], select(scores[usable]), atol=1e-6)
    assert np.all(weights[~usable] == 0)
    assert np.isfinite(jax.jacrev(select)(scores, valid)).all()
    # Not one: no weight at all, not an equal share of nothing.
    assert np.all(select(scores, np.zeros(12, bool)) == 0)
    assert np.all(jax.jacrev(select)(scores, np.zeros(12, bool)) == 0)


def test_jaxopt_is_imported_on_use_and_without_its_warning():
    program = (
        "import sys, warnings, jax.numpy as jnp, vojax.robust._soft as soft\n"
        "assert 'jaxopt' not in sys.modules\n"
        "warnings.simplefilter('error')\n"
        "print(soft.sparsemax_weights(jnp.array([0.0, 3.0])))\n"
        "assert 'jaxopt' in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[0. 1.]"
    assert "no longer maintained" not in done.stderr


def test_soft_inlier_count_is_its_formula_and_becomes_the_count(dtype, tolerance):
    rng = np.random.default_rng(0)
    errors = rng.uniform(0.0, 5.0, size=(3, 4, 40))
    mask = rng.uniform(size=40) < 0.7
    weights = rng.uniform(size=40)
    found = soft_inlier_count(jnp.asarray(errors**2, dtype), 2.0, weights=jnp.asarray(weights, dtype), mask=mask)
    expected = np.sum(mask * weights * scipy.special.expit(5.0 * (1 - errors / 2.0)), axis=-1)
    np.testing.assert_allclose(found, expected, atol=40 * tolerance)
    sharp = soft_inlier_count(jnp.asarray(errors**2, dtype), 2.0, sharpness=1e6, mask=mask)
    np.testing.assert_allclose(sharp, np.sum(mask & (errors < 2.0), axis=-1), atol=1e-3)


def test_impossible_errors_count_nothing_and_have_no_gradient():
    squared = jnp.array([0.0, 1.0, jnp.inf, jnp.nan, 1e38])
    value, gradient = jax.value_and_grad(lambda x: soft_inlier_count(x, 1.0))(squared)
    np.testing.assert_allclose(value, scipy.special.expit(5.0) + 0.5, rtol=1e-6)
    assert np.isfinite(gradient).all()
    assert gradient[1] < 0
    assert np.all(gradient[np.array([0, 2, 3])] == 0)


@pytest.mark.parametrize("select", [functools.partial(softmax_weights, temperature=0.5), sparsemax_weights])
def test_expected_loss_and_its_gradient(select, x64):
    rng = np.random.default_rng(0)
    losses, scores = jnp.asarray(rng.uniform(size=(6, 3))), jnp.asarray(rng.normal(size=(6, 3)))
    valid = np.asarray(rng.uniform(size=(6, 3)) < 0.7)
    function = jax.jit(lambda losses, scores: expected_loss(losses, scores, valid, failure_loss=1.0, select=select))
    if select is sparsemax_weights:
        probabilities = closed_form_sparsemax(np.asarray(scores)[valid])
    else:
        probabilities = scipy.special.softmax(np.asarray(scores)[valid] / 0.5)
    assert abs(function(losses, scores) - probabilities @ np.asarray(losses)[valid]) < 1e-12
    by_losses, by_scores = jax.grad(function, argnums=(0, 1))(losses, scores)
    np.testing.assert_allclose(by_losses, central_differences(lambda x: function(x, scores), losses), atol=1e-9)
    np.testing.assert_allclose(by_scores, central_differences(lambda x: function(losses, x), scores), atol=1e-9)
    assert np.any(np.asarray(by_scores) != 0)


def tiny_problem():
    """Five observations, samples of two: losses, scores and validity of two models for each of the ten sets."""
    rng = np.random.default_rng(5)
    subsets = np.array(list(itertools.combinations(range(5), 2)))
    losses, scores = jnp.asarray(rng.uniform(size=(10, 2))), jnp.asarray(rng.normal(size=(10, 2)))
    valid = jnp.asarray(rng.uniform(size=(10, 2)) < 0.7).at[3].set(False)
    return subsets, losses, scores, valid, jnp.asarray(rng.normal(size=5))


@pytest.mark.slow
@pytest.mark.parametrize("select", SELECTIONS)
@pytest.mark.parametrize("k", [1, 3])
def test_score_function_gradient_is_exact_in_expectation(select, k, x64):
    subsets, losses, scores, valid, logits = tiny_problem()
    subsets = jnp.asarray(subsets)
    pools = jnp.asarray(list(itertools.product(range(10), repeat=k)))  # all that can be drawn

    def pool_loss(logits, pool, guided):
        log_probability = sample_log_probability(logits, subsets[pool]) if guided else None
        return expected_loss(losses[pool], scores[pool], valid[pool], log_probability, failure_loss=2.0, select=select)

    def expectation(logits):
        # Without the score function: the sum over all pools of probability times loss, as it stands.
        probability = jnp.exp(sample_log_probability(logits, subsets))
        values = jax.vmap(lambda pool: pool_loss(logits, pool, False))(pools)
        return jnp.sum(jnp.prod(probability[pools], axis=1) * values)

    exact = jax.jit(jax.grad(expectation))(logits)
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(pool_loss), (None, 0, None)), static_argnums=2)(
        logits, pools, True
    )
    probability = jnp.prod(jnp.exp(sample_log_probability(logits, subsets))[pools], axis=1)
    np.testing.assert_allclose(probability @ gradients, exact, atol=1e-12)
    np.testing.assert_allclose(probability @ values, expectation(logits), atol=1e-12)
    assert np.abs(exact).max() > 1e-2
    if k > 2:
        # The point of the baselines: the same gradient with a smaller variance.
        plain = values[:, None] * jax.vmap(
            jax.grad(lambda logits, pool: jnp.sum(sample_log_probability(logits, subsets[pool]))), (None, 0)
        )(logits, pools)
        np.testing.assert_allclose(probability @ plain, exact, atol=1e-12)
        assert probability @ jnp.sum(gradients**2, axis=1) < 0.5 * (probability @ jnp.sum(plain**2, axis=1))


@pytest.mark.slow
def test_drawn_gradients_average_to_the_exact_one(x64):
    """As above with what is drawn: sampling, probability and baseline fit together."""
    truth = simulate_rigid(jax.random.key(0), 5, outlier_fraction=0.2, sigma=0.1, dtype=jnp.float64)
    logits = jnp.asarray([0.3, -0.5, 0.8, 0.0, -0.2])
    subsets = jnp.asarray(list(itertools.combinations(range(5), 3)))
    pools = jnp.asarray(list(itertools.product(range(10), repeat=2)))

    def score(model):
        return soft_inlier_count(jnp.sum((model.apply(truth.points0) - truth.points1) ** 2, axis=-1), 0.5)

    def loss(model):
        gap = model.translation() - truth.cam1_from_cam0.translation()
        return jnp.minimum(jnp.sum(gap**2), 1.0)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0))
    @jax.grad
    def drawn(logits, key):
        found = draw_hypotheses(
            key, logits, rigid_three_point, truth.points0, truth.points1, num_samples=2, sample_size=3
        )
        losses, scores = found.map(loss), found.map(score)
        return expected_loss(losses, scores, found.valid, found.log_probability, failure_loss=1.0)

    @jax.jit
    @jax.grad
    def exact(logits):
        models = jax.vmap(lambda s: rigid_three_point(truth.points0[s], truth.points1[s]).models)(subsets)
        losses, scores = (jax.vmap(jax.vmap(f))(models) for f in (loss, score))
        valid = jnp.ones((2, 1), bool)
        values = jax.vmap(lambda pair: expected_loss(losses[pair], scores[pair], valid, failure_loss=1.0))(pools)
        return jnp.sum(jnp.prod(jnp.exp(sample_log_probability(logits, subsets))[pools], axis=1) * values)

    expected = exact(logits)
    gradients = np.asarray(drawn(logits, jax.random.split(jax.random.key(1), 20_000)))
    standard_error = gradients.std(axis=0) / 20_000**0.5
    assert np.all(np.abs(gradients.mean(axis=0) - expected) < 4.0 * standard_error)
    assert np.abs(expected).max() > 20.0 * standard_error.max()


class Kind(NamedTuple):
    """A solver with a problem of its own: errors for the scores, and a loss against the truth."""

    solver: Any
    sample_size: int
    observations: tuple
    squared_error: Any
    loss: Any
    threshold: float
    inliers: Any


def absolute(seed, n, dtype):
    problem = simulate_absolute_pose(jax.random.key(seed), n, outlier_fraction=0.3, dtype=dtype)

    def squared_error(pose, points, bearings):
        directions = [x / jnp.linalg.norm(x, axis=-1, keepdims=True) for x in (pose.apply(points), bearings)]
        return jnp.sum((directions[0] - directions[1]) ** 2, axis=-1)

    def loss(pose):
        return jnp.sum((pose.translation() - problem.cam_from_world.translation()) ** 2)

    observations = (problem.points_world, problem.camera.unproject(problem.pixels))
    return Kind(p3p, 3, observations, squared_error, loss, 0.01, problem.inliers)


def relative(seed, n, dtype):
    problem = simulate_relative_pose(jax.random.key(seed), n, outlier_fraction=0.3, dtype=dtype)
    truth = essential_from_pose(problem.cam1_from_cam0)
    truth = truth / jnp.linalg.norm(truth)

    def squared_error(essential, rays0, rays1):
        return sampson_error(essential, rays0[:, :2] / rays0[:, 2:], rays1[:, :2] / rays1[:, 2:])

    def loss(essential):
        return 1.0 - jnp.sum(essential * truth) ** 2

    rays = tuple(problem.camera.unproject(p) for p in (problem.pixels0, problem.pixels1))
    return Kind(five_point, 5, rays, squared_error, loss, 0.003, problem.inliers)


def plane(seed, n, dtype):
    rng = np.random.default_rng(seed)
    truth = np.array([[1.0, 0.1, 0.2], [-0.1, 0.9, 0.1], [0.1, -0.2, 1.0]])
    inliers = np.arange(n) % 3 > 0

    def transfer(matrix, pixels):
        moved = pixels @ matrix[:, :2].T + matrix[None, :, 2]
        return moved[:, :2] / moved[:, 2:]

    pixels0 = rng.uniform(size=(n, 2))
    pixels1 = transfer(truth, pixels0) + rng.normal(size=(n, 2)) * np.where(inliers, 0.002, 0.3)[:, None]

    def squared_error(matrix, pixels0, pixels1):
        return jnp.sum((transfer(matrix, pixels0) - pixels1) ** 2, axis=-1)

    def loss(matrix):
        return jnp.sum((matrix - jnp.asarray(truth / np.linalg.norm(truth), dtype)) ** 2)

    observations = (jnp.asarray(pixels0, dtype), jnp.asarray(pixels1, dtype))
    return Kind(homography_four_point, 4, observations, squared_error, loss, 0.01, inliers)


def rigid(seed, n, dtype):
    problem = simulate_rigid(jax.random.key(seed), n, outlier_fraction=0.3, dtype=dtype)

    def squared_error(motion, points0, points1):
        return jnp.sum((motion.apply(points0) - points1) ** 2, axis=-1)

    def loss(motion):
        return jnp.sum((motion.translation() - problem.cam1_from_cam0.translation()) ** 2)

    observations = (problem.points0, problem.points1)
    return Kind(rigid_three_point, 3, observations, squared_error, loss, 0.05, problem.inliers)


SLOW = [pytest.param(kind, marks=pytest.mark.slow) for kind in (absolute, relative)]


def soft_loss(kind, logits, *observations, key, k=16, mask=None, select=None, failure_loss=1.0):
    """What a training loop writes; and which hypotheses there were."""
    found = draw_hypotheses(
        key, logits, kind.solver, *observations, num_samples=k, sample_size=kind.sample_size, mask=mask
    )
    # Padding is not drawn, but errors are its too, and 0 times NaN would reach the models.
    finite = observations if mask is None else [jnp.where(mask[:, None], x, 1.0) for x in observations]
    scores = soft_inlier_count(found.map(kind.squared_error, *finite), kind.threshold, mask=mask)
    losses = found.map(kind.loss)
    select = functools.partial(softmax_weights, temperature=0.5) if select is None else select
    loss = expected_loss(
        losses / (losses + 0.1), scores, found.valid, found.log_probability, failure_loss=failure_loss, select=select
    )
    return loss, found


@pytest.mark.slow
@pytest.mark.parametrize("kind", [plane, *SLOW, pytest.param(rigid, marks=pytest.mark.slow)])
def test_gradient_goes_through_solvers_and_scores(kind, x64):
    kind = kind(1, 12, jnp.float64)

    @jax.jit
    def function(*observations):
        return soft_loss(kind, jnp.zeros(12), *observations, key=jax.random.key(3))[0]

    value, gradients = jax.jit(jax.value_and_grad(function, argnums=(0, 1)))(*kind.observations)
    assert 0 < value < 1
    rng = np.random.default_rng(0)
    step = 1e-7
    for argument, gradient in enumerate(gradients):
        direction = rng.normal(size=gradient.shape)
        ends = []
        for sign in (1.0, -1.0):
            moved = list(kind.observations)
            moved[argument] = moved[argument] + sign * step * direction
            ends.append(function(*moved))
        assert np.abs(gradient).max() > 1e-3
        np.testing.assert_allclose(np.sum(gradient * direction), (ends[0] - ends[1]) / (2 * step), rtol=1e-5)


@pytest.mark.parametrize("kind", [plane, SLOW[0]])
def test_gradient_moves_weight_from_outliers_to_inliers(kind):
    kind = kind(2, 30, jnp.float32)
    inliers = np.asarray(kind.inliers)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0))
    @jax.grad
    def gradient(logits, key):
        # All hypotheses count the same, or the few bad ones would hardly matter.
        return soft_loss(kind, logits, *kind.observations, key=key, select=lambda _, valid: valid / jnp.sum(valid))[0]

    drawn = np.asarray(gradient(jnp.zeros(30), jax.random.split(jax.random.key(0), 128)))
    gain = drawn[:, ~inliers].mean(axis=1) - drawn[:, inliers].mean(axis=1)
    assert gain.mean() > 5.0 * gain.std() / 128**0.5


@pytest.mark.slow
@pytest.mark.parametrize("kind", [plane, rigid, *SLOW])
def test_degenerate_observations_give_the_failure_loss_and_no_nan(kind):
    n = 12
    kind = kind(1, n, jnp.float32)

    @jax.jit
    @functools.partial(jax.value_and_grad, argnums=(0, 2, 3), has_aux=True)
    def both(logits, mask, *observations):
        return soft_loss(kind, logits, *observations, key=jax.random.key(3), mask=mask, failure_loss=7.0)

    m = kind.sample_size
    all_of_them = jnp.ones(n, bool)
    same = [jnp.broadcast_to(x[:1], x.shape) for x in kind.observations]
    for name, mask, observations in [
        ("empty", all_of_them & False, kind.observations),
        ("too few", jnp.arange(n) < m - 1, kind.observations),
        ("identical", all_of_them, same),
        ("not a number", all_of_them, [x * jnp.nan for x in kind.observations]),
    ]:
        (value, found), gradients = both(jnp.zeros(n), mask, *observations)
        assert not found.valid.any(), name
        assert value == 7.0, name
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((found.models, gradients))), name
        assert not np.any(gradients[0]), name
    # Padding that is not a number is neither drawn nor read.
    mask = jnp.arange(n) < n - 3
    padded = [x.at[n - 3 :].set(jnp.nan) for x in kind.observations]
    (value, found), gradients = both(jnp.zeros(n), mask, *padded)
    assert found.valid.any()
    assert 0.0 < value < 1.0
    assert np.asarray(found.samples).max() < n - 3
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((found.models, gradients[0])))
    for gradient in gradients[1:]:
        assert np.any(np.asarray(gradient)[: n - 3] != 0)
        assert np.isfinite(gradient).all()


def test_not_finite_losses_and_scores_are_no_hypotheses():
    losses = jnp.array([[1.0, jnp.nan], [jnp.inf, 3.0], [5.0, 2.0]])
    scores = jnp.array([[0.0, 9.0], [9.0, 0.0], [jnp.nan, -jnp.inf]])
    valid = jnp.ones((3, 2), bool)
    probability = jnp.zeros(3)

    def function(losses, scores, probability):
        return expected_loss(losses, scores, valid, probability, failure_loss=9.0)

    value, gradients = jax.value_and_grad(function, argnums=(0, 1, 2))(losses, scores, probability)
    assert value == 2.0
    assert all(np.isfinite(x).all() for x in gradients)
    # Samples whose slots are none make no difference, and get no credit.
    assert gradients[2][2] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "select", [sparsemax_weights, *(pytest.param(f, marks=pytest.mark.slow) for f in (softmax_weights, argmax_weights))]
)
def test_a_batch_is_a_loop(select):
    kind = rigid(4, 15, jnp.float32)
    keys = jax.random.split(jax.random.key(0), 3)
    logits = jnp.asarray(np.random.default_rng(0).normal(size=(3, 15)), jnp.float32)
    masks = jnp.arange(15)[None] < jnp.array([15, 9, 2])[:, None]

    @jax.value_and_grad
    def one(logits, key, mask):
        return soft_loss(kind, logits, *kind.observations, key=key, k=8, mask=mask, select=select)[0]

    values, gradients = jax.jit(jax.vmap(one))(logits, keys, masks)
    alone = jax.jit(one)
    for i in range(3):
        value, gradient = alone(logits[i], keys[i], masks[i])
        np.testing.assert_allclose(values[i], value, atol=1e-5)
        np.testing.assert_allclose(gradients[i], gradient, atol=1e-4)
    assert values[2] == 1.0


def test_wrong_shapes_are_said():
    ones = jnp.ones((2, 1), bool)
    with pytest.raises((ValueError, TypeError)):
        expected_loss(jnp.zeros((2, 1)), jnp.zeros((2, 2)), ones, failure_loss=1.0)
    with pytest.raises((ValueError, TypeError)):
        expected_loss(jnp.zeros((2, 1)), jnp.zeros((2, 1)), ones, jnp.zeros(3), failure_loss=1.0)
    points, key = jnp.zeros((5, 3)), jax.random.key(0)
    with pytest.raises(ValueError, match="a logit for each row"):
        draw_hypotheses(key, jnp.zeros(4), rigid_three_point, points, points, num_samples=2, sample_size=3)
