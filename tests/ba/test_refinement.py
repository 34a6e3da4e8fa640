"""Refinement of a pose against least squares written in numpy, in double precision unless a test says otherwise."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.spatial
import scipy.stats

from vojax._result import Result
from vojax.ba import Cauchy, Huber, LMOptions, Squared, refine_absolute_pose
from vojax.cameras import Pinhole, RectifiedStereo
from vojax.lie import SE3

B, N = 16, 30  # every test solves B problems of N points at once, so that few programs are compiled
FOCAL, CENTER, BASELINE = 700.0, np.array([320.0, 240.0]), 0.5
TIGHT = 1e-22  # tolerance in float64, where differences of optima are taken
RHO = {  # ρ(s) and ρ′(s)
    "squared": (Squared(), lambda s: (s, np.ones_like(s))),
    "huber": (
        Huber(1.2),
        lambda s: (
            np.where(s <= 1.44, s, 2.4 * np.sqrt(s) - 1.44),
            np.where(s <= 1.44, 1.0, 1.2 / np.sqrt(np.maximum(s, 1e-30))),
        ),
    ),
    "cauchy": (Cauchy(2.0), lambda s: (4 * np.log1p(s / 4), 1 / (1 + s / 4))),
}


# ---- the oracle


def hat(xi):
    (a, b, c), matrix = xi[3:], np.zeros((4, 4))
    matrix[:3, :3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]]
    matrix[:3, 3] = xi[:3]
    return matrix


def moved(cam_from_world, xi):
    """The pose whose state `world_from_cam` was multiplied by exp(ξ) on the right."""
    return scipy.linalg.expm(-hat(xi)) @ cam_from_world


def tangent(cam_from_world, other):
    """ξ with `moved(cam_from_world, ξ) == other`."""
    matrix = -scipy.linalg.logm(other @ np.linalg.inv(cam_from_world)).real
    return np.array([*matrix[:3, 3], matrix[2, 1], matrix[0, 2], matrix[1, 0]])


def observe(cam_from_world, points, d=2, focal=FOCAL):
    x, y, z = (points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]).T
    rows = [focal * x / z + CENTER[0], focal * y / z + CENTER[1], focal * (x - BASELINE) / z + CENTER[0]]
    return np.stack(rows[:d], axis=-1)


def residuals(cam_from_world, problem, rho):
    """Residuals `[n, d]` with half the loss as half their squared norm, by the symmetric root of Σ⁻¹."""
    raw = observe(cam_from_world, problem["points"], problem["pixels"].shape[1]) - problem["pixels"]
    white = np.stack(
        [scipy.linalg.sqrtm(np.linalg.inv(s)).real @ r for s, r in zip(problem["sigma"], raw, strict=True)]
    )
    s = np.sum(white**2, axis=1)
    return white * np.sqrt(problem["weights"] * problem["mask"] * rho(s)[0] / s)[:, None]


def jacobian(function, at, h=1e-6):
    steps = h * np.eye(len(at))
    return np.stack([(function(at + e) - function(at - e)) / (2 * h) for e in steps], axis=-1)


def linearized(cam_from_world, problem, rho):
    """Jacobian `[n, d, 6]` of `residuals`, and the terms `[n, 6]` whose sum is the gradient of the cost.

    Differences are taken of the projection alone: across Huber's corner they would not be derivatives of its loss.
    """
    d = problem["pixels"].shape[1]
    roots = np.stack([scipy.linalg.sqrtm(np.linalg.inv(s)).real for s in problem["sigma"]])
    raw = observe(cam_from_world, problem["points"], d) - problem["pixels"]
    by_pose = jacobian(lambda xi: observe(moved(cam_from_world, xi), problem["points"], d), np.zeros(6), h=1e-5)
    r, rows = np.einsum("nij,nj->ni", roots, raw), roots @ by_pose
    s, weight = np.sum(r**2, axis=1), problem["weights"] * problem["mask"]
    value, slope = rho(s)
    # r̃ = g(s) r with g² = ρ/s, so 2 g g′ = (ρ′ s − ρ)/s².
    g = np.sqrt(value / s)
    radial = np.einsum("ni,nik->nk", r, rows)
    turned = (
        g[:, None, None] * rows + ((slope * s - value) / (g * s**2))[:, None, None] * r[:, :, None] * radial[:, None]
    )
    return np.sqrt(weight)[:, None, None] * turned, (weight * slope)[:, None] * radial


def relative_gradient(problem, pose, rho):
    """Largest entry of the gradient, relative to the sum of the magnitudes that it is made of."""
    terms = linearized(pose, problem, rho)[1]
    return np.max(np.abs(terms.sum(0)) / np.abs(terms).sum(0))


def make_problem(seed, d=2, noise=1.0):
    rng = np.random.default_rng(seed)
    cam_from_world = scipy.linalg.expm(hat(rng.normal(size=6) * [3, 3, 3, 1, 1, 1]))
    z = rng.uniform(4.0, 12.0, size=N)
    points_cam = np.column_stack([rng.uniform(-0.4, 0.4, size=(N, 2)) * z[:, None], z])
    points = (points_cam - cam_from_world[:3, 3]) @ cam_from_world[:3, :3]
    root = rng.normal(size=(N, d, d)) * 0.15 + np.eye(d)
    sigma = root @ root.transpose(0, 2, 1)
    error = noise * np.einsum("nij,nj->ni", root, rng.normal(size=(N, d)))
    return {
        "points": points,
        "pixels": observe(cam_from_world, points, d) + error,
        "sigma": sigma,
        "weights": rng.uniform(0.3, 2.0, size=N) * (np.arange(N) % 11 > 0),
        "mask": np.arange(N) % 7 > 0,
        "truth": cam_from_world,
        "start": moved(cam_from_world, rng.normal(size=6) * [0.1, 0.1, 0.1, 0.03, 0.03, 0.03]),
    }


def stacked(problems):
    return {name: np.stack([problem[name] for problem in problems]) for name in problems[0]}


@functools.cache
def oracle_optimum(seed, name, d=2):
    problem, rho = make_problem(seed, d), RHO[name][1]
    solution = scipy.optimize.least_squares(
        lambda xi: residuals(moved(problem["start"], xi), problem, rho).ravel(),
        np.zeros(6),
        jac="3-point",
        method="lm",
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
        x_scale="jac",
    )
    return moved(problem["start"], solution.x), solution.cost


# ---- the library, compiled once for each loss


def refine(problem, loss, tolerance):
    d = problem["pixels"].shape[1]
    camera = Pinhole(fx=problem["focal"], fy=problem["focal"], cx=CENTER[0], cy=CENTER[1])
    camera = camera if d == 2 else RectifiedStereo(camera, BASELINE)
    return refine_absolute_pose(
        SE3.from_matrix(problem["start"]),
        problem["points"],
        problem["pixels"],
        camera,
        sigma_px=problem["sigma"],
        mask=problem["mask"],
        weights=problem["weights"],
        loss=loss,
        options=LMOptions(max_steps=60, tolerance=tolerance),
    )


@functools.partial(jax.jit, static_argnums=2)
def _solve(problem, loss, tolerance):
    return jax.vmap(lambda one: refine(one, loss, tolerance))(problem)


def solve(problem, loss, tolerance="by dtype"):
    """Solve B problems: float64 tightly, float32 by default."""
    if tolerance == "by dtype":
        tolerance = TIGHT if problem["pixels"].dtype == jnp.float64 else None
    return _solve(problem, loss, tolerance)


def arguments(problems, dtype=np.float64):
    """Arguments of `solve`, repeated to B problems."""
    batch = stacked([problems[i % len(problems)] for i in range(B)])
    del batch["truth"]
    batch.setdefault("focal", np.full(B, FOCAL))
    return {name: jnp.asarray(x if x.dtype == bool else x.astype(dtype)) for name, x in batch.items()}


def matrices(pose):
    return np.asarray(pose.as_matrix(), np.float64)


@pytest.mark.parametrize(
    ("name", "d"),
    [
        ("squared", 2),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("huber", 2), ("cauchy", 2), ("squared", 3))),
    ],
)
def test_the_optimum_is_scipys(name, d, x64):
    problems = [make_problem(seed, d) for seed in range(4)]
    found = solve(arguments(problems), RHO[name][0])
    assert np.all(found.result == Result.success)
    for i, problem in enumerate(problems):
        pose, cost = oracle_optimum(i, name, d)
        # scipy's differences stall a little above the optimum of the robust costs, so there ours may be lower.
        assert cost * (1 - (1e-9 if name == "squared" else 1e-6)) < found.cost[i] < cost * (1 + 1e-9)
        assert np.abs(tangent(pose, matrices(found.model)[i])).max() < (1e-7 if name == "squared" else 1e-4)
        assert relative_gradient(problem, matrices(found.model)[i], RHO[name][1]) <= 1e-9


@pytest.mark.slow
def test_the_gradient_vanishes_with_the_default_tolerance(x64):
    problems = [make_problem(seed) for seed in range(B)]
    found = solve(arguments(problems), Squared(), None)
    assert np.all(found.result == Result.success)
    for problem, pose in zip(problems, matrices(found.model), strict=True):
        assert relative_gradient(problem, pose, RHO["squared"][1]) <= 1e-9


@pytest.mark.slow
def test_the_optimum_is_jaxopts(x64):
    import jaxopt

    problem = make_problem(0)
    white = np.stack([np.linalg.inv(np.linalg.cholesky(s)) for s in problem["sigma"]])
    white = white * np.sqrt(problem["weights"] * problem["mask"])[:, None, None]

    def residual(x):  # rotation vector and translation, nothing of vojax
        angle = jnp.sqrt(jnp.sum(x[:3] ** 2))
        axis = (x[:3] / angle)[None]
        turned = jnp.cos(angle) * problem["points"] + jnp.sin(angle) * jnp.cross(axis, problem["points"])
        along = jnp.sum(axis * problem["points"], axis=1, keepdims=True)
        points = turned + (1 - jnp.cos(angle)) * along * axis + x[None, 3:]
        raw = FOCAL * points[:, :2] / points[:, 2:] + CENTER[None] - problem["pixels"]
        return jnp.sum(white * raw[:, None], axis=2).ravel()

    rotation = scipy.spatial.transform.Rotation.from_matrix(problem["start"][:3, :3])
    start = jnp.asarray(np.concatenate([rotation.as_rotvec(), problem["start"][:3, 3]]))
    found, state = jaxopt.LevenbergMarquardt(residual, maxiter=100, tol=1e-10).run(start)
    ours = jax.tree.map(lambda leaf: leaf[0], solve(arguments([problem]), Squared()))
    assert ours.cost == pytest.approx(float(state.value), rel=1e-9)
    expected = np.eye(4)
    expected[:3, :3] = scipy.spatial.transform.Rotation.from_rotvec(np.array(found[:3])).as_matrix()
    expected[:3, 3] = found[3:]
    assert np.abs(tangent(expected, matrices(ours.model))).max() < 1e-6


@pytest.mark.parametrize(
    ("name", "d"),
    [("squared", 2), *(pytest.param(*case, marks=pytest.mark.slow) for case in (("huber", 2), ("squared", 3)))],
)
def test_the_covariance_is_the_inverse_gauss_newton_matrix(name, d, x64):
    problems = [make_problem(seed, d) for seed in range(4)]
    found = solve(arguments(problems), RHO[name][0])
    for i, problem in enumerate(problems):
        pose = matrices(found.model)[i]
        rows = linearized(pose, problem, RHO[name][1])[0].reshape(-1, 6)
        # In units of the standard deviations.
        scale = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))
        np.testing.assert_allclose(
            np.asarray(found.covariance[i]) / np.outer(scale, scale),
            np.linalg.inv(rows.T @ rows) / np.outer(scale, scale),
            atol=1e-6,
        )


@pytest.mark.slow
def test_errors_follow_the_covariance(x64):
    # 1,024 problems with anisotropic noise; NEES is χ² with six degrees of freedom. Band: 99.9 %, seeds fixed.
    nees = []
    for batch in range(64):
        problems = [make_problem(10_000 + batch * B + i) for i in range(B)]
        for problem in problems:
            problem["weights"] = np.ones(N)
        found = solve(arguments(problems), Squared())
        poses, covariances = matrices(found.model), np.asarray(found.covariance)
        for problem, pose, covariance in zip(problems, poses, covariances, strict=True):
            error = tangent(pose, problem["truth"])
            nees.append(error @ np.linalg.solve(covariance, error))
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 6 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high
    assert scipy.stats.kstest(nees, "chi2", args=(6,)).pvalue > 1e-3


# ---- derivatives

DERIVATIVE_INPUTS = {"points": 3e-4, "pixels": 0.03, "focal": 0.1, "sigma": 0.003, "weights": 0.02}
READOUT = np.random.default_rng(5).normal(size=(3, 4))


def functional(inputs, problem, loss):
    """One number that depends on all of a pose."""
    pose = refine({**problem, **inputs}, loss, TIGHT).model.as_matrix()[:3]
    return jnp.sum(pose * jnp.asarray(READOUT))


# Forward mode for one loss and reverse mode for the other; the values serve the differences.
forward = jax.jit(
    lambda inputs, moves, problem: jax.jvp(lambda x: functional(x, problem, Squared()), (inputs,), (moves,))
)
reverse = jax.jit(jax.value_and_grad(lambda inputs, problem: functional(inputs, problem, Cauchy(2.0))))


def directions(problem):
    """A direction of unit steps for each input, symmetric where the input is."""
    rng = np.random.default_rng(9)
    made = {name: rng.normal(size=np.shape(problem[name])) for name in DERIVATIVE_INPUTS}
    made["sigma"] = made["sigma"] + made["sigma"].transpose(0, 2, 1)
    made["weights"] *= np.asarray(problem["weights"]) > 0  # a weight of 0 is a mask
    return made


def differences(value, inputs):
    """Derivatives of `value` along `directions`, by Richardson's extrapolation of re-solved optima."""
    result = {}
    for name, direction in directions(inputs).items():
        h = DERIVATIVE_INPUTS[name]
        at = lambda step: float(value({**inputs, name: inputs[name] + step * direction}))  # noqa: B023, E731
        coarse, fine = (at(h) - at(-h)) / (2 * h), (at(h / 2) - at(-h / 2)) / h
        result[name] = (4 * fine - coarse) / 3
    return result


