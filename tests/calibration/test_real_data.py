"""The bars on real data: OpenCV's calibrations, and reference optima, on the same corners."""

import json

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3
from vojax.ba import Squared
from vojax.ba._board_residual import BoardData, BoardState, cost
from vojax.ba._calibration import adjust_board
from vojax.calibration import calibrate, calibrate_rig
from vojax.calibration._calibrate import CALIBRATION_OPTIONS
from vojax.cameras import DoubleSphere, ExtendedUnified, KannalaBrandt, Pinhole, Scaramuzza
from vojax.features import read_image
from vojax.features._chessboard import chessboard_points, find_chessboard

pytestmark = [pytest.mark.slow, pytest.mark.data]
PRECISE = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-12)


def corners_of(files, board):
    found = [find_chessboard(read_image(file), board) for file in files]
    assert all(corners is not None for corners in found)
    return np.array(found)


def as_opencv(corners):
    return [view.astype(np.float32).reshape(-1, 1, 2) for view in corners]


@pytest.fixture(scope="module")
def pairs(data_root):
    names = [f"{i:02d}" for i in (*range(1, 10), *range(11, 15))]
    return np.stack(
        [corners_of([data_root / "chessboard" / f"{side}{i}.jpg" for i in names], (9, 6)) for side in ("left", "right")]
    )


def intrinsics(camera):
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    return np.array([float(getattr(camera, name)) for name in names])


def theirs(k, distortion):
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *distortion.ravel()[:5]])


def test_a_camera_agrees_with_opencv(pairs, x64):
    board = chessboard_points((9, 6), 1.0)
    found = calibrate(pairs[0].astype(np.float32).astype(float), board, (640, 480))
    points = [board.astype(np.float32)] * len(pairs[0])
    rms, k, distortion, *_ = cv2.calibrateCamera(points, as_opencv(pairs[0]), (640, 480), None, None, criteria=PRECISE)
    assert float(found.rms_px) <= rms + 1e-3
    score = (intrinsics(found.camera) - theirs(k, distortion)) / np.asarray(found.standard_deviations())
    assert np.abs(score).max() < 3.0


def test_a_stereo_pair_agrees_with_opencv(pairs, x64):
    board = chessboard_points((9, 6), 1.0)
    found = calibrate_rig(pairs.astype(np.float32).astype(float), board, (640, 480))
    points = [board.astype(np.float32)] * len(pairs[0])
    start = [cv2.calibrateCamera(points, as_opencv(side), (640, 480), None, None)[1:3] for side in pairs]
    rms, k0, d0, k1, d1, rotation, translation, *_ = cv2.stereoCalibrate(
        points, *map(as_opencv, pairs), *start[0], *start[1], (640, 480),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=PRECISE,
    )  # fmt: skip
    assert float(found.rms_px) <= rms + 1e-3
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation.ravel()
    off = SE3(found.rig.cam_from_rig.wxyz_xyz[1]) @ SE3.from_matrix(jnp.asarray(pose)).inverse()
    error = [intrinsics(found.rig.cameras[0]) - theirs(k0, d0), intrinsics(found.rig.cameras[1]) - theirs(k1, d1)]
    score = np.concatenate([*error, np.asarray(off.log())]) / np.asarray(found.standard_deviations())
    assert np.abs(score).max() < 3.0


def test_fisheye_models(data_root, x64):
    # The boards are of 7 x 9 squares: 6 x 8 inner corners.
    files = [data_root / "fisheye_chessboard" / f"Fisheye2_{i}.jpg" for i in range(1, 17)]
    corners, board = corners_of(files, (6, 8)), chessboard_points((6, 8), 0.117)
    height, width = read_image(files[0]).shape[:2]
    found = calibrate(corners, board, (width, height), model=KannalaBrandt)
    # OpenCV's own start fails beyond 90 degrees; it gets ours.
    c = found.camera
    k = np.array([[float(c.fx), 0, float(c.cx)], [0, float(c.fy), float(c.cy)], [0, 0, 1.0]])
    rms, *_ = cv2.fisheye.calibrate(
        [board.reshape(1, -1, 3)] * len(corners), [view.reshape(1, -1, 2) for view in corners], (width, height), k,
        np.zeros((4, 1)), criteria=PRECISE,
        flags=cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW | cv2.CALIB_USE_INTRINSIC_GUESS,
    )  # fmt: skip
    assert float(found.rms_px) <= rms + 1e-6
    # Four terms fit this lens 12 % worse than Kannala and Brandt's five, a fifth one fits it better.
    four = calibrate(corners, board, (width, height), model=Scaramuzza)
    assert float(four.rms_px) <= 1.15 * float(found.rms_px)
    start = Scaramuzza(**{name: getattr(four.camera, name) for name in (*four.names, "e")}, higher=(0.0,))
    five = calibrate(corners, board, (width, height), model=start)
    assert float(five.rms_px) <= float(found.rms_px)


