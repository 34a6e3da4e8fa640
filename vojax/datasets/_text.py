"""Text files of numbers: read, counted and checked, with the line in every complaint."""

import pathlib
from collections.abc import Sequence

import numpy as np


def text_lines(path: pathlib.Path, expected: str) -> list[tuple[int, str]]:
    """The lines that are neither empty nor a comment (`#`), each with its number from 1."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} not found: expected {expected}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read ({type(error).__name__}): expected {expected}") from None
    lines = enumerate(text.splitlines(), 1)
    return [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]


def numbers(words: Sequence[str], count: int, where: str) -> np.ndarray:
    """`count` finite numbers."""
    if len(words) != count:
        raise ValueError(f"{where} has {len(words)} columns: expected {count} numbers")
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise ValueError(f"{where} holds something that is not a number: expected {count} numbers") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{where} holds NaN or infinity: expected {count} finite numbers")
    return values


def whole_number(word: str, what: str, where: str) -> int:
    """A whole number from 0 on, all digits kept: nanoseconds do not fit a float."""
    word = word.strip()
    if not (word.isascii() and word.isdigit()):
        raise ValueError(f"{where} has {word[:40]!r} for its {what}: expected a whole number from 0 on")
    return int(word)


def check_increasing(
    times: np.ndarray, line_numbers: Sequence[int], path: pathlib.Path, unit: str = "s", equal: bool = False
) -> None:
    """Refuse times that go backwards, and where `equal` is False also two that are the same."""
    step = np.diff(times)
    wrong = np.flatnonzero(step < 0 if equal else step <= 0)
    if len(wrong):
        i = int(wrong[0])
        raise ValueError(
            f"{path}, line {line_numbers[i + 1]}: {times[i + 1]} {unit} follows {times[i]} {unit}: expected "
            "increasing times"
        )


def read_times(path: pathlib.Path, frames: int) -> np.ndarray:
    """One increasing time in seconds for each frame."""
    lines = text_lines(path, "one time in seconds per frame")
    times = np.array([numbers(line.split(), 1, f"{path}, line {number},")[0] for number, line in lines])
    if len(times) != frames:
        raise ValueError(f"{path} has {len(times)} times for {frames} images: expected one per frame")
    check_increasing(times, [number for number, _ in lines], path)
    return times
