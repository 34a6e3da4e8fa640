"""Bundle adjustment against dense least squares of its own residuals, written out in numpy and scipy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from vojax import SE3, Result
from vojax.ba import Cauchy, LMOptions, Squared
from vojax.ba._bundle import adjust_bundle, slot_data, start_state
from vojax.ba._bundle_cholesky import cholesky
from vojax.ba._bundle_covariance import bundle_covariance
from vojax.ba._bundle_pcg import solve_iteratively
from vojax.ba._bundle_problem import bundle_problem
from vojax.ba._bundle_residual import linearize
from vojax.ba._bundle_schur import normal_equations, solve
from vojax.ba._bundle_state import BundlePriors
from vojax.cameras import Pinhole

C, P = 4, 14
FOCAL, CX, CY = 400.0, 320.0, 240.0
TIGHT = LMOptions(max_steps=120, tolerance=1e-22)
adjust = eqx.filter_jit(adjust_bundle)


def hat(xi):
    (a, b, c), matrix = xi[3:], np.zeros((4, 4), np.asarray(xi).dtype)
    matrix[:3, :3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]]
    matrix[:3, 3] = xi[:3]
    return matrix


def tangent(world_from_cam, other):
    """ξ with `world_from_cam @ exp(ξ) == other`."""
    matrix = scipy.linalg.logm(np.linalg.inv(world_from_cam) @ other).real
    return np.array([*matrix[:3, 3], matrix[2, 1], matrix[0, 2], matrix[1, 0]])


class Scene:
    """A small scene with noise of 5 px: residuals are large, and so is the curvature that they bring."""

    def __init__(self, seed=0, sigma=5.0):
        rng = np.random.default_rng(seed)
        xi = np.concatenate([rng.normal(size=(C, 3)) * 0.1, rng.normal(size=(C, 3)) * 0.05], axis=1)
        xi[:, 0] += 0.9 * np.arange(C)
        world_from_cam = np.stack([scipy.linalg.expm(hat(x)) for x in xi])
        self.landmarks = rng.uniform([-2, -2, 4], [4, 2, 9], size=(P, 3))
        self.camera_index, self.landmark_index = (index.ravel() for index in np.indices((C, P)))
        keep = rng.random(C * P) < 0.85
        self.camera_index, self.landmark_index = self.camera_index[keep], self.landmark_index[keep]
        order = rng.permutation(len(self.camera_index))  # observations come in any order
        self.camera_index, self.landmark_index = self.camera_index[order], self.landmark_index[order]
        self.cam_from_world = np.linalg.inv(world_from_cam)
        self.sigma_px = rng.uniform(0.5, 2.0, size=len(order))
        self.pixels = self.project(self.cam_from_world, self.landmarks, FOCAL) + sigma * rng.normal(
            size=(len(order), 2)
        )

    def project(self, cam_from_world, landmarks, focal):
        pose = cam_from_world[self.camera_index]
        points = np.einsum("oij,oj->oi", pose[:, :3, :3], landmarks[self.landmark_index]) + pose[:, :3, 3]
        return focal * points[:, :2] / points[:, 2:] + [CX, CY]

    def residuals(self, y, free, focal_free):
        """Whitened residuals at y = (ξ of the free coordinates of all cameras, focal length, landmark moves)."""
        n = int(free.sum())
        xi = np.zeros((C, 6), y.dtype)
        xi[free] = y[:n]
        poses = np.stack([scipy.linalg.expm(-hat(x)) @ pose for x, pose in zip(xi, self.cam_from_world, strict=True)])
        focal = FOCAL + (y[n] if focal_free else 0.0)
        landmarks = self.landmarks + y[n + focal_free :].reshape(P, 3)
        return ((self.project(poses, landmarks, focal) - self.pixels) / self.sigma_px[:, None]).ravel()

    def problem(self, **options):
        options = {"sigma_px": self.sigma_px, "gauge": "two_cameras"} | options
        return bundle_problem(
            SE3.from_matrix(jnp.asarray(self.cam_from_world)),
            self.landmarks,
            self.pixels,
            self.camera_index,
            self.landmark_index,
            Pinhole(fx=FOCAL, fy=FOCAL, cx=CX, cy=CY),
            **options,
        )


def jacobian(function, y, h=1e-6):
    return np.stack([(function(y + h * e) - function(y - h * e)) / (2 * h) for e in np.eye(len(y))], axis=1)


def complex_jacobian(function, y):
    """Exact to rounding: the function is analytic, and its imaginary part loses no digits."""
    return np.stack([function(y + 1e-30j * e).imag * 1e30 for e in np.eye(len(y))], axis=1)


def free_coordinates(problem):
    return np.asarray(problem.layout.columns)[:, :6] < problem.layout.unknowns


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.fixture(scope="module")
def shared(scene):
    """The scene with a common free focal length, adjusted."""
    with jax.enable_x64(True):
        problem = scene.problem(free_intrinsics=[("fx", "fy")])
        return problem, adjust(problem, options=TIGHT)


def test_a_reduced_step_is_the_dense_step(scene, x64):
    problem = scene.problem(free_intrinsics=[("fx", "fy")])
    free = free_coordinates(problem)
    assert problem.layout.unknowns == 6 * C - 7 + 1
    y = np.zeros(free.sum() + 1 + 3 * P)
    function = lambda y: scene.residuals(y, free, True)  # noqa: E731
    rows = complex_jacobian(function, y)
    data = slot_data(problem)
    state = start_state(problem)
    system = normal_equations(linearize(state, data, Squared(), problem.layout), data, problem.layout)
    for damping in (0.0, 1e-3, 1.0):
        unknowns, moves = solve(system.damped(jnp.asarray(damping)), problem.layout)
        hessian = rows.T @ rows
        step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), -rows.T @ function(y))
        n = len(unknowns)
        np.testing.assert_allclose(unknowns, step[:n], rtol=0, atol=1e-9 * np.abs(step[:n]).max())
        ours = np.zeros((P, 3))
        ours[np.asarray(problem.layout.landmark_order)] = moves.T
        np.testing.assert_allclose(ours.ravel(), step[n:], rtol=0, atol=1e-9 * np.abs(step[n:]).max())


def test_conjugate_gradients_give_the_same_step_and_the_same_derivative(scene, x64):
    problem = scene.problem(free_intrinsics=[("fx", "fy")])
    layout, data = problem.layout, slot_data(problem)
    system = normal_equations(linearize(start_state(problem), data, Squared(), layout), data, layout)
    system = system.damped(jnp.asarray(1e-3))
    iterate = lambda system, layout: solve_iteratively(system, layout, 1e-13, 1000)  # noqa: E731
    for ours, expected in zip(jax.jit(iterate)(system, layout), jax.jit(solve)(system, layout), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    rng = np.random.default_rng(0)
    weights = jnp.asarray(rng.normal(size=layout.unknowns)), jnp.asarray(rng.normal(size=(3, P)))

    def outcome(gradients, method):
        changed = eqx.tree_at(lambda s: (s.camera_gradient, s.landmark_gradient), system, gradients)
        return sum(jnp.sum(a * b) for a, b in zip(method(changed, layout), weights, strict=True))

    at = (system.camera_gradient, system.landmark_gradient)
    gradient = jax.jit(jax.grad(outcome), static_argnums=1)
    for ours, expected in zip(gradient(at, iterate), gradient(at, solve), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_the_optimum_is_that_of_dense_least_squares(scene, shared, x64):
    problem, found = shared
    free = free_coordinates(problem)
    function = lambda y: scene.residuals(y, free, True)  # noqa: E731
    start = function(np.zeros(free.sum() + 1 + 3 * P))
    best = scipy.optimize.least_squares(
        function, np.zeros(free.sum() + 1 + 3 * P), method="lm", x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15
    )
    assert found.result == Result.success
    assert found.initial_cost == pytest.approx(0.5 * start @ start, rel=1e-12)
    assert found.cost == pytest.approx(best.cost, rel=1e-9)
    assert found.camera.fx == pytest.approx(FOCAL + best.x[free.sum()], rel=1e-5)
    assert found.camera.fx == pytest.approx(float(found.camera.fy), rel=1e-14)


def test_the_trace_tells_the_cost_of_every_iteration(shared, x64):
    _, found = shared
    n = int(found.iterations)
    trace = found.trace
    assert trace.cost[0] == pytest.approx(float(found.initial_cost))
    costs = np.asarray(trace.cost)[:n][np.asarray(trace.accepted)[:n]]
    assert np.all(np.diff(costs) <= 1e-9 * costs[0])
    assert costs[-1] == pytest.approx(float(found.cost))
    assert trace.gradient_norm[n - 1] < 1e-5 * trace.gradient_norm[0]
    assert np.all(np.asarray(trace.cost)[n:] == 0)
    assert np.all(np.asarray(trace.damping)[:n] > 0)


def test_covariances_are_blocks_of_the_dense_inverse(scene, shared, x64):
    problem, found = shared
    covariance = bundle_covariance(problem, found.cam_from_world, found.landmarks, found.camera)
    assert covariance.regular
    free = free_coordinates(problem)
    at = Scene()
    at.cam_from_world, at.landmarks = np.asarray(found.cam_from_world.as_matrix()), np.asarray(found.landmarks)
    y = np.zeros(free.sum() + 1 + 3 * P)
    y[free.sum()] = found.camera.fx - FOCAL
    rows = complex_jacobian(lambda y: at.residuals(y, free, True), y)
    dense = np.linalg.inv(rows.T @ rows)
    pose = dense[: -3 * P, : -3 * P][:-1, :-1]
    full = np.zeros((6 * C, 6 * C))
    full[np.ix_(free.ravel(), free.ravel())] = pose

    def close(ours, expected):
        scale = np.sqrt(np.abs(np.outer(np.diag(expected), np.diag(expected)))) + 1e-300
        np.testing.assert_allclose(ours / scale, expected / scale, atol=2e-5)

    close(covariance.cameras(1)[:6, :6], full[6:12, 6:12])
    np.testing.assert_allclose(covariance.cameras(1, 2)[:6, :6], full[6:12, 12:18], atol=1e-5 * np.abs(full).max())
    assert np.all(np.asarray(covariance.cameras(0)[:6, :6]) == 0)
    close(covariance.intrinsics(), dense[-3 * P - 1 : -3 * P, -3 * P - 1 : -3 * P])
    for j in (0, 5):
        start = len(dense) - 3 * P + 3 * j
        close(covariance.landmark(j), dense[start : start + 3, start : start + 3])

    # A relative pose: the chain rule by differences of the group operations.
    poses = at.cam_from_world

    def relative(xi):
        moved = [scipy.linalg.expm(-hat(x)) @ pose for x, pose in zip(xi.reshape(2, 6), poses[[1, 2]], strict=True)]
        return tangent(poses[1] @ np.linalg.inv(poses[2]), moved[0] @ np.linalg.inv(moved[1]))

    chain = jacobian(relative, np.zeros(12))
    close(covariance.relative_pose(1, 2), chain @ full[6:18, 6:18] @ chain.T)


def test_a_free_gauge_has_no_covariance(scene, shared, x64):
    problem = scene.problem(gauge="free")
    assert problem.gauge_free
    covariance = bundle_covariance(problem, problem.cam_from_world, problem.landmarks, problem.camera)
    assert not covariance.regular
    assert np.all(np.asarray(covariance.inverse) == 0)


# ---- gradients


def gradient_problem(scene):
    roots = np.tile(2.0 * np.eye(6), (C, 1, 1))
    roots[2:] = 0.0
    landmark_roots = np.zeros((P, 3, 3))
    landmark_roots[3] = np.diag([2.0, 1.0, 0.5])
    rng = np.random.default_rng(5)
    priors = BundlePriors(
        cam_from_world=SE3.from_matrix(jnp.asarray(scene.cam_from_world))
        @ SE3.exp(0.02 * jnp.asarray(rng.normal(size=(C, 6)))),
        cam_root=jnp.asarray(roots),
        landmarks=jnp.asarray(scene.landmarks + 0.1),
        landmark_root=jnp.asarray(landmark_roots),
        intrinsics=jnp.array([[FOCAL + 10.0]]),
        intrinsics_root=jnp.array([[0.05]]),
    )
    return scene.problem(gauge="free", free_intrinsics=[("fx", "fy")], priors=priors)


@pytest.mark.slow
@pytest.mark.parametrize("loss", [Squared(), Cauchy(4.0)], ids=["squared", "cauchy"])
def test_gradients_are_those_of_problems_solved_anew(loss, scene, x64):
    problem = gradient_problem(scene)
    assert not problem.gauge_free
    loss = jax.tree.map(jnp.asarray, loss)
    rng = np.random.default_rng(1)
    by_pose, by_point = jnp.asarray(rng.normal(size=(C, 7))), jnp.asarray(rng.normal(size=(P, 3)))
    options = LMOptions(max_steps=250, tolerance=1e-30)

    def outcome(problem, loss):
        found = adjust_bundle(problem, loss=loss, options=options)
        return (
            jnp.sum(found.cam_from_world.wxyz_xyz * by_pose)
            + jnp.sum(found.landmarks * by_point)
            + 0.01 * found.camera.fx
        )

    value = eqx.filter_jit(outcome)
    known, fixed = eqx.partition((problem, loss), eqx.is_inexact_array)
    gradient = jax.jit(jax.grad(lambda known: outcome(*eqx.combine(known, fixed))))(known)

    def check(where, index, h):
        base = where((problem, loss))
        change = lambda h: eqx.tree_at(where, (problem, loss), base.at[index].add(h))  # noqa: E731
        numeric = [(value(*change(s * h)) - value(*change(-s * h))) / (2 * s * h) for s in (1, 2)]
        expected = float((4 * numeric[0] - numeric[1]) / 3)
        assert float(where(gradient)[index]) == pytest.approx(expected, rel=1e-6, abs=1e-9), (index, expected)

    check(lambda both: both[0].measurements, (3, 1), 2e-2)
    check(lambda both: both[0].sigma_px, (5,), 2e-3)
    check(lambda both: both[0].weights, (2,), 2e-3)
    check(lambda both: both[0].camera.cx, (), 2e-2)
    check(lambda both: both[0].camera.skew, (), 2e-2)
    check(lambda both: both[0].priors.landmarks, (3, 1), 2e-3)
    check(lambda both: both[0].priors.landmark_root, (3, 0, 0), 2e-3)
    check(lambda both: both[0].priors.cam_from_world.wxyz_xyz, (1, 5), 1e-3)
    check(lambda both: both[0].priors.cam_root, (1, 4, 4), 2e-3)
    check(lambda both: both[0].priors.intrinsics, (0, 0), 2e-2)
    check(lambda both: both[0].priors.intrinsics_root, (0, 0), 2e-4)
    # Where a solve starts does not matter.
    for leaf in (gradient[0].landmarks, gradient[0].cam_from_world.wxyz_xyz):
        assert np.abs(leaf).max() < 1e-9
    # Of tied parameters only the difference is given.
    assert abs(float(gradient[0].camera.fx + gradient[0].camera.fy)) < 1e-9
    if isinstance(loss, Cauchy):
        check(lambda both: both[1].scale, (), 2e-3)


# ---- variants


def test_a_residual_of_the_user_takes_the_place_of_the_camera(scene, shared, x64):
    def residual(cam_from_world, landmark, camera, measurement):
        return camera.project(cam_from_world.apply(landmark)) - measurement

    problem = scene.problem(free_intrinsics=[("fx", "fy")], residual=residual)
    data = slot_data(problem)
    other, _ = shared
    ours = linearize(start_state(problem), data, Squared(), problem.layout)
    expected = linearize(start_state(other), slot_data(other), Squared(), other.layout)
    np.testing.assert_allclose(ours.residual, expected.residual, atol=1e-9)
    np.testing.assert_allclose(ours.by_camera, expected.by_camera, atol=1e-8)
    np.testing.assert_allclose(ours.by_landmark, expected.by_landmark, atol=1e-8)


def test_what_is_fixed_does_not_move_and_float32_agrees(scene, shared):
    still = np.arange(P) == 4
    problem = scene.problem(free_intrinsics=[("fx", "fy")], fixed_landmarks=still)
    assert problem.landmarks.dtype == jnp.float32
    found = adjust(problem)
    assert found.result == Result.success
    assert np.array_equal(found.landmarks[4], problem.landmarks[4])
    np.testing.assert_allclose(found.cam_from_world.wxyz_xyz[0], problem.cam_from_world.wxyz_xyz[0], atol=1e-6)
    _, double = shared
    assert np.all(np.isfinite(np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(found.trace)])))
    # One landmark is held, so the cost is no less than without.
    assert float(double.cost) * (1 - 1e-3) < float(found.cost) < 1.3 * float(double.cost)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 47, 200])
def test_cholesky_by_panels(size, x64):
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, size))
    matrix = root @ root.T + np.eye(size)
    factor = cholesky(jnp.asarray(matrix))
    rhs = rng.normal(size=(size, 2))
    assert factor.regular
    np.testing.assert_allclose(matrix @ factor.solve(jnp.asarray(rhs)), rhs, atol=1e-9)
    np.testing.assert_allclose(
        factor.half_solve(jnp.asarray(rhs)),
        scipy.linalg.solve_triangular(np.linalg.cholesky(matrix), rhs, lower=True),
        atol=1e-9,
    )
    assert not cholesky(jnp.asarray(matrix - 1e3 * np.eye(size))).regular
    assert not cholesky(jnp.full((size, size), jnp.nan)).regular


# ---- what is wrong


def changed(array, index, value):
    array = np.array(array, float if isinstance(value, float) else None)
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: {"camera_index": changed(s.camera_index, 3, C)}, r"camera_index\[3\] is 4: expected 0 to 3"),
        (lambda s: {"landmark_index": changed(s.landmark_index, 2, -1)}, r"landmark_index\[2\] is -1"),
        (lambda s: {"pixels": changed(s.pixels, 7, np.nan)}, r"measurements\[7\] is not finite"),
        (lambda s: {"landmarks": changed(s.landmarks, 1, np.inf)}, r"landmarks\[1\] is not finite"),
        (lambda s: {"sigma_px": changed(s.sigma_px, 0, 0.0)}, "sigma_px has 1 entries that are not positive"),
    ],
)  # fmt: skip
def test_bad_arrays_are_refused(change, message, x64):
    scene = Scene()
    vars(scene).update(change(scene))
    with pytest.raises(ValueError, match=message):
        scene.problem()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weights": np.full(40, -1.0)}, r"weights\[0\] is negative"),
        ({"free_intrinsics": ["k1"]}, "no parameter 'k1'"),
        ({"fixed_cameras": np.zeros(2, bool)}, "fixed_cameras has shape"),
        ({"camera_group": np.arange(C), "free_intrinsics": ["fx"]}, "give it as an array"),
    ],
)
def test_bad_options_are_refused(options, message, scene, x64):
    with pytest.raises(ValueError, match=message):
        scene.problem(**options)


def test_masked_observations_may_hold_anything(scene, shared, x64):
    mask = np.arange(len(scene.pixels)) != 6
    other = Scene()
    other.pixels = changed(scene.pixels, 6, np.nan)
    problem = other.problem(mask=mask)
    assert np.all(np.isfinite(np.asarray(problem.measurements)))
    state = start_state(problem)
    blocks = linearize(state, slot_data(problem), Squared(), problem.layout)
    residual = scene.residuals(np.zeros(6 * C + 3 * P), np.ones((C, 6), bool), False).reshape(-1, 2)
    assert jnp.sum(blocks.residual**2) == pytest.approx(np.sum(residual[mask] ** 2), rel=1e-12)
