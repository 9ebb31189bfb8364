"""The four steps of `scarpsim gap`: locate, name, add, show."""

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
from pipeline.gap.mean.selection import Tried
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
from pipeline.gap.naming.selection_passes import PassInput, PassInputs, best_pass, subsample, subsample_rows
from pipeline.gap.naming.separating_measurements import with_separating_measurements
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
from pipeline.gap.noise_and_edges.missing_returns import (
    LOSS_EFFECTS,
    LossExplanation,
    count_isolated_returns,
    explain_missing_returns,
)
from pipeline.gap.noise_and_edges.variance_model import HeavyTails, VarianceScore, find_heavy_tails
from pipeline.gap.residuals.cells import Cells, block_numbers, held_out_blocks
from pipeline.gap.residuals.changes import SceneChange, moved_share
from pipeline.gap.residuals.registration import registered, residuals_of, settled
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.sight import Sight
from pipeline.gap.residuals.stereo_residuals import StereoResiduals, with_surroundings
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals
from pipeline.gap.residuals.thinning import thinned
from pipeline.gap.residuals.tls_residuals import TlsResiduals, missing_returns, with_order
from pipeline.gap.thresholds import Thresholds, thresholds, use_thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.occlusion_fill import OcclusionFill
from sensors.models.sensor_model import StereoModel, TlsModel

STEPS = {"residuals": 3.0, "naming": 14.0, "verification": 2.0}
"""The steps of `diagnose` and about what each takes, s."""
_DEFAULTS = Thresholds()
_LEAST_MODEL_SHARE = 0.1
"""Of its standard deviation that a model keeps where the reference's error explains all of the spread."""


