"""COLMAP's sparse models, text and binary: `cameras`, `images` and `points3D`, each `.txt` or `.bin`.

COLMAP puts the centre of the first pixel at (0.5, 0.5), vojax at (0, 0): pixels and principal points move by half a
pixel on the way in, and back on the way out. Its frames are ours.
"""

import dataclasses
import os
import pathlib
import struct
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64, Int

from vojax.cameras import BrownConrady, Pinhole

from ._bal import BalCamera

# By COLMAP's numbers: name, number of parameters, our model, and what it calls these parameters, in COLMAP's order.
_RADIAL = ("focal", "cx", "cy", "k1", "k2")
_OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
_MODELS: dict[int, tuple[str, int, Any, tuple[str, ...]]] = {
    0: ("SIMPLE_PINHOLE", 3, BalCamera, _RADIAL[:3]),
    1: ("PINHOLE", 4, Pinhole, _OPENCV[:4]),
    2: ("SIMPLE_RADIAL", 4, BalCamera, _RADIAL[:4]),
    3: ("RADIAL", 5, BalCamera, _RADIAL),
    4: ("OPENCV", 8, BrownConrady, _OPENCV),
}
_IDS = {name: number for number, (name, *_) in _MODELS.items()}


class ColmapBundle(NamedTuple):
    """A model in the arrays that `vojax.ba.bundle_problem` takes.

    Attributes:
        cam_from_world: Poses `(w, x, y, z, tx, ty, tz)`, by images.
        landmarks: Points in the world frame.
        pixels: Observations that have a point.
        camera_index: Image of every observation.
        landmark_index: Point of every observation.
        camera: Camera model, one entry for each of COLMAP's cameras.
        camera_group: Which of them took each image.
        free_intrinsics: Parameters that bundle adjustment frees: all but the principal point.
    """

    cam_from_world: Float64[np.ndarray, "c 7"]
    landmarks: Float64[np.ndarray, "p 3"]
    pixels: Float64[np.ndarray, "o 2"]
    camera_index: Int[np.ndarray, " o"]
    landmark_index: Int[np.ndarray, " o"]
    camera: Any
    camera_group: Int[np.ndarray, " c"]
    free_intrinsics: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class ColmapImage:
    """An image as COLMAP stores it; pixels by COLMAP's convention, `point_ids` −1 where there is no point."""

    id: int
    cam_from_world: np.ndarray
    camera_id: int
    name: str
    pixels: np.ndarray
    point_ids: np.ndarray


