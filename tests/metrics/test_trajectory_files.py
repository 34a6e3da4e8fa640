import numpy as np
import pytest
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from vojax.metrics import Trajectory, TrajectoryWriter, read_trajectory, write_trajectory


def _random_trajectory(n=20, seed=3, start=1305031102.160407):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4)[None], (n, 1, 1))
    poses[:, :3, :3] = Rotation.random(n, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(n, 3)) * 100
    return Trajectory(start + np.cumsum(rng.uniform(0.02, 0.2, n)), poses)


def test_tum_round_trip_and_evo_reads_the_same(tmp_path):
    trajectory = _random_trajectory()
    write_trajectory(tmp_path / "a.txt", trajectory, "tum")
    again = read_trajectory(tmp_path / "a.txt", "tum")
    np.testing.assert_array_equal(again.timestamps, trajectory.timestamps)
    np.testing.assert_allclose(again.world_from_cam, trajectory.world_from_cam, atol=1e-9)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "a.txt")
    np.testing.assert_array_equal(theirs.timestamps, trajectory.timestamps)
    np.testing.assert_allclose(np.array(theirs.poses_se3), trajectory.world_from_cam, atol=1e-9)


def test_kitti_round_trip_and_evo_reads_the_same(tmp_path):
    trajectory = _random_trajectory(start=0.0)
    write_trajectory(tmp_path / "a.txt", trajectory, "kitti")
    again = read_trajectory(tmp_path / "a.txt", "kitti", times=trajectory.timestamps)
    np.testing.assert_array_equal(again.timestamps, trajectory.timestamps)
    np.testing.assert_allclose(again.world_from_cam, trajectory.world_from_cam, atol=1e-9)
    theirs = file_interface.read_kitti_poses_file(tmp_path / "a.txt")
    np.testing.assert_allclose(np.array(theirs.poses_se3), trajectory.world_from_cam, atol=1e-9)
    np.testing.assert_array_equal(read_trajectory(tmp_path / "a.txt", "kitti").timestamps, np.arange(20.0))