@dataclass(frozen=True)
class GapDiagnosis:
    """What was found.

    held_out: (n,) points never used in naming; before, after: (n,) residuals with registration taken off, in the observable's
    unit; pose: (6 k,) shift (m) and turn (rad) of the sensor in k set-ups, wall frame; timings: s by step; thresholds: what was
    decided by.
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
    tried: tuple[Tried, ...]
    spread_tried: tuple[VarianceScore, ...]
    remaining: dict[str, Any]
    identifiability: dict[str, Any]
    seconds: float
    timings: dict[str, float]
    thresholds: Thresholds = _DEFAULTS

    @property
    def evidence(self) -> Evidence:
        """The numbers that the verdict and its words rest on."""
        numbers = {name: self.remaining[name] for name in ("p_value", "spread", "far", "moved", "wide")}
        return Evidence(self.gap, **numbers)

    @property
    def mended(self) -> bool:
        """Whether the model after is another one than before."""
        return bool(self.effects or self.remaining["lower_noise"])


def diagnose(
    measurement: Measurement,
    seed: int = 1,
    progress: Callable[[str], None] | None = None,
    thresholds: Thresholds = _DEFAULTS,
) -> GapDiagnosis:
    """Find what separates the measurement from its model, name it, add it and measure the gap again.

    progress: called with the name of each step of `STEPS` that is done; thresholds: the thresholds to decide by.
    """
    clock, random = _Clock(progress), KeyedRandom(seed, ("gap",))
    # the same sums on any number of threads, and none that wait for each other
    with use_thresholds(thresholds), threadpool_limits(1, "blas"):
        ordered = with_order(measurement) if isinstance(measurement, TlsMeasurement) else measurement
        part, rows = thinned(ordered, random.child("thinned"))
        found = _diagnose(part, clock, random)
    return replace(found, residuals=replace(found.residuals, index=rows[found.residuals.index]))


def _diagnose(measurement: Measurement, clock: _Clock, random: KeyedRandom) -> GapDiagnosis:
    measurement.check_near(FILE)
    first = residuals_of(measurement)
    check_noise("surface" if isinstance(first, SurfaceResiduals) else first.sensor, first.sigma)
    held_points = np.zeros(len(measurement.cloud.points), dtype=bool)
    held_points[first.index] = held_out_blocks(first.at, Cells.over(first.at).side_m)
    held_points |= _in_validation_epoch(measurement.epochs)
    there, plain, surveyed = settled(measurement, first.index[~held_points[first.index]], first)
    if isinstance(there, StereoMeasurement) and isinstance(plain, StereoResiduals):
        there = with_surroundings(there, plain)
    if isinstance(there, TlsMeasurement) and isinstance(plain, TlsResiduals):
        plain = replace(plain, missing=missing_returns(there, plain))
    clock.lap("residuals")
    if plain.smooth.sum() < thresholds().points.fewest:
        return _insufficient_data(measurement, plain, clock)
    held = _select_and_validate(PassInputs(there, plain, held_points), random)
    state, naming = held.state, held.naming
    clock.lap("naming")
    showing = Validation(
        measurement=there,
        residuals=plain,
        chosen=state.chosen,
        tested=state.shown & state.held_out,
        learned=state.shown & ~state.held_out,
        losses=held.losses,
        reference_sigma=naming.reference_sigma,
        largest=thresholds().points.outlier_sigmas * state.scale,
        random=random,
        lower=reduced_noise(there.model, _share_of_model_noise(naming.times.share, plain)),
    )
    shown, harmful = showing.show(held.named)
    notes = [*naming.notes, *note_excess_noise(naming.times.share, showing.lower), *held.words, *harmful]
    far = held.tails.share if held.tails is not None and held.tails.even else 0.0
    wide = 1.0 if any(item.spreads for item in shown.named) else naming.times.value
    evidence = Evidence(shown.gap, naming.p_beside(shown.named), naming.times.share, far, wide=wide)
    notes = [*notes, *note_overdispersion(evidence, notes)]
    evidence = _with_moved_share(evidence, there, state, shown)
    if evidence.much_moved:
        shown, _ = replace(showing, lower={}).show([])
        notes = [*note_moved_wall(evidence, bool(there.stable_areas)), *naming.notes]
    value = plain.value - plain.pose @ showing.pose
    clock.lap("verification")
    return GapDiagnosis(
        verdict=verdict_of(shown.named, evidence),
        effects=tuple(shown.named),
        changes=tuple(state.changes),
        residuals=replace(plain, smooth=state.residuals.smooth),
        held_out=state.held_out,
        before=value,
        after=np.where(np.isfinite(shown.value), shown.value, value),
        pose=surveyed + shown.pose,
        model_after=shown.model,
        gap=shown.gap,
        tried=naming.tried,
        spread_tried=naming.spread_tried,
        remaining=_remaining(evidence, _findings_first(notes, plain.notes), shown.lower),
        identifiability=naming.identifiability,
        seconds=clock.total,
        timings=clock.laps,
        thresholds=thresholds(),
    )


def _share_of_model_noise(share: float, residuals: Residuals) -> float:
    """A share of the predicted standard deviation as one of the model's, whose part is what the reference's error leaves."""
    if not isinstance(residuals, TlsResiduals) or not residuals.reference_error_m:
        return share
    whole, reference = float(np.median(residuals.sigma**2)), float(np.median(residuals.reference_variance))
    own = max(whole - reference, _LEAST_MODEL_SHARE**2 * whole)
    return float(np.sqrt(max(share**2 * whole - reference, _LEAST_MODEL_SHARE**2 * own) / own))


def _with_moved_share(evidence: Evidence, there: Measurement, state: PassInput, shown: ValidationResult) -> Evidence:
    """With the share of the wall that moved, where that may be why nothing was named that closes the gap, or why a noise was.

    A noise closes some of any gap, but takes no neighbours along: with the true one in the model next to nothing moved.
    """
    noisy = any(item.spreads for item in shown.named)
    unexplained_yet = verdict_of(shown.named, evidence) == "unknown" and (not shown.named or evidence.closes_little)
    if not (noisy or unexplained_yet):
        return evidence
    after = replace(state.residuals, value=shown.value)
    sight = Sight.of(there, after)
    moved = moved_share(after, sight, state.fit)
    if noisy and not unexplained_yet and moved >= thresholds().changes.moved_share:
        found = residuals_of(there.changed(model=shown.model))
        sigma = found.of_points(found.sigma, after.index)
        beside = moved_share(replace(after, sigma=np.where(np.isfinite(sigma), sigma, after.sigma)), sight, state.fit)
        moved = moved if beside >= thresholds().changes.moved_share_beside_noise else 0.0
    return replace(evidence, moved=moved)


def _in_validation_epoch(epochs: NDArray[np.int64]) -> BoolArray:
    """(n,) points of the last epoch where there are enough to learn from without it."""
    last = int(epochs.max(initial=0))
    return epochs == last if last + 1 >= thresholds().points.fewest_epochs else np.zeros(len(epochs), dtype=bool)


@dataclass(frozen=True)
class _ValidatedSelection:
    """What naming started from, the effects that hold on held-out blocks, heavy tails, and words for the other effects.

    losses: the effect on the returns, and the pulses that it was not fitted to.
    """

    state: PassInput
    naming: SelectionResult
    losses: tuple[LossExplanation, BoolArray] | None
    named: list[NamedEffect]
    tails: HeavyTails | None
    words: list[str]


def _select_and_validate(
    starts: PassInputs, random: KeyedRandom, left_out: frozenset[tuple[str, bool]] = frozenset()
) -> _ValidatedSelection:
    """What is named and holds on held-out blocks; where a free form does not, what is named without any. The effects come with
    what would split each class."""
    first, there, plain = best_pass(starts, random, left_out), starts.there, starts.plain
    state, naming = first.state, first.naming
    losses = _explain_losses(there, state)
    lost = [effect_from_losses(losses[0], there.cloud.intensity)] if losses else []
    named = sorted([*first.named, *map(effect_from_edges, state.shapes), *lost], key=lambda item: -item.gain)
    named, words = only_within_bounds(there.model, named)
    scored = _validate(there, state, named, naming.reference_sigma)
    words += [f"{item.name} dropped: it does not hold on blocks that were held out" for item in scored.failed]
    nameable = any(not each.empirical for each in plain.candidates)
    if (
        nameable
        and NONPARAMETRIC_TERMS not in left_out
        and any(item.kind == "empirical" and not item.spreads for item in scored.failed)
    ):
        again = _select_and_validate(starts, random, left_out | {NONPARAMETRIC_TERMS})
        if again.named:
            return replace(again, words=[*words, *(each for each in again.words if each not in words)])
    words += [f"{item.name} only mentioned: beside the others {describe_weakness(item)}" for item in scored.weak]
    described = [item.gain for item in scored.named if item.name.endswith("_empirical")]
    least = thresholds().validation.leftover_share * max(described, default=0.0)
    left = [item for item in scored.named if item.spreads and item.gain < least]
    words += [f"{item.name} dropped: so much is left over by the empirical term" for item in left]
    steady = subsample_rows(np.flatnonzero(state.fit & ~state.held_out))
    kept = [item for item in scored.named if item not in left]
    found, tails = _with_heavy_tails(*subsample(there, state.residuals, steady), kept, state.cells.side_m)
    words += [tails.words] if tails else []
    return _ValidatedSelection(state, naming, losses, with_separating_measurements(there, found), tails, words)


def _validate(there: Measurement, state: PassInput, named: list[NamedEffect], reference_sigma: float) -> ValidatedEffects:
    """The effects on held-out blocks."""
    tested = subsample_rows(np.flatnonzero(state.fit & state.held_out))
    rows = np.concatenate([state.chosen, tested])
    trained = np.arange(len(rows)) < len(state.chosen)
    return validate_effects(*subsample(there, state.residuals, rows), named, trained, reference_sigma)


def _with_heavy_tails(
    measurement: Measurement, residuals: Residuals, named: list[NamedEffect], side_m: float
) -> tuple[list[NamedEffect], HeavyTails | None]:
    """With heavy tails where those are all over the wall, which no effect of the catalogue makes but two: strips that are filled
    are also cells that had no match by chance, and drops return early. An effect on the spread stays beside them where the
    middle of the residuals is wider too."""
    if any(item.effect is OcclusionFill or item.entry.get("early_share") for item in named):
        return named, None
    part, value, scale = _smooth_residuals_with(measurement, named)
    tails = find_heavy_tails(value / part.sigma / scale, block_numbers(part.at, side_m))
    if tails is None or not tails.even or not tails.sigma:
        return named, tails
    steady = [item for item in named if not item.spreads]
    if len(steady) < len(named):
        _, _, middle = _smooth_residuals_with(measurement, steady)
        if middle**2 - 1 > thresholds().variance.core_excess:
            return named, tails
    heavy = effect_from_tails(part, tails.sigma * float(np.median(part.sigma)), tails.gain)
    return [*steady, *only_within_bounds(measurement.model, [heavy])[0]], tails


def _smooth_residuals_with(measurement: Measurement, named: list[NamedEffect]) -> tuple[Residuals, FloatArray, float]:
    """Residuals on smooth rock against the model with some effects, registered ones (n,), and how many sigmas they spread."""
    found = aligned_with(measurement, named).residuals
    part = found.part(np.flatnonzero(found.smooth))
    value, _, scale = registered(part)
    return part, value, scale


class _Clock:
    def __init__(self, told: Callable[[str], None] | None) -> None:
        self._start = self._last = time.perf_counter()
        self._told = told
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name], self._last = now - self._last, now
        if self._told is not None:
            self._told(name)

    @property
    def total(self) -> float:
        return time.perf_counter() - self._start


def _remaining(evidence: Evidence, notes: list[str], lower_noise: dict[str, float]) -> dict[str, Any]:
    """As gap.json holds it. spread: share of the predicted one that the residuals have where that is clearly less; far: share of
    points far out all over the wall; moved: of points off the reference with their neighbours, 0 where that was not asked; wide:
    how many predicted sigmas they spread where no effect explains that."""
    return {
        "p_value": evidence.p_value,
        "note": "; ".join(notes),
        "spread": evidence.spread,
        "far": evidence.far,
        "moved": evidence.moved,
        "wide": evidence.wide,
        "lower_noise": lower_noise,
    }


def _findings_first(notes: list[str], of_data: Sequence[str]) -> list[str]:
    """What was found before what the data cannot show."""
    return [*(each for each in notes if each not in of_data), *(each for each in notes if each in of_data)]


def _insufficient_data(measurement: Measurement, residuals: Residuals, clock: _Clock) -> GapDiagnosis:
    count, least = int(residuals.smooth.sum()), thresholds().points.fewest
    note = f"{count} points on smooth parts of the reference and stable ground, {least} are needed"
    empty = np.zeros(len(residuals))
    pose = np.zeros(residuals.pose.shape[1] if isinstance(residuals, SurfaceResiduals) else 6)
    return GapDiagnosis(
        "insufficient_data", (), (), residuals, empty > 1, residuals.value, residuals.value, pose, measurement.model,
        None, (), (), _remaining(Evidence(None, None), [note], {}), {"names": [], "cosines": [], "survival": []},
        clock.total, clock.laps, thresholds(),
    )  # fmt: skip


def _explain_losses(measurement: Measurement, state: PassInput) -> tuple[LossExplanation, BoolArray] | None:
    """The effect on the returns, and the pulses that it was not fitted to."""
    residuals = state.residuals
    missing = residuals.missing
    if missing is None or any(model_has(measurement, name) for name in LOSS_EFFECTS):
        return None
    held_out = held_out_blocks(missing.at, state.cells.side_m)
    early = (
        residuals.smooth
        & ~state.changed
        & (
            state.rough
            < -np.maximum(thresholds().missing_returns.early_sigmas * residuals.sigma, thresholds().missing_returns.early_m)
        )
    )
    drops = count_isolated_returns(residuals.at, early)
    found = explain_missing_returns(missing, ~held_out, drops, len(residuals), measurement.cloud.intensity)
    return None if found is None else (found, held_out)
