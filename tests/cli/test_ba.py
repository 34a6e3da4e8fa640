"""`vojax ba` on a small reconstruction, in both formats."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3
from vojax.datasets._bal import BalProblem, read_bal, write_bal
from vojax.datasets._colmap import ColmapImage, ColmapModel, read_colmap, write_colmap

C, P = 3, 20


@pytest.fixture(scope="module")
def scene():
    """A reconstruction of three cameras with noise of half a pixel, started beside the truth."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        poses = SE3.exp(
            jnp.asarray(np.concatenate([[[0.8 * k, 0, 0] for k in range(C)], 0.05 * rng.normal(size=(C, 3))], 1))
        )
        points = rng.uniform([-2, -2, 4], [3, 2, 8], size=(P, 3))
        index, seen = (grid.ravel() for grid in np.indices((C, P)))
        local = np.asarray(SE3(poses.wxyz_xyz[index]).apply(jnp.asarray(points[seen])))
        pixels = 400.0 * local[:, :2] / local[:, 2:] + 0.5 * rng.normal(size=(C * P, 2))
        start = poses @ SE3.exp(0.01 * jnp.asarray(rng.normal(size=(C, 6))))
        intrinsics = np.tile([[400.0, 0.0, 0.0]], (C, 1))
        return BalProblem(
            np.array(start.wxyz_xyz), points + 0.05 * rng.normal(size=(P, 3)), pixels, index, seen, intrinsics
        )


def as_colmap(scene):
    images = []
    for k in range(C):
        mine = scene.camera_index == k
        pixels = scene.pixels[mine] + [320.5, 240.5]
        images.append(
            ColmapImage(k + 1, scene.cam_from_world[k], 1, f"{k}.png", pixels, scene.landmark_index[mine] + 1)
        )
    tracks = [np.array([(k + 1, j) for k in range(C)]) for j in range(P)]
    return ColmapModel(
        {1: ("SIMPLE_PINHOLE", 640, 480, np.array([400.0, 320.5, 240.5]))},
        images, np.arange(1, P + 1), scene.landmarks, np.zeros((P, 3), np.uint8), np.zeros(P), tracks,
    )  # fmt: skip


def test_a_bal_file_is_refined(vojax_command, scene, tmp_path):
    file = write_bal(tmp_path / "problem.txt", scene)
    outcome = vojax_command("ba", file, "--format", "bal", "--out", tmp_path / "out")
    assert (outcome.status, outcome.stderr) == (0, "")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report.keys() >= {
        "initial_cost", "final_cost", "iterations", "solve_seconds", "compile_seconds", "behind_camera", "result",
    }  # fmt: skip
    # 120 residuals of variance ¼, 27 + 60 unknowns of which seven are gauge.
    assert report["final_cost"] < 0.5 * 120 * 0.25 < 0.01 * report["initial_cost"]
    assert report["behind_camera"] == 0
    assert report["dtype"] == "float64"
    assert "converged" in report["result"] or "steps" in report["result"]
    # The cost of what was written is the cost that was reported.
    refined = read_bal(tmp_path / "out" / "refined.txt")
    with jax.enable_x64(True):
        local = SE3(jnp.asarray(refined.cam_from_world[refined.camera_index])).apply(
            jnp.asarray(refined.landmarks[refined.landmark_index])
        )
        camera = jax.tree.map(lambda leaf: leaf[refined.camera_index] if leaf.ndim else leaf, refined.camera())
        cost = 0.5 * float(jnp.sum((camera.project(local) - refined.pixels) ** 2))
    assert cost == pytest.approx(report["final_cost"], rel=1e-9)
    np.testing.assert_array_equal(refined.pixels, scene.pixels)
    assert (tmp_path / "out" / "residuals.png").read_bytes()[:4] == b"\x89PNG"
    for word in ("iteration", "damping", "final cost", "report.json", str(tmp_path / "out")):
        assert word in outcome.stdout


@pytest.mark.slow
def test_a_colmap_model_is_refined(vojax_command, scene, tmp_path):
    write_colmap(tmp_path / "sparse", as_colmap(scene))
    outcome = vojax_command(
        "ba",
        tmp_path / "sparse",
        "--format",
        "colmap",
        "--out",
        tmp_path / "out",
        "--loss",
        "huber",
        "--dtype",
        "float32",
    )
    assert (outcome.status, outcome.stderr) == (0, "")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["final_cost"] < 0.05 * report["initial_cost"]
    refined = read_colmap(tmp_path / "out" / "refined")
    assert [image.name for image in refined.images] == ["0.png", "1.png", "2.png"]
    assert 0.1 < np.mean(refined.errors) < 1.0
    assert np.all(refined.cameras[1][3][1:] == [320.5, 240.5])


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["ba"], "FILE"),
        (["ba", "nowhere.txt", "--format", "bal", "--out", "o"], "nowhere.txt"),
        (["ba", "nowhere", "--format", "colmap", "--out", "o"], "cameras.txt not found"),
        (["ba", "x", "--format", "ply", "--out", "o"], "'ply'"),
        (["ba", "x", "--format", "bal", "--out", "o", "--max-steps", "0"], "expected 1 or more"),
        (["ba", "short.txt", "--format", "bal", "--out", "o"], "short.txt ends at line 2"),
    ],
)
def test_mistakes_end_in_one_line(vojax_command, arguments, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.txt").write_text("1 1 3\n0 0 1.0 2.0\n")
    error = vojax_command(*arguments).error
    assert error.startswith("vojax: error: ")
    assert expected in error
    assert not (tmp_path / "o").exists()


def test_help(vojax_command):
    outcome = vojax_command("ba", "--help")
    assert outcome.status == 0
    assert "COLMAP" in outcome.stdout
