"""The workflow of `scarpsim gap`: compute residuals, name effects, validate them, and measure the gap before and after."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pipeline.formats.measurements.checks import check_noise
from pipeline.formats.measurements.measurement import FILE, Measurement, StereoMeasurement, TlsMeasurement
from pipeline.gap.mean.detection_power import DetectableSize
from pipeline.gap.mean.selection import FamilyScore
from pipeline.gap.naming.candidate_families import model_has
from pipeline.gap.naming.effect_selection import NONPARAMETRIC_TERMS, SelectionResult
from pipeline.gap.naming.gap_score import Gap
from pipeline.gap.naming.named_effects import (
    NamedEffect,
    aligned_with,
    effect_from_edges,
    effect_from_losses,
    effect_from_tails,
    only_within_bounds,
)
from pipeline.gap.naming.selection_passes import PassInput, PassInputs, select_beside_edge_effects, subsample, subsample_rows
from pipeline.gap.naming.separating_measurements import with_separating_measurements
from pipeline.gap.naming.unseen_effects import unseen_effects
from pipeline.gap.naming.validation import Validation, ValidationResult
from pipeline.gap.naming.validation_scores import ValidatedEffects, describe_weakness, validate_effects
from pipeline.gap.naming.verdict import (
    Evidence,
    note_excess_noise,
    note_moved_wall,
    note_overdispersion,
    reduced_noise,
    verdict_of,
)
from pipeline.gap.noise_and_edges.disparity_edges import align_beside_fattening
from pipeline.gap.noise_and_edges.heavy_tails import HeavyTails, find_heavy_tails
from pipeline.gap.noise_and_edges.missing_returns import (
    LOSS_EFFECTS,
    LossExplanation,
    count_isolated_returns,
    explain_missing_returns,
)
from pipeline.gap.noise_and_edges.variance_model import VarianceScore
from pipeline.gap.residuals.alignment import align, compute_residuals, fit_pose_robustly
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.scene_changes import SceneChange, moved_share
from pipeline.gap.residuals.sensor_view import SensorView
from pipeline.gap.residuals.stereo_residuals import StereoResiduals, with_matches, with_surroundings
from pipeline.gap.residuals.subsampling import subsample_measurement
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals
from pipeline.gap.residuals.tls_residuals import TlsResiduals, find_expected_pulses, with_scan_order
from pipeline.gap.residuals.wall_blocks import BlockGrid, WallCells
from pipeline.gap.thresholds import Thresholds, thresholds, use_thresholds
from scene.common.backend import limited_threads
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.occlusion_fill import OcclusionFill
from sensors.models.sensor_model import StereoModel, TlsModel

STEPS = {"residuals": 3.0, "naming": 14.0, "validation": 2.0}
"""Steps of `diagnose`, and roughly how long each takes, s."""
_FEW_POINTS = 200_000
"""Most points for which the ray tracer gets one thread: its tasks are then so short that a second one would mostly wait."""
_DEFAULTS = Thresholds()
_LEAST_MODEL_SHARE = 0.1
"""Least share of its standard deviation that a model keeps where the reference error explains all of the noise."""


@dataclass(frozen=True)
class GapDiagnosis:
    """Result of a diagnosis: which sensor errors (effects) the sensor model lacks, and how much of its misfit they explain.

    Attributes
    ----------
    verdict : "no_gap" (model and measurement agree), "named", "several", "ambiguous", "unknown" (no effect explains the misfit)
        or "insufficient_data".
    effects : named effects, in the order of gap.json.
    changes : regions where the rock itself changed since the reference.
    residuals : residuals of the n points that were compared with the reference, measured minus predicted.
    held_out : (n,) true for validation points, which no fit used.
    before, after : (n,) residuals after registration, without and with the named effects in the model, in the unit of the
        observable: m for ranges and distances, px for disparities.
    pose : (6 k,) shift (m) and rotation (rad) of each of k set-ups from its surveyed pose, wall frame. For a surface without
        cameras: (q,) amounts of those combinations of shift, rotation and scale that its points determine, as the attribute
        `datum` of its residuals defines them.
    model_after : sensor model with the named effects.
    gap : scores of the model without and with the named effects; None if too few points could be scored.
    tried : scores of all systematic effects that were tried.
    variance_tried : scores of all noise terms that were tried.
    remaining : what the effects leave unexplained: p-value, noise and outliers, as the entry `remaining` of gap.json.
    identifiability : table with three keys: `names` of systematic effects; `cosines` between their signatures, the patterns of
        residuals that they make; and `survival`, the share of each signature that is left after the pose is fitted.
    timings : duration of each step by its name, s.
    unseen : effects that were not named, each with the size that would have shown with a probability of 95 %.
    reference_sigma : estimated standard deviation of the reference's correlated error, in the unit of the observable.
    thresholds : thresholds of the tests.
    """

    verdict: str
    effects: tuple[NamedEffect, ...]
    changes: tuple[SceneChange, ...]
    residuals: Residuals
    held_out: BoolArray
    before: FloatArray
    after: FloatArray
    pose: FloatArray
    model_after: TlsModel | StereoModel
    gap: Gap | None
    tried: tuple[FamilyScore, ...]
    variance_tried: tuple[VarianceScore, ...]
    remaining: dict[str, Any]
    identifiability: dict[str, Any]
    timings: dict[str, float]
    unseen: tuple[DetectableSize, ...] = ()
    reference_sigma: float = 0.0
    thresholds: Thresholds = _DEFAULTS

    @property
    def evidence(self) -> Evidence:
        """The numbers that decided the verdict: scores on validation points, p-value, noise, and share of points that moved."""
        keys = ("p_value", "spread", "far", "moved", "wide")  # in the order of the fields of Evidence
        return Evidence(self.gap, *(self.remaining[key] for key in keys))

    @property
    def seconds(self) -> float:
        """Duration of the whole diagnosis, s."""
        return sum(self.timings.values())

    @property
    def model_changed(self) -> bool:
        """Whether the diagnosis proposes another sensor model than the given one, with further effects or lower noise."""
        return bool(self.effects or self.remaining["lower_noise"])


def diagnose(
    measurement: Measurement,
    seed: int = 1,
    progress: Callable[[str], None] | None = None,
    thresholds: Thresholds = _DEFAULTS,
) -> GapDiagnosis:
    """Find where a measurement disagrees with its sensor model, and name the sensor errors (effects) that explain it.

    It also measures the gap: how much worse than noise explains the model fits, without and with these effects.

    Parameters
    ----------
    measurement : the measured points, with the reference surface and the sensor model to test.
    seed : start value of all random numbers.
    progress : called with the name of each step ("residuals", "naming", "validation") when it is done.
    thresholds : thresholds of the tests.

    Returns
    -------
    GapDiagnosis : verdict, effects, scores and everything else that the report shows.
    """
    clock, random = _Clock(progress), KeyedRandom(seed, ("gap",))
    few = len(measurement.cloud.points) <= _FEW_POINTS
    # one BLAS thread: results do not depend on the number of threads, and no threads wait for each other
    with use_thresholds(thresholds), threadpool_limits(1, "blas"), limited_threads(1 if few else None):
        part, rows = subsample_measurement(prepared(measurement), random.child("thinned"))
        found = _diagnose(part, clock, random)
    return replace(found, residuals=replace(found.residuals, index=rows[found.residuals.index]))


def prepared(measurement: Measurement) -> Measurement:
    """Return a copy of a measurement that stores what no pose changes: scan lines and times, or a stereo pair's disparities."""
    match measurement:
        case TlsMeasurement():
            return with_scan_order(measurement)
        case StereoMeasurement():
            return with_matches(measurement)
    return measurement


