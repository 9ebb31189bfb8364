"""Large effects, for which linearised effects are wrong by half, and prior knowledge of an effect's size."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from gap_cases import write_scan

from benchmarks.gap_closed_form import stereo_cases
from benchmarks.gap_closed_form.cases import Case, make
from benchmarks.gap_closed_form.strength import Strength, Target
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.mean.design import Design
from pipeline.gap.mean.mean_model import MeanModel, fit_reml
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.naming import nonlinear_refit
from pipeline.gap.naming.candidate_families import candidate_families
from pipeline.gap.naming.effect_screening import screen_effects
from pipeline.gap.naming.named_effects import NamedEffect, effect_from_estimate
from pipeline.gap.naming.nonlinear_refit import (
    _screened_single_fits,
    _strongest_single_fits,
    _with_equivalence_class,
    select_and_refit,
    with_classes_at_fit,
)
from pipeline.gap.naming.search_outcome import SearchInput, SearchOutcome
from pipeline.gap.naming.search_residuals import with_fitted_variance
from pipeline.gap.naming.selection_passes import PassInput, PassInputs
from pipeline.gap.naming.validation_scores import describe_weakness, validate_effects
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.residuals.alignment import align
from pipeline.gap.residuals.wall_blocks import BlockGrid, WallCells
from pipeline.gap.thresholds import Thresholds, use_thresholds
from scene.common.keyed_random import KeyedRandom


class _Strong(Target):
    """Draws effects as large as the generator allows."""

    @classmethod
    def draw(cls, random: np.random.Generator) -> Target:
        return Target(400.0, own=False)


@pytest.mark.parametrize("kind", ["camera_phi", "camera_omega"])
def test_a_large_turn_of_a_camera_is_one_effect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """A camera rotation of some milliradians, which moves the registered pair by metres, is named alone.

    The linearised model gives half of the angle, and adds other effects for the rest.
    """
    monkeypatch.setattr(stereo_cases, "Target", _Strong)
    make(Case(0, (3, 1), "one", "stereo", (kind,), 4_000, 4_000), tmp_path / "case", tmp_path / "truth.json", baselines=False)
    (truth,) = json.loads((tmp_path / "truth.json").read_text())["effects"]
    found = diagnose(read_measurement(tmp_path / "case"))
    (effect,) = found.effects
    assert f"stereo.{kind}" in {effect.name, *effect.indistinguishable}
    if effect.name == f"stereo.{kind}" and effect.entry["camera"] == truth["parameters"]["camera"]:
        error = effect.entry["angle_rad"] - truth["parameters"]["angle_rad"]
        assert abs(error) < max(4 * effect.std["angle_rad"], 0.02 * abs(truth["parameters"]["angle_rad"]))
    assert found.gap is not None
    assert (found.gap.closed or 0.0) > 0.9


def test_whose_principal_point_is_off_shows_with_it_in_the_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error of 10 px is attributed to the camera that has it, once the effect is in the model.

    It rotates the registered pair by some milliradians. The linearised model attributes it to the other camera, and adds a focal
    length for the rest.
    """
    monkeypatch.setattr(stereo_cases, "Target", _Strong)
    make(
        Case(0, (77, 1), "one", "stereo", ("principal_point_x",), 4_000, 4_000),
        tmp_path / "case",
        tmp_path / "truth.json",
        baselines=False,
    )
    (truth,) = json.loads((tmp_path / "truth.json").read_text())["effects"]
    (effect,) = diagnose(read_measurement(tmp_path / "case")).effects
    assert effect.name == "stereo.principal_point_x"
    assert effect.entry["camera"] == truth["parameters"]["camera"]
    assert effect.entry["delta_px"] == pytest.approx(truth["parameters"]["delta_px"], abs=4 * effect.std["delta_px"])


