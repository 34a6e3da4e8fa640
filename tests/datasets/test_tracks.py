import numpy as np
import pytest

from vojax.datasets import read_planar_tracks, read_stereo_tracks

IDENTITY = "1 0 0 0  0 1 0 0  0 0 1 {}  0 0 0 1"


def one_line(caught):
    assert "\n" not in str(caught.value)
    return str(caught.value)


def write_stereo(root):
    (root / "VO_calibration7.txt").write_text("100 110 0 50 40 0.5")
    (root / "VO_camera_poses7.txt").write_text("".join(f"{k} {IDENTITY.format(k)}\n" for k in range(3)))
    # By track, as the real file; frame 1 has no measurements.
    (root / "VO_stereo_factors7.txt").write_text(
        "0 30 60 50 45 0.5 0.25 5\n2 30 61 48 46 0.4 0.2 4\n2 9 20 18 30 -7 -2 25\n0 7 70 69 44 10 2 50\n"
    )
    return root


def test_stereo_tracks(tmp_path):
    tracks = read_stereo_tracks(write_stereo(tmp_path))
    assert len(tracks) == 3
    assert float(tracks.stereo.baseline) == 0.5
    assert [float(p) for p in (tracks.stereo.camera.fy, tracks.stereo.camera.cx)] == [110, 50]
    np.testing.assert_array_equal(tracks.frame_index, [0, 0, 2, 2])
    np.testing.assert_array_equal(tracks.track_names, [7, 9, 30])
    np.testing.assert_array_equal(tracks.track_index, [0, 2, 1, 2])
    # (u_left, v, u_right)
    np.testing.assert_array_equal(tracks.measurements, [[70, 44, 69], [60, 45, 50], [20, 30, 18], [61, 46, 48]])
    np.testing.assert_array_equal(tracks.points_cam[1], [0.5, 0.25, 5])
    np.testing.assert_array_equal(tracks.initial_poses[2], [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2]])
    assert tracks.frame(0) == slice(0, 2)
    assert tracks.frame(1) == slice(2, 2)
    assert tracks.frame(-1) == slice(2, 4)
    with pytest.raises(IndexError, match="expected 0 to 2"):
        tracks.frame(3)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("VO_calibration7.txt", "1 2 3\n", "line 1, has 3 columns: expected 6"),
        ("VO_calibration7.txt", "100 110 0 50 40 -0.5\n", "expected more than 0"),
        ("VO_calibration7.txt", "", "has 0 rows: expected one row 'fx fy"),
        ("VO_camera_poses7.txt", f"1 {IDENTITY.format(0)}\n", "line 1, starts with 1: expected 0"),
        ("VO_camera_poses7.txt", "0 1 2\n", "line 1, has 3 columns: expected 17"),
        ("VO_camera_poses7.txt", f"0 2{IDENTITY.format(0)[1:]}\n", "pose 0: .*is not a rotation"),
        ("VO_camera_poses7.txt", f"0 {IDENTITY.format(0)[:-1]}3\n", "pose 0 ends in"),
        ("VO_stereo_factors7.txt", "0 1 2\n", "line 1, has 3 columns: expected 'frame track"),
        ("VO_stereo_factors7.txt", "0 -1 60 50 45 1 1 1\n", "line 1, has '-1' for its track"),
        ("VO_stereo_factors7.txt", "0 1 60 50 nan 1 1 1\n", "line 1, from column 3 on, holds NaN"),
        ("VO_stereo_factors7.txt", "\n3 1 60 50 45 1 1 1\n", "line 2, is of frame 3: expected 0 to 2"),
        (
            "VO_stereo_factors7.txt",
            "0 1 6 5 4 1 1 1\n1 1 6 5 4 1 1 1\n0 1 7 5 4 1 1 1\n",
            "line 3: frame 0 has track 1",
        ),
        ("VO_stereo_factors7.txt", "", "holds no measurements"),
    ],
)
def test_bad_stereo_tracks(tmp_path, file, text, message):
    (write_stereo(tmp_path) / file).write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_stereo_tracks(tmp_path)
    assert file in one_line(caught)


