import numpy as np
import pytest

from vojax.odometry import (
    Flag,
    ImageChecks,
    consensus_flags,
    image_flags,
    is_static,
    synchrony_flags,
    track_flags,
)


def textured(seed=0, low=20, high=230):
    return np.random.default_rng(seed).integers(low, high, (60, 80), dtype=np.uint8)


def test_an_ordinary_image_has_no_flag():
    assert image_flags(textured(), 200) == ()


@pytest.mark.parametrize(
    ("image", "features", "flags"),
    [
        (np.full((60, 80), 128, np.uint8), 0, (Flag.texture,)),
        (np.zeros((60, 80), np.uint8), 0, (Flag.texture, Flag.dark)),
        (np.full((60, 80), 255, np.uint8), 0, (Flag.texture, Flag.bright)),
        (textured(low=0, high=5), 100, (Flag.dark,)),
        (textured(low=251, high=256), 100, (Flag.bright,)),
        (np.where(np.arange(80) < 30, 0, textured()).astype(np.uint8), 100, ()),  # a shadow on a third of it
    ],
)
def test_light_and_texture(image, features, flags):
    assert image_flags(image, features) == flags


def test_overlap_counts_what_was_found_again():
    pixels = np.random.default_rng(0).uniform(0, 80, (30, 2))
    assert track_flags(pixels, pixels + 5.0, 100) == ()
    assert track_flags(pixels[:19], pixels[:19] + 5.0, 100) == (Flag.overlap,)


@pytest.mark.parametrize(("motion", "static"), [(0.0, True), (2.0, False)])
def test_rest_is_motion_below_the_noise_of_the_tracks(motion, static):
    rng = np.random.default_rng(1)
    pixels = rng.uniform(0, 600, (400, 2))
    # Noise somewhat below what the checks expect; an object moves through the view.
    moved = pixels + [motion, 0.0] + 0.15 * rng.normal(size=pixels.shape)
    moved[:100] += 10.0
    assert is_static(pixels, moved) is static
    assert (Flag.static in track_flags(pixels, moved, 400)) is static
    assert not is_static(pixels[:5], moved[:5])  # too few to tell


def test_agreement():
    assert consensus_flags(80, 100, 12) == ()
    assert consensus_flags(30, 100, 12) == (Flag.consensus,)
    assert consensus_flags(11, 12, 12) == (Flag.consensus,)


@pytest.mark.parametrize(
    ("late", "deviation", "flags"),
    [
        (0.01, 0.001, ()),
        (0.03, 0.01, ()),  # it may be noise
        (0.03, 0.005, (Flag.unsynchronised,)),
        (-0.5, 0.05, (Flag.unsynchronised,)),
    ],
)
def test_the_time_between_left_and_right(late, deviation, flags):
    assert synchrony_flags(late, deviation) == flags


@pytest.mark.parametrize(
    "options", [{"max_clipped": 1.5}, {"min_overlap": -0.1}, {"clipped_margin": 200}, {"sigma_px": 0.0}]
)
def test_thresholds_out_of_range(options):
    with pytest.raises(ValueError, match="expected"):
        ImageChecks(**options)
