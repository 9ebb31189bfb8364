"""Explanations of the mean with the effects in the model, where the first search had only slopes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.decisions import decided
from pipeline.gap.mean.candidates import (
    HARMONIC_ORDERS,
    HARMONICS,
    Candidate,
    ExplanationKey,
    SineGrid,
    harmonics,
    prior_precision,
)
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.mean.selection import FamilyScore, SelectedEffect, equivalence_margin
from pipeline.gap.naming.entries import Estimate, from_mean, is_possible, settled_with, typical_sizes
from pipeline.gap.naming.families import PERIODIC, effects_of, families_of
from pipeline.gap.other.spread import SpreadFound
from pipeline.gap.residuals.alignment import AlignedMeasurement, fit_pose_robustly
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects import effect_of
from sensors.effects.matching_noise import MatchingNoise

_MOST_CONVERGED, _ROUNDS, _CONVERGED = 3, 8, 1.0
"""Effects whose values are sought exactly, by so many rounds, while the log-likelihood rises by so much."""
_MADE_UP = 0.5
"""Share of what an effect gains that may be what slopes are wrong by."""
_MOST_FITS, _FITTED = 10, 0.005
"""Rounds of a fit of all effects together, and the share by which its sum of squares falls at the least."""


@dataclass(frozen=True)
class SearchedPoints:
    """What the searches for effects on the mean share. spread_at: effects on the spread by residuals of these points with some
    effects on the mean in the model; added: variance to add to the predicted one."""

    measurement: Measurement
    part: Residuals
    families: list[Candidate | SineGrid]
    spread_at: Callable[[Residuals], list[SpreadFound]]
    added: float
    random: KeyedRandom


@dataclass(frozen=True)
class Explained:
    """Effects that a search chose, and what a search beside them, taken exactly, found.

    estimates: of both; search, at, tried: the last search, its residuals and what it tried; beside: what it chose.
    """

    chosen: list[SelectedEffect]
    estimates: list[Estimate]
    search: MeanSearch
    at: Residuals
    beside: list[SelectedEffect]
    tried: tuple[FamilyScore, ...]

    @property
    def complexity(self) -> tuple[int, int]:
        """Empirical terms, and all effects."""
        return sum(each.candidate.empirical for each in self.estimates), len(self.estimates)


@dataclass(frozen=True)
class _Alone:
    """One effect in the model. at: residuals against that; log_likelihood: of all points."""

    estimate: Estimate
    at: Residuals
    there: Measurement
    log_likelihood: float

    @property
    def name(self) -> str:
        """The effect's."""
        return self.estimate.candidate.name

    @property
    def score(self) -> float:
        """Of all points, less what the effect costs."""
        return self.log_likelihood - (self.estimate.chosen.log_likelihood_ratio - self.estimate.chosen.score)

    @classmethod
    def of(cls, points: SearchedPoints, first: MeanSearch, estimate: Estimate) -> _Alone | None:
        """None where it is beyond what can be, or where the rays of many points would miss the reference with it."""
        if beyond(points.measurement, [estimate], points.part):
            return None
        there, found, _ = _with(points, [estimate])
        found = found.part(np.isin(found.index, points.part.index))
        rough, _, scale = fit_pose_robustly(found)
        largest = decided().points.outlier * scale * found.sigma
        value, kept = np.zeros(len(points.part)), _kept(found, points.part)
        if kept.mean() < decided().points.kept:
            return None
        value[kept] = np.where(found.usable, np.clip(rough, -largest, largest), 0.0)
        return cls(estimate, at_points(found, points.part), there, first.design.log_likelihood(value, estimate.candidate))

    def better(self, points: SearchedPoints, first: MeanSearch) -> _Alone | None:
        """With its values moved by the slopes here."""
        candidate = _renewed(self.estimate.candidate, families_of(self.there, self.at))
        width = candidate.columns.shape[1]
        step = _step(self.at, candidate.columns, prior_precision(candidate, width), np.zeros(width))
        return _Alone.of(points, first, replace(self.estimate, values=self.estimate.values + step))