@pytest.fixture(scope="module")
def single():
    """One noisy problem as (inputs, the rest)."""
    with jax.enable_x64(True):
        problem = {**make_problem(2), "focal": np.array(FOCAL)}
        arrays = {name: jnp.asarray(x) for name, x in problem.items() if name != "truth"}
        return {name: arrays.pop(name) for name in DERIVATIVE_INPUTS}, arrays


def test_the_derivative_is_that_of_the_optimum_forward(single, x64):
    inputs, problem = single
    zeros = jax.tree.map(jnp.zeros_like, inputs)
    expected = differences(lambda inputs: forward(inputs, zeros, problem)[0], inputs)
    for name, direction in directions(inputs).items():
        _, derivative = forward(inputs, {**zeros, name: jnp.asarray(direction)}, problem)
        assert float(derivative) == pytest.approx(expected[name], rel=1e-6), name


@pytest.mark.slow
def test_the_derivative_is_that_of_the_optimum_reverse(single, x64):
    inputs, problem = single
    start = problem["start"]
    _, gradient = reverse({**inputs, "start": start}, problem)
    assert np.all(np.asarray(gradient["start"]) == 0)
    expected = differences(lambda inputs: reverse({**inputs, "start": start}, problem)[0], inputs)
    for name, direction in directions(inputs).items():
        derivative = float(np.sum(np.asarray(gradient[name]) * direction))
        assert derivative == pytest.approx(expected[name], rel=1e-6), name


