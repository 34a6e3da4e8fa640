import cv2
import numpy as np
import pytest

from vojax.cameras import Pinhole
from vojax.datasets import DepthSequence, SevenScenesSequence

FRAMES = (0, 1, 4)
SIZE = (480, 640)
TURN = "0 -1 0 {} 1 0 0 0 0 0 1 0 0 0 0 1"


def one_line(caught):
    assert "\n" not in str(caught.value)
    return str(caught.value)


def rows(text, columns=4):
    words = text.split()
    return "\n".join(" ".join(words[i : i + columns]) for i in range(0, len(words), columns)) + "\n"


def write_sequence(root, suffix="png", size=SIZE):
    folder = root / "seq-01"
    folder.mkdir()
    for k in FRAMES:
        name = f"frame-{k:06d}"
        cv2.imwrite(str(folder / f"{name}.color.{suffix}"), np.full((*size, 3), (0, 0, 40 * k), np.uint8))
        depth = np.full(size, 1500 + k, np.uint16)
        depth[0, :2] = 0, 65535
        cv2.imwrite(str(folder / f"{name}.depth.png"), depth)
        (folder / f"{name}.pose.txt").write_text(rows(TURN.format(k)))
    return folder


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_whole_sequence(tmp_path, suffix):
    sequence = SevenScenesSequence(write_sequence(tmp_path, suffix))
    assert isinstance(sequence, DepthSequence)
    assert len(sequence) == 3
    assert sequence.name == "seq-01"
    assert sequence.frame_names == ["frame-000000", "frame-000001", "frame-000004"]
    # A frame that is missing takes its time.
    np.testing.assert_allclose(sequence.times, [0, 1 / 30, 4 / 30])
    np.testing.assert_array_equal(sequence.poses[2], [[0, -1, 0, 4], [1, 0, 0, 0], [0, 0, 1, 0]])
    assert [float(p) for p in (sequence.camera.fx, sequence.camera.fy)] == [585, 585]
    assert [float(p) for p in (sequence.camera.cx, sequence.camera.cy)] == [320, 240]
    image, right = sequence.images(-1)
    assert right is None
    assert abs(int(image[9, 9, 0]) - 160) < 4
    depth = sequence.depth(1)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth[0, :3], np.float32([0, 0, 1.501]))
    with pytest.raises(IndexError, match="expected 0 to 2"):
        sequence.depth(3)


def test_intrinsics_from_the_file_or_given(tmp_path):
    folder = write_sequence(tmp_path)
    (folder / "camera-intrinsics.txt").write_text("500 0 300\n0 510 200\n0 0 1\n")
    camera = SevenScenesSequence(folder).camera
    assert [float(p) for p in (camera.fx, camera.fy, camera.cx, camera.cy)] == [500, 510, 300, 200]
    own = Pinhole(1.0, 1.0, 2.0, 2.0)
    assert SevenScenesSequence(folder, own).camera is own


def test_without_depth_and_truth(tmp_path):
    folder = write_sequence(tmp_path)
    (folder / "frame-000001.depth.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"frame-000001\.depth\.png not found") as caught:
        SevenScenesSequence(folder)
    one_line(caught)
    (folder / "frame-000004.pose.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"frame-000004\.pose\.txt not found") as caught:
        SevenScenesSequence(folder, depth=False)
    one_line(caught)
    for k in (0, 1):
        (folder / f"frame-{k:06d}.pose.txt").unlink()
    sequence = SevenScenesSequence(folder, depth=False)
    assert sequence.poses is None
    with pytest.raises(ValueError, match="opened with depth=False"):
        sequence.depth(0)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("frame-000001.pose.txt", rows(TURN.format(1)[:-2], 4), "line 4, has 3 columns: expected 4"),
        ("frame-000001.pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n", "has 3 rows: expected a 4×4 pose"),
        ("frame-000001.pose.txt", rows(TURN.format("nan")), "line 1, holds NaN"),
        ("frame-000001.pose.txt", rows("2" + TURN.format(1)[1:]), "is not a rotation"),
        ("frame-000001.pose.txt", rows(TURN.format(1)[:-1] + "2"), "the last row is"),
        ("camera-intrinsics.txt", "500 0 300\n0 510 200\n", "has 2 rows: expected a 3×3"),
        ("camera-intrinsics.txt", "-5 0 300\n0 510 200\n0 0 1\n", "positive focal lengths"),
        ("camera-intrinsics.txt", "500 0 300\n0 a 200\n0 0 1\n", "line 2, holds something"),
    ],
)
def test_bad_text(tmp_path, file, text, message):
    folder = write_sequence(tmp_path)
    (folder / file).write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        SevenScenesSequence(folder)
    assert file in one_line(caught)


def test_missing_folder_and_frames(tmp_path):
    for wrong, message in ((tmp_path / "nowhere", "not found"), (tmp_path, "holds no colour images")):
        with pytest.raises(FileNotFoundError, match=message) as caught:
            SevenScenesSequence(wrong)
        one_line(caught)
    folder = write_sequence(tmp_path)
    cv2.imwrite(str(folder / "frame-000000.color.jpg"), np.zeros((4, 4), np.uint8))
    with pytest.raises(ValueError, match="expected one colour image per frame"):
        SevenScenesSequence(folder)


def test_damaged_images_and_another_size(tmp_path):
    folder = write_sequence(tmp_path)
    for kind in ("color", "depth"):
        path = folder / f"frame-000001.{kind}.png"
        path.write_bytes(path.read_bytes()[:100])
    cv2.imwrite(str(folder / "frame-000004.color.png"), np.zeros((240, 320, 3), np.uint8))
    sequence = SevenScenesSequence(folder)
    for read in (sequence.images, sequence.depth):
        with pytest.raises(ValueError, match=r"frame-000001\..*is damaged") as caught:
            read(1)
        one_line(caught)
    with pytest.raises(ValueError, match="has 320×240 pixels and its calibration is for 640×480") as caught:
        sequence.images(2)
    one_line(caught)
    assert sequence.images(0)[0].shape == (480, 640, 3)
    assert sequence.depth(2).shape == (480, 640)


@pytest.mark.data
def test_real_frames_agree_in_space(data_root):
    sequence = SevenScenesSequence(data_root / "7scenes")
    assert len(sequence) == len(sequence.poses) == 100
    assert float(sequence.camera.fx) == 585
    image, _ = sequence.images(0)
    assert image.shape == (480, 640, 3)
    assert sequence.times[-1] == pytest.approx(99 / 30)
    # Points of one frame fall on the depths of another, three seconds later: poses, intrinsics and unit are right.
    first, other = sequence.depth(0), sequence.depth(60)
    v, u = np.mgrid[4:480:8, 4:640:8]
    z = first[v, u]
    points = np.stack([(u - 320) / 585 * z, (v - 240) / 585 * z, z], axis=-1)[(z > 0) & (z < 4)].astype(float)
    world = points @ sequence.poses[0, :, :3].T + sequence.poses[0, :, 3]
    seen = (world - sequence.poses[60, :, 3]) @ sequence.poses[60, :, :3]
    pixel = np.rint(585 * seen[:, :2] / seen[:, 2:] + [320, 240]).astype(int)
    inside = (seen[:, 2] > 0.3) & np.all((pixel >= 0) & (pixel < [640, 480]), axis=1)
    found = other[pixel[inside, 1], pixel[inside, 0]]
    error = np.abs(found - seen[inside, 2])[found > 0]
    moved = np.abs(points[inside, 2] - seen[inside, 2])[found > 0]
    assert len(error) > 1000
    assert np.median(error) < 0.03
    assert np.median(moved) > 2 * np.median(error)