def followed_up(points: SearchedPoints, first: MeanSearch) -> Explained:
    """What the first search chose, with what stands beside it when it is taken exactly.

    Slopes miss some of a large effect, and others then make up for it: where one alone, taken exactly, needs fewer beside it,
    or those that are found by slopes where all effects together fit best, that is the explanation.
    """
    together, tried = first.select()
    plain = Explained(together, _estimates(first, together), first, points.part, together, tried)
    alone = _largest_alone(points, first, together) if together else []
    if not alone:
        return _beside(points, plain) or plain
    by_itself = _beside_one(points, plain, alone)
    if by_itself is not None and len(by_itself.estimates) > 1:
        others = {each.candidate.name for each in by_itself.estimates if not each.candidate.empirical}
        more = _with_others(points, first, alone, others)
        if more[0] is not alone[0]:
            by_itself = _beside_one(points, plain, more) or by_itself
    if by_itself is not None and len(by_itself.estimates) == 1:
        return by_itself
    there = searched_at_best_fit(points)
    found = [_beside(points, plain) or plain]
    if by_itself is not None:
        found.insert(0, by_itself)
    if there is not None and there.chosen:
        found.append(_beside(points, there) or there)
    possible = [each for each in found if not beyond(points.measurement, each.estimates, each.at)]
    return min(possible, key=lambda each: each.complexity, default=plain)


def searched_at_best_fit(points: SearchedPoints) -> Explained | None:
    """What a search chooses by slopes where all effects of the catalogue together, none far beyond its typical size, fit best.

    There the rays go where they went, whichever of the effects turned them: slopes are the true ones, and to what is left by all
    of them the part of each is added again. None where one of them would be beyond what can be.
    """
    plain = [each for each in points.families if isinstance(each, Candidate) and not each.empirical]
    fitted = fitted_together(points, plain)
    if fitted is None:
        return None
    there, at, explained = fitted
    allowed = {(family.name, family.empirical) for family in points.families}
    families = [each for each in families_of(there, at) if (each.name, each.empirical) in allowed]
    left = replace(at, value=at.value + explained)
    heavier = replace(_weighed_at(points, at), value=left.value)
    search = MeanSearch(heavier, families, points.random.child("best fit"))
    together, tried = search.select()
    return Explained(together, _estimates(search, together), search, left, together, tried)


def fitted_together(points: SearchedPoints, candidates: list[Candidate]) -> tuple[Measurement, Residuals, FloatArray] | None:
    """The measurement with some effects in its model, what is left there, and how much (n,) they explain by slopes there."""
    there, at, before = points.measurement, points.part, np.inf
    widths = [each.columns.shape[1] for each in candidates]
    values = np.zeros(sum(widths))
    for _ in range(_MOST_FITS):
        after = float(np.mean((at.value / at.sigma) ** 2))
        if after > (1 - _FITTED) * before:
            break
        before = after
        precision = np.concatenate([prior_precision(each, width) for each, width in zip(candidates, widths, strict=True)])
        values = values + _step(at, _all_columns(candidates), precision, values)
        parts = np.split(values, np.cumsum(widths)[:-1])
        estimates = [_unchosen(each, part) for each, part in zip(candidates, parts, strict=True)]
        if beyond(points.measurement, estimates, at):
            return None
        there, found, _ = _with(points, estimates)
        at = noisier(at_points(found, points.part), points.added)
        if _has_lost(points, at):
            return None
        renewed = effects_of(there, at)
        candidates = [_renewed(each, renewed) for each in candidates]
    explained: FloatArray = _all_columns(candidates) @ values
    return there, at, explained


def _has_lost(points: SearchedPoints, at: Residuals) -> bool:
    """Whether too few of the points are left to search among."""
    return len(at) < decided().points.kept * len(points.part)


def _all_columns(candidates: list[Candidate]) -> FloatArray:
    columns: FloatArray = np.concatenate([each.columns for each in candidates], axis=1)
    return columns


def _unchosen(candidate: Candidate, values: FloatArray) -> Estimate:
    """An effect of some size for which nothing speaks yet."""
    nothing = SelectedEffect(candidate, (), 1.0, 0.0, 0.0, ())
    return Estimate(nothing, candidate, values, np.zeros((len(values), len(values))))


