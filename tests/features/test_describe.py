import cv2
import numpy as np
import pytest

from vojax.features import Described, DescriptorOptions, describe, match_descriptors

KINDS = [DescriptorOptions(kind=kind, max_features=300) for kind in ("sift", "orb")]


def named(options):
    return options.kind


@pytest.mark.parametrize("options", KINDS, ids=named)
@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.4, -1.7), (-9.25, 6.5)])
def test_known_shift(make_moved_pair, shift, options):
    first, second = (describe(image, options) for image in make_moved_pair(shift))
    matches = match_descriptors(first, second, options)
    assert len(matches.rows0) > 30
    assert len(set(matches.rows1)) == len(matches.rows1)
    assert (np.diff(matches.rows0) > 0).all()
    assert ((matches.quality > 0.2 - 1e-6) & (matches.quality <= 1)).all()
    error = second.pixels[matches.rows1] - first.pixels[matches.rows0] - np.array(shift)
    assert np.median(np.abs(error)) < 0.7
    assert np.mean(np.linalg.norm(error, axis=1) < 3.0) > 0.9


@pytest.mark.parametrize("options", KINDS, ids=named)
def test_unrelated_images_match_little(make_moved_pair, options):
    first, _ = make_moved_pair((0, 0), seed=1)
    second, _ = make_moved_pair((0, 0), seed=2)
    first, second = describe(first, options), describe(second, options)
    assert len(match_descriptors(first, second, options).rows0) < 0.1 * len(first.pixels)


def test_matches_far_from_where_they_are_expected_are_left_out(make_moved_pair):
    options = DescriptorOptions(max_features=300, radius_px=5.0)
    first, second = (describe(image, options) for image in make_moved_pair((12.0, 0.0)))
    near = match_descriptors(first, second, options, first.pixels + np.float32([11.0, 0.0]))
    assert len(near.rows0) > 30
    assert len(match_descriptors(first, second, options, first.pixels).rows0) < 0.2 * len(near.rows0)
    with pytest.raises(ValueError, match="expected one row per feature"):
        match_descriptors(first, second, options, first.pixels[:-1])


def test_strongest_first_and_no_place_twice(make_moved_pair):
    image, _ = make_moved_pair((0.0, 0.0))
    few, many = (
        describe(image, DescriptorOptions(max_features=40)),
        describe(image, DescriptorOptions(max_features=300)),
    )
    assert len(few.pixels) <= 40 < len(many.pixels)
    assert len(np.unique(many.pixels, axis=0)) == len(many.pixels)


@pytest.mark.parametrize("options", KINDS, ids=named)
def test_nothing_to_describe(options):
    nothing = describe(np.zeros((60, 80), np.uint8), options)
    assert nothing.pixels.shape == (0, 2)
    one = Described(np.ones((1, 2), np.float32), np.ones((1, 8), np.float32))
    for first, second in ((nothing, one), (one, nothing), (nothing, nothing), (one, one)):
        assert len(match_descriptors(first, second, options).rows0) == 0


def test_equal_descriptors_tell_nothing():
    twice = Described(np.zeros((4, 2), np.float32), np.ones((4, 8), np.float32))
    assert len(match_descriptors(twice, twice).rows0) == 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "surf"}, "kind is 'surf': expected one of sift, orb"),
        ({"max_features": 0}, "max_features is 0"),
        ({"max_ratio": 1.5}, "max_ratio is 1.5"),
        ({"radius_px": 0.0}, "radius_px is 0.0"),
    ],
)
def test_settings_out_of_range(settings, message):
    with pytest.raises(ValueError, match=message):
        DescriptorOptions(**settings)


def test_a_kind_that_this_opencv_lacks_is_named(monkeypatch):
    monkeypatch.delattr(cv2, "SIFT_create")
    with pytest.raises(ValueError, match=r"OpenCV .* has no SIFT: it has orb"):
        describe(np.zeros((60, 80), np.uint8))
