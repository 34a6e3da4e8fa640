"""Landmarks as directions and inverse depths, and structures and motions that obey constraints."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3, SO3, Result
from vojax.ba import (
    LINE_FIXED,
    ON_LINE,
    ON_PLANE,
    PLANE_FIXED,
    BundlePriors,
    LMOptions,
    adjust_bundle,
    bundle_covariance,
    bundle_problem,
    circular_motion,
    line_frame,
    parallel_axes,
    perpendicular_axes,
    plane_frame,
    structure_residual,
    trifocal_scale,
    turntable,
)
from vojax.cameras import Pinhole

CAMERA = Pinhole(fx=400.0, fy=400.0, cx=320.0, cy=240.0)
# Poses that hold place and scale exactly: "two_cameras" does so within each step only.
ENDS = np.arange(4) % 3 == 0
TIGHT = LMOptions(max_steps=100, tolerance=1e-18)
adjust = eqx.filter_jit(adjust_bundle)


def look(poses, points, frame, seen):
    """Pixels of homogeneous points."""
    matrices = np.asarray(poses.as_matrix())[frame, :3]
    x = np.einsum("oij,oj->oi", matrices, points[seen])
    return 400.0 * x[:, :2] / x[:, 2:] + [320.0, 240.0]


def homogeneous(points):
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def drive(count, rng, step=0.5):
    xi = 0.03 * rng.normal(size=(count, 6))
    xi[:, 0] += step * np.arange(count)
    return SE3.exp(jnp.asarray(xi)).inverse()


def spread(poses, scale, rng):
    return SE3.exp(jnp.asarray(scale * rng.normal(size=(len(poses.wxyz_xyz), 6)))) @ poses


# ---- landmarks


@pytest.fixture(scope="module")
def far():
    """Four cameras; half of the landmarks near, a quarter a thousand baselines away, a quarter at infinity."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        poses = drive(4, rng)
        points = homogeneous(rng.uniform([-2, -2, 4], [3, 2, 9], size=(16, 3)))
        points[8:12] *= [250.0, 250.0, 250.0, 1.0]
        points[12:] *= [1.0, 1.0, 1.0, 0.0]
        frame, seen = (index.ravel() for index in np.indices((4, 16)))
        pixels = look(poses, points, frame, seen) + 0.3 * rng.normal(size=(64, 2))
        return poses, points, pixels, frame, seen


@pytest.fixture(scope="module")
def on_the_sphere(far):
    poses, points, pixels, frame, seen = far
    with jax.enable_x64(True):
        problem = bundle_problem(poses, points, pixels, frame, seen, CAMERA, sigma_px=0.3, fixed_cameras=ENDS)
        return problem, adjust(problem, options=TIGHT)


def test_landmarks_at_infinity_are_ordinary(on_the_sphere, x64):
    problem, found = on_the_sphere
    assert found.result == Result.success
    assert not np.any(found.unconstrained_landmarks)
    np.testing.assert_allclose(np.linalg.norm(found.landmarks, axis=1), 1.0, atol=1e-12)
    freedom = 2 * 64 - 12 - 3 * 16
    assert abs(2 * float(found.cost) - freedom) < 4 * np.sqrt(2 * freedom)
    covariance = bundle_covariance(problem, found.cam_from_world, found.landmarks, found.camera)
    assert covariance.regular
    for j in (0, 9, 14):
        matrix = np.asarray(covariance.landmark(j))
        assert matrix.shape == (4, 4)
        np.testing.assert_allclose(matrix @ found.landmarks[j], 0.0, atol=1e-12)
        assert np.linalg.matrix_rank(matrix, tol=1e-14) == 3