def _step(at: Residuals, columns: FloatArray, precision: FloatArray, values: FloatArray) -> FloatArray:
    """(k,) by how much values (k,) change: least squares by slopes (n, k), the pose free and each value known to be near 0."""
    design = np.concatenate([at.pose_jacobian, columns], axis=1) / at.sigma[:, None]
    known, pull = np.zeros(design.shape[1]), np.zeros(design.shape[1])
    start = at.pose_jacobian.shape[1]
    known[start:], pull[start:] = precision, precision * values
    found = np.linalg.solve(design.T @ design + np.diag(known), design.T @ (at.value / at.sigma) - pull)
    return np.asarray(found[start:])


def _largest_alone(points: SearchedPoints, first: MeanSearch, together: list[SelectedEffect]) -> list[_Alone]:
    """The effects that explain most by themselves, of those that explain much, best first; none where slopes say all: where they
    are wrong by less than anything gains that was chosen."""
    found: list[_Alone] = []
    serve = min([decided().mean.slopes_serve, *(_MADE_UP * each.log_likelihood_ratio for each in together)])
    for candidate in first.leading_effects():
        alone = _taken_exactly(points, first, candidate)
        if alone is None:
            continue
        by_slopes = first.design.log_likelihood(points.part.value, candidate)
        if not found and abs(alone.log_likelihood - by_slopes) < serve:
            return []
        found.append(alone)
    if not found:
        return []
    likeliest = _likeliest(points, first, found)
    return _with_others(points, first, likeliest, set(likeliest[0].estimate.chosen.indistinguishable))


def _with_others(points: SearchedPoints, first: MeanSearch, alone: list[_Alone], names: set[str]) -> list[_Alone]:
    """With more effects, of which slopes may miss nearly all, and those that slopes cannot tell from the best; best first.

    Of each the parameters that slopes ask for, in every camera.
    """
    others = {item.name: item.candidate.names for item in first.score_families(()) if not item.empirical and item.name in names}
    for each in alone:
        others.pop(each.name, None)
    plain = (each for each in first.design.families.plain if not each.empirical)
    variants = [each for each in plain if each.names == others.get(each.name)]
    more = [each for each in (_taken_exactly(points, first, variant) for variant in variants) if each is not None]
    if not more:
        return alone
    ranked = sorted([*alone, *_likeliest(points, first, more)], key=lambda each: -each.score)
    return _with_others(points, first, ranked, set(ranked[0].estimate.chosen.indistinguishable))


def _taken_exactly(points: SearchedPoints, first: MeanSearch, candidate: Candidate) -> _Alone | None:
    """One effect in the model, at the values that slopes give it."""
    (estimate,) = _estimates(first, [first.selected_alone(candidate)])
    return _Alone.of(points, first, estimate)


def _likeliest(points: SearchedPoints, first: MeanSearch, found: list[_Alone]) -> list[_Alone]:
    """A variant of each of the likeliest effects, at the values that explain most, best first; of the best effect the best of the
    likeliest variants: which camera it is may not show before."""
    ranked = sorted(found, key=lambda each: -each.log_likelihood)
    variants = {each.name: each for each in reversed(ranked)}
    likely = sorted(variants.values(), key=lambda each: -each.log_likelihood)[:_MOST_CONVERGED]
    best, *rest = sorted((_converged(points, first, each) for each in likely), key=lambda each: -each.score)
    others = [each for each in ranked if each.name == best.name and each is not variants[best.name]][: _MOST_CONVERGED - 1]
    best = max([best, *(_converged(points, first, each) for each in others)], key=lambda each: each.score)
    return [best, *rest]


def _beside_one(points: SearchedPoints, plain: Explained, alone: list[_Alone]) -> Explained | None:
    """With what a search finds beside the best of some effects alone."""
    estimate = _with_class(alone).estimate
    return _beside(points, replace(plain, chosen=[estimate.chosen], estimates=[estimate]))


