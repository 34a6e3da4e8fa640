"""Bundle Adjustment in the Large: one text file per problem.

A file holds the numbers of cameras, points and observations; `camera point x y` for every observation; nine numbers
for every camera (Rodrigues vector, translation, focal length, k1, k2), three for every point. Its cameras look down
−z, with y up and pixels from the centre of the image. Here they look along +z with y down, as everywhere in vojax:
camera coordinates and pixels turn half around x, the world and all residual norms stay.
"""

import itertools
import os
import pathlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64, Int

from vojax._types import Array, ArrayLike, Bool, Float
from vojax.cameras._components import as_parameter, bearings_on_plane, onto_plane
from vojax.lie import SE3, SO3

_NEWTON_STEPS = 12


class BalCamera(eqx.Module):
    """Square pixels and two radial coefficients: BAL's camera, and COLMAP's SIMPLE_PINHOLE, SIMPLE_RADIAL and RADIAL.

    With (x, y) on the plane z = 1 and r² = x² + y², the pixel is f (1 + k1 r² + k2 r⁴) (x, y) + (cx, cy).

    Args:
        focal: Focal length in pixels.
        k1: Radial coefficient of r².
        k2: Radial coefficient of r⁴.
        cx: Principal point, u in pixels.
        cy: Principal point, v in pixels.

    Parameters may be arrays, one entry for each of many cameras.

    Degenerate input: as `vojax.cameras.BrownConrady`; `normalized` assumes a pixel that the lens can reach.
    Differentiability: both modes.
    """

    focal: Float[Array, "*shape"] = eqx.field(converter=as_parameter)
    k1: Float[Array, "*shape"] = eqx.field(converter=as_parameter, default=0.0)
    k2: Float[Array, "*shape"] = eqx.field(converter=as_parameter, default=0.0)
    cx: Float[Array, "*shape"] = eqx.field(converter=as_parameter, default=0.0)
    cy: Float[Array, "*shape"] = eqx.field(converter=as_parameter, default=0.0)

    def project_xyz(self, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> tuple[Array, Array]:
        """Project points given by components, elementwise: `(u, v)` in pixels."""
        xn, yn = onto_plane(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z))
        r2 = xn * xn + yn * yn
        scale = self.focal * (1.0 + r2 * (self.k1 + r2 * self.k2))
        return scale * xn + self.cx, scale * yn + self.cy

    def project(self, points_cam: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 2"]:
        """Project points of the camera frame to pixels."""
        points = jnp.asarray(points_cam)
        return jnp.stack(self.project_xyz(points[..., 0], points[..., 1], points[..., 2]), axis=-1)

    def normalized(self, pixels: Float[ArrayLike, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Undistorted coordinates, on the plane z = 1, of pixels, by Newton's method on the radius."""
        pixels = jnp.asarray(pixels)
        xd, yd = (pixels[..., 0] - self.cx) / self.focal, (pixels[..., 1] - self.cy) / self.focal
        rd2 = xd * xd + yd * yd
        scale = jnp.ones_like(rd2)  # of the undistorted radius over the distorted one
        for _ in range(_NEWTON_STEPS):
            r2 = rd2 * scale * scale
            slope = 1.0 + r2 * (3.0 * self.k1 + 5.0 * r2 * self.k2)
            usable = slope > 0.1
            step = (scale * (1.0 + r2 * (self.k1 + r2 * self.k2)) - 1.0) / jnp.where(usable, slope, 1.0)
            scale = scale - jnp.clip(step, -0.5, 0.5)
        return jnp.stack([xd * scale, yd * scale], axis=-1)

    def unproject(self, pixels: Float[ArrayLike, "*batch 2"]) -> Float[Array, "*batch 3"]:
        """Unit bearings, in the camera frame, of pixels."""
        return bearings_on_plane(self.normalized(pixels))

    def in_domain(self, points_cam: Float[ArrayLike, "*batch 3"]) -> Bool[Array, "*batch"]:
        """Mask of the points in front of the camera."""
        return jnp.asarray(points_cam)[..., 2] > 0


class BalProblem(eqx.Module):
    """A problem in the arrays that `vojax.ba.bundle_problem` takes, in double precision on the host.

    Attributes:
        cam_from_world: Poses `(w, x, y, z, tx, ty, tz)`.
        landmarks: Points in the world frame.
        pixels: Observations; from the centre of the image, v down.
        camera_index: Camera of every observation.
        landmark_index: Point of every observation.
        intrinsics: Focal length, k1 and k2 of every camera.
    """

    cam_from_world: Float64[np.ndarray, "c 7"]
    landmarks: Float64[np.ndarray, "p 3"]
    pixels: Float64[np.ndarray, "o 2"]
    camera_index: Int[np.ndarray, " o"]
    landmark_index: Int[np.ndarray, " o"]
    intrinsics: Float64[np.ndarray, "c 3"]

    def camera(self) -> BalCamera:
        """All cameras as one model whose parameters are arrays."""
        return BalCamera(*(jnp.asarray(column) for column in self.intrinsics.T))


def read_bal(path: str | os.PathLike[str]) -> BalProblem:
    """Read a problem.

    Args:
        path: A text file, not compressed.

    Returns:
        The problem; rotations by more than half a turn come back as the same rotations by less.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is truncated, has a wrong number, or an index out of range; the message says on which line.

    References: Agarwal, Snavely, Seitz & Szeliski, "Bundle adjustment in the large", ECCV 2010.
    """
    path = pathlib.Path(path)
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not a text file: expected a BAL problem, decompressed (bunzip2)") from None
    counts = lines[0].split() if lines else []
    if len(counts) != 3 or not all(count.isdigit() for count in counts):
        found = f"{lines[0][:60]!r}" if lines else "nothing"
        raise ValueError(f"{path}, line 1: found {found}, expected 'cameras points observations', three whole numbers")
    c, p, o = map(int, counts)
    rows, line = _observations(path, lines, o)
    values, line = _numbers(path, lines, line, 9 * c + 3 * p, f"{c} cameras of 9 and {p} points of 3 numbers")
    for k in range(line, len(lines)):
        if lines[k].strip():
            raise ValueError(f"{path}, line {k + 1}: found {lines[k][:60]!r} after the last point, expected the end")
    camera_index, landmark_index = rows[:, 0].astype(int), rows[:, 1].astype(int)
    for name, index, size in (("camera", camera_index, c), ("point", landmark_index, p)):
        wrong = np.flatnonzero((index < 0) | (index >= size))
        if len(wrong):
            number = _line_of_observation(lines, int(wrong[0]))
            raise ValueError(f"{path}, line {number}: {name} {index[wrong[0]]} is out of range, there are {size}")
    cameras, landmarks = values[: 9 * c].reshape(c, 9), values[9 * c :].reshape(p, 3)
    return BalProblem(
        _poses_from_bal(cameras[:, :6]),
        landmarks,
        rows[:, 2:] * [1.0, -1.0],
        camera_index,
        landmark_index,
        cameras[:, 6:],
    )


def write_bal(path: str | os.PathLike[str], problem: BalProblem) -> pathlib.Path:
    """Write a problem, all digits; `read_bal` gives the same numbers back to rounding.

    Returns:
        The path of the file.
    """
    path = pathlib.Path(path)
    cameras = np.concatenate([_poses_to_bal(problem.cam_from_world), problem.intrinsics], axis=1)
    pixels = problem.pixels * [1.0, -1.0]
    with open(path, "w", encoding="ascii") as file:
        file.write(f"{len(cameras)} {len(problem.landmarks)} {len(pixels)}\n")
        for i, j, (u, v) in zip(problem.camera_index, problem.landmark_index, pixels, strict=True):
            file.write(f"{i} {j} {float(u)!r} {float(v)!r}\n")
        for values in (cameras, problem.landmarks):
            file.writelines(f"{float(value)!r}\n" for value in values.ravel())
    return path


def _observations(path: pathlib.Path, lines: list[str], count: int) -> tuple[np.ndarray, int]:
    """The rows of the observations, and the number of lines up to them."""
    numbers: list[list[str]] = []
    k = 1
    while len(numbers) < count:
        if k == len(lines):
            raise ValueError(f"{path} ends at line {k}: found {len(numbers)} observations, expected {count}")
        fields = lines[k].split()
        k += 1
        if not fields:
            continue
        if len(fields) != 4 or not (fields[0].isdigit() and fields[1].isdigit()):
            raise ValueError(f"{path}, line {k}: found {lines[k - 1][:60]!r}, expected 'camera point x y'")
        numbers.append(fields)
    try:
        rows = np.array(numbers, dtype=float).reshape(-1, 4)
    except ValueError:
        rows = np.full((count, 4), np.nan)
        for row, fields in zip(rows, numbers, strict=True):
            row[:] = [_number(field) for field in fields]
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        number = _line_of_observation(lines, int(bad[0]))
        raise ValueError(f"{path}, line {number}: found {lines[number - 1][:60]!r}, expected finite numbers")
    return rows, k


def _line_of_observation(lines: list[str], index: int) -> int:
    filled = (k for k, line in enumerate(lines[1:], 2) if line.strip())
    return next(itertools.islice(filled, index, None))


def _numbers(path: pathlib.Path, lines: list[str], start: int, count: int, what: str) -> tuple[np.ndarray, int]:
    """The next `count` numbers, however they are spread over lines, and the number of lines up to them."""
    values = np.empty(count)
    found, k = 0, start
    while found < count:
        if k == len(lines):
            raise ValueError(f"{path} ends at line {k}: found {found} numbers after the observations, expected {what}")
        for field in lines[k].split():
            value = _number(field)
            if not np.isfinite(value) or found == count:
                expected = "a finite number" if found < count else f"no more than {what}"
                raise ValueError(f"{path}, line {k + 1}: found {field[:30]!r}, expected {expected}")
            values[found] = value
            found += 1
        k += 1
    return values, k


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


# Half a turn around x, from BAL's axes to ours and back.
_TURN = np.array([0.0, 1.0, 0.0, 0.0])


def _poses_from_bal(parameters: np.ndarray) -> np.ndarray:
    with jax.enable_x64(True):
        bal_from_world = SE3.from_rotation_and_translation(SO3.exp(parameters[:, :3]), parameters[:, 3:])
        return np.array((_turn(len(parameters)) @ bal_from_world).wxyz_xyz)


def _poses_to_bal(cam_from_world: np.ndarray) -> np.ndarray:
    with jax.enable_x64(True):
        bal_from_world = _turn(len(cam_from_world)) @ SE3(jnp.asarray(cam_from_world))
        return np.concatenate([bal_from_world.rotation().log(), bal_from_world.translation()], axis=1)


def _turn(count: int) -> SE3:
    return SE3(jnp.asarray(np.tile(np.concatenate([_TURN, np.zeros(3)]), (count, 1))))
