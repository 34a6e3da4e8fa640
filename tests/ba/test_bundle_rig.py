"""Rigs, stereo pairs and covariances of observations in bundle adjustment, against finite differences and truth."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3, Result
from vojax.ba import LMOptions, PoseFactors, Squared, adjust_bundle, bundle_covariance, bundle_problem
from vojax.ba._bundle import slot_data, start_state
from vojax.ba._bundle_pcg import solve_iteratively
from vojax.ba._bundle_residual import linearize, residual
from vojax.ba._bundle_schur import normal_equations, solve
from vojax.ba._bundle_state import retract
from vojax.cameras import BrownConrady, Pinhole, RectifiedStereo

C, R, P = 4, 3, 16
ENDS = np.arange(C) % (C - 1) == 0
adjust = eqx.filter_jit(adjust_bundle)
TIGHT = LMOptions(max_steps=60, tolerance=1e-16)


class RigScene:
    """A rig of three cameras that look apart, driven past landmarks all around it."""

    def __init__(self, sigma=0.5, seed=0):
        rng = np.random.default_rng(seed)
        with jax.enable_x64(True):
            xi = 0.05 * rng.normal(size=(C, 6))
            xi[:, 0] += 0.6 * np.arange(C)
            self.rig_from_world = SE3.exp(jnp.asarray(xi)).inverse()
            turn = 0.1 * rng.normal(size=(R, 6))
            turn[:, 4] += np.array([-0.4, 0.0, 0.4])
            turn[:, 0] += 0.3 * np.arange(R)
            self.cam_from_rig = SE3.exp(jnp.asarray(turn))
            self.landmarks = rng.uniform([-3, -2, 4], [5, 2, 9], size=(P, 3))
            frame, mount, seen = (index.ravel() for index in np.indices((C, R, P)))
            points = SE3(self.cam_from_rig.wxyz_xyz[mount]) @ SE3(self.rig_from_world.wxyz_xyz[frame])
            local = np.asarray(points.apply(jnp.asarray(self.landmarks[seen])))
            keep = (local[:, 2] > 1.0) & (np.abs(local[:, 0] / local[:, 2]) < 1.0) & (rng.random(len(local)) < 0.9)
            self.frame, self.mount, self.seen = frame[keep], mount[keep], seen[keep]
            self.local = local[keep]
            self.focal = np.array([400.0, 450.0, 500.0])
            truth = self.camera(self.focal[self.mount]).project(jnp.asarray(self.local))
            self.pixels = np.asarray(truth) + sigma * rng.normal(size=(len(self.local), 2))

    @staticmethod
    def camera(focal):
        return Pinhole(fx=jnp.asarray(focal), fy=jnp.asarray(focal), cx=320.0, cy=240.0)

    def problem(self, **options):
        options = {
            "rig_index": self.mount,
            "cam_from_rig": self.cam_from_rig,
            "fixed_cameras": ENDS,  # without a known baseline in the rig, scale is free
            "fixed_extrinsics": np.arange(R) == 1,
        } | options
        camera = options.pop("camera", self.camera(self.focal))
        return bundle_problem(
            options.pop("cam_from_world", self.rig_from_world),
            options.pop("landmarks", self.landmarks),
            options.pop("measurements", self.pixels),
            self.frame,
            self.seen,
            camera,
            **options,
        )


def check_blocks(problem, seed=0):
    """The normal equations are JᵀJ of differences of the residual along the retraction; both solvers agree on them."""
    layout, data, state = problem.layout, slot_data(problem), start_state(problem)
    u, count = layout.unknowns, layout.landmark_order.shape[0]
    free = np.repeat(np.asarray(layout.landmark_free) > 0, 3)

    @jax.jit
    def at(y):
        moved = retract(state, y[:u], y[u:].reshape(count, 3).T, data, layout)
        parts = residual(moved, data, Squared(), layout)
        return jnp.concatenate([part.ravel() for part in parts])

    y = jnp.zeros(u + 3 * count)
    jacobian = np.array(jax.jit(jax.jacfwd(at))(y))
    jacobian[:, u:] *= free
    value = np.asarray(at(y))
    system = jax.jit(
        lambda state: normal_equations(linearize(state, data, Squared(), layout), data, layout).damped(jnp.asarray(0.1))
    )(state)
    hessian = jacobian.T @ jacobian
    # A factor's damping leaves out what two of its poses share.
    expected = np.linalg.solve(
        hessian + 0.1 * np.diag(np.diag(hessian)) + np.diag(1.0 * (np.diag(hessian) == 0)), -jacobian.T @ value
    )
    for unknowns, moves in (
        jax.jit(solve)(system, layout),
        jax.jit(lambda system: solve_iteratively(system, layout, 1e-14, 500))(system),
    ):
        step = np.concatenate([unknowns, moves.T.ravel()])
        np.testing.assert_allclose(step, expected, rtol=0, atol=1e-7 * np.abs(expected).max())


def spread(poses, scale, seed):
    xi = scale * np.random.default_rng(seed).normal(size=(*poses.wxyz_xyz.shape[:-1], 6))
    return SE3.exp(jnp.asarray(xi)) @ poses


@pytest.fixture(scope="module")
def scene():
    return RigScene()


def test_a_rig_step_is_the_dense_step(scene, x64):
    motion = PoseFactors(
        lambda poses, data: (SE3(poses.wxyz_xyz[1]) @ SE3(poses.wxyz_xyz[0]).inverse()).log() / data,
        jnp.array([[0, 1], [1, 2], [2, 3]]),
        jnp.array([0.1, 0.2, 0.3]),
    )
    check_blocks(scene.problem(free_intrinsics=[("fx", "fy")], factors=[motion]))


@pytest.mark.slow
def test_a_rig_is_calibrated_while_it_moves(scene, x64):
    start = spread(scene.cam_from_rig, 0.01, 1)
    start = SE3(jnp.where((jnp.arange(R) == 1)[:, None], scene.cam_from_rig.wxyz_xyz, start.wxyz_xyz))
    moved = spread(scene.rig_from_world, 0.02, 2)
    moved = SE3(jnp.where(jnp.asarray(ENDS)[:, None], scene.rig_from_world.wxyz_xyz, moved.wxyz_xyz))
    problem = scene.problem(cam_from_world=moved, cam_from_rig=start, landmarks=scene.landmarks + 0.05, sigma_px=0.5)
    assert not problem.gauge_free
    found = adjust(problem, options=TIGHT)
    assert found.result == Result.success
    # Residuals are noise: half the degrees of freedom.
    freedom = 2 * len(scene.pixels) - problem.layout.unknowns - 3 * P
    assert 0.7 < float(found.cost) / (0.5 * freedom) < 1.3
    covariance = bundle_covariance(
        problem, found.cam_from_world, found.landmarks, found.camera, cam_from_rig=found.cam_from_rig
    )
    assert covariance.regular
    np.testing.assert_allclose(found.cam_from_rig.wxyz_xyz[1], scene.cam_from_rig.wxyz_xyz[1], atol=1e-14)
    assert np.all(np.asarray(covariance.extrinsics(1)) == 0)
    nees = []
    for i in range(R):
        if i != 1:
            xi = (SE3(found.cam_from_rig.wxyz_xyz[i]) @ SE3(scene.cam_from_rig.wxyz_xyz[i]).inverse()).log()
            nees.append(float(xi @ jnp.linalg.solve(covariance.extrinsics(i), xi)))
    xi = (SE3(found.cam_from_world.wxyz_xyz[1]) @ SE3(scene.rig_from_world.wxyz_xyz[1]).inverse()).log()
    nees.append(float(xi @ jnp.linalg.solve(covariance.cameras(1), xi)))
    assert max(nees) < 22.5  # 99.9 % of χ² with six degrees of freedom


@pytest.mark.slow
def test_a_rig_of_one_camera_is_that_camera(scene, x64):
    only = scene.mount == 1
    problem = scene.problem(mask=only, camera=scene.camera(450.0))
    found = adjust(problem, options=TIGHT)
    mount = SE3(jnp.tile(scene.cam_from_rig.wxyz_xyz[1], (C, 1)))
    alone = bundle_problem(
        mount @ scene.rig_from_world, scene.landmarks, scene.pixels[only],
        scene.frame[only], scene.seen[only], scene.camera(450.0), fixed_cameras=ENDS,
    )  # fmt: skip
    expected = adjust(alone, options=TIGHT)
    assert float(found.cost) == pytest.approx(float(expected.cost), rel=1e-9)
    assert float(found.initial_cost) == pytest.approx(float(expected.initial_cost), rel=1e-12)


@pytest.mark.slow
def test_the_gradient_through_a_rig(scene, x64):
    weight = jnp.asarray(np.random.default_rng(3).normal(size=(R, 7)))
    noise = 2.0 * np.random.default_rng(4).normal(size=scene.pixels.shape)
    problem = scene.problem(measurements=scene.pixels + noise)
    options = LMOptions(max_steps=150, tolerance=1e-30)

    def outcome(measurements):
        changed = eqx.tree_at(lambda problem: problem.measurements, problem, measurements)
        return jnp.sum(adjust_bundle(changed, options=options).cam_from_rig.wxyz_xyz * weight)

    value, gradient = jax.jit(jax.value_and_grad(outcome))(problem.measurements)
    rng = np.random.default_rng(5)
    direction = rng.normal(size=scene.pixels.shape)
    only = jax.jit(outcome)
    numeric = [
        float(only(problem.measurements + s * direction) - only(problem.measurements - s * direction)) / (2 * s)
        for s in (1e-3, 2e-3)
    ]
    assert np.isfinite(value)
    assert float(jnp.sum(gradient * direction)) == pytest.approx((4 * numeric[0] - numeric[1]) / 3, rel=1e-6)


def test_rigs_that_do_not_fit_are_refused(scene, x64):
    with pytest.raises(ValueError, match=r"rig_index\[0\] is 7: expected 0 to 2"):
        scene.problem(rig_index=np.full(len(scene.mount), 7))
    with pytest.raises(ValueError, match="one of them is missing"):
        scene.problem(rig_index=None)
    with pytest.raises(ValueError, match="fixed_extrinsics has shape"):
        scene.problem(fixed_extrinsics=np.zeros(5, bool))
    assert scene.problem(fixed_extrinsics=np.zeros(R, bool)).gauge_free
    lost = scene.problem(mask=scene.mount != 2)
    assert list(lost.unconstrained_extrinsics) == [False, False, True]


# ---- other measurements


@pytest.fixture(scope="module")
def stereo():
    """Truth, noisy (u_left, v, u_right) and their covariances."""
    rng = np.random.default_rng(6)
    with jax.enable_x64(True):
        xi = 0.03 * rng.normal(size=(C, 6))
        xi[:, 2] += 0.5 * np.arange(C)
        cam_from_world = SE3.exp(jnp.asarray(xi)).inverse()
        landmarks = rng.uniform([-3, -2, 5], [3, 2, 12], size=(P, 3))
        frame, seen = (index.ravel() for index in np.indices((C, P)))
        camera = RectifiedStereo(Pinhole(fx=500.0, fy=500.0, cx=320.0, cy=240.0), baseline=0.4)
        exact = camera.project(SE3(cam_from_world.wxyz_xyz[frame]).apply(jnp.asarray(landmarks[seen])))
        root = 0.3 * (np.eye(3) + 0.4 * rng.normal(size=(len(frame), 3, 3)))
        noise = np.einsum("oij,oj->oi", root, rng.normal(size=(len(frame), 3)))
        return cam_from_world, landmarks, np.asarray(exact) + noise, frame, seen, camera, root @ root.swapaxes(1, 2)


@pytest.mark.slow
@pytest.mark.parametrize("homogeneous", [False, True])
def test_a_stereo_step_is_the_dense_step(homogeneous, stereo, x64):
    cam_from_world, landmarks, pixels, frame, seen, camera, sigma = stereo
    if homogeneous:
        landmarks = np.concatenate([landmarks, np.ones((P, 1))], axis=1) * np.linspace(0.3, 2.0, P)[:, None]
    check_blocks(
        bundle_problem(cam_from_world, landmarks, pixels, frame, seen, camera, sigma_px=sigma, gauge="first_camera")
    )


def test_stereo_with_covariances_ends_at_its_degrees_of_freedom(stereo, x64):
    cam_from_world, landmarks, pixels, frame, seen, camera, sigma = stereo
    problem = bundle_problem(
        cam_from_world, landmarks + 0.05, pixels, frame, seen, camera, sigma_px=sigma, gauge="first_camera"
    )
    found = adjust(problem, options=TIGHT)
    assert found.result == Result.success
    freedom = 3 * len(frame) - 6 * (C - 1) - 3 * P
    assert abs(2 * float(found.cost) - freedom) < 4 * np.sqrt(2 * freedom)
    # With covariances of the wrong scale it does not.
    other = eqx.tree_at(lambda problem: problem.sigma_px, problem, 4.0 * problem.sigma_px)
    assert float(adjust(other, options=TIGHT).cost) == pytest.approx(0.25 * float(found.cost), rel=1e-6)


@pytest.mark.slow
def test_a_lens_with_distortion_and_a_covariance_of_its_residual(stereo, x64):
    cam_from_world, landmarks, _, frame, seen, _, _ = stereo
    camera = BrownConrady(fx=500.0, fy=510.0, cx=320.0, cy=240.0, k1=-0.2, k2=0.05, p1=1e-3, p2=-1e-3)
    exact = camera.project(SE3(cam_from_world.wxyz_xyz[frame]).apply(jnp.asarray(landmarks[seen])))
    exact = np.asarray(exact) + 0.2 * np.random.default_rng(7).normal(size=exact.shape)

    def residual(cam_from_world, landmark, camera, measurement):
        # Three numbers of a measurement of four: the fourth is an offset.
        error = camera.project(cam_from_world.apply(landmark)) - measurement[:2] - measurement[2]
        return jnp.concatenate([error, 0.1 * (error[:1] - measurement[3:])])

    measured = np.concatenate([exact, np.zeros((len(frame), 2))], axis=1)
    sigma = np.tile(np.diag([0.04, 0.04, 1.0]), (len(frame), 1, 1))
    problem = bundle_problem(
        cam_from_world, landmarks, measured, frame, seen, camera, sigma_px=sigma, gauge="two_cameras",
        residual=residual, free_intrinsics=[("fx", "fy"), "k1"],
    )  # fmt: skip
    check_blocks(problem)
    with pytest.raises(ValueError, match="sigma_px has shape"):
        bundle_problem(
            cam_from_world, landmarks, measured, frame, seen, camera, sigma_px=np.ones((len(frame), 4, 4)),
            residual=residual,
        )  # fmt: skip
