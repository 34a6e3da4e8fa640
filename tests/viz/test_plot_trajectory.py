import builtins
import subprocess
import sys

import matplotlib
import numpy as np
import pytest
from matplotlib import image as mpimage

from vojax.metrics import Trajectory, evaluate
from vojax.viz import draw_tracks, plot_trajectory, save_figure


def _walk(n=80, scale=1.0, gap=False):
    poses = np.tile(np.eye(4)[None], (n, 1, 1))
    turn = np.linspace(0, np.pi, n)
    poses[:, 0, 3], poses[:, 1, 3], poses[:, 2, 3] = scale * 20 * np.sin(turn), 0.5, scale * 30 * turn
    times = 1.3e9 + 0.1 * np.arange(n) + (30.0 * (np.arange(n) > n // 2) if gap else 0.0)
    return Trajectory(times, poses)


def _lines(axes):
    return {line.get_label(): line for line in axes.get_lines()}


def test_left_is_the_top_view_and_right_are_the_errors():
    truth, estimate = _walk(), _walk(scale=1.02)
    figure = plot_trajectory(estimate, truth, title="a walk")
    view, position, rotation = figure.axes
    drawn = _lines(view)
    assert set(drawn) == {"ground truth", "vojax", "start", "end"}
    np.testing.assert_allclose(drawn["ground truth"].get_xdata(), truth.positions[:, 0], atol=1e-9)
    np.testing.assert_allclose(drawn["ground truth"].get_ydata(), truth.positions[:, 2], atol=1e-9)
    np.testing.assert_allclose(drawn["end"].get_xydata()[0], estimate.positions[-1, [0, 2]], atol=1e-9)
    assert view.get_aspect() == 1.0
    assert (view.get_xlabel(), view.get_ylabel()) == ("x [m]", "z [m]")
    errors = position.get_lines()[0]
    np.testing.assert_allclose(errors.get_xdata()[[0, -1]], [0.0, 7.9], atol=1e-6)
    expected = np.linalg.norm(estimate.positions - truth.positions, axis=1)
    assert position.get_ylabel() == "position error [m]"
    np.testing.assert_allclose(errors.get_ydata(), expected, atol=1e-9)
    np.testing.assert_allclose(rotation.get_lines()[0].get_ydata(), 0.0, atol=1e-6)
    assert f"drift {evaluate(estimate, truth).drift_percent:.2f} %" in figure.get_supxlabel()


def test_small_errors_are_in_centimetres():
    truth, estimate = _walk(), _walk(scale=1.001)
    position = plot_trajectory(estimate, truth).axes[1]
    assert position.get_ylabel() == "position error [cm]"
    expected = 100 * np.linalg.norm(estimate.positions - truth.positions, axis=1)
    np.testing.assert_allclose(position.get_lines()[0].get_ydata(), expected, atol=1e-9)


def test_no_line_is_drawn_across_missing_poses():
    figure = plot_trajectory(_walk(gap=True, scale=1.1), _walk(gap=True))
    for axes, label in ((figure.axes[0], "vojax"), (figure.axes[0], "ground truth"), (figure.axes[1], None)):
        line = _lines(axes)[label] if label else axes.get_lines()[0]
        assert np.isnan(line.get_ydata()).sum() == 1
        assert np.isnan(line.get_ydata()[41])


@pytest.mark.parametrize("n", [1, 2])
def test_path_without_truth_and_degenerate_paths(tmp_path, n):
    still = Trajectory(np.arange(float(n)), np.tile(np.eye(4)[None], (n, 1, 1)))
    for trajectory in (_walk(n), still):
        figure = plot_trajectory(trajectory, plane="xy", time_unit="frames")
        assert len(figure.axes) == 1
        assert save_figure(figure, tmp_path / "path.png", dpi=40).stat().st_size > 1000
    both = plot_trajectory(still, still)
    assert save_figure(both, tmp_path / "both.png", dpi=40).exists()


def test_saving_touches_no_global_state_and_needs_no_display(tmp_path):
    backend = matplotlib.rcParams._get_backend_or_none()
    figure = plot_trajectory(_walk(), _walk())
    save_figure(figure, tmp_path / "figure.png")
    assert matplotlib.rcParams._get_backend_or_none() == backend
    picture = mpimage.imread(tmp_path / "figure.png")
    assert picture.shape[1] > 1000
    assert picture[..., :3].std() > 0.02


def test_bad_input_says_what_to_do(tmp_path):
    figure = plot_trajectory(_walk())
    with pytest.raises(FileNotFoundError, match="no such folder"):
        save_figure(figure, tmp_path / "none" / "a.png")
    with pytest.raises(ValueError, match=r"cannot write '\.xyz'; expected \.png"):
        save_figure(figure, tmp_path / "a.xyz")
    with pytest.raises(ValueError, match="a file without suffix"):
        save_figure(figure, tmp_path / "a")
    with pytest.raises(ValueError, match=r"found shape \(4, 4, 2\)"):
        draw_tracks(np.zeros((4, 4, 2)), np.zeros((0, 2)), np.zeros((0, 2)))


def test_without_matplotlib_one_line_says_what_to_install(monkeypatch):
    real_import = builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"pip install 'vojax\[viz\]'"):
        plot_trajectory(_walk())


def test_importing_viz_does_not_import_matplotlib():
    code = "import sys, vojax.viz; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("kind", ["grey", "rgb", "depth"])
def test_tracks_end_where_the_points_are(tmp_path, kind):
    image = {
        "grey": np.full((60, 100), 40, np.uint8),
        "rgb": np.full((60, 100, 3), 40, np.uint8),
        "depth": np.linspace(0, 5000, 6000).reshape(60, 100).astype(np.uint16),
    }[kind]
    before = np.array([[20.0, 30.0], [70.0, 20.0]], np.float32)
    after = np.array([[40.0, 30.0], [70.0, 40.0]], np.float32)
    figure = draw_tracks(image, before, after, np.array([True, False]))
    picture = mpimage.imread(save_figure(figure, tmp_path / "tracks.png", dpi=100))[..., :3]
    assert picture.shape == (60, 100, 3)
    # Halfway along: blue where the track is an inlier, orange where it is not; elsewhere the image itself.
    assert picture[30, 30, 2] > picture[30, 30, 0] + 0.2
    assert picture[30, 70, 0] > picture[30, 70, 2] + 0.2
    if kind != "depth":
        np.testing.assert_allclose(picture[50, 20], 40 / 255, atol=0.01)
    bare = draw_tracks(image, np.zeros((0, 2)), np.zeros((0, 2)))
    assert save_figure(bare, tmp_path / "bare.png", dpi=100).exists()
