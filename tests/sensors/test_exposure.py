"""Exposure: clipping is counted, noise has the variance of electrons, grey values follow gamma."""

from __future__ import annotations

import numpy as np
import pytest

from scene.common.keyed_random import KeyedRandom
from sensors.stereo.exposure import WHITE_LEVEL, ExposureConfig, expose, full_scale

STEP = 4


def flat(level: float, side: int = 200) -> np.ndarray:
    return np.full((side, side), level, dtype=np.float32)


def test_noise_is_that_of_the_binned_electrons() -> None:
    """With gamma 1, sigma = 255 sqrt(L / N + (r / N_full)^2 step^2), N_full = step^2 full wells, plus rounding (1/12).

    40,000 pixels: 5 sigma of a standard deviation is 5 / sqrt(2 n) = 1.8 %.
    """
    config = ExposureConfig(gamma=1.0, full_well_e=60.0, read_noise_e=4.0)
    photograph = expose(flat(0.5), 1.0, STEP, config, KeyedRandom(1))
    full = 60.0 * STEP**2
    expected = 255 * np.sqrt(0.5 / full + (4.0 * STEP / full) ** 2)
    assert photograph.image.std() == pytest.approx(np.hypot(expected, 12**-0.5), rel=0.018)
    assert photograph.image.mean() == pytest.approx(127.5, abs=5 * expected / 200)


def test_too_much_light_is_clipped_and_counted() -> None:
    picture = flat(0.2)
    picture[:50] = 0.8
    config = ExposureConfig(read_noise_e=0.0)
    assert expose(picture, 1.0, STEP, config, KeyedRandom(1)).clipped_share == 0.0
    brighter = expose(picture, 1.0, STEP, config.model_copy(update={"compensation_ev": 1.0}), KeyedRandom(1))
    assert brighter.clipped_share == 0.25
    assert (brighter.image[:50] == 255).all()
    assert brighter.image[60, 0] == pytest.approx(255 * 0.4 ** (1 / 2.2), abs=1)


def test_automatic_exposure_is_one_for_both_pictures() -> None:
    assert full_scale(flat(0.1), flat(0.4)) == pytest.approx(0.4 / WHITE_LEVEL)


def test_the_same_key_gives_the_same_picture() -> None:
    config = ExposureConfig(full_well_e=100.0)
    first, again, other = (expose(flat(0.5, 20), 1.0, STEP, config, KeyedRandom(seed)).image for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
