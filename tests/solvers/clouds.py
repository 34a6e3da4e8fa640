"""Point clouds of a wavy surface and of a frame of lines, and motions between them."""

import numpy as np
from scipy.spatial.transform import Rotation


def surface(rng, count, n):
    """Points [count, n, 3] on z = sin(5u) cos(4v) + 2 u v over a square of side 4, and the unit normals there."""
    u, v = rng.uniform(-1.0, 1.0, (2, count, n))
    z = np.sin(5 * u) * np.cos(4 * v) + 2.0 * u * v
    by_u = 5 * np.cos(5 * u) * np.cos(4 * v) + 2.0 * v
    by_v = -4 * np.sin(5 * u) * np.sin(4 * v) + 2.0 * u
    points = np.stack([2 * u, 2 * v, 0.3 * z], axis=-1)
    normals = np.stack([-0.15 * by_u, -0.15 * by_v, np.ones_like(u)], axis=-1)
    return points, normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def wires(rng, count, n):
    """Points on the twelve edges of a box, and the directions of the edges."""
    corners = np.array([2.0, 1.5, 1.0])
    axis = np.arange(n) % 3
    signs = np.where(rng.integers(0, 2, (count, n, 3)) == 1, 1.0, -1.0)
    points = signs * corners
    along = rng.uniform(-1.0, 1.0, (count, n)) * corners[axis]
    directions = np.broadcast_to(np.eye(3)[axis], points.shape)
    return np.where(directions > 0, along[..., None], points), directions


def small_motions(rng, count, angle=0.05, shift=0.05):
    """Matrices [count, 4, 4]."""
    motions = np.zeros((count, 4, 4))
    motions[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(count, 3)) * angle / np.sqrt(3)).as_matrix()
    motions[:, :3, 3], motions[:, 3, 3] = rng.normal(size=(count, 3)) * shift / np.sqrt(3), 1.0
    return motions


def move(motions, points):
    return np.einsum("bij,bnj->bni", motions[:, :3, :3], points) + motions[:, None, :3, 3]


def motion_errors(found, motions):
    """Rotation in radians and translation of the difference of motions [count, 4, 4]."""
    change = np.linalg.inv(motions) @ found
    return np.linalg.norm(Rotation.from_matrix(change[:, :3, :3]).as_rotvec(), axis=1), np.linalg.norm(
        change[:, :3, 3], axis=1
    )
