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
from pipeline.gap.decisions import Decisions, decided, deciding
from pipeline.gap.mean.selection import FamilyScore
from pipeline.gap.naming.attempts import Starts, State, attempt, few, thinned_rows
from pipeline.gap.naming.entries import (
    Named,
    from_missing,
    from_shape,
    from_tails,
    only_within_bounds,
    settled_with,
)
from pipeline.gap.naming.families import believes
from pipeline.gap.naming.held_out import Scored, score_effects, weakness
from pipeline.gap.naming.naming import FREE_FORMS, Naming
from pipeline.gap.naming.splitting import with_splits
from pipeline.gap.naming.verdict import Evidence, lower_noise, much_moved, too_noisy, unexplained, verdict_of
from pipeline.gap.naming.verification import Showing, Shown
from pipeline.gap.naming.verify import Gap
from pipeline.gap.other.missing import LOSSES, MissingFound, find_missing, isolated
from pipeline.gap.other.spread import SpreadTried, Tails, find_tails
from pipeline.gap.residuals.alignment import align, compute_residuals, fit_pose_robustly
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.scene_changes import SceneChange, moved_share
from pipeline.gap.residuals.sensor_view import SensorView
from pipeline.gap.residuals.stereo_residuals import StereoResiduals, with_surroundings
from pipeline.gap.residuals.subsampling import subsample
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals
from pipeline.gap.residuals.tls_residuals import TlsResiduals, find_expected_pulses, with_scan_order
from pipeline.gap.residuals.wall_blocks import WallCells, in_validation_blocks, wall_block_numbers
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.occlusion_fill import OcclusionFill
from sensors.models.sensor_model import StereoModel, TlsModel

STEPS = {"residuals": 3.0, "naming": 14.0, "verification": 2.0}
"""The steps of `diagnose` and about what each takes, s."""
_USUAL = Decisions()
_LEAST_SHARE = 0.1
"""Of its standard deviation that a model keeps where the reference's error explains all of the spread."""


@dataclass(frozen=True)
class GapDiagnosis:
    """What was found.

    held_out: (n,) points never used in naming; before, after: (n,) residuals with registration taken off, in the observable's
    unit; pose: (6 k,) shift (m) and turn (rad) of the sensor in k set-ups, wall frame; timings: s by step; decisions: what was
    decided by.
    """

    verdict: str
    effects: tuple[Named, ...]
    changes: tuple[SceneChange, ...]
    residuals: Residuals
    held_out: BoolArray
    before: FloatArray
    after: FloatArray
    pose: FloatArray
    model_after: TlsModel | StereoModel
    gap: Gap | None
    tried: tuple[FamilyScore, ...]
    spread_tried: tuple[SpreadTried, ...]
    remaining: dict[str, Any]
    identifiability: dict[str, Any]
    seconds: float
    timings: dict[str, float]
    decisions: Decisions = _USUAL

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
    decisions: Decisions = _USUAL,
) -> GapDiagnosis:
    """Find what separates the measurement from its model, name it, add it and measure the gap again.

    progress: called with the name of each step of `STEPS` that is done; decisions: the thresholds to decide by.
    """
    clock, random = _Clock(progress), KeyedRandom(seed, ("gap",))
    # the same sums on any number of threads, and none that wait for each other
    with deciding(decisions), threadpool_limits(1, "blas"):
        ordered = with_scan_order(measurement) if isinstance(measurement, TlsMeasurement) else measurement
        part, rows = subsample(ordered, random.child("thinned"))
        found = _diagnose(part, clock, random)
    return replace(found, residuals=replace(found.residuals, index=rows[found.residuals.index]))