def test_gauss_newton_would_not_pass_the_test_above(single, x64):
    # dξ = −(JᵀJ)⁻¹ Jᵀ dr is the derivative without the residuals' curvature.
    inputs, _ = single
    problem = make_problem(2)
    pose = matrices(solve(arguments([problem]), Squared()).model)[0]
    at = lambda xi, problem=problem: residuals(moved(pose, xi), problem, RHO["squared"][1]).ravel()  # noqa: E731
    rows = jacobian(at, np.zeros(6), h=1e-5)
    direction = directions(inputs)["pixels"]
    change = at(np.zeros(6), {**problem, "pixels": problem["pixels"] + direction}) - at(np.zeros(6))
    xi = -np.linalg.solve(rows.T @ rows, rows.T @ change)
    by_gauss_newton = np.sum(READOUT * (-hat(xi) @ pose)[:3])
    h = DERIVATIVE_INPUTS["pixels"]
    moved_pixels = [{**problem, "pixels": problem["pixels"] + step * direction} for step in (h, -h)]
    values = np.sum(READOUT * matrices(solve(arguments(moved_pixels), Squared()).model)[:2, :3], axis=(1, 2))
    assert 1e-4 < abs(by_gauss_newton / ((values[0] - values[1]) / (2 * h)) - 1) < 0.3


