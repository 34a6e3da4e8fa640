"""Random problems of two cameras that know the vertical, in numpy and float64."""

import jax
import jax.numpy as jnp
import numpy as np
import poselib
from scipy.spatial.transform import Rotation

from tests.solvers.problems import central_differences, lanes, pose_errors


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def upright_problems(count, n, seed=0, planar=False, any_turn=False, distance=1.0, level=False):
    """Unit bearings [count, n, 3] in both views and verticals [count, 3]; rotations and translations of cam1_from_cam0.

    Depths are 2.5 to 10 baselines times `distance`; turns about a third of a radian, or any, with points all around.
    Both cameras are mounted at random, unless `level`: then the vertical is (0, -1, 0) in both.
    """
    rng = np.random.default_rng(seed)
    theta = rng.uniform(-np.pi, np.pi, count) if any_turn else rng.normal(size=count) * 0.3
    rotation = Rotation.from_rotvec(theta[:, None] * np.array([0.0, 1.0, 0.0])).as_matrix()
    translation = unit(rng.normal(size=(count, 3)) * (np.array([1.0, 0.0, 1.0]) if planar else 1.0))
    if any_turn:
        points = unit(rng.normal(size=(count, n, 3))) * rng.uniform(2.5, 10.0, (count, n, 1))
    else:
        points = np.concatenate([rng.uniform(-0.7, 0.7, (count, n, 2)), np.ones((count, n, 1))], axis=-1)
        points = points * rng.uniform(2.5, 10.0, (count, n, 1)) * distance
    rays0, rays1 = unit(points), unit(np.einsum("bij,bnj->bni", rotation, points) + translation[:, None])
    up0 = up1 = np.tile([0.0, -1.0, 0.0], (count, 1))
    if not level:
        mount0, mount1 = (Rotation.random(count, rng=rng).as_matrix() for _ in range(2))
        rays0, rays1 = np.einsum("bij,bnj->bni", mount0, rays0), np.einsum("bij,bnj->bni", mount1, rays1)
        up0, up1 = np.einsum("bij,bj->bi", mount0, up0), np.einsum("bij,bj->bi", mount1, up1)
        rotation = np.einsum("bij,bjk,blk->bil", mount1, rotation, mount0)
        translation = np.einsum("bij,bj->bi", mount1, translation)
    return (rays0, rays1, up0, up1), rotation, translation