@dataclasses.dataclass(frozen=True)
class ColmapModel:
    """A sparse model as COLMAP stores it.

    Attributes:
        cameras: Model name, width, height and parameters by identifier.
        images: Images, by identifier.
        point_ids: Identifiers of the points, ascending.
        points: Their positions.
        colors: Their colours.
        errors: Their mean reprojection errors.
        tracks: Their observations, rows `(image identifier, index in the image)`.
    """

    cameras: dict[int, tuple[str, int, int, np.ndarray]]
    images: list[ColmapImage]
    point_ids: np.ndarray
    points: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    tracks: list[np.ndarray]

    def bundle(self) -> ColmapBundle:
        """The model as a bundle adjustment problem.

        Raises:
            ValueError: The cameras are of several models, or of one that vojax does not have; or an image names a point
                or a camera that is not there.
        """
        names = sorted({name for name, *_ in self.cameras.values()})
        if len(names) != 1 or names[0] not in _IDS:
            raise ValueError(
                f"the cameras are of the models {', '.join(names)}: expected one of {', '.join(_IDS)} for all"
            )
        _, _, model, fields = _MODELS[_IDS[names[0]]]
        ids = sorted(self.cameras)
        values = np.array([self.cameras[number][3] for number in ids])
        shift = np.array([0.5 if field in ("cx", "cy") else 0.0 for field in fields])
        parameters = dict(zip(fields, (values - shift).T, strict=True))
        missing = [image.name for image in self.images if image.camera_id not in self.cameras]
        if missing:
            raise ValueError(f"image {missing[0]} names a camera that is not there")
        index, seen, pixels = [], [], []
        for k, image in enumerate(self.images):
            have = image.point_ids >= 0
            position = np.searchsorted(self.point_ids, image.point_ids[have])
            known = (
                self.point_ids[np.minimum(position, len(self.point_ids) - 1)] if len(self.point_ids) else position - 1
            )
            wrong = np.flatnonzero(known != image.point_ids[have])
            if len(wrong):
                raise ValueError(
                    f"image {image.name} names point {image.point_ids[have][wrong[0]]}, which is not there"
                )
            index.append(np.full(len(position), k))
            seen.append(position)
            pixels.append(image.pixels[have] - 0.5)
        join = lambda parts, empty: np.concatenate(parts) if parts else empty  # noqa: E731
        groups = {number: k for k, number in enumerate(ids)}
        return ColmapBundle(
            cam_from_world=np.array([image.cam_from_world for image in self.images]).reshape(-1, 7),
            landmarks=self.points,
            pixels=join(pixels, np.zeros((0, 2))),
            camera_index=join(index, np.zeros(0, int)),
            landmark_index=join(seen, np.zeros(0, int)),
            camera=model(**{name: jnp.asarray(column) for name, column in parameters.items()}),
            camera_group=np.array([groups[image.camera_id] for image in self.images], int),
            free_intrinsics=tuple(field for field in fields if field not in ("cx", "cy")),
        )

    def updated(self, cam_from_world: np.ndarray, landmarks: np.ndarray, camera: Any) -> "ColmapModel":
        """The model with adjusted poses, points and camera parameters; reprojection errors are worked out anew."""
        images = [
            dataclasses.replace(image, cam_from_world=np.asarray(pose, float))
            for image, pose in zip(self.images, cam_from_world, strict=True)
        ]
        cameras = {}
        for k, number in enumerate(sorted(self.cameras)):
            name, width, height, _ = self.cameras[number]
            fields = _MODELS[_IDS[name]][3]
            values = [float(np.asarray(getattr(camera, field))[k]) + 0.5 * (field in ("cx", "cy")) for field in fields]
            cameras[number] = (name, width, height, np.array(values))
        model = dataclasses.replace(self, cameras=cameras, images=images, points=np.asarray(landmarks, float))
        return dataclasses.replace(model, errors=_mean_errors(model))