def aprilgrid(folder):
    """Corners `[2, v, 144, 2]`, which were seen, and the points of the grid: 6 x 6 tags of 0.088 m, 0.3 of it apart."""
    raw = json.loads((folder / "detected_corners.json").read_text())["value0"]
    frames = sorted({entry["key"]["first"] for entry in raw})
    corners, mask = np.zeros((2, len(frames), 144, 2)), np.zeros((2, len(frames), 144), bool)
    for entry in raw:
        at = entry["key"]["second"], frames.index(entry["key"]["first"])
        for pixel, i in zip(entry["value"]["value0"], entry["value"]["value1"], strict=True):
            corners[(*at, i)] = pixel["value0"], pixel["value1"]
            mask[(*at, i)] = True
    row, column = np.divmod(np.arange(144) // 4, 6)
    right, down = np.isin(np.arange(144) % 4, (1, 2)), np.isin(np.arange(144) % 4, (2, 3))
    points = 0.088 * np.stack([1.3 * column + right, 1.3 * row + down, 0.0 * row], axis=1)
    return corners, mask, points


@pytest.mark.parametrize(
    ("name", "model", "extra"),
    [
        ("pinhole", Pinhole, ()),
        ("kb4", KannalaBrandt, ("k1", "k2", "k3", "k4")),
        ("eucm", ExtendedUnified, ("alpha", "beta")),
        ("ds", DoubleSphere, ("xi", "alpha")),
    ],
)
def test_reference_optima_of_an_april_grid(data_root, x64, name, model, extra):
    folder = data_root / "aprilgrid_corners"
    corners, mask, points = aprilgrid(folder)
    found = calibrate_rig(corners, points, (752, 480), model=model, mask=mask)
    reference = json.loads((folder / f"gt_calib_{name}.json").read_text())["value0"]
    keys = ("fx", "fy", "cx", "cy", *(f"p{i + 1}" for i in range(len(extra))))
    values = np.array([[entry[key] for key in keys] for entry in reference["cam.intrinsics"]])
    pose = reference["cam.T_i_c"][1]
    rig_from_cam = SE3(jnp.array([pose[key] for key in ("qw", "qx", "qy", "qz", "px", "py", "pz")])).normalize()
    # The reference has no board poses, and one reaches its cost at best with the poses of the common optimum nearby:
    # with intrinsics held, boards and rig are brought to their optimum, which is no more than the reference's cost.
    data = BoardData(
        jnp.asarray(corners), jnp.asarray(points), jnp.asarray(mask, float), jnp.ones(mask.shape), Squared(), ()
    )
    rig = SE3(jnp.stack([SE3.identity().wxyz_xyz, rig_from_cam.inverse().wxyz_xyz]))
    cameras = jax.vmap(lambda row: model(*row))(jnp.asarray(values))
    start = BoardState(cameras, rig, found.rig_from_board)
    least = adjust_board(start, data, CALIBRATION_OPTIONS)[0]
    assert float(found.cost) <= float(cost(least, data)) * (1 + 1e-9)
    names = ("fx", "fy", "cx", "cy", *extra)
    ours = np.array([[float(getattr(camera, n)) for n in names] for camera in found.rig.cameras])
    off = SE3(found.rig.cam_from_rig.wxyz_xyz[1]) @ rig_from_cam
    score = np.concatenate([(ours - values).ravel(), np.asarray(off.log())]) / np.asarray(found.standard_deviations())
    assert np.abs(score).max() < 3.0
