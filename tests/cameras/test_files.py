"""Calibration files: round trips, OpenCV's and COLMAP's own readers and writers, published files, and bad input."""

import sys

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest

from vojax.cameras import (
    BrownConrady,
    CameraSet,
    DoubleSphere,
    ExtendedUnified,
    KannalaBrandt,
    Pinhole,
    RectifiedStereo,
    Rig,
    Scaramuzza,
    Spherical,
    Unified,
    read_cameras,
    write_cameras,
)
from vojax.lie import SE3

PINHOLE = Pinhole(458.654, 457.296, 367.215, 248.375)
LENS = BrownConrady(458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
LENS5 = BrownConrady(517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
FISHEYE = KannalaBrandt(190.978, 190.973, 254.932, 256.897, 0.0034824, 0.000715, -0.0020532, 0.00020294)
POSES = SE3(jnp.asarray([[1.0, 0, 0, 0, 0, 0, 0], [0.96, 0.0, -0.28, 0.0, -0.11, 0.002, -0.001]], jnp.float32))

# What each format can hold.
HELD = {
    "vojax": [
        PINHOLE,
        Pinhole(500.0, 501.0, 320.0, 240.0, 1.5),
        LENS5,
        FISHEYE,
        Unified(600.0, 610.0, 512.0, 500.0, 1.1, -0.1, 0.03, 1e-3, -1e-3),
        ExtendedUnified(461.0, 459.6, 365.9, 249.3, 0.592, 1.124),
        DoubleSphere(351.0, 350.0, 365.9, 249.3, -0.2385, 0.5679),
        Scaramuzza(520.0, 390.0, 260.0, -9e-4, 4e-7, -1.4e-9, 1.0004, 2e-4, -3e-4, higher=(1e-12, -1e-16)),
        Spherical.from_size(2048, 1024),
    ],
    "opencv": [PINHOLE, Pinhole(500.0, 501.0, 320.0, 240.0, 1.5), LENS, LENS5, FISHEYE],
    "kalibr": [
        PINHOLE,
        LENS,
        FISHEYE,
        Unified(600.0, 610.0, 512.0, 500.0, 1.1),
        Unified(600.0, 610.0, 512.0, 500.0, 1.1, -0.1, 0.03, 1e-3, -1e-3),
        ExtendedUnified(461.0, 459.6, 365.9, 249.3, 0.592, 1.124),
        DoubleSphere(351.0, 350.0, 365.9, 249.3, -0.2385, 0.5679),
    ],
    "euroc": [PINHOLE, LENS, FISHEYE],
    "kitti": [PINHOLE, Pinhole(500.0, 501.0, 320.0, 240.0, 1.5)],
    "colmap": [
        PINHOLE,
        LENS,
        LENS5,
        FISHEYE,
        ExtendedUnified(461.0, 459.6, 365.9, 249.3, 0.592, 1.124),
        Spherical.from_size(2048, 1024),
    ],
}


project = jax.jit(lambda camera, points: camera.project(points))
pose_matrices = jax.jit(lambda poses: poses.as_matrix())


def suffix(format):
    return ".txt" if format in ("kitti", "colmap") else ".yaml"


def same_camera(one, other, rtol=0.0):
    assert type(one) is type(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol)


@pytest.mark.parametrize("format", HELD)
def test_a_camera_comes_back_as_it_was(format, tmp_path):
    for i, camera in enumerate(HELD[format]):
        path = tmp_path / f"{i}{suffix(format)}"
        size = (2048, 1024)
        write_cameras(path, CameraSet({"7": camera}, {"7": size}), format=format)
        read = read_cameras(path)
        (found,) = read.cameras.values()
        # COLMAP's half pixel and KITTI's product with t round the last digit.
        same_camera(found, camera, rtol=2e-7 if format in ("colmap", "kitti") else 0.0)
        assert list(read.sizes.values()) == ([] if format == "kitti" else [size])


@pytest.mark.parametrize("format", ["vojax", "opencv", "kalibr"])
def test_a_pair_keeps_its_poses(format, tmp_path):
    path = tmp_path / "pair.yaml"
    write_cameras(path, CameraSet({"cam0": LENS, "cam1": LENS}, {"cam0": (752, 480)}, POSES), format=format)
    read = read_cameras(path)
    assert read.cam_from_rig is not None
    expected, found = pose_matrices(POSES), np.asarray(pose_matrices(read.cam_from_rig))
    np.testing.assert_allclose(found[1] @ np.linalg.inv(found[0]), expected[1], atol=1e-6)
    rig = read.rig()
    assert isinstance(rig, Rig)
    same_camera(rig.cameras[1], LENS)


def test_names_and_double_precision_survive(tmp_path, x64):
    camera = Pinhole(fx=1 / 3, fy=np.pi, cx=1e-17, cy=1e17)
    write_cameras(tmp_path / "a.yaml", {"left eye": camera})
    read = read_cameras(tmp_path / "a.yaml")
    same_camera(read["left eye"], camera)
    assert read.pose("left eye") is None
    assert read.rig().cam_from_rig.wxyz_xyz.shape == (1, 7)


@pytest.mark.parametrize("camera", [LENS5, FISHEYE])
def test_opencv_reads_what_vojax_writes(camera, tmp_path):
    path = tmp_path / "camera.yaml"
    write_cameras(path, CameraSet({"camera": camera}, {"camera": (640, 480)}), format="opencv")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(storage.getNode("camera_matrix").mat(), Pinhole(*jax.tree.leaves(camera)[:4]).matrix())
    np.testing.assert_allclose(
        storage.getNode("distortion_coefficients").mat()[:, 0], jax.tree.leaves(camera)[4:], rtol=1e-6
    )
    assert storage.getNode("image_width").real() == 640
    write_cameras(path, CameraSet({"a": LENS, "b": LENS5}, {}, POSES), format="opencv")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    second = np.asarray(pose_matrices(POSES))[1]
    np.testing.assert_allclose(storage.getNode("R").mat(), second[:3, :3], atol=1e-6)
    np.testing.assert_allclose(storage.getNode("T").mat()[:, 0], second[:3, 3], atol=1e-6)


@pytest.mark.parametrize("count", [4, 5, 8, 14])
def test_vojax_reads_what_opencv_writes(count, tmp_path, x64):
    path, matrix = tmp_path / "out.yml", np.array([[517.3, 0, 318.6], [0, 516.5, 255.3], [0, 0, 1.0]])
    lens = np.zeros((count, 1))
    lens[:5, 0] = [0.2624, -0.9531, -0.0054, 0.0026, 1.1633][:count]
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in {"image_width": 640, "image_height": 480, "camera_matrix": matrix}.items():
        storage.write(key, value)
    storage.write("distortion_coefficients", lens)
    storage.release()
    read = read_cameras(path)
    expected = BrownConrady(517.3, 516.5, 318.6, 255.3, *[float(k) for k in lens[:5, 0]])
    same_camera(read["camera"], expected)
    assert read.sizes == {"camera": (640, 480)}


def test_camera_info_of_ros_is_understood(tmp_path):
    path = tmp_path / "head.yaml"
    path.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: head\n"
        "camera_matrix:\n  rows: 3\n  cols: 3\n  data: [500, 0, 320, 0, 501, 240, 0, 0, 1]\n"
        "distortion_model: plumb_bob\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 1e-3, 0, 0]}\n"
    )
    same_camera(read_cameras(path)["head"], BrownConrady(500.0, 501.0, 320.0, 240.0, 0.1, -0.2, 1e-3))


def test_colmap_reads_what_vojax_writes(tmp_path, x64):
    cameras = CameraSet({"3": LENS, "8": FISHEYE}, {"3": (752, 480), "8": (512, 512)})
    write_cameras(tmp_path / "cameras.txt", cameras, format="colmap")
    (tmp_path / "images.txt").write_text("")
    (tmp_path / "points3D.txt").write_text("")
    model = pycolmap.Reconstruction()
    model.read_text(str(tmp_path))
    assert sorted(model.cameras) == [3, 8]
    points = np.array([[0.1, 0.2, 1.0], [-0.5, 0.3, 2.0]])
    for name, camera in cameras.cameras.items():
        # Their pixels have the first centre at a half.
        expected = model.cameras[int(name)].img_from_cam(points) - 0.5
        np.testing.assert_allclose(project(camera, points), expected, atol=1e-4)


def test_colmap_models_with_one_focal_length(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text(
        "# comment\n1 SIMPLE_PINHOLE 640 480 500 320.5 240.5\n2 SIMPLE_RADIAL 640 480 500 320.5 240.5 0.1\n"
        "3 RADIAL 640 480 500 320.5 240.5 0.1 0.01\n4 RADIAL_FISHEYE 640 480 500 320.5 240.5 0.1 0.01\n"
    )
    read = read_cameras(path)
    same_camera(read["1"], Pinhole(500.0, 500.0, 320.0, 240.0))
    same_camera(read["2"], BrownConrady(500.0, 500.0, 320.0, 240.0, 0.1))
    same_camera(read["3"], BrownConrady(500.0, 500.0, 320.0, 240.0, 0.1, 0.01))
    same_camera(read["4"], KannalaBrandt(500.0, 500.0, 320.0, 240.0, 0.1, 0.01))


@pytest.mark.data
def test_published_files(data_root, x64):
    euroc = read_cameras(data_root / "euroc" / "V1_01_easy" / "mav0")
    same_camera(
        euroc["cam0"],
        BrownConrady(*[458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907], *[0.00019359, 1.76187114e-05]),
    )
    assert euroc.sizes == {"cam0": (752, 480), "cam1": (752, 480)}
    matrices = np.asarray(pose_matrices(euroc.cam_from_rig))
    # The sensor's origin is in the body where T_BS says.
    origin = np.linalg.inv(matrices[0])[:3, 3]
    np.testing.assert_allclose(origin, [-0.0216401454975, -0.064676986768, 0.00981073058949], atol=1e-9)
    relative = matrices[1] @ np.linalg.inv(matrices[0])
    assert abs(np.linalg.norm(relative[:3, 3]) - 0.11007) < 1e-4
    kitti = read_cameras(data_root / "kitti" / "sequences" / "06" / "calib.txt")
    assert list(kitti.cameras) == ["P0", "P1"]
    stereo = RectifiedStereo(kitti["P0"], -float(kitti.pose("P1").translation()[0]))
    assert abs(float(stereo.baseline) - 379.8145 / 707.0912) < 1e-9
    assert float(stereo.camera.cy) == 183.1104


def kalibr(**change):
    part = {
        "camera_model": "pinhole",
        "intrinsics": [458.0, 457.0, 367.0, 248.0],
        "distortion_model": "radtan",
        "distortion_coeffs": [-0.28, 0.07, 0.0, 0.0],
        "resolution": [752, 480],
    }
    part.update(change)
    return "cam0: " + repr({key: value for key, value in part.items() if value is not None})


BAD = {
    "empty.yaml": ("", "holds no keys"),
    "syntax.yaml": ("%YAML:1.0\na: [1, 2\nb: 3\n", "line 3"),
    "tag.yaml": ("camera_matrix: !!python/object:os.system {}\n", "not valid YAML"),
    "other.yaml": ("weather: fine\n", "none of OpenCV's"),
    "list.yaml": ("- 1\n- 2\n", "holds no keys"),
    "model.yaml": (kalibr(camera_model="ladybug"), "cam0: camera model 'ladybug'"),
    "few.yaml": (kalibr(intrinsics=[1, 2, 3]), "cam0, intrinsics has 3 numbers: expected 4"),
    "words.yaml": (kalibr(intrinsics=[1, 2, 3, "x"]), "holds 'x'"),
    "nan.yaml": ("cam0: {camera_model: pinhole, intrinsics: [1, 2, 3, .nan]}\n", "expected finite numbers"),
    "no_lens.yaml": (kalibr(distortion_coeffs=None), "no 'distortion_coeffs'"),
    "size.yaml": (kalibr(resolution=[752, -480]), "width and height"),
    "pose.yaml": (kalibr(T_cam_imu=[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "not a rigid"),
    "matrix.yaml": ("camera_matrix: {rows: 3, cols: 3, data: [1, 2, 3]}\n", "rows x cols = 3 x 3"),
    "negative.yaml": ("camera_matrix: [-500, 0, 320, 0, 500, 240, 0, 0, 1]\n", "fx, fy > 0"),
    "rational.yaml": ("K: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nD: [0, 0, 0, 0, 0, 1, 0, 0]\n", "rational"),
    "count.yaml": ("K: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nD: [0, 0, 0]\n", "has 3 numbers"),
    "quaternion.yaml": (
        "a: {model: Spherical, parameters: {fx: 1, fy: 1, cx: 0, cy: 0}, cam_from_rig: [2, 0, 0, 0, 0, 0, 0]}\n",
        "length 2",
    ),
    "focal.yaml": (kalibr(intrinsics=[0, 1, 2, 3]), "cam0 has fx = 0"),
    "many.yaml": ("a: {model: Pinhole, parameters: {fx: [1, 2], fy: 1, cx: 0, cy: 0}}\n", "a, fx has 2 numbers"),
    "own.yaml": ("a: {model: Pinhole, parameters: {fx: 1, gy: 2}}\n", "parameters of Pinhole"),
    "unknown.yaml": ("a: {model: Camera, parameters: {fx: 1}}\n", "model 'Camera'"),
    "kitti.txt": ("P0: 1 2 3\n", "line 1 (P0), has 3 numbers: expected 12"),
    "kitti_focal.txt": ("P0: -7 0 6 0 0 7 1 0 0 0 1 0\n", "positive focal"),
    "colmap.txt": ("1 OPENCV 640 480 500\n", "line 1, parameters has 1 numbers: expected 8"),
    "colmap_model.txt": ("1 LADYBUG 640 480 500\n", "id MODEL width height"),
    "colmap_twice.txt": ("1 PINHOLE 9 9 5 5 4 4\n1 PINHOLE 9 9 5 5 4 4\n", "line 2, has identifier"),
    "prose.txt": ("call me Ishmael\n", "no calibration file"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line_that_says_where(name, tmp_path):
    text, expected = BAD[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError) as error:  # noqa: PT011 - the message is checked below
        read_cameras(tmp_path / name)
    message = str(error.value)
    assert name in message
    assert expected in message
    assert "\n" not in message


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.yaml not found"):
        read_cameras(tmp_path / "nothing.yaml")
    with pytest.raises(ValueError, match=r"without cam0/sensor\.yaml"):
        read_cameras(tmp_path)
    (tmp_path / "image.yaml").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(ValueError, match="cannot be read"):
        read_cameras(tmp_path / "image.yaml")


@pytest.mark.parametrize(
    ("cameras", "format", "expected"),
    [
        (PINHOLE, "xml", "format 'xml'"),
        (LENS5, "kalibr", "has k3"),
        (Pinhole(1.0, 1.0, 0.0, 0.0, 2.0), "kalibr", "has skew"),
        (Spherical.from_size(20, 10), "kalibr", "is a Spherical"),
        ({"a": LENS, "b": LENS}, "euroc", "2 cameras"),
        ({"a": LENS, "b": FISHEYE}, "opencv", "BrownConrady, KannalaBrandt"),
        ({"a": LENS, "b": LENS, "c": LENS}, "opencv", "one or two"),
        (LENS, "kitti", "Pinhole only"),
        (CameraSet({"a": PINHOLE, "b": PINHOLE}, {}, POSES), "kitti", "is turned"),
        (PINHOLE, "colmap", "no image size"),
        (CameraSet({"a": DoubleSphere(1.0, 1.0, 0.0, 0.0, 0.0, 0.5)}, {"a": (4, 3)}), "colmap", "DoubleSphere"),
        (CameraSet({"a": Spherical.from_size(20, 10)}, {"a": (40, 10)}), "colmap", "panorama"),
    ],
)
def test_what_a_format_cannot_hold_is_refused(cameras, format, expected, tmp_path):
    with pytest.raises(ValueError, match=expected):
        write_cameras(tmp_path / "out", cameras, format=format)
    assert not (tmp_path / "out").exists()


def test_without_pyyaml_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "yaml", None)
    (tmp_path / "a.yaml").write_text("a: 1\n")
    with pytest.raises(ImportError, match=r"vojax\[files\]"):
        read_cameras(tmp_path / "a.yaml")


def test_camera_sets_check_themselves():
    with pytest.raises(ValueError, match="camera 'a' has parameters that are arrays"):
        CameraSet({"a": jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), PINHOLE)})
    with pytest.raises(ValueError, match="without a camera"):
        CameraSet({})
    with pytest.raises(ValueError, match="size for camera 'b'"):
        CameraSet({"a": PINHOLE}, {"b": (1, 1)})
    with pytest.raises(ValueError, match="expected \\(1, 7\\)"):
        CameraSet({"a": PINHOLE}, {}, POSES)
    with pytest.raises(ValueError, match="not known"):
        CameraSet({"a": PINHOLE, "b": PINHOLE}).rig()
