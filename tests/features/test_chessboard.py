"""Corners of rendered boards, whose places are known."""

import cv2
import numpy as np
import pytest

from vojax.features import chessboard_points, find_chessboard

BOARD, SIZE, FINER = (9, 6), (640, 480), 8
K = np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1.0]])


def render(turn, shift, blur=0.8, noise=2.0):
    """A board of 10 x 7 squares of unit side, drawn eight times too large and averaged, and its true corners."""
    rotation, _ = cv2.Rodrigues(np.array(turn))
    texture = np.kron((np.indices((7, 10)).sum(0) % 2) * 255.0, np.ones((40, 40))).astype(np.uint8)
    texture = np.pad(texture, 40, constant_values=255)
    # Texture pixels to the plane of the board, with its first inner corner between four pixels at the origin.
    plane = np.array([[1, 0, -79.5], [0, 1, -79.5], [0, 0, 40]]) / 40
    pose = np.column_stack([rotation[:, :2], shift])
    fine = np.array([[FINER, 0, (FINER - 1) / 2], [0, FINER, (FINER - 1) / 2], [0, 0, 1]])
    big = (SIZE[0] * FINER, SIZE[1] * FINER)
    image = cv2.warpPerspective(texture, fine @ K @ pose @ plane, big, borderValue=128)
    image = cv2.GaussianBlur(cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA).astype(float), (0, 0), blur)
    image = image + noise * np.random.default_rng(0).normal(size=image.shape)
    corners = (chessboard_points(BOARD, 1.0) @ rotation.T + np.array(shift)) @ K.T
    return np.clip(image, 0, 255).round().astype(np.uint8), corners[:, :2] / corners[:, 2:]


VIEWS = [
    ((0.0, 0.0, 0.0), (-4.0, -2.5, 12.0)),
    ((0.6, 0.1, 0.2), (-3.0, -2.0, 12.0)),
    ((-0.3, 0.7, -0.3), (-3.0, -1.0, 17.0)),
]


@pytest.mark.parametrize(("turn", "shift"), VIEWS)
def test_corners_are_found_to_a_thirtieth_of_a_pixel(turn, shift):
    image, truth = render(turn, shift)
    found = find_chessboard(image, BOARD)
    # The board may be read from the other end.
    error = min((np.linalg.norm(found - order, axis=1) for order in (truth, truth[::-1])), key=np.max)
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert error.max() < 0.08


def test_no_board_in_an_empty_image():
    assert find_chessboard(np.full((100, 100), 128, np.uint8), BOARD) is None


def test_a_board_without_inside():
    with pytest.raises(ValueError, match="at least 3x3 inner corners"):
        find_chessboard(np.zeros((100, 100), np.uint8), (2, 9))
