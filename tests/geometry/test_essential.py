"""The motions of an essential matrix against the SVD, the truth of simulations, and traps in the literature."""

import functools

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation

from tests.solvers.problems import central_differences, essential_matrices, lanes, pose_errors, relative_pose_problems
from vojax.geometry import (
    cheirality_votes,
    decompose_essential,
    essential_from_pose,
    pose_from_essential,
    sampson_error,
)
from vojax.lie import SE3, SO3

motions_last = jax.jit(jax.vmap(decompose_essential, in_axes=-1, out_axes=-1))
pose_last = jax.jit(jax.vmap(pose_from_essential, in_axes=-1, out_axes=-1))
pose_of = jax.jit(pose_from_essential)
votes_of = jax.jit(cheirality_votes)


def motions(matrices, dtype):
    """Poses [count, 4, 7] and validity [count]."""
    result = motions_last(*lanes(matrices, dtype=dtype))
    return np.moveaxis(np.asarray(result.cam1_from_cam0.wxyz_xyz, np.float64), -1, 0), np.asarray(result.valid)


def matrices_of(quaternions):
    return (
        Rotation.from_quat(quaternions[..., [1, 2, 3, 0]].reshape(-1, 4))
        .as_matrix()
        .reshape(*quaternions.shape[:-1], 3, 3)
    )


def motions_by_svd(matrix):
    """The textbook's two rotations and the direction of translation."""
    u, _, vt = np.linalg.svd(matrix)
    u, vt = u * np.linalg.det(u), vt * np.linalg.det(vt)
    w = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return u @ w @ vt, u @ w.T @ vt, u[:, 2]


def test_four_motions_are_those_of_the_svd(dtype, tolerance):
    *_, rotation, translation = relative_pose_problems(500, 1, seed=1)
    essential = essential_matrices(rotation, translation) * 3.0
    poses, valid = motions(essential, dtype)
    assert valid.all()
    found = matrices_of(poses[..., :4])
    for i in range(500):
        first, second, t = motions_by_svd(essential[i])
        expected = (first, second) if np.abs(found[i, 0] - first).max() < 0.1 else (second, first)
        np.testing.assert_allclose(found[i, 0], expected[0], atol=tolerance)
        np.testing.assert_allclose(found[i, 2], expected[1], atol=tolerance)
        np.testing.assert_allclose(np.abs(poses[i, 0, 4:] @ t), 1.0, atol=tolerance)
    # The order of the slots.
    np.testing.assert_array_equal(poses[:, 0, :4], poses[:, 1, :4])
    np.testing.assert_array_equal(poses[:, 2, :4], poses[:, 3, :4])
    np.testing.assert_array_equal(poses[:, 0, 4:], -poses[:, 1, 4:])
    np.testing.assert_array_equal(poses[:, 0, 4:], poses[:, 2, 4:])
    assert (poses[:, 0, 4:].max(axis=-1) >= -poses[:, 0, 4:].min(axis=-1)).all()
    for slot, side in enumerate((1.0, -1.0, -1.0, 1.0)):
        cross = np.cross(poses[:, slot, 4:, None], found[:, slot], axis=1)
        np.testing.assert_allclose(side * cross * 3.0 / np.sqrt(2.0), essential, atol=3 * tolerance)


def test_one_motion_is_the_truth(dtype, tolerance):
    *_, rotation, translation = relative_pose_problems(500, 1, seed=2)
    rotation = Rotation.random(500, rng=np.random.default_rng(0)).as_matrix()
    poses, _ = motions(essential_matrices(rotation, translation), dtype)
    assert pose_errors(poses, rotation, translation).min(axis=-1).max() < 5 * tolerance


