"""Test where a first answer of the diagnosis does not hold.

This covers effects that turn rays off the wall, non-parametric terms that fail validation, and edge effects that are
reconsidered.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gap_cases import write_scan
from numpy.typing import NDArray

from benchmarks.gap_closed_form.cases import Case, make
from pipeline.formats.measurements.measurement import StereoMeasurement, read_measurement
from pipeline.gap.mean.nonparametric_terms import SPATIAL_NULL
from pipeline.gap.naming import nonlinear_refit, selection_passes, workflow
from pipeline.gap.naming.effect_selection import NONPARAMETRIC_TERMS
from pipeline.gap.naming.gap_score import simulate_errors
from pipeline.gap.naming.named_effects import NamedEffect, with_effects
from pipeline.gap.naming.selection_notes import _note_most_similar
from pipeline.gap.naming.selection_passes import PassInput, PassInputs, select_beside_edge_effects
from pipeline.gap.naming.validation_scores import ValidatedEffects
from pipeline.gap.noise_and_edges.edge_effects import EdgeEffect
from pipeline.gap.noise_and_edges.variance_model import VarianceTerm
from pipeline.gap.residuals.alignment import _moves_far, align, at_points_of, compute_residuals
from pipeline.gap.residuals.disparity_raster import DisparityRaster
from pipeline.gap.residuals.nominal_pair import NominalPair, real_pair
from pipeline.gap.residuals.stereo_residuals import StereoResiduals, stereo_residuals
from pipeline.gap.residuals.wall_blocks import BlockGrid
from scene.common.keyed_random import KeyedRandom
from sensors.effects.edge_fattening import EdgeFattening
from sensors.effects.smoothing import Smoothing
from sensors.models.sensor_model import StereoNoise
from sensors.stereo.stereo_pair import REDUCTION


def test_an_effect_that_turns_all_rays_off_the_wall_leaves_no_residuals(tmp_path: Path) -> None:
    """The principal point is wrong by 10,000 px, beside an effect that uses the raster of what is seen."""
    make(Case(0, (3, 1), "none", "stereo", (), 15_000, 15_000), tmp_path / "case", tmp_path / "truth.json", baselines=False)
    measurement = read_measurement(tmp_path / "case")
    assert isinstance(measurement, StereoMeasurement)
    away = [{"name": "principal_point_x", "camera": "left", "delta_px": 1e4}, {"name": "smoothing", "sigma_px": 2.0}]
    found = align(measurement.changed(model=with_effects(measurement.model, away)))
    assert len(found.residuals) == 0
    assert not found.pose.any()
    assert len(at_points_of(found.residuals, compute_residuals(measurement))) == 0


def test_noise_found_on_some_points_adds_alike_to_all() -> None:
    found = VarianceTerm("a", (), 0.1, 3.0, {}, {}, False, np.full(5, 0.04))
    np.testing.assert_array_equal(found.with_constant_variance(8).variance, np.full(8, 0.04))


def _named(name: str, kind: str) -> NamedEffect:
    return NamedEffect(f"tls.{name}", kind, {"name": name}, {}, (), 0.002, 50.0)


@pytest.mark.parametrize(
    ("without", "kept"),
    [
        ([_named("range_offset", "physical")], ["tls.range_offset"]),
        ([], []),  # nothing else either: what is left stays as it was found the first time
    ],
)
def test_where_a_free_form_fails_all_is_named_again_without_any(
    without: list[NamedEffect], kept: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_scan(tmp_path, 10, step_rad=0.007)
    there, plain, _ = align(read_measurement(tmp_path))
    nowhere = np.zeros(len(there.cloud.points), dtype=bool)
    pass_input = PassInput.of(there, plain, nowhere, [])
    seen: list[bool] = []

    def named(*given: Any) -> Any:
        seen.append(NONPARAMETRIC_TERMS in given[-1])
        items = without if seen[-1] else [_named("range_empirical", "empirical")]
        selection = SimpleNamespace(reference_sigma=0.0, asked=seen[-1])
        return SimpleNamespace(pass_input=pass_input, selection=selection, named=items)

    def scored(_there: Any, _residuals: Any, items: list[NamedEffect], *_: Any) -> ValidatedEffects:
        failed = [item for item in items if item.kind == "empirical"]
        return ValidatedEffects([item for item in items if item not in failed], failed, [])

    monkeypatch.setattr(workflow, "select_beside_edge_effects", named)
    monkeypatch.setattr(workflow, "validate_effects", scored)
    monkeypatch.setattr(workflow, "only_within_bounds", lambda _, items: (items, []))
    monkeypatch.setattr(workflow, "_with_heavy_tails", lambda *given: (given[1], None))
    monkeypatch.setattr(workflow, "with_separating_measurements", lambda _, items: items)
    found = workflow._select_and_validate(PassInputs(there, plain, nowhere, BlockGrid(np.zeros(2), 1.0)), KeyedRandom(1))
    assert [item.name for item in found.named] == kept
    assert found.words == ["tls.range_empirical dropped: it does not improve the validation blocks"]
    assert seen == [False, True]
    assert found.selection.asked is bool(kept)  # type: ignore[attr-defined]


def test_a_simulation_without_noise_departs_nowhere_from_the_surface(tmp_path: Path) -> None:
    """Depth maps have cells of two pixels or more, whose centres differ by half a pixel from the measurement's pixels.

    What the surface does between them must not count as an error of the sensor.
    """
    make(Case(0, (3, 1), "none", "stereo", (), 15_000, 15_000), tmp_path / "case", tmp_path / "truth.json", baselines=False)
    there, residuals, _ = align(read_measurement(tmp_path / "case"))
    assert isinstance(there, StereoMeasurement)
    noise = StereoNoise(parallax_sigma_px=1e-6, regularization_sigma_px=0.0)
    (seen,) = simulate_errors(there, there.model.model_copy(update={"noise": noise}), residuals, [KeyedRandom(1)])
    nominal, u, v = NominalPair.of(there), there.cloud.extra["pixel_x"], there.cloud.extra["pixel_y"]
    between = nominal.surface_disparity(there.scene, u + 0.5, v + 0.5) - nominal.surface_disparity(there.scene, u, v)
    assert np.nanstd(between[residuals.index[residuals.usable]]) > 0.01, "px of disparity on smooth surface"
    known = residuals.usable & np.isfinite(seen)
    assert known.sum() > 5000
    np.testing.assert_allclose(seen[known], 0, atol=2e-4)


def test_a_simulated_pair_with_a_shifted_image_sees_the_rock_that_its_pixels_see(tmp_path: Path) -> None:
    """With a wrong principal point other rock lies between a pixel and the centre of its cell.

    A simulation without noise must give the disparities of the rays through the measured pixels of the real cameras.
    """
    make(Case(0, (3, 1), "none", "stereo", (), 15_000, 15_000), tmp_path / "case", tmp_path / "truth.json", baselines=False)
    there, residuals, _ = align(read_measurement(tmp_path / "case"))
    assert isinstance(there, StereoMeasurement)
    model = with_effects(there.model, [{"name": "principal_point_y", "camera": "left", "delta_px": -8.0}])
    quiet = StereoNoise(parallax_sigma_px=1e-6, regularization_sigma_px=0.0)
    (seen,) = simulate_errors(there, model.model_copy(update={"noise": quiet}), residuals, [KeyedRandom(1)])
    nominal, real = NominalPair.of(there), real_pair(model.effects, there)
    u, v = residuals.geometry.u, residuals.geometry.v
    expected = nominal.surface_disparity(there.scene, u, v, real) - nominal.surface_disparity(there.scene, u, v)
    known = residuals.usable & np.isfinite(seen) & np.isfinite(expected)
    assert known.sum() > 5000
    assert np.std(expected[known]) > 0.05, "px of disparity, by which the rock that is seen differs"
    np.testing.assert_allclose(seen[known], expected[known], atol=2e-4)


def test_outlines_grow_among_the_measurement_s_own_pixels_when_it_is_simulated(tmp_path: Path) -> None:
    """On a depth map with finer cells the same radius would have another reach and start at other steps."""
    make(
        Case(0, (4, 1), "one", "stereo", ("edge_fattening",), 6_000, 15_000),
        tmp_path / "case",
        tmp_path / "truth.json",
        baselines=False,
    )
    read = read_measurement(tmp_path / "case")
    plain = compute_residuals(read)
    raster = DisparityRaster.of(read, plain.geometry)
    assert raster is not None
    assert raster.step not in REDUCTION.values()
    grown = {"name": "edge_fattening", "radius_px": 2.5 * raster.step}
    model = with_effects(read.model, [grown])
    quiet = StereoNoise(parallax_sigma_px=1e-6, regularization_sigma_px=0.0)
    (seen,) = simulate_errors(read, model.model_copy(update={"noise": quiet}), plain, [KeyedRandom(1)])
    expected = raster.added_by([EdgeFattening(radius_px=2.5 * raster.step)], plain.geometry.disparity)
    known = np.isfinite(seen)
    assert np.count_nonzero(expected[known]) > 50
    assert np.mean(np.abs(seen - expected)[known] < 1e-3) > 0.99


def test_outlines_grow_where_a_turned_camera_sees_them_when_they_are_simulated(tmp_path: Path) -> None:
    """Where outlines grow, the simulation agrees to half a pixel with what the residuals subtract.

    As seen by the nominal camera only 18 % did.
    """
    make(
        Case(0, (6, 1), "two", "stereo", ("edge_fattening", "camera_omega"), 5000, 5000),
        tmp_path / "case",
        tmp_path / "truth.json",
        baselines=False,
    )
    there = read_measurement(tmp_path / "case")
    assert isinstance(there, StereoMeasurement)
    effects = json.loads((tmp_path / "truth.json").read_text())["effects"]
    model = with_effects(there.model, [{"name": effect["name"], **effect["parameters"]} for effect in effects])
    model = model.model_copy(update={"noise": StereoNoise(parallax_sigma_px=0, regularization_sigma_px=0)})
    nominal, turned = stereo_residuals(there), stereo_residuals(there.changed(model=model))
    drawn = simulate_errors(there, model, nominal, [KeyedRandom(1)])[0]
    _, before, after = np.intersect1d(nominal.index, turned.index, return_indices=True)
    shaped = turned.geometry.shaped[after]
    predicted = turned.geometry.disparity[after] + shaped - nominal.geometry.disparity[before]
    grown = np.abs(shaped) > 1
    assert grown.sum() > 300
    assert np.mean(np.abs(drawn[before] - predicted)[grown] < 0.5) > 0.95


def test_a_low_pass_that_others_feign_takes_no_outlines_along(monkeypatch: pytest.MonkeyPatch) -> None:
    """A smoothing that is seen only beside the named effects does not count, but grown outlines that were seen with it do."""
    nowhere = np.zeros(1, dtype=bool)
    seen = [EdgeEffect(effect, {}, 50.0, nowhere) for effect in (EdgeFattening(radius_px=3.0), Smoothing(sigma_px=2.0))]

    def with_these(effects: list[EdgeEffect]) -> Any:
        start = SimpleNamespace(given=None, outline=lambda: ["camera_phi"])
        return SimpleNamespace(edge_effects=effects, start=lambda *_: start)

    monkeypatch.setattr(selection_passes, "select_effects", lambda *_: ([], None))
    inputs: Any = SimpleNamespace(edge_effects=[], edge_effects_given=lambda _: seen, with_these=with_these)
    found = select_beside_edge_effects(inputs, KeyedRandom(1), frozenset())
    assert [each.name for each in found.pass_input.edge_effects] == ["edge_fattening"]


@pytest.mark.parametrize(
    ("after", "again"),
    [
        ({}, False),
        ({"radius_px": 3.04}, False),  # by less than a tenth of its standard deviation
        ({"radius_px": 3.06}, True),
        ({"step_px": 1.01}, True),  # no standard deviation is known
        ({"window": "disc"}, True),
        (None, True),  # another effect
    ],
)
def test_a_search_is_repeated_where_edge_effects_change(
    monkeypatch: pytest.MonkeyPatch, after: dict[str, Any] | None, again: bool
) -> None:
    nowhere, std = np.zeros(1, dtype=bool), {"radius_px": 0.5}
    before = EdgeEffect(EdgeFattening(radius_px=3.0), std, 50.0, nowhere)
    changed = Smoothing(sigma_px=2.0) if after is None else before.effect.model_copy(update=after)
    seen = EdgeEffect(changed, {"sigma_px": 0.1} if after is None else std, 50.0, nowhere)
    made: list[list[EdgeEffect]] = []

    def with_these(effects: list[EdgeEffect]) -> Any:
        made.append(effects)
        return SimpleNamespace(edge_effects=effects, start=lambda *_: SimpleNamespace(outline=lambda: ["camera_phi"]))

    monkeypatch.setattr(selection_passes, "select_effects", lambda *_: ([], None))
    inputs: Any = SimpleNamespace(edge_effects=[before], edge_effects_given=lambda _: [seen], with_these=with_these)
    select_beside_edge_effects(inputs, KeyedRandom(1), frozenset())
    assert len(made) == 1 + again


def test_an_unknown_without_a_name_says_what_remains_is_most_like() -> None:
    """The note names the largest form that was tried, except steps at a place, with its size.

    There is no note if chance explains as much or if an effect was found.
    """

    def item(name: str, score: float, form: str) -> Any:
        return SimpleNamespace(name=name, score=score, empirical=bool(form), candidate=SimpleNamespace(form=form))

    tried = (item(f"{SPATIAL_NULL} 30", 9.0, "step"), item("azimuth", 8.0, "spline"), item("row_jitter", 3.0, ""))
    part: Any = SimpleNamespace(unit_m=np.full(3, 0.1))
    for p_value, estimates, expected in ((0.004, [], 1), (0.02, [], 0), (None, [], 0), (0.004, ["effect"], 0)):
        search = SimpleNamespace(fitted_std=lambda each: 0.01 * each.score)
        found: Any = SimpleNamespace(search=search, p_value=p_value, tried=tried, estimates=estimates)
        said = _note_most_similar(found, part)
        assert len(said) == expected
        assert all("a change with azimuth (spline), 8 mm" in words for words in said)


@pytest.fixture(name="smoothed_disparities")
def _smoothed_disparities(tmp_path: Path) -> StereoMeasurement:
    """A quiet measurement whose model has a wide low-pass."""
    make(Case(0, (3, 1), "none", "stereo", (), 15_000, 15_000), tmp_path / "case", tmp_path / "truth.json", baselines=False)
    read = read_measurement(tmp_path / "case")
    assert isinstance(read, StereoMeasurement)
    return read.changed(model=with_effects(read.model, [{"name": "smoothing", "sigma_px": 40.0}]))


def _training_part(measurement: StereoMeasurement) -> tuple[StereoMeasurement, StereoResiduals, NDArray[np.int64]]:
    """Return the points from which effects are selected: their measurement, residuals, and row numbers in the whole measurement.

    No point is kept for validation.
    """
    nowhere = np.zeros(len(measurement.cloud.points), dtype=bool)
    pass_input = PassInput.of(measurement, compute_residuals(measurement), nowhere, [])
    part, residuals = pass_input.training_part
    assert isinstance(part, StereoMeasurement)
    assert isinstance(residuals, StereoResiduals)
    return part, residuals, pass_input.residuals.index[pass_input.training_rows]


def test_what_a_low_pass_does_is_kept_for_a_search_on_a_large_raster(
    smoothed_disparities: StereoMeasurement, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the low-pass changes is computed once, on the whole raster, and every trial of another error uses it."""
    monkeypatch.setattr(selection_passes, "_MOST_CELLS", 1000)
    part, residuals, _ = _training_part(smoothed_disparities)
    found = compute_residuals(part).value
    assert len(found) > 1000
    np.testing.assert_allclose(found, residuals.value, atol=1e-6)
    assert part.shaped_px is not None
    assert np.std(part.shaped_px) > 0.01, "px that the low-pass does"
    moved = compute_residuals(part.changed(shaped_px=part.shaped_px + 1))
    np.testing.assert_allclose(moved.value, found - 1)