def mixed(data, seed):
    """Problems of which half are degenerate in one of several ways or absurd."""
    rays0, rays1, up0, up1 = (x.copy() for x in data)
    count, n = rays0.shape[:2]
    rng = np.random.default_rng(seed)
    kinds = np.array_split(rng.permutation(count)[: count // 2], 13)
    rays0[kinds[0], 1], rays1[kinds[0], 1] = 2.0 * rays0[kinds[0], 0], 3.0 * rays1[kinds[0], 0]
    rays0[kinds[1]], rays1[kinds[1]] = rays0[kinds[1], :1], rays1[kinds[1], :1]
    rays1[kinds[2]], up1[kinds[2]] = rays0[kinds[2]], up0[kinds[2]]
    rays1[kinds[3]], up1[kinds[3]] = -rays0[kinds[3]], up0[kinds[3]]
    rays0[kinds[4], 0] = 0.0
    up0[kinds[5]] = 0.0
    rays0[kinds[6], 0], rays1[kinds[6], 0] = up0[kinds[6]], up1[kinds[6]]
    for rays, up in ((rays0, up0), (rays1, up1)):
        level = rays[kinds[7]] - np.sum(rays[kinds[7]] * up[kinds[7], None], -1, keepdims=True) * up[kinds[7], None]
        rays[kinds[7]] = level
    rays0[kinds[8], n - 1, 0] = np.nan
    rays1[kinds[9], 0, 1] = np.inf
    up1[kinds[10], 2] = np.nan
    for kind, size in ((kinds[11], 1e30), (kinds[12], 1e-30)):
        rays0[kind] *= size
        up1[kind] *= size
    return rays0, rays1, up0, up1


def equation_errors(models, data):
    """Largest of the epipolar error, the tilt and | |t| - 1 | of poses [count, s, 7]; and the least distance."""
    rays0, rays1, up0, up1 = data
    models = np.asarray(models, np.float64)
    shape = models.shape[:2]
    rotation = Rotation.from_quat(models[..., [1, 2, 3, 0]].reshape(-1, 4)).as_matrix().reshape(*shape, 3, 3)
    t = models[..., None, 4:]
    turned = np.einsum("bsij,bnj->bsni", rotation, rays0)
    normal = np.cross(turned, rays1[:, None])
    epipolar = np.abs(np.sum(normal * t, axis=-1)).max(axis=-1)
    tilt = np.linalg.norm(np.einsum("bsij,bj->bsi", rotation, up0) - up1[:, None], axis=-1)
    length = np.abs(np.linalg.norm(t[..., 0, :], axis=-1) - 1.0)
    distance0 = -np.sum(np.cross(t, rays1[:, None]) * normal, axis=-1)
    distance1 = -np.sum(np.cross(t, turned) * normal, axis=-1)
    climb = np.abs(np.sum(models[..., 4:] * up1[:, None], axis=-1))
    return np.maximum(np.maximum(epipolar, tilt), length), climb, np.minimum(distance0, distance1).min(axis=-1)


def compare_with_poselib(candidates, data, solver, tolerance):
    """How many poses both found, only PoseLib and only we; verticals along y.

    PoseLib returns poses with points behind the cameras too: those do not count.
    """
    both = only_poselib = only_ours = 0
    for i in range(len(data[0])):
        ours = np.asarray(candidates.models.wxyz_xyz[i][candidates.valid[i]])
        theirs = np.array([[*pose.q, *pose.t] for pose in solver(data[0][i], data[1][i])]).reshape(-1, 7)
        theirs[:, 4:] = unit(theirs[:, 4:])
        theirs = theirs[equation_errors(theirs[None], [x[i : i + 1] for x in data])[2][0] > 0]
        ours, theirs = (
            np.concatenate([Rotation.from_quat(x[:, [1, 2, 3, 0]]).as_matrix().reshape(-1, 9), x[:, 4:]], axis=1)
            if len(x)
            else np.zeros((0, 12))
            for x in (ours, theirs)
        )
        distance = np.abs(ours[:, None] - theirs[None]).max(axis=-1)
        both += np.sum(distance.min(axis=0, initial=np.inf) < tolerance)
        only_poselib += np.sum(distance.min(axis=0, initial=np.inf) >= tolerance)
        only_ours += np.sum(distance.min(axis=1, initial=np.inf) >= tolerance)
    return both, only_poselib, only_ours


def least_errors(candidates, rotation, translation):
    """Error of the valid candidate nearest to the truth."""
    errors = pose_errors(candidates.models.wxyz_xyz, rotation, translation)
    return np.where(np.asarray(candidates.valid), errors, np.inf).min(axis=-1)


def check_gradients(solver, data, count):
    """Forward, reverse and central differences of a weighted sum of all poses agree for `count` problems."""

    def function(*data):
        candidates = solver(*data)
        parameters = candidates.models.wxyz_xyz
        factors = jnp.arange(1.0, 1.0 + parameters.size).reshape(parameters.shape) / parameters.size
        return jnp.sum(jnp.where(candidates.valid[:, None], parameters, 0.0) * factors)

    value = jax.jit(function)
    reverse = jax.jit(jax.grad(function, range(len(data))))
    forward = jax.jit(jax.jacfwd(function, range(len(data))))
    checked = 0
    for i in range(len(data[0])):
        one = [x[i] for x in data]
        of_reverse = reverse(*one)
        # Central differences err by the cube of the conditioning: take moderate problems, as many as asked for.
        size = max(np.abs(x).max() for x in of_reverse)
        if checked == count or not 0.1 < size < 20.0:
            continue
        checked += 1
        for index, (back, ahead) in enumerate(zip(of_reverse, forward(*one), strict=True)):
            numeric = central_differences(value, one, index)
            np.testing.assert_allclose(back, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max() + 1e-8)
            np.testing.assert_allclose(ahead, back, rtol=1e-9, atol=1e-10 * size)
    assert checked == count


def check_finite_gradients(solver, data, dtype):
    """Reverse derivatives of all slots, valid or not, are finite."""
    gradient = jax.jit(
        jax.vmap(jax.grad(lambda *data: jnp.sum(solver(*data).models.wxyz_xyz), range(len(data))), -1, -1)
    )
    for part in gradient(*lanes(*data, dtype=dtype)):
        assert np.isfinite(part).all()


POSELIB = {3: poselib.relpose_upright_3pt, 2: poselib.relpose_upright_planar_2pt}
