"""Every effect: simulated recordings against the mean, variance, losses and semivariogram that the effect states.

A laser scanner sends 200,000 pulses in one direction to a slanting plane; a stereo pair matches 500 x 500 cells of a plane. Means
within 5 standard errors, variances within 5 of theirs, sqrt(2 / n), so that each of about 50 comparisons fails by chance with
less than 1e-6; semivariograms within the stated share.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_array

from pipeline.gap.residuals.correlated_noise import GridCorrelatedNoise
from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from sensors.effects import EFFECTS
from sensors.effects.base import Effect, Search, ShowsIn, Stage
from sensors.effects.heavy_tailed_noise import HeavyTailedNoise
from sensors.effects.matching_noise import MatchingNoise
from sensors.effects.range_incidence_bias import RangeIncidenceBias
from sensors.effects.regularization_noise import RegularizationNoise
from sensors.numerics.functions import DEVICE, HOST
from sensors.signal_chain.matches import ImageRows, Matches
from sensors.signal_chain.pulses import PulseGeometry, Pulses, slant

PULSES = 200_000
AZIMUTH, ZENITH, RANGE, COSINE, POWER, LINE, SHARE = 0.3, 1.2, 83.0, 0.6, 0.4, 37, 0.25
BY_AZIMUTH, BY_ZENITH = 40.0, -70.0
AT = PulseGeometry(
    *(np.full(PULSES, value) for value in (AZIMUTH, ZENITH, RANGE, COSINE, POWER, LINE, SHARE, BY_AZIMUTH, BY_ZENITH))
)


def typical(effect: type[Effect]) -> Effect:
    return effect(**effect.typical_sizes())


def pulses() -> Pulses:
    index = dr.arange(mi.UInt32, PULSES)
    azimuth, zenith = dr.full(mi.Float64, AZIMUTH, PULSES), dr.full(mi.Float64, ZENITH, PULSES)
    distance = dr.full(mi.Float64, RANGE, PULSES)
    return Pulses(
        line=index * 0 + LINE,
        share=dr.full(mi.Float64, SHARE, PULSES),
        line_key=index * 0,
        pulse_key=index,
        azimuth=azimuth,
        zenith=zenith,
        aim_azimuth=azimuth,
        aim_zenith=zenith,
        true_range=distance,
        range_m=distance,
        cos_incidence=dr.full(mi.Float32, COSINE, PULSES),
        power=dr.full(mi.Float32, POWER, PULSES),
        block=mi.Int32(index) * 0,
        returned=index == index,
        minimum_range=mi.Float64(1.0),
    )


def recorded(effect: Effect) -> np.ndarray:
    """Return recorded minus true range (n,), where the true one belongs to the beam's real direction on the plane."""
    after = effect.apply(pulses(), KeyedRandom(5))
    azimuth, zenith, timed = (np.array(each) for each in (after.aim_azimuth, after.aim_zenith, after.range_m))
    return (azimuth - AZIMUTH) * BY_AZIMUTH + (zenith - ZENITH) * BY_ZENITH + timed - RANGE


SCANNER = [each for each in EFFECTS if each.sensor == "tls" and each.stage in (Stage.AIM, Stage.RANGE) and not each.empirical]


@pytest.mark.parametrize("effect", [each for each in SCANNER if each.shows_in != ShowsIn.VALUES], ids=lambda each: each.tag())
def test_a_scanner_s_ranges_have_the_mean_and_the_variance_that_the_effect_states(effect: type[Effect]) -> None:
    chosen = typical(effect)
    error = recorded(chosen)
    mean, variance = chosen.mean(AT), chosen.variance(AT)
    assert mean.shape == variance.shape == (PULSES,)
    assert (np.any(mean != 0), np.any(variance > 0)) == (
        effect.shows_in == ShowsIn.MEAN and _moves(effect),
        effect.shows_in == ShowsIn.SPREAD,
    )
    assert error.mean() == pytest.approx(mean[0], abs=5 * np.sqrt(variance[0] / PULSES) + 1e-8)
    assert error.var() == pytest.approx(variance[0], rel=5 * np.sqrt(2 / PULSES), abs=1e-14)


def _moves(effect: type[Effect]) -> bool:
    """Return whether the effect has a mean: time walk has none here, because it is relative to the median power, which all pulses
    have.
    """
    return "reference_power" not in effect.model_fields


