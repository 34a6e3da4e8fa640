import shutil

import cv2
import numpy as np
import pytest

from vojax.datasets import KittiSequence

FRAMES = 3
ROW = "700 0 60 {} 0 700 30 0 0 0 1 0"


def write_sequence(root, name="07", stereo=True, poses=True):
    rng = np.random.default_rng(0)
    folder = root / "sequences" / name
    for camera in ("image_0", "image_1") if stereo else ("image_0",):
        (folder / camera).mkdir(parents=True)
        for k in range(FRAMES):
            cv2.imwrite(str(folder / camera / f"{k:06d}.png"), rng.integers(0, 255, (60, 120), dtype=np.uint8))
    (folder / "calib.txt").write_text(f"P0: {ROW.format(0)}\nP1: {ROW.format(-350)}\nTr: 1 2 3\n")
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")
    if poses:
        (root / "poses").mkdir(exist_ok=True)
        lines = [f"1 0 0 {k} 0 1 0 0 0 0 1 {2 * k}" for k in range(FRAMES)]
        (root / "poses" / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return folder


def one_line(caught):
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_whole_sequence(tmp_path):
    write_sequence(tmp_path)
    sequence = KittiSequence(tmp_path, "07")
    assert len(sequence) == FRAMES
    assert float(sequence.stereo.baseline) == pytest.approx(0.5)
    assert float(sequence.camera.fx) == 700
    assert float(sequence.camera.cx) == 60
    np.testing.assert_array_equal(sequence.times, [0, 0.1, 0.2])
    np.testing.assert_array_equal(sequence.poses[2, :, 3], [2, 0, 4])
    assert sequence.frame_names == ["000000", "000001", "000002"]
    left, right = sequence.images(1)
    assert left.shape == right.shape == (60, 120)
    np.testing.assert_array_equal(sequence.images(-1)[0], sequence.images(2)[0])
    with pytest.raises(IndexError, match="expected 0 to 2"):
        sequence.images(3)


def test_monocular_and_without_truth(tmp_path):
    write_sequence(tmp_path, stereo=False, poses=False)
    sequence = KittiSequence(tmp_path, "07", stereo=False)
    assert sequence.stereo is None
    assert sequence.poses is None
    left, right = sequence.images(0)
    assert left.shape == (60, 120)
    assert right is None
    with pytest.raises(FileNotFoundError, match=r"has no image_1.*stereo=False") as caught:
        KittiSequence(tmp_path, "07")
    one_line(caught)


def test_missing_folders_say_what_exists(tmp_path):
    with pytest.raises(FileNotFoundError, match="KITTI folder") as caught:
        KittiSequence(tmp_path / "nowhere", "07")
    one_line(caught)
    with pytest.raises(FileNotFoundError, match="no folder 'sequences'") as caught:
        KittiSequence(tmp_path, "07")
    one_line(caught)
    write_sequence(tmp_path, "07")
    write_sequence(tmp_path, "09")
    for wrong in ("08", "", "../.."):
        with pytest.raises(FileNotFoundError, match=r"\(07, 09\)") as caught:
            KittiSequence(tmp_path, wrong)
        one_line(caught)


@pytest.mark.parametrize("name", ["calib.txt", "times.txt", "image_0", "image_1"])
def test_missing_parts(tmp_path, name):
    path = write_sequence(tmp_path) / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(FileNotFoundError, match=name) as caught:
        KittiSequence(tmp_path, "07")
    one_line(caught)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("calib.txt", "P0: 1 2 3\nP1: 1 2 3\n", "row P0, has 3 columns: expected 12"),
        ("calib.txt", f"P0: {ROW.format(0)}\n", "no row 'P1:'"),
        ("calib.txt", f"P0: {ROW.format(0)}\nP1: {ROW.format('x')}\n", "row P1, holds something that is not a number"),
        ("calib.txt", f"P0: {ROW.format(0)}\nP1: {ROW.format('nan')}\n", "row P1, holds NaN"),
        ("calib.txt", f"P0: {ROW.format(0)}\nP1: {ROW.format(350)}\n", "baseline is -0.5 m"),
        ("calib.txt", f"P0: {ROW.format(0)}\nP1: {ROW.format(-350).replace('700', '710')}\n", "different intrinsics"),
        ("calib.txt", f"P0: {ROW.format(0).replace('700', '-7')}\nP1: {ROW.format(-350)}\n", "positive focal"),
        ("calib.txt", "", "no row 'P0:'"),
        ("times.txt", "0.0\n0.1\n", "has 2 times for 3 images"),
        ("times.txt", "0.0\n0.1\n0.1\n", "line 3: 0.1 s follows 0.1 s"),
        ("times.txt", "0.0\nnan\n0.1\n", "line 2, holds NaN"),
        ("times.txt", "0.0\n0.1 7\n0.2\n", "line 2, has 2 columns"),
    ],
)
def test_bad_text(tmp_path, file, text, message):
    (write_sequence(tmp_path) / file).write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        KittiSequence(tmp_path, "07")
    assert file in one_line(caught)


