"""Explanations of the mean with the effects in the model, where the first search had only slopes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.mean.candidates import HARMONICS, OVERTONES, Candidate, Explanation, SineGrid, harmonics, precision_of
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.mean.selection import Chosen, Tried, class_margin
from pipeline.gap.naming.candidate_families import PERIODIC, candidate_families, catalogue_families
from pipeline.gap.naming.named_effects import Estimate, aligned_with, effect_from_estimate, is_plausible, relative_size
from pipeline.gap.noise_and_edges.variance_model import VarianceTerm
from pipeline.gap.residuals.registration import Settled, registered
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects import effect_of
from sensors.effects.matching_noise import MatchingNoise

_MOST_CONVERGED, _MOST_ROUNDS, _CONVERGED_GAIN = 3, 8, 1.0
"""Effects whose values are sought exactly, by so many rounds, while the log-likelihood rises by so much."""
_ABSORBED_SHARE = 0.5
"""Share of what an effect gains that may be what slopes are wrong by."""
_MOST_FITS, _CONVERGED_DECREASE = 10, 0.005
"""Rounds of a fit of all effects together, and the share by which its sum of squares falls at the least."""


@dataclass(frozen=True)
class SearchInput:
    """What the searches for effects on the mean share. spread_at: effects on the spread by residuals of these points with some
    effects on the mean in the model; added: variance to add to the predicted one."""

    measurement: Measurement
    part: Residuals
    families: list[Candidate | SineGrid]
    spread_at: Callable[[Residuals], list[VarianceTerm]]
    added: float
    random: KeyedRandom


@dataclass(frozen=True)
class SearchOutcome:
    """Effects that a search chose, and what a search beside them, taken exactly, found.

    estimates: of both; search, at, tried: the last search, its residuals and what it tried; beside: what it chose.
    """

    chosen: list[Chosen]
    estimates: list[Estimate]
    search: MeanSearch
    at: Residuals
    beside: list[Chosen]
    tried: tuple[Tried, ...]

    @property
    def complexity(self) -> tuple[int, int]:
        """Empirical terms, and all effects."""
        return sum(each.candidate.empirical for each in self.estimates), len(self.estimates)


@dataclass(frozen=True)
class _SingleFit:
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
        return self.log_likelihood - (self.estimate.chosen.gain - self.estimate.chosen.score)

    @classmethod
    def of(cls, points: SearchInput, first: MeanSearch, estimate: Estimate) -> _SingleFit | None:
        """None where it is beyond what can be, or where the rays of many points would miss the reference with it."""
        if out_of_bounds(points.measurement, [estimate], points.part):
            return None
        there, found, _ = _aligned_with_estimates(points, [estimate])
        found = found.part(np.isin(found.index, points.part.index))
        rough, _, scale = registered(found)
        largest = thresholds().points.outlier_sigmas * scale * found.sigma
        value, kept = np.zeros(len(points.part)), _still_present(found, points.part)
        if kept.mean() < thresholds().points.least_share_on_reference:
            return None
        value[kept] = np.where(found.smooth, np.clip(rough, -largest, largest), 0.0)
        return cls(estimate, at_points_of(found, points.part), there, first.design.log_likelihood(value, estimate.candidate))

    def better(self, points: SearchInput, first: MeanSearch) -> _SingleFit | None:
        """With its values moved by the slopes here."""
        candidate = _recomputed(self.estimate.candidate, candidate_families(self.there, self.at))
        width = candidate.columns.shape[1]
        step = _gauss_newton_step(self.at, candidate.columns, precision_of(candidate, width), np.zeros(width))
        return _SingleFit.of(points, first, replace(self.estimate, values=self.estimate.values + step))


def select_and_refit(points: SearchInput, first: MeanSearch) -> SearchOutcome:
    """What the first search chose, with what stands beside it when it is taken exactly.

    Slopes miss some of a large effect, and others then make up for it: where one alone, taken exactly, needs fewer beside it,
    or those that are found by slopes where all effects together fit best, that is the explanation.
    """
    together, tried = first.select()
    plain = SearchOutcome(together, _estimates_of(first, together), first, points.part, together, tried)
    alone = _strongest_single_fits(points, first, together) if together else []
    if not alone:
        return _search_beside(points, plain) or plain
    by_itself = _search_beside_best(points, plain, alone)
    if by_itself is not None and len(by_itself.estimates) > 1:
        others = {each.candidate.name for each in by_itself.estimates if not each.candidate.empirical}
        more = _with_alternatives(points, first, alone, others)
        if more[0] is not alone[0]:
            by_itself = _search_beside_best(points, plain, more) or by_itself
    if by_itself is not None and len(by_itself.estimates) == 1:
        return by_itself
    there = search_at_joint_fit(points)
    found = [_search_beside(points, plain) or plain]
    if by_itself is not None:
        found.insert(0, by_itself)
    if there is not None and there.chosen:
        found.append(_search_beside(points, there) or there)
    possible = [each for each in found if not out_of_bounds(points.measurement, each.estimates, each.at)]
    return min(possible, key=lambda each: each.complexity, default=plain)


def search_at_joint_fit(points: SearchInput) -> SearchOutcome | None:
    """What a search chooses by slopes where all effects of the catalogue together, none far beyond its typical size, fit best.

    There the rays go where they went, whichever of the effects turned them: slopes are the true ones, and to what is left by all
    of them the part of each is added again. None where one of them would be beyond what can be.
    """
    plain = [each for each in points.families if isinstance(each, Candidate) and not each.empirical]
    fitted = fit_jointly(points, plain)
    if fitted is None:
        return None
    there, at, explained = fitted
    allowed = {(family.name, family.empirical) for family in points.families}
    families = [each for each in candidate_families(there, at) if (each.name, each.empirical) in allowed]
    left = replace(at, value=at.value + explained)
    heavier = replace(_with_variance_refitted(points, at), value=left.value)
    search = MeanSearch(heavier, families, points.random.child("best fit"))
    together, tried = search.select()
    return SearchOutcome(together, _estimates_of(search, together), search, left, together, tried)


def fit_jointly(points: SearchInput, candidates: list[Candidate]) -> tuple[Measurement, Residuals, FloatArray] | None:
    """The measurement with some effects in its model, what is left there, and how much (n,) they explain by slopes there."""
    there, at, before = points.measurement, points.part, np.inf
    widths = [each.columns.shape[1] for each in candidates]
    values = np.zeros(sum(widths))
    for _ in range(_MOST_FITS):
        after = float(np.mean((at.value / at.sigma) ** 2))
        if after > (1 - _CONVERGED_DECREASE) * before:
            break
        before = after
        precision = np.concatenate([precision_of(each, width) for each, width in zip(candidates, widths, strict=True)])
        values = values + _gauss_newton_step(at, _all_columns(candidates), precision, values)
        parts = np.split(values, np.cumsum(widths)[:-1])
        estimates = [_estimate_of_size(each, part) for each, part in zip(candidates, parts, strict=True)]
        if out_of_bounds(points.measurement, estimates, at):
            return None
        there, found, _ = _aligned_with_estimates(points, estimates)
        at = with_added_variance(at_points_of(found, points.part), points.added)
        if _too_few_left(points, at):
            return None
        renewed = catalogue_families(there, at)
        candidates = [_recomputed(each, renewed) for each in candidates]
    explained: FloatArray = _all_columns(candidates) @ values
    return there, at, explained


def _too_few_left(points: SearchInput, at: Residuals) -> bool:
    """Whether too few of the points are left to search among."""
    return len(at) < thresholds().points.least_share_on_reference * len(points.part)


def _all_columns(candidates: list[Candidate]) -> FloatArray:
    columns: FloatArray = np.concatenate([each.columns for each in candidates], axis=1)
    return columns


def _estimate_of_size(candidate: Candidate, values: FloatArray) -> Estimate:
    """An effect of some size for which nothing speaks yet."""
    nothing = Chosen(candidate, (), 1.0, 0.0, 0.0, ())
    return Estimate(nothing, candidate, values, np.zeros((len(values), len(values))))


def _gauss_newton_step(at: Residuals, columns: FloatArray, precision: FloatArray, values: FloatArray) -> FloatArray:
    """(k,) by how much values (k,) change: least squares by slopes (n, k), the pose free and each value known to be near 0."""
    design = np.concatenate([at.pose, columns], axis=1) / at.sigma[:, None]
    known, pull = np.zeros(design.shape[1]), np.zeros(design.shape[1])
    start = at.pose.shape[1]
    known[start:], pull[start:] = precision, precision * values
    found = np.linalg.solve(design.T @ design + np.diag(known), design.T @ (at.value / at.sigma) - pull)
    return np.asarray(found[start:])


def _strongest_single_fits(points: SearchInput, first: MeanSearch, together: list[Chosen]) -> list[_SingleFit]:
    """The effects that explain most by themselves, of those that explain much, best first; none where slopes say all: where they
    are wrong by less than anything gains that was chosen."""
    found: list[_SingleFit] = []
    serve = min([thresholds().mean.linearisation_error, *(_ABSORBED_SHARE * each.gain for each in together)])
    for candidate in first.leading():
        alone = _single_fit(points, first, candidate)
        if alone is None:
            continue
        by_slopes = first.design.log_likelihood(points.part.value, candidate)
        if not found and abs(alone.log_likelihood - by_slopes) < serve:
            return []
        found.append(alone)
    if not found:
        return []
    likeliest = _best_variants(points, first, found)
    return _with_alternatives(points, first, likeliest, set(likeliest[0].estimate.chosen.alike))


def _with_alternatives(points: SearchInput, first: MeanSearch, alone: list[_SingleFit], names: set[str]) -> list[_SingleFit]:
    """With more effects, of which slopes may miss nearly all, and those that slopes cannot tell from the best; best first.

    Of each the parameters that slopes ask for, in every camera.
    """
    others = {item.name: item.candidate.names for item in first.tried(()) if not item.empirical and item.name in names}
    for each in alone:
        others.pop(each.name, None)
    plain = (each for each in first.design.families.plain if not each.empirical)
    variants = [each for each in plain if each.names == others.get(each.name)]
    more = [each for each in (_single_fit(points, first, variant) for variant in variants) if each is not None]
    if not more:
        return alone
    ranked = sorted([*alone, *_best_variants(points, first, more)], key=lambda each: -each.score)
    return _with_alternatives(points, first, ranked, set(ranked[0].estimate.chosen.alike))


def _single_fit(points: SearchInput, first: MeanSearch, candidate: Candidate) -> _SingleFit | None:
    """One effect in the model, at the values that slopes give it."""
    (estimate,) = _estimates_of(first, [first.alone(candidate)])
    return _SingleFit.of(points, first, estimate)


def _best_variants(points: SearchInput, first: MeanSearch, found: list[_SingleFit]) -> list[_SingleFit]:
    """A variant of each of the likeliest effects, at the values that explain most, best first; of the best effect the best of the
    likeliest variants: which camera it is may not show before."""
    ranked = sorted(found, key=lambda each: -each.log_likelihood)
    variants = {each.name: each for each in reversed(ranked)}
    likely = sorted(variants.values(), key=lambda each: -each.log_likelihood)[:_MOST_CONVERGED]
    best, *rest = sorted((_converged(points, first, each) for each in likely), key=lambda each: -each.score)
    others = [each for each in ranked if each.name == best.name and each is not variants[best.name]][: _MOST_CONVERGED - 1]
    best = max([best, *(_converged(points, first, each) for each in others)], key=lambda each: each.score)
    return [best, *rest]


def _search_beside_best(points: SearchInput, plain: SearchOutcome, alone: list[_SingleFit]) -> SearchOutcome | None:
    """With what a search finds beside the best of some effects alone."""
    estimate = _with_equivalence_class(alone).estimate
    return _search_beside(points, replace(plain, chosen=[estimate.chosen], estimates=[estimate]))


def _with_equivalence_class(converged: list[_SingleFit]) -> _SingleFit:
    """The best, with those that would do as well: slopes say so of effects that were not taken exactly only."""
    best, *others = converged
    chosen = best.estimate.chosen
    least = best.score - class_margin(chosen.gain)
    near = {each.name for each in others if each.score > least}
    slopes = set(chosen.alike) - {each.name for each in others}
    return replace(best, estimate=replace(best.estimate, chosen=replace(chosen, alike=tuple(sorted(near | slopes)))))


def _converged(points: SearchInput, first: MeanSearch, alone: _SingleFit) -> _SingleFit:
    """At the values that explain most."""
    for _ in range(_MOST_ROUNDS):
        better = alone.better(points, first)
        if better is None or better.log_likelihood < alone.log_likelihood + _CONVERGED_GAIN:
            break
        alone = better
    return alone


def _search_beside(points: SearchInput, chosen: SearchOutcome) -> SearchOutcome | None:
    """With what a search finds beside the effects; None where there are none, or where they are beyond what can be."""
    physical = [each for each in chosen.estimates if not each.candidate.empirical]
    if not physical or out_of_bounds(points.measurement, chosen.estimates, chosen.at):
        return None
    again = _repeat_search(points, physical, chosen.search.gains_alone)
    if again is None:
        return None
    search, at, estimates, beside, tried = again
    return replace(chosen, estimates=estimates, search=search, at=at, beside=beside, tried=tried)


def out_of_bounds(measurement: Measurement, estimates: list[Estimate], part: Residuals) -> frozenset[tuple[str, bool]]:
    """Families whose estimate lies beyond the bounds of the effect."""
    wrong = [each for each in estimates if not is_plausible(measurement.model, effect_from_estimate(each, part).entry)]
    return frozenset((each.candidate.name, each.candidate.empirical) for each in wrong)


def absorbed_by_registration(
    estimates: list[Estimate], part: Residuals, survival: Mapping[str, float]
) -> frozenset[tuple[str, bool]]:
    """Effects far beyond their typical size of which the registration leaves next to nothing. survival: that share by name."""
    by = thresholds().mean
    doubtful = [each for each in estimates if not each.candidate.empirical and survival[each.candidate.name] < by.absorbed_share]
    large = [each for each in doubtful if relative_size(effect_from_estimate(each, part).entry) > by.absorbed_size]
    return frozenset((each.candidate.name, False) for each in large)


def with_added_variance(part: Residuals, variance: float) -> Residuals:
    return replace(part, sigma=np.sqrt(part.sigma**2 + variance)) if variance else part


def with_fitted_variance(part: Residuals, spread: list[VarianceTerm], scale: float) -> Residuals:
    """With the spread that the points really have, as it counts for means of neighbours."""
    part = part.averaged
    if not spread:
        return replace(part, sigma=part.sigma * scale)
    made = (effect_of(each.effect)(**each.parameters) for each in spread if each.parameters)
    shared = [effect for effect in made if isinstance(effect, MatchingNoise)]
    sigma = np.sqrt(part.sigma**2 + sum(each.variance for each in spread))
    return replace(part, sigma=sigma, shared_noise=part.shared_noise.beside(shared))


def _estimates_of(search: MeanSearch, chosen: list[Chosen]) -> list[Estimate]:
    candidates, fit = search.design.refined([item.candidate for item in chosen])
    places = search.design.split(np.arange(len(fit.coefficients)), candidates)
    return [
        Estimate(item, candidate, fit.coefficients[place], fit.covariance[np.ix_(place, place)])
        for item, candidate, place in zip(chosen, candidates, places, strict=True)
    ]


def _repeat_search(
    points: SearchInput, had: list[Estimate], alone: Mapping[Explanation, float]
) -> tuple[MeanSearch, Residuals, list[Estimate], list[Chosen], tuple[Tried, ...]] | None:
    """The search beside effects that the model now has, whose values are free to move a little: they count as pose.

    alone: what each explanation gains by itself. Returns the search, its residuals, the effects with what was found beside them,
    that only, and what was tried last; None where the rays of many points would miss the reference with them.
    """
    part = points.part
    there, found, _ = _aligned_with_estimates(points, had)
    at = with_added_variance(at_points_of(found, part), points.added)
    if _too_few_left(points, at):
        return None
    renewed = candidate_families(there, at)
    allowed = {(family.name, family.empirical) for family in points.families}
    names = {each.candidate.name for each in had}
    others = [each for each in renewed if (each.name, each.empirical) in allowed and (each.empirical or each.name not in names)]
    known = [replace(each, candidate=_recomputed(each.candidate, renewed)) for each in had]
    columns = [_free_columns(each) for each in known]
    periodic = [(PERIODIC[name], each.candidate) for each in known if (name := each.candidate.name) in PERIODIC]
    others += [harmonics(covariate, sine, last) for covariate, sine in periodic for last in OVERTONES]
    heavier = _with_variance_refitted(points, at)
    precision = [precision_of(each.candidate, matrix.shape[1]) for each, matrix in zip(known, columns, strict=True)]
    search = MeanSearch(
        replace(heavier, pose=np.concatenate([at.pose, *columns], axis=1)),
        others,
        points.random.child("again"),
        np.concatenate([np.zeros(at.pose.shape[1]), *precision]),
        alone,
    )
    chosen, tried = search.select()
    fit = search.design.refined([item.candidate for item in chosen])[1]
    kept, start = [], at.pose.shape[1]
    for each, matrix in zip(known, columns, strict=True):
        place = slice(start, start := start + matrix.shape[1])
        kept.append(replace(each, values=each.values + fit.coefficients[place], covariance=fit.covariance[place, place]))
    return search, at, _merge_sines_with_overtones([*kept, *_estimates_of(search, chosen)]), chosen, tried


def _with_variance_refitted(points: SearchInput, at: Residuals) -> Residuals:
    """Residuals with some effects on the mean in the model, with the spread that they have there: without those in the model what
    they do looks like noise, beside which nothing small would be seen."""
    return with_fitted_variance(at, points.spread_at(at), registered(at)[2])


def _aligned_with_estimates(points: SearchInput, effects: list[Estimate]) -> Settled:
    """The measurement with some effects in its model, settled."""
    return aligned_with(points.measurement, [effect_from_estimate(each, points.part) for each in effects], points.part.index)


def _merge_sines_with_overtones(estimates: list[Estimate]) -> list[Estimate]:
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


def at_points_of(found: Residuals, part: Residuals) -> Residuals:
    """What was found at the points of a part, where the surface is smooth there too and they are no outliers."""
    rough, _, scale = registered(found)
    good = found.smooth & (np.abs(rough) < thresholds().points.outlier_sigmas * scale * found.sigma)
    place = np.full(int(max(found.index.max(initial=-1), part.index.max())) + 1, -1)
    place[found.index[good]] = np.flatnonzero(good)
    rows = place[part.index]
    return found.part(rows[rows >= 0])


def _still_present(at: Residuals, part: Residuals) -> BoolArray:
    """Which points of the part are left."""
    return np.isin(part.index, at.index)


def _recomputed(candidate: Candidate, families: list[Candidate | SineGrid]) -> Candidate:
    """The same candidate for other rays."""
    key = "" if candidate.wave is None else candidate.wave.key
    chosen = {name: value for name, value in candidate.fixed.items() if name != key}
    for family in families:
        if family.name == candidate.name and not family.empirical and dict(family.fixed) == chosen:
            if isinstance(family, SineGrid):
                return family.at(candidate.period)
            if family.names == candidate.names:
                return family
    raise KeyError(candidate.name)


def _free_columns(found: Estimate) -> FloatArray:
    """(n, k) of its coefficients, a sine's with that of its frequency."""
    wave = found.candidate.wave
    return found.candidate.columns if wave is None else wave.with_slope(found.candidate.period, found.values[:2])