def _with_class(converged: list[_Alone]) -> _Alone:
    """The best, with those that would do as well: slopes say so of effects that were not taken exactly only."""
    best, *others = converged
    chosen = best.estimate.chosen
    least = best.score - equivalence_margin(chosen.log_likelihood_ratio)
    near = {each.name for each in others if each.score > least}
    slopes = set(chosen.indistinguishable) - {each.name for each in others}
    return replace(best, estimate=replace(best.estimate, chosen=replace(chosen, indistinguishable=tuple(sorted(near | slopes)))))


def _converged(points: SearchedPoints, first: MeanSearch, alone: _Alone) -> _Alone:
    """At the values that explain most."""
    for _ in range(_ROUNDS):
        better = alone.better(points, first)
        if better is None or better.log_likelihood < alone.log_likelihood + _CONVERGED:
            break
        alone = better
    return alone


def _beside(points: SearchedPoints, chosen: Explained) -> Explained | None:
    """With what a search finds beside the effects; None where there are none, or where they are beyond what can be."""
    physical = [each for each in chosen.estimates if not each.candidate.empirical]
    if not physical or beyond(points.measurement, chosen.estimates, chosen.at):
        return None
    again = _again(points, physical, chosen.search.single_effect_ratios)
    if again is None:
        return None
    search, at, estimates, beside, tried = again
    return replace(chosen, estimates=estimates, search=search, at=at, beside=beside, tried=tried)


def beyond(measurement: Measurement, estimates: list[Estimate], part: Residuals) -> frozenset[tuple[str, bool]]:
    """Families whose estimate lies beyond the bounds of the effect."""
    wrong = [each for each in estimates if not is_possible(measurement.model, from_mean(each, part).entry)]
    return frozenset((each.candidate.name, each.candidate.empirical) for each in wrong)


def undone(estimates: list[Estimate], part: Residuals, survival: Mapping[str, float]) -> frozenset[tuple[str, bool]]:
    """Effects far beyond their typical size of which the registration leaves next to nothing. survival: that share by name."""
    by = decided().mean
    doubtful = [each for each in estimates if not each.candidate.empirical and survival[each.candidate.name] < by.undone_share]
    large = [each for each in doubtful if typical_sizes(from_mean(each, part).entry) > by.undone_size]
    return frozenset((each.candidate.name, False) for each in large)


def noisier(part: Residuals, variance: float) -> Residuals:
    return replace(part, sigma=np.sqrt(part.sigma**2 + variance)) if variance else part


def weighed(part: Residuals, spread: list[SpreadFound], scale: float) -> Residuals:
    """With the spread that the points really have, as it counts for means of neighbours."""
    part = part.with_sigma_of_means
    if not spread:
        return replace(part, sigma=part.sigma * scale)
    made = (effect_of(each.effect)(**each.parameters) for each in spread if each.parameters)
    shared = [effect for effect in made if isinstance(effect, MatchingNoise)]
    sigma = np.sqrt(part.sigma**2 + sum(each.variance for each in spread))
    return replace(part, sigma=sigma, correlated_noise=part.correlated_noise.with_effects(shared))


def _estimates(search: MeanSearch, chosen: list[SelectedEffect]) -> list[Estimate]:
    candidates, fit = search.design.fit_refined([item.candidate for item in chosen])
    places = search.design.split_coefficients(np.arange(len(fit.coefficients)), candidates)
    return [
        Estimate(item, candidate, fit.coefficients[place], fit.covariance[np.ix_(place, place)])
        for item, candidate, place in zip(chosen, candidates, places, strict=True)
    ]


