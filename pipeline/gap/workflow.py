"""The four steps of `scarpsim gap`: locate, name, add, show."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.gap import stereo_signatures, tls_signatures
from pipeline.gap.candidates import PLACE, Candidate, Grid, free_forms, places, variants
from pipeline.gap.cells import Cells, held_out_blocks
from pipeline.gap.changes import SceneChange, find_changes
from pipeline.gap.entries import Named, from_comb, from_mean, from_missing, from_spread, with_effects
from pipeline.gap.measurement import Measurement
from pipeline.gap.missing import find_missing
from pipeline.gap.quantization import find_comb
from pipeline.gap.residuals import BoolArray, Residuals
from pipeline.gap.selection import MeanSearch, Tried
from pipeline.gap.spread import find_spread
from pipeline.gap.stereo_residuals import stereo_residuals
from pipeline.gap.tls_residuals import tls_residuals
from pipeline.gap.verify import Gap, Version, measure_gap, thinned
from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray
from sensors.model import StereoModel, TlsModel

FEWEST_POINTS = 800
_MOST_POINTS = 60_000
"""Points that take part in the selection; more add little to 1,100 cells."""
_CLIP = 5.0
_EARLY_SIGMAS, _EARLY_M = 8.0, 0.5
_NOT_FREE = {"tls": ("edge_step", "line"), "stereo": ("edge_step", "incidence")}
"""Covariates by sensor that an empirical term cannot be a function of."""


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    held_out: (n,) points never used in naming; before, after: (n,) residuals with registration taken off, in the observable's
    unit; pose: (6,) shift (m) and turn (rad) of the sensor, wall frame; timings: s by step.
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
    remaining: dict[str, Any]
    identifiability: dict[str, Any]
    seconds: float
    timings: dict[str, float]


def residuals_of(measurement: Measurement) -> Residuals:
    """The raw residuals of either sensor."""
    return tls_residuals(measurement) if measurement.sensor == "tls" else stereo_residuals(measurement)


def diagnose(measurement: Measurement, seed: int = 1) -> Diagnosis:
    """Find what separates the measurement from its model, name it, add it and measure the gap again."""
    clock, random = _Clock(), KeyedRandom(seed, ("gap",))
    residuals = residuals_of(measurement)
    clock.lap("residuals")
    if residuals.smooth.sum() < FEWEST_POINTS:
        return _insufficient(measurement, residuals, clock)
    rough, scale = _registered(residuals)
    changes, changed = find_changes(replace(residuals, value=rough), measurement.cloud.points[residuals.index], residuals.smooth)
    rough, scale = _registered(replace(residuals, smooth=residuals.smooth & ~changed))
    clock.lap("changes")
    cells = Cells.over(residuals.at)
    held_out = held_out_blocks(residuals.at, cells.side_m)
    usable = residuals.smooth & ~changed & (np.abs(rough) < _CLIP * scale * residuals.sigma)
    chosen = np.flatnonzero(usable & ~held_out)
    chosen = chosen[:: max(len(chosen) // _MOST_POINTS, 1)]
    named, naming = _name(measurement, residuals.part(chosen), scale, random)
    named = sorted([*named, *_missing(measurement, residuals, rough, changed)], key=lambda item: -item.gain)
    clock.lap("naming")
    after = with_effects(measurement.model, [item.entry for item in named])
    corrected = _corrected(measurement, after, residuals) if named else residuals.value
    sound = chosen[np.isfinite(corrected[chosen])]
    versions = tuple(
        Version(model, _pose(replace(residuals, value=value).part(sound)))
        for model, value in ((measurement.model, residuals.value), (after, corrected))
    )
    gap = _gap(measurement, versions, residuals, residuals.smooth & ~changed & held_out, naming.reference_sigma, scale, random)
    clock.lap("verification")
    return Diagnosis(
        verdict=_verdict(named),
        effects=tuple(named),
        changes=tuple(changes),
        residuals=residuals,
        held_out=held_out,
        before=residuals.value - residuals.pose @ versions[0].pose,
        after=np.where(np.isfinite(corrected), corrected, residuals.value) - residuals.pose @ versions[1].pose,
        pose=versions[1].pose,
        model_after=after,
        gap=gap,
        tried=naming.tried,
        remaining=naming.remaining,
        identifiability=naming.identifiability,
        seconds=clock.total,
        timings=clock.laps,
    )


@dataclass(frozen=True)
class _Naming:
    """What the selection leaves beside the effects: what was tried, what remains, and the standard deviation of the reference."""

    tried: tuple[Tried, ...]
    remaining: dict[str, Any]
    identifiability: dict[str, Any]
    reference_sigma: float


def _corrected(measurement: Measurement, model: TlsModel | StereoModel, residuals: Residuals) -> FloatArray:
    """(n,) residuals of the same points against another model; NaN where that one misses the reference."""
    found = residuals_of(replace(measurement, model=model))
    value = np.full(len(measurement.cloud.points), np.nan)
    value[found.index] = found.value
    return np.asarray(value[residuals.index])


class _Clock:
    def __init__(self) -> None:
        self._start = self._last = time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name], self._last = now - self._last, now

    @property
    def total(self) -> float:
        return time.perf_counter() - self._start


def _insufficient(measurement: Measurement, residuals: Residuals, clock: _Clock) -> Diagnosis:
    note = f"{int(residuals.smooth.sum())} points on smooth parts of the reference, {FEWEST_POINTS} are needed"
    empty = np.zeros(len(residuals))
    return Diagnosis(
        "insufficient_data", (), (), residuals, empty > 1, residuals.value, residuals.value, np.zeros(6), measurement.model,
        None, (), {"p_value": 1.0, "note": note}, {"names": [], "cosines": [], "survival": []}, clock.total, clock.laps,
    )  # fmt: skip


def _registered(residuals: Residuals) -> tuple[FloatArray, float]:
    """(n,) residuals after a robust registration, and how many predicted sigmas their spread is (at least 1)."""
    kept, scale = residuals.smooth.copy(), 1.0
    value = residuals.value
    for _ in range(6):
        weighted = residuals.pose[kept] / residuals.sigma[kept, None]
        pose = np.linalg.lstsq(weighted, residuals.value[kept] / residuals.sigma[kept], rcond=None)[0]
        value = residuals.value - residuals.pose @ pose
        z = np.abs(value / residuals.sigma)
        scale = max(1.0, 1.4826 * float(np.median(z[residuals.smooth])))
        kept = residuals.smooth & (z < 3.5 * scale)
        if kept.sum() < 100:
            kept = residuals.smooth
    return value, scale


def _pose(residuals: Residuals) -> FloatArray:
    weighted = residuals.pose / residuals.sigma[:, None]
    return np.asarray(np.linalg.lstsq(weighted, residuals.value / residuals.sigma, rcond=None)[0])


def families_of(measurement: Measurement, part: Residuals) -> list[Candidate | Grid]:
    """Every explanation of the mean that the fields of `part` allow, the catalogue's and free forms."""
    named = tls_signatures.mean_families(part) if part.sensor == "tls" else stereo_signatures.mean_families(part, measurement)
    free = [
        form
        for name, values in part.covariates.items()
        if name not in _NOT_FREE[part.sensor] and np.ptp(values) > 0
        for form in free_forms(name, values)
    ]
    return [*named, *free, *places(part.at)]


