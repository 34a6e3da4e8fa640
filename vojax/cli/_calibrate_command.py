"""`vojax calibrate`: a camera, or the cameras of a rig, from images of a chessboard."""

import glob
import pathlib
import time
from collections.abc import Iterable
from typing import Any, NamedTuple

from ._arguments import Calibrate

_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".tif", ".tiff")
# Corners farther off than this many standard deviations (by the median) are wrong detections.
_WRONG_SIGMAS = 8.0
_COVERAGE_CELLS = (12, 9)


class _Views(NamedTuple):
    names: list[str]
    corners: Any  # [c, v, n, 2]
    mask: Any  # [c, v, n]
    image_size: tuple[int, int]
    left_out: list[dict[str, str]]


def execute(command: Calibrate) -> None:
    """Find corners, calibrate, write and print."""
    board = _board_size(command.board)
    import jax
    import numpy as np
    from rich.console import Console

    from vojax.calibration._models import MODELS
    from vojax.features._chessboard import chessboard_points

    from ._report import print_line, write_json
    from ._run_command import warn_without_cache

    if command.model not in MODELS:
        raise ValueError(f"--model is {command.model!r}; expected one of {', '.join(MODELS)}")
    points = chessboard_points(board, command.square)
    files = _files(command.images)
    warn_without_cache()
    console = Console()
    views = _find(files, board, console)
    command.out.mkdir(parents=True, exist_ok=True)
    for left in views.left_out:
        print_line(console, f"left out: {left['image']}: {left['reason']}")
    with jax.enable_x64(command.dtype == "float64"):
        started = time.perf_counter()
        found, mask = _calibrate(views, points, MODELS[command.model], np.dtype(command.dtype))
        seconds = time.perf_counter() - started
        if float(found.view_angle) < 0.05:
            raise ValueError(
                f"all boards are parallel to within {np.degrees(float(found.view_angle)):.1f} degrees, which leaves "
                "the focal length open: take images of the board at different angles, 20 degrees and more"
            )
        report = _report(found, views, mask, command, seconds)
        write_json(command.out / "report.json", report)
        camera_file = _write_cameras(found, views, command, console)
    _draw(found, views, mask, command, report)
    _print(console, report, command, camera_file)


def _board_size(text: str) -> tuple[int, int]:
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise ValueError(f"--board is {text!r}; expected COLSxROWS of inner corners, such as 9x6")
    columns, rows = int(parts[0]), int(parts[1])
    if min(columns, rows) < 3:
        raise ValueError(f"--board is {text!r}; expected at least 3x3 inner corners")
    return columns, rows


def _files(images: tuple[str, ...]) -> list[list[pathlib.Path]]:
    """Images camera by camera: files are those of one camera, folders and patterns each those of one."""
    if not images:
        raise ValueError("no images given; expected a folder, a pattern such as 'left*.jpg', or files")
    if all(pathlib.Path(entry).is_file() for entry in images):
        return [sorted(pathlib.Path(entry) for entry in images)]
    cameras = []
    for entry in images:
        path = pathlib.Path(entry)
        if path.is_dir():
            files = [file for file in path.iterdir() if file.suffix.lower() in _SUFFIXES]
        else:
            files = [pathlib.Path(file) for file in glob.glob(entry) if pathlib.Path(file).is_file()]
        if not files:
            raise ValueError(f"no images in {entry}; expected a folder with {', '.join(_SUFFIXES)} files, or a pattern")
        cameras.append(sorted(files))
    counts = [len(files) for files in cameras]
    if len(set(counts)) > 1:
        raise ValueError(f"cameras have {counts} images; expected as many for each, in the same order")
    return cameras


def _find(files: list[list[pathlib.Path]], board: tuple[int, int], console: Any) -> _Views:
    import numpy as np

    from vojax.features import read_image
    from vojax.features._chessboard import find_chessboard

    count, size = board[0] * board[1], None
    corners = np.zeros((len(files), len(files[0]), count, 2))
    mask = np.zeros((len(files), len(files[0]), count), bool)
    left_out: list[dict[str, str]] = []
    first = None
    for c, v, file in _progress([(c, v, file) for c, own in enumerate(files) for v, file in enumerate(own)], console):
        try:
            image = read_image(file)
            if image.dtype != np.uint8:
                image = (image >> 8).astype(np.uint8)
            found = find_chessboard(image, board)
        except (ValueError, OSError) as error:
            left_out.append({"image": str(file), "reason": " ".join(str(error).split())})
            continue
        if size is None:
            size, first = image.shape[1::-1], file
        if image.shape[1::-1] != size:
            raise ValueError(
                f"{file} has {image.shape[1]}x{image.shape[0]} pixels and {first} {size[0]}x{size[1]}: expected images "
                "of one size, from one camera"
            )
        if found is None:
            left_out.append({"image": str(file), "reason": f"no board of {board[0]}x{board[1]} inner corners found"})
            continue
        corners[c, v], mask[c, v] = found, True
    if size is None:
        raise ValueError(f"none of {sum(map(len, files))} files is an image: {left_out[0]['reason']}")
    if not mask.any():
        total = sum(map(len, files))
        raise ValueError(
            f"no board of {board[0]}x{board[1]} inner corners found in any of {total} images{_hint(files, board)}"
        )
    if len(files) == 1 and (found_views := int(mask.any(axis=(0, 2)).sum())) < 3:
        raise ValueError(
            f"the board was found in {found_views} of {len(files[0])} images: expected 3 or more, at different angles"
        )
    return _Views([file.name for file in files[0]], corners, mask, (int(size[0]), int(size[1])), left_out)


