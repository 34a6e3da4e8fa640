import cv2
import numpy as np
import pytest

from vojax.features import read_image, to_gray


def gradient_image(dtype=np.uint8, channels=None):
    top = np.iinfo(dtype).max
    image = np.add.outer(np.arange(60), 2 * np.arange(90)).astype(np.float64)
    image = image / image.max() * top
    if channels:
        image = np.stack([image, image[::-1], image[:, ::-1]], axis=-1)
    return image.astype(dtype)


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".pgm"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_images_come_back_as_stored(tmp_path, suffix, dtype):
    image = gradient_image(dtype)
    assert cv2.imwrite(str(tmp_path / f"a{suffix}"), image)
    read = read_image(tmp_path / f"a{suffix}")
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, image)


def test_colour_is_rgb(tmp_path):
    image = gradient_image(channels=3)
    cv2.imwrite(str(tmp_path / "a.png"), image[:, :, ::-1])
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), image)
    assert to_gray(image).shape == image.shape[:2]


def test_whole_jpeg_is_read(tmp_path):
    cv2.imwrite(str(tmp_path / "a.jpg"), gradient_image())
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - gradient_image()).max() < 10


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".pgm"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.9, 0.999])
def test_truncated_image_is_an_error(tmp_path, suffix, share, capfd):
    path = tmp_path / f"a{suffix}"
    rng = np.random.default_rng(0)
    cv2.imwrite(str(path), rng.integers(0, 255, (80, 120), dtype=np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=f"a{suffix}") as caught:
        read_image(path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == "" or suffix == ".pgm"


def test_png_with_a_flipped_byte_is_an_error(tmp_path, capfd):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), gradient_image())
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x55
    path.write_bytes(bytes(data))
    with pytest.raises(ValueError, match="checksum"):
        read_image(path)
    assert capfd.readouterr().err == ""


def test_missing_empty_and_foreign_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="not found"):
        read_image(tmp_path / "none.png")
    (tmp_path / "empty.png").touch()
    with pytest.raises(ValueError, match="is empty"):
        read_image(tmp_path / "empty.png")
    (tmp_path / "text.png").write_text("this is no image")
    with pytest.raises(ValueError, match="cannot be decoded"):
        read_image(tmp_path / "text.png")
    with pytest.raises(ValueError, match="cannot be read"):
        read_image(tmp_path)


def test_to_gray_refuses_other_types():
    with pytest.raises(ValueError, match="uint16"):
        to_gray(gradient_image(np.uint16))
    with pytest.raises(ValueError, match="shape"):
        to_gray(np.zeros((4, 5, 7), np.uint8))