def test_what_a_low_pass_does_follows_the_rays_that_another_error_moves(smoothed_disparities: StereoMeasurement) -> None:
    """A principal point that is off by 6 px shows other places of the rock: a sixth of the low-pass's width away.

    The part from which effects are selected has the same raster as the whole measurement, except at its border.
    """
    part, residuals, rows = _training_part(smoothed_disparities)
    turned = [{"name": "principal_point_x", "camera": "both", "delta_px": 6.0}]
    here, there = (
        stereo_residuals(each.changed(model=with_effects(each.model, turned))) for each in (part, smoothed_disparities)
    )
    expected = there.values_at(there.geometry.shaped, rows[here.index])
    before = residuals.values_at(residuals.geometry.shaped, here.index)
    assert len(here) > 1000
    assert np.nanstd(before - expected) > 0.1 * np.nanstd(expected), "the rays see other rock"
    assert np.mean(np.abs(here.geometry.shaped - expected) < 0.02 * np.nanstd(expected)) > 0.9


def test_a_pairs_rays_are_not_traced_again_where_shift_and_turn_cancel(smoothed_disparities: StereoMeasurement) -> None:
    """Of all moves of a pair, one shift and rotation together changes the disparities least.

    It moves the rays on the wall so far that they would be traced again if only that counted.
    """
    found = stereo_residuals(smoothed_disparities)
    relative = found.pose_jacobian / found.sigma[:, None]
    least = np.linalg.svd(relative, full_matrices=False)[2][-1]
    pose = least * 0.019 / np.mean(np.abs(relative @ least))
    assert not _moves_far(pose, found)
    assert _moves_far(1.1 * pose, found), "now they change by more than 2 % of sigma"


