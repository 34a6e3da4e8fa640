"""Calibration of one camera: truth, OpenCV, dense algebra, finite differences; degenerate and bad input."""

import inspect

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3, Result
from vojax.ba import Cauchy
from vojax.calibration import calibrate
from vojax.cameras import BrownConrady, Pinhole

SIZE = (640, 480)
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


@pytest.fixture(scope="module")
def found(views, board):
    with jax.enable_x64(True):
        return calibrate(views[0], board, SIZE)


def test_the_truth_is_within_its_deviations(found, lens, views, x64):
    assert found.names == NAMES
    assert found.result == Result.success
    assert bool(found.used.all())
    assert not bool(found.unconstrained[:2].any())
    truth = np.array([float(getattr(lens, name)) for name in NAMES])
    score = (np.asarray(found.values()) - truth) / np.asarray(found.standard_deviations())
    # Nine parameters: |score| above 4 happens once in 1,700 calibrations.
    assert np.abs(score).max() < 4.0
    # 480 coordinates, 57 unknowns: the estimated noise is 0.2 to 4 standard errors.
    assert float(found.sigma_px) == pytest.approx(0.2, abs=4 * 0.2 / np.sqrt(2 * 423))
    off = (found.cam_from_board @ SE3(views[1].wxyz_xyz).inverse()).log()
    chi2 = jnp.einsum("vi,vij,vj->v", off, jnp.linalg.inv(found.pose_covariance), off)
    assert float(chi2.max()) < 30.0  # six degrees of freedom, eight views: once in 3,000


def test_agrees_with_opencv(found, views, board, x64):
    image_points = [c.astype(np.float32).reshape(-1, 1, 2) for c in views[0]]
    rms, k, distortion, _, _, deviations, *_ = cv2.calibrateCameraExtended(
        [board.astype(np.float32)] * len(views[0]), image_points, SIZE, None, None,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-14),
    )  # fmt: skip
    assert float(found.rms_px) <= rms + 1e-5
    theirs = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *distortion.ravel()])
    ours, sigma = np.asarray(found.values()), np.asarray(found.standard_deviations())
    np.testing.assert_allclose((ours - theirs) / sigma, 0.0, atol=1e-2)
    np.testing.assert_allclose(sigma, deviations.ravel()[: len(sigma)], rtol=1e-3)


def _residual(found, corners, board):
    """All residuals as a function of all unknowns, written without the calibration's own code."""
    values = found.values()

    def residual(z):
        camera = BrownConrady(**dict(zip(NAMES, values + z[:9], strict=True)))
        poses = SE3.exp(-z[9:].reshape(-1, 6)) @ found.cam_from_board
        pixels = jax.vmap(lambda pose: camera.project(SE3(pose).apply(jnp.asarray(board))))(poses.wxyz_xyz)
        return (pixels - corners).ravel()

    return residual, jnp.zeros(9 + 6 * len(corners))


def test_covariance_is_that_of_the_dense_normal_matrix(found, views, board, x64):
    residual, zero = _residual(found, jnp.asarray(views[0]), board)
    jacobian = jax.jacfwd(residual)(zero)
    gradient = jacobian.T @ residual(zero)
    dense = np.linalg.inv(np.asarray(jacobian.T @ jacobian))
    # At the minimum: the step that is left is far below a deviation.
    assert np.abs(dense @ gradient / np.sqrt(np.diag(dense))).max() < 1e-5
    dense = dense * float(found.sigma_px) ** 2
    scale = np.sqrt(np.diag(dense)[:9])
    np.testing.assert_allclose(np.asarray(found.covariance) / np.outer(scale, scale),
                               dense[:9, :9] / np.outer(scale, scale), atol=1e-6)  # fmt: skip
    for v in range(2):
        rows = slice(9 + 6 * v, 15 + 6 * v)
        scale = np.sqrt(np.diag(dense)[rows])
        np.testing.assert_allclose(np.asarray(found.pose_covariance[v]) / np.outer(scale, scale),
                                   dense[rows, rows] / np.outer(scale, scale), atol=1e-6)  # fmt: skip


