import functools

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from vojax.geometry import HomographyMotion, decompose_homography, metric_translation
from vojax.lie import SE3
from vojax.solvers import homography_dlt

COUNT = 500
decompose = jax.jit(jax.vmap(decompose_homography))
decompose_seen = jax.jit(jax.vmap(decompose_homography))


def motions(seed=0, size=0.3):
    """Rotations, translations over plane distance, normals, homographies of any scale and sign, rays [COUNT, 8, 3]."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.normal(size=(COUNT, 3)) * 0.3).as_matrix()
    translation = rng.normal(size=(COUNT, 3))
    translation *= size * rng.uniform(0.3, 1.0, (COUNT, 1)) / np.linalg.norm(translation, axis=1, keepdims=True)
    normal = np.concatenate([rng.uniform(-0.8, 0.8, (COUNT, 2)), np.ones((COUNT, 1))], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    homography = rotation + translation[:, :, None] * normal[:, None]
    assert (np.linalg.det(homography) > 0).all()
    homography = homography * rng.uniform(0.1, 5.0, (COUNT, 1, 1)) * rng.choice([-1.0, 1.0], (COUNT, 1, 1))
    rays = np.concatenate([rng.uniform(-0.5, 0.5, (COUNT, 8, 2)), np.ones((COUNT, 8, 1))], axis=-1)
    return rotation, translation, normal, homography, rays


def unpacked(motion):
    """Rotations [count, 4, 3, 3], translations, normals in float64."""
    parameters = np.asarray(motion.cam1_from_cam0.wxyz_xyz, np.float64)
    wxyz = parameters[..., :4].reshape(-1, 4)
    rotation = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix().reshape(*parameters.shape[:-1], 3, 3)
    return rotation, parameters[..., 4:], np.asarray(motion.normal, np.float64)


def errors(motion, rotation, translation, normal):
    """Distance of the nearest valid slot to the truth."""
    r, t, n = unpacked(motion)
    distance = np.abs(r - rotation[:, None]).max(axis=(-1, -2))
    distance = np.maximum(distance, np.abs(t - translation[:, None]).max(axis=-1))
    distance = np.maximum(distance, np.abs(n - normal[:, None]).max(axis=-1))
    return np.where(np.asarray(motion.valid), distance, np.inf).min(axis=-1)


def test_motions_give_the_homography(dtype):
    *_, homography, _ = motions()
    motion = decompose(homography.astype(dtype))
    assert motion.valid.all()
    assert not motion.is_rotation.any()
    r, t, n = unpacked(motion)
    np.testing.assert_allclose(np.linalg.norm(n, axis=-1), 1.0, atol=1e-6)
    found = r + t[..., :, None] * n[..., None, :]
    scale = np.sum(found * homography[:, None], axis=(-1, -2)) / np.sum(homography**2, axis=(-1, -2))[:, None]
    error = np.abs(found - scale[..., None, None] * homography[:, None]).max(axis=(-1, -2, -3))
    assert error.max() < (2e-5 if dtype == jnp.float32 else 1e-13)
    np.testing.assert_allclose(t[:, 0], -t[:, 1])
    np.testing.assert_allclose(n[:, 2], -n[:, 3])


@pytest.mark.parametrize("size", [0.3, 0.01])
def test_finds_the_truth(dtype, size):
    rotation, translation, normal, homography, _ = motions(seed=1, size=size)
    found = errors(decompose(homography.astype(dtype)), rotation, translation, normal)
    # Rounding of H, divided by the translation for the normal, and by the angle between it and the translation.
    eps = float(jnp.finfo(dtype).eps)
    assert np.quantile(found, 0.99) < 30.0 * eps / size
    assert found.max() < 300.0 * eps / size


def test_poselib_and_opencv_find_the_same_motions(x64):
    *_, homography, _ = motions(seed=2)
    r, t, n = unpacked(decompose(homography))
    for i in range(100):
        ours = np.concatenate([r[i].reshape(4, 9), t[i], n[i]], axis=1)
        # OpenCV keeps the sign of H, PoseLib undoes it.
        h = homography[i] * np.sign(np.linalg.det(homography[i]))
        poses, normals = poselib.motion_from_homography(h)
        of_poselib = np.array(
            [np.concatenate([pose.R.ravel(), pose.t, m]) for pose, m in zip(poses, normals, strict=True)]
        )
        _, rotations, translations, normals = cv2.decomposeHomographyMat(h, np.eye(3))
        of_opencv = np.array(
            [
                np.concatenate([np.ravel(x) for x in parts])
                for parts in zip(rotations, translations, normals, strict=True)
            ]
        )
        for theirs in (of_poselib, of_opencv):
            assert theirs.shape == (4, 15)
            distance = np.abs(ours[:, None] - theirs[None]).max(axis=-1)
            assert distance.min(axis=0).max() < 1e-7
            assert distance.min(axis=1).max() < 1e-7


def test_visible_rays_leave_two_motions_at_most(x64):
    rotation, translation, normal, homography, rays = motions(seed=3)
    seen = np.einsum("bnj,bj->bn", rays, normal) > 0.05
    motion = decompose_seen(homography, rays, seen)
    assert (motion.valid.sum(axis=1) <= 2).all()
    assert np.mean(motion.valid.sum(axis=1) == 1) > 0.1
    assert errors(motion, rotation, translation, normal).max() < 1e-10
    _, t, n = unpacked(motion)
    heights = np.einsum("bsj,bnj->bsn", n, rays)
    assert (heights > 0)[np.asarray(motion.valid)[..., None] & seen[:, None]].all()
    assert (t[~np.asarray(motion.valid)] == 0.0).all()
    # Nothing masked in: nothing dropped.
    assert decompose_seen(homography, rays, np.zeros_like(seen)).valid.all()


def test_pure_rotation_has_no_normal(dtype):
    rotation, *_, rays = motions(seed=4)
    for motion in (
        decompose(-3.0 * rotation.astype(dtype)),
        decompose_seen(rotation.astype(dtype), rays.astype(dtype), rays[..., 0] < 9.0),
    ):
        assert motion.is_rotation.all()
        np.testing.assert_array_equal(motion.valid, np.broadcast_to(np.eye(4, dtype=bool)[0], (COUNT, 4)))
        r, t, n = unpacked(motion)
        np.testing.assert_allclose(r[:, 0], rotation, atol=2e-6 if dtype == jnp.float32 else 1e-14)
        assert (t == 0.0).all()
        assert (n == 0.0).all()


def test_a_small_translation_is_no_rotation(x64):
    rotation, translation, normal, homography, _ = motions(seed=5, size=1e-6)
    motion = decompose(homography)
    assert not motion.is_rotation.any()
    assert np.quantile(errors(motion, rotation, translation, normal), 0.99) < 1e-7


def test_translation_along_the_normal_is_one_motion(dtype):
    rotation, _, normal, *_ = motions(seed=6)
    distance = np.linspace(-0.5, 0.9, COUNT)[:, None]
    distance = np.where(np.abs(distance) < 0.05, 0.05, distance)
    translation = distance * np.einsum("bij,bj->bi", rotation, normal)
    homography = rotation + translation[:, :, None] * normal[:, None]
    motion = decompose(homography.astype(dtype))
    # Half the digits at a double root; merged where rounding leaves no two.
    found = errors(motion, rotation, translation, normal)
    assert np.quantile(found, 0.99) < (1e-2 if dtype == jnp.float32 else 1e-6)
    assert np.mean(motion.valid.sum(axis=1) == 2) > 0.9


@pytest.mark.parametrize("spoil", ["nan", "inf", "zero", "singular", "rank one"])
def test_no_homography_no_motion(dtype, spoil):
    rotation, _, normal, homography, _ = motions(seed=7)
    if spoil == "nan":
        homography[:, 1, 2] = np.nan
    elif spoil == "inf":
        homography[:, 0, 0] = -np.inf
    elif spoil == "zero":
        homography[:] = 0.0
    elif spoil == "singular":  # camera 1 in the plane
        translation = -np.einsum("bij,bj->bi", rotation, normal)
        homography = rotation + translation[:, :, None] * normal[:, None]
    else:
        homography = rotation[:, :, :1] * normal[:, None]
    motion = decompose(homography.astype(dtype))
    assert not motion.valid.any()
    assert not motion.is_rotation.any()
    np.testing.assert_array_equal(motion.cam1_from_cam0.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (COUNT, 4, 7)))
    assert (motion.normal == 0.0).all()


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_scale_does_not_matter(size):
    rotation, translation, normal, homography, _ = motions(seed=8)
    motion = decompose((size * homography).astype(np.float32))
    assert np.quantile(errors(motion, rotation, translation, normal), 0.99) < 2e-5


def parts(homography, scale=1.0):
    motion = metric_translation(
        decompose_homography(homography), scale, down=jnp.array([0.0, 0.0, 1.0]), max_angle=np.pi
    )
    return jnp.concatenate([motion.cam1_from_cam0.wxyz_xyz, motion.normal], axis=1)


@functools.cache
def jacobians():
    reverse = jax.jit(jax.vmap(jax.jacrev(parts)))
    return reverse, jax.jit(jax.vmap(jax.jacfwd(parts)))


def test_gradients_equal_central_differences(x64):
    *_, homography, _ = motions(seed=9)
    reverse, forward = (np.asarray(f(homography)) for f in jacobians())
    value = jax.jit(jax.vmap(parts))
    numeric = np.zeros_like(forward)
    for i, j in np.ndindex(3, 3):
        step = np.zeros((3, 3))
        step[i, j] = 1e-6
        numeric[..., i, j] = (value(homography + step) - value(homography - step)) / 2e-6
    size = np.abs(numeric).max(axis=(1, 2, 3, 4), keepdims=True)
    conditioned = size[:, 0, 0, 0, 0] < 1e3
    assert conditioned.mean() > 0.9
    np.testing.assert_allclose((forward / size)[conditioned], (numeric / size)[conditioned], atol=1e-6)
    np.testing.assert_allclose(reverse / size, forward / size, atol=1e-12)


@pytest.mark.slow
def test_gradients_are_finite_everywhere(dtype):
    rotation, _, normal, homography, _ = motions(seed=10)
    homography[:50] = rotation[:50]
    homography[50:100] = np.eye(3)
    along = np.einsum("bij,bj->bi", rotation, normal)
    homography[100:150] = (rotation + 0.3 * along[:, :, None] * normal[:, None])[100:150]
    homography[150:200] = (rotation - along[:, :, None] * normal[:, None])[150:200]
    homography[200:220] = 0.0
    homography[220:240, 0, 1] = np.nan
    homography[240:260, 2, 2] = np.inf
    homography[260:280] *= 1e30
    homography[280:300] *= 1e-30
    motion = decompose(homography.astype(dtype))
    for x in jax.tree.leaves(motion):
        assert np.isfinite(x).all()
    for jacobian in jacobians():
        entries = np.asarray(jacobian(homography.astype(dtype)))
        assert np.isfinite(entries).all()
        assert (entries[:100] == 0.0).all()
        assert (np.abs(entries[300:]).max(axis=(1, 2, 3, 4)) > 0.0).all()


def test_height_gives_the_scale_over_the_ground(dtype):
    # A camera 1.6 m above the road, pitched a little, driving ahead and turning.
    rng = np.random.default_rng(11)
    height = 1.6
    pitch = Rotation.from_rotvec(np.c_[rng.uniform(-0.1, 0.1, COUNT), np.zeros(COUNT), rng.uniform(-0.1, 0.1, COUNT)])
    normal = pitch.apply(np.array([0.0, 1.0, 0.0]))
    rotation = Rotation.from_rotvec(rng.normal(size=(COUNT, 3)) * 0.05).as_matrix()
    translation = np.c_[rng.uniform(-0.2, 0.2, COUNT), rng.uniform(-0.05, 0.05, COUNT), -rng.uniform(0.3, 2.0, COUNT)]
    homography = rotation + translation[:, :, None] * normal[:, None] / height
    motion = decompose(homography.astype(dtype))
    metric = jax.vmap(lambda motion: metric_translation(motion, height))(motion)
    assert isinstance(metric, HomographyMotion)
    assert errors(metric, rotation, translation, normal).max() < (1e-4 if dtype == jnp.float32 else 1e-11)
    # One motion is over the ground; the other has its plane nearly across the way.
    assert (metric.valid.sum(axis=1) == 1).mean() > 0.95
    from_ceiling = jax.vmap(lambda motion: metric_translation(motion, height, down=jnp.array([0.0, -3.0, 0.0])))(motion)
    assert errors(from_ceiling, rotation, -translation, -normal).max() < (1e-4 if dtype == jnp.float32 else 1e-11)


@pytest.mark.parametrize(
    ("height", "down"),
    [
        (-1.0, [0.0, 1.0, 0.0]),
        (np.nan, [0.0, 1.0, 0.0]),
        (np.inf, [0.0, 1.0, 0.0]),
        (1.0, [0.0, 0.0, 0.0]),
        (1.0, [0.0, np.nan, 1.0]),
    ],
)
def test_no_height_no_scale(height, down):
    motion = decompose_homography(
        np.eye(3, dtype=np.float32) + np.array([[0, 0, 0], [0, 0, 0], [0, -0.1, 0]], np.float32)
    )
    metric = metric_translation(motion, height, down=jnp.array(down))
    assert not metric.valid.any()
    np.testing.assert_array_equal(metric.cam1_from_cam0.wxyz_xyz, np.broadcast_to(np.eye(7)[0], (4, 7)))


def test_vmap_equals_loop(x64):
    *_, homography, _ = motions(seed=12)
    batched = decompose(homography)
    single = jax.jit(decompose_homography)
    for i in range(8):
        one = single(homography[i])
        assert isinstance(one.cam1_from_cam0, SE3)
        np.testing.assert_allclose(one.cam1_from_cam0.wxyz_xyz, batched.cam1_from_cam0.wxyz_xyz[i], atol=1e-13)
        np.testing.assert_allclose(one.normal, batched.normal[i], atol=1e-13)


# --- Fundamental matrices from planes ---


def eight_point(pixels0, pixels1):
    """Normalised eight-point algorithm of rank two."""
    frames, points = [], []
    for pixels in (pixels0, pixels1):
        mean, size = pixels.mean(axis=0), np.sqrt(0.5 * np.mean(np.sum((pixels - pixels.mean(axis=0)) ** 2, axis=1)))
        frames.append(
            np.array([[1.0 / size, 0.0, -mean[0] / size], [0.0, 1.0 / size, -mean[1] / size], [0.0, 0.0, 1.0]])
        )
        points.append(np.c_[(pixels - mean) / size, np.ones(len(pixels))])
    matrix = np.linalg.svd(np.einsum("ni,nj->nij", points[1], points[0]).reshape(-1, 9))[2][-1].reshape(3, 3)
    u, s, vt = np.linalg.svd(matrix)
    return frames[1].T @ (u * np.array([s[0], s[1], 0.0])) @ vt @ frames[0]


def from_homographies(homographies, calibration):
    """Least squares of HᵀF + FᵀH = 0 over the homographies, in normalized coordinates, then rank two."""
    inverse = np.linalg.inv(calibration)
    rows = []
    for h in homographies:
        h = inverse @ h @ calibration
        h /= np.linalg.norm(h)
        # Entry (i, j) of HᵀF, linear in F.
        product = np.einsum("ki,jl->ijkl", h, np.eye(3))
        rows += [(product[i, j] + product[j, i]).ravel() for i in range(3) for j in range(i, 3)]
    matrix = np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)
    u, s, vt = np.linalg.svd(matrix)
    return inverse.T @ (u * np.array([s[0], s[1], 0.0])) @ vt @ inverse


def epipolar_distance(matrix, pixels0, pixels1):
    """RMS distance of points of image 1 from the lines of their matches."""
    lines = np.c_[pixels0, np.ones(len(pixels0))] @ matrix.T
    distance = np.sum(lines * np.c_[pixels1, np.ones(len(pixels1))], axis=1) / np.linalg.norm(lines[:, :2], axis=1)
    return np.sqrt(np.mean(distance**2))


def test_a_fundamental_matrix_from_homographies_is_poor(x64):
    # Three planes with 20 points each at 1 px; measured on 200 noise-free points of the whole scene. Virtual points are
    # a grid over the hull of each plane's points, moved by its homography.
    rng = np.random.default_rng(13)
    calibration = np.array([[800.0, 0.0, 640.0], [0.0, 800.0, 480.0], [0.0, 0.0, 1.0]])

    def project(points):
        pixels = points @ calibration.T
        return pixels[..., :2] / pixels[..., 2:]

    fit = jax.jit(jax.vmap(lambda p, q: homography_dlt(p, q).models[0]))
    scores = []
    for _ in range(60):
        rotation = Rotation.from_rotvec(rng.normal(size=3) * 0.1).as_matrix()
        translation = np.array([1.0, 0.2, 0.1]) + 0.2 * rng.normal(size=3)
        pixels0, pixels1 = [], []
        for column in range(3):
            rays = np.c_[rng.uniform(-0.7, -0.3, 20) + 0.5 * column, rng.uniform(-0.5, 0.5, 20), np.ones(20)]
            normal = np.array([*rng.uniform(-0.6, 0.6, 2), 1.0])
            points = rays * rng.uniform(5.0, 10.0) / (rays @ normal)[:, None]
            pixels0.append(project(points) + rng.normal(size=(20, 2)))
            pixels1.append(project(points @ rotation.T + translation) + rng.normal(size=(20, 2)))
        homographies = np.asarray(fit(np.array(pixels0), np.array(pixels1)))
        virtual0, virtual1 = [], []
        for p, h in zip(pixels0, homographies, strict=True):
            grid = np.stack(
                np.meshgrid(*(np.linspace(*np.quantile(p[:, i], [0.1, 0.9]), 4) for i in range(2))), axis=-1
            )
            moved = np.c_[grid.reshape(-1, 2), np.ones(16)] @ h.T
            virtual0.append(grid.reshape(-1, 2))
            virtual1.append(moved[:, :2] / moved[:, 2:])
        test_points = np.c_[rng.uniform(-0.7, 0.7, 200), rng.uniform(-0.5, 0.5, 200), np.ones(200)] * rng.uniform(
            5.0, 10.0, (200, 1)
        )
        truth = project(test_points), project(test_points @ rotation.T + translation)
        candidates = (
            eight_point(np.concatenate(pixels0), np.concatenate(pixels1)),
            eight_point(np.concatenate(virtual0), np.concatenate(virtual1)),
            from_homographies(homographies, calibration),
        )
        scores.append([epipolar_distance(matrix, *truth) for matrix in candidates])
    of_points, of_virtual, of_homographies = np.median(scores, axis=0)
    print(
        "median rms epipolar distance, px: points, virtual points, homographies", of_points, of_virtual, of_homographies
    )
    assert of_virtual < 0.6 * of_homographies
    assert of_points < 0.6 * of_homographies