@pytest.mark.slow
def test_near_landmarks_are_where_euclidean_ones_are(far, x64):
    poses, points, pixels, frame, seen = far
    near = seen < 8
    arguments = (poses, pixels[near], frame[near], seen[near])

    def solve(landmarks, **options):
        poses, pixels, frame, seen = arguments
        problem = bundle_problem(poses, landmarks, pixels, frame, seen, CAMERA, fixed_cameras=ENDS, **options)
        found = adjust(problem, options=TIGHT)
        return problem, found, bundle_covariance(problem, found.cam_from_world, found.landmarks, found.camera)

    euclidean = points[:8, :3] / points[:8, 3:]
    _, expected, reference = solve(euclidean)
    for landmarks, options in (
        (points[:8], {}),
        (euclidean, {"anchor_index": np.arange(8) % 3}),
    ):
        _, found, covariance = solve(landmarks, **options)
        assert float(found.cost) == pytest.approx(float(expected.cost), rel=1e-9)
        h = np.asarray(found.landmarks)
        np.testing.assert_allclose(h[:, :3] / h[:, 3:], expected.landmarks, atol=1e-6)
        # d(x/w) = (dx − x/w dw) / w
        to_point = np.concatenate([np.eye(3), -(h[2, :3] / h[2, 3])[:, None]], axis=1) / h[2, 3]
        mapped = to_point @ np.asarray(covariance.landmark(2)) @ to_point.T
        np.testing.assert_allclose(mapped, reference.landmark(2), atol=1e-5 * np.abs(mapped).max())
        np.testing.assert_allclose(
            covariance.cameras(1), reference.cameras(1), atol=1e-5 * np.abs(reference.cameras(1)).max()
        )


@pytest.mark.slow
def test_anchored_landmarks_keep_depth_one_in_their_anchors(far, x64):
    poses, points, pixels, frame, seen = far
    anchors = np.arange(16) % 4
    problem = bundle_problem(
        poses, points, pixels, frame, seen, CAMERA, sigma_px=0.3, fixed_cameras=ENDS, anchor_index=anchors
    )
    found = adjust(problem, options=TIGHT)
    assert found.result == Result.success
    rows = np.asarray(poses.as_matrix())[anchors, 2]
    np.testing.assert_allclose(np.sum(rows * found.landmarks, axis=1), 1.0, atol=1e-9)
    bad = points.copy()
    bad[3, :3] = np.asarray(poses.inverse().translation())[3]
    with pytest.raises(ValueError, match=r"landmarks\[3\] has depth zero in its anchor"):
        bundle_problem(poses, bad, pixels, frame, seen, CAMERA, anchor_index=anchors)
    with pytest.raises(ValueError, match="priors on landmarks are about Euclidean"):
        bundle_problem(
            poses, points, pixels, frame, seen, CAMERA,
            priors=BundlePriors(landmarks=jnp.zeros((16, 3)), landmark_root=jnp.zeros((16, 3, 3))),
        )  # fmt: skip


@pytest.mark.slow
def test_the_gradient_through_homogeneous_landmarks(far, x64):
    poses, points, pixels, frame, seen = far
    problem = bundle_problem(poses, points, pixels + 0.0, frame, seen, CAMERA, fixed_cameras=ENDS)
    options = LMOptions(max_steps=150, tolerance=1e-30)
    rng = np.random.default_rng(1)
    weight, direction = jnp.asarray(rng.normal(size=(4, 7))), rng.normal(size=pixels.shape)

    @jax.jit
    def outcome(measurements):
        changed = eqx.tree_at(lambda problem: problem.measurements, problem, measurements)
        return jnp.sum(adjust_bundle(changed, options=options).cam_from_world.wxyz_xyz * weight)

    gradient = jax.jit(jax.grad(outcome))(problem.measurements)
    numeric = [
        float(outcome(problem.measurements + s * direction) - outcome(problem.measurements - s * direction)) / (2 * s)
        for s in (1e-2, 2e-2)
    ]
    assert float(jnp.sum(gradient * direction)) == pytest.approx((4 * numeric[0] - numeric[1]) / 3, rel=1e-6)


# ---- constrained structure


