import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.derivatives import assert_derivatives
from tests.solvers.problems import lanes, pose_errors, solve_in_batches
from vojax.solvers import p5pfr
from vojax.solvers._p5pfr import five_of_each

solve_last = jax.jit(jax.vmap(p5pfr, in_axes=-1, out_axes=-1))
DEGENERATE = ["one point", "one pixel", "collinear", "zeros", "nan", "inf"]


def problems(count, seed=0, sigma=0.0, distorted=0.3):
    """Points [count, 5, 3] 2 to 10 units ahead, pixels [count, 5, 2], R, t, focal lengths and distortions.

    f² k is between -`distorted` and 0: at 0.3, a radius of one focal length is seen at 0.77.
    """
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-0.7, 0.7, (count, 5, 2)), np.ones((count, 5, 1))], axis=-1)
    depths = rng.uniform(2.0, 10.0, (count, 5, 1))
    focal = rng.uniform(400.0, 2000.0, count)
    distortion = -distorted * rng.uniform(0.0, 1.0, count) / focal**2
    rotation = Rotation.random(count, rng=rng).as_matrix()
    translation = rng.normal(size=(count, 3)) * 2.0
    points = np.einsum("bji,bnj->bni", rotation, rays * depths - translation[:, None])
    # The radius r of a pixel from that without distortion, ρ = r / (1 + k r²).
    straight = focal[:, None, None] * rays[..., :2]
    square = np.sum(straight**2, axis=-1, keepdims=True)
    pixels = straight * 2.0 / (1.0 + np.sqrt(1.0 - 4.0 * distortion[:, None, None] * square))
    return points, pixels + sigma * rng.normal(size=(count, 5, 2)), rotation, translation, focal, distortion


def solve(points, pixels, dtype):
    return solve_in_batches(solve_last, points, pixels, dtype=dtype)


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
    elif kind == "no focus":
        pixels[:, 1] = pixels[:, 0]
        pixels[:, 2] = pixels[:, 0]
    elif kind == "collinear":
        points[:] = points[:, :1] + (points[:, 1:2] - points[:, :1]) * np.arange(5.0)[:, None]
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


def mixed(seed, count):
    """Random problems, half of them degenerate in one of several ways or absurd."""
    points, pixels, *_ = problems(count, seed)
    kinds = [*DEGENERATE, "two points", "three on a line", "huge", "tiny"]
    for part, kind in zip(np.array_split(np.arange(count // 2), len(kinds)), kinds, strict=True):
        points[part], pixels[part] = spoiled(points[part], pixels[part], kind)
    return points, pixels


def test_finds_the_truth(dtype):
    points, pixels, *truth = problems(4000, 1)
    candidates = solve(points, pixels, dtype)
    assert recall(candidates, *truth, 1e-3 if dtype == jnp.float32 else 1e-6) >= (
        0.996 if dtype == jnp.float32 else 0.999
    )


@pytest.mark.slow
def test_finds_the_truth_in_many_problems(dtype):
    points, pixels, *truth = problems(100_000, 3)
    candidates = solve(points, pixels, dtype)
    assert recall(candidates, *truth, 1e-3 if dtype == jnp.float32 else 1e-6) >= (
        0.997 if dtype == jnp.float32 else 0.9999
    )


def test_finds_what_poselib_finds(x64):
    # Its radial solver gives the first two rows of a pose.
    points, pixels, *_ = problems(500, 4)
    candidates = solve(points, pixels, np.float64)
    found = missed = 0
    for i in range(500):
        lines = [np.array([-v, u, 0.0]) for u, v in pixels[i] / 1000.0]
        theirs = poselib.p5lp_radial(lines, list(points[i]))
        ours = candidates.models.cam_from_world.wxyz_xyz[i][candidates.valid[i]]
        turned = Rotation.from_quat(ours[:, [1, 2, 3, 0]]).as_matrix() if len(ours) else np.zeros((0, 3, 3))
        mine = np.concatenate([turned[:, :2], ours[:, 4:6, None]], axis=2)
        peers = [np.concatenate([pose.R[:2], pose.t[:2, None]], axis=1) for pose in theirs]
        for row in mine:
            near = min((min(np.abs(row - q).max(), np.abs(row + q).max()) for q in peers), default=np.inf)
            found += near < 1e-5 * (1.0 + np.abs(row).max())
            missed += near >= 1e-5 * (1.0 + np.abs(row).max())
    assert found > 500
    assert missed <= 2


def test_without_distortion(x64):
    points, pixels, *truth = problems(1000, 5, distorted=0.0)
    assert recall(solve(points, pixels, np.float64), *truth, 1e-6) >= 0.999


def test_moves_smoothly_with_noise(x64):
    medians = []
    for sigma in (1e-5, 1e-4):
        points, pixels, *truth = problems(500, 6, sigma=sigma)
        candidates = solve(points, pixels, np.float64)
        errors = np.abs(candidates.models.focal / truth[2][:, None] - 1.0)
        medians.append(np.median(np.where(candidates.valid, errors, np.inf).min(axis=1)))
    np.testing.assert_allclose(medians[1] / medians[0], 10.0, rtol=0.1)


@pytest.mark.parametrize("kind", DEGENERATE)
def test_impossible_problems_have_no_valid_slot(dtype, kind):
    points, pixels, *_ = problems(64, 9)
    candidates = solve(*spoiled(points, pixels, kind), dtype)
    assert not candidates.valid.any()
    assert (candidates.models.focal == 1.0).all()
    np.testing.assert_array_equal(candidates.models.cam_from_world.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (64, 4, 7)))


def test_nothing_is_infinite(dtype):
    candidates = solve(*mixed(8, 2000), dtype)
    for x in jax.tree.leaves(candidates.models):
        assert np.isfinite(x).all()
    assert (candidates.models.focal[~candidates.valid] == 1.0).all()
    assert (candidates.models.focal > 0).all()


@pytest.mark.slow
def test_nothing_is_ever_infinite(dtype):
    for seed in range(8):
        for x in jax.tree.leaves(solve(*mixed(seed, 125_000), dtype).models):
            assert np.isfinite(x).all()


def test_gradients_equal_central_differences(x64):
    # Pixels of the order of one, so that the distortion is too.
    points, pixels, *_ = problems(1, 11, sigma=1.0)
    assert_derivatives(p5pfr, solve_last, (points[0], pixels[0] / 1000.0))


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    data = mixed(12, 2048)

    def total(points, pixels):
        models = p5pfr(points, pixels).models
        return jnp.sum(models.cam_from_world.wxyz_xyz) + jnp.sum(models.focal) + jnp.sum(models.distortion)

    for part in jax.jit(jax.vmap(jax.grad(total, (0, 1)), -1, -1))(*lanes(*data, dtype=np.float32)):
        assert np.isfinite(part).all()


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="expected five of each"):
        five_of_each(jnp.zeros((4, 3)), jnp.zeros((4, 2)))
