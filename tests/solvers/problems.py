"""Random problems with known answers, in numpy and float64."""

import jax
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


def relative_pose_problems(count, n, seed=0, planar=False):
    """Unit bearings [count, n, 3] in both views, rotations and unit translations of cam1_from_cam0.

    Depths are 2.5 to 10 baselines in view 0, rotations about half a radian in any direction; all points are in front
    of both cameras. `planar` puts the points of a problem on one plane.
    """
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.normal(size=(count, 3)) * 0.2).as_matrix()
    translation = rng.normal(size=(count, 3))
    translation /= np.linalg.norm(translation, axis=-1, keepdims=True)
    rays = np.concatenate([rng.uniform(-0.7, 0.7, (count, n, 2)), np.ones((count, n, 1))], axis=-1)
    depths = rng.uniform(2.5, 10.0, (count, n, 1))
    if planar:
        normal = np.concatenate([rng.uniform(-0.5, 0.5, (count, 1, 2)), np.ones((count, 1, 1))], axis=-1)
        depths = rng.uniform(4.0, 8.0, (count, 1, 1)) / np.sum(rays * normal, axis=-1, keepdims=True)
    points0 = rays * depths
    points1 = np.einsum("bij,bnj->bni", rotation, points0) + translation[:, None]
    unit = [points / np.linalg.norm(points, axis=-1, keepdims=True) for points in (points0, points1)]
    return unit[0], unit[1], rotation, translation


def essential_matrices(rotation, translation):
    """[t]× R, scaled to norm 1 with its largest entry positive, as vojax returns it."""
    cross = np.cross(np.eye(3), translation[..., None, :])  # row i is e_i × t; minus its transpose is [t]×
    return unit_matrices(np.einsum("...ij,...jk->...ik", np.swapaxes(cross, -1, -2), rotation))


def unit_matrices(matrices):
    """Frobenius norm 1, entry of largest magnitude positive."""
    flat = matrices.reshape(*matrices.shape[:-2], 9)
    largest = np.take_along_axis(flat, np.abs(flat).argmax(axis=-1)[..., None], axis=-1)
    return (flat / (np.linalg.norm(flat, axis=-1, keepdims=True) * np.sign(largest))).reshape(matrices.shape)


def matrix_recall(candidates, truth, threshold):
    """Fraction of problems [count, ...] whose true matrix, up to scale and sign, is among the valid candidates."""
    models = np.asarray(candidates.models, np.float64)
    inner = np.sum(models * truth[:, None], axis=(-1, -2), keepdims=True)
    errors = np.linalg.norm(models - np.where(inner < 0, -1.0, 1.0) * truth[:, None], axis=(-1, -2))
    return (np.where(np.asarray(candidates.valid), errors, np.inf).min(axis=-1) < threshold).mean()


def solve_in_batches(solve_last, *arrays, dtype, size=2048):
    """Candidates, batch on the first axis, from a solver jitted with it on the last, in batches of one size.

    One shape, one compilation. The last batch is filled up with zeros, whose answers are cut off.
    """
    results = []
    for start in range(0, len(arrays[0]), size):
        parts = [x[start : start + size] for x in arrays]
        count = len(parts[0])
        padded = [np.concatenate([x, np.zeros((size - count, *x.shape[1:]))]) for x in parts]
        candidates = solve_last(*lanes(*padded, dtype=dtype))
        results.append(jax.tree.map(lambda x, n=count: np.moveaxis(np.asarray(x), -1, 0)[:n], candidates))
    return jax.tree.map(lambda *x: np.concatenate(x), *results)
