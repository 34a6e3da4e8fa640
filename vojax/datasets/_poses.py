"""Poses as the files of data sets hold them, on the host in double precision."""

from collections.abc import Callable

import numpy as np


def check_rotations(rotations: np.ndarray, where: Callable[[int], str], expected: str, tolerance: float = 1e-4) -> None:
    """Refuse `[n, 3, 3]` matrices that are not rotations to the digits of a text file."""
    deviation = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = (deviation > tolerance) | (np.linalg.det(rotations) < 0)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise ValueError(
            f"{where(i)}: the left 3×3 block is not a rotation (off by {deviation[i]:.2g}): expected {expected}"
        )


def check_quaternions(quaternions: np.ndarray, where: Callable[[int], str], order: str) -> None:
    """Refuse `[n, 4]` quaternions whose length is not 1 to a percent."""
    length = np.linalg.norm(quaternions, axis=1)
    wrong = np.abs(length - 1.0) > 1e-2
    if wrong.any():
        i = int(np.argmax(wrong))
        raise ValueError(f"{where(i)}: the quaternion {order} has length {length[i]:.4g}: expected 1")


def pose_matrices(wxyz: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """`[n, 3, 4]` of quaternions `[n, 4]`, of any length, and translations `[n, 3]`."""
    w, x, y, z = (wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)).T
    columns = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), translation[:, 0]],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), translation[:, 1]],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), translation[:, 2]],
    ]
    return np.array(columns).transpose(2, 0, 1)


def compose(b_from_a: np.ndarray, a_from_c: np.ndarray) -> np.ndarray:
    """The product of `[…, 3, 4]` poses: b from c."""
    rotation = b_from_a[..., :3] @ a_from_c[..., :3]
    translation = b_from_a[..., :3] @ a_from_c[..., 3:] + b_from_a[..., 3:]
    return np.concatenate([rotation, translation], axis=-1)


def invert(b_from_a: np.ndarray) -> np.ndarray:
    """The inverse of `[…, 3, 4]` poses: a from b."""
    rotation = np.swapaxes(b_from_a[..., :3], -1, -2)
    return np.concatenate([rotation, -rotation @ b_from_a[..., 3:]], axis=-1)


def slerp(wxyz0: np.ndarray, wxyz1: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Quaternions `fraction` `[n]` of the shorter way from one to the other, both `[n, 4]` of length 1."""
    cosine = np.sum(wxyz0 * wxyz1, axis=1)
    wxyz1 = np.where(cosine[:, None] < 0, -wxyz1, wxyz1)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    # sin(s angle) / sin(angle) tends to s; numpy's sinc is sin(πx) / (πx).
    whole = np.sinc(angle / np.pi)
    weight0 = (1 - fraction) * np.sinc((1 - fraction) * angle / np.pi) / whole
    weight1 = fraction * np.sinc(fraction * angle / np.pi) / whole
    return weight0[:, None] * wxyz0 + weight1[:, None] * wxyz1


def multiply_quaternions(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The product, wxyz, of two quaternions."""
    vector = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], vector])