def _diagnose(measurement: Measurement, clock: _Clock, random: KeyedRandom) -> GapDiagnosis:
    """Run the steps of the workflow on the subsampled measurement."""
    inputs, surveyed = _aligned(measurement)
    aligned, plain = inputs.measurement, inputs.plain
    clock.lap("residuals")
    if plain.usable.sum() < thresholds().points.fewest:
        return _insufficient_data(measurement, plain, surveyed, clock)
    validated = _select_and_validate(inputs, random)
    clock.lap("naming")
    validation = _validation(inputs, validated, random)
    result = validation.validate(validated.named)
    given, selection = validated.given, validated.selection
    notes = [
        *selection.notes,
        *note_excess_noise(selection.unexplained_noise.at_most_one, validation.reduced_noise),
        *validated.words,
    ]
    evidence = _evidence(validated, result)
    notes = [*notes, *note_overdispersion(evidence, notes)]
    evidence = _with_moved_share(evidence, aligned, given, result)
    if evidence.much_moved:
        result = replace(validation, reduced_noise={}).validate([])
        notes = [*note_moved_wall(evidence, bool(aligned.stable_areas)), *selection.notes]
    findings_first = sorted(notes, key=lambda note: note in plain.notes)  # then what the data cannot show
    value = plain.value - plain.pose_jacobian @ validation.pose
    clock.lap("validation")
    return GapDiagnosis(
        verdict=verdict_of(result.named, evidence),
        effects=tuple(result.named),
        changes=tuple(given.changes),
        residuals=replace(plain, usable=given.residuals.usable),
        held_out=given.held_out,
        before=value,
        after=np.where(np.isfinite(result.value), result.value, value),
        pose=surveyed + result.pose,
        model_after=result.model,
        gap=result.gap,
        tried=selection.tried,
        variance_tried=selection.variance_tried,
        remaining=_remaining_entry(evidence, findings_first, result.reduced_noise),
        identifiability=selection.identifiability,
        timings=clock.laps,
        unseen=unseen_effects(plain, selection.detectable(), [item.name.partition(".")[2] for item in result.named]),
        reference_sigma=selection.reference_sigma,
        thresholds=thresholds(),
    )


