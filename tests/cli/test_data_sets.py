"""Every data set that the commands open, with what each pipeline takes of it."""

import json

import cv2
import numpy as np
import pytest

from vojax.cameras import Pinhole, RectifiedStereo
from vojax.metrics import read_trajectory
from vojax.odometry import PairRectifier

SHAPE = (16, 32)
STAMPS = [1403715273262142976 + 50_000_000 * k for k in range(3)]
SENSOR = """%YAML:1.0
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, {x}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
resolution: [32, 16]
camera_model: pinhole
intrinsics: [20, 20, 15.5, 7.5]
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.0, 0.0, 0.0]
"""


def picture(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.asarray(value))


def grey(k):
    return np.full(SHAPE, 10 * k + 5, np.uint8)


def colour(k):
    return np.full((*SHAPE, 3), 10 * k + 5, np.uint8)


@pytest.fixture
def calibration(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 32 16 20 20 16 8\n2 PINHOLE 32 16 21 21 16 8\n")
    return tmp_path / "cameras.txt"


@pytest.fixture
def tum(tmp_path):
    folder = tmp_path / "desk"
    for k in range(4):
        picture(folder / "rgb" / f"{k}.png", colour(k))
        picture(folder / "depth" / f"{k}.png", np.full(SHAPE, 5000 * (k + 1), np.uint16))
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text("".join(f"{k / 10} {kind}/{k}.png\n" for k in range(4)))
    # The last image has no true pose near it.
    (folder / "groundtruth.txt").write_text("".join(f"{k / 10} 0 0 {k} 0 0 0 1\n" for k in range(3)))
    return folder


@pytest.fixture
def seven_scenes(tmp_path):
    folder = tmp_path / "seq-01"
    for k in range(3):
        picture(folder / f"frame-{k:06d}.color.png", colour(k))
        picture(folder / f"frame-{k:06d}.depth.png", np.full(SHAPE, 1000 * (k + 1), np.uint16))
        (folder / f"frame-{k:06d}.pose.txt").write_text(f"1 0 0 0\n0 1 0 0\n0 0 1 {k}\n0 0 0 1\n")
    return folder


@pytest.fixture
def euroc(tmp_path):
    mav = tmp_path / "room" / "mav0"
    for i in (0, 1):
        for k, stamp in enumerate(STAMPS):
            picture(mav / f"cam{i}" / "data" / f"{stamp}.png", grey(k))
        (mav / f"cam{i}" / "sensor.yaml").write_text(SENSOR.format(x=0.25 * i))
        (mav / f"cam{i}" / "data.csv").write_text("".join(f"{stamp},{stamp}.png\n" for stamp in STAMPS))
    return mav.parent


@pytest.fixture
def run(vojax_command, fake, tmp_path):
    def run(dataset, path, pipeline, *more):
        outcome = vojax_command(
            "run", path, "--dataset", dataset, "--pipeline", pipeline, "--out", tmp_path / "out", *more
        )
        assert outcome.status == 0, outcome.stderr
        return json.loads((tmp_path / "out" / "metrics.json").read_text())

    return run


def test_tum(run, fake, tum, calibration, tmp_path):
    metrics = run("tum", tum, "rgbd-3d2d", "--calibration", calibration, "--camera-name", "2")
    (odometry,) = fake.made
    assert float(odometry.camera.fx) == 21
    assert [float(depth[3, 4]) for _, depth in odometry.images] == [1, 2, 3, 4]
    assert [int(image[3, 4, 0]) for image, _ in odometry.images] == [5, 15, 25, 35]
    assert (metrics["frames"], metrics["frames_with_truth"], metrics["alignment"]) == (4, 3, "none")
    assert metrics["path_length_m"] == pytest.approx(2.0)
    assert len(read_trajectory(tmp_path / "out" / "trajectory.txt")) == 4


def test_a_sequence_inside_the_folder_and_one_camera_of_it(run, fake, tum, calibration):
    metrics = run(
        "tum", tum.parent, "mono-3d2d", "--sequence", "desk", "--calibration", calibration, "--camera-name", "1"
    )
    assert [len(images) for images in fake.made[0].images] == [1] * 4
    assert metrics["alignment"] == "sim3"


def test_seven_scenes(run, fake, seven_scenes, calibration):
    metrics = run("7scenes", seven_scenes, "rgbd-3d2d", "--calibration", calibration, "--camera-name", "1")
    assert [float(depth[3, 4]) for _, depth in fake.made[0].images] == [1, 2, 3]
    assert metrics["frames_with_truth"] == 3


def test_euroc_is_rectified(run, fake, euroc):
    run("euroc", euroc, "stereo-3d2d")
    (odometry,) = fake.made
    assert isinstance(odometry.camera, PairRectifier)
    assert float(odometry.camera.stereo.baseline) == pytest.approx(0.25)
    # As taken; the odometry rectifies.
    assert [tuple(image[3, 4] for image in images) for images in odometry.images] == [(5, 5), (15, 15), (25, 25)]


def test_one_camera_of_euroc(run, fake, euroc):
    (euroc / "mav0" / "cam1").rename(euroc / "elsewhere")
    run("euroc", euroc, "mono-3d2d")
    assert [len(images) for images in fake.made[0].images] == [1] * 3


def test_kitti_is_rectified_as_it_is(run_kitti, fake):
    assert run_kitti().status == 0
    assert isinstance(fake.made[0].camera, RectifiedStereo)


def test_images_and_a_video(run, fake, tmp_path, calibration):
    folder = tmp_path / "pictures"
    for k in range(3):
        picture(folder / f"{k}.png", grey(k))
    run("images", folder, "mono-3d2d", "--calibration", calibration, "--camera-name", "2")
    assert isinstance(fake.made[0].camera, Pinhole)
    assert [int(image[3, 4]) for (image,) in fake.made[0].images] == [5, 15, 25]
    video = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, SHAPE[::-1])
    for k in range(5):
        writer.write(colour(k))
    writer.release()
    metrics = run("images", video, "mono-3d2d", "--calibration", calibration, "--camera-name", "1")
    assert metrics["sequence"] == "film"
    assert metrics["frames"] == 5
    assert "ate_rmse_m" not in metrics


def test_the_demo_takes_any_pipeline(vojax_command, fake, tmp_path):
    for pipeline, images in (("mono-3d2d", 1), ("rgbd-3d2d", 2), ("stereo-3d3d", 2)):
        outcome = vojax_command("demo", "--pipeline", pipeline, "--frames", 2, "--out", tmp_path / pipeline)
        assert outcome.status == 0, outcome.stderr
        assert [len(one) for one in fake.made[-1].images] == [images] * 2
    assert fake.made[1].images[0][1].dtype == np.float32
    assert "choose one of" in vojax_command("demo", "--pipeline", "walk", "--out", tmp_path / "none").error
