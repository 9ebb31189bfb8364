"""Periodic errors that are no sine: averaged over their period ("folded"), or over a few scan lines, columns or rows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gap_cases import write_scan

from benchmarks.gap_closed_form.cases import Case, make
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.mean.candidates import Candidate, SineGrid, Wave
from pipeline.gap.mean.nonparametric_terms import (
    HARMONIC_SERIES,
    LINE_PATTERN,
    half_pixel_sine,
    line_pattern_terms,
    nonparametric_terms,
)
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.mean.signatures import _searched, systematic_families
from pipeline.gap.naming.candidate_families import candidate_families
from pipeline.gap.naming.named_effects import Estimate, _standard_deviations, effect_from_estimate
from pipeline.gap.residuals.alignment import compute_residuals
from pipeline.gap.residuals.disparity_raster import raster_cell_px, raster_spacing_px
from pipeline.gap.residuals.nominal_pair import PixelGeometry
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.disparity_empirical import DisparityEmpirical
from sensors.effects.row_jitter import RowJitter
from sensors.numerics.curve import interpolate_on_host

SIDE, STRIDE, SIGMA, PERIOD = 100, 4.0, 0.2, 64.0
PIXELS = STRIDE * np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2)


def residuals(error: FloatArray) -> StereoResiduals:
    """Return an error with white noise on a raster; the pose is a parabola over the wall."""
    at, count = PIXELS / 40.0, len(PIXELS)
    pose = np.stack([np.ones(count), *at.T, at[:, 0] ** 2, at[:, 0] * at[:, 1], at[:, 1] ** 2], axis=1)
    every, covariates = np.ones(count, dtype=bool), {"image_x": PIXELS[:, 0], "image_y": PIXELS[:, 1]}
    nowhere = PixelGeometry(*[np.zeros(count)] * 12)
    value = error + SIGMA * np.random.default_rng(7).standard_normal(count)
    sigma, unit = np.full(count, SIGMA), np.full(count, 0.1)
    return StereoResiduals(value, sigma, unit, every, every, pose, at, covariates, np.arange(count), nowhere)


def best(found: Residuals, families: list[Candidate | SineGrid]) -> tuple[MeanSearch, Estimate]:
    """Return the form that a search chooses, with its values."""
    search = MeanSearch(
        found,
        [*nonparametric_terms("image_x", PIXELS[:, 0]), *nonparametric_terms("image_y", PIXELS[:, 1]), *families],
        KeyedRandom(1),
    )
    (chosen,), _ = search.select()
    candidates, fit = search.design.fit_refined([chosen.candidate])
    width = len(fit.coefficients) - found.pose_jacobian.shape[1]
    return search, Estimate(chosen, candidates[0], fit.coefficients[-width:], fit.covariance[-width:, -width:])


@pytest.mark.parametrize(("stride", "shortest"), [(4.0, 20.0), (27.0, 54.0)])
def test_periods_are_searched_as_far_as_the_rows_tell_them_apart(stride: float, shortest: float) -> None:
    """Sampled every 27 px, a jitter of 26.2 px looks like a wave of 884 px, which was once named for a slanting wave."""
    pixels = PIXELS * stride / STRIDE
    assert RowJitter.searched is not None
    nowhere = PixelGeometry(*pixels.T, pixels[:, 1], *[np.zeros(len(pixels))] * 9)
    for camera in ("left", "right"):
        (grid,) = _searched(RowJitter, RowJitter.searched, nowhere, {"camera": camera})
        assert 1 / grid.frequencies[-1] == pytest.approx(shortest)
    assert np.sin(2 * np.pi * 27 / 26.2 * np.arange(9)) == pytest.approx(np.sin(2 * np.pi * 27 / 884.25 * np.arange(9)))


@pytest.mark.parametrize(("across", "down", "side"), [(4.0, 4.0, 4.0), (4.0, 8.0, 4.0), (8.0, 4.0, 4.0)])
def test_cells_are_as_fine_as_the_finer_of_columns_and_rows(across: float, down: float, side: float) -> None:
    """Larger cells would mix pixels of two rows."""
    u, v = (PIXELS / STRIDE * [across, down]).T
    assert raster_cell_px(u, v) == side


def square(x: FloatArray, period: float) -> FloatArray:
    return 0.12 * np.sign(np.sin(2 * np.pi * x / period + 0.3))


@pytest.mark.parametrize(("period", "least"), [(PERIOD, 0.93), (96.0, 0.96)])
def test_a_square_wave_is_folded_over_its_period_in_pixels(period: float, least: float) -> None:
    """A square wave is described by its odd overtones, as far as the raster shows them.

    Beyond the fifth, 7 % of its variance are left (a correlation of 0.97 without noise), beyond the eleventh 3 % (0.983). With 16
    columns a period none beyond the eighth is visible.
    """
    found = residuals(square(PIXELS[:, 0], period))
    _, estimate = best(found, [])
    assert estimate.candidate.form == HARMONIC_SERIES
    assert estimate.candidate.columns.shape[1] == (10 if period == PERIOD else 22)
    entry = effect_from_estimate(estimate, found).entry
    assert entry["along"]["period"] == pytest.approx(period, rel=0.01)
    effect = DisparityEmpirical.model_validate(entry)
    curve = interpolate_on_host(PIXELS[:, 0], PIXELS[:, 0], effect.along, effect.across, effect.values_px)
    assert np.corrcoef(curve, square(PIXELS[:, 0], period))[0, 1] > least


def test_a_sine_stays_a_sine() -> None:
    _, estimate = best(residuals(0.15 * np.sin(2 * np.pi * PIXELS[:, 0] / PERIOD)), [])
    assert estimate.candidate.form == "wave"


def test_the_amplitude_is_right_where_the_phase_at_zero_is_not_known() -> None:
    """A sine whose points lie 150 periods from x = 0, as those of a cyclic range error, begun from a trial period beside its own.

    The oracles are the true values, and sigma sqrt(2 / n) for the standard deviation of an amplitude.
    """
    amplitude, x = 0.05, 150 * PERIOD + PIXELS[:, 0]
    found = residuals(amplitude * np.sin(2 * np.pi * x / PERIOD + 0.7))
    wave = Wave("period", np.ones(len(x)), x, float(x.mean()), 1e-3)
    grid = SineGrid("image_x", "amplitude", wave, np.array([0.99, 1.0, 1.01]) / PERIOD, empirical=True)
    design = MeanSearch(found, [grid], KeyedRandom(1)).design
    trial = grid.at_period(PERIOD * 1.012)
    (candidate,), fit = design.fit_refined([trial])
    values, place = fit.coefficients[-3:], slice(-3, None)
    told = candidate.parameters(values)
    std = _standard_deviations(candidate, values, fit.covariance[place, place])
    expected = SIGMA * np.sqrt(2 / len(x))
    assert abs(told["amplitude"] - amplitude) < 4 * expected
    assert std["amplitude"] == pytest.approx(expected, rel=0.5)
    assert std["phase_rad"] > 10 * expected / amplitude  # at x = 0
    assert abs(told["period"] - PERIOD) < 4 * std["period"]
    curve = told["amplitude"] * np.sin(2 * np.pi * x / told["period"] + told["phase_rad"])
    assert np.abs(curve - amplitude * np.sin(2 * np.pi * x / PERIOD + 0.7)).max() < 8 * expected


@pytest.mark.parametrize("lines", [3, 4, 5])
def test_offsets_of_every_few_columns_are_found_with_their_number(lines: int) -> None:
    """The columns are offset by 0, 1, -0.6, 0.3 and -0.2 times 0.1 px, in turn, as no sine of any period is.

    Planes fitted to cells of five columns absorb most of the differences: 0.19 of their scatter remain, and 0.04 for cells of
    three.
    """
    column = PIXELS[:, 0] / STRIDE
    error = 0.1 * np.array([0.0, 1.0, -0.6, 0.3, -0.2])[(column % lines).astype(int)]
    found = residuals(error)
    _, estimate = best(found, [*line_pattern_terms("image_x", column, STRIDE)])
    assert estimate.candidate.form == f"{LINE_PATTERN} {lines}"
    entry = effect_from_estimate(estimate, found).entry
    assert entry["along"]["period"] == lines * STRIDE
    effect = DisparityEmpirical.model_validate(entry)
    curve = interpolate_on_host(PIXELS[:, 0], PIXELS[:, 0], effect.along, effect.across, effect.values_px)
    assert np.std(curve - curve.mean() - (error - error.mean())) < 0.25 * np.std(error)


@pytest.mark.parametrize("scale", [1.0, 0.985])
def test_a_matcher_that_is_off_alike_at_each_half_of_a_pixel_is_found(scale: float) -> None:
    """An error of two cycles a pixel is found on a wall of 40 px of disparity.

    The matcher's rectification may have another principal distance. The sine's amplitude of 0.1 px has a standard error of 0.2
    sqrt(2 / 10,000), 3 %.
    """
    x, y = PIXELS.T / (STRIDE * SIDE)
    disparity = 500 + 40 * (x + 0.3 * np.sin(5 * y) + 0.1 * np.sin(9 * x * y))
    error = 0.1 * np.sin(4 * np.pi * scale * disparity + 0.7)
    found = replace(residuals(error), covariates={"image_x": PIXELS[:, 0], "image_y": PIXELS[:, 1], "disparity": disparity})
    _, estimate = best(found, [*nonparametric_terms("disparity", disparity), *half_pixel_sine("disparity", disparity)])
    entry = effect_from_estimate(estimate, found).entry
    assert entry["covariate"] == "disparity"
    assert entry["along"]["period"] == pytest.approx(0.5 / scale, rel=1e-3)
    effect = DisparityEmpirical.model_validate(entry)
    curve = interpolate_on_host(disparity, disparity, effect.along, effect.across, effect.values_px)
    assert curve @ error / (error @ error) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize(("points", "least"), [(12_000, 34), (300, 0)])
def test_waves_along_the_columns_are_tried_as_far_as_the_raster_shows_them(tmp_path: Path, points: int, least: int) -> None:
    """A block-wise read-out may repeat tens of times over an image, while a wall's shape may do so twelve times.

    A raster with fewer than two columns per cycle shows another wave.
    """
    make(Case(0, (3, 1), "none", "stereo", (), points, 6_000), tmp_path / "case", tmp_path / "truth.json", baselines=False)
    measurement = read_measurement(tmp_path / "case")
    found = compute_residuals(measurement)
    waves = [each for each in candidate_families(measurement, found) if isinstance(each, SineGrid) and each.name == "image_x"]
    shortest = float(found.covariates["image_x"].std()) / max(float(each.frequencies[-1]) for each in waves)
    reach, step = float(np.ptp(found.covariates["image_x"])), raster_spacing_px(found.covariates["image_x"])
    assert step is not None
    assert shortest >= 0.99 * 2 * step
    assert least <= reach / shortest < 42


@pytest.mark.parametrize(("lines", "cycles"), [(300, 0.3), (2000, 0.3), (8000, 1.0)])
def test_periods_are_tried_as_finely_as_the_lines_tell_them_apart(tmp_path: Path, lines: int, cycles: float) -> None:
    """Each wobble is near one of the trial periods.

    Neighbouring trial periods differ by less than the resolvable part of a cycle over all lines.
    """
    write_scan(tmp_path, 3, step_rad=0.01)
    measurement = read_measurement(tmp_path)
    found = compute_residuals(measurement)
    assert isinstance(found, TlsResiduals)
    line = np.linspace(0, lines, len(found.value)).round()
    grids = systematic_families(replace(found, geometry=replace(found.geometry, line=line)), measurement)
    [wobble] = [each for each in grids if isinstance(each, SineGrid) and each.name == "wobble"]
    assert float(np.diff(wobble.frequencies).max()) * lines < 1.05 * cycles
    assert wobble.frequencies[-1] == pytest.approx(1 / 4)