def test_matrix_beside_the_manifold_is_decomposed_as_the_nearest_one(x64):
    *_, rotation, translation = relative_pose_problems(200, 1, seed=3)
    noise = np.random.default_rng(0).normal(size=(200, 3, 3))
    for size in (1e-2, 1e-4):
        matrix = essential_matrices(rotation, translation) + size * noise
        poses, _ = motions(matrix, np.float64)
        found = matrices_of(poses[..., :4])
        for i in range(200):
            by_svd = motions_by_svd(matrix[i])
            singular = np.linalg.svd(matrix[i], compute_uv=False)
            atol = 2.0 * (singular[2] / singular[1]) ** 3 + 1e-12
            for slot in (0, 2):
                assert min(np.abs(found[i, slot] - r).max() for r in by_svd[:2]) < atol
            assert abs(abs(poses[i, 0, 4:] @ by_svd[2]) - 1.0) < atol


def test_essential_matrix_is_t_cross_r_and_not_r_t_cross(x64):
    # Some texts print E = R [t]×. With p1 = R p0 + t that matrix belongs to another translation, Rᵀt... and R t.
    pose = SE3.exp(jnp.array([0.8, -0.3, 0.2, 0.4, -0.3, 0.6]))
    r, t = np.asarray(pose.rotation().as_matrix()), np.asarray(pose.translation())
    t_cross = np.cross(t[None], np.eye(3)).T
    points0 = np.random.default_rng(0).uniform([-2, -2, 4], [2, 2, 8], (20, 3))
    points1 = points0 @ r.T + t
    ours = np.asarray(essential_from_pose(pose))
    np.testing.assert_allclose(ours, t_cross @ r, atol=1e-14)
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", points1, ours, points0), 0.0, atol=1e-12)
    printed = r @ t_cross
    assert np.abs(np.einsum("ni,ij,nj->n", points1, printed, points0)).max() > 1.0
    # What is printed is right for t measured in camera 0: R [Rᵀt]× = [t]× R.
    np.testing.assert_allclose(r @ np.cross((r.T @ t)[None], np.eye(3)).T, ours, atol=1e-14)
    # Decomposed, the printed matrix gives another translation.
    direction = np.asarray(decompose_essential(printed).cam1_from_cam0.translation()[0])
    assert abs(direction @ t) / np.linalg.norm(t) < 0.95
    np.testing.assert_allclose(abs(direction @ (r @ t)) / np.linalg.norm(t), 1.0, atol=1e-12)


def test_sampson_error_has_a_squared_numerator(x64):
    # Some texts print |p1ᵀ E p0| / (…). The squared distance to the nearest pair of points that fulfils the
    # constraint decides, by constrained optimisation.
    rays0, rays1, rotation, translation = relative_pose_problems(1, 6, seed=4)
    essential = essential_matrices(rotation, translation)[0]
    noise = np.random.default_rng(1).normal(size=(2, 6, 2)) * 1e-3
    points0, points1 = (
        rays[0, :, :2] / rays[0, :, 2:] + shift for rays, shift in zip((rays0, rays1), noise, strict=True)
    )

    def form(x):
        return np.array([*x[2:], 1.0]) @ essential @ np.array([*x[:2], 1.0])

    ours = np.asarray(sampson_error(essential, points0, points1))
    for i in range(6):
        pair = np.concatenate([points0[i], points1[i]])
        nearest = scipy.optimize.minimize(
            lambda x, pair=pair: 1e6 * np.sum((x - pair) ** 2),
            pair,
            constraints={"type": "eq", "fun": lambda x: 1e3 * form(x)},
            options={"ftol": 1e-12, "maxiter": 200},
        )
        distance2 = np.sum((nearest.x - pair) ** 2)
        np.testing.assert_allclose(ours[i], distance2, rtol=1e-2)
        as_printed = ours[i] / abs(form(pair))
        assert not 0.1 < as_printed / distance2 < 10.0
    # Nor would it be a property of the epipolar geometry: it changes with the scale of E.
    np.testing.assert_allclose(sampson_error(7.0 * essential, points0, points1), ours, rtol=1e-10)


