import cv2
import numpy as np
import pytest

from vojax.cameras import BrownConrady, Pinhole
from vojax.datasets import DepthSequence, TumSequence

# A depth frame is missing near 1.10, one lies too far from 1.15, and the truth ends before 1.15.
COLOR = [1.0, 1.05, 1.10, 1.15]
DEPTH = [1.01, 1.04, 1.18]
TRUTH = [0.995, 1.004, 1.05]


def one_line(caught):
    assert "\n" not in str(caught.value)
    return str(caught.value)


def write_sequence(root, name="rgbd_dataset_freiburg3_desk", shape=(480, 640)):
    folder = root / name
    for kind, times in (("rgb", COLOR), ("depth", DEPTH)):
        (folder / kind).mkdir(parents=True)
        for k, t in enumerate(times):
            image = np.full((*shape, 3), 10 * k, np.uint8) if kind == "rgb" else np.full(shape, 5000 + k, np.uint16)
            image[0, 0] = 0
            cv2.imwrite(str(folder / kind / f"{t:.6f}.png"), image)
        rows = "".join(f"{t:.6f} {kind}/{t:.6f}.png\n" for t in times)
        (folder / f"{kind}.txt").write_text(f"# images\n# timestamp filename\n{rows}")
    # Half a turn about z, then a quarter about x.
    half = 0.5**0.5
    turns = ["0 0 1 0", "0 0 1 0", f"{half} 0 0 {half}"]
    rows = "".join(f"{t} {k} {2 * k} {3 * k} {q}\n" for k, (t, q) in enumerate(zip(TRUTH, turns, strict=True)))
    (folder / "groundtruth.txt").write_text(f"# truth\n{rows}")
    return folder