def candidates_of(measurement: Measurement, part: Residuals) -> list[Candidate]:
    """The same, with each searched sine at each of its frequencies."""
    return variants(families_of(measurement, part))


def _name(measurement: Measurement, part: Residuals, scale: float, random: KeyedRandom) -> tuple[list[Named], _Naming]:
    """Effects on the mean and on the spread, from the selection blocks alone."""
    comb = find_comb(part.geometry.measured_m) if part.sensor == "tls" and not _names(measurement, "range_quantization") else None
    named: list[Named] = []
    if comb is not None:
        named.append(from_comb(comb, part))
        part = replace(part, sigma=np.sqrt(part.sigma**2 + comb.step_m**2 / 12))
        scale = 1.0
    families, cells = families_of(measurement, part), Cells.over(part.at)
    spread = find_spread(part, cells, _registered(part)[0], random)
    sigma = part.sigma * scale if spread is None else np.sqrt(part.sigma**2 + spread.variance)
    search = MeanSearch(replace(part, sigma=sigma), families, random)
    chosen, tried = search.select()
    if chosen:
        spread = find_spread(part, cells, search.without(chosen), random)
    named += from_mean(search, chosen, part)
    if spread is not None:
        named.append(from_spread(spread))
    names, cosines, survival = search.identifiability()
    remaining = {"p_value": search.p_value(tried[0].score) if tried else 1.0, "note": "; ".join(part.notes)}
    table = {"names": [f"{part.sensor}.{name}" for name in names], "cosines": cosines.tolist(), "survival": survival.tolist()}
    everything = tuple(item for item in (chosen[0].tried if chosen else tried) if not item.name.startswith(PLACE))
    return named, _Naming(everything, remaining, table, search.reference_sigma(chosen))


def _names(measurement: Measurement, name: str) -> bool:
    return any(effect.name == name for effect in measurement.model.effects)


def _missing(measurement: Measurement, residuals: Residuals, rough: FloatArray, changed: BoolArray) -> list[Named]:
    if residuals.missing is None or _names(measurement, "precipitation") or _names(measurement, "detection_limit"):
        return []
    early = residuals.smooth & ~changed & (rough < -np.maximum(_EARLY_SIGMAS * residuals.sigma, _EARLY_M))
    found = find_missing(residuals.missing, int(early.sum()), len(residuals))
    return [] if found is None else [from_missing(found, measurement.cloud.intensity)]


def _gap(
    measurement: Measurement,
    versions: tuple[Version, ...],
    residuals: Residuals,
    rows: BoolArray,
    reference_sigma: float,
    scale: float,
    random: KeyedRandom,
) -> Gap | None:
    chosen = np.flatnonzero(rows)
    if len(chosen) < 100:
        return None
    part = residuals.part(chosen[thinned(len(chosen))])
    return measure_gap(measurement, versions[0], versions[1], part, reference_sigma, _CLIP * scale, random.child("verify"))


def _verdict(named: list[Named]) -> str:
    if not named:
        return "no_gap"
    if any(item.kind == "empirical" for item in named):
        return "unknown"
    if len(named) > 1:
        return "several"
    return "ambiguous" if named[0].alike else "named"
