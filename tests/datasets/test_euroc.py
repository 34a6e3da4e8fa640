import shutil

import cv2
import numpy as np
import pytest

from vojax.cameras import BrownConrady
from vojax.datasets import EurocSequence, FrameSequence

# Beyond 2^53: nanoseconds that a float would round to another number.
START = 1403715273262142976
STAMPS = [START + 50_000_000 * k for k in range(4)]

SENSOR = """%YAML:1.0
T_BS:
  cols: 4
  rows: 4
  data: [0, -1, 0, {x}, 1, 0, 0, {y}, 0, 0, 1, 0, 0, 0, 0, 1]
resolution: [{width}, 48]
camera_model: pinhole
intrinsics: [50, 51, {cx}, 23]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]
"""


def one_line(caught):
    assert "\n" not in str(caught.value)
    return str(caught.value)


def truth_row(stamp, position, wxyz, rest=True):
    values = [*position, *wxyz, *([0] * 9 if rest else [])]
    return ",".join([str(stamp), *(repr(float(value)) for value in values)]) + "\n"


def write_sequence(root, cameras=2, truth=True):
    mav = root / "MH_09" / "mav0"
    for i in range(cameras):
        folder = mav / f"cam{i}"
        (folder / "data").mkdir(parents=True)
        # On the body, x is up and z is forward, so the camera's x axis is the body's y axis.
        (folder / "sensor.yaml").write_text(SENSOR.format(x=0.5, y=0.1 * i, width=64, cx=31 + i))
        for k, stamp in enumerate(STAMPS):
            cv2.imwrite(str(folder / "data" / f"{stamp}.png"), np.full((48, 64), 10 * k + i, np.uint8))
        rows = "".join(f"{stamp},{stamp}.png\n" for stamp in STAMPS)
        (folder / "data.csv").write_text("#timestamp [ns],filename\n" + rows)
    if truth:
        folder = mav / "state_groundtruth_estimate0"
        folder.mkdir()
        half = np.deg2rad(60.0) / 2
        rows = truth_row(STAMPS[1] - 10_000_000, (0, 0, 0), (1, 0, 0, 0))
        # The same turn by 60° about z, by the quaternion of the other sign.
        rows += truth_row(STAMPS[1] + 20_000_000, (3, 6, 9), (-np.cos(half), 0, 0, -np.sin(half)))
        rows += truth_row(STAMPS[2], (4, 4, 4), (0, 1, 0, 0))
        (folder / "data.csv").write_text("#timestamp, p_RS_R_x [m], …\n" + rows)
    return root / "MH_09"


def test_a_whole_stereo_sequence(tmp_path):
    root = write_sequence(tmp_path)
    sequence = EurocSequence(root)
    assert isinstance(sequence, FrameSequence)
    assert sequence.name == EurocSequence(root / "mav0").name == "MH_09"
    assert len(sequence) == 4
    assert sequence.frame_names == [str(stamp) for stamp in STAMPS]
    np.testing.assert_allclose(np.diff(sequence.times), 0.05, atol=1e-6)
    assert sequence.times[0] == pytest.approx(1403715273.262143, abs=1e-6)
    left, right = sequence.images(2)
    assert left.shape == right.shape == (48, 64)
    assert (left[0, 0], right[0, 0]) == (20, 21)
    np.testing.assert_array_equal(sequence.images(-2)[1], right)
    with pytest.raises(IndexError, match="expected 0 to 3"):
        sequence.images(4)
    assert all(isinstance(camera, BrownConrady) for camera in sequence.cameras)
    assert [float(camera.cx) for camera in sequence.cameras] == [31, 32]
    assert sequence.camera is sequence.cameras[0]
    assert sequence.size == (64, 48)
    # The right camera is 0.1 m along the left one's x axis.
    np.testing.assert_allclose(sequence.cam1_from_cam0.wxyz_xyz, [1, 0, 0, 0, -0.1, 0, 0], atol=1e-7)