def test_steps_of_the_range_add_the_variance_of_a_uniform_error() -> None:
    effect = next(each for each in SCANNER if each.shows_in == ShowsIn.VALUES)(step_m=0.01)
    state = pulses()
    true = np.random.default_rng(3).normal(RANGE, 0.005, PULSES)
    error = np.array(effect.apply(replace(state, range_m=mi.Float64(true)), KeyedRandom(1)).range_m) - true
    assert error.var() == pytest.approx(effect.variance(AT)[0], rel=0.02)
    assert abs(error.mean()) < 5 * 0.01 / np.sqrt(12 * PULSES)


@pytest.mark.parametrize("effect", [each for each in EFFECTS if each.shows_in == ShowsIn.RETURNS], ids=lambda each: each.tag())
def test_as_many_returns_are_kept_as_the_effect_states(effect: type[Effect]) -> None:
    values = {"early_share": 0.0} if "early_share" in effect.model_fields else {}
    key, size = next(iter(effect.typical_sizes().items()))
    for scale in (1.0, 10.0):
        chosen = effect(**values, **{key: scale * size})
        kept = np.array(chosen.apply(pulses(), KeyedRandom(7)).returned).mean()
        expected = chosen.kept(AT)[0]
        assert kept == pytest.approx(expected, abs=5 * np.sqrt(expected * (1 - expected) / PULSES) + 1e-12)


def test_the_echo_of_a_slanting_surface_is_stretched_by_as_much_on_host_and_device_and_not_without_end() -> None:
    cosine = np.array([1.0, 0.5, 0.2, 0.1, 0.01, 1e-9])
    host, device = slant(cosine, HOST), np.array(slant(mi.Float64(cosine), DEVICE))
    np.testing.assert_allclose(host, [0.0, 1.0, 4.0, 9.0, 9.0, 9.0])
    np.testing.assert_allclose(device, host, rtol=1e-12)
    grazing = replace(pulses(), cos_incidence=dr.full(mi.Float32, 1e-3, PULSES))
    error = np.array(RangeIncidenceBias(coefficient_m=0.002).apply(grazing, KeyedRandom(1)).range_m) - RANGE
    np.testing.assert_allclose(error, 0.018, rtol=1e-6)


CELLS, REDUCTION = 500, 4
NODE_CELLS = 240
"""Along a side, so few that nodes half a step apart serve."""


def matches(disparity: Any = 60.0) -> Matches:
    index = dr.arange(mi.UInt32, CELLS * CELLS)
    row = index // CELLS
    column = index - row * CELLS
    return Matches(
        index=index,
        u=(mi.Float64(column) + 0.5) * REDUCTION,
        v=(mi.Float64(row) + 0.5) * REDUCTION,
        disparity=mi.Float64(disparity) + dr.zeros(mi.Float64, CELLS * CELLS),
        matched=index == index,
        block=mi.Int32(index) * 0,
        true_depth=dr.full(mi.Float64, 50.0, CELLS * CELLS),
        albedo=None,
        width=CELLS * REDUCTION,
        height=CELLS * REDUCTION,
        reduction=REDUCTION,
        tangent=dr.zeros(mi.Float64, CELLS * CELLS),
        infinity=0.0,
    )


def noise(effect: MatchingNoise, seeds: range) -> np.ndarray:
    """Return what the effect adds (seeds, rows, columns), px."""
    fields = [np.array(effect.apply(matches(), KeyedRandom(seed)).disparity).reshape(CELLS, CELLS) - 60.0 for seed in seeds]
    return np.stack(fields)


NOISES = [each for each in EFFECTS if issubclass(each, MatchingNoise)]
LAGS = np.array([[4, 0], [8, 0], [0, 12], [16, 16], [40, 0], [400, 400]])