# ---- single precision, degenerate and special input


@pytest.fixture(scope="module")
def float32_batch():
    """Sixteen problems solved in one call in float32: eight ordinary, then special ones."""
    problems = [make_problem(seed) for seed in range(B)]
    for problem in problems:
        problem["weights"] = np.ones(N)
    line = np.linspace(-2, 2, N)[:, None] * np.array([[1.0, 0.4, 0.7]]) + np.array([[0.3, 0.2, 8.0]])
    depth = np.linspace(4, 12, N)

    def replace(index, points_cam):
        problem = problems[index]
        pose = problem["truth"]
        problem["points"] = (points_cam - pose[:3, 3]) @ pose[:3, :3]
        problem["pixels"] = observe(pose, problem["points"])
        problem["mask"] = np.ones(N, bool)

    replace(8, line)
    replace(9, np.column_stack([0.1 * depth, 0 * depth, depth]))  # a ray: all in one pixel
    problems[10]["mask"] = np.arange(N) < 2
    problems[11]["mask"] = np.zeros(N, bool)
    problems[12]["weights"] = np.zeros(N)
    behind = observe(problems[13]["truth"], problems[13]["points"])
    problems[13]["points"] = 2 * np.linalg.inv(problems[13]["truth"])[:3, 3] - problems[13]["points"]
    problems[13]["pixels"] = behind
    problems[14]["pixels"] = observe(problems[14]["truth"], problems[14]["points"])  # noise-free
    problems[15]["points"] = np.tile(problems[15]["points"][:1], (N, 1))  # one point, many times
    return problems, solve(arguments(problems, np.float32), Squared())


