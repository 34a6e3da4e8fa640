"""What is wrong with the arrays of a bundle, and what they cannot tell. On the host."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np


def check_values(
    poses: np.ndarray,
    points: np.ndarray,
    measurements: np.ndarray,
    indices: Sequence[tuple[str, np.ndarray, int, str]],
    used: np.ndarray,
    weight: np.ndarray,
) -> None:
    """Refuse shapes, indices and numbers that cannot be meant; `indices` are name, values, how many and of what."""
    if used.shape != (len(measurements),) or used.dtype != bool:
        raise ValueError(
            f"mask has shape {used.shape} and dtype {used.dtype}: expected booleans ({len(measurements)},)"
        )
    if weight.shape != (len(measurements),):
        raise ValueError(f"weights has shape {weight.shape}: expected ({len(measurements)},)")
    for name, index, size, of in indices:
        wrong = np.flatnonzero((index < 0) | (index >= size))
        if len(wrong):
            raise ValueError(
                f"{name}[{wrong[0]}] is {index[wrong[0]]}: expected 0 to {size - 1}, there are {size} {of} "
                f"({len(wrong)} indices are out of range)"
            )
    for name, values, hint in (
        ("cam_from_world", poses, ""),
        ("landmarks", points, ""),
        ("measurements", np.where(used[:, None], measurements, 0.0), "; mask out what was not seen"),
        ("weights", np.where(used, weight, 0.0), ""),
    ):
        bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
        if len(bad):
            raise ValueError(f"{name}[{bad[0]}] is not finite ({len(bad)} such rows): expected numbers{hint}")
    if (weight < 0).any():
        raise ValueError(f"weights[{np.argmax(weight < 0)}] is negative: expected 0 or more")
    if not np.abs(poses[:, :4]).sum(axis=1).all():
        raise ValueError(f"cam_from_world[{np.argmin(np.abs(poses[:, :4]).sum(axis=1))}] has a zero quaternion")
    if points.shape[1:] == (4,) and not np.abs(points).sum(axis=1).all():
        raise ValueError(f"landmarks[{np.argmin(np.abs(points).sum(axis=1))}] is zero: homogeneous points are not")


def check_sigma(sigma: np.ndarray, used: np.ndarray) -> None:
    """Refuse deviations and covariances that are not positive."""
    if sigma.ndim == 3:
        finite = np.isfinite(sigma).all(axis=(1, 2), keepdims=True)
        values = np.linalg.eigvalsh(np.where(finite, sigma, 0.0)).min(axis=-1, initial=np.inf)
    else:
        values = sigma
    bad = ~(np.isfinite(values) & (values > 0)) & used
    if bad.any():
        raise ValueError(f"sigma_px has {int(bad.sum())} entries that are not positive numbers: expected pixels > 0")


def flags(name: str, values: Any, size: int) -> np.ndarray:
    """Booleans for `size` things."""
    array = np.asarray(values)
    if array.shape != (size,) or array.dtype != bool:
        raise ValueError(f"{name} has shape {array.shape} and dtype {array.dtype}: expected booleans ({size},)")
    return array


def pose_flags(name: str, values: Any, size: int) -> np.ndarray:
    """Booleans for the tangent coordinates of `size` poses, given for each or for all six at once."""
    array = np.asarray(values)
    if array.shape not in ((size,), (size, 6)) or array.dtype != bool:
        raise ValueError(
            f"{name} has shape {array.shape} and dtype {array.dtype}: expected booleans ({size},), or ({size}, 6) for "
            "the coordinates (ρ, φ)"
        )
    return np.broadcast_to(array if array.ndim == 2 else array[:, None], (size, 6))


class Loose(NamedTuple):
    """What observations cannot place: see `BundleProblem`."""

    cameras: np.ndarray
    landmarks: np.ndarray
    parts: np.ndarray


def find_loose(
    pairs: np.ndarray,
    equations: int,
    links: Sequence[tuple[np.ndarray, int]],
    free_pose: np.ndarray,
    fixed_landmarks: np.ndarray,
) -> Loose:
    """Count equations and follow connections.

    Args:
        pairs: Camera and landmark of every observation `[2, o]`, without duplicates.
        equations: That an observation gives.
        links: Factors: the cameras of each, and the number of equations it gives.
        free_pose: Number of free coordinates of every camera's pose.
        fixed_landmarks: True for landmarks that stay.
    """
    c, p = len(free_pose), len(fixed_landmarks)
    fixed_cameras = free_pose == 0
    loose_landmarks = ~fixed_landmarks & (equations * np.bincount(pairs[1], minlength=p) < 3)
    useful = pairs[:, ~loose_landmarks[pairs[1]]]
    counted = equations * np.bincount(useful[0], minlength=c)
    for members, rows in links:
        counted += rows * np.bincount(members.ravel(), minlength=c)
    loose_cameras = counted < free_pose
    # A factor connects its cameras as a landmark would that all of them see.
    joined, landmarks = [useful], p
    for members, _ in links:
        joined.append(np.stack([members.ravel(), landmarks + np.repeat(np.arange(len(members)), members.shape[1])]))
        landmarks += len(members)
    part, landmark_part = _parts(np.concatenate(joined, axis=1), c, landmarks)
    landmark_part = landmark_part[:p]
    _, part = np.unique(part, return_inverse=True)
    landmark_part = np.where(landmark_part < c, part[np.minimum(landmark_part, c - 1)], -1)
    sizes = np.bincount(part)
    rank = np.argsort(np.argsort(-sizes, kind="stable"), kind="stable")
    part, landmark_part = rank[part], np.where(landmark_part >= 0, rank[landmark_part], -1)
    held = np.unique(part[fixed_cameras])
    held = np.union1d(held, landmark_part[fixed_landmarks & (landmark_part >= 0)])
    held = held if len(held) else np.zeros(1, int)  # nothing is fixed: the largest part is where the world is
    loose_cameras |= ~fixed_cameras & ~np.isin(part, held)
    loose_landmarks |= ~fixed_landmarks & ~np.isin(landmark_part, held)
    return Loose(loose_cameras, loose_landmarks, part)


def _parts(pairs: np.ndarray, c: int, p: int) -> tuple[np.ndarray, np.ndarray]:
    """The lowest camera that each camera and each landmark is connected to; `c` for landmarks nobody saw."""
    camera, landmark = np.arange(c), np.full(p, c)
    while True:
        before = camera.copy()
        np.minimum.at(landmark, pairs[1], camera[pairs[0]])
        np.minimum.at(camera, pairs[0], landmark[pairs[1]])
        camera = camera[camera]  # jump along the chain
        if np.array_equal(before, camera):
            return camera, landmark
