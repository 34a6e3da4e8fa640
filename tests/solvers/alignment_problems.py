"""Point sets in two frames with known motions, and ways to spoil them."""

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from tests.solvers.problems import central_differences

SPOILED = ["collinear", "equal points", "one point", "zeros", "nan", "inf"]


def alignment_problems(count, n, noise=0.0, seed=0, dim=3):
    """Points [count, n, dim] in two frames, and the motions [count, dim, dim], [count, dim]."""
    rng = np.random.default_rng(seed)
    points0 = rng.normal(size=(count, n, dim))
    if dim == 3:
        rotation = Rotation.random(count, rng=rng).as_matrix()
    else:
        angle = rng.uniform(-np.pi, np.pi, count)
        rotation = np.moveaxis(np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]), -1, 0)
    translation = rng.normal(size=(count, dim)) * 3.0
    points1 = np.einsum("bij,bnj->bni", rotation, points0) + translation[:, None]
    return points0, points1 + noise * rng.normal(size=points0.shape), rotation, translation


def spoiled(points0, points1, kind):
    """The same problems made degenerate in one way."""
    points0, points1 = points0.copy(), points1.copy()
    steps = np.linspace(-1.0, 1.0, points0.shape[1])[None, :, None] ** 3
    if kind == "collinear":
        points0, points1 = (p[:, :1] + steps * (p[:, 1:2] - p[:, :1]) for p in (points0, points1))
    elif kind == "collinear in one":
        points1 = points1[:, :1] + steps * (points1[:, 1:2] - points1[:, :1])
    elif kind == "equal points":
        points0[:, 1:], points1[:, 1:] = points0[:, 1:2], points1[:, 1:2]
    elif kind == "one point":
        points0[:], points1[:] = points0[:, :1], points1[:, :1]
    elif kind == "zeros":
        points0[:], points1[:] = 0.0, 0.0
    elif kind == "nan":
        points0[:, 2, 1] = np.nan
    elif kind == "inf":
        points1[:, 1, 0] = np.inf
    elif kind == "huge":
        points0, points1 = points0 * 1e30, points1 * 1e30
    elif kind == "tiny":
        points0, points1 = points0 * 1e-30, points1 * 1e-30
    elif kind == "mirror":
        points1 = -points0
    return points0, points1


def mixed(seed, count, n, dim=3):
    """Random problems, half of them degenerate in one of several ways or absurd."""
    points0, points1, *_ = alignment_problems(count, n, 0.1, seed, dim)
    kinds = [*SPOILED, "collinear in one", "huge", "tiny", "mirror"]
    for part, kind in zip(np.array_split(np.arange(count // 2), len(kinds)), kinds, strict=True):
        points0[part], points1[part] = spoiled(points0[part], points1[part], kind)
    return points0, points1


def pose_matrices(poses):
    """Matrices [..., 4, 4] of poses (w, x, y, z, tx, ty, tz)."""
    poses = np.asarray(poses, np.float64)
    matrices = np.zeros((*poses.shape[:-1], 4, 4))
    flat = poses[..., [1, 2, 3, 0]].reshape(-1, 4)
    matrices[..., :3, :3] = Rotation.from_quat(flat).as_matrix().reshape(*poses.shape[:-1], 3, 3)
    matrices[..., :3, 3], matrices[..., 3, 3] = poses[..., 4:], 1.0
    return matrices


def check_gradients(function, problems, used=None, rtol=1e-6, step=1e-6):
    """Reverse and forward derivatives of a scalar function of arrays against central differences, in float64."""
    used = tuple(range(len(problems[0]))) if used is None else used

    def derivatives(data, tangents):
        def of_used(*parts):
            arguments = list(data)
            for index, part in zip(used, parts, strict=True):
                arguments[index] = part
            return function(*arguments)

        along = jax.jvp(of_used, tuple(data[i] for i in used), tangents)[1]
        return jax.grad(function, used)(*data), along

    value, derivatives = jax.jit(function), jax.jit(derivatives)
    rng = np.random.default_rng(0)
    for data in problems:
        tangents = tuple(rng.normal(size=data[i].shape) for i in used)
        reverse, forward = derivatives(data, tangents)
        total, largest = 0.0, 0.0
        for index, back, tangent in zip(used, reverse, tangents, strict=True):
            numeric = central_differences(value, data, index, step)
            largest = max(largest, np.abs(numeric).max())
            np.testing.assert_allclose(back, numeric, rtol=rtol, atol=max(rtol * np.abs(numeric).max(), 1e-9))
            total += np.sum(np.asarray(back) * tangent)
        np.testing.assert_allclose(forward, total, rtol=1e-8, atol=1e-10)
        assert largest > 0
