"""The four steps of `scarpsim gap`: locate, name, add, show."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pipeline.formats.measurement import Measurement, StereoMeasurement, TlsMeasurement
from pipeline.formats.measurement_checks import check_near, check_noise
from pipeline.gap.decisions import Decisions, decided, deciding
from pipeline.gap.mean.selection import Tried
from pipeline.gap.naming.entries import (
    Named,
    from_missing,
    from_shape,
    from_tails,
    only_within_bounds,
    settled_with,
    with_effects,
)
from pipeline.gap.naming.families import believes
from pipeline.gap.naming.held_out import score_effects
from pipeline.gap.naming.naming import FREE_FORMS, Naming, name_effects
from pipeline.gap.naming.splitting import with_splits
from pipeline.gap.naming.verdict import Evidence, lower_noise, much_moved, too_noisy, verdict_of
from pipeline.gap.naming.verification import Showing, Shown
from pipeline.gap.naming.verify import Gap
from pipeline.gap.other.missing import LOSSES, MissingFound, find_missing, isolated
from pipeline.gap.other.mixed_pixels import find_footprint
from pipeline.gap.other.shapes import ShapeFound
from pipeline.gap.other.spread import SpreadTried, Tails, find_tails
from pipeline.gap.other.stereo_shapes import find_shapes
from pipeline.gap.residuals.cells import Cells, block_numbers, held_out_blocks
from pipeline.gap.residuals.changes import SceneChange, find_changes, moved_share, once_each
from pipeline.gap.residuals.registration import registered, residuals_of, settled
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.sight import Sight
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.thinning import thinned
from pipeline.gap.residuals.tls_residuals import TlsResiduals, missing_returns, with_order
from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray
from sensors.effects.beam_divergence import BeamDivergence
from sensors.effects.occlusion_fill import OcclusionFill
from sensors.effects.smoothing import Smoothing
from sensors.model import StereoModel, TlsModel

STEPS = {"residuals": 3.0, "naming": 14.0, "verification": 2.0}
"""The steps of `diagnose` and about what each takes, s."""
_MOST_POINTS = 60_000
"""Points that take part in the selection; more add little to 1,100 cells."""
_NOT_FREE = {"tls": ("edge_step", "line"), "stereo": ("edge_step", "incidence")}
"""Covariates by sensor that an empirical term cannot be a function of."""


_USUAL = Decisions()


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
    tried: tuple[Tried, ...]
    spread_tried: tuple[SpreadTried, ...]
    remaining: dict[str, Any]
    identifiability: dict[str, Any]
    seconds: float
    timings: dict[str, float]
    decisions: Decisions = _USUAL

    @property
    def evidence(self) -> Evidence:
        """The numbers that the verdict and its words rest on."""
        return Evidence(self.gap, self.remaining["p_value"], self.remaining["spread"], self.remaining["far"],
                        self.remaining["moved"])  # fmt: skip

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
        ordered = with_order(measurement) if isinstance(measurement, TlsMeasurement) else measurement
        part, rows = thinned(ordered, random.child("thinned"))
        found = _diagnose(part, clock, random)
    return replace(found, residuals=replace(found.residuals, index=rows[found.residuals.index]))


def _diagnose(measurement: Measurement, clock: _Clock, random: KeyedRandom) -> GapDiagnosis:
    check_near(measurement.fit)
    first = residuals_of(measurement)
    check_noise(first.sensor, first.sigma)
    held_points = np.zeros(len(measurement.cloud.points), dtype=bool)
    held_points[first.index] = held_out_blocks(first.at, Cells.over(first.at).side_m)
    held_points |= _held_epoch(measurement.epochs)
    there, plain, surveyed = settled(measurement, first.index[~held_points[first.index]], first)
    if isinstance(there, TlsMeasurement) and isinstance(plain, TlsResiduals):
        plain = replace(plain, missing=missing_returns(there, plain))
    clock.lap("residuals")
    if plain.smooth.sum() < decided().points.fewest:
        return _insufficient(measurement, plain, clock)
    held = _held(there, plain, held_points, random)
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
        lower=lower_noise(there.model, naming.share),
    )
    shown, harmful = showing.show(held.named)
    notes = [*naming.notes, *too_noisy(naming.share, showing.lower), *held.words, *harmful]
    far = held.tails.share if held.tails is not None and held.tails.even else 0.0
    evidence = _with_moved(Evidence(shown.gap, naming.p_beside(shown.named), naming.share, far), there, state, shown)
    if evidence.much_moved:
        shown, _ = replace(showing, lower={}).show([])
        notes = [*much_moved(evidence, bool(there.stable_areas)), *naming.notes]
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
        remaining=_remaining(evidence, _found_first(notes, plain.notes), shown.lower),
        identifiability=naming.identifiability,
        seconds=clock.total,
        timings=clock.laps,
        decisions=decided(),
    )


def _with_moved(evidence: Evidence, there: Measurement, state: _State, shown: Shown) -> Evidence:
    """With the share of the wall that moved, where that may be why nothing was named that closes the gap."""
    if verdict_of(shown.named, evidence) != "unknown" or (shown.named and not evidence.stays_open):
        return evidence
    after = replace(state.residuals, value=shown.value)
    return replace(evidence, moved=moved_share(after, Sight.of(there, after), state.residuals.smooth & ~state.changed))


def _held_epoch(epochs: NDArray[np.int64]) -> BoolArray:
    """(n,) points of the last epoch where there are enough to learn from without it."""
    last = int(epochs.max(initial=0))
    return epochs == last if last + 1 >= decided().points.fewest_epochs else np.zeros(len(epochs), dtype=bool)


@dataclass(frozen=True)
class _State:
    """What naming starts from, once effects where the surface is not smooth are known.

    shaped: the measurement with them in its model; residuals: against that; touched, changed, held_out: (n,) points that they
    touch, that lie in changes of the scene, and that no step before the last may look at; rough: (n,) registered residuals, which
    spread `scale` predicted sigmas; chosen: rows that selection may look at.
    """

    shapes: list[ShapeFound]
    shaped: Measurement
    residuals: Residuals
    touched: BoolArray
    changes: list[SceneChange]
    changed: BoolArray
    rough: FloatArray
    scale: float
    cells: Cells
    held_out: BoolArray
    chosen: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        there: Measurement,
        plain: Residuals,
        held_points: BoolArray,
        shapes: list[ShapeFound],
        touched_points: BoolArray,
        resettled: bool = True,
    ) -> _State:
        """held_points, touched_points: of the measurement; resettled: the sensor goes where it stood with the shapes."""
        touched = touched_points[plain.index]
        trusted = plain.index[~(touched | held_points[plain.index])] if resettled else None
        shaped, residuals = _shaped(there, plain, shapes, touched, trusted)
        rough, _, scale = registered(residuals)
        sight = Sight.of(there, residuals)
        changes, changed = find_changes(replace(residuals, value=rough), sight, residuals.even & ~touched)
        if isinstance(there, TlsMeasurement) and there.scans:
            changes = once_each(changes)
        rough, _, scale = registered(replace(residuals, smooth=residuals.smooth & ~changed))
        cells = Cells.over(residuals.at)
        held_out = held_points[residuals.index]
        usable = residuals.smooth & ~changed & (np.abs(rough) < decided().points.outlier * scale * residuals.sigma)
        chosen = _thinned(np.flatnonzero(usable & ~held_out))
        return cls(shapes, shaped, residuals, touched, changes, changed, rough, scale, cells, held_out, chosen)

    @property
    def shown(self) -> BoolArray:
        """(n,) points on which a gap may be measured: on smooth surface, or where an effect was found that shows elsewhere."""
        return np.asarray((self.residuals.smooth | self.touched) & ~self.changed)

    @property
    def part(self) -> tuple[Measurement, Residuals]:
        """What selection may look at."""
        return few(self.shaped, self.residuals, self.chosen)


@dataclass(frozen=True)
class _Attempt:
    """What naming started from and what it named."""

    state: _State
    named: list[Named]
    naming: Naming

    @classmethod
    def of(cls, state: _State, random: KeyedRandom, left_out: frozenset[tuple[str, bool]]) -> _Attempt:
        return cls(state, *name_effects(*state.part, state.scale, random, left_out))

    @property
    def shapes(self) -> set[str]:
        """Effects where the surface is not smooth."""
        return {each.name for each in self.state.shapes}

    @property
    def complexity(self) -> tuple[int, int]:
        """Empirical terms, and all effects and changes of the scene."""
        state = self.state
        return sum(item.kind == "empirical" for item in self.named), len(self.named) + len(state.shapes) + len(state.changes)


def _named(
    there: Measurement, plain: Residuals, held_points: BoolArray, random: KeyedRandom, left_out: frozenset[tuple[str, bool]]
) -> _Attempt:
    """What the naming started from in the end, and what it named. left_out: as of `name_effects`.

    What moves the rays everywhere hides, or feigns, effects where the surface is not smooth: those are looked for again beside
    what was named; and where there seemed to be some, beside what is named without them. A low-pass moves the sensor, or what
    does so beside it: where the sensor goes along and a term of no effect is left, it stays. Fewer effects are the explanation.
    """

    def beside(found: _Attempt) -> _Attempt:
        if not found.named:
            return found
        seen = settled_with(there, found.named, plain.index[~held_points[plain.index]])
        again = _State.of(there, plain, held_points, *_shapes(seen.measurement, seen.residuals, held_points))
        names = {each.name for each in again.shapes}
        # rays that are not quite where they are thought to be look like a low-pass
        feigned = Smoothing.tag() in names - found.shapes
        return found if names == found.shapes or feigned else _Attempt.of(again, random, left_out)

    shapes = _shapes(there, plain, held_points)
    first = _Attempt.of(_State.of(there, plain, held_points, *shapes), random, left_out)
    found = [beside(first)]
    if Smoothing.tag() in first.shapes and found[0].complexity >= (1, 0):
        staying = _State.of(there, plain, held_points, *shapes, resettled=False)
        found.append(beside(_Attempt.of(staying, random, left_out)))
    if first.shapes and found[0].complexity > (0, 1):  # one effect is the least that there can be
        untouched = np.zeros(len(held_points), dtype=bool)
        smooth = _Attempt.of(_State.of(there, plain, held_points, [], untouched), random, left_out)
        if smooth.named:
            found.append(beside(smooth))
    return min(found, key=lambda each: each.complexity)


@dataclass(frozen=True)
class _Held:
    """What naming started from, the effects that hold on held-out blocks, heavy tails, and words for the other effects.

    losses: the effect on the returns, and the pulses that it was not fitted to.
    """

    state: _State
    naming: Naming
    losses: tuple[MissingFound, BoolArray] | None
    named: list[Named]
    tails: Tails | None
    words: list[str]


def _held(
    there: Measurement,
    plain: Residuals,
    held_points: BoolArray,
    random: KeyedRandom,
    left_out: frozenset[tuple[str, bool]] = frozenset(),
) -> _Held:
    """What is named and holds on held-out blocks; where a free form does not, what is named without any. The effects come with
    what would split each class."""
    attempt = _named(there, plain, held_points, random, left_out)
    state, naming = attempt.state, attempt.naming
    losses = _missing(there, state)
    lost = [from_missing(losses[0], there.cloud.intensity)] if losses else []
    named = sorted([*attempt.named, *map(from_shape, state.shapes), *lost], key=lambda item: -item.gain)
    named, words = only_within_bounds(there.model, named)
    fit = state.residuals.smooth & ~state.changed
    tested = _thinned(np.flatnonzero(fit & state.held_out))
    rows = np.concatenate([state.chosen, tested])
    trained = np.arange(len(rows)) < len(state.chosen)
    scored = score_effects(*few(there, state.residuals, rows), named, trained, naming.reference_sigma)
    words += [f"{item.name} dropped: it does not hold on blocks that were held out" for item in scored.failed]
    if FREE_FORMS not in left_out and any(item.kind == "empirical" and not item.spreads for item in scored.failed):
        again = _held(there, plain, held_points, random, left_out | {FREE_FORMS})
        if again.named:
            return replace(again, words=[*words, *(each for each in again.words if each not in words)])
    words += [f"{item.name} only mentioned: beside the others it gains {item.gain:.1f} on new blocks" for item in scored.weak]
    described = [item.gain for item in scored.named if item.name.endswith("_empirical")]
    least = decided().held_out.left_over * max(described, default=0.0)
    left = [item for item in scored.named if item.spreads and item.gain < least]
    words += [f"{item.name} dropped: so much is left over by the empirical term" for item in left]
    steady = _thinned(np.flatnonzero(fit & ~state.held_out))
    kept = [item for item in scored.named if item not in left]
    found, tails = _with_tails(*few(there, state.residuals, steady), kept, state.cells.side_m)
    words += [tails.words] if tails else []
    return _Held(state, naming, losses, with_splits(there, found), tails, words)


def _thinned(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    return rows[:: max(len(rows) // _MOST_POINTS, 1)]


def _shapes(measurement: Measurement, residuals: Residuals, held_points: BoolArray) -> tuple[list[ShapeFound], BoolArray]:
    """Effects where the surface is not smooth that the model does not hold, and which of the measurement's points they touch.

    held_points: of the measurement's points those that have no say.
    """
    rough, _, scale = registered(residuals)
    found: list[ShapeFound] = []
    held_out = held_points[residuals.index]
    match measurement, residuals:
        case StereoMeasurement(), StereoResiduals():
            found = find_shapes(measurement, residuals, rough, held_out)
        case TlsMeasurement(), TlsResiduals() if not believes(measurement, BeamDivergence.tag()):
            found = find_footprint(measurement, residuals, rough, scale, held_out)
    touched = np.zeros(len(measurement.cloud.points), dtype=bool)
    for each in found:
        touched[residuals.index] |= each.touched
    return found, touched


def _shaped(
    measurement: Measurement,
    residuals: Residuals,
    shapes: list[ShapeFound],
    touched: BoolArray,
    trusted: NDArray[np.int64] | None,
) -> tuple[Measurement, Residuals]:
    """The measurement with these effects in its model, its sensor where its points say that it stood with them, and the residuals
    of the same points there. touched: (n,) points that the effects move; trusted: rows of the measurement's points that say where
    the sensor stood, None where it stays."""
    if not shapes:
        return measurement, residuals
    entries = [from_shape(shape).entry for shape in shapes]
    shaped = measurement.changed(model=with_effects(measurement.model, entries))
    if trusted is None:
        found = residuals_of(shaped)
    else:
        shaped, found, _ = settled(shaped, trusted)
    place = np.full(len(measurement.cloud.points), -1)
    place[found.index] = np.arange(len(found))
    rows = place[residuals.index]
    known = rows >= 0
    there = residuals.with_rows(known, found.part(rows[known]))
    return shaped, replace(there, smooth=residuals.smooth & ~touched & known)


def few(measurement: Measurement, residuals: Residuals, rows: NDArray[np.int64]) -> tuple[Measurement, Residuals]:
    """The measurement with the points of some rows of its residuals alone, and their residuals."""
    part = residuals.part(rows)
    return measurement.part(part.index), replace(part, index=np.arange(len(rows)), missing=None)


def _with_tails(
    measurement: Measurement, residuals: Residuals, named: list[Named], side_m: float
) -> tuple[list[Named], Tails | None]:
    """With heavy tails where those are all over the wall, which no effect of the catalogue makes but two: strips that are filled
    are also cells that had no match by chance, and drops return early. An effect on the spread stays beside them where the
    middle of the residuals is wider too."""
    if any(item.effect is OcclusionFill or item.entry.get("early_share") for item in named):
        return named, None
    part, value, scale = _smooth_with(measurement, named)
    tails = find_tails(value / part.sigma / scale, block_numbers(part.at, side_m))
    if tails is None or not tails.even or not tails.sigma:
        return named, tails
    steady = [item for item in named if not item.spreads]
    if len(steady) < len(named):
        _, _, middle = _smooth_with(measurement, steady)
        if middle**2 - 1 > decided().spread.core_excess:
            return named, tails
    heavy = from_tails(part.sensor, tails.sigma * float(np.median(part.sigma)), tails.gain)
    return [*steady, *only_within_bounds(measurement.model, [heavy])[0]], tails


def _smooth_with(measurement: Measurement, named: list[Named]) -> tuple[Residuals, FloatArray, float]:
    """Residuals on smooth rock against the model with some effects, registered ones (n,), and how many sigmas they spread."""
    found = settled_with(measurement, named).residuals
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
    points far out all over the wall; moved: of points off the reference with their neighbours, 0 where that was not asked."""
    return {
        "p_value": evidence.p_value,
        "note": "; ".join(notes),
        "spread": evidence.spread,
        "far": evidence.far,
        "moved": evidence.moved,
        "lower_noise": lower_noise,
    }


