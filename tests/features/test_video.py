import cv2
import numpy as np
import pytest

from vojax.features import VideoReader

FRAMES = 12


def write_video(path, codec, frames=FRAMES):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 10.0, (96, 64))
    assert writer.isOpened()
    for k in range(frames):
        image = np.full((64, 96, 3), 15 * k + 20, np.uint8)
        image[:, :48, 0] += 40  # the left half is bluer
        writer.write(image)
    writer.release()
    return path


def number(image):
    """Which frame it is, by its brightness."""
    return round((float(np.median(image[:, 60:])) - 20) / 15)


def damage(path, frame):
    """Overwrite one picture of a Motion-JPEG file."""
    data = path.read_bytes()
    starts = [i for i in range(len(data) - 3) if data[i : i + 3] == b"\xff\xd8\xff"]
    assert len(starts) == FRAMES
    # The next picture's chunk starts 8 bytes before it.
    end = starts[frame + 1] - 8
    path.write_bytes(data[: starts[frame]] + bytes(end - starts[frame]) + data[end:])


@pytest.mark.parametrize(("name", "codec"), [("a.avi", "MJPG"), ("a.mp4", "mp4v"), ("a.mkv", "MJPG")])
def test_frames_by_number_in_any_order(tmp_path, name, codec):
    video = VideoReader(write_video(tmp_path / name, codec))
    assert len(video) == FRAMES
    assert video.fps == pytest.approx(10.0)
    for k in [*range(FRAMES), 3, 3, 7, 0, 11]:
        image = video.read(k)
        assert image.shape == (64, 96, 3)
        assert number(image) == k
    # RGB: blue comes last.
    image = video.read(4).astype(int)
    assert np.median(image[:, 5:40, 2] - image[:, 5:40, 0]) > 30
    for k in (-1, FRAMES):
        with pytest.raises(IndexError, match="expected 0 to 11"):
            video.read(k)


def test_a_damaged_frame_leaves_the_others(tmp_path):
    path = write_video(tmp_path / "a.avi", "MJPG")
    damage(path, 5)
    damaged = VideoReader(path)
    for k in [*range(FRAMES), 5, 2]:
        if k == 5:
            with pytest.raises(ValueError, match=r"frame 5 of video .*a\.avi is damaged") as caught:
                damaged.read(k)
            assert "\n" not in str(caught.value)
        else:
            assert number(damaged.read(k)) == k


@pytest.mark.parametrize("in_order", [True, False])
def test_a_video_that_ends_early(tmp_path, in_order):
    path = write_video(tmp_path / "a.avi", "MJPG")
    data = path.read_bytes()
    fourth = [i for i in range(len(data) - 3) if data[i : i + 3] == b"\xff\xd8\xff"][4]
    path.write_bytes(data[: fourth - 8])
    video = VideoReader(path)
    assert len(video) == FRAMES
    for k in range(4) if in_order else ():
        assert number(video.read(k)) == k
    for k in (8, 4, 11):
        with pytest.raises(ValueError, match=f"frame {k} of .*ends after 4 frames, expected 12") as caught:
            video.read(k)
        assert "\n" not in str(caught.value)
    assert number(video.read(3)) == 3


def test_what_is_no_video(tmp_path):
    with pytest.raises(FileNotFoundError, match="not found"):
        VideoReader(tmp_path / "none.mp4")
    path = write_video(tmp_path / "a.mp4", "mp4v")
    path.write_bytes(path.read_bytes()[:1500])
    (tmp_path / "text.avi").write_text("no video")
    for wrong in (path, tmp_path / "text.avi", tmp_path):
        with pytest.raises(ValueError, match="cannot be opened") as caught:
            VideoReader(wrong)
        assert "\n" not in str(caught.value)