def read_colmap(path: str | os.PathLike[str]) -> ColmapModel:
    """Read a sparse model.

    Args:
        path: Folder with `cameras`, `images` and `points3D`, all `.bin` or all `.txt`; binary ones are preferred.

    Returns:
        The model.

    Raises:
        FileNotFoundError: One of the files is missing.
        ValueError: A file is truncated or malformed; the message names the line, or the byte of a binary file.

    References: Schönberger & Frahm, "Structure-from-motion revisited", CVPR 2016; COLMAP's documentation of its output
        format.
    """
    folder = pathlib.Path(path)
    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    files = [folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D")]
    for file in files:
        if not file.is_file():
            raise FileNotFoundError(
                f"{file} not found: expected a folder with cameras, images and points3D (.txt or .bin)"
            )
    read = _read_binary if suffix == ".bin" else _read_text
    cameras, images, points = read(files)
    images.sort(key=lambda image: image.id)
    points.sort(key=lambda point: point[0])
    return ColmapModel(
        cameras=cameras,
        images=images,
        point_ids=np.array([point[0] for point in points], dtype=np.int64),
        points=np.array([point[1] for point in points]).reshape(-1, 3),
        colors=np.array([point[2] for point in points], dtype=np.uint8).reshape(-1, 3),
        errors=np.array([point[3] for point in points], dtype=float),
        tracks=[point[4] for point in points],
    )


def write_colmap(path: str | os.PathLike[str], model: ColmapModel, *, binary: bool = True) -> pathlib.Path:
    """Write a sparse model into a folder, which is made where it does not exist.

    Returns:
        The path of the folder.
    """
    folder = pathlib.Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    if binary:
        (folder / "cameras.bin").write_bytes(_cameras_to_bytes(model))
        (folder / "images.bin").write_bytes(_images_to_bytes(model))
        (folder / "points3D.bin").write_bytes(_points_to_bytes(model))
        return folder
    numbers = lambda values: " ".join(repr(float(value)) for value in values)  # noqa: E731
    lines = [f"{k} {name} {width} {height} {numbers(p)}" for k, (name, width, height, p) in model.cameras.items()]
    _write_lines(folder / "cameras.txt", ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", *lines])
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for image in model.images:
        lines.append(f"{image.id} {numbers(image.cam_from_world)} {image.camera_id} {image.name}")
        lines.append(
            " ".join(f"{numbers(xy)} {number}" for xy, number in zip(image.pixels, image.point_ids, strict=True))
        )
    _write_lines(folder / "images.txt", lines)
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for number, xyz, rgb, error, track in _rows(model):
        colors, pairs = " ".join(str(int(c)) for c in rgb), " ".join(str(int(v)) for v in np.ravel(track))
        lines.append(f"{number} {numbers(xyz)} {colors} {float(error)!r} {pairs}")
    _write_lines(folder / "points3D.txt", lines)
    return folder


def _rows(model: ColmapModel) -> Any:
    return zip(model.point_ids, model.points, model.colors, model.errors, model.tracks, strict=True)


def _write_lines(path: pathlib.Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _mean_errors(model: ColmapModel) -> np.ndarray:
    """Mean reprojection error of every point, in pixels."""
    import jax

    from vojax.lie import SE3

    bundle = model.bundle()
    with jax.enable_x64(True):
        poses = SE3(jnp.asarray(bundle.cam_from_world[bundle.camera_index]))
        points = poses.apply(jnp.asarray(bundle.landmarks[bundle.landmark_index]))
        own = bundle.camera_group[bundle.camera_index]
        camera = jax.tree.map(lambda leaf: jnp.asarray(leaf)[own] if jnp.ndim(leaf) else leaf, bundle.camera)
        projected = np.asarray(camera.project(points))
    errors = np.linalg.norm(projected - bundle.pixels, axis=1)
    count = np.bincount(bundle.landmark_index, minlength=len(model.points))
    return np.bincount(bundle.landmark_index, errors, minlength=len(model.points)) / np.maximum(count, 1)


# ---- text


def _read_text(files: list[pathlib.Path]) -> tuple[dict, list[ColmapImage], list]:
    cameras, points, images = {}, [], []
    for number, fields in _text_rows(files[0]):
        with _Line(files[0], number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."):
            name = fields[1]
            count = _MODELS[_IDS[name]][1] if name in _IDS else len(fields) - 4
            values = np.array(fields[4:], float)
            if len(values) != count or not np.isfinite(values).all():
                raise ValueError
            cameras[int(fields[0])] = (name, int(fields[2]), int(fields[3]), values)
    rows = _text_rows(files[1], keep_empty=True)
    for number, fields in rows:
        with _Line(files[1], number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"):
            pose = np.array(fields[1:8], float)
            identifier, camera, name = int(fields[0]), int(fields[8]), " ".join(fields[9:])
            if len(pose) != 7 or not np.isfinite(pose).all() or not name:
                raise ValueError
        second = next(rows, None)
        if second is None:
            raise ValueError(f"{files[1]} ends at line {number}: expected a line of points after that of image {name}")
        with _Line(files[1], second[0], "X Y POINT3D_ID, for each point of the image"):
            triples = np.array(second[1], dtype=object).reshape(-1, 3)
            pixels = triples[:, :2].astype(float)
            ids = np.array([int(value) for value in triples[:, 2]], dtype=np.int64)
            if not np.isfinite(pixels).all():
                raise ValueError
        images.append(ColmapImage(identifier, pose, camera, name, pixels, ids))
    for number, fields in _text_rows(files[2]):
        with _Line(files[2], number, "POINT3D_ID X Y Z R G B ERROR (IMAGE_ID POINT2D_IDX)..."):
            xyz, track = np.array(fields[1:4], float), np.array(fields[8:], dtype=np.int64).reshape(-1, 2)
            if len(xyz) != 3 or not np.isfinite(xyz).all():
                raise ValueError
            points.append((int(fields[0]), xyz, np.array(fields[4:7], np.uint8), float(fields[7]), track))
    return cameras, images, points


class _Line:
    """Turns whatever goes wrong inside into one sentence with the number of the line."""

    def __init__(self, path: pathlib.Path, number: int, expected: str):
        self._where = f"{path}, line {number}"
        self._expected = expected

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if isinstance(error, (ValueError, IndexError, OverflowError)):
            raise ValueError(f"{self._where}: malformed, expected {self._expected}") from None


def _text_rows(path: pathlib.Path, keep_empty: bool = False) -> Any:
    """Line numbers and fields, without comments; empty lines only where they mean something, after a first row."""
    started = False
    with open(path, encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, 1):
            fields = line.split()
            if line.startswith("#") or not (fields or (keep_empty and started)):
                continue
            started = True
            yield number, fields


# ---- binary


class _Bytes:
    """Reads little-endian values, and says where a file ends too early."""

    def __init__(self, path: pathlib.Path):
        self._path, self._data, self._at = path, path.read_bytes(), 0

    def values(self, form: str) -> tuple:
        size = struct.calcsize("<" + form)
        self._need(size)
        found = struct.unpack_from("<" + form, self._data, self._at)
        self._at += size
        return found

    def array(self, dtype: Any, count: int) -> np.ndarray:
        dtype = np.dtype(dtype)
        self._need(dtype.itemsize * count)
        found = np.frombuffer(self._data, dtype, count, self._at)
        self._at += dtype.itemsize * count
        return found

    def string(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            self._need(len(self._data) + 1)
        text = self._data[self._at : end].decode("utf-8", errors="replace")
        self._at = end + 1
        return text

    def end(self) -> None:
        if self._at != len(self._data):
            raise ValueError(f"{self._path}: {len(self._data) - self._at} bytes too many after byte {self._at}")

    def fail(self, what: str) -> None:
        raise ValueError(f"{self._path}, byte {self._at}: {what}")

    def _need(self, size: int) -> None:
        if self._at + size > len(self._data):
            raise ValueError(f"{self._path} is truncated: it ends at byte {len(self._data)}, inside a record")


_OBSERVATION = np.dtype([("xy", "<f8", 2), ("id", "<u8")])


def _read_binary(files: list[pathlib.Path]) -> tuple[dict, list[ColmapImage], list]:
    cameras, images, points = {}, [], []
    data = _Bytes(files[0])
    for _ in range(data.values("Q")[0]):
        identifier, model, width, height = data.values("IiQQ")
        if model not in _MODELS:
            data.fail(f"camera {identifier} has model {model}: expected one of {', '.join(_IDS)}")
        name, count, *_ = _MODELS[model]
        cameras[identifier] = (name, width, height, data.array("<f8", count).copy())
    data.end()
    data = _Bytes(files[1])
    for _ in range(data.values("Q")[0]):
        (identifier,), pose, (camera,) = data.values("I"), data.array("<f8", 7).copy(), data.values("I")
        name = data.string()
        seen = data.array(_OBSERVATION, data.values("Q")[0])
        ids = seen["id"].astype(np.int64)  # what means "none" is −1 here
        images.append(ColmapImage(identifier, pose, camera, name, seen["xy"].copy(), ids))
        if not (np.isfinite(pose).all() and np.isfinite(seen["xy"]).all()):
            data.fail(f"image {name} has numbers that are not finite")
    data.end()
    data = _Bytes(files[2])
    for _ in range(data.values("Q")[0]):
        (identifier,), xyz = data.values("Q"), data.array("<f8", 3).copy()
        color, (error, length) = data.array("u1", 3).copy(), data.values("dQ")
        track = data.array("<u4", 2 * length).astype(np.int64).reshape(-1, 2)
        if not np.isfinite(xyz).all():
            data.fail(f"point {identifier} has numbers that are not finite")
        points.append((identifier, xyz, color, error, track))
    data.end()
    return cameras, images, points


def _cameras_to_bytes(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.cameras))]
    for number, (name, width, height, values) in model.cameras.items():
        parts.append(struct.pack("<IiQQ", number, _IDS[name], width, height) + np.asarray(values, "<f8").tobytes())
    return b"".join(parts)


def _images_to_bytes(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.images))]
    for image in model.images:
        seen = np.zeros(len(image.pixels), _OBSERVATION)
        seen["xy"] = image.pixels
        seen["id"] = image.point_ids.astype(np.uint64)  # −1 wraps to the number that means "none"
        pose = np.asarray(image.cam_from_world, "<f8").tobytes()
        parts += [struct.pack("<I", image.id), pose, struct.pack("<I", image.camera_id), image.name.encode() + b"\0"]
        parts += [struct.pack("<Q", len(seen)), seen.tobytes()]
    return b"".join(parts)


def _points_to_bytes(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.points))]
    for number, xyz, rgb, error, track in _rows(model):
        parts += [struct.pack("<Q", int(number)), np.asarray(xyz, "<f8").tobytes(), np.asarray(rgb, "u1").tobytes()]
        parts += [struct.pack("<dQ", float(error), len(track)), np.asarray(track, "<u4").tobytes()]
    return b"".join(parts)