@pytest.mark.parametrize(("beside", "kept"), [(["smoothing", "edge_fattening"], True), (["edge_fattening"], False), ([], False)])
def test_smoothing_must_also_show_beside_the_effect_that_makes_residuals_smallest(
    monkeypatch: pytest.MonkeyPatch, beside: list[str], kept: bool
) -> None:
    """A small error of the rays' directions looks like smoothing."""
    first, then = ([SimpleNamespace(name=name) for name in names] for names in (["smoothing"], beside))
    monkeypatch.setattr(selection_passes, "_find_edge_effects", lambda *_: first)
    inputs: Any = SimpleNamespace(large_effect=None, _best_single_effect="camera_phi", measurement=None, plain=None)
    inputs.held_out_points, inputs._edge_effects_beside = None, lambda effects, _: then if effects == ["camera_phi"] else []
    assert PassInputs.edge_effects.func(inputs) is (first if kept else then)


@pytest.mark.parametrize(
    ("selections", "kept", "complete"),
    [
        (["ab", "ab"], 1, True),
        (["ab", "ac", "ac"], 2, True),
        (["ab", "ac", "ab"], 2, False),  # it goes round in a circle
        (["ab", "ac", "ad", "ae"], 3, False),  # each one differs, and no more are made
        (["aE", "bE", "cE"], 2, False),  # nor are they beside an empirical term, after two
        (["aE", "bE", "bE"], 2, True),
        (["ab", ""], 0, False),  # the model cannot hold the effects
    ],
)
def test_a_selection_is_repeated_until_it_selects_the_same_again(
    monkeypatch: pytest.MonkeyPatch, selections: list[str], kept: int, complete: bool
) -> None:
    """A selection counts as complete only if it equals the one before.

    Each small letter stands for an effect, and a capital one for an empirical term.
    """

    def selected(names: str) -> Any:
        curves = sum(map(str.isupper, names))
        estimates = [SimpleNamespace(candidate=SimpleNamespace(name=name)) for name in names]
        return SimpleNamespace(estimates=estimates, complexity=(curves, len(names) - curves))

    given: Any = None
    outcomes = [selected(names) if names else None for names in selections]
    left = iter(outcomes[1:])
    monkeypatch.setattr(nonlinear_refit, "_selected_at_fit", lambda *_: next(left))
    assert nonlinear_refit._relinearised(given, outcomes[0]) == (outcomes[kept], complete)
    assert next(left, None) is None


@pytest.mark.parametrize(("most_points", "limit"), [(10**6, 1), (10, None)])
def test_a_small_measurement_gets_one_thread_of_the_ray_tracer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most_points: int, limit: int | None
) -> None:
    write_scan(tmp_path, 10, step_rad=0.02)
    asked: list[int | None] = []

    def limited(most: int | None) -> Any:
        asked.append(most)
        raise InterruptedError

    monkeypatch.setattr(workflow, "_FEW_POINTS", most_points)
    monkeypatch.setattr(workflow, "limited_threads", limited)
    with pytest.raises(InterruptedError):
        workflow.diagnose(read_measurement(tmp_path))
    assert asked == [limit]