def test_pose_of_most_votes_is_the_truth(dtype, tolerance):
    rays0, rays1, rotation, translation = relative_pose_problems(2000, 8, seed=5)
    essential = essential_matrices(rotation, translation)
    poses, votes = pose_last(*lanes(essential, rays0, rays1, dtype=dtype))
    poses = np.moveaxis(np.asarray(poses.wxyz_xyz), -1, 0)
    assert pose_errors(poses[:, None], rotation, translation).max() < 5 * tolerance
    np.testing.assert_array_equal(votes, 8.0)


def test_votes_agree_with_opencv(x64):
    rays0, rays1, rotation, translation = relative_pose_problems(50, 20, seed=6)
    essential = essential_matrices(rotation, translation)
    # Half of the correspondences are wrong.
    rays1[:, 10:] = np.roll(rays1[:, 10:], 1, axis=1)
    for i in range(50):
        points0, points1 = (rays[i, :, :2] / rays[i, :, 2:] for rays in (rays0, rays1))
        count, r, t, *_ = cv2.recoverPose(essential[i], points0, points1, np.eye(3), distanceThresh=1e9)
        pose, votes = pose_of(essential[i], rays0[i], rays1[i])
        np.testing.assert_allclose(pose.rotation().as_matrix(), r, atol=1e-9)
        np.testing.assert_allclose(pose.translation(), t[:, 0], atol=1e-9)
        # OpenCV asks for z > 0 of an algebraic intersection; the wrong ones may differ.
        assert abs(float(votes) - count) <= 3


@pytest.mark.slow
def test_votes_beyond_180_degrees(dtype):
    # Points all around the cameras: half of them have z < 0.
    rng = np.random.default_rng(7)
    points0 = rng.normal(size=(200, 3)) * 5.0
    pose = SE3.exp(jnp.array([0.8, -0.3, 0.2, 0.4, -0.3, 0.6]))
    rays1 = np.asarray(pose @ points0.astype(dtype))
    rays0 = points0.astype(dtype)
    assert (rays0[:, 2] < 0).mean() > 0.3
    found, votes = pose_of(essential_from_pose(pose).astype(dtype), rays0, rays1)
    unit = np.asarray(pose.translation() / jnp.linalg.norm(pose.translation()))
    np.testing.assert_allclose(found.translation(), unit, atol=1e-4)
    np.testing.assert_array_equal(votes, 200.0)
    # A ray the other way puts its point behind the camera.
    _, votes = pose_of(
        essential_from_pose(pose).astype(dtype),
        rays0,
        rays1 * np.where(np.arange(200) < 30, -1, 1).astype(dtype)[:, None],
    )
    np.testing.assert_array_equal(votes, 170.0)


def test_weights_count_and_mask(dtype):
    rays0, rays1, rotation, translation = (x[0] for x in relative_pose_problems(1, 8, seed=8))
    rays0, rays1 = rays0.astype(dtype), rays1.astype(dtype)
    pose = SE3.from_rotation_and_translation(SO3.from_matrix(rotation.astype(dtype)), translation.astype(dtype))
    rays0[7] = np.nan
    weights = np.array([1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.0, 3.0], dtype)
    assert votes_of(pose, rays0, rays1) == 7.0
    assert votes_of(pose, rays0, rays1, weights) == 3.5
    gradient = jax.grad(lambda w: cheirality_votes(pose, rays0, rays1, w))(weights)
    np.testing.assert_array_equal(gradient, [1, 1, 1, 1, 1, 1, 1, 0])


def test_points_at_infinity_choose_the_rotation_only(dtype):
    rng = np.random.default_rng(9)
    rotation = SO3.exp(jnp.array([0.1, 0.3, -0.2], dtype))
    translation = jnp.array([0.6, 0.0, 0.8], dtype)
    rays0 = rng.normal(size=(50, 3)).astype(dtype)
    rays1 = np.asarray(rotation @ rays0)
    pose = SE3.from_rotation_and_translation(rotation, translation)
    poses = decompose_essential(essential_from_pose(pose)).cam1_from_cam0
    np.testing.assert_array_equal(votes_of(poses, rays0, rays1), [25.0, 25.0, 0.0, 0.0])
    # Rays towards the other camera meet it anywhere: no vote.
    along = np.asarray(rotation.inverse() @ translation)[None, :]
    assert votes_of(poses, -along, np.asarray(translation)[None, :])[2:].sum() == 0.0