def _diagnose(measurement: Measurement, clock: _Clock, random: KeyedRandom) -> GapDiagnosis:
    measurement.check_near(FILE)
    first = compute_residuals(measurement)
    check_noise("surface" if isinstance(first, SurfaceResiduals) else first.sensor, first.sigma)
    held_points = np.zeros(len(measurement.cloud.points), dtype=bool)
    held_points[first.index] = in_validation_blocks(first.wall_xy, WallCells.over(first.wall_xy).side_m)
    held_points |= _held_epoch(measurement.epochs)
    there, plain, surveyed = align(measurement, first.index[~held_points[first.index]], first)
    if isinstance(there, StereoMeasurement) and isinstance(plain, StereoResiduals):
        there = with_surroundings(there, plain)
    if isinstance(there, TlsMeasurement) and isinstance(plain, TlsResiduals):
        plain = replace(plain, expected_pulses=find_expected_pulses(there, plain))
    clock.lap("residuals")
    if plain.usable.sum() < decided().points.fewest:
        return _insufficient(measurement, plain, clock)
    held = _held(Starts(there, plain, held_points), random)
    state, naming = held.state, held.naming
    clock.lap("naming")
    showing = Showing(
        measurement=there,
        residuals=plain,
        chosen=state.chosen,
        tested=state.shown & state.held_out,
        learned=state.shown & ~state.held_out,
        losses=held.losses,
        reference_sigma=naming.reference_sigma,
        largest=decided().points.outlier * state.scale,
        random=random,
        lower=lower_noise(there.model, _of_model(naming.times.share, plain)),
    )
    shown, harmful = showing.show(held.named)
    notes = [*naming.notes, *too_noisy(naming.times.share, showing.lower), *held.words, *harmful]
    far = held.tails.share if held.tails is not None and held.tails.even else 0.0
    wide = 1.0 if any(item.spreads for item in shown.named) else naming.times.value
    evidence = Evidence(shown.gap, naming.p_beside(shown.named), naming.times.share, far, wide=wide)
    notes = [*notes, *unexplained(evidence, notes)]
    evidence = _with_moved(evidence, there, state, shown)
    if evidence.much_moved:
        shown, _ = replace(showing, lower={}).show([])
        notes = [*much_moved(evidence, bool(there.stable_areas)), *naming.notes]
    value = plain.value - plain.pose_jacobian @ showing.pose
    clock.lap("verification")
    return GapDiagnosis(
        verdict=verdict_of(shown.named, evidence),
        effects=tuple(shown.named),
        changes=tuple(state.changes),
        residuals=replace(plain, usable=state.residuals.usable),
        held_out=state.held_out,
        before=value,
        after=np.where(np.isfinite(shown.value), shown.value, value),
        pose=surveyed + shown.pose,
        model_after=shown.model,
        gap=shown.gap,
        tried=naming.tried,
        spread_tried=naming.spread_tried,
        remaining=_remaining(evidence, _found_first(notes, plain.notes), shown.lower),
        identifiability=naming.identifiability,
        seconds=clock.total,
        timings=clock.laps,
        decisions=decided(),
    )


def _of_model(share: float, residuals: Residuals) -> float:
    """A share of the predicted standard deviation as one of the model's, whose part is what the reference's error leaves."""
    if not isinstance(residuals, TlsResiduals) or not residuals.reference_error_m:
        return share
    whole, reference = float(np.median(residuals.sigma**2)), float(np.median(residuals.reference_variance))
    own = max(whole - reference, _LEAST_SHARE**2 * whole)
    return float(np.sqrt(max(share**2 * whole - reference, _LEAST_SHARE**2 * own) / own))


def _with_moved(evidence: Evidence, there: Measurement, state: State, shown: Shown) -> Evidence:
    """With the share of the wall that moved, where that may be why nothing was named that closes the gap, or why a noise was.

    A noise closes some of any gap, but takes no neighbours along: with the true one in the model next to nothing moved.
    """
    noisy = any(item.spreads for item in shown.named)
    unexplained_yet = verdict_of(shown.named, evidence) == "unknown" and (not shown.named or evidence.closes_little)
    if not (noisy or unexplained_yet):
        return evidence
    after = replace(state.residuals, value=shown.value)
    sight = SensorView.of(there, after)
    moved = moved_share(after, sight, state.fit)
    if noisy and not unexplained_yet and moved >= decided().changes.moved_share:
        found = compute_residuals(there.changed(model=shown.model))
        sigma = found.values_at(found.sigma, after.index)
        beside = moved_share(replace(after, sigma=np.where(np.isfinite(sigma), sigma, after.sigma)), sight, state.fit)
        moved = moved if beside >= decided().changes.moved_beside_noise else 0.0
    return replace(evidence, moved=moved)


def _held_epoch(epochs: NDArray[np.int64]) -> BoolArray:
    """(n,) points of the last epoch where there are enough to learn from without it."""
    last = int(epochs.max(initial=0))
    return epochs == last if last + 1 >= decided().points.fewest_epochs else np.zeros(len(epochs), dtype=bool)


@dataclass(frozen=True)
class _Held:
    """What naming started from, the effects that hold on held-out blocks, heavy tails, and words for the other effects.

    losses: the effect on the returns, and the pulses that it was not fitted to.
    """

    state: State
    naming: Naming
    losses: tuple[MissingFound, BoolArray] | None
    named: list[Named]
    tails: Tails | None
    words: list[str]