def _found_first(notes: list[str], of_data: Sequence[str]) -> list[str]:
    """What was found before what the data cannot show."""
    return [*(each for each in notes if each not in of_data), *(each for each in notes if each in of_data)]


def _insufficient(measurement: Measurement, residuals: Residuals, clock: _Clock) -> GapDiagnosis:
    count, least = int(residuals.smooth.sum()), decided().points.fewest
    note = f"{count} points on smooth parts of the reference and stable ground, {least} are needed"
    empty = np.zeros(len(residuals))
    return GapDiagnosis(
        "insufficient_data", (), (), residuals, empty > 1, residuals.value, residuals.value, np.zeros(6), measurement.model,
        None, (), (), _remaining(Evidence(None, None), [note], {}), {"names": [], "cosines": [], "survival": []},
        clock.total, clock.laps, decided(),
    )  # fmt: skip


def _missing(measurement: Measurement, state: _State) -> tuple[MissingFound, BoolArray] | None:
    """The effect on the returns, and the pulses that it was not fitted to."""
    residuals = state.residuals
    missing = residuals.missing
    if missing is None or any(believes(measurement, name) for name in LOSSES):
        return None
    held_out = held_out_blocks(missing.at, state.cells.side_m)
    early = (
        residuals.smooth
        & ~state.changed
        & (state.rough < -np.maximum(decided().losses.early_sigmas * residuals.sigma, decided().losses.early))
    )
    drops = isolated(residuals.at, early)
    found = find_missing(missing, ~held_out, drops, len(residuals), measurement.cloud.intensity)
    return None if found is None else (found, held_out)