def _hint(files: list[list[pathlib.Path]], board: tuple[int, int]) -> str:
    """What may be wrong: squares counted instead of corners."""
    from vojax.features import read_image
    from vojax.features._chessboard import find_chessboard

    fewer = (board[0] - 1, board[1] - 1)
    for file in files[0][:3] if min(fewer) >= 3 else ():
        try:
            if find_chessboard(read_image(file), fewer) is not None:
                return f": one of {fewer[0]}x{fewer[1]} is there; --board counts inner corners, not squares"
        except (ValueError, OSError):
            continue
    return "; --board counts inner corners, one fewer than squares in each direction"


def _progress(items: list[Any], console: Any) -> Iterable[Any]:
    """A bar on a terminal, nothing elsewhere."""
    if not console.is_terminal:
        return items
    from rich.progress import track

    return track(items, description="corners", console=console)


def _calibrate(views: _Views, points: Any, model: type, dtype: Any) -> tuple[Any, Any]:
    """The calibration, and the corners that count: wrong ones are found with a robust loss and left out."""
    import numpy as np

    from vojax.ba import Cauchy, Squared
    from vojax.calibration import calibrate, calibrate_rig

    single = len(views.corners) == 1

    def fit(mask: Any, loss: Any) -> Any:
        corners, board = views.corners.astype(dtype), points.astype(dtype)
        if single:
            return calibrate(corners[0], board, views.image_size, model=model, mask=mask[0], loss=loss)
        return calibrate_rig(corners, board, views.image_size, model=model, mask=mask, loss=loss)

    def wrong(found: Any, mask: Any) -> Any:
        residuals = np.asarray(found.residuals, np.float64).reshape(views.corners.shape)
        sigma = 1.4826 * np.median(np.abs(residuals[mask]))
        return mask & (np.linalg.norm(residuals, axis=-1) > _WRONG_SIGMAS * max(sigma, 1e-3))

    found, mask = fit(views.mask, Squared()), views.mask
    if wrong(found, mask).any():
        mask = mask & ~wrong(fit(mask, Cauchy()), mask)
        found = fit(mask, Squared())
    return found, mask


def _report(found: Any, views: _Views, mask: Any, command: Calibrate, seconds: float) -> dict[str, Any]:
    import jax
    import numpy as np

    from vojax._result import Result
    from vojax.calibration._models import all_parameters

    cameras = found.rig.cameras if hasattr(found, "rig") else (found.camera,)
    names, deviations = list(found.names), np.asarray(found.standard_deviations(), np.float64)
    by_name = dict(zip(names, deviations.tolist(), strict=True))
    poses = found.rig_from_board if hasattr(found, "rig") else found.cam_from_board
    residuals = np.asarray(found.residuals, np.float64).reshape(views.corners.shape)
    used = np.asarray(found.used).reshape(len(cameras), -1)
    counted = mask & used[:, :, None]
    squares = np.sum(residuals**2, axis=-1, where=np.broadcast_to(counted[..., None], residuals.shape))
    per_view = np.sqrt(squares.sum(axis=(0, 2)) / np.maximum(counted.sum(axis=(0, 2)), 1))
    described = []
    for i, camera in enumerate(cameras):
        prefix = f"camera{i}." if hasattr(found, "rig") else ""
        own = {name: _number(camera, name) for name in all_parameters(camera)}
        described.append(
            {
                "parameters": own,
                "standard_deviations": {n: by_name[prefix + n] for n in own if prefix + n in by_name},
                "coverage_percent": 100.0 * _coverage(views.corners[i][mask[i]], views.image_size),
            }
        )
    report = {
        "model": command.model,
        "image_size": list(views.image_size),
        "rms_px": float(found.rms_px),
        "sigma_px": float(found.sigma_px),
        "views": int(used.any(axis=0).sum()),
        "cameras": described,
        "unconstrained": [name for name, loose in zip(names, np.asarray(found.unconstrained), strict=True) if loose],
        "wrong_corners": int((views.mask & ~mask).sum()),
        "left_out": views.left_out,
        "view_angle_deg": float(np.degrees(float(found.view_angle))),
        "images": [
            {"name": name, "used": bool(on), "rms_px": float(error), "pose_from_board": pose.tolist()}
            for name, on, error, pose in zip(
                views.names,
                np.any(used, axis=0).tolist(),
                per_view,
                np.asarray(poses.wxyz_xyz, np.float64),
                strict=True,
            )
        ],
        "iterations": int(found.iterations),
        "result": Result[found.result],
        "seconds": seconds,
        "dtype": command.dtype,
        "versions": {"jax": jax.__version__},
    }
    if hasattr(found, "rig"):
        report["cam_from_rig"] = np.asarray(found.rig.cam_from_rig.wxyz_xyz, np.float64).tolist()
        report["camera_rms_px"] = np.asarray(found.camera_rms_px, np.float64).tolist()
        moves = names[len(names) - 6 * (len(cameras) - 1) :]
        report["rig_standard_deviations"] = {name: by_name[name] for name in moves}
    return report