def test_missing_and_ambiguous_stereo_tracks(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere not found"):
        read_stereo_tracks(tmp_path / "nowhere")
    write_stereo(tmp_path)
    (tmp_path / "VO_calibration.txt").write_text("100 110 0 50 40 0.5")
    with pytest.raises(ValueError, match=r"has VO_calibration\.txt, VO_calibration7\.txt: expected one"):
        read_stereo_tracks(tmp_path)
    for path in tmp_path.glob("VO_calibration*"):
        path.unlink()
    with pytest.raises(FileNotFoundError, match="has no VO_calibration"):
        read_stereo_tracks(tmp_path)


LOOK = " 0.5" * 10
CAMERA = """camera matrix:
100 0 32
0 110 24
0 0 1
cam_transform:
0 0 1 0.2
-1 0 0 0
0 -1 0 0.1
0 0 0 1
z_near: 0
z_far:  5
width:  64
height: 48
"""


def write_planar(root):
    (root / "camera.dat").write_text(CAMERA)
    (root / "trajectory.dat").write_text("0 0 0 0 0 0 0\n1 1.1 0 1.5 1 2 1.5707963267948966\n")
    (root / "world.dat").write_text("".join(f"{k} {k} {2 * k} {0.5 * k}{LOOK}\n" for k in range(4)))
    header = "seq: {}\ngt_pose: 0 0 0\nodom_pose: 0 0 0\n"
    (root / "meas-00000.dat").write_text(header.format(0) + f"point 0 3 10 20{LOOK}\npoint 1 1 11 21{LOOK}\n\n")
    (root / "meas-00001.dat").write_text(header.format(1) + f"point 0 2 12 22{LOOK}\n")
    return root


def test_planar_tracks(tmp_path):
    tracks = read_planar_tracks(write_planar(tmp_path))
    assert len(tracks) == 2
    assert [float(p) for p in (tracks.camera.fx, tracks.camera.fy, tracks.camera.cx)] == [100, 110, 32]
    assert tracks.size == (64, 48)
    assert tracks.depth_range == (0, 5)
    np.testing.assert_array_equal(tracks.frame_index, [0, 0, 1])
    np.testing.assert_array_equal(tracks.track_index, [3, 1, 2])
    np.testing.assert_array_equal(tracks.pixels, [[10, 20], [11, 21], [12, 22]])
    assert tracks.appearance.shape == (3, 10)
    assert tracks.landmark_appearance.shape == (4, 10)
    np.testing.assert_array_equal(tracks.landmarks[3], [3, 6, 1.5])
    np.testing.assert_array_equal(tracks.odometry[1], [1.1, 0, 1.5])
    np.testing.assert_array_equal(tracks.robot_poses[1, :2], [1, 2])
    # Turned to the left, at (1, 2): the camera is 0.2 ahead, which is along y, looks there, and sees down as down.
    np.testing.assert_allclose(tracks.poses[1], [[1, 0, 0, 1], [0, 0, 1, 2.2], [0, -1, 0, 0.1]], atol=1e-12)
    assert tracks.frame(1) == slice(2, 3)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("camera.dat", CAMERA.replace("0 110 24", "0 110"), "line 3, has 2 columns: expected 3"),
        ("camera.dat", CAMERA.replace("0 0 1\n", "", 1), "has 2 rows of 'camera matrix:': expected 3"),
        ("camera.dat", CAMERA.replace("width", "breadth"), "line 12: found 'breadth:"),
        ("camera.dat", CAMERA.replace("64", "64.5"), "width and height are 64.5 and 48"),
        ("camera.dat", CAMERA.replace("100 0 32", "-100 0 32"), "positive focal lengths"),
        ("camera.dat", CAMERA.replace("-1 0 0 0", "-2 0 0 0"), "cam_transform: .*is not a rotation"),
        ("trajectory.dat", "0 0 0 0 0 0\n", "line 1, has 6 columns: expected 7"),
        ("trajectory.dat", "0 0 0 0 0 0 0\n2 0 0 0 0 0 0\n", "line 2, starts with 2: expected 1"),
        ("trajectory.dat", "0 0 0 0 0 0 0\n", "has 2 files meas-.*1 poses"),
        ("world.dat", "", "is empty"),
        ("world.dat", f"0 1 2{LOOK}\n", "line 1, has 13 columns: expected 14"),
        ("meas-00001.dat", f"seq: 1\npoint 0 2 12{LOOK}\n", "line 2, has 14 columns: expected 'point"),
        ("meas-00001.dat", "seq: 0\n", "line 1, is of frame 0: expected 1"),
        ("meas-00001.dat", f"point 0 4 12 22{LOOK}\n", "line 1, is of landmark 4: expected 0 to 3"),
        ("meas-00001.dat", f"point 0 2 1 2{LOOK}\npoint 1 2 1 2{LOOK}\n", "line 2, is of landmark 2 again"),
        ("meas-00001.dat", f"point 0 2 1 x{LOOK}\n", "line 1, from column 4 on, holds something"),
    ],
)
def test_bad_planar_tracks(tmp_path, file, text, message):
    (write_planar(tmp_path) / file).write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_planar_tracks(tmp_path)
    assert file in one_line(caught)