def _again(
    points: SearchedPoints, had: list[Estimate], alone: Mapping[ExplanationKey, float]
) -> tuple[MeanSearch, Residuals, list[Estimate], list[SelectedEffect], tuple[FamilyScore, ...]] | None:
    """The search beside effects that the model now has, whose values are free to move a little: they count as pose.

    alone: what each explanation gains by itself. Returns the search, its residuals, the effects with what was found beside them,
    that only, and what was tried last; None where the rays of many points would miss the reference with them.
    """
    part = points.part
    there, found, _ = _with(points, had)
    at = noisier(at_points(found, part), points.added)
    if _has_lost(points, at):
        return None
    renewed = families_of(there, at)
    allowed = {(family.name, family.empirical) for family in points.families}
    names = {each.candidate.name for each in had}
    others = [each for each in renewed if (each.name, each.empirical) in allowed and (each.empirical or each.name not in names)]
    known = [replace(each, candidate=_renewed(each.candidate, renewed)) for each in had]
    columns = [_columns(each) for each in known]
    periodic = [(PERIODIC[name], each.candidate) for each in known if (name := each.candidate.name) in PERIODIC]
    others += [harmonics(covariate, sine, last) for covariate, sine in periodic for last in HARMONIC_ORDERS]
    heavier = _weighed_at(points, at)
    precision = [prior_precision(each.candidate, matrix.shape[1]) for each, matrix in zip(known, columns, strict=True)]
    search = MeanSearch(
        replace(heavier, pose_jacobian=np.concatenate([at.pose_jacobian, *columns], axis=1)),
        others,
        points.random.child("again"),
        np.concatenate([np.zeros(at.pose_jacobian.shape[1]), *precision]),
        alone,
    )
    chosen, tried = search.select()
    fit = search.design.fit_refined([item.candidate for item in chosen])[1]
    kept, start = [], at.pose_jacobian.shape[1]
    for each, matrix in zip(known, columns, strict=True):
        place = slice(start, start := start + matrix.shape[1])
        kept.append(replace(each, values=each.values + fit.coefficients[place], covariance=fit.covariance[place, place]))
    return search, at, _without_sines([*kept, *_estimates(search, chosen)]), chosen, tried


def _weighed_at(points: SearchedPoints, at: Residuals) -> Residuals:
    """Residuals with some effects on the mean in the model, with the spread that they have there: without those in the model what
    they do looks like noise, beside which nothing small would be seen."""
    return weighed(at, points.spread_at(at), fit_pose_robustly(at)[2])


def _with(points: SearchedPoints, effects: list[Estimate]) -> AlignedMeasurement:
    """The measurement with some effects in its model, settled."""
    return settled_with(points.measurement, [from_mean(each, points.part) for each in effects], points.part.index)


def _without_sines(estimates: list[Estimate]) -> list[Estimate]:
    """A named sine with overtones becomes one empirical term."""
    found = list(estimates)
    for overtones in (each for each in estimates if each.candidate.form == HARMONICS):
        sine = next(each for each in estimates if PERIODIC.get(each.candidate.name) == overtones.candidate.name)
        both = np.concatenate([sine.candidate.columns, overtones.candidate.columns], axis=1)
        width = sine.candidate.columns.shape[1]
        values = np.concatenate([sine.values[:width], overtones.values])
        found = [each for each in found if each is not sine and each is not overtones]
        found.append(replace(overtones, candidate=replace(overtones.candidate, matrix=both), values=values))
    return found


def at_points(found: Residuals, part: Residuals) -> Residuals:
    """What was found at the points of a part, where the surface is smooth there too and they are no outliers."""
    rough, _, scale = fit_pose_robustly(found)
    good = found.usable & (np.abs(rough) < decided().points.outlier * scale * found.sigma)
    place = np.full(int(max(found.index.max(initial=-1), part.index.max())) + 1, -1)
    place[found.index[good]] = np.flatnonzero(good)
    rows = place[part.index]
    return found.part(rows[rows >= 0])


def _kept(at: Residuals, part: Residuals) -> BoolArray:
    """Which points of the part are left."""
    return np.isin(part.index, at.index)


def _renewed(candidate: Candidate, families: list[Candidate | SineGrid]) -> Candidate:
    """The same candidate for other rays."""
    key = "" if candidate.wave is None else candidate.wave.key
    chosen = {name: value for name, value in candidate.fixed.items() if name != key}
    for family in families:
        if family.name == candidate.name and not family.empirical and dict(family.fixed) == chosen:
            if isinstance(family, SineGrid):
                return family.at_period(candidate.period)
            if family.names == candidate.names:
                return family
    raise KeyError(candidate.name)


def _columns(found: Estimate) -> FloatArray:
    """(n, k) of its coefficients, a sine's with that of its frequency."""
    wave = found.candidate.wave
    return found.candidate.columns if wave is None else wave.with_frequency_derivative(found.candidate.period, found.values[:2])