@pytest.mark.parametrize(
    ("second_line", "message"),
    [
        ("nan 0 0 0 0 1 0 0 0 0 1 0", "line 2, holds NaN"),
        ("1 0 0 0 0 1 0 0 0 0 1", "line 2, has 11 columns"),
        ("1 0 0 0 0 1 0 0 0 0 1.1 0", "line 2: the left 3×3 block is not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", "line 2: the left 3×3 block is not a rotation"),
        ("", "has 2 poses for 3 images"),
    ],
)
def test_bad_poses(tmp_path, second_line, message):
    write_sequence(tmp_path)
    path = tmp_path / "poses" / "07.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], second_line, lines[2]]))
    with pytest.raises(ValueError, match=message) as caught:
        KittiSequence(tmp_path, "07")
    one_line(caught)


def test_images_that_do_not_pair_up(tmp_path):
    folder = write_sequence(tmp_path)
    moved = folder / "image_1" / "000001.png"
    moved.rename(folder / "image_1" / "000009.png")
    with pytest.raises(ValueError, match=r"000001\.png where image_1 has 000002\.png") as caught:
        KittiSequence(tmp_path, "07")
    one_line(caught)
    (folder / "image_1" / "000009.png").unlink()
    with pytest.raises(ValueError, match="3 images in image_0 and 2 in image_1") as caught:
        KittiSequence(tmp_path, "07")
    one_line(caught)
    for path in (folder / "image_0").iterdir():
        path.unlink()
    with pytest.raises(FileNotFoundError, match="holds no images"):
        KittiSequence(tmp_path, "07")


def test_damaged_image_is_an_error_when_read(tmp_path):
    folder = write_sequence(tmp_path)
    path = folder / "image_1" / "000002.png"
    path.write_bytes(path.read_bytes()[:2000])
    cv2.imwrite(str(folder / "image_1" / "000001.png"), np.zeros((30, 120), np.uint8))
    sequence = KittiSequence(tmp_path, "07")
    sequence.images(0)
    with pytest.raises(ValueError, match="expected one size"):
        sequence.images(1)
    with pytest.raises(ValueError, match=r"000002\.png is damaged"):
        sequence.images(2)


def test_calibration_for_images_of_another_size(tmp_path):
    (write_sequence(tmp_path) / "calib.txt").write_text(
        f"P0: {ROW.format(0)}\nP1: {ROW.format(-350)}\n".replace(" 60 ", " 120 ")
    )
    sequence = KittiSequence(tmp_path, "07")
    with pytest.raises(ValueError, match=r"000000\.png has 120×60 pixels .* principal point at \(120, 30\)") as caught:
        sequence.images(0)
    one_line(caught)


@pytest.mark.data
def test_real_sequences(data_root):
    sequence = KittiSequence(data_root / "kitti", "06")
    assert len(sequence) == len(sequence.poses) == 51
    assert float(sequence.stereo.baseline) == pytest.approx(379.8145 / 707.0912, rel=1e-6)
    np.testing.assert_allclose(sequence.poses[0], np.eye(4)[:3], atol=1e-6)
    # 1.2 m a frame, forward along the optical axis.
    np.testing.assert_allclose(sequence.poses[1, :, 3], [0, 0, 1.2], atol=0.05)
    left, right = sequence.images(7)
    assert left.shape == right.shape == (370, 1226)
    assert left.dtype == np.uint8
    monocular = KittiSequence(data_root / "kitti", "00", stereo=False)
    assert len(monocular) == 150
    with pytest.raises(FileNotFoundError, match="no image_1"):
        KittiSequence(data_root / "kitti", "00")