@pytest.mark.slow
def test_nothing_is_ever_not_a_number(float32_batch):
    _, found = float32_batch
    for leaf in jax.tree.leaves((found.model, found.covariance, found.cost)):
        assert np.isfinite(leaf).all()
    # Poses are proper rotations, whatever happened.
    rotation = matrices(found.model)[:, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (B, 1, 1)), atol=1e-6)


def test_float32_converges_to_the_float64_optimum(float32_batch, x64):
    problems, found = float32_batch
    exact = solve(arguments(problems), Squared())
    for i in range(8):
        assert (found.result == Result.success)[i]
        deviations = np.sqrt(np.diag(np.asarray(exact.covariance[i])))
        error = tangent(matrices(exact.model)[i], matrices(found.model)[i])
        assert np.all(np.abs(error) < 0.02 * deviations + 2e-6), error / deviations
        assert found.cost[i] == pytest.approx(float(exact.cost[i]), rel=1e-3)
        np.testing.assert_allclose(
            np.asarray(found.covariance[i]) / np.outer(deviations, deviations),
            np.asarray(exact.covariance[i]) / np.outer(deviations, deviations),
            atol=0.01,
        )


@pytest.mark.parametrize("index", [9, 10, 11, 12, 15], ids=["ray", "two", "masked", "weightless", "one"])
def test_degenerate_input_is_reported(index, float32_batch):
    problems, found = float32_batch
    assert (found.result == Result.degenerate)[index]
    assert np.all(np.asarray(found.covariance[index]) == 0)
    if index in (11, 12):  # nothing to go by: the pose stays
        np.testing.assert_allclose(matrices(found.model)[index], problems[index]["start"], atol=2e-6)
        assert found.cost[index] == 0