def _aligned(measurement: Measurement) -> tuple[PassInputs, FloatArray]:
    """Estimate the pose, compute the residuals and choose the validation points; return these, and the pose."""
    measurement.check_near(FILE)
    initial = compute_residuals(measurement)
    check_noise("surface" if isinstance(initial, SurfaceResiduals) else initial.sensor, initial.sigma)
    held_out_points, blocks = np.zeros(len(measurement.cloud.points), dtype=bool), WallCells.over(initial.wall_xy).blocks
    held_out_points[initial.index] = blocks.for_validation(initial.wall_xy)
    held_out_points |= _in_validation_epoch(measurement.epochs)
    trusted = initial.index[~held_out_points[initial.index]]
    found = align(measurement, trusted, initial)
    if isinstance(measurement, StereoMeasurement) and isinstance(initial, StereoResiduals):
        found = align_beside_fattening(measurement, initial, found, trusted)
    aligned, plain, pose = found
    if isinstance(aligned, StereoMeasurement) and isinstance(plain, StereoResiduals):
        aligned = with_surroundings(aligned, plain)
    if isinstance(aligned, TlsMeasurement) and isinstance(plain, TlsResiduals):
        plain = replace(plain, expected_pulses=find_expected_pulses(aligned, plain))
    return PassInputs(aligned, plain, held_out_points, blocks), pose


def _evidence(validated: _ValidatedSelection, result: ValidationResult) -> Evidence:
    """Return the numbers that decide the verdict, but for the share of the wall that moved."""
    noise, tails = validated.selection.unexplained_noise, validated.tails
    return Evidence(
        result.gap,
        validated.selection.p_value_given(result.named),
        noise.at_most_one,
        tails.share if tails is not None and tails.uniform else 0.0,
        overdispersion=1.0 if any(item.adds_variance for item in result.named) else noise.value,
    )


def _validation(inputs: PassInputs, validated: _ValidatedSelection, random: KeyedRandom) -> Validation:
    """Prepare the scores on the validation points of a selection."""
    given, selection, plain = validated.given, validated.selection, inputs.plain
    share = _share_of_model_noise(selection.unexplained_noise.at_most_one, plain)
    return Validation(
        measurement=inputs.measurement,
        residuals=plain,
        registration_rows=given.training_rows,
        tested=given.measurable & given.held_out,
        training=given.measurable & ~given.held_out,
        losses=validated.losses,
        reference_sigma=selection.reference_sigma,
        most_sigmas=thresholds().points.outlier_sigmas * given.noise_ratio,
        random=random,
        reduced_noise=reduced_noise(inputs.measurement.model, share),
    )


def _has_alternatives(inputs: PassInputs, dropped: Sequence[NamedEffect]) -> bool:
    """Whether a term among the dropped effects is empirical and no noise, and the catalogue has effects to try instead."""
    curves = any(item.kind == "empirical" and not item.adds_variance for item in dropped)
    return curves and any(not each.empirical for each in inputs.plain.candidates)


