import cv2
import numpy as np
import pytest

from vojax.cameras import BrownConrady, CameraSet, Pinhole, write_cameras
from vojax.datasets import FrameSequence, ImageSequence

NAMES = ["img1.png", "img2.png", "img10.png"]
CAMERA = Pinhole(50.0, 50.0, 31.5, 23.5)


def one_line(caught):
    assert "\n" not in str(caught.value)
    return str(caught.value)


def write_folder(root, size=(48, 64)):
    folder = root / "walk"
    folder.mkdir()
    for k, name in enumerate(NAMES):
        cv2.imwrite(str(folder / name), np.full((*size, 3), (0, 0, 50 * k), np.uint8))
    (folder / "notes.txt").write_text("no image")
    calibration = root / "camera.yaml"
    write_cameras(calibration, CameraSet({"front": CAMERA}, {"front": (64, 48)}))
    return folder, calibration


def write_video(root, frames=6):
    path = root / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (64, 48))
    for k in range(frames):
        writer.write(np.full((48, 64, 3), 30 * k + 20, np.uint8))
    writer.release()
    return path


def test_a_folder(tmp_path):
    folder, calibration = write_folder(tmp_path)
    sequence = ImageSequence(folder, calibration)
    assert isinstance(sequence, FrameSequence)
    assert len(sequence) == 3
    assert sequence.name == "walk"
    assert sequence.frame_names == ["img1", "img2", "img10"]
    np.testing.assert_array_equal(sequence.times, [0, 1, 2])
    assert sequence.poses is None
    assert float(sequence.camera.cx) == 31.5
    assert sequence.size == (64, 48)
    image, right = sequence.images(-1)
    assert image[3, 3].tolist() == [100, 0, 0]
    assert right is None
    with pytest.raises(IndexError, match="expected 0 to 2"):
        sequence.images(3)
    np.testing.assert_allclose(ImageSequence(folder, calibration, fps=20).times, [0, 0.05, 0.1])
    times = tmp_path / "times.txt"
    times.write_text("# seconds\n5.0\n5.5\n7.25\n")
    np.testing.assert_array_equal(ImageSequence(folder, calibration, times=times).times, [5, 5.5, 7.25])


def test_a_video(tmp_path):
    path = write_video(tmp_path)
    calibration = tmp_path / "cameras.txt"
    calibration.write_text("1 PINHOLE 64 48 50 50 32 24\n")
    sequence = ImageSequence(path, calibration)
    assert len(sequence) == 6
    assert sequence.frame_names[4] == "000004"
    np.testing.assert_allclose(sequence.times, np.arange(6) / 25)
    np.testing.assert_allclose(ImageSequence(path, calibration, fps=5).times, np.arange(6) / 5)
    for k in (0, 1, 5, -4):
        image, _ = sequence.images(k)
        assert image.shape == (48, 64, 3)
        assert abs(int(image[9, 9, 1]) - 30 * (k % 6) - 20) < 5


def test_a_video_that_ends_early(tmp_path):
    path = write_video(tmp_path)
    data = path.read_bytes()
    starts = [i for i in range(len(data) - 3) if data[i : i + 3] == b"\xff\xd8\xff"]
    path.write_bytes(data[: starts[4] - 8])
    sequence = ImageSequence(path, CameraSet({"camera": CAMERA}))
    assert len(sequence) == 6
    for k in range(4):
        sequence.images(k)
    with pytest.raises(ValueError, match=r"frame 4 of video .*ends after 4 frames, expected 6") as caught:
        sequence.images(4)
    one_line(caught)
    assert sequence.images(2)[0].shape == (48, 64, 3)


def test_a_video_with_a_damaged_frame(tmp_path):
    path = write_video(tmp_path)
    data = path.read_bytes()
    starts = [i for i in range(len(data) - 3) if data[i : i + 3] == b"\xff\xd8\xff"]
    path.write_bytes(data[: starts[2]] + bytes(starts[3] - 8 - starts[2]) + data[starts[3] - 8 :])
    sequence = ImageSequence(path, CameraSet({"camera": CAMERA}))
    with pytest.raises(ValueError, match=r"frame 2 of video .* is damaged") as caught:
        sequence.images(2)
    one_line(caught)
    assert abs(int(sequence.images(3)[0][9, 9, 0]) - 110) < 5