def test_missing_planar_tracks(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere not found"):
        read_planar_tracks(tmp_path / "nowhere")
    write_planar(tmp_path)
    (tmp_path / "meas-00001.dat").rename(tmp_path / "meas-00002.dat")
    with pytest.raises(FileNotFoundError, match=r"meas-00001\.dat not found") as caught:
        read_planar_tracks(tmp_path)
    one_line(caught)
    (tmp_path / "camera.dat").unlink()
    with pytest.raises(FileNotFoundError, match=r"camera\.dat not found"):
        read_planar_tracks(tmp_path)


@pytest.mark.data
def test_real_stereo_tracks(data_root):
    tracks = read_stereo_tracks(data_root / "kitti00_stereo_tracks")
    assert len(tracks) == 77
    assert len(tracks.measurements) == 52544
    assert len(tracks.track_names) == 15638
    assert sum(len(range(52544)[tracks.frame(k)]) for k in range(77)) == 52544
    # The points are the measurements, triangulated.
    u_left, v, u_right = tracks.measurements.T
    x, y, z = tracks.points_cam.T
    camera = tracks.stereo.camera
    fx, cx, cy = float(camera.fx), float(camera.cx), float(camera.cy)
    np.testing.assert_allclose(fx * x / z + cx, u_left, atol=0.02)
    np.testing.assert_allclose(fx * y / z + cy, v, atol=0.02)
    np.testing.assert_allclose(fx * float(tracks.stereo.baseline) / z, u_left - u_right, atol=0.02)
    # The poses carry points of one frame onto those of the next.
    first, second = tracks.frame(10), tracks.frame(11)
    _, i, j = np.intersect1d(tracks.track_index[first], tracks.track_index[second], return_indices=True)
    world = [
        tracks.points_cam[part][index] @ tracks.initial_poses[k][:, :3].T + tracks.initial_poses[k][:, 3]
        for k, part, index in ((10, first, i), (11, second, j))
    ]
    assert len(i) > 200
    assert np.median(np.linalg.norm(world[0] - world[1], axis=1)) < 0.3


@pytest.mark.data
def test_real_planar_tracks(data_root):
    tracks = read_planar_tracks(data_root / "sapienza_pr_vo")
    assert len(tracks) == 121
    assert len(tracks.pixels) == 10012
    assert tracks.landmarks.shape == (1000, 3)
    assert np.linalg.norm(np.diff(tracks.robot_poses[:, :2], axis=0), axis=1).sum() == pytest.approx(21.016, abs=1e-3)
    pose = tracks.poses[tracks.frame_index]
    seen = np.einsum("oji,oj->oi", pose[:, :, :3], tracks.landmarks[tracks.track_index] - pose[:, :, 3])
    np.testing.assert_allclose(180 * seen[:, :2] / seen[:, 2:] + [320, 240], tracks.pixels, atol=0.03)
    assert np.all((seen[:, 2] > tracks.depth_range[0]) & (seen[:, 2] < tracks.depth_range[1]))
    np.testing.assert_array_equal(tracks.appearance, tracks.landmark_appearance[tracks.track_index])
