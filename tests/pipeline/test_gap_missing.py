"""Lost returns: loss probabilities drawn in closed form, and losses that are no effect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gap_cases import write_scan
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm

from pipeline.formats.measurements.measurement import TlsMeasurement, read_measurement
from pipeline.gap.naming.gap_score import measure_losses
from pipeline.gap.noise_and_edges.missing_returns import LossExplanation, count_isolated_returns, explain_missing_returns
from pipeline.gap.residuals.residuals import ExpectedPulses
from pipeline.gap.residuals.tls_residuals import find_expected_pulses, tls_residuals

Array = np.ndarray[Any, np.dtype[np.float64]]
COUNT = 30_000


def pulses() -> tuple[Array, Array, dict[str, Array]]:
    """Places x and y on a wall 40 m wide and 30 m high, seen from 50 m, and the covariates of pulses to them."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-20, 20, COUNT), rng.uniform(0, 30, COUNT)
    distance = np.sqrt(x**2 + y**2 + 50**2)
    cosine = 50 / distance
    covariates = {
        "range": distance,
        "incidence": np.arccos(cosine),
        "log_power": np.log(cosine * (100 / distance) ** 2),
        "azimuth": np.arctan2(x, 50.0),
        "zenith": np.pi / 2 - np.arcsin(y / distance),
    }
    return x, y, covariates


def found(chance: Array, early: int = 0, seed: int = 6) -> LossExplanation | None:
    """Return the effects that are found where pulses are lost with probabilities (n,)."""
    x, y, covariates = pulses()
    lost = np.random.default_rng(seed).uniform(size=COUNT) < chance
    every = np.arange(COUNT) % 5 != 0
    return explain_missing_returns(ExpectedPulses(lost, covariates, np.stack([x, y], axis=1)), every, early, COUNT, None)


def test_a_limit_is_found_with_its_spread_of_albedo() -> None:
    _, _, covariates = pulses()
    level = float(np.quantile(covariates["log_power"], 0.5))
    effect = found(0.01 + 0.99 * norm.cdf((level - covariates["log_power"]) / 0.3))
    assert effect is not None
    assert effect.name == "detection_limit"
    # with albedos about 0.5, the limit lies at half of what a white wall sends back there; 3 % is 5 sigma of 30,000 pulses
    assert effect.parameters["minimum_power"] == pytest.approx(0.5 * np.exp(level), rel=0.03)


def test_a_rate_of_precipitation_lies_in_its_interval() -> None:
    distance = pulses()[2]["range"]
    rate = 1.5e-3
    effect = found(1 - 0.99 * np.exp(-2 * rate * distance), early=40)
    assert effect is not None
    assert effect.name == "precipitation"
    assert effect.parameters["rate_per_m"] == pytest.approx(rate, abs=3.3 * effect.std["rate_per_m"] + 0.05 * rate)


def test_losses_in_a_sector_are_no_effect_of_the_catalogue() -> None:
    azimuth = pulses()[2]["azimuth"]
    effect = found(np.where(np.abs(azimuth - 0.1) < 0.08, 0.4, 0.02))
    assert effect is not None
    assert effect.covariate == "azimuth"


@pytest.mark.parametrize("draws", [4, 20])
def test_losses_alike_everywhere_are_none(draws: int) -> None:
    """By chance a score of 9 occurs in about 1e-4 of the draws."""
    assert all(found(np.full(COUNT, 0.03), seed=seed) is None for seed in range(100, 100 + draws))


def test_a_shrub_before_the_wall_is_none() -> None:
    x, y, _ = pulses()
    assert found(np.where(np.hypot(x - 8, y - 10) < 1.5, 1.0, 0.01)) is None


@pytest.mark.parametrize(("draws", "most"), [(4, 0), (20, 1)])
def test_lines_that_the_scanner_dropped_are_none(draws: int, most: int) -> None:
    """There are nine gaps of a few lines and a fifth of their height.

    If each draw is taken for a sector's losses with a chance of 1 %, one of 4 is with 4 %, and two of 20 with 2 %.
    """
    _, _, covariates = pulses()
    azimuth, zenith = covariates["azimuth"], covariates["zenith"]
    wrong = 0
    for seed in range(200, 200 + draws):
        rng = np.random.default_rng(seed)
        chance = np.full(COUNT, 0.01)
        for line, first in zip(rng.choice(azimuth, 9), rng.choice(zenith, 9), strict=True):
            chance[(np.abs(azimuth - line) < 0.008) & (np.abs(zenith - first) < 0.05)] = 1.0
        wrong += found(chance, seed=seed) is not None
    assert wrong <= most


def test_drops_scatter_and_what_stands_before_the_wall_does_not() -> None:
    x, y, _ = pulses()
    at = np.stack([x, y], axis=1)
    drops = np.random.default_rng(7).uniform(size=COUNT) < 0.003
    assert count_isolated_returns(at, drops) == drops.sum()
    assert count_isolated_returns(at, np.hypot(x - 8, y - 10) < 1.0) == 0


def test_the_score_of_losses_closes_the_gap_of_the_true_chance() -> None:
    """With the true probability of losses the gap is zero within 3.3 standard errors.

    The Brier score of a probability p is p (1 - p) on average.
    """
    x, y, covariates = pulses()
    chance = np.where(covariates["zenith"] < 1.2, 0.62, 0.02)
    lost = np.random.default_rng(8).uniform(size=COUNT) < chance
    held_out = np.arange(COUNT) % 5 == 0
    gap = measure_losses(ExpectedPulses(lost, covariates, np.stack([x, y], axis=1)), chance, held_out)
    assert gap is not None
    assert gap.unit == "1"
    floor = chance[held_out] * (1 - chance[held_out])
    # patches of the wall count alike, however many pulses they hold: up to a tenth beside the mean of all pulses
    error = 3.3 * float(np.std((lost - chance)[held_out] ** 2)) / np.sqrt(held_out.sum()) + 0.1 * floor.mean()
    assert gap.after == pytest.approx(floor.mean(), abs=error)
    assert gap.before > 1.2 * gap.after
    assert gap.closed == pytest.approx(1.0, abs=0.1)


def test_a_wall_on_both_sides_of_the_azimuth_pi_is_one_wall(tmp_path: Path) -> None:
    """The scanner's frame is turned so that half of the same points have azimuths just below pi and half just above -pi."""
    write_scan(tmp_path, 1)
    plain = read_measurement(tmp_path)
    assert isinstance(plain, TlsMeasurement)
    assert plain.pattern is not None
    position, rotation = plain.station
    before = tls_residuals(plain)
    angle = np.pi - float(np.median(before.geometry.azimuth))
    back = np.array([[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    start, stop, step = plain.pattern.azimuth_rad
    turned = plain.changed(
        station=(position, rotation @ back),
        pattern=plain.pattern.model_copy(update={"azimuth_rad": (start + angle, stop + angle, step)}),
    )
    after = tls_residuals(turned)
    assert_allclose(after.value, before.value, atol=1e-9)
    turns = after.geometry.azimuth - before.geometry.azimuth - angle
    assert_allclose(turns, 2 * np.pi * np.rint(turns[0] / (2 * np.pi)), atol=1e-9)
    counted = [find_expected_pulses(each, residuals) for each, residuals in ((plain, before), (turned, after))]
    assert counted[0] is not None
    assert counted[1] is not None
    assert_array_equal(counted[0].lost, counted[1].lost)
