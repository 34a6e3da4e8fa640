"""The time between left and right, from row offsets that geometry makes."""

import numpy as np
import pytest

from vojax.odometry._synchrony import Synchrony

FOCAL, CENTER = 400.0, np.array([320.0, 120.0])


def frame(rng, late, count=150):
    """Pixels of a camera that goes 0.9 m ahead in a frame, their flow down, and the row offsets of a late right one."""
    points = rng.uniform([-8.0, -2.0, 5.0], [8.0, 2.0, 40.0], (count, 3))

    def pixels(ahead):
        local = points - np.array([0.0, 0.0, ahead])
        return FOCAL * local[:, :2] / local[:, 2:] + CENTER

    flow = (pixels(0.0) - pixels(-0.9))[:, 1]
    return pixels(0.0), flow, (pixels(0.9 * late) - pixels(0.0))[:, 1]


@pytest.mark.parametrize("late", [0.0, 0.05, -0.2])
def test_the_time_is_found_whatever_rectification_left(late):
    rng, synchrony = np.random.default_rng(0), Synchrony.prior()
    for _ in range(20):
        pixels, flow, offset = frame(rng, late)
        left = 0.3 - 0.2 * pixels[:, 0] / 1000.0 + 0.4 * pixels[:, 1] / 1000.0
        synchrony = synchrony.add(pixels, flow, offset + left + 0.2 * rng.normal(size=len(flow)))
    found, deviation = synchrony.late()
    # To first order: a point's flow grows while it comes closer, by 4 % at the mean of these depths.
    assert abs(found - late) < 4.0 * deviation + 0.05 * abs(late)
    assert deviation < 0.01


def test_wrong_matches_do_not_decide():
    rng, synchrony = np.random.default_rng(1), Synchrony.prior()
    for _ in range(20):
        pixels, flow, offset = frame(rng, 0.1)
        wrong = rng.random(len(flow)) < 0.2
        offset = np.where(wrong, rng.uniform(-1.5, 1.5, len(flow)), offset + 0.2 * rng.normal(size=len(flow)))
        synchrony = synchrony.add(pixels, flow, offset)
    found, deviation = synchrony.late()
    assert abs(found - 0.1) < 0.02
    assert found > 5.0 * deviation


def test_nothing_is_known_of_a_camera_at_rest():
    rng, synchrony = np.random.default_rng(2), Synchrony.prior()
    for _ in range(20):
        pixels, _, _ = frame(rng, 0.0)
        synchrony = synchrony.add(pixels, np.zeros(len(pixels)), 0.2 * rng.normal(size=len(pixels)))
    found, deviation = synchrony.late()
    assert deviation == pytest.approx(1.0)
    assert abs(found) < 1e-9
    assert Synchrony.prior().add(np.zeros((0, 2)), np.zeros(0), np.zeros(0)).late() == (0.0, 1.0)
