"""Image files in, arrays out; what a decoder would let through half-grey is an error here."""

import os
import pathlib
import zlib

import cv2
import numpy as np
from jaxtyping import UInt8

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_READ_AGAIN = "copy or download the file again"


def read_image(path: str | os.PathLike[str]) -> np.ndarray:
    """Read an image file as it is stored.

    Decoders return a half-grey picture for a truncated JPEG and print to stderr for a truncated PNG, so the structure
    of both formats is checked before decoding.

    Args:
        path: A file in any format OpenCV decodes (PNG, JPEG, PGM, TIFF, …).

    Returns:
        `[h, w]` for grey images, `[h, w, 3]` in RGB order (`[h, w, 4]` with an alpha channel) for colour; uint8, or
        uint16 where the file holds 16 bits.

    Raises:
        FileNotFoundError: No such file.
        ValueError: The file is empty, truncated, damaged or in no known image format.
    """
    path = pathlib.Path(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise FileNotFoundError(f"image {path} not found: check the path") from None
    except OSError as error:
        raise ValueError(
            f"image {path} cannot be read ({error.strerror}): check the path and its permissions"
        ) from None
    if not data:
        raise ValueError(f"image {path} is empty: {_READ_AGAIN}")
    damage = _damage(data)
    if damage:
        raise ValueError(f"image {path} is damaged ({damage}): {_READ_AGAIN}")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise ValueError(
            f"image {path} cannot be decoded ({len(data)} bytes): expected a whole PNG, JPEG, PGM or TIFF file"
        )
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"image {path} holds {image.dtype} values: expected 8-bit or 16-bit unsigned integers")
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    elif image.ndim == 3 and image.shape[2] == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    elif image.ndim == 3 and image.shape[2] == 4:
        image = cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA)
    return image


def to_gray(image: np.ndarray) -> UInt8[np.ndarray, "h w"]:
    """Turn an 8-bit image into the grey one that detection, tracking and matching work on.

    Args:
        image: uint8, `[h, w]` or RGB(A) `[h, w, 3 or 4]`.

    Returns:
        The grey image; a grey input comes back as it is.

    Raises:
        ValueError: Not uint8, or not an image.

    Example:
        >>> to_gray(np.zeros((4, 6, 3), np.uint8)).shape
        (4, 6)
    """
    _check_image(image, "image")
    if image.ndim == 2:
        return image
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY if image.shape[2] == 3 else cv2.COLOR_RGBA2GRAY)


def _check_image(image: np.ndarray, name: str) -> None:
    shape_ok = image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (3, 4))
    if not shape_ok or image.size == 0:
        raise ValueError(
            f"{name} has shape {image.shape}: expected [height, width] or [height, width, 3 or 4], not empty"
        )
    if image.dtype != np.uint8:
        raise ValueError(f"{name} has dtype {image.dtype}: expected uint8 (scale 16-bit images to 8 bits first)")


def gray_pair(image0: np.ndarray, image1: np.ndarray, names: tuple[str, str]) -> tuple[np.ndarray, np.ndarray]:
    """Both images in grey, after checking that they have one size."""
    _check_image(image0, names[0])
    _check_image(image1, names[1])
    if image0.shape[:2] != image1.shape[:2]:
        raise ValueError(
            f"{names[0]} has size {image0.shape[1]}×{image0.shape[0]} and "
            f"{names[1]} {image1.shape[1]}×{image1.shape[0]}: expected images of one size"
        )
    return to_gray(image0), to_gray(image1)


def check_pixels(pixels: np.ndarray, name: str = "pixels") -> np.ndarray:
    """Pixel positions as a contiguous float32 `[n, 2]` array."""
    pixels = np.ascontiguousarray(pixels, np.float32)
    if pixels.size == 0:
        return pixels.reshape(0, 2)
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ValueError(f"{name} has shape {pixels.shape}: expected [n, 2] with columns u, v")
    return pixels


def inside(pixels: np.ndarray, shape: tuple[int, ...], border_px: float | int = 0) -> np.ndarray:
    """True for finite positions at least `border_px` away from the outermost pixel centres."""
    u, v = pixels[:, 0], pixels[:, 1]
    # Comparisons with NaN are False, so positions that are not finite fall out too.
    return (u >= border_px) & (u <= shape[1] - 1 - border_px) & (v >= border_px) & (v <= shape[0] - 1 - border_px)


def _damage(data: bytes) -> str | None:
    """What is structurally wrong with a PNG or JPEG file, or None."""
    if data.startswith(_PNG_SIGNATURE):
        return _png_damage(data)
    if data.startswith(b"\xff\xd8"):
        return _jpeg_damage(data)
    return None


def _png_damage(data: bytes) -> str | None:
    view, position = memoryview(data), len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        length = int.from_bytes(view[position : position + 4], "big")
        end = position + 12 + length
        if end > len(data):
            break
        # The checksum covers the chunk's type and its data.
        if zlib.crc32(view[position + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            return f"wrong PNG checksum at byte {position}"
        if view[position + 4 : position + 8] == b"IEND":
            return None
        position = end
    return f"the PNG ends early, after {len(data)} bytes"


def _jpeg_damage(data: bytes) -> str | None:
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
            continue
        if marker == 0xDA:
            # Within the coded picture 0xFF is followed by 0 or a restart marker: 0xFFD9 is the end mark. Looking for
            # it from here on passes over thumbnails, which have an end mark of their own.
            return None if data.find(b"\xff\xd9", position) >= 0 else f"the JPEG ends early, after {len(data)} bytes"
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return f"the JPEG ends early, after {len(data)} bytes"