def _held(starts: Starts, random: KeyedRandom, left_out: frozenset[tuple[str, bool]] = frozenset()) -> _Held:
    """What is named and holds on held-out blocks; where a free form does not, what is named without any. The effects come with
    what would split each class."""
    first, there, plain = attempt(starts, random, left_out), starts.there, starts.plain
    state, naming = first.state, first.naming
    losses = _missing(there, state)
    lost = [from_missing(losses[0], there.cloud.intensity)] if losses else []
    named = sorted([*first.named, *map(from_shape, state.shapes), *lost], key=lambda item: -item.gain)
    named, words = only_within_bounds(there.model, named)
    scored = _scored(there, state, named, naming.reference_sigma)
    words += [f"{item.name} dropped: it does not hold on blocks that were held out" for item in scored.failed]
    nameable = any(not each.empirical for each in plain.candidates)
    if nameable and FREE_FORMS not in left_out and any(item.kind == "empirical" and not item.spreads for item in scored.failed):
        again = _held(starts, random, left_out | {FREE_FORMS})
        if again.named:
            return replace(again, words=[*words, *(each for each in again.words if each not in words)])
    words += [f"{item.name} only mentioned: beside the others {weakness(item)}" for item in scored.weak]
    described = [item.gain for item in scored.named if item.name.endswith("_empirical")]
    least = decided().held_out.left_over * max(described, default=0.0)
    left = [item for item in scored.named if item.spreads and item.gain < least]
    words += [f"{item.name} dropped: so much is left over by the empirical term" for item in left]
    steady = thinned_rows(np.flatnonzero(state.fit & ~state.held_out))
    kept = [item for item in scored.named if item not in left]
    found, tails = _with_tails(*few(there, state.residuals, steady), kept, state.cells.side_m)
    words += [tails.words] if tails else []
    return _Held(state, naming, losses, with_splits(there, found), tails, words)


def _scored(there: Measurement, state: State, named: list[Named], reference_sigma: float) -> Scored:
    """The effects on held-out blocks."""
    tested = thinned_rows(np.flatnonzero(state.fit & state.held_out))
    rows = np.concatenate([state.chosen, tested])
    trained = np.arange(len(rows)) < len(state.chosen)
    return score_effects(*few(there, state.residuals, rows), named, trained, reference_sigma)


def _with_tails(
    measurement: Measurement, residuals: Residuals, named: list[Named], side_m: float
) -> tuple[list[Named], Tails | None]:
    """With heavy tails where those are all over the wall, which no effect of the catalogue makes but two: strips that are filled
    are also cells that had no match by chance, and drops return early. An effect on the spread stays beside them where the
    middle of the residuals is wider too."""
    if any(item.effect is OcclusionFill or item.entry.get("early_share") for item in named):
        return named, None
    part, value, scale = _smooth_with(measurement, named)
    tails = find_tails(value / part.sigma / scale, wall_block_numbers(part.wall_xy, side_m))
    if tails is None or not tails.even or not tails.sigma:
        return named, tails
    steady = [item for item in named if not item.spreads]
    if len(steady) < len(named):
        _, _, middle = _smooth_with(measurement, steady)
        if middle**2 - 1 > decided().spread.core_excess:
            return named, tails
    heavy = from_tails(part, tails.sigma * float(np.median(part.sigma)), tails.gain)
    return [*steady, *only_within_bounds(measurement.model, [heavy])[0]], tails


def _smooth_with(measurement: Measurement, named: list[Named]) -> tuple[Residuals, FloatArray, float]:
    """Residuals on smooth rock against the model with some effects, registered ones (n,), and how many sigmas they spread."""
    found = settled_with(measurement, named).residuals
    part = found.part(np.flatnonzero(found.usable))
    value, _, scale = fit_pose_robustly(part)
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


def _found_first(notes: list[str], of_data: Sequence[str]) -> list[str]:
    """What was found before what the data cannot show."""
    return [*(each for each in notes if each not in of_data), *(each for each in notes if each in of_data)]


def _insufficient(measurement: Measurement, residuals: Residuals, clock: _Clock) -> GapDiagnosis:
    count, least = int(residuals.usable.sum()), decided().points.fewest
    note = f"{count} points on smooth parts of the reference and stable ground, {least} are needed"
    empty = np.zeros(len(residuals))
    pose = np.zeros(residuals.pose_jacobian.shape[1] if isinstance(residuals, SurfaceResiduals) else 6)
    return GapDiagnosis(
        "insufficient_data", (), (), residuals, empty > 1, residuals.value, residuals.value, pose, measurement.model,
        None, (), (), _remaining(Evidence(None, None), [note], {}), {"names": [], "cosines": [], "survival": []},
        clock.total, clock.laps, decided(),
    )  # fmt: skip


def _missing(measurement: Measurement, state: State) -> tuple[MissingFound, BoolArray] | None:
    """The effect on the returns, and the pulses that it was not fitted to."""
    residuals = state.residuals
    missing = residuals.expected_pulses
    if missing is None or any(believes(measurement, name) for name in LOSSES):
        return None
    held_out = in_validation_blocks(missing.wall_xy, state.cells.side_m)
    early = (
        residuals.usable
        & ~state.changed
        & (state.rough < -np.maximum(decided().losses.early_sigmas * residuals.sigma, decided().losses.early))
    )
    drops = isolated(residuals.wall_xy, early)
    found = find_missing(missing, ~held_out, drops, len(residuals), measurement.cloud.intensity)
    return None if found is None else (found, held_out)
