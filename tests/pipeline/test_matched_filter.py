"""The matched filter's signal-to-noise ratio against the white closed form and against the covariance matrix."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.linalg import toeplitz

from pipeline.change.matched_filter import noise_spectrum, signal_to_noise

SHAPE = (512, 640)


def disc(radius: float, row: int, column: int) -> np.ndarray:
    y, x = np.indices(SHAPE)
    return np.hypot(y - row, x - column) <= radius


def labelled(*radii: float) -> np.ndarray:
    block = np.zeros(SHAPE, dtype=np.int32)
    for number, radius in enumerate(radii, start=1):
        block[disc(radius, 260, 90 * number)] = number
    return block


def test_in_white_noise_it_is_the_root_of_the_sum_of_squares() -> None:
    """rho = sqrt(sum t^2) / sigma; about 300 windows give the spectrum to 3 % at each frequency, and its mean much better."""
    block, random = labelled(3, 12, 40), np.random.default_rng(1)
    change = np.where(block > 0, 0.02 + 0.03 * random.random(SHAPE), 0).astype(np.float32)
    difference = (change + random.normal(0, 0.025, SHAPE)).astype(np.float32)
    found = signal_to_noise(difference, block, change, 3)
    expected = [np.sqrt(np.sum(change[block == number].astype(float) ** 2)) / 0.025 for number in (1, 2, 3)]
    assert found == pytest.approx(expected, rel=0.06)


def test_in_noise_with_grain_it_is_that_of_the_covariance_matrix() -> None:
    """rho = t' t / sqrt(t' C t) on a square of 16 px, with C of noise that is smoothed along both axes."""
    kernel = np.array([1.0, 2.0, 3.0, 2.0, 1.0])
    kernel /= np.sqrt(np.sum(kernel**2))
    covariance = np.convolve(kernel, kernel[::-1])[4:]
    along = toeplitz(np.concatenate([covariance, np.zeros(43)])) + 0.05 * np.eye(48)
    random, sigma = np.random.default_rng(2), 0.02
    block = labelled(2.5)
    crop = (block == 1)[236:284, 66:114]
    template = 0.03 * crop  # C is the Kronecker product of both axes
    expected = np.sum(template**2) / (sigma * np.sqrt(np.sum(template * (along @ template @ along))))
    noise, change = _field(kernel, random), (0.03 * (block > 0)).astype(np.float32)
    found = signal_to_noise((change + sigma * noise).astype(np.float32), block, change, 1)
    assert found[0] == pytest.approx(expected, rel=0.1)


def _field(kernel: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return separable noise whose covariance along both axes is that of `kernel` plus 0.05 on the diagonal."""
    parts = [random.normal(size=SHAPE) for _ in range(4)]
    across, down = (lambda a, axis=axis: ndimage.correlate1d(a, kernel, axis=axis, mode="wrap") for axis in (1, 0))
    small = np.sqrt(0.05)
    return np.asarray(down(across(parts[0])) + small * across(parts[1]) + small * down(parts[2]) + 0.05 * parts[3])


def test_what_does_not_show_has_none_and_a_map_without_noise_tells_nothing() -> None:
    block = labelled(5)
    change = np.where(block > 0, 0.05, 0).astype(np.float32)
    noise = np.random.default_rng(3).normal(0, 0.01, SHAPE).astype(np.float32)
    assert signal_to_noise(noise, np.zeros_like(block), change, 1)[0] == 0.0
    hidden = np.where(block > 0, np.float32(np.nan), noise)
    assert signal_to_noise(hidden, block, change, 1)[0] == 0.0
    assert np.isnan(signal_to_noise(change, block, change, 1)[0])
    assert noise_spectrum(noise[:50, :50], 64) is None


@pytest.mark.parametrize(("shown", "scatter"), [(0.75, 1.0), (1.0, 0.5)])
def test_the_ratio_is_of_what_the_map_shows_and_of_the_noise_inside_niches(shown: float, scatter: float) -> None:
    """A map that shows 3/4 of each change has 3/4 of the ratio; half the noise inside niches doubles it.

    60 blocks at rho = 10: a median scatters by 1.25 / sqrt(60), the NMAD by 1.17 / sqrt(2 60) = 11 %.
    """
    y, x = np.indices(SHAPE)
    block = np.where((y % 64 < 5) & (x % 64 < 5) & (y < 384), 1 + (y // 64) * 10 + x // 64, 0).astype(np.int32)
    count, sigma = 60, 0.02
    change = np.where(block > 0, 0.04, 0).astype(np.float32)
    noise = np.random.default_rng(5).normal(0, sigma, SHAPE) * np.where(block > 0, scatter, 1.0)
    found = signal_to_noise((shown * change + noise).astype(np.float32), block, change, count)
    assert np.median(found) == pytest.approx(0.04 * 5 / sigma * shown / scatter, rel=0.3)
