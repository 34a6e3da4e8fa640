"""`vojax calibrate` on images that the test renders, and on what users get wrong."""

import json

import cv2
import numpy as np
import pytest

from vojax.cameras import Pinhole, read_cameras

BOARD = (6, 5)
SQUARE_PX = 60


def picture(turn, distance, shift=(0.0, 0.0), size=(640, 480)):
    """A chessboard of 7 x 6 squares seen by a pinhole camera of focal length 600."""
    squares = np.indices((BOARD[1] + 1, BOARD[0] + 1)).sum(0) % 2
    texture = np.kron(255 * squares, np.ones((SQUARE_PX, SQUARE_PX))).astype(np.uint8)
    texture = np.pad(texture, SQUARE_PX, constant_values=255)
    # Texture pixels to the board's plane, a square for a unit, its middle at the origin.
    middle = (np.array(texture.shape[::-1]) - 1) / 2
    plane = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, SQUARE_PX]]) / SQUARE_PX
    rotation, _ = cv2.Rodrigues(np.array(turn))
    pose = np.column_stack([rotation[:, :2], [*shift, distance]])
    k = np.array([[600, 0, (size[0] - 1) / 2], [0, 600, (size[1] - 1) / 2], [0, 0, 1.0]])
    return cv2.warpPerspective(texture, k @ pose @ plane, size, flags=cv2.INTER_AREA, borderValue=128)


VIEWS = [
    ((0.5, 0.0, 0.1), 9.0, (0.5, 0.0)), ((-0.5, 0.1, 0.0), 9.5, (-1.0, 0.5)), ((0.0, 0.5, -0.1), 9.0, (0.0, -0.5)),
    ((0.1, -0.5, 0.2), 10.0, (1.0, 0.5)), ((0.4, 0.4, 0.0), 9.0, (-0.5, -0.5)),
]  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    for i, view in enumerate(VIEWS):
        cv2.imwrite(str(images / f"{i}.png"), picture(*view))
    return images


def command(vojax_command, *images, out, board="6x5", **options):
    extra = [word for key, value in options.items() for word in (f"--{key}", value)]
    return vojax_command("calibrate", *images, "--board", board, "--square", "0.03", "--out", out, *extra)


def test_a_camera_is_calibrated_and_what_fails_is_named(vojax_command, folder, tmp_path):
    cv2.imwrite(str(folder / "blank.png"), np.full((480, 640), 128, np.uint8))
    (folder / "broken.png").write_bytes(b"no image")
    outcome = command(vojax_command, folder, out=tmp_path / "out", model="pinhole")
    assert (outcome.status, outcome.stderr) == (0, "")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    camera = report["cameras"][0]
    assert report["views"] == 5
    assert report["rms_px"] < 0.2
    for name, true in (("fx", 600.0), ("fy", 600.0), ("cx", 319.5), ("cy", 239.5)):
        assert abs(camera["parameters"][name] - true) < 4 * camera["standard_deviations"][name] + 0.5
    assert [left["image"].rsplit("/", 1)[-1] for left in report["left_out"]] == ["blank.png", "broken.png"]
    assert report["dtype"] == "float64"
    assert (tmp_path / "out" / "residuals.png").read_bytes()[:4] == b"\x89PNG"
    cameras = read_cameras(tmp_path / "out" / "cameras.yaml")
    assert cameras.sizes == {"cam0": (640, 480)}
    assert float(cameras["cam0"].fx) == pytest.approx(camera["parameters"]["fx"], rel=1e-6)
    for word in ("fx", "±", "RMS", "left out", "blank.png", "broken.png", str(tmp_path / "out")):
        assert word in outcome.stdout


@pytest.mark.slow
@pytest.mark.parametrize(("form", "name"), [("opencv", "cameras.yaml"), ("colmap", "cameras.txt")])
def test_the_camera_in_another_format(vojax_command, folder, tmp_path, form, name):
    outcome = command(vojax_command, folder, out=tmp_path / "out", model="pinhole", format=form)
    assert (outcome.status, outcome.stderr) == (0, "")
    (camera,) = read_cameras(tmp_path / "out" / name).cameras.values()
    assert isinstance(camera, Pinhole)
    assert abs(float(camera.fx) - 600.0) < 1.0


@pytest.mark.slow
def test_a_format_that_cannot_hold_the_camera(vojax_command, folder, tmp_path):
    outcome = command(vojax_command, folder, out=tmp_path / "out", model="scaramuzza", format="kalibr")
    assert (outcome.status, outcome.stderr) == (0, "")
    assert "vojax' own format instead of kalibr" in outcome.stdout
    assert float(read_cameras(tmp_path / "out" / "cameras.yaml")["cam0"].a0) > 0


def one_line(outcome, *words):
    assert outcome.status == 2
    assert outcome.stderr.count("\n") == 1
    for word in words:
        assert word in outcome.stderr


def test_squares_counted_instead_of_corners(vojax_command, folder, tmp_path):
    one_line(command(vojax_command, folder, out=tmp_path, board="7x6"), "6x5 is there", "inner corners, not squares")


def test_no_corners(vojax_command, tmp_path):
    images = tmp_path / "blank"
    images.mkdir()
    cv2.imwrite(str(images / "a.png"), np.full((200, 300), 128, np.uint8))
    one_line(command(vojax_command, images, out=tmp_path), "no board of 6x5 inner corners found in any of 1 images")


def test_too_few_views(vojax_command, folder, tmp_path):
    files = (folder / "0.png", folder / "1.png")
    one_line(command(vojax_command, *files, out=tmp_path), "found in 2 of 2 images: expected 3 or more")


def test_sizes_that_differ(vojax_command, folder, tmp_path):
    cv2.imwrite(str(folder / "9.png"), picture(*VIEWS[0], size=(800, 600)))
    one_line(command(vojax_command, folder, out=tmp_path), "9.png has 800x600", "of one size")


def test_no_images_and_other_formats(vojax_command, tmp_path):
    one_line(command(vojax_command, tmp_path / "nowhere", out=tmp_path), "no images in", "nowhere")
    text = tmp_path / "notes.png"
    text.write_text("not a picture")
    one_line(command(vojax_command, text, out=tmp_path), "none of 1 files is an image")


@pytest.mark.parametrize("board", ["9", "9x", "2x9", "axb", "9x6x3"])
def test_board_that_is_none(vojax_command, folder, tmp_path, board):
    one_line(command(vojax_command, folder, out=tmp_path, board=board), "--board is", "inner corners")


def test_square_that_is_none(vojax_command, folder, tmp_path):
    outcome = vojax_command("calibrate", folder, "--board", "6x5", "--square", "0", "--out", tmp_path)
    one_line(outcome, "square is 0", "above zero")


@pytest.mark.slow
def test_parallel_boards(vojax_command, tmp_path):
    images = tmp_path / "parallel"
    images.mkdir()
    for i, (distance, shift) in enumerate([(8, (0, 0)), (9, (1, 0)), (10, (-1, 1)), (8.5, (0, 0.5))]):
        cv2.imwrite(str(images / f"{i}.png"), picture((0.0, 0.0, 0.1 * i), distance, shift))
    one_line(command(vojax_command, images, out=tmp_path / "out", model="pinhole"), "all boards are parallel")
