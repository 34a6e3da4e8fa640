"""One problem with everything wrong that is not refused: each flaw is named in the result, and harms nothing else."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3, Result
from vojax.ba import adjust_bundle, bundle_problem
from vojax.cameras import Pinhole

CAMERA = Pinhole(fx=400.0, fy=400.0, cx=320.0, cy=240.0)
GOOD = 4  # cameras, and after them:
ALONE, APART, OTHER, TURNED = 4, 5, 6, 7
P = 15  # good landmarks, and after them:
ONCE, NEVER, ALONG, BEHIND = 15, 16, 17, 18
ISLAND = range(19, 24)


def project(pose, points):
    local = points @ pose[:3, :3].T + pose[:3, 3]
    return 400.0 * local[:, :2] / local[:, 2:] + [320.0, 240.0]


@pytest.fixture(scope="module")
def flawed():
    """The problem and its adjustment."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        xi = 0.05 * rng.normal(size=(8, 6))
        xi[:, 0] += 0.7 * np.arange(8)
        xi[TURNED, :3] = xi[3, :3]  # where camera 3 is, but turned
        xi[TURNED, 3:] = xi[3, 3:] = 0.0
        poses = np.array(SE3.exp(jnp.asarray(xi)).inverse().as_matrix())
        turn = np.array(SE3.exp(jnp.array([0, 0, 0, 0, 0.1, 0])).as_matrix())
        poses[TURNED] = turn @ poses[TURNED]
    points = rng.uniform([-2, -2, 4], [4, 2, 9], size=(24, 3))
    points[BEHIND] = [0.5, 0.3, -6.0]
    rows = [(k, j) for k in (*range(GOOD), TURNED) for j in range(P)]
    rows += [(1, ONCE), (3, ALONG), (TURNED, ALONG), (0, BEHIND), (1, BEHIND), (2, BEHIND)]
    rows += [(k, j) for k in (APART, OTHER) for j in ISLAND]
    rows.append(rows[0])  # a duplicate
    index, seen = np.array(rows).T
    pixels = np.concatenate([project(poses[k], points[j : j + 1]) for k, j in rows])
    pixels += 0.3 * rng.normal(size=pixels.shape)
    with jax.enable_x64(True):
        problem = bundle_problem(
            SE3.from_matrix(jnp.asarray(poses)), points, pixels, index, seen, CAMERA, gauge="two_cameras"
        )
        return problem, eqx.filter_jit(adjust_bundle)(problem)


def test_nothing_is_lost_and_all_is_finite(flawed, x64):
    _, found = flawed
    assert found.cam_from_world.wxyz_xyz.shape == (8, 7)
    assert found.landmarks.shape == (24, 3)
    for leaf in jax.tree.leaves((found.cam_from_world, found.landmarks, found.cost, found.trace)):
        assert np.all(np.isfinite(leaf))
    assert found.result == Result.degenerate
    assert not np.any(found.unconstrained_cameras[:GOOD])
    assert not np.any(found.unconstrained_landmarks[:P])


def test_landmarks_seen_once_or_never_are_named(flawed, x64):
    problem, found = flawed
    assert found.unconstrained_landmarks[ONCE]
    assert found.unconstrained_landmarks[NEVER]
    np.testing.assert_array_equal(found.landmarks[NEVER], problem.landmarks[NEVER])


def test_a_landmark_seen_along_one_ray_is_named(flawed, x64):
    problem, found = flawed
    assert not problem.unconstrained_landmarks[ALONG]  # two cameras saw it: enough by count
    assert found.unconstrained_landmarks[ALONG] | (float(jnp.abs(found.landmarks[ALONG]).max()) > 20)


def test_a_landmark_behind_its_cameras_is_counted(flawed, x64):
    _, found = flawed
    assert found.behind_camera == 3
    assert not found.unconstrained_landmarks[BEHIND]


def test_a_camera_without_observations_stays_and_is_named(flawed, x64):
    problem, found = flawed
    assert found.unconstrained_cameras[ALONE]
    np.testing.assert_allclose(found.cam_from_world.wxyz_xyz[ALONE], problem.cam_from_world.wxyz_xyz[ALONE], atol=1e-12)


def test_a_disconnected_part_is_named(flawed, x64):
    problem, found = flawed
    assert list(np.flatnonzero(found.unconstrained_cameras)) == [ALONE, APART, OTHER]
    assert np.all(np.asarray(found.unconstrained_landmarks)[list(ISLAND)])
    parts = np.asarray(problem.parts)
    assert np.all(parts[[*range(GOOD), TURNED]] == 0)
    assert parts[APART] == parts[OTHER] != parts[ALONE]


def test_duplicates_are_counted_and_weigh_in(flawed, x64):
    problem, _ = flawed
    assert problem.duplicates == 1
    assert problem.weights.sum() == len(problem.measurements)


def test_a_gauge_left_free_is_told(flawed, x64):
    problem, _ = flawed
    assert not problem.gauge_free
    arguments = (problem.measurements, problem.camera_index, problem.landmark_index, CAMERA)
    free = bundle_problem(problem.cam_from_world, problem.landmarks, *arguments)
    assert free.gauge_free
    three = np.arange(24) < 3
    assert not bundle_problem(problem.cam_from_world, problem.landmarks, *arguments, fixed_landmarks=three).gauge_free


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"landmarks": np.full((24, 3), np.nan)}, r"landmarks\[0\] is not finite \(24 such rows\)"),
        ({"landmarks": np.zeros((24, 2))}, r"landmarks has shape \(24, 2\): expected \(p, 3\)"),
        ({"landmarks": np.zeros((24, 4))}, r"landmarks\[0\] is zero: homogeneous points are not"),
        ({"camera_index": np.full(92, 8)}, r"camera_index\[0\] is 8: expected 0 to 7, there are 8 cameras"),
        ({"landmark_index": np.full(92, 24)}, r"landmark_index\[0\] is 24: expected 0 to 23"),
        ({"sigma_px": np.full((92, 2, 2), 1.0)}, "sigma_px has 92 entries that are not positive"),
        ({"sigma_px": np.ones(3)}, r"sigma_px has shape \(3,\)"),
        ({"fixed_cameras": np.zeros((8, 5), bool)}, r"fixed_cameras has shape \(8, 5\)"),
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_refused(change, message, flawed, x64):
    problem, _ = flawed
    assert len(problem.measurements) == 92
    given = {
        "cam_from_world": problem.cam_from_world, "landmarks": problem.landmarks, "measurements": problem.measurements,
        "camera_index": problem.camera_index, "landmark_index": problem.landmark_index, "camera": CAMERA,
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        bundle_problem(**(given | change))
