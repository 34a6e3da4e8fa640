import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.solvers._roots import cubic_roots, evaluate, pack, polynomial_roots, quadratic_roots, quartic_roots

SOLVERS = {
    2: jax.jit(quadratic_roots),
    3: jax.jit(cubic_roots),
    4: jax.jit(quartic_roots),
    10: jax.jit(lambda c: polynomial_roots(c, 10)),
}
BATCH = 4096


def solve(coefficients, dtype, size=BATCH):
    """Pairs [count, slots, 2] and validity [count, slots] for coefficients [count, terms], in batches of one shape."""
    solver = SOLVERS[coefficients.shape[1] - 1]
    results = []
    for start in range(0, len(coefficients), size):
        part = coefficients[start : start + size]
        padded = np.concatenate([part, np.zeros((size - len(part), part.shape[1]))])
        pairs, valid = solver(np.ascontiguousarray(padded.T).astype(dtype))
        results.append((np.moveaxis(np.asarray(pairs), 0, -1).swapaxes(0, 1), np.asarray(valid).T))
        results[-1] = tuple(x[: len(part)] for x in results[-1])
    pairs, valid = (np.concatenate(x) for x in zip(*results, strict=True))
    assert np.isfinite(pairs).all()
    np.testing.assert_array_equal(pairs[~valid], np.broadcast_to([0.0, 1.0], pairs[~valid].shape))
    np.testing.assert_allclose(np.abs(pairs[valid]).max(axis=-1), 1.0, rtol=2.0 * np.finfo(dtype).eps)
    assert (pairs[..., 1] >= 0).all()
    return pairs.astype(np.float64), valid


def angles(pairs):
    """Roots on the circle of directions: 0 to π, infinity at π / 2."""
    return np.arctan2(pairs[..., 0], pairs[..., 1])


def true_angles(coefficients):
    """Angles [count, degree] of all roots by numpy's companion matrix, and which are real."""
    degree = coefficients.shape[1] - 1
    companion = np.zeros((len(coefficients), degree, degree))
    companion[:, np.arange(1, degree), np.arange(degree - 1)] = 1.0
    companion[:, :, -1] = -coefficients[:, :-1] / coefficients[:, -1:]
    roots = np.linalg.eigvals(companion)
    return np.arctan(roots.real), np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1.0), roots


def separations(roots):
    """Distance of each root to its nearest neighbour, complex ones included, relative to its size."""
    gaps = np.abs(roots[:, :, None] - roots[:, None, :]) + 1e9 * np.eye(roots.shape[1])
    return gaps.min(axis=-1) / np.maximum(np.abs(roots), 1.0)


def shares(coefficients, dtype, tolerance, apart=1e-3):
    """Share of separated real roots that are found, and the share of what is found that is a root."""
    pairs, valid = solve(coefficients, dtype)
    found = angles(pairs)
    truth, real, roots = true_angles(coefficients)
    distance = np.abs(np.sin(found[:, :, None] - truth[:, None, :]))
    wanted = real & (separations(roots) > apart)
    nearest = np.where(valid[:, :, None], distance, np.inf).min(axis=1)
    # A pair that is within rounding of real is rightly reported as a double root.
    close = real | (np.abs(roots.imag) < 0.05 * np.maximum(np.abs(roots), 1.0))
    backed = np.where(close[:, None, :], distance, np.inf).min(axis=2)
    return (nearest[wanted] < tolerance).mean(), (backed[valid] < 0.05).mean(), wanted.sum()


@pytest.mark.parametrize("degree", [2, 3, 4, 10])
def test_finds_what_numpy_finds(dtype, degree):
    coefficients = np.random.default_rng(degree).normal(size=(BATCH, degree + 1))
    recall, precision, count = shares(coefficients, dtype, 1e-4 if dtype == jnp.float32 else 1e-9)
    assert count > BATCH
    assert recall >= (0.998 if dtype == jnp.float32 else 0.9999)
    assert precision == 1.0


