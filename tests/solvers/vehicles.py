"""A vehicle with a fixed axle that drives along circular arcs, in numpy and float64."""

import numpy as np
from scipy.spatial.transform import Rotation


def drive(count, n, seed=0, theta=None, lever_arm=0.0, side=0.0, outliers=0.0, sigma=0.0, mounted=False, reverse=False):
    """Correspondences of `count` motions and what is true of them.

    The axle rolls 1 m along a chord while the heading turns by theta (0.2 rad rms by default, left positive). The
    camera is `lever_arm` ahead of the axle and `side` to its left, level and looking ahead, or mounted at random.
    Points are 4 to 30 m away. The first `outliers` share of the points is moved at random.

    Returns:
        A dictionary: rays0 and rays1 [count, n, 3], forward and up [count, 3], theta, rotation, translation (metric) of
        cam1_from_cam0 and which points are outliers.
    """
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=count) * 0.2 if theta is None else np.broadcast_to(theta, (count,)).astype(float)
    chord = -1.0 if reverse else 1.0
    # In a camera that is level: x right, y down, z ahead. The world is the first axle's frame.
    yaw = Rotation.from_rotvec(-theta[:, None] * np.array([0.0, 1.0, 0.0])).as_matrix()  # vehicle to world
    moved = chord * np.stack([-np.sin(theta / 2), np.zeros(count), np.cos(theta / 2)], axis=-1)
    arm = np.array([-side, 0.0, lever_arm])
    rays = np.concatenate([rng.uniform(-0.8, 0.8, (count, n, 2)) * [1.0, 0.5], np.ones((count, n, 1))], axis=-1)
    points0 = rays * rng.uniform(4.0, 30.0, (count, n, 1))
    camera1 = moved + np.einsum("bij,j->bi", yaw, arm) - arm  # in the first camera's axes, from the first camera
    rotation = np.swapaxes(yaw, 1, 2)
    translation = -np.einsum("bij,bj->bi", rotation, camera1)
    points1 = np.einsum("bij,bnj->bni", rotation, points0) + translation[:, None]
    wrong = np.zeros((count, n), bool)
    wrong[:, : round(outliers * n)] = True
    elsewhere = np.concatenate([rng.uniform(-0.8, 0.8, (count, n, 2)) * [1.0, 0.5], np.ones((count, n, 1))], axis=-1)
    points1[wrong] = elsewhere[wrong]
    rays0, rays1 = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (points0, points1))
    rays0, rays1 = rays0 + sigma * rng.normal(size=rays0.shape), rays1 + sigma * rng.normal(size=rays1.shape)
    forward, up = np.tile([0.0, 0.0, 1.0], (count, 1)), np.tile([0.0, -1.0, 0.0], (count, 1))
    if mounted:
        mount = Rotation.random(count, rng=rng).as_matrix()
        rays0, rays1 = (np.einsum("bij,bnj->bni", mount, x) for x in (rays0, rays1))
        forward, up, translation = (np.einsum("bij,bj->bi", mount, x) for x in (forward, up, translation))
        rotation = np.einsum("bij,bjk,blk->bil", mount, rotation, mount)
    return {
        "rays0": rays0,
        "rays1": rays1,
        "forward": forward,
        "up": up,
        "theta": theta,
        "rotation": rotation,
        "translation": translation,
        "outliers": wrong,
    }
