"""Select effects from the training points: rounding and locking first, then systematic effects and noise terms in turn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement
from pipeline.gap.mean.candidates import Candidate, SineGrid
from pipeline.gap.mean.detection_power import DetectableSize
from pipeline.gap.mean.nonparametric_terms import SPATIAL_NULL
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.mean.selection import FamilyScore
from pipeline.gap.naming.candidate_families import candidate_families, model_has
from pipeline.gap.naming.named_effects import (
    NamedEffect,
    aligned_with,
    effect_from_estimate,
    effect_from_locking,
    effect_from_range_step,
    effect_from_seams,
    effect_from_variance,
    out_of_bounds,
    within_bounds,
)
from pipeline.gap.naming.nonlinear_refit import outline_effects, select_and_refit, with_classes_at_fit
from pipeline.gap.naming.search_beside_effects import repeat_search
from pipeline.gap.naming.search_outcome import SearchInput, SearchOutcome
from pipeline.gap.naming.search_residuals import with_added_variance, with_fitted_variance
from pipeline.gap.naming.selection_notes import note_left_out, notes_on_outcome
from pipeline.gap.noise_and_edges.grid_noise import find_grid_noise, separate_white_and_grid_noise
from pipeline.gap.noise_and_edges.noise_power import detectable_noise
from pipeline.gap.noise_and_edges.pixel_locking import Locking, NoiseBounds, find_locking
from pipeline.gap.noise_and_edges.rounded_ranges import find_range_step
from pipeline.gap.noise_and_edges.tile_seams import UnequalTiles, detectable_tile_shift, find_tile_seams, find_unequal_tiles
from pipeline.gap.noise_and_edges.variance_model import NoiseRatio, VarianceScore, VarianceTerm, fit_variance_model
from pipeline.gap.residuals.alignment import at_points_of, fit_pose_robustly
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.residuals.wall_blocks import WallCells
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.pixel_locking import PixelLocking
from sensors.effects.range_quantization import RangeQuantization
from sensors.effects.regularization_noise import RegularizationNoise
from sensors.effects.tile_shift import TileShift

_GRID_NOISE = RegularizationNoise.tag()
NONPARAMETRIC_TERMS = ("", True)
"""Stands for all families of non-parametric terms."""


@dataclass(frozen=True)
class SelectionResult:
    """What a selection of sensor errors (effects) yields beside the effects themselves: scores, tests and notes.

    Attributes
    ----------
    tried : scores of all systematic effects that were tried.
    variance_tried : scores of all noise terms that were tried.
    systematic : names of the selected systematic effects, such as "tls.range_offset", empirical ones included.
    p_value : p-value of the misfit that remains with all selected systematic effects in the model; None if nothing was left to
        try.
    p_without_effects : p-value of the misfit without any systematic effect in the model; None if nothing was tried.
    unexplained_noise : observed over predicted standard deviation within small squares of the wall; 1 if a noise term explains
        it.
    notes : notes for the report.
    identifiability : table with three keys: `names` of the effects; `cosines` between their signatures, the patterns of
        residuals that they make; and `survival`, the share of each signature that is left after the sensor's pose is fitted.
    reference_sigma : standard deviation of the error of the reference surface, in the unit of the observable (m or px).
    detectable : function that computes, for each effect that was not found, the size at which it would have been found with a
        probability of 95 %.
    p_value_beside : function that computes the p-value of the misfit beside some of the selected systematic effects, given by
        their names. It repeats the search with them in the model, and returns None if it cannot.
    """

    tried: tuple[FamilyScore, ...]
    variance_tried: tuple[VarianceScore, ...]
    systematic: frozenset[str]
    p_value: float | None
    p_without_effects: float | None
    unexplained_noise: NoiseRatio
    notes: tuple[str, ...]
    identifiability: dict[str, Any]
    reference_sigma: float
    detectable: Callable[[], tuple[DetectableSize, ...]]
    p_value_beside: Callable[[frozenset[str]], float | None] = lambda _: None

    def p_value_given(self, named: Sequence[NamedEffect]) -> float | None:
        """Return the p-value of the misfit that is left when the sensor model holds only some of the selected effects.

        It serves the verdict after validation has dropped effects. The p-values with all selected systematic effects and with
        none of them are known; for a part of them it is computed. None if nothing was left to try, or if it cannot be computed.

        named: effects that are kept.
        """
        kept = self.systematic & {item.name for item in named}
        if kept == self.systematic:
            return self.p_value
        return self.p_value_beside(kept) if kept else self.p_without_effects


@dataclass(frozen=True)
class SelectionInput:
    """Input of a selection of sensor errors (effects).

    Attributes
    ----------
    measurement : the training points (those that are not kept for validation), with their sensor model.
    part : residuals of these n points, measured minus predicted.
    noise_ratio : observed over predicted standard deviation of these residuals.
    random : source of random numbers for the null distributions.
    excluded : effects that are not tried, as pairs (name, whether it is an empirical term); `NONPARAMETRIC_TERMS` stands for
        all empirical terms.
    noise : (n,) registered residuals with a large error in the model, beside which the search is made; noise terms are fitted to
        them. None: there is no such error, and the registered residuals serve.
    grid_noise : noise that neighbouring points share, if a preceding selection found it in its residuals. It is then part of
        the model from the start, because it imitates empirical terms and errors of the reference. None in a first selection.
    """

    measurement: Measurement
    part: Residuals
    noise_ratio: float
    random: KeyedRandom
    excluded: frozenset[tuple[str, bool]] = frozenset()
    noise: FloatArray | None = None
    grid_noise: VarianceTerm | None = None

    def registered(self, part: Residuals) -> FloatArray:
        """Return the (n,) residuals to which noise terms are fitted first. part: the residuals, with their predicted noise."""
        return fit_pose_robustly(part)[0] if self.noise is None else self.noise

    def without(self, families: frozenset[tuple[str, bool]]) -> SelectionInput:
        """Return the input of a selection that does not try some further effects, given as pairs like `excluded`."""
        return replace(self, excluded=self.excluded | families, grid_noise=None)


@dataclass(frozen=True, eq=False)
class SelectionStart:
    """The first, linearised search of a selection, and what must be known before.

    Attributes
    ----------
    given : input of the selection, in which effects whose noise terms are implausible count as not to be tried.
    tiles : shifts of a stereo matcher's tiles, which are in the sensor model of `given`; None without.
    apart : rounded ranges or locked disparities.
    noise : noise terms beside no systematic effect.
    search : input of all searches for systematic effects.
    first : the linearised search.
    """

    given: SelectionInput
    tiles: NamedEffect | None
    apart: _FoundApart
    noise: _FittedNoise
    search: SearchInput
    first: MeanSearch

    @classmethod
    def of(cls, given: SelectionInput) -> SelectionStart:
        """Set up the linearised search for effects, after those that are found by tests of their own.

        These are shifted tiles of a stereo matcher, rounded ranges, pixel locking and noise terms.
        """
        tiles = _shifted_tiles(given)
        given = given if tiles is None else _beside_tiles(given, tiles)
        apart = _FoundApart.of(given)
        part = with_added_variance(given.part, apart.variance)
        noise = _FittedNoise.of(given, part, WallCells.over(part.wall_xy), given.registered(part))
        while wrong := noise.implausible(given.measurement):
            given = given.without(wrong)
            noise = _FittedNoise.of(given, part, WallCells.over(part.wall_xy), given.registered(part))
        families = _families(given, part, apart)
        terms_at = partial(_noise_terms_at, given, part)
        known = [] if given.grid_noise is None else [given.grid_noise]
        first = MeanSearch(with_fitted_variance(part, noise.terms or known, apart.noise_ratio), families, given.random)
        search = SearchInput(given.measurement, part, families, terms_at, apart.variance, given.random)
        return cls(given, tiles, apart, noise, search, first)

    def outline(self) -> list[NamedEffect]:
        """Return the effects that the linearised search selects, fitted once more: jointly, and with the full sensor model.

        They may be the wrong ones, but together they explain most of what is systematic in the residuals. That suffices to search
        effects at depth steps beside them, and takes much less time than `select_effects`.
        """
        apart = [*self.apart.named] if self.tiles is None else [self.tiles, *self.apart.named]
        estimates = outline_effects(self.search, self.first)
        return [*apart, *(effect_from_estimate(each, self.search.part) for each in estimates)]


def select_effects(start: SelectionStart) -> tuple[list[NamedEffect], SelectionResult]:
    """Find the systematic sensor errors and noise terms that explain the residuals of a measurement (forward selection).

    A linearised search finds systematic effects. They are put into the sensor model, residuals are computed again, and further
    effects are searched. Strong effects are refitted without linearising. Noise terms are fitted to the remaining residuals and
    weight the next search. If the fitted value of an effect is implausible, the effect is excluded, and the selection is
    repeated. The effects that were found are returned, and the scores and tests of the selection.

    start : the linearised search, made from the residuals of the training points.
    """
    named, result = _select_effects(start)
    if (tiles := start.tiles) is None:
        return named, result

    def beside(kept: frozenset[str]) -> float | None:
        return result.p_value_given([each for each in named if each.name in kept]) if tiles.name in kept else None

    return [tiles, *named], replace(result, systematic=result.systematic | {tiles.name}, p_value_beside=beside)


def _select_effects(start: SelectionStart) -> tuple[list[NamedEffect], SelectionResult]:
    """Select effects; shifted tiles that were found are in the sensor model already."""
    given, search, noise = start.given, start.search, start.noise
    found = select_and_refit(search, start.first)
    wrong = out_of_bounds(given.measurement, found.estimates, found.residuals)
    design = found.search.design
    left = design.residuals_after([each.candidate for each in found.further])
    if found.chosen and not wrong:
        noise = _FittedNoise.of(given, found.residuals, design.cells, left)
    if not noise.terms:
        refound, noise = _with_grid_noise(given, search.part, found, left, noise)
        if refound is not None:
            return _select_effects(SelectionStart.of(replace(given, grid_noise=refound)))
    if wrong := (wrong | noise.implausible(given.measurement)) - given.excluded:
        return _select_effects(SelectionStart.of(given.without(wrong)))
    found = with_classes_at_fit(search, found)
    systematic = [effect_from_estimate(each, found.residuals) for each in found.estimates]
    result = _result(start, found, noise, left, frozenset(item.name for item in systematic))
    noise_terms = (effect_from_variance(each, given.part.sensor) for each in noise.terms)
    return [*start.apart.named, *systematic, *noise_terms], result


def _shifted_tiles(given: SelectionInput) -> NamedEffect | None:
    """Find shifts of a stereo matcher's tiles, unless the model has them or they are not to be tried."""
    part, known = given.part, (TileShift.tag(), False) in given.excluded or model_has(given.measurement, TileShift.tag())
    seams = find_tile_seams(part, given.registered(part)) if isinstance(part, StereoResiduals) and not known else None
    return None if seams is None else effect_from_seams(seams)


