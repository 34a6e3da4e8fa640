"""Problems of cameras with unknown focal length and radial distortion, and how they are spoiled."""

import numpy as np
from scipy.spatial.transform import Rotation

from tests.solvers.problems import pose_errors

DEGENERATE = ["one point", "one pixel", "collinear", "zeros", "nan", "inf"]


def problems(count, seed=0, sigma=0.0, distorted=0.3, points=5, planar=False):
    """Points [count, points, 3] 2 to 10 units ahead, pixels, R, t, focal lengths and distortions.

    f² k is between -`distorted` and 0: at 0.3, a radius of one focal length is seen at 0.77. Points on a plane are 3.5
    to 20 units ahead.
    """
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-0.7, 0.7, (count, points, 2)), np.ones((count, points, 1))], axis=-1)
    depths = rng.uniform(2.0, 10.0, (count, points, 1))
    if planar:
        slope = rng.uniform(-0.6, 0.6, (count, 1, 2))
        depths = rng.uniform(5.0, 8.0, (count, 1, 1)) / (1.0 + np.sum(slope * rays[..., :2], axis=-1, keepdims=True))
    focal = rng.uniform(400.0, 2000.0, count)
    distortion = -distorted * rng.uniform(0.0, 1.0, count) / focal**2
    rotation = Rotation.random(count, rng=rng).as_matrix()
    translation = rng.normal(size=(count, 3)) * 2.0
    world = np.einsum("bji,bnj->bni", rotation, rays * depths - translation[:, None])
    # The radius r of a pixel from that without distortion, ρ = r / (1 + k r²).
    straight = focal[:, None, None] * rays[..., :2]
    square = np.sum(straight**2, axis=-1, keepdims=True)
    pixels = straight * 2.0 / (1.0 + np.sqrt(1.0 - 4.0 * distortion[:, None, None] * square))
    return world, pixels + sigma * rng.normal(size=pixels.shape), rotation, translation, focal, distortion


def recall(candidates, rotation, translation, focal, distortion, threshold):
    """Share of problems whose true pose, relative focal length and f² k are among the valid candidates."""
    errors = pose_errors(candidates.models.cam_from_world.wxyz_xyz, rotation, translation)
    errors = np.maximum(errors, np.abs(candidates.models.focal / focal[:, None] - 1.0))
    errors = np.maximum(errors, np.abs(candidates.models.distortion - distortion[:, None]) * focal[:, None] ** 2)
    return (np.where(candidates.valid, errors, np.inf).min(axis=1) < threshold).mean()


def spoiled(points, pixels, kind):
    points, pixels = points.copy(), pixels.copy()
    if kind == "one point":
        points[:] = points[:, :1]
    elif kind == "one pixel":
        pixels[:] = pixels[:, :1]
    elif kind == "collinear":
        points[:] = points[:, :1] + (points[:, 1:2] - points[:, :1]) * np.arange(float(points.shape[1]))[:, None]
    elif kind == "zeros":
        points[:], pixels[:] = 0.0, 0.0
    elif kind == "nan":
        points[:, 0, 2] = np.nan
    elif kind == "inf":
        pixels[:, 1, 0] = np.inf
    elif kind == "two points":
        points[:, 1], pixels[:, 1] = points[:, 0], pixels[:, 0]
    elif kind == "three on a line":
        points[:, 2] = 0.3 * points[:, 0] + 0.7 * points[:, 1]
    elif kind == "huge":
        points *= 1e30
    elif kind == "tiny":
        points, pixels = points * 1e-30, pixels * 1e-30
    return points, pixels


def mixed(points, pixels):
    """The problems with half of them degenerate in one of several ways or absurd."""
    points, pixels = points.copy(), pixels.copy()
    kinds = [*DEGENERATE, "two points", "three on a line", "huge", "tiny"]
    for part, kind in zip(np.array_split(np.arange(len(points) // 2), len(kinds)), kinds, strict=True):
        points[part], pixels[part] = spoiled(points[part], pixels[part], kind)
    return points, pixels
