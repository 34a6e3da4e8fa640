import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from vojax.ba import Barron, Cauchy, GaussianUniform, GemanMcClure, Huber, Loss, Squared, mad_scale, robustify

# ρ(s) as the papers print it, with the constants used below.
ORACLES = {
    "squared": (Squared(), lambda s: s),
    "huber": (Huber(1.3), lambda s: np.where(np.sqrt(s) <= 1.3, s, 2 * 1.3 * np.sqrt(s) - 1.3**2)),
    "cauchy": (Cauchy(1.7), lambda s: 1.7**2 * np.log(1 + s / 1.7**2)),
    "geman-mcclure": (GemanMcClure(2.1), lambda s: 2.1**2 * s / (2.1**2 + s)),
    # Barron 2019, eq. (1), times 2c²: ρ = 2c² |α−2|/α (((x/c)²/|α−2| + 1)^(α/2) − 1).
    "barron 1": (Barron(1.0, 1.5), lambda s: 2 * 1.5**2 * (np.sqrt(s / 1.5**2 + 1) - 1)),
    "barron -1": (Barron(-1.0, 0.8), lambda s: 2 * 0.8**2 * 3 / -1 * ((s / 0.8**2 / 3 + 1) ** -0.5 - 1)),
    "barron 1.4": (Barron(1.4, 0.8), lambda s: 2 * 0.8**2 * 0.6 / 1.4 * ((s / 0.8**2 / 0.6 + 1) ** 0.7 - 1)),
}
SQUARES = np.concatenate([[0.0, 1e-12, 1e-6], np.geomspace(1e-3, 1e4, 60), [1.3**2]])
all_losses = pytest.mark.parametrize("name", ORACLES)


@all_losses
def test_rho_is_the_published_formula(name, dtype):
    loss, oracle = ORACLES[name]
    rho = loss.rho(jnp.asarray(SQUARES, dtype))
    assert isinstance(loss, Loss)
    assert rho.dtype == dtype
    assert rho[0] == 0
    tolerance = 3e-6 if dtype == jnp.float32 else 1e-12
    # The formulas cancel near 0 where vojax does not, hence the absolute part.
    np.testing.assert_allclose(rho, oracle(SQUARES), rtol=tolerance, atol=1e-14)


@all_losses
def test_weight_is_the_derivative_of_rho(name, x64):
    loss, oracle = ORACLES[name]
    s = jnp.asarray(SQUARES[2:])  # central differences of the oracle, which needs room below s
    weight = np.asarray(loss.weight(s))
    np.testing.assert_allclose(weight, jax.jit(jax.vmap(jax.grad(loss.rho)))(s), rtol=1e-12)
    assert loss.weight(jnp.zeros(()))[()] == pytest.approx(1.0, abs=1e-12)
    smooth = np.abs(SQUARES[2:] - 1.3**2) > 1e-3  # Huber's second derivative jumps there
    h = 1e-4 * SQUARES[2:]
    differences = (oracle(SQUARES[2:] + h) - oracle(SQUARES[2:] - h)) / (2 * h)
    np.testing.assert_allclose(weight[smooth], differences[smooth], rtol=1e-5)


@all_losses
def test_derivatives_are_finite_at_zero_and_far_out(name):
    loss, _ = ORACLES[name]

    @jax.jit
    def values(s):
        functions = [f for g in (loss.rho, loss.weight) for f in (g, jax.grad(g), jax.grad(jax.grad(g)))]
        return [jax.vmap(function)(s) for function in functions]

    assert np.isfinite(values(jnp.array([0.0, 1e-30, 1e-6, 1.3**2, 1e30]))).all()


@pytest.mark.parametrize(
    ("alpha", "named", "scale"),
    [
        (2.0, Squared(), 1.5),
        (0.0, Cauchy(1.5 * 2**0.5), 1.5),
        (-2.0, GemanMcClure(1.5 * 2), 1.5),
    ],
    ids=["squared", "cauchy", "geman-mcclure"],
)
def test_barron_passes_through_the_named_losses(alpha, named, scale, dtype):
    barron = Barron(jnp.asarray(alpha, dtype), scale)
    s = jnp.asarray(SQUARES[:-20], dtype)  # at 1e30 no α near 2 is the squared loss
    # The singular values are stepped over by 2√eps: 7e-4 in float32.
    tolerance = 5e-3 if dtype == jnp.float32 else 1e-6
    np.testing.assert_allclose(barron.rho(s), named.rho(s), rtol=tolerance)
    np.testing.assert_allclose(barron.weight(s), named.weight(s), rtol=tolerance)


def test_barrons_shape_can_be_learnt(x64):
    s = jnp.asarray(SQUARES[1:-10])
    total = jax.jit(jax.vmap(jax.value_and_grad(lambda alpha: jnp.sum(Barron(alpha, 1.2).rho(s)))))
    alphas = np.array([-3.0, -0.5, 0.4, 1.0, 1.7, 0.0, 2.0])
    gradient = total(alphas)[1]
    differences = (total(alphas + 1e-5)[0] - total(alphas - 1e-5)[0]) / 2e-5
    np.testing.assert_allclose(gradient[:5], differences[:5], rtol=1e-6)
    assert np.isfinite(gradient).all()