def test_points_on_a_line_are_degenerate():
    problems = [make_problem(seed) for seed in range(B)]
    for i, problem in enumerate(problems):
        direction = np.random.default_rng(i).normal(size=3)
        line = np.linspace(-2, 2, N)[:, None] * (direction / np.linalg.norm(direction)) + np.array([[0.3, 0.2, 8.0]])
        pose = problem["truth"]
        problem["points"] = (line - pose[:3, 3]) @ pose[:3, :3]
        problem["pixels"] = observe(pose, problem["points"])
        problem["weights"], problem["mask"] = np.ones(N), np.ones(N, bool)
    found = solve(arguments(problems, np.float32), Squared())
    assert np.all(found.result == Result.degenerate)


def test_two_points_are_still_fitted(float32_batch):
    _, found = float32_batch
    assert found.cost[10] < 1e-2


def test_noise_free_data_give_the_truth(float32_batch, x64):
    problems, found = float32_batch
    assert (found.result == Result.success)[14]
    assert np.abs(tangent(problems[14]["truth"], matrices(found.model)[14])).max() < 1e-5
    exact = solve(arguments([problems[14]]), Squared())
    assert np.all(exact.result == Result.success)
    assert exact.cost[0] < 1e-18
    assert np.abs(tangent(problems[14]["truth"], matrices(exact.model)[0])).max() < 1e-11


def test_a_batch_is_a_loop(float32_batch):
    problems, found = float32_batch
    batch = arguments(problems, np.float32)
    for i in (0, 3, 10, 14):
        # The same program, so that nothing is compiled: problem i in every place.
        alone = solve(jax.tree.map(lambda x: jnp.stack([x[i]] * B), batch), Squared())  # noqa: B023
        assert alone.iterations[5] == found.iterations[i]
        assert alone.cost[5] == pytest.approx(float(found.cost[i]), rel=1e-4, abs=1e-3)
        if i != 10:  # two points leave directions free, along which rounding moves the pose
            np.testing.assert_allclose(matrices(alone.model)[5], matrices(found.model)[i], atol=1e-5)
        codes = (Result.success, Result.not_converged, Result.degenerate)
        assert [(alone.result == code)[5] for code in codes] == [(found.result == code)[i] for code in codes]


@pytest.mark.slow
def test_one_problem_alone_with_a_deviation_for_each_point(float32_batch):
    problems, _ = float32_batch
    problem, rng = dict(problems[0]), np.random.default_rng(0)
    deviations = rng.uniform(0.5, 2.0, size=N).astype(np.float32)
    problem["sigma"] = deviations[:, None, None] ** 2 * np.eye(2)
    expected = solve(arguments([problem], np.float32), Squared())
    camera = Pinhole(fx=FOCAL, fy=FOCAL, cx=CENTER[0], cy=CENTER[1])
    start = SE3.from_matrix(jnp.asarray(problem["start"], jnp.float32))
    refine = jax.jit(lambda p, z, s, m: refine_absolute_pose(start, p, z, camera, sigma_px=s, mask=m))
    inputs = [problem[name].astype(np.float32) for name in ("points", "pixels")]
    alone = refine(*inputs, deviations, problem["mask"])
    # Float32 ends within 2 % of a standard deviation of the optimum, as tested above.
    np.testing.assert_allclose(matrices(alone.model), matrices(expected.model)[0], atol=2e-4)
    assert alone.cost == pytest.approx(float(expected.cost[0]), rel=1e-4)
    np.testing.assert_allclose(alone.covariance, expected.covariance[0], rtol=0.02, atol=1e-9)