@pytest.mark.parametrize("effect", NOISES, ids=lambda each: each.tag())
@pytest.mark.parametrize("step", [24.0, 40.0])
def test_disparities_differ_between_neighbours_as_the_effect_states(effect: type[MatchingNoise], step: float) -> None:
    """5 % of each semivariogram: 12 images of about a thousand independent nodes scatter by 1 % (heavy tails: by 1.5 %)."""
    values = {"sigma_px": 0.4} | ({"step_px": step} if effect.shared else {})
    chosen = effect(**values)
    field = noise(chosen, range(12))
    stated = chosen.semivariogram(LAGS.astype(float))
    for (dx, dy), expected in zip(LAGS // REDUCTION, stated, strict=True):
        difference = field[:, dy:, dx:] - field[:, : CELLS - dy, : CELLS - dx]
        assert 0.5 * np.mean(difference**2) == pytest.approx(expected, rel=0.05)
    assert np.mean(field**2) == pytest.approx(chosen.total_variance, rel=0.05)
    np.testing.assert_allclose(chosen.variance(np.zeros(3)), chosen.total_variance)


def test_smooth_noise_with_heavy_tails_is_not_white() -> None:
    """At a distance of four pixels, neighbours differ by a twentieth of what white noise would, for which it used to be taken."""
    effect = HeavyTailedNoise(sigma_px=0.5, step_px=24.0)
    assert effect.semivariogram(np.array([[4.0, 0.0]]))[0] < 0.1 * effect.total_variance


@pytest.mark.parametrize(
    "effect", [RegularizationNoise(sigma_px=0.4, step_px=40.0), HeavyTailedNoise(sigma_px=0.4, step_px=40.0)]
)
@pytest.mark.parametrize("side", [20, 80, 200])
def test_the_mean_of_a_square_has_the_variance_that_its_pairs_give(effect: MatchingNoise, side: int) -> None:
    """side: px; means over the squares of 20 images, at least 2,000 of them. 20 % are allowed: the error for bilinear nodes half
    a step apart (heavy tails: 8 %) and four times the scatter.
    """
    cells = side // REDUCTION
    count = CELLS // cells
    field = noise(effect, range(20))[:, : count * cells, : count * cells]
    means = field.reshape(20, count, cells, count, cells).mean(axis=(2, 4))
    across = REDUCTION * (np.arange(NODE_CELLS) + 0.5)
    pixels = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    nodes = GridCorrelatedNoise((effect,), pixels).node_field(len(pixels))
    per_side = NODE_CELLS // cells
    number = np.minimum(pixels // side, per_side).astype(int) @ np.array([1, per_side + 1])
    gathered = csr_array((np.full(len(number), 1 / cells**2), (number, np.arange(len(number)))))
    whole = np.bincount(number, minlength=gathered.shape[0]) == cells**2
    weights = (gathered @ nodes.weights).toarray()[whole]
    stated = float(np.mean(np.sum(weights @ nodes.covariance * weights, axis=1)))
    assert np.mean(means**2) == pytest.approx(stated, rel=0.2)
    assert nodes.variance == pytest.approx(effect.total_variance, rel=0.25)


@pytest.mark.parametrize("camera", ["left", "right", "both"])
def test_rows_that_shake_move_disparities_as_the_effect_states(camera: str) -> None:
    effect = next(each for each in EFFECTS if each.stage == Stage.EXPOSE)(camera=camera, amplitude_px=0.5, rows_per_cycle=300.0)
    v, v_right = np.linspace(0, 900, 50), np.linspace(3, 910, 50)
    moved = [
        np.array(effect.apply(ImageRows(side, mi.Float64(rows), dr.zeros(mi.Float64, 50)), KeyedRandom(1)).du)
        for side, rows in (("left", v), ("right", v_right))
    ]
    at = type("Rows", (), {"v": v, "v_right": v_right, "__len__": lambda self: 50})()
    np.testing.assert_allclose(effect.mean(at), moved[0] - moved[1], atol=1e-12)


def test_locking_moves_disparities_as_the_effect_states() -> None:
    effect = next(each for each in EFFECTS if each.sensor == "stereo" and each.shows_in == ShowsIn.VALUES)(
        amplitude_px=0.3, period_px=4.0
    )
    found = np.linspace(40.0, 60.0, CELLS * CELLS)
    moved = np.array(effect.apply(matches(found), KeyedRandom(1)).disparity) - found
    at = type("Pixels", (), {"found": found, "__len__": lambda self: len(found)})()
    np.testing.assert_allclose(effect.mean(at), moved, atol=1e-9)


def test_a_searched_sine_without_what_it_runs_along_is_no_class() -> None:
    """Otherwise an effect from another package would stop a diagnosis half-way."""
    with pytest.raises(TypeError, match="needs `argument` too"):
        type("Half", (Effect,), {"searched": Search("period_m", "range", shortest=0.1), "__annotations__": {}})
