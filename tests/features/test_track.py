import numpy as np
import pytest

from vojax.features import DetectorOptions, TrackerOptions, detect, track

DETECTOR = DetectorOptions(max_features=200, cell_px=40)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.4, -1.7), (-9.25, 6.5)])
def test_known_shift(make_moved_pair, shift):
    previous, current = make_moved_pair(shift)
    pixels = detect(previous, DETECTOR).pixels
    tracks = track(previous, current, pixels)
    middle = np.all((pixels > 25) & (pixels < np.array([235, 115])), axis=1)
    assert tracks.valid[middle].mean() > 0.9
    error = (tracks.pixels - pixels - np.array(shift))[tracks.valid]
    assert np.abs(error.mean(axis=0)).max() < 0.02
    assert np.sqrt(np.mean(error**2)) < 0.08
    assert ((tracks.quality > 0) == tracks.valid).all()


def test_a_guess_reaches_further(make_moved_pair):
    shift = (46.0, 3.0)
    previous, current = make_moved_pair(shift, shape=(140, 400))
    pixels = detect(previous, DETECTOR).pixels
    pixels = pixels[(pixels[:, 0] > 20) & (pixels[:, 0] < 320)]
    options = TrackerOptions(levels=1)
    without = track(previous, current, pixels, options)
    aided = track(previous, current, pixels, options, guess=pixels + np.float32([44, 4]))
    right = np.abs(aided.pixels - pixels - np.array(shift)).max(axis=1) < 0.3
    assert without.valid.mean() < 0.2
    assert (aided.valid & right).mean() > 0.8


def test_unrelated_images_lose_features(make_moved_pair):
    previous, _ = make_moved_pair((0, 0), seed=1)
    current, _ = make_moved_pair((0, 0), seed=2)
    tracks = track(previous, current, detect(previous, DETECTOR).pixels)
    assert tracks.valid.mean() < 0.1


def test_features_that_leave_the_image_are_lost(make_moved_pair):
    previous, current = make_moved_pair((30.0, 0.0))
    pixels = np.stack([np.full(10, 245.0), np.linspace(20, 120, 10)], axis=1)
    assert not track(previous, current, pixels, guess=pixels + np.array([30.0, 0.0])).valid.any()


def test_invalid_rows_are_finite_and_marked(make_moved_pair):
    previous, current = make_moved_pair((1.0, 1.0))
    pixels = np.array([[np.nan, 3], [-5, 8], [1e9, 2], [130, 70]])
    tracks = track(previous, current, pixels)
    np.testing.assert_array_equal(tracks.valid, [False, False, False, True])
    assert np.isfinite(tracks.pixels).all()
    assert (tracks.quality[:3] == 0).all()
    odd_guess = np.array([[0, 0], [0, 0], [0, 0], [np.nan, np.inf]])
    assert track(previous, current, pixels, guess=odd_guess).valid[3]


@pytest.mark.parametrize("shape", [(100, 200), (20, 20), (3, 3)])
def test_blank_images_and_no_features(shape):
    blank = np.full(shape, 90, np.uint8)
    assert not track(blank, blank, np.array([[shape[1] / 2, shape[0] / 2]])).valid.any()
    empty = track(blank, blank, np.empty((0, 2)))
    assert empty.pixels.shape == (0, 2)
    assert empty.valid.shape == (0,)


def test_bad_input():
    image = np.zeros((50, 60), np.uint8)
    with pytest.raises(ValueError, match="previous has size 60×50 and current 60×49"):
        track(image, image[:-1], np.zeros((1, 2)))
    with pytest.raises(ValueError, match="guess has shape"):
        track(image, image, np.zeros((2, 2)), guess=np.zeros((1, 2)))
    with pytest.raises(ValueError, match="window_px"):
        TrackerOptions(window_px=1)
