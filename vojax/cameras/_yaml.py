"""YAML in the dialects of calibration files, and values out of it with errors that name file and key."""

import math
import pathlib
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

_MATRIX_TAG = "tag:yaml.org,2002:opencv-matrix"


def load_yaml(path: pathlib.Path, text: str) -> dict[str, Any]:
    """Parse a mapping; OpenCV's `%YAML:1.0` header and `!!opencv-matrix` tags are understood.

    Raises:
        ImportError: PyYAML is not installed.
        ValueError: The file is not YAML, or not a mapping.
    """
    yaml = _pyyaml()

    class Loader(yaml.SafeLoader):
        pass

    Loader.add_constructor(_MATRIX_TAG, lambda loader, node: loader.construct_mapping(node, deep=True))
    # The directive that OpenCV writes is not one of YAML's. Its line stays, so that line numbers do.
    text = re.sub(r"\A\ufeff?%YAML:.*", "", text)
    try:
        value = yaml.load(text, Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or "it cannot be parsed"
        raise ValueError(f"{path}{where} is not valid YAML: {problem}") from None
    if not isinstance(value, dict):
        raise ValueError(f"{path} holds no keys: expected a calibration file")
    return {str(key): entry for key, entry in value.items()}


def dump_yaml(value: Mapping[str, Any]) -> str:
    """Text of a mapping: block style outside, lists of numbers in one line."""
    return _pyyaml().safe_dump(dict(value), sort_keys=False, default_flow_style=None, width=1000)


def _pyyaml() -> Any:
    try:
        import yaml
    except ImportError:
        raise ImportError("reading and writing YAML needs PyYAML: pip install 'vojax[files]'") from None
    return yaml


def text_of(path: pathlib.Path) -> str:
    """The text of a file.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It cannot be read as text.
    """
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} not found: expected a calibration file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read ({type(error).__name__}): expected a calibration file") from None


def numbers(value: Any, where: str, counts: tuple[int, ...] = ()) -> list[float]:
    """A flat or nested list, or an OpenCV matrix, as finite numbers, in one of the expected counts (none: any)."""
    if isinstance(value, Mapping):
        if "data" not in value:
            raise ValueError(f"{where} is a mapping without 'data': expected numbers")
        rows, columns = value.get("rows"), value.get("cols")
        value = value["data"]
        if isinstance(rows, int) and isinstance(columns, int) and np.size(value) != rows * columns:
            raise ValueError(f"{where} has {np.size(value)} numbers: expected rows x cols = {rows} x {columns}")
    flat: list[float] = []

    def collect(entry: Any) -> None:
        if isinstance(entry, list):
            for part in entry:
                collect(part)
            return
        try:
            # YAML takes 1e-5, without a point, for text.
            flat.append(math.nan if isinstance(entry, bool) else float(entry))
        except (TypeError, ValueError):
            raise ValueError(f"{where} holds {entry!r}: expected numbers") from None

    collect(value)
    if not all(math.isfinite(number) for number in flat):
        raise ValueError(f"{where} holds {value}: expected finite numbers")
    if counts and len(flat) not in counts:
        raise ValueError(f"{where} has {len(flat)} numbers: expected {' or '.join(str(count) for count in counts)}")
    return flat


def entry(value: Mapping[str, Any], key: str, where: str) -> Any:
    """What a mapping holds under a key that it must have."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{where} is {value!r}: expected keys and values")
    if value.get(key) is None:
        raise ValueError(f"{where} has no '{key}'")
    return value[key]


def check_focal_lengths(parameters: Mapping[str, Any], where: str) -> None:
    """Refuse focal lengths that are not positive."""
    for key in ("f", "fx", "fy", "a0"):
        if key in parameters and not parameters[key] > 0:
            raise ValueError(f"{where} has {key} = {parameters[key]:g}: expected a focal length > 0")


def image_size(value: Any, where: str) -> tuple[int, int]:
    """Width and height."""
    width, height = numbers(value, where, (2,))
    if width != int(width) or height != int(height) or min(width, height) < 1:
        raise ValueError(f"{where} is {value}: expected width and height in pixels")
    return int(width), int(height)


def rigid_matrix(value: Any, where: str) -> np.ndarray:
    """A 4x4 rigid transformation; its rotation may be rounded, and is made one."""
    matrix = np.array(numbers(value, where, (16,))).reshape(4, 4)
    rotation = matrix[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if off > 1e-3 or np.linalg.det(rotation) < 0 or not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        raise ValueError(f"{where} is not a rigid transformation [R t; 0 0 0 1] (R off by {off:.2g})")
    u, _, vt = np.linalg.svd(rotation)
    matrix[:3, :3] = u @ vt
    return matrix


def plain(value: Any) -> Any:
    """Numbers and arrays as Python's, each with the fewest digits that give it back in its own precision."""
    array = np.asarray(value)
    if array.ndim:
        return [plain(part) for part in array]
    return float(str(array[()])) if array.dtype.kind == "f" else array.item()