def test_truth_is_interpolated_to_the_frames(tmp_path):
    sequence = EurocSequence(write_sequence(tmp_path))
    np.testing.assert_array_equal(np.isnan(sequence.poses).all(axis=(1, 2)), [True, False, False, True])
    # Frame 1 is a third of the way: 20° about z and (1, 2, 3); the camera is turned 90° on the body, at 0.5 along x.
    angle = np.deg2rad(20.0)
    c, s = np.cos(angle + np.pi / 2), np.sin(angle + np.pi / 2)
    np.testing.assert_allclose(sequence.poses[1, :, :3], [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(
        sequence.poses[1, :, 3], [1 + 0.5 * np.cos(angle), 2 + 0.5 * np.sin(angle), 3], atol=1e-6
    )
    # Frame 2 is at the very time of the last row: half a turn about x.
    np.testing.assert_allclose(sequence.poses[2, :, 3], [4.5, 4, 4], atol=1e-6)
    np.testing.assert_allclose(sequence.poses[2, :, :3], [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-6)
    # A limit below the 30 ms between the first rows; frame 2 still has its own.
    sequence = EurocSequence(tmp_path / "MH_09", max_gap_s=0.02)
    np.testing.assert_array_equal(np.isnan(sequence.poses).all(axis=(1, 2)), [True, True, False, True])


def test_monocular_and_a_truth_beside(tmp_path):
    root = write_sequence(tmp_path, cameras=1, truth=False)
    sequence = EurocSequence(root, stereo=False)
    assert sequence.poses is None
    assert sequence.cam1_from_cam0 is None
    assert len(sequence.cameras) == 1
    assert sequence.images(0)[1] is None
    with pytest.raises(FileNotFoundError, match=r"has no cam1.*stereo=False") as caught:
        EurocSequence(root)
    one_line(caught)
    beside = tmp_path / "truth.csv"
    beside.write_text(truth_row(START, (1, 2, 3), (1, 0, 0, 0), rest=False))
    sequence = EurocSequence(root, stereo=False, truth=beside)
    np.testing.assert_allclose(sequence.poses[0, :, 3], [1.5, 2, 3], atol=1e-6)
    assert np.isnan(sequence.poses[1:]).all()
    with pytest.raises(FileNotFoundError, match=r"none\.csv not found"):
        EurocSequence(root, stereo=False, truth=tmp_path / "none.csv")


def test_unsynchronised_pairs(tmp_path):
    root = write_sequence(tmp_path)
    path = root / "mav0" / "cam1" / "data.csv"
    whole = path.read_text()
    path.write_text(whole[: whole.rindex(f"{STAMPS[3]},")])
    with pytest.raises(ValueError, match="has 4 images of cam0 and 3 of cam1") as caught:
        EurocSequence(root)
    one_line(caught)
    path.write_text(whole.replace(f"{STAMPS[2]},", f"{STAMPS[2] + 1_000_001},"))
    with pytest.raises(
        ValueError, match=f"image 2 is of {STAMPS[2]} ns in cam0 and of {STAMPS[2] + 1_000_001}"
    ) as caught:
        EurocSequence(root)
    one_line(caught)
    path.write_text(whole.replace(f"{STAMPS[2]},", f"{STAMPS[2] + 1000},"))
    assert len(EurocSequence(root)) == 4


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("cam0/data.csv", f"{START},a.png,7\n", "line 1, has 3 columns: expected 'nanoseconds,file'"),
        ("cam0/data.csv", "#time,file\n", "lists no images"),
        ("cam0/data.csv", f"#\n1.5,{START}.png\n", "line 2, has '1.5' for its time: expected a whole number"),
        ("cam1/data.csv", f"7,{START}.png\n5,{START}.png\n", "line 2: 5 ns follows 7 ns"),
        ("state_groundtruth_estimate0/data.csv", "1,2,3\n", "line 1, has 3 columns: expected 8 or 17"),
        ("state_groundtruth_estimate0/data.csv", "1,0,0,0,1,0,0,x\n", "line 1, from column 2 on, holds something"),
        ("state_groundtruth_estimate0/data.csv", "1,0,0,0,1,0,0,1\n", "line 1: the quaternion .* has length 1.414"),
        ("state_groundtruth_estimate0/data.csv", "2,0,0,0,1,0,0,0\n2,0,0,0,1,0,0,0\n", "line 2: 2 ns follows 2 ns"),
        ("state_groundtruth_estimate0/data.csv", "2,0,0,0,1,0,0,0\n", "covers no image"),
        ("state_groundtruth_estimate0/data.csv", "", "holds no poses"),
        ("cam0/sensor.yaml", "intrinsics: [1, 2]\n", "camera_model"),
        ("cam1/sensor.yaml", SENSOR[SENSOR.index("resolution") :].format(width=64, cx=31), "has no T_BS"),
    ],
)
def test_bad_text(tmp_path, file, text, message):
    root = write_sequence(tmp_path)
    (root / "mav0" / file).write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        EurocSequence(root)
    assert file in one_line(caught)


@pytest.mark.parametrize("part", ["cam0", "cam0/data.csv", "cam0/sensor.yaml", "cam1/data.csv", "cam1/sensor.yaml"])
def test_missing_parts(tmp_path, part):
    root = write_sequence(tmp_path)
    path = root / "mav0" / part
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(FileNotFoundError, match=part) as caught:
        EurocSequence(root)
    one_line(caught)


def test_missing_folder_and_image(tmp_path):
    with pytest.raises(FileNotFoundError, match="EuRoC folder"):
        EurocSequence(tmp_path / "nowhere")
    root = write_sequence(tmp_path)
    (root / "mav0" / "cam1" / "data" / f"{STAMPS[1]}.png").unlink()
    with pytest.raises(FileNotFoundError, match=f"{STAMPS[1]}.png not found: expected it from .*line 3") as caught:
        EurocSequence(root)
    one_line(caught)


def test_damaged_images_and_another_size(tmp_path):
    root = write_sequence(tmp_path)
    path = root / "mav0" / "cam1" / "data" / f"{STAMPS[1]}.png"
    path.write_bytes(path.read_bytes()[:60])
    cv2.imwrite(str(root / "mav0" / "cam1" / "data" / f"{STAMPS[2]}.png"), np.zeros((24, 32), np.uint8))
    sequence = EurocSequence(root)
    with pytest.raises(ValueError, match=f"cam1/data/{STAMPS[1]}.png is damaged") as caught:
        sequence.images(1)
    one_line(caught)
    with pytest.raises(ValueError, match="has 32×24 pixels and its calibration is for 64×48") as caught:
        sequence.images(2)
    one_line(caught)
    assert sequence.images(3)[0].shape == (48, 64)


@pytest.mark.data
def test_real_sequence(data_root):
    root = data_root / "euroc" / "V1_01_easy"
    assert EurocSequence(root).poses is None
    sequence = EurocSequence(root, truth=root / "gt_V1_01_easy_openvins.csv")
    assert len(sequence) == 12
    assert sequence.name == "V1_01_easy"
    assert sequence.size == (752, 480)
    left, right = sequence.images(11)
    assert left.shape == right.shape == (480, 752)
    relative = np.asarray(sequence.cam1_from_cam0.wxyz_xyz)
    assert np.linalg.norm(relative[4:]) == pytest.approx(0.11007, abs=2e-5)
    assert relative[4] < -0.10
    assert not np.isnan(sequence.poses).any()
    # Body pose of the first row times T_BS, both by hand from the files.
    w, x, y, z = 0.069433, -0.824237, -0.106942, -0.551702
    body = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    position = body @ [-0.0216401454975, -0.064676986768, 0.00981073058949] + [0.878895, 2.1834, 0.948427]
    np.testing.assert_allclose(sequence.poses[0, :, 3], position, atol=1e-5)
    # At rest.
    assert np.abs(sequence.poses[:, :, 3] - sequence.poses[0, :, 3]).max() < 0.005