@pytest.mark.parametrize("degree", [2, 3, 4, 10])
def test_finds_all_roots_where_all_are_real(dtype, degree):
    rng = np.random.default_rng(10 + degree)
    roots = np.tan(rng.uniform(-1.5, 1.5, (BATCH, degree)))
    coefficients = np.stack([np.poly(x)[::-1] for x in roots])
    truth = np.arctan(roots)
    pairs, valid = solve(coefficients, dtype)
    distance = np.abs(np.sin(angles(pairs)[:, :, None] - truth[:, None, :]))
    nearest = np.where(valid[:, :, None], distance, np.inf).min(axis=1)
    gaps = np.abs(np.sin(truth[:, :, None] - truth[:, None, :])) + np.eye(degree)
    separate = gaps.min(axis=-1) > 0.05
    tolerance = 2e-2 if dtype == jnp.float32 else 1e-6
    # In float32 the coefficients of degree 10 decide less than this.
    if degree < 10 or dtype == jnp.float64:
        assert (nearest[separate] < tolerance).mean() > 0.998
    assert valid.sum(axis=-1).mean() > 0.97 * degree or dtype == jnp.float32


def test_degree_ten_with_all_roots_real_in_float32():
    # Chebyshev polynomials are the well-conditioned ones.
    from numpy.polynomial import chebyshev

    coefficients = chebyshev.cheb2poly(np.eye(11)[10])[None]
    pairs, valid = solve(coefficients, np.float32)
    assert valid.all()
    expected = np.sort(np.cos((2.0 * np.arange(10) + 1.0) * np.pi / 20.0))
    np.testing.assert_allclose(np.sort(pairs[0, :, 0] / pairs[0, :, 1]), expected, atol=1e-4)


@pytest.mark.parametrize("degree", [2, 3, 4, 10])
def test_root_at_infinity_and_at_zero(dtype, degree):
    rng = np.random.default_rng(20 + degree)
    coefficients = rng.normal(size=(512, degree + 1))
    infinite, zero = coefficients.copy(), coefficients.copy()
    infinite[:, -1], zero[:, 0] = 0.0, 0.0
    pairs, valid = solve(infinite, dtype)
    at_infinity = valid & (pairs[..., 1] < (1e-6 if dtype == jnp.float32 else 1e-14))
    assert (at_infinity.sum(axis=-1) == 1).all()
    pairs, valid = solve(zero, dtype)
    at_zero = valid & (np.abs(pairs[..., 0]) < (1e-6 if dtype == jnp.float32 else 1e-14))
    assert (at_zero.sum(axis=-1) == 1).all()
    # The other roots are those of the polynomial of lower degree.
    if degree in (3, 4):
        truth, real, roots = true_angles(infinite[:, :-1])
        wanted = real & (separations(roots) > 1e-3)
        pairs, valid = solve(infinite, dtype)
        distance = np.where(valid[:, :, None], np.abs(np.sin(angles(pairs)[:, :, None] - truth[:, None, :])), np.inf)
        assert (distance.min(axis=1)[wanted] < (1e-3 if dtype == jnp.float32 else 1e-8)).mean() > 0.998


def test_nearly_infinite_root_does_not_spoil_the_others(x64):
    # Roots in [-1, 1] and one far away, as when points are distant.
    rng = np.random.default_rng(30)
    coefficients = rng.normal(size=(BATCH, 5))
    coefficients = coefficients[np.abs(coefficients[:, 3]) > 0.1]
    coefficients[:, 4] = 10.0 ** rng.uniform(-14, -8, len(coefficients))
    truth, real, roots = true_angles(coefficients[:, :4])
    pairs, valid = solve(coefficients, np.float64)
    distance = np.where(valid[:, :, None], np.abs(np.sin(angles(pairs)[:, :, None] - truth[:, None, :])), np.inf)
    wanted = real & (separations(roots) > 1e-2)
    assert (distance.min(axis=1)[wanted] < 1e-5).mean() > 0.9999