@pytest.fixture(scope="module")
def turned_and_zoomed(tmp_path_factory: pytest.TempPathFactory) -> tuple[SearchInput, dict[str, dict[str, Any]]]:
    """The search input of a pair with two large errors, and the parameters of both.

    One camera is rotated by 4 mrad, and a focal length is wrong by 8 px.
    """
    folder = tmp_path_factory.mktemp("large")
    kinds = ("camera_kappa", "focal_length")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(stereo_cases, "Target", _Strong)
        make(Case(0, (9241, 310), "two", "stereo", kinds, 3_000, 3_000), folder / "case", folder / "truth.json", baselines=False)
    truth = {each["name"]: each["parameters"] for each in json.loads((folder / "truth.json").read_text())["effects"]}
    there, residuals, _ = align(read_measurement(folder / "case"))
    part = residuals.part(residuals.usable)
    there, part = there.part(part.index), replace(part, index=np.arange(residuals.usable.sum()))
    return SearchInput(there, part, candidate_families(there, part), lambda _: [], 0.0, KeyedRandom(1)), truth


def test_the_class_of_an_effect_taken_exactly_is_by_exact_likelihoods(
    turned_and_zoomed: tuple[SearchInput, dict[str, dict[str, Any]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The equivalence class of a refitted effect contains the refitted effects within the margin.

    With any margin these are all that were refitted. With none, only those remain that the linearised search put there and that
    were not refitted.
    """
    points, _ = turned_and_zoomed
    first = MeanSearch(with_fitted_variance(points.part, [], 1.0), points.families, KeyedRandom(1))
    screened = _screened_single_fits(points, first, _strongest_single_fits(points, first, first.select()[0]))
    assert len({each.name for each in screened}) == len(screened)
    assert [each.score for each in screened] == sorted((each.score for each in screened), reverse=True)
    classes = {}
    for margin in (0.0, 1e9):
        monkeypatch.setattr(nonlinear_refit, "equivalence_margin", lambda _, margin=margin: margin)
        one = _with_equivalence_class(_strongest_single_fits(points, first, first.select()[0]))
        classes[margin] = set(effect_from_estimate(one.estimates[0], points.part).indistinguishable)
    exactly = classes[1e9] - classes[0.0]
    assert len(exactly) == 2
    assert f"stereo.{one.name}" not in classes[1e9]


def test_slopes_do_not_serve_where_what_they_miss_is_as_much_as_something_gains(
    turned_and_zoomed: tuple[SearchInput, dict[str, dict[str, Any]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first effect is fitted exactly only if its linearisation is poor.

    Poor means that its error is as large as the gain of a weak second effect.
    """
    points, _ = turned_and_zoomed
    first = MeanSearch(with_fitted_variance(points.part, [], 1.0), points.families, KeyedRandom(1))
    chosen = first.select()[0]
    (leading, *_) = _strongest_single_fits(points, first, chosen)
    # beside other effects, the points that the refit leaves out count too
    one, two = (
        abs(leading.log_likelihood - first.design.log_likelihood(np.where(used, points.part.value, 0.0), leading.candidates))
        for used in (leading.used, np.ones_like(leading.used))
    )
    monkeypatch.setattr(first, "leading_effects", lambda: leading.candidates)
    monkeypatch.setattr(nonlinear_refit, "_single_fit", lambda *_: leading)
    monkeypatch.setattr(nonlinear_refit, "_best_variants", lambda *_: [leading])

    def refitted(wrong_by: float, *ratios: float) -> bool:
        mean = Thresholds().mean.model_copy(update={"class_margin": 2 * wrong_by})
        with use_thresholds(Thresholds().model_copy(update={"mean": mean})):
            selected = [replace(chosen[0], log_likelihood_ratio=ratio * wrong_by) for ratio in ratios]
            return bool(_strongest_single_fits(points, first, selected))

    assert not refitted(one, 3)
    assert refitted(one, 1.5)
    assert not refitted(two, 3, 3)
    assert refitted(two, 3, 1.5)


def test_effects_are_tried_one_by_one_where_several_weak_ones_seem_needed(
    turned_and_zoomed: tuple[SearchInput, dict[str, dict[str, Any]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The explanation so found replaces the linear one only if it has fewer effects."""
    points, _ = turned_and_zoomed
    first = MeanSearch(with_fitted_variance(points.part, [], 1.0), points.families, KeyedRandom(1))
    chosen = first.select()[0]
    assert len(chosen) > 1
    monkeypatch.setattr(first, "leading_effects", list)
    assert _strongest_single_fits(points, first, chosen[:1]) is None
    assert _strongest_single_fits(points, first, chosen) == []
    tried: list[SearchOutcome] = []

    def beside_best(given: SearchInput, linear: SearchOutcome, alone: list[Any]) -> SearchOutcome:
        assert given is points
        assert alone
        tried.append(replace(linear, estimates=linear.estimates[: len(linear.estimates) - fewer]))
        return tried[-1]

    monkeypatch.setattr(nonlinear_refit, "_search_beside_best", beside_best)
    monkeypatch.setattr(nonlinear_refit, "_search_beside", lambda *_: None)
    monkeypatch.setattr(nonlinear_refit, "_relinearised", lambda _, linear: (replace(linear, chosen=[]), False))
    for fewer in (0, 1):
        found = select_and_refit(points, first)
        assert (found is tried[-1]) == (fewer > 0)


def _explanation(physical: int, empirical: int) -> Any:
    """Return an explanation with the given numbers of effects of the catalogue and of empirical terms."""
    kinds = [False] * physical + [True] * empirical
    estimates = [SimpleNamespace(candidate=SimpleNamespace(empirical=each)) for each in kinds]
    return SimpleNamespace(
        chosen=estimates, estimates=estimates, complexity=(empirical, len(kinds)), leaves_more_misfit_than=lambda _: False
    )


def test_two_large_effects_are_found_with_the_derivatives_at_the_fitted_model(
    turned_and_zoomed: tuple[SearchInput, dict[str, dict[str, Any]]],
) -> None:
    """With the derivatives at the model without effects, a third effect is selected beside the two."""
    points, _ = turned_and_zoomed
    first = MeanSearch(with_fitted_variance(points.part, [], 1.0), points.families, KeyedRandom(1))
    assert len(first.select()[0]) > 2
    found = {each.candidate.name for each in select_and_refit(points, first).estimates}
    assert found in ({"focal_length", name} for name in ("camera_kappa", "affinity_skew"))  # a turn is a skew


def test_an_effect_gets_its_class_beside_those_that_were_found_later(
    turned_and_zoomed: tuple[SearchInput, dict[str, dict[str, Any]]],
) -> None:
    """Beside the focal length, a turn of an image fits about as well as a skew, and a shift of the camera fits worse."""
    points, _ = turned_and_zoomed
    first = MeanSearch(with_fitted_variance(points.part, [], 1.0), points.families, KeyedRandom(1))
    found, earlier = select_and_refit(points, first), ("camera_kappa", "camera_shift")
    before = [replace(each, chosen=replace(each.chosen, indistinguishable=earlier)) for each in found.estimates]
    found_later = with_classes_at_fit(points, replace(found, chosen=found.chosen[:1], estimates=before)).estimates
    alike = {each.candidate.name: {each.candidate.name, *each.chosen.indistinguishable} for each in found_later}
    assert alike.pop("focal_length") == {"focal_length"}
    assert list(alike.values()) == [{"camera_kappa", "affinity_skew"}]
    found_at_once = replace(found, estimates=before)
    assert with_classes_at_fit(points, found_at_once) is found_at_once


@pytest.mark.parametrize(
    ("best", "other", "ties", "searched", "other_wins"),
    [
        ((2, 0), (1, 1), False, True, False),  # its empirical term might have gone
        ((2, 0), (2, 0), False, False, False),
        ((2, 0), (2, 0), True, True, True),
        ((2, 0), (3, 0), True, False, False),
        ((1, 1), (2, 0), False, True, True),
        (None, (3, 1), False, True, True),
    ],
)
def test_no_effects_are_searched_beside_an_explanation_that_cannot_be_simpler(
    best: tuple[int, int] | None,
    other: tuple[int, int],
    ties: bool,
    searched: bool,
    other_wins: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each explanation is given by two numbers: of its effects of the catalogue, and of its empirical terms."""
    tried: list[Any] = []
    monkeypatch.setattr(nonlinear_refit, "_search_beside", lambda _, outcome: tried.append(outcome))
    monkeypatch.setattr(nonlinear_refit, "_within_bounds", lambda *_: True)
    known, second, nothing = None if best is None else _explanation(*best), _explanation(*other), cast(Any, None)
    assert nonlinear_refit._simpler(nothing, known, second, ties) is (second if other_wins else known)
    assert tried == [second] * searched


def test_the_effect_that_leaves_the_least_noise_ranks_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A principal point is off by 8 px; with it in the model, the residuals are as small as the noise again.

    Fewer points count as outliers beside it, so that it is a large effect if as few as 1 % make the search look for one.
    """
    drawn = [("principal_point_x", {"camera": "left", "delta_px": 8.0}, Strength(0.0, "", 0.0))]
    monkeypatch.setattr(stereo_cases, "_drawn", lambda *_: drawn)
    case = Case(0, (1, 5), "one", "stereo", ("principal_point_x",), 2_000, 2_000)
    make(case, tmp_path / "case", tmp_path / "truth.json", baselines=False)
    there, residuals, _ = align(read_measurement(tmp_path / "case"))
    part = residuals.part(residuals.usable)
    search = MeanSearch(part, candidate_families(there, part), KeyedRandom(1))
    tried = [each for each in search.effect_variants() if each.name in {"principal_point_x", "focal_length", "radial_distortion"}]
    assert len(tried) == 9  # each in the left camera, in the right one and in both
    best = {each.name: each for each in search.score_families(())}
    for each in tried:
        lead = best[each.name].score - search.score_alone(each)
        assert lead == pytest.approx(0.0) if each is best[each.name].candidate else lead > 0
    ranked = screen_effects(there, part, tried[::-1], 9)
    assert {(each.candidate.name, each.candidate.fixed["camera"]) for each in ranked[:2]} == {
        ("principal_point_x", "left"),
        ("principal_point_x", "right"),
    }
    inputs = PassInputs(there, residuals, np.zeros(len(there.cloud.points), dtype=bool), BlockGrid(np.zeros(2), 1.0))
    without = PassInput.of(there, residuals, inputs.held_out_points, []).excluded_share
    with use_thresholds(_with_moved_share(0.01)):
        assert inputs.large_effect is not None
        assert inputs.with_these([]).excluded_share < without / 2
    assert inputs.large_effect.name == "stereo.principal_point_x"
    size = inputs.large_effect.entry
    assert size["delta_px"] == pytest.approx({"left": 8.0, "right": -8.0}[size["camera"]], abs=0.2)


def test_rock_that_moved_is_no_large_effect(tmp_path: Path) -> None:
    """Every eighth point lies 1 m further away, which no effect of the sensor explains."""
    write_scan(tmp_path, 8, step_rad=0.007, ranges=lambda scan: scan.R + 1.0 * (np.arange(len(scan.R)) % 8 == 0))
    there, residuals, _ = align(read_measurement(tmp_path))
    inputs = PassInputs(there, residuals, np.zeros(len(there.cloud.points), dtype=bool), BlockGrid(np.zeros(2), 1.0))
    assert PassInput.of(there, residuals, inputs.held_out_points, []).excluded_share > 0.1
    with use_thresholds(_with_moved_share(0.1)):
        assert inputs.large_effect is None


def _with_moved_share(share: float) -> Thresholds:
    changes = Thresholds().changes.model_copy(update={"moved_share": share})
    return Thresholds().model_copy(update={"changes": changes})


def test_what_is_known_before_shrinks_a_coefficient_as_bayes_says() -> None:
    """The estimate is (x'x + k)^-1 x'y, with that inverse as variance.

    There is one column, equal for all points of a cell, and white noise; k is the precision of the prior.
    """
    rng = np.random.default_rng(1)
    at = rng.uniform(0, 20, (4000, 2))
    cells = WallCells.over(at)
    model = MeanModel(cells, at, np.full(4000, 0.5))
    x, y = rng.standard_normal((len(cells), 1))[cells.cell], rng.standard_normal((4000, 1))
    columns, value = (model.project(each[model.rows] / 0.5) for each in (x, y))
    white = [each for each in model.covariances if each.variance_ratio == 0.0]
    gram = float((x[model.rows] ** 2).sum()) / 0.25
    right = float((x[model.rows] * y[model.rows]).sum()) / 0.25
    for known in (0.0, gram, 100 * gram):
        found = fit_reml(white, columns, value, np.array([[known]]))
        assert found.coefficients[0] == pytest.approx(right / (gram + known), rel=1e-6)
        assert found.covariance[0, 0] == pytest.approx(1 / (gram + known), rel=1e-6)


def test_what_is_known_of_one_effect_holds_beside_another(tmp_path: Path) -> None:
    """The prior of one effect also acts when another is fitted beside it.

    A column about which the data say almost nothing (prior standard deviation 0.2) overlaps with one that the data determine.
    """
    write_scan(tmp_path, 8, ranges=lambda scan: scan.R + 0.01 * (1 / scan.cos_i - 1), step_rad=0.012)
    there, residuals, _ = align(read_measurement(tmp_path))
    part = residuals.part(residuals.usable)
    families = candidate_families(there, part)
    bias = next(each for each in families if isinstance(each, Candidate) and each.name == "range_incidence_bias")
    rng = np.random.default_rng(1)
    faint = 1e-7 * (bias.columns[:, :1] + rng.standard_normal((len(part), 1)))
    precision = np.concatenate([np.zeros(6), [25.0]])
    design = Design.of(
        replace(part, pose_jacobian=np.concatenate([part.pose_jacobian, faint], axis=1)), families, KeyedRandom(1), precision
    )
    found = design.fit([bias])
    assert abs(found.coefficients[6]) < 0.01
    assert found.covariance[6, 6] == pytest.approx(0.2**2, rel=1e-3)
    assert found.coefficients[7] == pytest.approx(0.01, abs=5 * np.sqrt(found.covariance[7, 7]))


def test_an_effect_that_is_not_there_fails_on_blocks_that_were_held_out(tmp_path: Path) -> None:
    """The ranges grow with the incidence angle; a scale error of nine parts in 10,000 is also named, but is not there."""
    write_scan(tmp_path, 8, ranges=lambda scan: scan.R + 0.01 * (1 / scan.cos_i - 1), step_rad=0.007)
    there, residuals, _ = align(read_measurement(tmp_path))
    blocks = WallCells.over(residuals.wall_xy).blocks
    trained = ~blocks.for_validation(residuals.wall_xy)
    true, wrong = (
        NamedEffect(f"tls.{name}", "physical", {"name": name, key: value}, {}, (), 0.001, 10.0)
        for name, key, value in (("range_incidence_bias", "coefficient_m", 0.01), ("range_scale", "scale_ppm", 900.0))
    )
    scored = validate_effects(there, residuals, [wrong, true], trained, 0.0004, blocks)
    assert [item.name for item in scored.failed] == ["tls.range_scale"]
    assert [item.name for item in scored.named] == ["tls.range_incidence_bias"]
    assert scored.named[0].gain > 50


def test_an_effect_from_which_few_blocks_gain_is_only_mentioned_beside_others(tmp_path: Path) -> None:
    """The ranges grow with the incidence angle; a scale error of 1 ppm, which cannot be told from zero, is also named."""
    write_scan(tmp_path, 8, ranges=lambda scan: scan.R + 0.01 * (1 / scan.cos_i - 1), step_rad=0.007)
    there, residuals, _ = align(read_measurement(tmp_path))
    blocks = WallCells.over(residuals.wall_xy).blocks
    trained = ~blocks.for_validation(residuals.wall_xy)
    true, slight = (
        NamedEffect(f"tls.{name}", "physical", {"name": name, key: value}, {}, (), 0.001, 10.0)
        for name, key, value in (("range_incidence_bias", "coefficient_m", 0.01), ("range_scale", "scale_ppm", 1.0))
    )
    both = validate_effects(there, residuals, [true, slight], trained, 0.0004, blocks)
    assert [item.name for item in both.named] == ["tls.range_incidence_bias"]
    assert [item.name for item in both.weak] == ["tls.range_scale"]
    assert 0 < both.weak[0].gain < 2


@pytest.mark.parametrize(("amplitude_m", "named"), [(0.0004, False), (0.004, True)])
def test_a_curve_beside_an_effect_that_gains_a_hundred_times_as_much_is_only_mentioned(
    tmp_path: Path, amplitude_m: float, named: bool
) -> None:
    """The ranges grow with the incidence angle by centimetres, and by a wave, of 0.4 mm or 4 mm, that a curve describes."""
    incidence = np.linspace(0.0, 1.4, 141)
    wave = amplitude_m * np.sin(9 * incidence)
    write_scan(
        tmp_path,
        8,
        step_rad=0.007,
        ranges=lambda scan: scan.R + 0.05 * (1 / scan.cos_i - 1) + amplitude_m * np.sin(9 * np.arccos(scan.cos_i)),
    )
    there, residuals, _ = align(read_measurement(tmp_path))
    blocks = WallCells.over(residuals.wall_xy).blocks
    curve = {"name": "range_empirical", "covariate": "incidence", "along": {"low": 0.0, "high": 1.4}, "values_m": [wave.tolist()]}
    bias = {"name": "range_incidence_bias", "coefficient_m": 0.05}
    effects = [
        NamedEffect("tls.range_incidence_bias", "physical", bias, {}, (), 0.001, 9.0),
        NamedEffect("tls.range_empirical", "empirical", curve, {}, (), 0.001, 9.0),
    ]
    scored = validate_effects(there, residuals, effects, ~blocks.for_validation(residuals.wall_xy), 0.0004, blocks)
    assert not scored.failed
    assert [item.name for item in scored.named] == ["tls.range_incidence_bias", "tls.range_empirical"][: 1 + named]
    assert [item.name for item in scored.weak] == ["tls.range_empirical"][: not named]
    assert all("less than 1 % of what the strongest effect gains" in describe_weakness(item) for item in scored.weak)
    limit = NamedEffect("tls.detection_limit", "physical", {"name": "detection_limit", "minimum_power": 1e-9}, {}, (), None, 1e6)
    beside_losses = validate_effects(
        there, residuals, [effects[1], limit], ~blocks.for_validation(residuals.wall_xy), 0.0004, blocks
    )
    assert not beside_losses.weak, "lost returns move no point"


def test_of_two_curves_with_one_name_only_the_wrong_one_fails(tmp_path: Path) -> None:
    """The ranges grow with the incidence angle, as one curve says; the other one moves ranges where there is no error."""
    write_scan(tmp_path, 8, ranges=lambda scan: scan.R + 0.01 * (1 / scan.cos_i - 1), step_rad=0.007)
    there, residuals, _ = align(read_measurement(tmp_path))
    blocks = WallCells.over(residuals.wall_xy).blocks
    incidence = np.linspace(0.0, 1.4, 141)
    shapes = (0.01 * (1 / np.cos(incidence) - 1), 0.003 * np.sin(9 * incidence))
    along = {"covariate": "incidence", "along": {"low": 0.0, "high": 1.4}}
    entries = [{"name": "range_empirical", **along, "values_m": [shape.tolist()]} for shape in shapes]
    true, wrong = (NamedEffect("tls.range_empirical", "empirical", entry, {}, (), 0.001, 9.0) for entry in entries)
    scored = validate_effects(there, residuals, [true, wrong], ~blocks.for_validation(residuals.wall_xy), 0.0004, blocks)
    assert [item.entry for item in scored.named] == [true.entry]
    assert [item.entry for item in scored.failed] == [wrong.entry]