@dataclass(frozen=True)
class _FoundApart:
    """Rounded ranges or locked disparities, which are found before all other effects.

    named: the effect; variance: variance of its error, squared unit of the observable; noise_ratio: observed over predicted
    standard deviation beside it; locking: the pixel locking, if that is the effect.
    """

    named: list[NamedEffect]
    variance: float
    noise_ratio: float
    locking: Locking | None = None

    @classmethod
    def of(cls, given: SelectionInput) -> _FoundApart:
        """Find rounding and locking that the model does not have."""
        part, measurement = given.part, given.measurement
        if isinstance(part, TlsResiduals) and not model_has(measurement, RangeQuantization.tag()):
            step = find_range_step(part.geometry.measured_m)
            if step is not None:
                return cls([effect_from_range_step(step, part)], step.step_m**2 / 12, 1.0)
        if isinstance(part, StereoResiduals) and not model_has(measurement, PixelLocking.tag()):
            at, residual = part.geometry, given.registered(part)
            allowed = NoiseBounds(float(np.median(part.sigma)), nmad(residual))
            locking = find_locking(at.found, at.disparity, at.tangent, at.infinity, allowed, residual)
            if locking is not None:
                return cls([effect_from_locking(locking)], locking.amplitude_px**2 / 2, given.noise_ratio, locking)
        return cls([], 0.0, given.noise_ratio)


