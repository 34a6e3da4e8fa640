import dataclasses

import numpy as np
import pytest

from vojax.features import DetectorOptions, detect


def blocks(rows=200, cols=400, size=20, seed=0):
    """Squares of random brightness: corners at known places, between pixels."""
    values = np.random.default_rng(seed).integers(20, 235, (rows // size, cols // size))
    return np.kron(values, np.ones((size, size))).astype(np.uint8)


def test_corners_of_squares_are_sub_pixel():
    keypoints = detect(blocks(), DetectorOptions(subpixel=True))
    assert len(keypoints.pixels) > 100
    assert keypoints.pixels.dtype == keypoints.quality.dtype == np.float32
    # The corner between pixels 19 and 20 is at 19.5.
    off = np.abs((keypoints.pixels - 19.5 + 10) % 20 - 10)
    coarse = np.abs((detect(blocks()).pixels - 19.5 + 10) % 20 - 10)
    assert np.median(off) < 0.1
    assert np.median(coarse) >= 0.5  # which is why the refinement is there


def test_quality_is_sorted_and_at_least_the_minimum():
    keypoints = detect(blocks(), DetectorOptions(min_quality=5.0))
    assert np.all(np.diff(keypoints.quality) <= 0)
    assert keypoints.quality.min() >= 5.0


@pytest.mark.parametrize("detector", ["gftt", "fast"])
def test_spacing_between_new_and_existing(detector):
    rng = np.random.default_rng(1)
    image = rng.integers(0, 255, (150, 300), dtype=np.uint8)
    options = DetectorOptions(detector=detector, min_distance_px=9, max_features=300, subpixel=False)
    first = detect(image, options)
    second = detect(image, dataclasses.replace(options, max_features=500), existing=first.pixels)
    assert len(first.pixels) > 50
    everything = np.concatenate([first.pixels, second.pixels])
    assert len(everything) <= 500
    gap = np.abs(everything[:, None] - everything[None]).max(axis=2) + 1e3 * np.eye(len(everything))
    assert gap.min() >= 9


def test_features_are_spread_over_unequal_texture():
    """Half of the image has ten times the contrast: each half still gets its share."""
    rng = np.random.default_rng(2)
    image = rng.integers(0, 20, (192, 384)).astype(float)
    image[:, 192:] *= 10
    keypoints = detect((image + 20).astype(np.uint8), DetectorOptions(max_features=180))
    left = np.sum(keypoints.pixels[:, 0] < 192)
    assert len(keypoints.pixels) == 180
    assert 70 <= left <= 110


def test_existing_features_use_up_the_budget():
    rng = np.random.default_rng(3)
    image = rng.integers(0, 255, (128, 256), dtype=np.uint8)
    options = DetectorOptions(max_features=100)
    assert len(detect(image, options, existing=rng.uniform(10, 100, (100, 2))).pixels) == 0
    assert len(detect(image, options, existing=rng.uniform(10, 100, (70, 2))).pixels) == 30


def test_border_is_free():
    image = np.random.default_rng(4).integers(0, 255, (100, 150), dtype=np.uint8)
    pixels = detect(image, DetectorOptions(border_px=15, subpixel=False)).pixels
    assert pixels.min() >= 15
    assert pixels[:, 0].max() <= 134
    assert pixels[:, 1].max() <= 84


@pytest.mark.parametrize("detector", ["gftt", "fast"])
@pytest.mark.parametrize(
    "image", [np.zeros((100, 200), np.uint8), np.full((10, 12), 77, np.uint8), np.zeros((1, 1), np.uint8)]
)
def test_images_without_texture_give_no_features(detector, image):
    keypoints = detect(image, DetectorOptions(detector=detector))
    assert keypoints.pixels.shape == (0, 2)
    assert keypoints.quality.shape == (0,)


def test_existing_outside_the_image_or_not_finite_is_passed_over():
    image = blocks()
    odd = np.array([[-50.0, 10.0], [1e9, 5.0], [np.nan, 3.0]])
    np.testing.assert_array_equal(detect(image, existing=odd).pixels, detect(image).pixels)
    np.testing.assert_array_equal(detect(image, existing=np.empty((0, 2))).pixels, detect(image).pixels)


def test_bad_input():
    with pytest.raises(ValueError, match="uint8"):
        detect(np.zeros((10, 10), np.float32))
    with pytest.raises(ValueError, match=r"existing has shape \(3,\)"):
        detect(blocks(), existing=np.zeros(3))
    with pytest.raises(Exception, match="sift"):  # the type checker of the tests may be first
        DetectorOptions(detector="sift")
    with pytest.raises(ValueError, match="cell_px is 0"):
        DetectorOptions(cell_px=0)
    with pytest.raises(TypeError):
        DetectorOptions(max_feature=3)