@pytest.mark.parametrize("degree", [2, 3, 4, 10])
def test_double_roots_are_not_lost(dtype, degree):
    rng = np.random.default_rng(40 + degree)
    double = rng.uniform(-2.0, 2.0, 512)
    coefficients = []
    for root in double:
        rest = rng.normal(size=degree - 1)
        coefficients.append(np.polymul(rest, np.poly([root, root]))[::-1])
    pairs, valid = solve(np.stack(coefficients), dtype)
    distance = np.where(valid, np.abs(np.sin(angles(pairs) - np.arctan(double)[:, None])), np.inf).min(axis=-1)
    # Half the digits; the rest is the conditioning of the polynomial.
    assert (distance < (3e-2 if dtype == jnp.float32 else 1e-5)).mean() > 0.99


def test_quadratics_with_double_and_complex_roots(dtype):
    coefficients = np.array(
        [[1.0, 2.0, 1.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 1.0, 0.0]]
    )
    pairs, valid = solve(coefficients, dtype)
    np.testing.assert_array_equal(valid.sum(axis=-1), [2, 0, 2, 2, 2, 2])
    np.testing.assert_allclose(pairs[0], [[-1.0, 1.0]] * 2)
    np.testing.assert_array_equal(np.abs(pairs[2]), [[0.0, 1.0]] * 2)
    np.testing.assert_array_equal(np.abs(pairs[3]), [[1.0, 0.0]] * 2)
    assert {tuple(x) for x in np.abs(pairs[4]).tolist()} == {(0.0, 1.0), (1.0, 0.0)}


def test_quadratic_does_not_cancel():
    # x² - 1e4 x + 1: the small root to full precision.
    pairs, valid = solve(np.array([[1.0, -1e4, 1.0]]), np.float32)
    assert valid.all()
    ratios = np.sort(pairs[0, :, 0] / pairs[0, :, 1])
    np.testing.assert_allclose(ratios, [1.00000001e-4, 9999.9999], rtol=3e-7)


@pytest.mark.parametrize("degree", [2, 3, 4, 10])
def test_scale_of_coefficients_does_not_matter(dtype, degree):
    coefficients = np.random.default_rng(50 + degree).normal(size=(256, degree + 1))
    pairs, valid = solve(coefficients, dtype)
    for factor in (2.0**100, -(2.0**-100)):
        other, other_valid = solve(coefficients * factor, dtype)
        np.testing.assert_array_equal(other_valid, valid)
        np.testing.assert_allclose(other, pairs, atol=1e-5 if dtype == jnp.float32 else 1e-12)


@pytest.mark.parametrize("degree", [3, 4])
def test_scale_of_the_variable_does_not_matter(x64, degree):
    rng = np.random.default_rng(60 + degree)
    coefficients = rng.normal(size=(BATCH, degree + 1))
    for size in (1e-3, 1e3):
        scaled = coefficients / size ** np.arange(degree + 1)
        truth, real, roots = true_angles(scaled)
        pairs, valid = solve(scaled, np.float64)
        distance = np.where(valid[:, :, None], np.abs(np.sin(angles(pairs)[:, :, None] - truth[:, None, :])), np.inf)
        wanted = real & ((separations(roots / size)) > 1e-3)
        assert (distance.min(axis=1)[wanted] < 1e-9).mean() > 0.999


@pytest.mark.parametrize("degree", [2, 3, 4, 10])
def test_nonsense_has_no_root(dtype, degree):
    coefficients = np.ones((6, degree + 1))
    coefficients[0] = 0.0
    coefficients[1, 1] = np.nan
    coefficients[2, 0] = np.inf
    coefficients[3, degree] = -np.inf
    coefficients[4, :] = np.nan
    coefficients[5, 1:] = 0.0  # a constant: all its roots are at infinity
    pairs, valid = solve(coefficients, dtype)
    assert not valid[:5].any()
    assert (np.abs(pairs[5][valid[5]]) == [1.0, 0.0]).all()