def test_association_by_the_nearest_time(tmp_path):
    sequence = TumSequence(write_sequence(tmp_path))
    assert isinstance(sequence, DepthSequence)
    assert sequence.name == "rgbd_dataset_freiburg3_desk"
    assert len(sequence) == 2
    np.testing.assert_array_equal(sequence.times, [1.0, 1.05])
    assert sequence.frame_names == ["1.000000", "1.050000"]
    # The second pose is nearer to the first image than the first pose (4 ms against 5 ms).
    np.testing.assert_allclose(sequence.poses[:, :, 3], [[1, 2, 3], [2, 4, 6]])
    np.testing.assert_allclose(sequence.poses[0, :, :3], np.diag([-1.0, -1, 1]), atol=1e-12)
    np.testing.assert_allclose(sequence.poses[1, :, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
    image, right = sequence.images(1)
    assert image.shape == (480, 640, 3)
    assert image[5, 5, 0] == 10
    assert right is None
    depth = sequence.depth(-1)
    assert depth.dtype == np.float32
    assert depth[0, 0] == 0
    assert depth[5, 5] == np.float32(5001 / 5000)
    for read in (sequence.images, sequence.depth):
        with pytest.raises(IndexError, match="expected 0 to 1"):
            read(2)


def test_a_depth_serves_one_image(tmp_path):
    folder = write_sequence(tmp_path)
    (folder / "depth.txt").write_text("1.028 depth/1.010000.png\n1.1 depth/1.040000.png\n")
    sequence = TumSequence(folder, max_difference_s=0.03)
    # 1.028 is 28 ms from the first image and 22 ms from the second.
    np.testing.assert_array_equal(sequence.times, [1.05, 1.10])


def test_colour_alone_keeps_all_and_marks_the_unknown_truth(tmp_path):
    folder = write_sequence(tmp_path)
    (folder / "depth.txt").unlink()
    sequence = TumSequence(folder, depth=False)
    np.testing.assert_array_equal(sequence.times, COLOR)
    np.testing.assert_array_equal(np.isnan(sequence.poses).all(axis=(1, 2)), [False, False, True, True])
    assert not np.isnan(sequence.poses[:2]).any()
    with pytest.raises(ValueError, match="opened with depth=False"):
        sequence.depth(0)
    with pytest.raises(FileNotFoundError, match=r"depth\.txt not found"):
        TumSequence(folder)
    (folder / "groundtruth.txt").unlink()
    assert TumSequence(folder, depth=False).poses is None


@pytest.mark.parametrize(
    ("name", "fx", "kind"),
    [
        ("rgbd_dataset_freiburg1_xyz", 517.3, BrownConrady),
        ("fr2_desk", 520.9, BrownConrady),
        ("rgbd_dataset_freiburg3_long_office", 535.4, Pinhole),
    ],
)
def test_published_calibration_by_name(tmp_path, name, fx, kind):
    camera = TumSequence(write_sequence(tmp_path, name)).camera
    assert isinstance(camera, kind)
    assert float(camera.fx) == pytest.approx(fx)
    if name == "fr2_desk":
        assert float(camera.k3) == pytest.approx(0.9172)
        assert float(camera.p2) == pytest.approx(-0.0001)


def test_camera_of_ones_own(tmp_path):
    folder = write_sequence(tmp_path, "mine", shape=(24, 32))
    with pytest.raises(ValueError, match="'mine' does not tell which camera") as caught:
        TumSequence(folder)
    one_line(caught)
    sequence = TumSequence(folder, Pinhole(30.0, 30.0, 15.5, 11.5))
    assert sequence.images(0)[0].shape == (24, 32, 3)
    assert sequence.depth(0).shape == (24, 32)


def test_calibration_for_another_size(tmp_path):
    folder = write_sequence(tmp_path, shape=(240, 320))
    sequence = TumSequence(folder)
    for read in (sequence.images, sequence.depth):
        with pytest.raises(ValueError, match="has 320×240 pixels and its calibration is for 640×480") as caught:
            read(0)
        one_line(caught)
    sequence = TumSequence(folder, Pinhole(500.0, 500.0, 320.0, 240.0))
    with pytest.raises(ValueError, match=r"principal point at \(320, 240\), outside") as caught:
        sequence.images(0)
    one_line(caught)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("rgb.txt", "1.0 rgb/1.000000.png\n1.1\n", "line 2, has 1 columns: expected 'time file'"),
        ("rgb.txt", "# only this\n", "lists no images"),
        ("rgb.txt", "#\nx rgb/1.000000.png\n", "line 2, column 1, holds something that is not a number"),
        ("rgb.txt", "2.0 rgb/1.000000.png\n1.5 rgb/1.050000.png\n", "line 2: 1.5 s follows 2.0 s"),
        ("depth.txt", "1 depth/1.010000.png\n1 depth/1.040000.png\n", "line 2: 1.0 s follows 1.0 s"),
        ("depth.txt", "9.0 depth/1.010000.png\n", "no depth image within 0.02 s of a colour one"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 1\n", "line 1, has 7 columns: expected 8"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0 nan\n", "line 1, holds NaN"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0 2\n", "line 1: the quaternion qx qy qz qw has length 2: expected 1"),
        ("groundtruth.txt", "2.0 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n", "line 2: 1.0 s follows 2.0 s"),
        ("groundtruth.txt", "9.0 0 0 0 0 0 0 1\n", "no pose within 0.02 s of an image"),
        ("groundtruth.txt", "#\n", "holds no poses"),
    ],
)
def test_bad_text(tmp_path, file, text, message):
    folder = write_sequence(tmp_path)
    (folder / file).write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        TumSequence(folder)
    assert file in one_line(caught)


def test_missing_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"TUM folder .*nowhere not found"):
        TumSequence(tmp_path / "nowhere")
    folder = write_sequence(tmp_path)
    (folder / "depth" / "1.040000.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"1\.040000\.png not found: expected it from .*line 4") as caught:
        TumSequence(folder)
    one_line(caught)
    (folder / "rgb.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"rgb\.txt not found") as caught:
        TumSequence(folder)
    one_line(caught)
    with pytest.raises(ValueError, match="max_difference_s"):
        TumSequence(folder, max_difference_s=-1.0)


def test_damaged_images_when_read(tmp_path):
    folder = write_sequence(tmp_path)
    path = folder / "rgb" / "1.000000.png"
    path.write_bytes(path.read_bytes()[:200])
    cv2.imwrite(str(folder / "depth" / "1.010000.png"), np.zeros((480, 640), np.uint8))
    sequence = TumSequence(folder)
    with pytest.raises(ValueError, match=r"1\.000000\.png is damaged") as caught:
        sequence.images(0)
    one_line(caught)
    with pytest.raises(ValueError, match=r"holds uint8 .*expected depths, 16 bits") as caught:
        sequence.depth(0)
    one_line(caught)
    assert sequence.images(1)[0].shape == (480, 640, 3)
    assert sequence.depth(1).shape == (480, 640)


@pytest.mark.data
def test_real_truth(data_root, tmp_path):
    """The published truth of a sequence whose images are not there: poses come out as its rows say."""
    folder = write_sequence(tmp_path, "rgbd_dataset_freiburg1_xyz")
    truth = (data_root / "trajectories" / "freiburg1_xyz-groundtruth.txt").read_text()
    (folder / "groundtruth.txt").write_text(truth)
    rows = np.loadtxt(truth.splitlines())
    files = [f"rgb/{t:.6f}.png" for t in COLOR]
    times = rows[[10, 500, 1000, 2000], 0] + 0.001
    (folder / "rgb.txt").write_text("".join(f"{t:.6f} {f}\n" for t, f in zip(times, files, strict=True)))
    sequence = TumSequence(folder, depth=False)
    np.testing.assert_allclose(sequence.poses[:, :, 3], rows[[10, 500, 1000, 2000], 1:4], atol=1e-12)
    # The z axis of a camera with quaternion (x, y, z, w).
    x, y, z, w = rows[500, 4:]
    np.testing.assert_allclose(
        sequence.poses[1, :, 2], [2 * (x * z + w * y), 2 * (y * z - w * x), w * w + z * z - x * x - y * y], atol=2e-4
    )