@all_losses
def test_robustified_residual_has_half_the_loss_as_cost(name, dtype, tolerance):
    loss, oracle = ORACLES[name]
    rng = np.random.default_rng(0)
    residual = rng.normal(size=(3, 50)) * np.geomspace(1e-6, 100, 50)
    residual[:, 7] = 0.0
    weight = rng.uniform(0.1, 2.0, size=50) * (np.arange(50) % 9 > 0)
    robust = robustify(tuple(jnp.asarray(residual, dtype)), loss, jnp.asarray(weight, dtype))
    cost = 0.5 * sum(np.asarray(r, np.float64) ** 2 for r in robust)
    expected = 0.5 * weight * oracle(np.sum(residual**2, axis=0))
    np.testing.assert_allclose(cost, expected, rtol=10 * tolerance, atol=1e-14)
    assert np.all(np.asarray(robust)[:, 7] == 0)
    # The direction of the residual stays.
    cosine = np.sum(np.asarray(robust) * residual, 0)[weight > 0]
    norms = np.linalg.norm(np.asarray(robust), axis=0) * np.linalg.norm(residual, axis=0)
    np.testing.assert_allclose(cosine, norms[weight > 0], rtol=10 * tolerance)


@all_losses
def test_robustified_residual_is_differentiable_at_zero(name):
    loss, _ = ORACLES[name]

    def first(u, v, w):
        return robustify((u, v), loss, w)[0]

    @jax.jit
    def derivatives(u, w):
        zero = jnp.zeros_like(u)
        by_all = jax.vmap(jax.grad(first, argnums=(0, 1, 2)))(u, zero, w)
        return by_all, jax.vmap(jax.grad(jax.grad(first)))(u, zero, w)

    u, w = jnp.array([0.0, 1e-25, 0.0, 1e8]), jnp.array([4.0, 4.0, 0.0, 4.0])
    by_all, second = derivatives(u, w)
    assert np.isfinite(by_all).all()
    assert np.isfinite(second).all()
    np.testing.assert_allclose(by_all[0][:3], [2.0, 2.0, 0.0], rtol=1e-6)  # r̃ ≈ √w r


@pytest.mark.parametrize("n", [1, 2, 7, 30, 101])
def test_mad_scale_is_scipys(n, dtype):
    rng = np.random.default_rng(n)
    residuals = rng.normal(3.0, 2.0, size=n).astype(dtype)
    expected = scipy.stats.median_abs_deviation(residuals.astype(np.float64), scale=1 / 1.4826)
    np.testing.assert_allclose(mad_scale(residuals), expected, rtol=1e-5, atol=1e-7)


def test_mad_scale_ignores_what_is_masked():
    rng = np.random.default_rng(3)
    residuals = rng.normal(size=40).astype(np.float32)
    for kept in (1, 2, 15, 16):
        mask = rng.permutation(np.arange(40) < kept)
        chosen = residuals[mask]
        expected = 1.4826 * np.median(np.abs(chosen - np.median(chosen)))
        dirty = np.where(mask, residuals, rng.choice([1e30, -5.0, np.inf], size=40)).astype(np.float32)
        assert mad_scale(dirty, jnp.asarray(mask)) == pytest.approx(expected, rel=1e-5, abs=1e-7)
    assert mad_scale(residuals, jnp.zeros(40, bool)) == 0


def test_mad_scale_estimates_the_deviation_in_spite_of_outliers():
    rng = np.random.default_rng(5)
    residuals = np.concatenate([rng.normal(0, 0.7, 20000), rng.normal(0, 100.0, 2000)]).astype(np.float32)
    # 9 % outliers raise the median deviation by about a tenth; the standard deviation is 30.
    assert 0.65 < mad_scale(residuals) < 0.85


def test_huber_location_is_the_known_estimator(x64):
    # Minimising ½Σρ over a location is Huber's M-estimator: an independent fixed point, ψ summed to zero.
    rng = np.random.default_rng(1)
    x = np.concatenate([rng.normal(2.0, 1.0, 60), [30.0, 45.0]])
    found = scipy.optimize.brentq(lambda m: np.sum(np.clip(x - m, -1.345, 1.345)), -5, 10, xtol=1e-13)
    gradient = jax.jit(jax.grad(lambda m: 0.5 * jnp.sum(Huber().rho((jnp.asarray(x) - m) ** 2))))(found)
    assert abs(gradient) < 1e-10


@all_losses
def test_derivatives_up_to_the_third_are_finite_however_far_out(name, dtype):
    loss, _ = ORACLES[name]
    cost = lambda r: sum(c * c for c in robustify((r, 0.3 * r), loss))  # noqa: E731
    third = jax.grad(jax.grad(jax.grad(cost)))
    values = jax.jit(jax.vmap(lambda r: (cost(r), third(r))))(jnp.geomspace(1.0, 1e18, 64, dtype=dtype))
    assert all(np.isfinite(v).all() for v in values)


@pytest.mark.parametrize(
    "loss", [Huber(1.3), Cauchy(1.7), GemanMcClure(2.1), Barron(-1.0, 0.8), GaussianUniform(3.0)], ids=str
)
def test_second_derivatives_of_small_residuals_are_those_of_the_loss(loss):
    """Residuals of a model that fits all but exactly: ½ρ(r²) has the second derivative ρ′(0) there."""
    r = jnp.float32(np.concatenate([[0.0], np.geomspace(1e-12, 1e-2, 30)]))

    def half_loss(x):
        (scaled,) = robustify((x,), loss)
        return 0.5 * scaled * scaled

    second = jax.jit(jax.vmap(jax.grad(jax.grad(half_loss))))(r)
    np.testing.assert_allclose(second, float(loss.weight(jnp.zeros(()))), rtol=2e-2)