def _write_cameras(found: Any, views: _Views, command: Calibrate, console: Any) -> str:
    """Write the cameras for `read_cameras` and others; what a format cannot hold is written in vojax' own."""
    from vojax.cameras import CameraSet, write_cameras

    from ._report import print_line

    cameras = found.rig.cameras if hasattr(found, "rig") else (found.camera,)
    named = {f"cam{i}": camera for i, camera in enumerate(cameras)}
    poses = found.rig.cam_from_rig if hasattr(found, "rig") else None
    cameras = CameraSet(named, dict.fromkeys(named, views.image_size), poses)
    name = "cameras.txt" if command.format == "colmap" else "cameras.yaml"
    try:
        write_cameras(command.out / name, cameras, format=command.format)
    except ValueError as error:
        name = "cameras.yaml"
        print_line(console, f"warning: {error}: {name} is in vojax' own format instead of {command.format}")
        write_cameras(command.out / name, cameras)
    return name


def _number(camera: Any, name: str) -> float:
    from vojax.ba._intrinsics import get_attribute

    return float(get_attribute(camera, name))


def _coverage(corners: Any, image_size: tuple[int, int]) -> float:
    """Share of the cells of a grid over the image that hold a corner."""
    import numpy as np

    columns, rows = _COVERAGE_CELLS
    u = np.clip((corners[:, 0] + 0.5) / image_size[0] * columns, 0, columns - 1).astype(int)
    v = np.clip((corners[:, 1] + 0.5) / image_size[1] * rows, 0, rows - 1).astype(int)
    return len(set(zip(u.tolist(), v.tolist(), strict=True))) / (columns * rows)


def _draw(found: Any, views: _Views, mask: Any, command: Calibrate, report: dict[str, Any]) -> None:
    import numpy as np

    from vojax.viz import save_figure
    from vojax.viz._calibration import plot_calibration

    residuals = np.asarray(found.residuals, np.float64).reshape(views.corners.shape)
    for i in range(len(views.corners)):
        name = "residuals.png" if len(views.corners) == 1 else f"residuals{i}.png"
        title = f"{command.model}, {report['views']} views: RMS {report['rms_px']:.3f} px"
        figure = plot_calibration(views.corners[i][mask[i]], residuals[i][mask[i]], views.image_size, title=title)
        save_figure(figure, command.out / name)


def _print(console: Any, report: dict[str, Any], command: Calibrate, camera_file: str) -> None:
    from rich.table import Table

    from ._report import print_line

    for i, camera in enumerate(report["cameras"]):
        table = Table(box=None)
        for head in ("parameter" if len(report["cameras"]) == 1 else f"camera {i}", "value", "± σ"):
            table.add_column(head, justify="left" if head != "value" else "right", no_wrap=True)
        for name, value in camera["parameters"].items():
            deviation = camera["standard_deviations"].get(name)
            table.add_row(name, f"{value:.6g}", "fixed" if deviation is None else f"± {deviation:.2g}")
        console.print(table)
        covered = camera["coverage_percent"]
        advice = "" if covered >= 50 else ": little; move the board to the edges"
        print_line(console, f"corners in {covered:.0f} % of the image{advice}")
    print_line(
        console, f"RMS {report['rms_px']:.4f} px over {report['views']} views; noise {report['sigma_px']:.4f} px"
    )
    if report["wrong_corners"]:
        print_line(console, f"{report['wrong_corners']} corners left out as wrong detections")
    if report["unconstrained"]:
        print_line(console, f"warning: the views do not constrain {', '.join(report['unconstrained'])}")
    print_line(console, report["result"])
    print_line(
        console,
        f"in {command.out}: {camera_file}, report.json, residuals{'' if len(report['cameras']) == 1 else '0'}.png",
    )
