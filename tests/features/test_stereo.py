import numpy as np
import pytest

from vojax.features import DetectorOptions, StereoOptions, detect, match_stereo_rows

DETECTOR = DetectorOptions(max_features=300, cell_px=40)


def match(left, right, least_u=80, options=StereoOptions()):
    pixels = detect(left, DETECTOR).pixels
    pixels = pixels[pixels[:, 0] > least_u]
    return pixels, match_stereo_rows(left, right, pixels, options)


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 0.75])
@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_sub_pixel_disparity_without_pixel_locking(make_stereo_pair, fraction, noise):
    rng = np.random.default_rng(5)
    left, right = make_stereo_pair(rng, 23 + fraction, noise=noise, gain=0.9, bias=6)
    _, matches = match(left, right)
    error = matches.disparity[matches.valid] - (23 + fraction)
    assert matches.valid.mean() > 0.9
    assert abs(error.mean()) < 0.01
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert np.abs(error).max() < 0.15


@pytest.mark.parametrize("slope", [-0.2, 0.33])
def test_windows_on_the_ground(make_stereo_pair, slope):
    """A level ground seen from 1.65 m with a 0.54 m baseline has a slope of 0.33."""
    rng = np.random.default_rng(6)
    left, right = make_stereo_pair(rng, 30.4, slope=slope)
    pixels, matches = match(left, right)
    error = (matches.disparity - (30.4 + slope * (pixels[:, 1] - 60)))[matches.valid]
    assert matches.valid.mean() > 0.6
    assert abs(error.mean()) < 0.01
    assert np.sqrt(np.mean(error**2)) < 0.03
    # Half a row off, an upright window would be this wrong.
    assert np.abs(error).max() < abs(slope) / 2


@pytest.mark.parametrize("row_offset", [-0.8, 0.4, 1.2])
def test_rows_off_by_a_pixel_do_not_bias(make_stereo_pair, row_offset):
    rng = np.random.default_rng(7)
    left, right = make_stereo_pair(rng, 17.7, row_offset=row_offset)
    _, matches = match(left, right)
    error = matches.disparity[matches.valid] - 17.7
    assert matches.valid.mean() > 0.8
    assert abs(error.mean()) < 0.015
    assert np.sqrt(np.mean(error**2)) < 0.04


def test_sigma_matches_the_error(make_stereo_pair):
    """Without its floor the stated standard deviation is that of the errors, over a range of noise."""
    for noise in (2.0, 6.0):
        rng = np.random.default_rng(8)
        left, right = make_stereo_pair(rng, 20.3, noise=noise)
        _, matches = match(left, right, options=StereoOptions(sigma_floor_px=0.0))
        ratio = ((matches.disparity - 20.3) / matches.sigma)[matches.valid]
        assert 0.6 < np.sqrt(np.mean(ratio**2)) < 1.4


def test_range_of_disparities(make_stereo_pair):
    for disparity in (1.3, 64.6, 120.2):
        left, right = make_stereo_pair(np.random.default_rng(9), disparity)
        _, matches = match(left, right, least_u=140)
        assert matches.valid.mean() > 0.8
        assert np.median(np.abs(matches.disparity[matches.valid] - disparity)) < 0.03
    left, right = make_stereo_pair(np.random.default_rng(9), 150.0)
    _, matches = match(left, right, least_u=160)
    assert matches.valid.mean() < 0.02


def test_unrelated_images_do_not_match(make_stereo_pair):
    rng = np.random.default_rng(10)
    left, _ = make_stereo_pair(rng, 20)
    right, _ = make_stereo_pair(rng, 20)
    _, matches = match(left, right)
    assert matches.valid.mean() < 0.02


def test_repeated_pattern_is_refused():
    v, u = np.mgrid[:120, :320]
    left = (128 + 60 * (u // 8 % 2) - 50 * (v // 8 % 2)).astype(np.uint8)
    right = np.roll(left, -20, axis=1)
    pixels = np.stack(np.meshgrid(np.arange(150, 250, 8.0), np.arange(20, 100, 8.0)), axis=-1).reshape(-1, 2)
    assert not match_stereo_rows(left, right, pixels).valid.any()


def test_invalid_rows_are_finite_and_marked(make_stereo_pair):
    left, right = make_stereo_pair(np.random.default_rng(11), 12.5)
    pixels = np.array([[np.nan, 5], [-3, 10], [0, 0], [319, 119], [1e9, 7], [150.2, 60.7]])
    matches = match_stereo_rows(left, right, pixels)
    np.testing.assert_array_equal(matches.valid, [False] * 5 + [True])
    for field in (*matches[:3], matches.row_offset):
        assert np.isfinite(field).all()
        assert field.dtype == np.float32
    assert (matches.disparity[:5] == 0).all()
    assert (matches.quality[:5] == 0).all()
    assert (matches.sigma[:5] == 1).all()
    assert (matches.row_offset[:5] == 0).all()


def test_the_row_offset_is_measured(make_stereo_pair):
    left, right = make_stereo_pair(np.random.default_rng(12), 12.5)
    pixels = np.stack(np.meshgrid(np.arange(60, 280, 20.0), np.arange(20, 100, 12.0)), axis=-1).reshape(-1, 2)
    for rows in (0, 1, -1):
        matches = match_stereo_rows(left, np.roll(right, rows, axis=0), pixels)
        assert matches.valid.mean() > 0.9
        np.testing.assert_allclose(np.median(matches.row_offset[matches.valid]), rows, atol=0.1)


@pytest.mark.parametrize("shape", [(100, 200), (20, 20), (3, 3), (1, 1)])
def test_blank_and_tiny_images(shape):
    blank = np.full(shape, 90, np.uint8)
    matches = match_stereo_rows(blank, blank, np.array([[shape[1] / 2, shape[0] / 2]]))
    assert not matches.valid.any()
    assert np.isfinite(matches.sigma).all()
    assert [len(field) for field in match_stereo_rows(blank, blank, np.empty((0, 2)))] == [0] * 5


def test_bad_input():
    left, right = np.zeros((50, 60), np.uint8), np.zeros((50, 61), np.uint8)
    with pytest.raises(ValueError, match="left has size 60×50 and right 61×50"):
        match_stereo_rows(left, right, np.zeros((1, 2)))
    with pytest.raises(ValueError, match=r"pixels has shape \(1, 3\)"):
        match_stereo_rows(left, left, np.zeros((1, 3)))
    with pytest.raises(ValueError, match="expected min < max"):
        StereoOptions(min_disparity_px=10.0, max_disparity_px=5.0)
    with pytest.raises(ValueError, match="radius_px"):
        StereoOptions(radius_px=0)
