"""Random problems with known answers, in numpy and float64."""

import numpy as np
from scipy.spatial.transform import Rotation


def absolute_pose_problems(count, seed=0):
    """Points [count, 3, 3], unit bearings [count, 3, 3], rotations and translations of cam_from_world."""
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-0.7, 0.7, (count, 3, 2)), np.ones((count, 3, 1))], axis=-1)
    bearings = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    points_cam = bearings * rng.uniform(1.0, 10.0, (count, 3, 1))
    rotation = Rotation.random(count, rng=rng).as_matrix()
    translation = rng.normal(size=(count, 3)) * 2.0
    points_world = np.einsum("bji,bnj->bni", rotation, points_cam - translation[:, None])
    return points_world, bearings, rotation, translation


def pose_errors(parameters, rotation, translation):
    """max(|R - R*|, |t - t*| / |t*|) of poses [count, s, 7] against the truth [count, ...]."""
    parameters = np.asarray(parameters, np.float64)
    shape = parameters.shape[:-1]
    found = Rotation.from_quat(parameters[..., [1, 2, 3, 0]].reshape(-1, 4)).as_matrix().reshape(*shape, 3, 3)
    of_rotation = np.abs(found - rotation[:, None]).max(axis=(-1, -2))
    of_translation = np.linalg.norm(parameters[..., 4:] - translation[:, None], axis=-1)
    return np.maximum(of_rotation, of_translation / np.linalg.norm(translation, axis=-1)[:, None])


def recall(candidates, rotation, translation, threshold):
    """Fraction of problems, batch on the first axis, whose true pose is among the valid candidates."""
    errors = pose_errors(candidates.models.wxyz_xyz, rotation, translation)
    best = np.where(np.asarray(candidates.valid), errors, np.inf).min(axis=-1)
    return (best < threshold).mean()


def lanes(*arrays, dtype):
    """Batch to the last axis."""
    return tuple(np.ascontiguousarray(np.moveaxis(x, 0, -1)).astype(dtype) for x in arrays)


def central_differences(function, arguments, index, step=1e-6):
    """Gradient of a scalar function in one of its array arguments."""
    gradient = np.zeros_like(arguments[index])
    for entry in np.ndindex(gradient.shape):
        ends = []
        for change in (step, -step):
            moved = [x.copy() for x in arguments]
            moved[index][entry] += change
            ends.append(float(function(*moved)))
        gradient[entry] = (ends[0] - ends[1]) / (2.0 * step)
    return gradient