def test_one_of_several_cameras(tmp_path):
    folder, _ = write_folder(tmp_path)
    cameras = CameraSet({"left": CAMERA, "right": BrownConrady(60.0, 60.0, 30.0, 20.0)})
    assert isinstance(ImageSequence(folder, cameras, camera_name="right").camera, BrownConrady)
    with pytest.raises(ValueError, match="holds cameras left, right: choose one with camera_name=") as caught:
        ImageSequence(folder, cameras)
    one_line(caught)
    with pytest.raises(ValueError, match="has no camera 'top': expected one of left, right") as caught:
        ImageSequence(folder, cameras, camera_name="top")
    one_line(caught)


def test_calibration_for_another_size(tmp_path):
    folder, calibration = write_folder(tmp_path, size=(24, 32))
    with pytest.raises(ValueError, match=r"img1\.png has 32×24 pixels and its calibration is for 64×48") as caught:
        ImageSequence(folder, calibration).images(0)
    one_line(caught)
    sequence = ImageSequence(folder, CameraSet({"camera": Pinhole(50.0, 50.0, 20.0, 23.5)}))
    with pytest.raises(ValueError, match=r"principal point at \(20, 23\.5\), outside") as caught:
        sequence.images(0)
    one_line(caught)


def test_a_damaged_image_in_the_middle(tmp_path):
    folder, calibration = write_folder(tmp_path)
    path = folder / "img2.png"
    path.write_bytes(path.read_bytes()[:50])
    sequence = ImageSequence(folder, calibration)
    with pytest.raises(ValueError, match=r"img2\.png is damaged") as caught:
        sequence.images(1)
    one_line(caught)
    assert sequence.images(2)[0][0, 0, 0] == 100


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1\n2\n", "has 2 times for 3 images"),
        ("1\n\n2\n2\n", "line 4: 2.0 s follows 2.0 s"),
        ("1\n2 3\n4\n", "line 2, has 2 columns"),
        ("1\n2\nnan\n", "line 3, holds NaN"),
    ],
)
def test_bad_times(tmp_path, text, message):
    folder, calibration = write_folder(tmp_path)
    times = tmp_path / "times.txt"
    times.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        ImageSequence(folder, calibration, times=times)
    assert "times.txt" in one_line(caught)


def test_missing_files_and_bad_options(tmp_path):
    folder, calibration = write_folder(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mp4").write_text("no video")
    for path, file, options, error, message in (
        (
            tmp_path / "none",
            calibration,
            {},
            FileNotFoundError,
            "none not found: expected a folder of images or a video",
        ),
        (tmp_path / "empty", calibration, {}, FileNotFoundError, "holds no images"),
        (tmp_path / "text.mp4", calibration, {}, ValueError, "cannot be opened"),
        (folder, tmp_path / "none.yaml", {}, FileNotFoundError, r"none\.yaml"),
        (folder, folder / "notes.txt", {}, ValueError, "is no calibration file"),
        (folder, calibration, {"times": tmp_path / "t.txt"}, FileNotFoundError, r"t\.txt not found"),
        (folder, calibration, {"fps": 0.0}, ValueError, "fps is 0"),
        (folder, calibration, {"fps": float("nan")}, ValueError, "fps is nan"),
        (folder, calibration, {"fps": 5.0, "times": tmp_path / "t.txt"}, ValueError, "expected one of them"),
    ):
        with pytest.raises(error, match=message) as caught:
            ImageSequence(path, file, **options)
        one_line(caught)


@pytest.mark.data
def test_real_images(data_root):
    sequence = ImageSequence(
        data_root / "kitti" / "sequences" / "06" / "image_0",
        data_root / "kitti" / "sequences" / "06" / "calib.txt",
        camera_name="P0",
        times=data_root / "kitti" / "sequences" / "06" / "times.txt",
    )
    assert len(sequence) == 51
    assert sequence.images(50)[0].shape == (370, 1226)
    assert np.median(np.diff(sequence.times)) == pytest.approx(0.1, abs=0.01)
