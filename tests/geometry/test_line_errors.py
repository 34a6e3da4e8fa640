import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from vojax.cameras import Pinhole
from vojax.geometry._line_errors import line_reprojection_error
from vojax.lie import SE3

CAMERA = Pinhole(fx=600.0, fy=620.0, cx=320.0, cy=240.0)


def scene(seed=0, count=20):
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(size=3) * 0.3)
    translation = rng.normal(size=3)
    cam = np.concatenate([rng.uniform(-2, 2, (count, 2, 2)), rng.uniform(4, 8, (count, 2, 1))], axis=-1)
    world = turn.inv().apply((cam - translation).reshape(-1, 3)).reshape(cam.shape)
    quaternion = turn.as_quat()
    pose = SE3(jnp.asarray(np.concatenate([quaternion[3:], quaternion[:3], translation])))
    pixels = cam[..., :2] / cam[..., 2:] * np.array([600.0, 620.0]) + np.array([320.0, 240.0])
    return pose, world, pixels


def through(pixels):
    ends = np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1)
    return np.cross(ends[..., 0, :], ends[..., 1, :])


def test_the_true_line_has_no_error(x64):
    pose, world, pixels = scene()
    errors = line_reprojection_error(world, through(pixels), CAMERA, pose)
    np.testing.assert_allclose(errors, 0.0, atol=1e-9)


def test_distances_of_a_moved_line(x64):
    pose, world, pixels = scene(1)
    lines = through(pixels)
    lines = lines / np.linalg.norm(lines[:, :2], axis=-1, keepdims=True)
    moved = lines - np.array([0.0, 0.0, 3.0])
    for scale in (1.0, 50.0):
        errors = line_reprojection_error(world, scale * moved, CAMERA, pose)
        np.testing.assert_allclose(errors, -3.0, rtol=1e-9)


def test_one_line_without_a_batch(x64):
    pose, world, pixels = scene(2)
    line = through(pixels)[0] + np.array([0.1, -0.2, 5.0])
    one = line_reprojection_error(world[0], line, CAMERA, pose)
    normal = line[:2] / np.linalg.norm(line[:2])
    expected = pixels[0] @ normal + line[2] / np.linalg.norm(line[:2])
    np.testing.assert_allclose(one, expected, rtol=1e-9)


def test_nothing_is_infinite():
    pose, world, _ = scene(3)
    world[0] = 0.0
    world[1, :, 2] = -4.0

    def total(world, lines):
        return jnp.sum(line_reprojection_error(world, lines, CAMERA, pose))

    lines = np.ones((20, 3), np.float32)
    lines[2] = 0.0
    value, gradients = jax.value_and_grad(total, (0, 1))(world.astype(np.float32), lines)
    assert np.isfinite(value)
    for gradient in gradients:
        assert np.isfinite(gradient).all()
    errors = line_reprojection_error(world.astype(np.float32), lines, CAMERA, pose)
    np.testing.assert_array_equal(errors[2], 0.0)


def test_gradient_equals_central_differences(x64):
    pose, world, pixels = scene(4, 2)
    lines = through(pixels) + np.array([10.0, -20.0, 5000.0])

    def total(world, lines):
        return jnp.sum(line_reprojection_error(world, lines, CAMERA, pose) ** 2)

    gradients = jax.grad(total, (0, 1))(world, lines)
    for index, gradient in enumerate(gradients):
        numeric = np.zeros(gradient.shape)
        for entry in np.ndindex(numeric.shape):
            step = 1e-6 * max(1.0, abs((world, lines)[index][entry]))
            ends = []
            for change in (step, -step):
                arrays = [world.copy(), lines.copy()]
                arrays[index][entry] += change
                ends.append(float(total(*arrays)))
            numeric[entry] = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max())
