import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.cameras import Pinhole
from vojax.datasets import (
    motion_profile,
    simulate_absolute_pose,
    simulate_relative_pose,
    simulate_rigid,
    simulate_stereo_window,
)

KEY = jax.random.key(7)


def _same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def _oracle_project(points, focal, width, height):
    points = np.asarray(points, np.float64)
    return points[..., :2] / points[..., 2:] * focal + [(width - 1) / 2, (height - 1) / 2]


def _matrix(pose):
    return np.asarray(pose.as_matrix(), np.float64)


def test_absolute_pose_reprojects_with_the_noise_asked_for(dtype):
    problem = simulate_absolute_pose(KEY, 4000, outlier_fraction=0.25, sigma_px=0.7, dtype=dtype)
    assert problem.pixels.dtype == problem.points_world.dtype == dtype
    matrix = _matrix(problem.cam_from_world)
    points_cam = np.asarray(problem.points_world, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    residual = np.asarray(problem.pixels, np.float64) - _oracle_project(points_cam, 800.0, 1280, 960)
    inliers = np.asarray(problem.inliers)
    assert inliers.sum() == 3000
    # 3 sigma of the sample deviation of 6,000 numbers is 2.7 %.
    assert residual[inliers].std() == pytest.approx(0.7, rel=0.03)
    assert np.median(np.linalg.norm(residual[~inliers], axis=1)) > 200
    distance = np.linalg.norm(points_cam, axis=1)
    assert distance.min() > 1.99
    assert distance.max() < 20.01


def test_outliers_are_uniform_over_the_image():
    problem = simulate_absolute_pose(KEY, 4000, outlier_fraction=1.0)
    pixels = np.asarray(problem.pixels)
    assert not np.any(np.asarray(problem.inliers))
    counts, *_ = np.histogram2d(pixels[:, 0], pixels[:, 1], bins=4, range=[[0, 1279], [0, 959]])
    assert counts.sum() == 4000
    # 16 cells of 250: five sigma is 77.
    assert np.abs(counts - 250).max() < 77


def test_without_noise_the_problem_is_exact(x64):
    camera = Pinhole(fx=500.0, fy=510.0, cx=320.0, cy=200.0)
    problem = simulate_absolute_pose(KEY, 50, sigma_px=0.0, camera=camera, image_size=(640, 400), dtype=jnp.float64)
    again = camera.project(problem.cam_from_world.apply(problem.points_world))
    np.testing.assert_allclose(again, problem.pixels, atol=1e-9)


def test_batches_over_keys_and_repeats():
    keys = jax.random.split(KEY, 3)
    batch = jax.vmap(lambda key: simulate_absolute_pose(key, 12, outlier_fraction=0.5))(keys)
    assert batch.pixels.shape == (3, 12, 2)
    assert np.asarray(batch.inliers).sum(axis=1).tolist() == [6, 6, 6]
    one = simulate_absolute_pose(keys[1], 12, outlier_fraction=0.5)
    np.testing.assert_allclose(batch.points_world[1], one.points_world, rtol=1e-4, atol=1e-4)
    assert _same(one, simulate_absolute_pose(keys[1], 12, outlier_fraction=0.5))
    assert not np.allclose(batch.pixels[0], batch.pixels[1])


def test_relative_pose_obeys_the_epipolar_equation(x64):
    problem = simulate_relative_pose(KEY, 200, sigma_px=0.0, outlier_fraction=0.1, dtype=jnp.float64)
    matrix = _matrix(problem.cam1_from_cam0)
    x, y, z = matrix[:3, 3]
    assert np.hypot(np.hypot(x, y), z) == pytest.approx(1.0)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ matrix[:3, :3]
    ray0, ray1 = (np.asarray(problem.camera.unproject(p)) for p in (problem.pixels0, problem.pixels1))
    error = np.abs(np.einsum("ni,ij,nj->n", ray1, essential, ray0))
    inliers = np.asarray(problem.inliers)
    assert inliers.sum() == 180
    assert error[inliers].max() < 1e-9
    assert np.median(error[~inliers]) > 1e-3


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_rigid_moves_points(dtype, scale):
    problem = simulate_rigid(KEY, 3000, outlier_fraction=0.2, sigma=0.02, scale=scale, dtype=dtype)
    matrix = _matrix(problem.cam1_from_cam0)
    moved = scale * np.asarray(problem.points0, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    residual = np.asarray(problem.points1, np.float64) - moved
    inliers = np.asarray(problem.inliers)
    assert inliers.sum() == 2400
    assert residual[inliers].std() == pytest.approx(0.02, rel=0.04)
    assert np.median(np.linalg.norm(residual[~inliers], axis=1)) > 2


@pytest.mark.parametrize(("motion", "along"), [("forward", 2), ("turning", 2), ("sideways", 0), ("random", None)])
def test_motion_profiles(motion, along):
    poses = motion_profile(80, key=KEY, motion=motion, step=0.8)
    matrix = _matrix(poses)
    np.testing.assert_allclose(matrix[0], np.eye(4), atol=1e-7)
    eye = np.broadcast_to(np.eye(3), (80, 3, 3))
    np.testing.assert_allclose(matrix[:, :3, :3] @ matrix[:, :3, :3].swapaxes(1, 2), eye, atol=1e-5)
    steps = np.linalg.inv(matrix[:-1]) @ matrix[1:]
    length = np.linalg.norm(steps[:, :3, 3], axis=1)
    assert length.mean() == pytest.approx(0.8, rel=0.15)
    turned = np.degrees(np.arccos(np.clip((np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    whole = np.degrees(np.arccos(np.clip(matrix[:, 2, 2], -1, 1)))
    if along is not None:
        assert (steps[:, along, 3] > 0.7).all()
        assert turned.max() < 5.0
        # Smooth: the heading rate changes little from frame to frame.
        assert np.abs(np.diff(turned)).max() < 1.0
    if motion == "turning":
        assert whole.max() > 45
    elif motion != "random":
        assert whole.max() < 10


def test_stereo_window_agrees_with_the_pinhole_equations(x64):
    window = simulate_stereo_window(KEY, 8, 300, sigma_px=0.3, outlier_fraction=0.1, dtype=jnp.float64)
    assert window.observations.shape == (8, 300, 3)
    matrix = np.linalg.inv(_matrix(window.world_from_cam))
    landmarks = np.asarray(window.landmarks_world)
    points = np.einsum("fij,pj->fpi", matrix[:, :3, :3], landmarks) + matrix[:, None, :3, 3]
    left = _oracle_project(points, 400.0, 640, 240)
    right = left[..., 0] - 400.0 * 0.54 / points[..., 2]
    residual = np.asarray(window.observations) - np.concatenate([left, right[..., None]], axis=-1)
    visible, inliers = np.asarray(window.visible), np.asarray(window.inliers)
    assert residual[inliers].std() == pytest.approx(0.3, rel=0.05)
    assert not np.any(inliers & ~visible)
    assert 0.05 < 1 - inliers.sum() / visible.sum() < 0.15
    # Every landmark is seen at least once, and tracks are long enough to tie frames together.
    assert visible.any(axis=0).all()
    assert visible.sum(axis=0).mean() > 3
    assert not np.any(np.asarray(window.observations)[~visible])
    assert (points[..., 2][visible] > 3.9).all()


def test_one_frame_and_other_bad_input():
    assert motion_profile(1, key=KEY).wxyz_xyz.shape == (1, 7)
    with pytest.raises(ValueError, match="frames is 0"):
        motion_profile(0, key=KEY)
    with pytest.raises(ValueError, match=r"outlier_fraction is 1\.5"):
        simulate_absolute_pose(KEY, 5, outlier_fraction=1.5)


def test_the_dtype_asked_for_is_that_of_everything_also_where_jax_has_doubles(x64):
    problems = (
        simulate_absolute_pose(KEY, 20, dtype=jnp.float32),
        simulate_relative_pose(KEY, 20, dtype=jnp.float32),
        simulate_rigid(KEY, 20, dtype=jnp.float32),
        simulate_stereo_window(KEY, 3, 20, dtype=jnp.float32),
    )
    numbers = [leaf for leaf in jax.tree.leaves(problems) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert {leaf.dtype for leaf in numbers} == {jnp.dtype(jnp.float32)}
