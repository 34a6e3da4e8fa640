"""Textures known between pixels, so that images shifted by fractions of a pixel are exact."""

import numpy as np
import pytest


class Texture:
    """A sum of plane waves up to half the highest frequency that pixels can hold."""

    def __init__(self, rng, waves=120, highest=1.5):
        direction = rng.uniform(0, 2 * np.pi, waves)
        frequency = rng.uniform(0.15, highest, waves)
        self.wave = np.stack([np.cos(direction), np.sin(direction)], axis=1) * frequency[:, None]
        self.phase = rng.uniform(0, 2 * np.pi, waves)
        self.amplitude = 50 / np.sqrt(waves)

    def __call__(self, u, v):
        out = np.full(u.shape, 128.0)
        for (a, b), phase in zip(self.wave, self.phase, strict=True):
            out += self.amplitude * np.cos(a * u + b * v + phase)
        return out


def noisy(rng, image, sigma):
    return np.clip(np.rint(image + sigma * rng.standard_normal(image.shape)), 0, 255).astype(np.uint8)


def stereo_pair(rng, disparity, slope=0.0, row_offset=0.0, gain=1.0, bias=0.0, noise=2.0, shape=(120, 320)):
    """Left and right view of a plane with disparity `disparity + slope · (v − h/2)`."""
    texture = Texture(rng)
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    row = v - row_offset
    seen = texture(u + disparity + slope * (row - shape[0] / 2), row)
    return noisy(rng, texture(u, v), noise), noisy(rng, gain * (seen - 128) + 128 + bias, noise)


def moved_pair(shift, seed=0, noise=2.0, shape=(140, 260)):
    """Two views of a plane that moved by `shift` pixels."""
    rng = np.random.default_rng(seed)
    texture = Texture(rng, highest=1.0)
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    return noisy(rng, texture(u, v), noise), noisy(rng, texture(u - shift[0], v - shift[1]), noise)


@pytest.fixture
def make_stereo_pair():
    return stereo_pair


@pytest.fixture
def make_moved_pair():
    return moved_pair