@pytest.mark.parametrize("angle", [0.0, 1e-9, np.pi / 2, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("axis", np.concatenate([np.eye(3), -np.eye(3), np.ones((1, 3)) / np.sqrt(3)]))
def test_quaternions_survive_every_kind_of_rotation(tmp_path, angle, axis):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
    write_trajectory(tmp_path / "a.txt", Trajectory(np.zeros(1), pose[None]))
    np.testing.assert_allclose(read_trajectory(tmp_path / "a.txt").world_from_cam[0], pose, atol=1e-11)


def test_comments_and_blank_lines_are_skipped(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("# header\n\n1.5 1 2 3 0 0 0 1  # trailing\n   \n2.5 1 2 3 0 0 0.70711 0.70711\n")
    trajectory = read_trajectory(path)
    np.testing.assert_array_equal(trajectory.timestamps, [1.5, 2.5])
    np.testing.assert_allclose(trajectory.world_from_cam[1, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(trajectory.positions, [[1, 2, 3], [1, 2, 3]])


GOOD = "0.0 0 0 0 0 0 0 1\n"
KITTI_IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    ("format", "text", "message"),
    [
        ("tum", GOOD + "1.0 0 0 0 0 0 1\n", r":2: found 7 columns, expected 8"),
        ("tum", GOOD + "1.0 0 0 nan 0 0 0 1\n", r":2: found a number that is not finite"),
        ("tum", GOOD + "1.0 0 0 inf 0 0 0 1\n", r":2: found a number that is not finite"),
        ("tum", GOOD + "1.0 0 0 zero 0 0 0 1\n", r":2: .*'zero'; expected 8 numbers"),
        ("tum", GOOD + "1.0 0 0 0 0 0 0 2\n", r":2: the quaternion has length 2, expected 1"),
        ("tum", GOOD + "1.0 0 0 0 0 0 0 0\n", r":2: the quaternion has length 0, expected 1"),
        ("tum", GOOD + "# c\n-1.0 0 0 0 0 0 0 1\n", r":3: time -1.0 lies before 0.0"),
        ("tum", "# only a comment\n", r"holds no poses"),
        ("tum", "", r"holds no poses"),
        ("tum", KITTI_IDENTITY, r":1: found 12 columns, expected 8"),
        ("kitti", GOOD, r":1: found 8 columns, expected 12"),
        ("kitti", KITTI_IDENTITY + "2 0 0 0 0 2 0 0 0 0 2 0\n", r":2: not a camera pose: .* not a rotation"),
        ("kitti", "1 0 0 0 0 1 0 0 0 0 -1 0\n", r":1: not a camera pose: .* reflection"),
    ],
)
def test_bad_files_name_file_and_line(tmp_path, format, text, message):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_trajectory(path, format)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_missing_folder_binary_and_unknown_format(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such trajectory file"):
        read_trajectory(tmp_path / "none.txt")
    with pytest.raises(ValueError, match="is a folder"):
        read_trajectory(tmp_path)
    (tmp_path / "image.png").write_bytes(bytes(range(255)))
    with pytest.raises(ValueError, match="not a text file"):
        read_trajectory(tmp_path / "image.png")
    with pytest.raises(FileNotFoundError, match="no such folder"):
        TrajectoryWriter(tmp_path / "none" / "a.txt")
    (tmp_path / "k.txt").write_text(KITTI_IDENTITY * 2)
    with pytest.raises(ValueError, match="2 poses, but 3 times"):
        read_trajectory(tmp_path / "k.txt", "kitti", times=np.arange(3.0))
    with pytest.raises(ValueError, match="leave out times"):
        read_trajectory(tmp_path / "k.txt", "tum", times=np.arange(2.0))


@pytest.mark.parametrize("format", ["tum", "kitti"])
def test_every_pose_is_on_disk_before_the_next_one(tmp_path, format):
    trajectory = _random_trajectory(5)
    path = tmp_path / "a.txt"
    with TrajectoryWriter(path, format) as writer:
        for i in range(5):
            writer.append(trajectory.world_from_cam[i], trajectory.timestamps[i])
            # Read while the writer is still open: what a killed run would leave behind.
            assert len(read_trajectory(path, format)) == i + 1
    with pytest.raises(ValueError, match="closed"):
        writer.append(np.eye(4), 1e12)
    writer.close()


def test_writer_refuses_bad_poses_and_leaves_the_file_valid(tmp_path):
    path = tmp_path / "a.txt"
    with TrajectoryWriter(path) as writer:
        writer.append(np.eye(4, dtype=np.float32), 1.0)
        with pytest.raises(ValueError, match="not finite numbers"):
            writer.append(np.full((4, 4), np.nan), 2.0)
        with pytest.raises(ValueError, match="not a rotation"):
            writer.append(np.diag([2.0, 2.0, 2.0, 1.0]), 2.0)
        with pytest.raises(ValueError, match=r"needs a time from 1\.0 on; found None"):
            writer.append(np.eye(4))
        with pytest.raises(ValueError, match=r"needs a time from 1\.0 on; found 0\.5"):
            writer.append(np.eye(4), 0.5)
    assert path.read_text() == "1.0 0 0 0 0 0 0 1\n"


def test_trajectory_refuses_what_is_not_one():
    eye = np.tile(np.eye(4)[None], (3, 1, 1))
    with pytest.raises(ValueError, match="go backwards; number 2"):
        Trajectory(np.array([0.0, 2.0, 1.0]), eye)
    with pytest.raises(ValueError, match="at least one pose"):
        Trajectory(np.zeros(0), eye[:0])
    with pytest.raises(ValueError, match="timestamp 1 is not a finite"):
        Trajectory(np.array([0.0, np.nan, 1.0]), eye)
    bad = eye.copy()
    bad[1, 0, 0] = 1.1
    with pytest.raises(ValueError, match="pose 1 is not a rigid transform"):
        Trajectory(np.arange(3.0), bad)
    bad = eye.copy()
    bad[2, 3, 0] = 1.0
    with pytest.raises(ValueError, match=r"pose 2 .* last row"):
        Trajectory(np.arange(3.0), bad)
    bad[2, 3, 0] = np.nan
    with pytest.raises(ValueError, match=r"pose 2 .* not finite"):
        Trajectory(np.arange(3.0), bad)


def test_trajectory_is_immutable_and_measures_its_path():
    poses = np.tile(np.eye(4)[None], (3, 1, 1))
    poses[1, :3, 3] = (3.0, 4.0, 0.0)
    poses[2, :3, 3] = (3.0, 4.0, 2.0)
    trajectory = Trajectory(np.arange(3.0), poses)
    poses[:] = 0
    np.testing.assert_array_equal(trajectory.distances, [0, 5, 7])
    assert trajectory.path_length == 7
    with pytest.raises(ValueError, match="read-only"):
        trajectory.positions[0, 0] = 1.0
    moved = _random_trajectory().from_origin()
    np.testing.assert_allclose(moved.world_from_cam[0], np.eye(4), atol=1e-12)
    assert moved.path_length == pytest.approx(_random_trajectory().path_length, rel=1e-12)
