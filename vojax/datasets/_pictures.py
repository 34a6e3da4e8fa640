"""Files of images and depths, and whether they are those that the calibration is for."""

import pathlib
import re

import numpy as np

from vojax.cameras import Camera
from vojax.features import read_image

_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff")


def image_files(folder: pathlib.Path, expected: str = "000000.png, 000001.png, …") -> list[pathlib.Path]:
    """The images of a folder in the order of their names, numbers by value: 2.png comes before 10.png."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} not found: expected a folder of images {expected}")
    files = sorted(
        (path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and not path.name.startswith(".")),
        key=lambda path: (_by_number(path.stem), path.name),
    )
    if not files:
        raise FileNotFoundError(f"{folder} holds no images: expected {expected}")
    return files


def _by_number(name: str) -> list[str | int]:
    return [int(part) if part.isdecimal() else part for part in re.split(r"([0-9]+)", name)]


def check_index(k: int, frames: int, name: str) -> int:
    """The index from 0 of a frame, which may be counted from the end."""
    if not -frames <= k < frames:
        raise IndexError(f"frame {k} of sequence {name}: expected 0 to {frames - 1}")
    return k % frames


def check_size(
    image: np.ndarray, where: pathlib.Path | str, camera: Camera | None, size: tuple[int, int] | None = None
) -> None:
    """Refuse an image of another size than its calibration is for.

    Where the calibration does not tell its (width, height), the principal point must lie in the image: one of twice
    the resolution is noticed, a slightly different crop is not.
    """
    height, width = image.shape[:2]
    if size is not None and (width, height) != size:
        raise ValueError(
            f"{where} has {width}×{height} pixels and its calibration is for {size[0]}×{size[1]}: expected the "
            "calibration of these images"
        )
    cx, cy = getattr(camera, "cx", None), getattr(camera, "cy", None)
    if cx is not None and cy is not None and not (0 <= float(cx) <= width - 1 and 0 <= float(cy) <= height - 1):
        raise ValueError(
            f"{where} has {width}×{height} pixels and its calibration puts the principal point at ({float(cx):g}, "
            f"{float(cy):g}), outside: expected the calibration of these images"
        )


def read_depth(
    path: pathlib.Path, unit: float, none: tuple[int, ...], camera: Camera, size: tuple[int, int] | None
) -> np.ndarray:
    """A 16-bit depth image in metres, float32, 0 where there is none.

    Args:
        path: The file.
        unit: What one metre is in it.
        none: Values that stand for no depth.
        camera: As for `check_size`.
        size: As for `check_size`.
    """
    stored = read_image(path)
    if stored.dtype != np.uint16 or stored.ndim != 2:
        raise ValueError(f"{path} holds {stored.dtype} of shape {stored.shape}: expected depths, 16 bits, one channel")
    check_size(stored, path, camera, size)
    return np.where(np.isin(stored, none), np.float32(0), stored.astype(np.float32) / np.float32(unit))
