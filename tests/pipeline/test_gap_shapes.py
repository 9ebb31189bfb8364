"""Test edge effects and grid noise on the closed-form generator's cases.

Edge effects are smoothing, grown outlines, filled strips and beam footprints.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

from benchmarks.gap_closed_form import stereo_effects
from benchmarks.gap_closed_form.cases import Case, make
from benchmarks.gap_second_generator.cases import build, schedule
from pipeline.formats.measurements.measurement import (
    Measurement,
    StereoMeasurement,
    TlsMeasurement,
    read_measurement,
)
from pipeline.gap.mean.candidates import Candidate, SineGrid
from pipeline.gap.naming import effect_selection as steps
from pipeline.gap.naming.candidate_families import candidate_families
from pipeline.gap.naming.named_effects import with_effects
from pipeline.gap.noise_and_edges import disparity_edges
from pipeline.gap.noise_and_edges.beam_footprint import find_footprint
from pipeline.gap.noise_and_edges.disparity_edges import find_disparity_edge_effects
from pipeline.gap.noise_and_edges.edge_effects import agreed_gain
from pipeline.gap.noise_and_edges.grid_noise import find_grid_noise, separate_white_and_grid_noise
from pipeline.gap.noise_and_edges.variance_model import fit_variance_model
from pipeline.gap.residuals import disparity_raster, stereo_residuals
from pipeline.gap.residuals.alignment import align, compute_residuals, fit_pose_robustly
from pipeline.gap.residuals.disparity_raster import DisparityRaster, raster_spacing_px
from pipeline.gap.residuals.nominal_pair import NominalPair, project
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.residuals.scan_simulation import simulate_ranges, simulate_ranges_by_mode, systematic_part
from pipeline.gap.residuals.wall_blocks import WallCells
from scene.common.keyed_random import KeyedRandom
from sensors.effects.beam_divergence import BeamDivergence
from sensors.effects.edge_fattening import EdgeFattening
from sensors.effects.occlusion_fill import OcclusionFill
from sensors.effects.smoothing import Smoothing
from sensors.models.sensor_model import StereoModel

Made = tuple[Measurement, Residuals, dict[str, Any]]


def made_in(folder: Path, sensor: str, kinds: tuple[str, ...], seed: int) -> Made:
    """Return a measurement with the effects `kinds`, its residuals, and the true parameters of the first effect."""
    stratum = "one" if kinds else "none"
    make(Case(0, (seed, 1), stratum, sensor, kinds, 15_000, 15_000), folder / "case", folder / "truth.json", baselines=False)
    effects = json.loads((folder / "truth.json").read_text())["effects"]
    there, residuals, _ = align(read_measurement(folder / "case"))
    return there, residuals, effects[0]["parameters"] if effects else {}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Made]:
    """`made_in` a folder of its own, once for all tests that ask for the same sensor, effects and seed."""
    return cache(lambda *case: made_in(tmp_path_factory.mktemp("made"), *case))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> StereoMeasurement:
    """A stereo pair without effects, of a wall with ledges and relief."""
    folder = tmp_path_factory.mktemp("plain")
    make(Case(0, (5, 1), "none", "stereo", (), 15_000, 15_000), folder / "case", folder / "truth.json", baselines=False)
    found = read_measurement(folder / "case")
    assert isinstance(found, StereoMeasurement)
    return found


def shapes_of(case: Made) -> dict[str, Any]:
    """Return the edge effects that are found in disparities, by name."""
    there, residuals, _ = case
    return {
        each.name: each
        for each in find_disparity_edge_effects(
            there, residuals, fit_pose_robustly(residuals)[0], np.zeros(len(residuals), dtype=bool)
        )
    }


@pytest.mark.parametrize("seed", [1, 2])
def test_a_low_pass_is_found_with_its_width(made: Callable[..., Made], seed: int) -> None:
    case = made("stereo", ("smoothing",), seed)
    found = shapes_of(case)
    assert set(found) == {"smoothing"}
    # the generator filters its own cells, the diagnosis those of the reference, whose error is some millimetres
    assert found["smoothing"].effect.sigma_px == pytest.approx(case[2]["sigma_px"], rel=0.1)


def test_outlines_that_grow_are_found_with_their_reach(made: Callable[..., Made]) -> None:
    case = made("stereo", ("edge_fattening",), 1)
    found = shapes_of(case)["edge_fattening"]
    assert found.effect.radius_px == pytest.approx(case[2]["radius_px"], abs=2 * np.sqrt(3) * found.std["radius_px"])


def test_outlines_that_grow_at_high_steps_alone_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The matcher follows low steps like slopes; the measurement does not say which height it takes for a step."""
    monkeypatch.setattr(stereo_effects, "_STEP_PX", 4.0)
    there, residuals, truth = case = made_in(tmp_path, "stereo", ("edge_fattening",), 4)
    raster = DisparityRaster.of(there, residuals.geometry)
    assert raster is not None
    assert raster.depth_step_px < 2
    found = shapes_of(case)["edge_fattening"]
    assert isinstance(found.effect, EdgeFattening)
    assert 2 < found.effect.step_px < 8
    assert found.effect.radius_px == pytest.approx(truth["radius_px"], abs=2 * np.sqrt(3) * found.std["radius_px"])