def _share_of_model_noise(share: float, residuals: Residuals) -> float:
    """Convert a ratio of the predicted standard deviation to one of the model's own, which excludes the reference error."""
    if share >= 1 or not isinstance(residuals, TlsResiduals) or not residuals.reference_error_m:
        return share
    whole, reference = float(np.median(residuals.sigma**2)), float(np.median(residuals.reference_variance))
    own = max(whole - reference, _LEAST_MODEL_SHARE**2 * whole)
    return float(np.sqrt(max(share**2 * whole - reference, _LEAST_MODEL_SHARE**2 * own) / own))


def _with_moved_share(evidence: Evidence, aligned: Measurement, given: PassInput, result: ValidationResult) -> Evidence:
    """Add the share of the wall that moved, if that may be why nothing closes the gap."""
    if verdict_of(result.named, evidence) != "unknown" or (result.named and not evidence.closes_little):
        return evidence
    after = replace(given.residuals, value=result.value)
    return replace(evidence, moved_share=moved_share(after, SensorView.of(aligned, after), given.stable))


def _in_validation_epoch(epochs: NDArray[np.int64]) -> BoolArray:
    """(n,) points of the last epoch, if there are enough epochs to keep it for validation."""
    last = int(epochs.max(initial=0))
    return epochs == last if last + 1 >= thresholds().points.fewest_epochs else np.zeros(len(epochs), dtype=bool)


@dataclass(frozen=True)
class _ValidatedSelection:
    """The chosen selection pass with the effects that passed validation.

    Attributes
    ----------
    given : input of the pass.
    selection : what the selection left beside the effects.
    losses : explanation of the missing returns, and the pulses that it was not fitted to.
    named : accepted effects, with the measurement that would separate each class.
    tails : heavy tails of the residuals, if any.
    words : notes on dropped effects.
    """

    given: PassInput
    selection: SelectionResult
    losses: tuple[LossExplanation, BoolArray] | None
    named: list[NamedEffect]
    tails: HeavyTails | None
    words: list[str]


def _select_and_validate(
    inputs: PassInputs, random: KeyedRandom, excluded: frozenset[tuple[str, bool]] = frozenset()
) -> _ValidatedSelection:
    """Select effects and validate them. If an empirical term fails, the selection is repeated without empirical terms."""
    best, aligned = select_beside_edge_effects(inputs, random, excluded), inputs.measurement
    given, selection = best.pass_input, best.selection
    losses = _explain_losses(aligned, given, inputs.blocks)
    lost = [effect_from_losses(losses[0], aligned.cloud.intensity)] if losses else []
    named = sorted([*best.named, *map(effect_from_edges, given.edge_effects), *lost], key=lambda item: -item.gain)
    named, words = only_within_bounds(aligned.model, named)
    scored = _validate(aligned, given, named, selection.reference_sigma, inputs.blocks).with_needed(selection)
    words += [f"{item.name} dropped: it does not improve the validation blocks" for item in scored.failed]
    if NONPARAMETRIC_TERMS not in excluded and _has_alternatives(inputs, scored.failed):
        again = _select_and_validate(inputs, random, excluded | {NONPARAMETRIC_TERMS})
        if again.named:
            return replace(again, words=[*words, *(each for each in again.words if each not in words)])
    words += [f"{item.name} mentioned but not named: beside the other effects {describe_weakness(item)}" for item in scored.weak]
    rows_of_tails = subsample_rows(np.flatnonzero(given.stable & ~given.held_out))
    fewer, _ = subsample(aligned, given.residuals, rows_of_tails)
    found, tails = _with_heavy_tails(fewer, scored.named, inputs.blocks)
    words += [tails.note] if tails else []
    return _ValidatedSelection(given, selection, losses, with_separating_measurements(aligned, found), tails, words)


def _validate(
    aligned: Measurement, given: PassInput, named: list[NamedEffect], reference_sigma: float, blocks: BlockGrid
) -> ValidatedEffects:
    """Score the effects on the validation points."""
    tested = subsample_rows(np.flatnonzero(given.stable & given.held_out))
    rows = np.concatenate([given.training_rows, tested])
    training = np.arange(len(rows)) < len(given.training_rows)
    part = subsample(aligned, given.residuals, rows)
    return validate_effects(*part, named, training, reference_sigma, blocks)


