import numpy as np
import pytest

from vojax.metrics import Trajectory, kitti_errors
from vojax.viz import plot_drift_by_length, plot_timings, plot_trajectories, save_figure


def straight(scale=1.0, frames=400):
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = scale * np.arange(frames)
    return poses


def test_drift_by_length_of_a_wrong_scale():
    truth = straight()
    figure = plot_drift_by_length(
        {"two percent": kitti_errors(straight(1.02), truth), "five": kitti_errors(straight(1.05), truth)}
    )
    translation, rotation = figure.axes
    two, five = translation.lines
    np.testing.assert_allclose(two.get_xdata(), [100, 200, 300])
    # A stretch ends with the first frame beyond its length, so that a hundredth of it may be added.
    np.testing.assert_allclose(two.get_ydata(), 2.0, rtol=0.02)
    np.testing.assert_allclose(five.get_ydata(), 5.0, rtol=0.02)
    np.testing.assert_allclose(rotation.lines[0].get_ydata(), 0.0, atol=1e-6)
    assert [text.get_text() for text in translation.get_legend().get_texts()] == ["two percent", "five"]


def test_drift_needs_a_stretch():
    short = straight(frames=50)
    with pytest.raises(ValueError, match="shortest stretch"):
        plot_drift_by_length({"short": kitti_errors(short, short)})


def test_timings_leave_out_what_is_not_known():
    figure = plot_timings({"step": [np.nan, 0.02, 0.04, 0.03], "read": [0.001] * 4}, title="a run")
    by_frame, shares = figure.axes
    np.testing.assert_allclose(by_frame.lines[0].get_ydata(), [np.nan, 20, 40, 30])
    np.testing.assert_allclose(shares.lines[0].get_ydata(), [20, 30, 40])
    assert "step: median 30 ms" in shares.get_legend().get_texts()[0].get_text()
    with pytest.raises(ValueError, match="no finite times"):
        plot_timings({"step": [np.nan]})


def test_several_paths_and_the_truth(tmp_path):
    times = np.arange(20) / 10
    paths = {name: Trajectory(times, straight(scale, 20)) for name, scale in (("one", 1.0), ("two", 1.1))}
    figure = plot_trajectories(paths, Trajectory(times, straight(frames=20)), title="both")
    (axes,) = figure.axes
    assert [line.get_label() for line in axes.lines] == ["ground truth", "one", "two"]
    np.testing.assert_allclose(axes.lines[2].get_ydata(), 1.1 * np.arange(20))
    save_figure(figure, tmp_path / "paths.png")
    assert (tmp_path / "paths.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(ValueError, match="no trajectories"):
        plot_trajectories({})
