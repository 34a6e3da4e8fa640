"""Which model explains two views: general scenes, planes and turns, with wrong matches among them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.spatial.transform import Rotation

from vojax import Result
from vojax.cameras import Pinhole
from vojax.geometry import decompose_homography
from vojax.metrics import nees
from vojax.robust import TwoViewModel, select_two_view_model

B, N = 24, 200
FOCAL, MIDDLE, SIZE = 800.0, np.array([639.5, 479.5]), np.array([1280.0, 960.0])
CAMERA = Pinhole(fx=FOCAL, fy=FOCAL, cx=MIDDLE[0], cy=MIDDLE[1])
CODES = {"general": TwoViewModel.general, "planar": TwoViewModel.planar, "rotation": TwoViewModel.rotation}


# Not jitted as a whole: its three estimates are programs of their own.
select = jax.vmap(lambda key, pixels0, pixels1: select_two_view_model(pixels0, pixels1, CAMERA, CAMERA, key=key))


def solve(pixels0, pixels1, seed=0):
    return select(jax.random.split(jax.random.key(seed), B), jnp.float32(pixels0), jnp.float32(pixels1))


def scenes(seed, kinds, wrong=0.3, sigma_px=1.0, off_plane=0.0):
    """Matches of B scenes, the rotations and translations; `off_plane` is the share that does not lie on a plane."""
    rng = np.random.default_rng(seed)
    pixels0 = rng.uniform(0, SIZE, (B, N, 2))
    rays = np.concatenate([(pixels0 - MIDDLE) / FOCAL, np.ones((B, N, 1))], axis=-1)
    axes = rng.normal(size=(B, 3))
    turns = axes / np.linalg.norm(axes, axis=1, keepdims=True) * rng.uniform(0, 0.3, (B, 1))
    rotations = Rotation.from_rotvec(turns).as_matrix()
    translations = rng.normal(size=(B, 3))
    translations /= np.linalg.norm(translations, axis=1, keepdims=True)
    kinds = np.asarray(kinds)
    translations[kinds == "rotation"] = 0
    normals = np.concatenate([rng.uniform(-0.5, 0.5, (B, 2)), np.ones((B, 1))], axis=1)
    on_plane = rng.uniform(5, 12, (B, 1)) / np.einsum("bi,bni->bn", normals, rays)
    order = np.arange(N)
    flat = (kinds == "planar")[:, None] & (order[None] >= round(off_plane * N))
    depths = np.where(flat, on_plane, rng.uniform(4, 20, (B, N)))
    moved = np.einsum("bij,bnj->bni", rotations, rays * depths[..., None]) + translations[:, None]
    pixels1 = moved[..., :2] / moved[..., 2:] * FOCAL + MIDDLE
    bad = rng.permuted(np.tile(order < round(wrong * N), (B, 1)), axis=1)
    pixels0, pixels1 = (x + sigma_px * rng.normal(size=x.shape) for x in (pixels0, pixels1))
    pixels1 = np.where(bad[..., None], rng.uniform(0, SIZE, pixels1.shape), pixels1)
    return pixels0, pixels1, rotations, translations


def right(found, kinds):
    return np.array([bool((found.model == CODES[kind])[i]) for i, kind in enumerate(kinds)])


MIXED = (list(CODES) * B)[:B]


@pytest.fixture(scope="module")
def mixed():
    pixels0, pixels1, rotations, translations = scenes(0, MIXED)
    return solve(pixels0, pixels1), rotations, translations


def degrees(cosines):
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))


@pytest.mark.slow
def test_scenes_planes_and_turns_are_told_apart(mixed):
    found, _, _ = mixed
    assert right(found, MIXED).mean() >= 0.95
    assert np.isfinite(found.criterion).all()
    # One pixel of noise, measured with five parameters fitted to the inliers.
    np.testing.assert_allclose(found.sigma_px, 1.0, atol=0.3)
    assert abs(np.median(found.sigma_px) - 1.0) < 0.05


@pytest.mark.slow
def test_each_estimate_is_that_of_its_scene(mixed):
    found, rotations, translations = mixed
    kinds = np.array(MIXED)
    turned = np.asarray(found.rotation.model.as_matrix(), np.float64)
    angle = degrees((np.einsum("bij,bij->b", turned, rotations) - 1) / 2)
    assert angle[kinds == "rotation"].max() < 0.1
    moved = kinds != "rotation"
    cosine = np.sum(np.asarray(found.relative_pose.model.translation()) * translations, axis=1)
    assert np.median(degrees(cosine[moved])) < 2.0
    # One of the decompositions of a plane's homography is its motion.
    motions = jax.vmap(decompose_homography)(found.homography.model)
    candidates = np.asarray(motions.cam1_from_cam0.as_matrix(), np.float64)
    direction = candidates[..., :3, 3] / np.linalg.norm(candidates[..., :3, 3], axis=-1, keepdims=True)
    best = np.max(np.einsum("bsi,bi->bs", direction, translations), axis=1)
    assert np.median(degrees(best[kinds == "planar"])) < 2.0


def test_a_view_of_nothing_has_no_model():
    rng = np.random.default_rng(1)
    pixels0, pixels1 = (rng.uniform(0, SIZE, (B, N, 2)) for _ in range(2))
    pixels0[0] = np.nan
    found = solve(pixels0, pixels1)
    nothing = np.asarray(found.model == TwoViewModel.none)
    assert nothing[0]
    assert nothing.mean() > 0.9
    for leaf in jax.tree.leaves((found.relative_pose.model, found.homography, found.rotation, found.sigma_px)):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.isfinite(leaf).all()
    assert not np.isnan(found.criterion).any()


def test_relative_pose_stands_when_most_matches_are_on_a_plane():
    pixels0, pixels1, rotations, translations = scenes(2, ["planar"] * B, wrong=0.2, sigma_px=0.5, off_plane=0.1)
    pose = solve(pixels0, pixels1).relative_pose
    assert np.all(pose.result == Result.success)
    matrices = np.asarray(pose.model.as_matrix(), np.float64)
    angle = degrees((np.einsum("bij,bij->b", matrices[:, :3, :3], rotations) - 1) / 2)
    direction = degrees(np.sum(matrices[:, :3, 3] * translations, axis=1))
    assert np.median(angle) < 0.3
    assert np.median(direction) < 1.5
    assert np.mean(direction < 10.0) > 0.9


def test_errors_of_rotations_follow_the_covariance():
    values = []
    for seed in range(4):
        pixels0, pixels1, rotations, _ = scenes(10 + seed, ["rotation"] * B, wrong=0.0)
        found = solve(pixels0, pixels1, seed).rotation
        estimated = np.asarray(found.model.as_matrix(), np.float64)
        # truth = exp(−φ) @ model
        phi = Rotation.from_matrix(estimated @ np.swapaxes(rotations, 1, 2)).as_rotvec()
        values.append(np.asarray(nees(jnp.float32(phi), found.covariance)))
    values = np.concatenate(values)
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 3 * len(values)) / len(values)
    assert low < values.mean() < high


def test_wrong_shapes_are_said_in_one_line():
    few, pixels = np.ones((4, 2), np.float32), np.ones((8, 2), np.float32)
    for views, more in (((few, few), {}), ((pixels, pixels), {"sigma_px": 0.0})):
        with pytest.raises(ValueError, match=r"expected|needs") as caught:
            select_two_view_model(*views, CAMERA, CAMERA, key=jax.random.key(0), **more)
        assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("sigma_px", [0.5, 1.0])
@pytest.mark.parametrize("kind", list(CODES))
def test_choices_are_right(kind, sigma_px):
    """216 problems of each kind and noise, 30 % of the matches wrong."""
    correct = []
    for seed in range(9):
        pixels0, pixels1, *_ = scenes(100 + seed, [kind] * B, sigma_px=sigma_px)
        correct.append(right(solve(pixels0, pixels1, seed), [kind] * B))
    assert np.mean(correct) >= 0.95