@pytest.fixture(scope="module")
def house():
    """Two walls at right angles, each with points on it and two parallel edges; cameras in front."""
    rng = np.random.default_rng(2)
    with jax.enable_x64(True):
        poses = drive(4, rng, 0.6)
        tilt = np.asarray(SO3.exp(jnp.array([0.1, 0.3, -0.2])).as_matrix())
        wall = np.stack([rng.uniform(-2, 2, 10), rng.uniform(-1.5, 1.5, 10), np.zeros(10)], axis=1)
        side = np.stack([np.full(10, 2.0), rng.uniform(-1.5, 1.5, 10), rng.uniform(-3, 0, 10)], axis=1)
        edges = np.concatenate([[[x, y, 0.0] for y in (-1.5, -0.5, 0.5, 1.5)] for x in (-2.0, 1.0)])
        points = np.concatenate([wall, side, edges]) @ tilt.T + [0.5, 0.0, 7.0]
        frame, seen = (index.ravel() for index in np.indices((4, len(points))))
        pixels = look(poses, homogeneous(points), frame, seen) + 0.5 * rng.normal(size=(len(frame), 2))
        return poses, points, pixels, frame, seen


def adjust_house(house, sigma, angle, seed=3):
    """Adjust with planes and lines as frames 4 to 7; `sigma` says how well points are on them."""
    poses, points, pixels, frame, seen = house
    rng = np.random.default_rng(seed)
    start = points + 0.05 * rng.normal(size=points.shape)
    planes = [np.arange(10), np.arange(10, 20)]
    lines = [np.arange(20, 24), np.arange(24, 28)]
    frames = [plane_frame(start[members]) for members in planes] + [line_frame(start[members]) for members in lines]
    members = [*planes, *lines]
    extra = np.concatenate([np.full(len(index), 4 + k) for k, index in enumerate(members)])
    kind = np.concatenate([np.full(20, ON_PLANE), np.full(8, ON_LINE)])
    measured = np.concatenate([np.pad(pixels, ((0, 0), (0, 1))), np.pad(kind[:, None], ((0, 0), (2, 0)))])
    moved = jnp.where(jnp.asarray(ENDS)[:, None], poses.wxyz_xyz, spread(poses, 0.01, rng).wxyz_xyz)
    problem = bundle_problem(
        SE3(jnp.concatenate([moved, jnp.asarray(np.stack(frames))])),
        start,
        measured,
        np.concatenate([frame, extra]),
        np.concatenate([seen, *members]),
        CAMERA,
        sigma_px=np.concatenate([np.full(len(frame), 0.5), np.full(len(extra), sigma)]),
        # Scale is fixed: a smaller world would be nearer to its planes.
        fixed_cameras=np.concatenate(
            [np.repeat(ENDS[:, None], 6, axis=1), [PLANE_FIXED, PLANE_FIXED, LINE_FIXED, LINE_FIXED]]
        ),
        residual=structure_residual,
        factors=[parallel_axes([[6, 7]], angle), perpendicular_axes([[4, 5]], angle)],
    )
    return problem, adjust(problem)


@pytest.mark.slow
def test_points_keep_to_planes_and_lines_at_right_angles(house, x64):
    _, points, *_ = house
    problem, found = adjust_house(house, 1e-4, 1e-5)
    _, loose = adjust_house(house, 1e3, 1e3)
    assert not np.any(problem.unconstrained_cameras)

    def check(found):
        axes = found.cam_from_world.rotation().as_matrix()[4:, 2]
        local = [
            SE3(found.cam_from_world.wxyz_xyz[4 + k]).apply(found.landmarks[index])
            for k, index in enumerate((slice(0, 10), slice(10, 20), slice(20, 24), slice(24, 28)))
        ]
        off = (
            max(float(jnp.abs(local[k][:, 2]).max()) for k in (0, 1)),
            max(float(jnp.abs(local[k][:, :2]).max()) for k in (2, 3)),
        )
        return off, abs(float(axes[0] @ axes[1])), float(jnp.linalg.norm(jnp.cross(axes[2], axes[3])))

    off, right, parallel = check(found)
    assert max(off) < 1e-3
    assert right < 1e-4
    assert parallel < 1e-4
    (without, *_), *angles = check(loose)
    assert without > 5e-3
    assert max(angles) > 1e-3

    def shape_error(landmarks):
        """Error of the shape: scale and place are not known."""
        a, b = (x - x.mean(axis=0) for x in (np.asarray(landmarks), points))
        u, s, v = np.linalg.svd(a.T @ b)
        s[2] *= np.sign(np.linalg.det(u @ v))
        return np.sqrt(1 - s.sum() ** 2 / (np.sum(a * a) * np.sum(b * b)))

    assert shape_error(found.landmarks) < 0.8 * shape_error(loose.landmarks)


