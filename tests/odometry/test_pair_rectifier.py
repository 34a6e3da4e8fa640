import jax.numpy as jnp
import numpy as np
import pytest

from vojax.cameras import BrownConrady, KannalaBrandt
from vojax.lie import SE3
from vojax.odometry import PairRectifier

SIZE = (160, 120)
LEFT = BrownConrady(fx=90.0, fy=91.0, cx=80.0, cy=59.0, k1=-0.2, k2=0.05, p1=1e-3, p2=0.0, k3=0.0)
RIGHT = KannalaBrandt(fx=88.0, fy=88.0, cx=78.0, cy=61.0, k1=0.02, k2=0.0, k3=0.0, k4=0.0)
CAM1_FROM_CAM0 = SE3.exp(jnp.array([-0.2, 0.01, 0.005, 0.01, -0.02, 0.015]))


@pytest.fixture(scope="module")
def rectifier():
    return PairRectifier(LEFT, RIGHT, CAM1_FROM_CAM0, SIZE)


def blob(camera, point):
    """An image with a light spot where a point is seen, and that pixel."""
    pixel = np.asarray(camera.project(point))
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    return (250 * np.exp(-((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2) / 18)).astype(np.uint8), pixel


def centre(image):
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    weight = image.astype(float)
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("point", [(0.3, 0.2, 1.5), (-0.4, -0.3, 2.0), (0.0, 0.1, 1.0)])
def test_a_point_lands_on_one_row_at_its_depth(rectifier, point):
    point = jnp.array(point)
    (left, pixel), (right, _) = blob(LEFT, point), blob(RIGHT, CAM1_FROM_CAM0.apply(point))
    seen0, seen1 = map(centre, rectifier(left, right))
    assert seen0[1] == pytest.approx(seen1[1], abs=0.15)
    in_rect = rectifier.stereo.unproject(jnp.array([seen0[0], seen0[1], seen1[0]]))
    np.testing.assert_allclose(rectifier.rect_from_cam0.T @ np.asarray(in_rect), point, rtol=0.03, atol=0.01)
    np.testing.assert_allclose(rectifier.pixels_of_left(seen0[None])[0], pixel, atol=0.15)


def test_poses_of_the_left_camera(rectifier):
    np.testing.assert_allclose(rectifier.pose_of_left(np.eye(4)), np.eye(4), atol=1e-6)
    turn = np.eye(4)
    turn[:3, :3] = rectifier.rect_from_cam0
    # world = first left camera: world_from_cam = rect0⁻¹ world_rect_from_rect rect.
    motion = np.asarray(SE3.exp(jnp.array([0.1, 0.2, 0.3, 0.05, -0.1, 0.2])).as_matrix(), np.float64)
    np.testing.assert_allclose(turn @ rectifier.pose_of_left(motion), motion @ turn, atol=1e-6)


def test_no_pixels(rectifier):
    assert rectifier.pixels_of_left(np.zeros((0, 2))).shape == (0, 2)


def test_bad_input(rectifier):
    image = np.zeros((120, 160), np.uint8)
    with pytest.raises(ValueError, match="the right image is 160×100 px: expected 160×120"):
        rectifier(image, image[:100])
    with pytest.raises(ValueError, match="image size"):
        PairRectifier(LEFT, RIGHT, CAM1_FROM_CAM0, (0, 10))
    with pytest.raises(ValueError, match="left"):
        PairRectifier(LEFT, RIGHT, CAM1_FROM_CAM0.inverse(), SIZE)