def test_a_low_pass_takes_the_relief_off_what_a_move_changes(plain: StereoMeasurement) -> None:
    """The Jacobian of the pose, of low-passed disparities, predicts what a small move of the cameras changes.

    It is compared with moving the cameras and filtering the reference anew, on a wall with ledges and relief. The move has mm and
    tens of microradians, where the change is linear. Points beside pixels without a hit are left out, because the low-pass does
    not know what is there.
    """
    there = plain.changed(model=with_effects(plain.model, [{"name": "smoothing", "sigma_px": 40.0}]))
    sharp, found = compute_residuals(plain), compute_residuals(there)
    step = np.array([2e-3, 0, 1e-3, 0, 2e-5, 0])
    moved = compute_residuals(there.moved(step))
    inner = ~DisparityRaster.of(plain, sharp.geometry).near_border(60.0)[np.searchsorted(sharp.index, found.index)]
    both, ours, theirs = np.intersect1d(found.index[found.usable & inner], moved.index, return_indices=True)
    rows = np.flatnonzero(found.usable & inner)[ours]
    assert len(both) > 3000
    change = found.value[rows] - moved.value[theirs]
    low_passed, raw = (float(np.std(change - each.pose_jacobian[rows] @ step)) for each in (found, sharp))
    assert low_passed < 0.1 * np.std(change)
    assert low_passed < 0.3 * raw


def test_a_cut_cloud_has_the_low_pass_of_the_whole_picture(plain: StereoMeasurement) -> None:
    """Clouds are matched first and cut then: at a cut, the smoothing has seen what was cut off."""
    there = plain.changed(model=with_effects(plain.model, [{"name": "smoothing", "sigma_px": 30.0}]))
    whole = compute_residuals(there)
    u = whole.geometry.u
    kept = whole.index[(u > np.quantile(u, 0.3)) & (u < np.quantile(u, 0.7))]
    part = compute_residuals(there.part(kept))
    both, ours, theirs = np.intersect1d(kept[part.index], whole.index, return_indices=True)
    assert len(both) > 4000
    np.testing.assert_allclose(part.geometry.shaped[ours], whole.geometry.shaped[theirs], atol=1e-3)
    assert np.std(whole.geometry.shaped[theirs]) > 0.05, "px that the low-pass does"


def test_nothing_is_matched_outside_of_the_right_picture(plain: StereoMeasurement) -> None:
    geometry = compute_residuals(plain).geometry
    right = plain.cameras.right
    column = right.width // 2
    narrow = plain.changed(cameras=replace(plain.cameras, right=replace(right, width=column, cx_px=right.cx_px + column / 2)))
    raster, cut = DisparityRaster.of(plain, geometry), DisparityRaster.of(narrow, geometry)
    assert raster is not None
    assert cut is not None
    seen_at = project(NominalPair.of(plain).pair.right, geometry.point)[0]
    held = ~np.isnan(cut.at_points(cut.disparity))
    sure, matched = np.abs(seen_at - column) > 2, ~np.isnan(raster.at_points(raster.disparity))
    np.testing.assert_array_equal(held[sure & matched], (seen_at < column)[sure & matched])
    assert 0.1 < held.mean() < 0.9


