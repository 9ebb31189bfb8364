"""Pixel locking found from the measured disparities: against disparities drawn in closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.gap.noise_and_edges.pixel_locking import NoiseBounds, find_locking
from sensors.effects.pixel_locking import PixelLocking


@pytest.mark.parametrize(
    ("amplitude", "period", "phase"), [(0.1, 1.0, 0.0), (0.25, 1.01, 2.0), (0.4, 0.99, -1.0), (0.4, 2.0, 0.5)]
)
def test_amplitude_period_and_phase_are_found_through_noise(amplitude: float, period: float, phase: float) -> None:
    rng = np.random.default_rng(3)
    plain = rng.uniform(200, 260, 20_000) + 0.4 * rng.standard_normal(20_000)
    locked = plain + amplitude * np.sin(2 * np.pi * plain / period + phase)
    surface = rng.uniform(200, 260, 20_000)
    found = find_locking(locked, surface)
    assert found is not None
    assert found.amplitude_px == pytest.approx(amplitude, abs=max(4 * found.std_px, 0.01))
    assert found.std_px < 0.02
    assert found.period_px == pytest.approx(period, rel=2e-4)
    # the phase at the middle of the disparities, where the period's error does not matter; 0.05 is 3 sigma of 20,000 points
    there = 2 * np.pi * 230 / found.period_px + found.phase_rad - 2 * np.pi * 230 / period - phase
    assert abs(np.angle(np.exp(1j * there))) < 0.1


def test_disparities_of_a_rough_wall_show_none() -> None:
    """No locking is found on 200 walls of ten facets each.

    The significance level is 1e-4 for each, so one in fifty seeds of this test fails by chance.
    """
    rng = np.random.default_rng(4)
    for _ in range(200):
        facets = rng.uniform(200, 230, 10)[:, None] + rng.uniform(0, 6, (10, 1)) * rng.uniform(size=(10, 300))
        measured = facets + 0.3 * rng.standard_normal(facets.shape) + 0.4
        assert find_locking(measured.ravel(), facets.ravel()) is None


@pytest.mark.parametrize(("draws", "least"), [(5, 4), (20, 18)])
def test_a_small_amplitude_is_told_from_noise_by_how_much_of_it_there_may_be(draws: int, least: int) -> None:
    """Of 0.115 px beside noise of 0.22 px only the first harmonic shows.

    The mean is within 8 %, and most intervals of 1.645 standard deviations contain the truth: of five draws, fewer than four do
    with a chance of 8 %; the seeds are fixed.
    """
    found = []
    for seed in range(draws):
        random = np.random.default_rng(seed)
        surface = random.uniform(100, 160, 6000)
        measured = surface + 0.115 * np.sin(2 * np.pi * surface) + 0.22 * random.standard_normal(6000)
        locking = find_locking(measured, surface, noise=NoiseBounds(0.22, float(np.std(measured - surface))))
        assert locking is not None
        found.append((locking.amplitude_px, locking.std_px))
    amplitude, std = np.transpose(found)
    assert amplitude.mean() == pytest.approx(0.115, rel=0.08)
    assert np.sum(np.abs(amplitude - 0.115) < 1.645 * std) >= least


def test_an_amplitude_that_folds_disparities_over_is_not_taken_for_a_small_one() -> None:
    """A tenth of the disparities is snapped to whole pixels beside 0.12 px of locking.

    The first harmonic alone would also fit 0.46 px, which no matcher makes. Snapping is no sine, so the amplitude is only known
    to a sixth.
    """
    rng = np.random.default_rng(3)
    plain = rng.uniform(0, 80, 60_000)
    locked = plain + 0.12 * np.sin(2 * np.pi * plain)
    measured = np.where(rng.uniform(size=len(plain)) < 0.1, np.rint(locked), locked)
    found = find_locking(measured, plain)
    assert found is not None
    assert found.amplitude_px == pytest.approx(0.12, abs=0.02)


@pytest.mark.parametrize(("tilt", "amplitude"), [(0.06, 0.3), (-0.04, 0.08)])
def test_a_matcher_whose_rectification_is_turned_about_the_base_is_seen_through(tilt: float, amplitude: float) -> None:
    """Locking is found in the pixels of another rectification.

    Its disparities are f B / Z' with Z' = Z cos w + Y sin w, in pixels of its own principal distance.
    """
    rng = np.random.default_rng(5)
    tangent, beyond, infinity = rng.uniform(-0.35, 0.3, 20_000), rng.uniform(400, 700, 20_000), -350.0
    theirs = 1.01 * beyond / (np.cos(tilt) + tangent * np.sin(tilt)) + 0.3 * rng.standard_normal(20_000)
    locked = theirs + amplitude * np.sin(2 * np.pi * theirs)
    ours = infinity + locked * (np.cos(tilt) + tangent * np.sin(tilt)) / 1.01
    found = find_locking(ours, infinity + beyond, tangent, infinity)
    assert found is not None
    assert found.tilt_rad == pytest.approx(tilt, abs=2e-4)
    assert found.amplitude_px == pytest.approx(amplitude / 1.01, abs=max(4 * found.std_px, 0.01))
    turned = find_locking(ours, infinity + beyond)
    assert turned is None or turned.gain < 0.1 * found.gain
    effect = PixelLocking(
        amplitude_px=found.amplitude_px, period_px=found.period_px, phase_rad=found.phase_rad, tilt_rad=found.tilt_rad
    )
    mean = effect.mean(SimpleNamespace(found=ours, tangent=tangent, infinity=infinity))
    assert np.corrcoef(mean, np.sin(2 * np.pi * locked))[0, 1] > 0.98


@pytest.mark.parametrize(
    ("amplitude", "before", "after"),
    [
        *((amplitude, *noise) for amplitude in (0.13, 0.25, 0.4) for noise in ((0.3, 0), (0, 0.3))),
        (0.13, 0.2, 0.2),
        (0.25, 0.2, 0.2),
    ],
)
def test_amplitude_is_found_whether_noise_comes_before_or_after_the_locking(
    amplitude: float, before: float, after: float
) -> None:
    """The amplitude found is within three standard deviations of the truth. The matcher worked in an image of half the size."""
    random = np.random.default_rng(7)
    surface = random.uniform(100, 160, 20_000)
    x = surface + before * random.standard_normal(20_000)
    disparity = 2 * (x + amplitude * np.sin(2 * np.pi * x + 1.0) + after * random.standard_normal(20_000))
    residual = disparity - 2 * surface
    noise = NoiseBounds(2 * np.hypot(before, after), float(np.std(residual)))
    found = find_locking(disparity, 2 * surface, noise=noise, residual=residual)
    assert found is not None
    assert found.amplitude_px == pytest.approx(2 * amplitude, abs=max(3 * found.std_px, 0.004))
    assert found.std_px < 0.2 * found.amplitude_px
    assert found.period_px == pytest.approx(2, rel=1e-3)


def test_disparities_that_crowd_at_other_frequencies_too_show_no_locking() -> None:
    """A third of the points lies on ten flat patches that the reference does not have, such as fresh scars.

    They crowd at every frequency, as few independent points do. The significance level is 1e-4 for each wall; the mean over the
    few frequencies beside is itself uncertain, so two of 40 are allowed.
    """
    found = 0
    for seed in range(40):
        random = np.random.default_rng(seed)
        rough = random.uniform(100, 160, 6000)
        patches = np.repeat(random.uniform(100, 160, 10), 200) + 0.05 * random.standard_normal(2000)
        found += find_locking(np.append(rough[:4000], patches), rough) is not None
    assert found <= 2