def test_masked_and_weightless_rows_do_not_matter(x64):
    problem = make_problem(1)
    off = ~problem["mask"]
    other = {**problem, "pixels": problem["pixels"].copy(), "points": problem["points"].copy()}
    other["pixels"][off] = 1e5
    other["points"][off] = -77.0
    weightless = {**problem, "mask": np.ones(N, bool), "weights": problem["weights"] * problem["mask"]}
    found = solve(arguments([problem, other, weightless]), Squared())
    for leaf in jax.tree.leaves((found.model, found.cost, found.covariance)):
        np.testing.assert_allclose(leaf[1], leaf[0], rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(leaf[2], leaf[0], rtol=1e-12, atol=1e-14)


def test_a_weight_of_two_is_two_observations(x64):
    problem = make_problem(3)
    problem["mask"] = np.ones(N, bool)
    half = N // 2
    twice = {name: value.copy() for name, value in problem.items()}
    for name in ("points", "pixels", "sigma"):
        twice[name][half:] = problem[name][:half]
    twice["weights"] = np.ones(N)
    problem["weights"] = 2.0 * (np.arange(N) < half)
    found = solve(arguments([problem, twice]), Squared())
    np.testing.assert_allclose(found.cost[1], found.cost[0], rtol=1e-10)
    assert np.abs(tangent(*matrices(found.model)[:2])).max() < 1e-8
    np.testing.assert_allclose(found.covariance[1], found.covariance[0], rtol=1e-6, atol=1e-12)


def test_far_from_the_worlds_origin_float32_loses_only_what_it_cannot_store(x64):
    # 10 km out coordinates are multiples of 1 mm, 0.1 px here. The optimum for the rounded data in float64 is the
    # reference; a solve that rotated about the world's origin would be metres off.
    errors = []
    for shift in (np.array([1e4, -4e3, 300.0]), np.array([-6e3, 8e3, 50.0])):
        problems = [make_problem(seed) for seed in range(8)]
        for problem in problems:
            move = np.eye(4)
            move[:3, 3] = -shift
            problem["points"] = (problem["points"] + shift).astype(np.float32).astype(np.float64)
            problem["truth"], problem["start"] = problem["truth"] @ move, problem["start"] @ move
        exact = solve(arguments(problems), Squared())
        with jax.enable_x64(False):
            found = solve(arguments(problems, np.float32), Squared())
        for i in range(8):
            assert (found.result == Result.success)[i]
            deviations = np.sqrt(np.diag(np.asarray(exact.covariance[i])))
            # Camera centres and rotations apart: a float32 pose cannot tell them from each other at 10 km.
            ours, reference = matrices(found.model)[i], matrices(exact.model)[i]
            angle = np.linalg.norm(ours[:3, :3] - reference[:3, :3]) / 2**0.5
            errors.append(angle / np.linalg.norm(deviations[3:]))
            np.testing.assert_allclose(
                np.asarray(found.covariance[i]) / np.outer(deviations, deviations),
                np.asarray(exact.covariance[i]) / np.outer(deviations, deviations),
                atol=0.05,
            )
    assert np.max(errors) < 0.5


def test_wrong_shapes_are_said_in_one_line():
    camera = Pinhole(fx=FOCAL, fy=FOCAL, cx=CENTER[0], cy=CENTER[1])
    points, pixels = np.zeros((6, 3), np.float32), np.zeros((6, 2), np.float32)
    for sigma in (np.ones(5), np.ones((6, 3, 3)), np.ones((6, 2))):
        with pytest.raises(ValueError, match="sigma_px has shape") as caught:
            refine_absolute_pose(SE3.identity(), points, pixels, camera, sigma_px=sigma.astype(np.float32))
        assert "\n" not in str(caught.value)