@pytest.mark.parametrize("sigma_px", [4.0, 10.0])
def test_a_low_pass_sees_over_a_straight_border_from_so_many_sigmas(sigma_px: float) -> None:
    """More than a hundredth of a Gaussian lies beyond 2.326 standard deviations; cell centres are half a cell inside."""
    row, column = (np.ravel(each) for each in np.indices((120, 120)))
    raster = DisparityRaster(1.0, np.full((120, 120), 30.0), np.zeros((120, 120), dtype=bool), row, column)
    away, found = np.minimum(column, 119 - column) + 0.5, raster.near_border(sigma_px)
    middle = np.abs(row - 59.5) < 20
    np.testing.assert_array_equal(found[middle], away[middle] < 2.326 * sigma_px)


def test_a_raster_too_large_for_shapes_is_told(plain: StereoMeasurement, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not any("cells" in note for note in align(plain).residuals.notes)
    monkeypatch.setattr(stereo_residuals, "MOST_CELLS", 1000)
    assert any("more than 1,000 cells" in note for note in align(plain).residuals.notes)


def banded(monkeypatch: pytest.MonkeyPatch, cells: int, rows: int) -> None:
    """Make searches use at most `cells` cells, in bands of at least `rows` rows."""
    monkeypatch.setattr(disparity_raster, "_SEARCHED", cells)
    monkeypatch.setattr(disparity_raster, "_LEAST_ROWS", rows)


@pytest.mark.parametrize("shape", [(700, 300), (120, 400), (40, 3000)])
def test_bands_of_a_large_raster_hold_what_the_whole_does(shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    """The bands are far apart, touch, or cover the whole image; effects reach 32 cells at most."""
    banded(monkeypatch, 20_000, 20)
    random, (row, column) = np.random.default_rng(5), np.indices(shape)
    disparity = 40 + row / 50 + 6.0 * (np.sin(row / 17) * np.cos(column / 23) > 0.3)
    hidden = random.random(shape) < 0.1
    disparity[hidden] = np.nan
    points = np.flatnonzero(random.random(shape).ravel() < 0.5)
    raster = DisparityRaster(1.0, disparity, hidden, row.ravel()[points], column.ravel()[points])
    part, rows = raster.search_part()
    assert len(np.unique(rows)) == len(rows)
    assert len(rows) < len(points) or shape[0] < 80
    assert len(np.unique(part.row)) == len(np.unique(raster.row[rows]))
    np.testing.assert_array_equal(part.at_points(part.disparity), raster.at_points(raster.disparity)[rows])
    np.testing.assert_array_equal(part.in_filled_occlusions([]), raster.in_filled_occlusions([])[rows])
    believed = raster.at_points(raster.disparity)
    for effect in (EdgeFattening(radius_px=6.5), Smoothing(sigma_px=8.0), OcclusionFill(reach_px=30.0)):
        np.testing.assert_allclose(part.added_by([effect], believed[rows]), raster.added_by([effect], believed)[rows], atol=1e-9)


def test_filled_gaps_show_as_copies_of_their_neighbours() -> None:
    """Copies are runs of equal disparities in a row, to a thousandth of the noise.

    Equal neighbours in a column or across a gap are none.
    """
    random = np.random.default_rng(7)
    cells = random.normal(scale=0.3, size=(40, 60))
    cells[5, 10:14] = cells[5, 9]
    cells[20:23, 30] = cells[20, 30]
    cells[30, 42] = cells[30, 40]
    row, column = (place.ravel() for place in np.indices(cells.shape))
    known = ~((row == 30) & (column == 41))
    there = DisparityRaster(1.0, np.zeros(cells.shape), np.zeros(cells.shape, dtype=bool), row[known], column[known])
    copies = np.zeros(cells.shape, dtype=bool)
    copies[row[known], column[known]] = there.copied_from_neighbour(
        cells.ravel()[known] + 1e-4 * random.uniform(size=int(known.sum())), 3e-4
    )
    assert copies[5, 9:14].all()
    assert not copies[20:23, 30].any()
    assert not copies[30, [40, 42]].any()
    assert copies.sum() < 10, "0.04 % of 2,399 pairs by chance"


def test_outlines_in_few_places_agree_by_signs() -> None:
    """Outlines in few places are found by the signs of their contributions.

    One block of 60 points and 14 of two all agree: 15 of 15 signs are 3.9 standard deviations; the sums, of which one is largest,
    are only 1.5.
    """
    block = np.repeat(np.arange(15), [60, *[2] * 14])
    gains = np.full(len(block), 2.0)
    assert agreed_gain(gains, block) is None
    assert agreed_gain(gains, block, by_signs=True) == pytest.approx(176)
    against = np.where(block % 3 == 1, -2.0, 2.0)
    assert agreed_gain(against, block, by_signs=True) is None


@pytest.mark.parametrize(("kind", "seed"), [("smoothing", 1), ("edge_fattening", 4), ("occlusion_fill", 6)])
def test_shapes_are_found_in_bands_of_a_large_raster(
    made: Callable[..., Made], kind: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The values agree with those of the whole raster, and the touched points are found in all of it.

    In the bands, values are tried at some of the points only.
    """
    case = made("stereo", (kind,), seed)
    whole = shapes_of(case)[kind]
    banded(monkeypatch, 8_000, 16)
    monkeypatch.setattr(disparity_edges, "_TRIED", 1_000)
    there, residuals, _ = case
    raster = DisparityRaster.of(there, residuals.geometry)
    assert raster is not None
    assert len(raster.search_part()[1]) < 0.6 * len(residuals)
    found = shapes_of(case)[kind]
    (name,) = whole.std
    least = np.hypot(found.std[name], whole.std[name])
    assert getattr(found.effect, name) == pytest.approx(getattr(whole.effect, name), abs=3 * least)
    assert np.count_nonzero(found.touched & whole.touched) > 0.8 * np.count_nonzero(whole.touched)


def test_strips_that_are_filled_are_found(made: Callable[..., Made]) -> None:
    found = shapes_of(made("stereo", ("occlusion_fill",), 6))
    assert set(found) == {"occlusion_fill"}


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_wall_without_effects_shows_no_shape(made: Callable[..., Made], seed: int) -> None:
    assert not shapes_of(made("stereo", (), seed))


def test_points_that_are_held_out_have_no_say(made: Callable[..., Made]) -> None:
    there, residuals, _ = made("stereo", ("smoothing",), 1)
    assert not find_disparity_edge_effects(there, residuals, fit_pose_robustly(residuals)[0], np.ones(len(residuals), dtype=bool))


@pytest.mark.parametrize("seed", [2, 3])
def test_a_footprint_is_found_with_divergence_and_mode(made: Callable[..., Made], seed: int) -> None:
    there, residuals, truth = made("tls", ("beam_divergence",), seed)
    rough, _, scale = fit_pose_robustly(residuals)
    (found,) = find_footprint(there, residuals, rough, scale, np.zeros(len(residuals), dtype=bool))
    assert isinstance(found.effect, BeamDivergence)
    # the generator's beam has other sub-rays: 15 %
    assert found.effect.divergence_rad == pytest.approx(truth["divergence_rad"], rel=0.15)
    assert found.effect.mode == truth["mode"]


def test_modes_that_share_their_sub_rays_record_what_each_would_alone(made: Callable[..., Made]) -> None:
    there, residuals, _ = made("tls", ("beam_divergence",), 2)
    random, modes, plain = KeyedRandom(0), ("strongest", "mean", "first"), systematic_part(there.model)
    beams = {
        mode: plain.model_copy(update={"effects": (*plain.effects, BeamDivergence(divergence_rad=2e-3, mode=mode))})
        for mode in modes
    }
    together = simulate_ranges_by_mode(there, beams["mean"], modes, residuals.geometry, random)
    for mode in modes:
        np.testing.assert_array_equal(together[mode], simulate_ranges(there, beams[mode], residuals.geometry, random))
    assert np.nanmax(np.abs(together["first"] - together["mean"])) > 1e-3


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_thin_beam_shows_no_footprint(made: Callable[..., Made], seed: int) -> None:
    there, residuals, _ = made("tls", (), seed)
    rough, _, scale = fit_pose_robustly(residuals)
    assert not find_footprint(there, residuals, rough, scale, np.zeros(len(residuals), dtype=bool))


def test_the_noise_of_angles_is_no_footprint(tmp_path: Path) -> None:
    """Noise of the beam's direction does not pass for a beam footprint if the model contains it.

    A beam without width scatters by 55 microradians on ledges. At edges it records on average what a beam of four times that
    divergence does. The case is a quiet one of the second generator, which simulated no footprint.
    """
    build(schedule(78, 40)[26], 78, tmp_path / "case")
    there, residuals, _ = align(read_measurement(tmp_path / "case"))
    assert isinstance(there, TlsMeasurement)
    rough, _, scale = fit_pose_robustly(residuals)
    assert not find_footprint(there, residuals, rough, scale, np.zeros(len(residuals), dtype=bool))
    unaware = there.changed(model=there.model.without_noise())
    (feigned,) = find_footprint(unaware, residuals, rough, scale, np.zeros(len(residuals), dtype=bool))
    assert isinstance(feigned.effect, BeamDivergence)
    assert feigned.effect.divergence_rad == pytest.approx(4 * there.model.noise.angle_sigma_rad, rel=0.15)


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize(("kind", "seed"), [("parallax_noise", 2), ("regularization_noise", 9)])
def test_white_noise_and_noise_on_a_grid_are_told_apart(made: Callable[..., Made], kind: str, seed: int, every: int) -> None:
    """Also where rows lie twice as far apart as columns, because every second row of a map is compared."""
    there, residuals, truth = made("stereo", (kind,), seed)
    row = residuals.geometry.sensor_coordinates[:, 1]
    step = raster_spacing_px(row)
    assert step is not None
    part = residuals.part(residuals.usable & (np.rint((row - row.min()) / step) % every == 0))
    value = fit_pose_robustly(part)[0]
    spread, _, _ = fit_variance_model(part, WallCells.over(part.wall_xy), value, KeyedRandom(1))
    assert isinstance(there.model, StereoModel)
    (found,) = separate_white_and_grid_noise(spread, part, value, there.model)
    assert found.effect == kind
    # of 64 px nodes there are some 80 on the wall: their own standard deviation varies by 8 %
    assert found.parameters["sigma_px"] == pytest.approx(truth["sigma_px"], rel=0.2)


@pytest.mark.parametrize(("kind", "seed", "empirical"), [("parallax_noise", 2, True), ("regularization_noise", 9, False)])
def test_noise_on_a_grid_goes_before_an_empirical_term(made: Callable[..., Made], kind: str, seed: int, empirical: bool) -> None:
    """Grid noise replaces an empirical variance term; white noise keeps it.

    Some of few nodes are noisier by chance, whichever covariate sorts them.
    """
    there, residuals, _ = made("stereo", (kind,), seed)
    part = residuals.part(residuals.usable)
    value = fit_pose_robustly(part)[0]
    spread, _, _ = fit_variance_model(part, WallCells.over(part.wall_xy), value, KeyedRandom(1))
    assert isinstance(there.model, StereoModel)
    described = [replace(each, empirical=True) for each in spread]
    (found,) = separate_white_and_grid_noise(described, part, value, there.model)
    assert found.empirical == empirical
    assert found.effect == kind


def test_noise_on_a_coarse_grid_is_found_where_no_point_is_noisier_than_it_should_be(made: Callable[..., Made]) -> None:
    """Nodes are 64 px apart, with 0.23 px: within a cell of the search all points have the same error."""
    there, residuals, truth = made("stereo", ("regularization_noise",), 8)
    part = residuals.part(residuals.usable)
    assert isinstance(there.model, StereoModel)
    found, _ = find_grid_noise(part, fit_pose_robustly(part)[0], there.model, KeyedRandom(1))
    assert found is not None
    assert found.parameters["step_px"] == pytest.approx(truth["step_px"], rel=0.5)
    assert found.parameters["sigma_px"] == pytest.approx(truth["sigma_px"], rel=0.2)
    assert found.p_value == 1 / 2000


def _few_families(measurement: Measurement, part: Residuals) -> list[Candidate | SineGrid]:
    return [each for each in candidate_families(measurement, part) if isinstance(each, Candidate)][:3]


def test_noise_on_a_coarse_grid_counts_as_no_error_of_the_reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Effects are selected again beside the grid noise.

    Otherwise the noise passes for an equal error of the reference; then, with the noise named, the model predicts too wide a
    scatter of patches, and the right name is lost.
    """
    there, residuals, _ = made_in(tmp_path, "stereo", (), 1)
    left = residuals.covariates["image_x"]
    part = residuals.part(residuals.usable & (left < np.median(left)))
    x, y = (part.covariates[name] for name in ("image_x", "image_y"))
    lines = [np.arange(place.min() - 64, place.max() + 128, 64.0) for place in (x, y)]
    nodes = 0.4 * np.random.default_rng(5).standard_normal([len(line) for line in lines])
    part = replace(part, value=part.value + RectBivariateSpline(*lines, nodes, kx=1, ky=1)(x, y, grid=False))
    monkeypatch.setattr(
        steps,
        "candidate_families",
        lambda *known: [each for each in candidate_families(*known) if isinstance(each, Candidate)][:3],
    )
    named, naming = steps.select_effects(
        steps.SelectionStart.of(steps.SelectionInput(there, part, fit_pose_robustly(part)[2], KeyedRandom(1)))
    )
    assert [item.name for item in named] == ["stereo.regularization_noise"]
    assert naming.p_value is not None
    assert naming.p_value > 0.01
    off = json.loads((tmp_path / "truth.json").read_text())["nuisances"]["reference_m"][0]
    assert naming.reference_sigma * float(np.median(part.unit_m)) < 3 * off


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_the_reference_error_is_not_taken_for_noise_on_a_grid(made: Callable[..., Made], seed: int) -> None:
    """The reference's error is a few millimetres, correlated over metres."""
    there, residuals, _ = made("stereo", (), seed)
    part = residuals.part(residuals.usable)
    assert isinstance(there.model, StereoModel)
    assert find_grid_noise(part, fit_pose_robustly(part)[0], there.model, KeyedRandom(1))[0] is None


@pytest.mark.parametrize(("off_m", "length_m", "found"), [(0.012, 0.8, False), (0.015, 0.3, True), (0.0, 0.3, False)])
def test_noise_that_neighbours_share_is_the_reference_s_error_only_where_that_may_be_so(
    made: Callable[..., Made], off_m: float, length_m: float, found: bool
) -> None:
    """A reference may be wrong by centimetres over metres, but not over decimetres.

    If an error is attributed to it, the note says so.
    """
    there, residuals, _ = made("stereo", (), 1)
    part = residuals.part(residuals.usable)
    random = np.random.default_rng(3)
    k = random.normal(scale=1 / length_m, size=(400, 2))  # spectrum of a Gaussian correlation exp(-h^2 / 2 l^2)
    phase = random.uniform(0, 2 * np.pi, 400)
    field = np.sqrt(2 / 400) * np.cos(part.wall_xy @ k.T + phase).sum(axis=1)
    part = replace(part, value=part.value + off_m * field / part.unit_m)
    assert isinstance(there.model, StereoModel)
    nodes, words = find_grid_noise(part, fit_pose_robustly(part)[0], there.model, KeyedRandom(1))
    assert (nodes is not None) == found
    assert ("attributed to the reference" in words) == (off_m > 0 and not found)
