"""Errors and scores of given models, against OpenCV, numpy and the estimators themselves."""

import functools

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3, SO3, Sim3
from vojax.cameras import Pinhole, Rig
from vojax.geometry import essential_from_pose
from vojax.robust import (
    GaussianUniformScore,
    InlierCount,
    Msac,
    estimate_absolute_pose,
    estimate_fundamental,
    estimate_generalized_pose,
    estimate_homography,
    estimate_relative_pose,
    estimate_rigid,
    estimate_similarity,
    score_hypotheses,
    squared_errors,
)

K, N = 5, 30
CAMERA = Pinhole(fx=500.0, fy=510.0, cx=320.0, cy=240.0)
MATRIX = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])


def homogeneous(x):
    return np.concatenate([x, np.ones_like(x[:, :1])], axis=1)


def numbers():
    """Points before the cameras, K motions near the identity, and what two views see, with errors of some pixels."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-2, 2, (N, 2)), rng.uniform(4, 9, (N, 1))], axis=1)
    twists = np.concatenate([rng.uniform(-0.2, 0.2, (K, 3)), rng.uniform(-0.02, 0.02, (K, 3))], axis=1)
    poses = jax.vmap(SE3.exp)(jnp.float32(twists))
    pixels0 = points @ MATRIX.T
    pixels0 = pixels0[:, :2] / pixels0[:, 2:]
    pixels1 = pixels0 + rng.normal(size=(N, 2)) * 4.0
    return points, pixels0, pixels1, poses


def sampson_of_homographies(matrices, pixels0, pixels1):
    """δᵀ (G Gᵀ)⁻¹ δ with numeric derivatives."""

    def delta(matrix, p):
        x, y, w = matrix @ np.array([p[0], p[1], 1.0])
        return np.array([p[2] * w - x, p[3] * w - y])

    out = np.zeros((len(matrices), len(pixels0)))
    for i, matrix in enumerate(matrices):
        for j, p in enumerate(np.concatenate([pixels0, pixels1], axis=1)):
            g = np.stack([(delta(matrix, p + e) - delta(matrix, p - e)) / 2e-3 for e in 1e-3 * np.eye(4)], axis=1)
            d = delta(matrix, p)
            out[i, j] = d @ np.linalg.solve(g @ g.T, d)
    return out


def cases():
    points, pixels0, pixels1, poses = numbers()
    matrices = np.asarray(poses.as_matrix(), np.float64)
    moved = np.einsum("kij,nj->kni", matrices[:, :3], homogeneous(points))
    turned = [cv2.projectPoints(points, cv2.Rodrigues(m[:3, :3])[0], m[:3, 3], MATRIX, None)[0][:, 0] for m in matrices]
    reprojected = np.sum((np.stack(turned) - pixels1) ** 2, axis=-1)

    second = np.array([0.5, 0.0, 0.0])  # camera 1 sits half a unit along x
    index = np.arange(N) % 2
    in_camera = moved - second * index[:, None]
    seen = in_camera @ MATRIX.T
    rig = Rig((CAMERA, CAMERA), SE3(jnp.float32([[1, 0, 0, 0, 0, 0, 0], [1, 0, 0, 0, -0.5, 0, 0]])))
    in_rig = np.sum((seen[..., :2] / seen[..., 2:] - pixels1) ** 2, axis=-1)

    skew = lambda t: np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])  # noqa: E731
    inverse = np.linalg.inv(MATRIX)
    fundamental = np.stack([inverse.T @ skew(m[:3, 3]) @ m[:3, :3] @ inverse for m in matrices])
    sampson = np.array(
        [
            [cv2.sampsonDistance(b, a, f) for a, b in zip(homogeneous(pixels0), homogeneous(pixels1), strict=True)]
            for f in fundamental.transpose(0, 2, 1)
        ]
    )
    planar = np.stack([MATRIX @ m[:3, :3] @ inverse for m in matrices])
    scaled = Sim3(jnp.concatenate([poses.wxyz_xyz, jnp.full((K, 1), 1.1)], axis=1))
    grown = 1.1 * np.einsum("kij,nj->kni", matrices[:, :3, :3], points) + matrices[:, None, :3, 3]
    target = points + 0.1
    p, q0, q1 = jnp.float32(points), jnp.float32(pixels0), jnp.float32(pixels1)
    return {
        "absolute": (estimate_absolute_pose, poses, (p, q1, CAMERA), reprojected),
        "generalized": (estimate_generalized_pose, poses, (p, q1, jnp.int32(index), rig), in_rig),
        "relative": (estimate_relative_pose, poses, (q0, q1, CAMERA, CAMERA), sampson),
        "essential": (
            estimate_relative_pose,
            jax.vmap(essential_from_pose)(poses),
            (q0, q1, CAMERA, CAMERA),
            sampson,
        ),
        "fundamental": (estimate_fundamental, jnp.float32(1e3 * fundamental), (q0, q1), sampson),
        "homography": (
            estimate_homography,
            jnp.float32(planar),
            (q0, q1),
            sampson_of_homographies(planar, pixels0, pixels1),
        ),
        "rigid": (estimate_rigid, poses, (p, jnp.float32(target)), np.sum((moved - target) ** 2, axis=-1)),
        "similarity": (estimate_similarity, scaled, (p, jnp.float32(target)), np.sum((grown - target) ** 2, axis=-1)),
    }


CASES = cases()


@pytest.mark.parametrize("name", list(CASES))
def test_errors_are_those_of_the_oracle(name):
    estimator, models, observations, expected = CASES[name]
    found = jax.jit(jax.vmap(lambda model: squared_errors(estimator, model, *observations)))(models)
    # Small squares are differences of pixels of some hundreds in float32.
    np.testing.assert_allclose(np.sqrt(found), np.sqrt(expected), rtol=2e-4, atol=2e-3)


@pytest.mark.parametrize("name", list(CASES))
def test_scores_are_sums_over_observations(name):
    estimator, models, observations, expected = CASES[name]
    mask = np.arange(N) < 24
    middle = float(np.sqrt(np.median(expected)))
    kept = expected[:, mask]
    wanted = [
        (Msac(jnp.float32(middle)), np.minimum(kept / middle**2, 1.0)),
        (
            GaussianUniformScore(jnp.float32(middle), 2.0),
            np.log((1 + np.exp(-2.0)) / (np.exp(-0.5 * kept / middle**2) + np.exp(-2.0))),
        ),
    ]
    for score, losses in wanted:
        found = score_hypotheses(estimator, models, *observations, score=score, mask=jnp.asarray(mask))
        np.testing.assert_allclose(found, losses.sum(axis=1), rtol=2e-3)
    counts = score_hypotheses(
        estimator, models, *observations, score=InlierCount(jnp.float32(middle)), mask=jnp.asarray(mask)
    )
    np.testing.assert_allclose(-counts, (kept <= middle**2).sum(axis=1), atol=1)


def test_what_is_impossible_or_not_finite_is_infinitely_wrong():
    points, _, pixels1, poses = numbers()
    points[0, 2], pixels1[1] = -5.0, np.nan
    errors = squared_errors(estimate_absolute_pose, SE3(poses.wxyz_xyz[0]), jnp.float32(points), pixels1, CAMERA)
    assert np.isinf(errors[:2]).all()
    assert np.isfinite(errors[2:]).all()
    broken = SE3(poses.wxyz_xyz.at[1].set(jnp.nan))
    scores = score_hypotheses(
        estimate_absolute_pose, broken, jnp.float32(points), jnp.float32(pixels1), CAMERA, score=Msac(3.0)
    )
    # The row that is not finite counts as masked, and a pose that is not finite explains nothing.
    assert scores[1] == N - 1
    assert np.isfinite(scores).all()


@pytest.mark.slow
@pytest.mark.parametrize("score", [Msac(8.0), GaussianUniformScore(4.0)])
def test_derivatives_equal_central_differences(score, x64):
    points, _, pixels1, poses = numbers()
    points[0, 2] = -5.0  # behind the camera: no derivative, and no NaN
    points, pixels1 = jnp.asarray(points), jnp.asarray(pixels1)
    poses = SE3(poses.wxyz_xyz.astype(jnp.float64))
    camera = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), CAMERA)

    def total(pixels, shift):
        moved = jax.vmap(lambda pose: SE3.exp(jnp.concatenate([shift, jnp.zeros(3)])) @ pose)(poses)
        return jnp.sum(score_hypotheses(estimate_absolute_pose, moved, points, pixels, camera, score=score))

    shift = jnp.zeros(3)
    gradient = jax.grad(total, argnums=(0, 1))(pixels1, shift)
    rng = np.random.default_rng(3)
    directions = rng.normal(size=pixels1.shape), rng.normal(size=3)
    step = 1e-6
    ahead, behind = (total(pixels1 + s * directions[0], shift + s * directions[1]) for s in (step, -step))
    along = sum(np.sum(g * d) for g, d in zip(gradient, directions, strict=True))
    np.testing.assert_allclose(along, (ahead - behind) / (2 * step), rtol=1e-5)


def test_bad_arguments_are_said_in_one_line():
    points, pixels0, pixels1, poses = numbers()
    score = functools.partial(score_hypotheses, score=Msac(3.0))
    wrong = [
        lambda: score(len, poses, points, pixels1, CAMERA),
        lambda: score(estimate_absolute_pose, poses, points, pixels1[:-1], CAMERA),
        lambda: score(estimate_homography, np.ones((K, 3, 3)), pixels0, pixels1, mask=np.ones(N + 1, bool)),
        lambda: Msac(0.0),
        lambda: InlierCount(-1.0),
        lambda: GaussianUniformScore(0.0),
        lambda: GaussianUniformScore(1.0, cut=float("nan")),
    ]
    for call in wrong:
        with pytest.raises(ValueError, match="expected") as caught:
            call()
        assert "\n" not in str(caught.value)


def test_a_rotation_at_the_origin_is_the_identity():
    # Guards the order of rotation and translation in the entries: turning about z by a quarter.
    turn = SE3.from_rotation_and_translation(SO3.exp(jnp.array([0.0, 0.0, jnp.pi / 2])), jnp.array([1.0, 0.0, 0.0]))
    error = squared_errors(estimate_rigid, turn, jnp.array([[1.0, 0.0, 0.0]]), jnp.array([[1.0, 1.0, 0.0]]))
    assert float(error[0]) < 1e-10