@dataclass(frozen=True)
class _FittedNoise:
    """Noise terms that were fitted to residuals, the scores of all that were tried, and a note on variance that none explains."""

    terms: list[VarianceTerm]
    tried: list[VarianceScore]
    note: str

    @classmethod
    def of(cls, given: SelectionInput, part: Residuals, cells: WallCells, value: FloatArray) -> _FittedNoise:
        """Fit the noise. value: (n,) residuals after the systematic effects."""
        names = frozenset(name for name, empirical in given.excluded if not empirical)
        found, tried, note = fit_variance_model(part, cells, value, given.random, names)
        if isinstance(given.measurement, StereoMeasurement) and isinstance(part, StereoResiduals):
            before, found = found, separate_white_and_grid_noise(found, part, value, given.measurement.model)
            note = note if [each.empirical for each in before] == [each.empirical for each in found] else ""
        return cls([each for each in found if each.effect not in names], tried, note)

    def implausible(self, measurement: Measurement) -> frozenset[tuple[str, bool]]:
        """Families of noise terms whose values are outside the bounds of their effect."""
        entries = {each.effect: effect_from_variance(each, measurement.sensor).entry for each in self.terms}
        return frozenset((name, False) for name, entry in entries.items() if not within_bounds(measurement.model, entry))