# ---- constrained motion


@pytest.mark.slow
def test_a_turntable_keeps_its_axis(x64):
    rng = np.random.default_rng(4)
    angle = np.deg2rad(12.0)
    spin = np.zeros((8, 6))
    spin[:, 5] = angle * np.arange(8)
    table = SE3.exp(jnp.asarray(spin))
    cam_from_table = SE3.exp(jnp.asarray([0.1, 0.2, 6.0, 1.9, 0.1, 0.0]))
    poses = SE3(jnp.tile(cam_from_table.wxyz_xyz, (8, 1))) @ table
    factor = turntable([[i, i + 1, i + 2] for i in range(6)], 0.01)
    np.testing.assert_allclose(factor.at(poses), 0.0, atol=1e-10)
    assert np.abs(np.asarray(factor.at(spread(poses, 0.01, rng)))).max() > 0.5

    points = rng.uniform([-1.5, -1.5, -1], [1.5, 1.5, 1], size=(20, 3))
    frame, seen = (index.ravel() for index in np.indices((8, 20)))
    pixels = look(poses, homogeneous(points), frame, seen) + rng.normal(size=(160, 2))
    moved = spread(poses, 0.02, rng).wxyz_xyz.at[0].set(poses.wxyz_xyz[0])
    arguments = (SE3(moved), points, pixels, frame, seen, CAMERA)
    found = adjust(bundle_problem(*arguments, gauge="two_cameras", factors=[turntable(factor.cameras, 1e-5)]))
    assert found.result == Result.success
    assert np.abs(np.asarray(factor.at(found.cam_from_world))).max() < 0.01
    # The hard constraint: one camera in the frame of the table, which turns about its z by any angles.
    stay = np.ones((8, 6), bool)
    stay[1:, 5] = False
    noisy = spin + np.array([0, 0, 0, 0, 0, 0.02]) * rng.normal(size=(8, 1)) * (np.arange(8) > 0)[:, None]
    problem = bundle_problem(
        SE3.exp(jnp.asarray(noisy)), points, pixels, frame, seen, CAMERA, fixed_cameras=stay,
        cam_from_rig=SE3(cam_from_table.wxyz_xyz[None]), rig_index=np.zeros(160, int), gauge="first_camera",
        fixed_extrinsics=np.zeros(1, bool),
    )  # fmt: skip
    hard = adjust(problem)
    assert float(hard.cost) < 1.2 * float(found.cost)
    turned = np.asarray(hard.cam_from_world.log())
    np.testing.assert_allclose(turned[:, :5], 0.0, atol=1e-12)
    np.testing.assert_allclose(turned[:, 5], spin[:, 5], atol=0.03)