def test_roots_ascend_within_one_and_then_beyond(x64):
    pairs, valid = solve(np.poly([-3.0, -0.5, 0.25, 2.0])[::-1][None], np.float64)
    assert valid.all()
    np.testing.assert_allclose(pairs[0, :2, 0] / pairs[0, :2, 1], [-0.5, 0.25])
    np.testing.assert_allclose(np.sort(pairs[0, 2:, 0] / pairs[0, 2:, 1]), [-3.0, 2.0])


def test_fewer_slots_than_degree_keep_the_first(x64):
    c = jnp.asarray(np.poly([-0.5, 0.25, 0.75])[::-1].copy())
    pairs, valid = polynomial_roots(c, 2)
    assert valid.all()
    np.testing.assert_allclose(pairs[0] / pairs[1], [-0.5, 0.25])


def test_evaluate_equals_numpy(x64):
    rng = np.random.default_rng(70)
    c, x = rng.normal(size=(6, 20)), rng.normal(size=20)
    expected = [np.polynomial.polynomial.polyval(x[i], c[:, i]) for i in range(20)]
    np.testing.assert_allclose(evaluate(jnp.asarray(c), jnp.asarray(x)), expected, rtol=1e-12)


def test_pack_moves_the_valid_to_the_front():
    values = jnp.arange(10.0).reshape(2, 5)
    packed, valid = pack(values, jnp.asarray([False, True, False, True, True]), 4)
    np.testing.assert_array_equal(packed, [[1.0, 3.0, 4.0, 0.0], [6.0, 8.0, 9.0, 0.0]])
    np.testing.assert_array_equal(valid, [True, True, True, False])


@pytest.mark.slow
def test_many_lanes_give_what_few_give():
    coefficients = np.random.default_rng(80).normal(size=(65_536, 5))
    many, many_valid = solve(coefficients, np.float32, size=65_536)
    few, few_valid = solve(coefficients, np.float32)
    same = (many_valid == few_valid).all(axis=-1)
    assert same.mean() > 0.9999
    assert np.quantile(np.abs(many - few)[same].max(axis=(-1, -2)), 0.999) < 1e-4


def degenerate(count, degree, seed):
    """Polynomials of every unkind sort."""
    rng = np.random.default_rng(seed)
    coefficients = rng.normal(size=(count, degree + 1))
    kinds = np.array_split(np.arange(count), 9)
    coefficients[kinds[0]] = rng.integers(-1, 2, (len(kinds[0]), degree + 1))
    coefficients[kinds[1], rng.integers(0, degree + 1, len(kinds[1]))] = np.nan
    coefficients[kinds[2], rng.integers(0, degree + 1, len(kinds[2]))] = np.inf
    coefficients[kinds[3]] *= 10.0 ** rng.uniform(-45, 45, (len(kinds[3]), degree + 1))
    coefficients[kinds[4], degree // 2 :] = 0.0
    coefficients[kinds[5], : degree // 2] = 0.0
    coefficients[kinds[6]] *= 1e-38
    coefficients[kinds[7]] *= rng.integers(0, 2, (len(kinds[7]), degree + 1)) * 1e38
    return coefficients


@pytest.mark.parametrize("degree", [2, 3, 4, 10])
def test_degenerate_polynomials_give_finite_pairs(dtype, degree):
    with np.errstate(over="ignore"):
        solve(degenerate(BATCH, degree, seed=degree), dtype)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [2, 4, 10])
def test_a_million_degenerate_polynomials(dtype, degree):
    with np.errstate(over="ignore"):
        for seed in range(10):
            solve(degenerate(100_000, degree, seed), dtype, size=25_000)


@pytest.mark.slow
def test_recall_of_many_polynomials_of_degree_ten(dtype):
    coefficients = np.random.default_rng(90).normal(size=(100_000, 11))
    tolerance = 1e-3 if dtype == jnp.float32 else 1e-8
    recall, precision, count = shares(coefficients, dtype, tolerance)
    print("recall", dtype, recall, "precision", precision, "roots", count)
    assert recall >= (0.9995 if dtype == jnp.float32 else 0.9999)
    assert precision > 0.9999