def _families(given: SelectionInput, part: Residuals, apart: _FoundApart) -> list[Candidate | SineGrid]:
    """Families of systematic effects to try."""
    out = given.excluded | {(each.entry["name"], False) for each in apart.named}
    possible = (each for each in candidate_families(given.measurement, part) if (each.name, each.empirical) not in out)
    return [each for each in possible if not (each.empirical and NONPARAMETRIC_TERMS in out)]


def _noise_terms_at(given: SelectionInput, part: Residuals, at: Residuals) -> list[VarianceTerm]:
    """Fit noise terms to other residuals of some of the points of `part`; if none is found, the known grid noise remains."""
    fitted = _FittedNoise.of(given, at, WallCells.over(at.wall_xy), fit_pose_robustly(at)[0]).terms
    if fitted or given.grid_noise is None:
        return fitted
    return [replace(given.grid_noise, variance=given.grid_noise.variance[np.isin(part.index, at.index)])]


def _with_grid_noise(
    given: SelectionInput, part: Residuals, found: SearchOutcome, left: FloatArray, noise: _FittedNoise
) -> tuple[VarianceTerm | None, _FittedNoise]:
    """Search noise that neighbouring points share, where no other noise was found.

    Returns
    -------
    The grid noise beside which the selection must be repeated, or None; and the noise with it.
    """
    if (_GRID_NOISE, False) in given.excluded:
        return None, noise
    match given.measurement, part, found.residuals:
        case StereoMeasurement(model=model), StereoResiduals(), StereoResiduals():
            noise_left, shared = find_grid_noise(found.residuals, left, model, given.random)
            described = any(each.candidate.empirical for each in found.estimates)
            if noise_left is not None and given.grid_noise is None:
                in_all = find_grid_noise(part, given.registered(part), model, given.random)[0] if described else None
                return in_all or noise_left.with_constant_variance(len(part)), noise
            kept = noise_left or (None if described else given.grid_noise)
            return None, replace(noise, terms=[] if kept is None else [kept], note=noise.note or (shared if kept is None else ""))
    return None, noise


