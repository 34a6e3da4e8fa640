import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3
from vojax.cameras import BrownConrady
from vojax.features._chessboard import chessboard_points

BOARD = (6, 5)
SIZE = (640, 480)


@pytest.fixture(scope="session")
def board():
    """Points of a board of 6 x 5 inner corners, a unit apart."""
    return chessboard_points(BOARD, 1.0)


def views_of(camera, board, count, seed=0, distance=7.0, tilt=0.6, spread=1.5):
    """Corners without noise of a board at various angles, and its poses."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-tilt, tilt, size=(count, 3))
    middle = board.mean(axis=0)
    poses = SE3.exp(jnp.asarray(np.concatenate([np.zeros((count, 3)), turn], axis=1)))
    shift = rng.uniform(-spread, spread, size=(count, 3)) + np.array([0.0, 0.0, distance])
    offset = jnp.asarray(shift) - poses.apply(jnp.tile(jnp.asarray(middle)[None], (count, 1)))
    poses = SE3.from_rotation_and_translation(poses.rotation(), offset)
    corners = np.stack([np.asarray(camera.project(SE3(pose).apply(jnp.asarray(board)))) for pose in poses.wxyz_xyz])
    return corners, poses


@pytest.fixture(scope="session")
def make_views():
    """The function `views_of`."""
    return views_of


@pytest.fixture(scope="session")
def lens():
    """A camera with the distortion of an ordinary lens."""
    with jax.enable_x64(True):
        return BrownConrady(fx=520.0, fy=515.0, cx=325.0, cy=236.0, k1=-0.25, k2=0.08, p1=1e-3, p2=-5e-4, k3=-0.01)


@pytest.fixture(scope="session")
def views(lens, board):
    """Eight views through `lens` with noise of 0.2 pixels, and the true poses."""
    with jax.enable_x64(True):
        corners, poses = views_of(lens, board, 8)
        return corners + 0.2 * np.random.default_rng(7).normal(size=corners.shape), poses
