"""BAL files against the format's own formulas in numpy, and everything that can be wrong with one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform

from vojax.datasets._bal import BalCamera, read_bal, write_bal

TEXT = """2 3 4
0 0     -3.5 2.25
0 1     10.0 -4.0
1 1     0.5 7.5
1 2     -1.0 -2.0
{cameras}
0.5
-1.0
-4.0
1.0 2.0 -6.0
-0.25
0.75
-5.0
"""
CAMERAS = np.array(
    [[0.1, -0.2, 0.3, 0.5, -0.25, -1.0, 400.0, -1e-2, 1e-3], [2.0, 1.0, -0.5, 0.1, 0.2, -0.3, 500.0, 2e-2, -1e-3]]
)


def text():
    return TEXT.format(cameras="\n".join(repr(float(x)) for x in CAMERAS.ravel()))


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "problem.txt"
    file.write_text(text())
    return file


def bal_projection(camera, point):
    """The formulas of the format's page."""
    rotation = scipy.spatial.transform.Rotation.from_rotvec(camera[:3]).as_matrix()
    p = rotation @ point + camera[3:6]
    p = -p[:2] / p[2]
    f, k1, k2 = camera[6:]
    r2 = p @ p
    return f * (1.0 + k1 * r2 + k2 * r2**2) * p


def test_residuals_are_those_of_the_format(path, x64):
    problem = read_bal(path)
    assert list(problem.camera_index) == [0, 0, 1, 1]
    assert list(problem.landmark_index) == [0, 1, 1, 2]
    camera = problem.camera()
    pixels_in_file = np.array([[-3.5, 2.25], [10.0, -4.0], [0.5, 7.5], [-1.0, -2.0]])
    for k in range(4):
        i, j = problem.camera_index[k], problem.landmark_index[k]
        expected = bal_projection(CAMERAS[i], problem.landmarks[j]) - pixels_in_file[k]
        from vojax import SE3

        point = SE3(jnp.asarray(problem.cam_from_world[i])).apply(jnp.asarray(problem.landmarks[j]))
        ours = jax.tree.map(lambda leaf, i=i: leaf[i] if leaf.ndim else leaf, camera).project(point) - problem.pixels[k]
        np.testing.assert_allclose(ours * np.array([1, -1]), expected, atol=1e-10)


def test_what_is_written_comes_back(path, tmp_path):
    problem = read_bal(path)
    again = read_bal(write_bal(tmp_path / "again.txt", problem))
    for field in dataclasses.fields(problem):
        np.testing.assert_allclose(getattr(again, field.name), getattr(problem, field.name), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: "", r"line 1: found nothing, expected 'cameras points observations'"),
        (lambda t: t.replace("2 3 4", "2 3 x", 1), r"line 1: found '2 3 x'"),
        (lambda t: "\n".join(t.splitlines()[:3]), r"ends at line 3: found 2 observations, expected 4"),
        (lambda t: t.replace("1 1     0.5 7.5", "1 1     0.5", 1), r"line 4: found '1 1     0.5', expected"),
        (lambda t: t.replace("1 1     0.5 7.5", "1 1     0.5 abc", 1), r"line 4: .* expected finite numbers"),
        (lambda t: t.replace("1 2     -1.0", "1 3     -1.0", 1), r"line 5: point 3 is out of range, there are 3"),
        (lambda t: t.replace("1 2     -1.0", "2 2     -1.0", 1), r"line 5: camera 2 is out of range, there are 2"),
        (lambda t: t.replace("400.0", "nan", 1), r"line 12: found 'nan', expected a finite number"),
        (lambda t: "\n".join(t.splitlines()[:-1]), r"ends at line 29: found 26 numbers after the observations"),
        (lambda t: t + "7.0\n", r"line 31: found '7.0' after the last point"),
    ],
)  # fmt: skip
def test_malformed_files_are_refused_with_the_line(change, message, tmp_path):
    file = tmp_path / "bad.txt"
    file.write_text(change(text()))
    with pytest.raises(ValueError, match=message):
        read_bal(file)


def test_a_compressed_file_is_refused(tmp_path):
    (tmp_path / "problem.txt.bz2").write_bytes(b"BZh9\xff\xfe\x80")
    with pytest.raises(ValueError, match="decompressed"):
        read_bal(tmp_path / "problem.txt.bz2")


def test_the_camera_inverts_itself(x64):
    camera = BalCamera(500.0, -0.05, 0.002, 320.0, 240.0)
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], size=(50, 3))
    bearings = camera.unproject(camera.project(jnp.asarray(points)))
    np.testing.assert_allclose(bearings, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-9)


@pytest.mark.data
def test_ladybug_starts_at_its_known_cost(data_root, x64):
    problem = read_bal(data_root / "bal" / "problem-49-7776-pre.txt")
    assert (len(problem.cam_from_world), len(problem.landmarks), len(problem.pixels)) == (49, 7776, 31843)
    from vojax import SE3

    points = SE3(jnp.asarray(problem.cam_from_world[problem.camera_index])).apply(
        jnp.asarray(problem.landmarks[problem.landmark_index])
    )
    camera = jax.tree.map(lambda leaf: leaf[problem.camera_index] if leaf.ndim else leaf, problem.camera())
    residual = camera.project(points) - problem.pixels
    assert 0.5 * float(jnp.sum(residual**2)) == pytest.approx(850912.46, abs=0.01)
    assert int(jnp.sum(points[:, 2] <= 0)) == 31