def _result(
    start: SelectionStart, found: SearchOutcome, noise: _FittedNoise, left: FloatArray, systematic: frozenset[str]
) -> SelectionResult:
    """Return the scores and tests of a selection.

    left: (n,) residuals after its systematic effects; systematic: their names.
    """
    given, first, design = start.given, start.first, found.search.design
    tiles = _unequal_tiles(given, start.apart.locking, found, left)
    p_without_effects = first.goodness_of_fit_p_value(first.score_families(())) if found.estimates else found.p_value
    names, cosines, survival = first.design.identifiability
    tried = found.chosen[0].family_scores if found.chosen else found.tried
    return SelectionResult(
        tried=tuple(item for item in tried if not item.name.startswith(SPATIAL_NULL)),
        variance_tried=tuple(noise.tried),
        systematic=systematic,
        p_value=_smaller_p_value(found.p_value, tiles),
        p_without_effects=_smaller_p_value(p_without_effects, tiles),
        unexplained_noise=(
            NoiseRatio(1.0, False) if noise.terms else NoiseRatio.of(found.residuals, design.cells, left, given.random)
        ),
        notes=(
            *given.part.notes,
            *note_left_out(given.excluded - {NONPARAMETRIC_TERMS}),
            *filter(None, [noise.note, tiles.note if tiles else ""]),
            *notes_on_outcome(found, given.part),
        ),
        identifiability={
            "names": [f"{given.part.sensor}.{name}" for name in names],
            "cosines": cosines.tolist(),
            "survival": survival.tolist(),
        },
        reference_sigma=design.reference_sigma([each.candidate for each in found.further]),
        detectable=lambda: _detectable_sizes(found, [each.effect for each in noise.terms], left, given.random),
        p_value_beside=cache(lambda kept: _smaller_p_value(_p_value_beside(start.search, found, kept), tiles)),
    )


def _unequal_tiles(given: SelectionInput, locking: Locking | None, found: SearchOutcome, left: FloatArray) -> UnequalTiles | None:
    """Find tiles of the image that are shifted by unequal amounts.

    They are not searched for where the model has, or this selection found, pixel locking or shifted tiles, because these make
    jumps too. left: (n,) residuals after the systematic effects.
    """
    if locking is not None or any(model_has(given.measurement, effect.tag()) for effect in (TileShift, PixelLocking)):
        return None
    return find_unequal_tiles(found.residuals, left) if isinstance(found.residuals, StereoResiduals) else None


def _smaller_p_value(p_value: float | None, tiles: UnequalTiles | None) -> float | None:
    """The p-value of a misfit, or that of shifted tiles if it is smaller."""
    return p_value if tiles is None else min(1.0 if p_value is None else p_value, tiles.p_value)


def _p_value_beside(points: SearchInput, found: SearchOutcome, kept: frozenset[str]) -> float | None:
    """Return the p-value of the misfit beside some of the effects that were found, whose sizes are fitted anew.

    kept: their names, with the sensor's prefix. None if one of them is unknown or an empirical term, or if the search fails.
    """
    estimates = {f"{points.part.sensor}.{each.candidate.name}": each for each in found.estimates if not each.candidate.empirical}
    if not kept <= set(estimates):
        return None
    again = repeat_search(points, found, [estimates[name] for name in sorted(kept)])
    return None if again is None else again.search.goodness_of_fit_p_value(again.search.score_families(()))


def _detectable_sizes(
    found: SearchOutcome, noise_terms: Sequence[str], left: FloatArray, random: KeyedRandom
) -> tuple[DetectableSize, ...]:
    """Sizes from which effects that were not found would have shown. left: (n,) residuals after the systematic effects."""
    members = [each.candidate for each in found.further]
    systematic = found.search.detectable_sizes(members, found.tried, random.child("power"))
    noise = detectable_noise(found.residuals, found.search.design.cells, left, noise_terms, random)
    tiles = [detectable_tile_shift(found.residuals, left)] if isinstance(found.residuals, StereoResiduals) else []
    return (*systematic, *tiles, *noise)


def _beside_tiles(given: SelectionInput, tiles: NamedEffect) -> SelectionInput:
    """Put the shifts of tiles into the sensor model, and return the input of a selection with the residuals that are left."""
    aligned, found, _ = aligned_with(given.measurement, [tiles], given.part.index)
    at = at_points_of(found, given.part)
    ratio = fit_pose_robustly(at)[2]
    return replace(given, measurement=aligned, part=at, noise_ratio=ratio, noise=None, grid_noise=None)