def _with_heavy_tails(
    measurement: Measurement, named: list[NamedEffect], blocks: BlockGrid
) -> tuple[list[NamedEffect], HeavyTails | None]:
    """Add heavy tails to the named effects if outliers lie all over the wall.

    Only two effects of the catalogue make such tails, and then nothing is added: filled occlusions, whose strips include cells
    without a match, and drops that return early. A noise term is kept beside heavy tails if the core of the residuals has more
    variance than predicted.
    """
    if any(item.effect is OcclusionFill or item.entry.get("early_share") for item in named):
        return named, None
    part, value, scale = _smooth_residuals_with(measurement, named)
    tails = find_heavy_tails(value / part.sigma / scale, blocks.numbers(part.wall_xy))
    if tails is None or not tails.uniform or not tails.sigma:
        return named, tails
    total = scale**2 * (1 + tails.sigma**2) * np.median(part.sigma) ** 2
    without_noise = [item for item in named if not item.adds_variance]
    if len(without_noise) < len(named):
        part, _, core_noise_ratio = _smooth_residuals_with(measurement, without_noise)
        if core_noise_ratio**2 - 1 > thresholds().variance.least_excess:
            return named, tails
    heavy = effect_from_tails(part, float(np.sqrt(total - np.median(part.sigma) ** 2)), tails.gain)
    return [*without_noise, *only_within_bounds(measurement.model, [heavy])[0]], tails


def _smooth_residuals_with(measurement: Measurement, named: list[NamedEffect]) -> tuple[Residuals, FloatArray, float]:
    """Return the residuals on smooth rock with some effects in the model.

    Returns
    -------
    The residuals, their registered values (n,), and their noise over the predicted one.
    """
    found = aligned_with(measurement, named).residuals
    part = found.part(np.flatnonzero(found.usable))
    value, _, scale = fit_pose_robustly(part)
    return part, value, scale


class _Clock:
    """Measures how long each step takes, and reports the steps that are done."""

    def __init__(self, report: Callable[[str], None] | None) -> None:
        self._last, self._report = time.perf_counter(), report
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        """End a step."""
        now = time.perf_counter()
        self.laps[name], self._last = now - self._last, now
        if self._report is not None:
            self._report(name)


def _remaining_entry(evidence: Evidence, notes: list[str], lower_noise: dict[str, float]) -> dict[str, Any]:
    """Return the entry `remaining` of gap.json: what the named effects leave unexplained.

    Its numbers are those of `Evidence`; lower_noise holds noise values that fit.
    """
    return {
        "p_value": evidence.p_value,
        "note": "; ".join(notes),
        "spread": evidence.noise_ratio,
        "far": evidence.outlier_share,
        "moved": evidence.moved_share,
        "wide": evidence.overdispersion,
        "lower_noise": lower_noise,
    }


def _insufficient_data(measurement: Measurement, residuals: Residuals, pose: FloatArray, clock: _Clock) -> GapDiagnosis:
    """Return the diagnosis of a measurement with too few points. pose: the estimated one, as in the diagnosis."""
    count, least = int(residuals.usable.sum()), thresholds().points.fewest
    note = f"{count} points on smooth parts of the reference and stable ground, but {least} are needed"
    empty = np.zeros(len(residuals))
    return GapDiagnosis(
        "insufficient_data", (), (), residuals, empty > 1, residuals.value, residuals.value, pose, measurement.model,
        None, (), (), _remaining_entry(Evidence(None, None), [note], {}), {"names": [], "cosines": [], "survival": []},
        clock.laps, thresholds=thresholds(),
    )  # fmt: skip


def _explain_losses(measurement: Measurement, given: PassInput, blocks: BlockGrid) -> tuple[LossExplanation, BoolArray] | None:
    """Explain the missing returns, with the pulses that the explanation was not fitted to."""
    residuals = given.residuals
    missing = residuals.expected_pulses
    if missing is None or any(model_has(measurement, name) for name in LOSS_EFFECTS):
        return None
    held_out = blocks.for_validation(missing.wall_xy)
    early = residuals.usable & ~given.changed & (given.registered_residuals < -thresholds().missing_returns.early_m)
    drops = count_isolated_returns(residuals.wall_xy, early)
    found = explain_missing_returns(missing, ~held_out, drops, len(residuals), measurement.cloud.intensity)
    return None if found is None else (found, held_out)