def arc(turns, lengths):
    """A vehicle's poses, world_from_vehicle, along circular arcs."""
    poses = [np.eye(4)]
    for turn, length in zip(turns, lengths, strict=True):
        step = np.eye(4)
        step[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        step[:3, 3] = [length * np.sin(turn / 2), 0, length * np.cos(turn / 2)]
        poses.append(poses[-1] @ step)
    return SE3.from_matrix(jnp.asarray(np.stack(poses))).inverse()


@pytest.mark.slow
def test_circular_motion_steadies_a_drive(x64):
    truth = arc([0.1, 0.2, 0.0, -0.3, -0.1, 0.05, 0.0], [1.0] * 7)
    pairs = [[i, i + 1] for i in range(7)]
    np.testing.assert_allclose(circular_motion(pairs, 0.01, 0.001).at(truth), 0.0, atol=1e-10)
    # From the second pose to the third the way is straight: 2 cm to the side are two standard deviations.
    slipped = SE3.exp(jnp.asarray([0.02, 0, 0, 0, 0, 0])) @ SE3(truth.wxyz_xyz[3])
    both = SE3(jnp.stack([truth.wxyz_xyz[2], slipped.wxyz_xyz]))
    assert abs(float(circular_motion([[0, 1]], 0.01, 0.001).at(both)[0, 0])) == pytest.approx(2.0, rel=1e-6)

    rng = np.random.default_rng(5)
    points = rng.uniform([-8, -2, 4], [8, 2, 25], size=(15, 3))
    frame, seen = (index.ravel() for index in np.indices((8, 15)))
    local = np.asarray(SE3(truth.wxyz_xyz[frame]).apply(jnp.asarray(points[seen])))
    ahead = local[:, 2] > 2.0
    exact = np.asarray(CAMERA.project(jnp.where(jnp.asarray(ahead)[:, None], jnp.asarray(local), 1.0)))

    def side_errors(seed, factors):
        pixels = exact + 2.0 * np.random.default_rng(seed).normal(size=(120, 2))
        problem = bundle_problem(
            truth, points, pixels, frame, seen, CAMERA, sigma_px=2.0, mask=ahead, gauge="two_cameras", factors=factors
        )
        found = adjust(problem)
        return np.asarray(found.cam_from_world.inverse().translation() - truth.inverse().translation())[:, :2]

    factor = circular_motion(pairs, 0.005, 0.002)
    with_model = np.concatenate([side_errors(seed, [factor]) for seed in range(4)])
    without = np.concatenate([side_errors(seed, []) for seed in range(4)])
    assert np.sqrt(np.mean(with_model**2)) < 0.6 * np.sqrt(np.mean(without**2))


@pytest.mark.slow
def test_three_views_tie_two_baselines(x64):
    rng = np.random.default_rng(6)
    poses = drive(3, rng)
    points = rng.uniform([-2, -2, 4], [3, 2, 9], size=(12, 3))
    local = jnp.stack([SE3(poses.wxyz_xyz[i]).apply(jnp.asarray(points)) for i in range(3)], axis=1)
    bearings = local / jnp.linalg.norm(local, axis=-1, keepdims=True)
    factor = trifocal_scale(np.tile(np.arange(3), (12, 1)), bearings, 0.01)
    np.testing.assert_allclose(factor.at(poses), 0.0, atol=1e-9)
    # The third camera saw no landmark; all of its pose is known but one coordinate, which starts 20 % off.
    along = int(np.argmax(np.abs(poses.wxyz_xyz[2, 4:])))
    step = np.zeros(6)
    step[along] = 0.2 * float(poses.wxyz_xyz[2, 4 + along])
    start = poses.wxyz_xyz.at[2].set((SE3.exp(jnp.asarray(step)) @ SE3(poses.wxyz_xyz[2])).wxyz_xyz)
    frame, seen = (index.ravel() for index in np.indices((2, 12)))
    pixels = look(poses, homogeneous(points), frame, seen)
    fixed = np.ones((3, 6), bool)
    fixed[2, along] = False
    problem = bundle_problem(SE3(start), points, pixels, frame, seen, CAMERA, fixed_cameras=fixed, factors=[factor])
    assert not np.any(problem.unconstrained_cameras)
    found = adjust(problem, options=TIGHT)
    np.testing.assert_allclose(found.cam_from_world.wxyz_xyz, poses.wxyz_xyz, atol=1e-6)