@pytest.mark.parametrize("spoil", ["zero", "rank 1", "nan", "inf"])
def test_impossible_matrices_are_invalid(dtype, spoil):
    matrix = np.outer([1.0, 2.0, -1.0], [0.3, 0.5, 0.7]).astype(dtype)
    if spoil == "zero":
        matrix[:] = 0.0
    elif spoil == "nan":
        matrix[1, 2] = np.nan
    elif spoil == "inf":
        matrix[0, 0] = np.inf
    result = decompose_essential(matrix)
    assert not result.valid
    np.testing.assert_array_equal(result.cam1_from_cam0.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (4, 7)))
    _, votes = pose_of(matrix, np.ones((4, 3), dtype), np.ones((4, 3), dtype))
    assert votes == 0.0


def test_huge_and_tiny_matrices(dtype, tolerance):
    *_, rotation, translation = relative_pose_problems(20, 1, seed=10)
    essential = essential_matrices(rotation, translation)
    usual, _ = motions(essential, dtype)
    for size in (1e30, 1e-30):
        scaled, valid = motions(essential * size, dtype)
        assert valid.all()
        np.testing.assert_allclose(scaled, usual, atol=tolerance)


@functools.cache
def weighted_sum():
    factors = np.arange(1.0, 29.0).reshape(4, 7) / 28.0

    def function(matrix):
        return jnp.sum(decompose_essential(matrix).cam1_from_cam0.wxyz_xyz * factors)

    return jax.jit(function), jax.jit(jax.grad(function)), jax.jit(jax.jacfwd(function))


def test_gradients_equal_central_differences(x64):
    # In all nine directions, those across the manifold too, at exactly equal singular values. Beside the manifold the
    # values are those of the nearest essential matrix, to more digits than a difference resolves (tested above).
    function, reverse, forward = weighted_sum()
    *_, rotation, translation = relative_pose_problems(5, 1, seed=11)
    for essential in essential_matrices(rotation, translation):
        numeric = central_differences(function, (essential,), 0)
        np.testing.assert_allclose(reverse(essential), numeric, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(forward(essential), reverse(essential), rtol=1e-9, atol=1e-10)


@pytest.mark.slow
def test_gradients_are_finite_everywhere(dtype):
    *_, rotation, translation = relative_pose_problems(64, 1, seed=12)
    essential = essential_matrices(rotation, translation)
    essential[:8] = 0.0
    essential[8:16, 0, 0] = np.nan
    essential[16:24, 1, 1] = np.inf
    essential[24:32] *= 1e30
    essential[32:40] *= 1e-25
    essential[40:48] = np.outer([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    essential[48:56] = np.eye(3)
    gradient = jax.jit(jax.vmap(jax.grad(lambda e: jnp.sum(decompose_essential(e).cam1_from_cam0.wxyz_xyz)), -1, -1))
    assert np.isfinite(gradient(*lanes(essential, dtype=dtype))).all()
    assert np.isfinite(motions(essential, dtype)[0]).all()


@pytest.mark.slow
def test_vmap_equals_loop(x64):
    rays0, rays1, rotation, translation = relative_pose_problems(6, 5, seed=13)
    essential = essential_matrices(rotation, translation)
    poses, votes = pose_last(*lanes(essential, rays0, rays1, dtype=np.float64))
    first, _ = jax.jit(jax.vmap(pose_from_essential))(essential, rays0, rays1)
    np.testing.assert_allclose(np.moveaxis(np.asarray(poses.wxyz_xyz), -1, 0), first.wxyz_xyz, atol=1e-12)
    for i in range(6):
        single, count = pose_of(essential[i], rays0[i], rays1[i])
        np.testing.assert_allclose(single.wxyz_xyz, first.wxyz_xyz[i], atol=1e-12)
        assert count == votes[i]