def test_a_view_that_cannot_be_used_is_left_out(found, views, board, x64):
    # Three corners fix no pose, nor does a row of corners; what masked corners hold is no matter.
    corners = np.array(views[0])
    mask = np.ones(corners.shape[:2], bool)
    mask[2, 3:] = False
    mask[5, 6:] = False
    corners[~mask] = np.nan
    less = calibrate(corners, board, SIZE, mask=mask)
    assert less.result == Result.success
    assert np.flatnonzero(~np.asarray(less.used)).tolist() == [2, 5]
    assert np.isfinite(np.asarray(less.residuals)).all()
    np.testing.assert_array_equal(np.asarray(less.cam_from_board.wxyz_xyz[2]), [1, 0, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(np.asarray(less.pose_covariance[2]), 0.0)
    assert abs(float(less.camera.fx - found.camera.fx)) < 5 * float(less.standard_deviations()[0])


def test_parallel_boards_are_degenerate(lens, board, x64):
    corners, _ = views_parallel(lens, board)
    flat = calibrate(corners, board, SIZE)
    assert flat.result == Result.degenerate
    assert float(flat.view_angle) < 0.05
    assert bool(flat.unconstrained[:2].any())
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves((flat.camera, flat.covariance)))


def views_parallel(lens, board):
    shift = np.array([[0, 0, 7], [1, 0, 8], [-1, 1, 6.5], [0, -1, 9], [1, 1, 7], [0, 0, 8], [1, -1, 7], [-1, 0, 7]])
    poses = jnp.concatenate([jnp.tile(jnp.eye(4)[:1], (8, 1)), jnp.asarray(shift - board.mean(axis=0))], axis=1)
    return np.stack([np.asarray(lens.project(SE3(pose).apply(jnp.asarray(board)))) for pose in poses]), poses


@pytest.mark.slow
def test_gradients_of_a_calibration(views, board, x64):
    corners = jnp.asarray(views[0])

    def focal(corners):
        return calibrate(corners, board, SIZE).camera.fx

    gradient = jax.grad(focal)(corners)
    direction = jnp.asarray(np.random.default_rng(3).normal(size=corners.shape))
    step = 1e-3
    difference = (focal(corners + step * direction) - focal(corners - step * direction)) / (2 * step)
    assert float(jnp.sum(gradient * direction)) == pytest.approx(float(difference), rel=1e-5)
    # Both modes.
    _, forward = jax.jvp(focal, (corners,), (direction,))
    assert float(forward) == pytest.approx(float(jnp.sum(gradient * direction)), rel=1e-9)


@pytest.mark.slow
def test_wrong_corners_lose_to_a_robust_loss(lens, views, board, x64):
    corners = np.array(views[0])
    rng = np.random.default_rng(11)
    wrong = [(v, int(i)) for v in range(8) for i in rng.choice(corners.shape[1], 2, replace=False)]
    for v, i in wrong:
        corners[v, i] += rng.uniform(15, 40, 2) * rng.choice([-1, 1], 2)
    robust = calibrate(corners, board, SIZE, loss=Cauchy(0.5))
    assert robust.result == Result.success
    assert abs(float(robust.camera.fx - lens.fx)) < 4 * float(robust.standard_deviations()[0])
    assert float(robust.sigma_px) == pytest.approx(0.2, abs=0.06)
    length = np.linalg.norm(np.asarray(robust.residuals), axis=-1)
    flagged = {(int(v), int(i)) for v, i in np.argwhere(length > 5.0)}
    assert flagged == set(wrong)


@pytest.mark.slow
def test_start_and_free_parameters(views, board, x64):
    start = Pinhole(fx=400.0, fy=400.0, cx=319.5, cy=239.5)
    tied = calibrate(views[0], board, SIZE, model=start, free=(("fx", "fy"),), sigma_px=2.0)
    assert tied.names == ("fx = fy",)
    assert float(tied.camera.fx) == float(tied.camera.fy)
    assert float(tied.camera.cx) == 319.5
    assert float(tied.sigma_px) == 2.0
    assert 450 < float(tied.camera.fx) < 600


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"corners": np.zeros((8, 30))}, "expected [v, n, 2]"),
        ({"object_points": np.zeros((29, 3))}, "30 corners in a view"),
        ({"object_points": np.ones((30, 3)) * np.arange(30)[:, None]}, "plane z = 0"),
        ({"mask": np.ones((8, 29), bool)}, "mask has shape"),
        ({"mask": np.arange(240).reshape(8, 30) < 60}, "2 views with at least 4 corners: expected 3 or more"),
        ({"corners": np.full((8, 30, 2), np.nan)}, "not finite"),
        ({"corners": np.full((8, 30, 2), 900.0)}, "outside an image of 640 x 480"),
        ({"image_size": (640,)}, "expected width and height"),
        ({"sigma_px": 0.0}, "sigma_px is not positive"),
        ({"sigma_px": np.ones(5)}, "sigma_px has shape (5,)"),
        ({"free": ("fx", "focal")}, "free names 'focal', which BrownConrady does not have"),
        ({"free": ("fx", "fx")}, "expected each once"),
        ({"model": "pinhole"}, "expected a camera class"),
        ({"model": SE3}, "SE3"),
        ({"loss": 3.0}, "loss is 3.0"),
    ],
)
def test_bad_input_is_one_sentence(views, board, change, words, x64):
    arguments = {"corners": views[0], "object_points": board, "image_size": SIZE, **change}
    positional = [arguments.pop(name) for name in ("corners", "object_points", "image_size")]
    with pytest.raises(ValueError, match=r"\w") as caught:
        inspect.unwrap(calibrate)(*positional, **arguments)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
