"""Refit strong systematic effects without linearising (Gauss-Newton), and repeat the selection beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.mean.candidates import Candidate, ExplanationKey, SineGrid, prior_precision
from pipeline.gap.mean.nonparametric_terms import HARMONIC_ORDERS, HARMONICS, harmonics
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.mean.selection import FamilyScore, SelectedEffect
from pipeline.gap.naming.candidate_families import PERIODIC, candidate_families, catalogue_families
from pipeline.gap.naming.effect_screening import estimate_of_size, gauss_newton_step, screen_effects
from pipeline.gap.naming.named_effects import Estimate, aligned_with, effect_from_estimate, out_of_bounds
from pipeline.gap.naming.search_outcome import SearchInput, SearchOutcome
from pipeline.gap.naming.search_residuals import with_added_variance, with_fitted_variance
from pipeline.gap.residuals.alignment import AlignedMeasurement, at_points_of, fit_pose_robustly
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.thresholds import equivalence_margin, thresholds
from scene.geometry.mesh import FloatArray

_MOST_CONVERGED, _MOST_ROUNDS, _CONVERGED_GAIN = 3, 8, 1.0
"""Effects that are refitted to convergence, and most iterations of each."""
_ABSORBED_SHARE = 0.5
"""Share of an effect's gain that may be linearisation error of the others."""
_MOST_FITS, _CONVERGED_DECREASE = 10, 0.005
"""Most iterations of the joint fit of all effects."""


@dataclass(frozen=True)
class _SingleFit:
    """One effect alone in the model, without linearising.

    estimate: the effect; residuals, measurement: with it in the model, at the estimated pose; value: (n,) registered
    residuals of all points, 0 where a point is not used; used: (n,) points that are used; log_likelihood: of these points.
    """

    estimate: Estimate
    residuals: Residuals
    measurement: Measurement
    value: FloatArray
    used: BoolArray
    log_likelihood: float

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.estimate.candidate.name

    @property
    def score(self) -> float:
        """Penalised log-likelihood."""
        return self.log_likelihood - (self.estimate.chosen.log_likelihood_ratio - self.estimate.chosen.score)

    @classmethod
    def of(cls, given: SearchInput, first: MeanSearch, estimate: Estimate) -> _SingleFit | None:
        """Put one effect into the model; None if it is out of bounds, or if too few rays meet the reference with it."""
        if out_of_bounds(given.measurement, [estimate], given.part):
            return None
        measurement, found, _ = _aligned_with_estimates(given, [estimate])
        found = found.part(np.isin(found.index, given.part.index))
        registered_residuals, _, noise_ratio = fit_pose_robustly(found)
        largest = thresholds().points.outlier_sigmas * noise_ratio * found.sigma
        value, kept = np.zeros(len(given.part)), _still_present(found, given.part)
        if kept.mean() < thresholds().points.least_share_on_reference:
            return None
        value[kept] = np.where(found.usable, np.clip(registered_residuals, -largest, largest), 0.0)
        kept[kept] = found.usable
        log_likelihood = first.design.log_likelihood(value, estimate.candidate)
        return cls(estimate, at_points_of(found, given.part), measurement, value, kept, log_likelihood)

    def is_significant(self, given: SearchInput, first: MeanSearch) -> bool:
        """Tell whether the effect explains the residuals better than the best of all effects would if there were none."""
        chosen, candidate = self.estimate.chosen, self.estimate.candidate
        linearised = first.design.log_likelihood(np.where(self.used, given.part.value, 0.0), candidate)
        return first.p_value(chosen.score + self.log_likelihood - linearised) <= thresholds().mean.significance

    def improved(self, given: SearchInput, first: MeanSearch) -> _SingleFit | None:
        """Return the fit after one Gauss-Newton step from the present values; None for the reasons of `of`."""
        candidate = _recomputed(self.estimate.candidate, candidate_families(self.measurement, self.residuals))
        width = candidate.columns.shape[1]
        step = gauss_newton_step(self.residuals, candidate.columns, prior_precision(candidate, width), np.zeros(width))
        return _SingleFit.of(given, first, replace(self.estimate, values=self.estimate.values + step))


def _on_common_points(fits: list[_SingleFit], first: MeanSearch) -> list[_SingleFit]:
    """Return the fits with their log-likelihoods on the points that all of them use, so that none gains by leaving out points."""
    common, design = np.all([each.used for each in fits], axis=0), first.design
    values = (np.where(common, each.value, 0.0) for each in fits)
    return [
        replace(each, log_likelihood=design.log_likelihood(value, each.estimate.candidate))
        for each, value in zip(fits, values, strict=True)
    ]


def _ranked_on_common_points(fits: list[_SingleFit], first: MeanSearch) -> list[_SingleFit]:
    """Return the fits with log-likelihoods on the points that all of them use, best first."""
    return sorted(_on_common_points(fits, first), key=lambda each: -each.score)


def _gain_over(later: _SingleFit, earlier: _SingleFit, first: MeanSearch) -> float:
    """Log-likelihood ratio of two fits."""
    after, before = _on_common_points([later, earlier], first)
    return after.log_likelihood - before.log_likelihood


def select_and_refit(given: SearchInput, first: MeanSearch) -> SearchOutcome:
    """Select the systematic sensor errors (effects) that explain residuals, and refit the strong ones without linearising.

    The linearised model is inexact for a large effect, and forward selection then adds spurious effects that absorb the
    linearisation error. Several explanations are therefore compared. One is the linearised selection. For another, the strongest
    effects are refitted alone without linearising, and the selection is repeated beside the best one. If that still needs several
    effects, or if none is strong, each effect is tried alone (`screen_effects`), and all together (`search_at_joint_fit`).

    Parameters
    ----------
    given : points, residuals and candidate effects.
    first : the linearised search, in which residuals change in proportion to the size of each effect.

    Returns
    -------
    SearchOutcome : the explanation with the fewest empirical terms, and of these the one with the fewest effects.
    """
    together, tried = first.select()
    linear = SearchOutcome(together, _estimates_of(first, together), first, given.part, together, tried)
    alone = _strongest_single_fits(given, first, together) if together else None
    if alone is None:
        return _search_beside(given, linear) or linear
    beside_best = _search_beside_best(given, linear, alone) if alone else None
    if beside_best is None or len(beside_best.estimates) > 1:
        screened = _screened_single_fits(given, first, alone)
        if screened and (not alone or screened[0].estimate is not alone[0].estimate):
            beside_best = _search_beside_best(given, linear, screened) or beside_best
        elif beside_best is not None:
            beside_best = _with_class_of_first(beside_best, screened)
        if beside_best is not None and len(beside_best.estimates) > 1:
            beside_best = _search_beside_others(given, linear, screened, beside_best)
    if beside_best is not None and len(beside_best.estimates) == 1:
        return beside_best
    best = beside_best if beside_best is not None and _within_bounds(given, beside_best) else None
    best = _simpler(given, best, linear, ties=not alone)
    if best is None or best.complexity > (0, 1):
        best = _simpler(given, best, search_at_joint_fit(given), ties=False)
    return linear if best is None else best.with_classes_of(linear)


def _simpler(given: SearchInput, best: SearchOutcome | None, other: SearchOutcome | None, ties: bool) -> SearchOutcome | None:
    """Return the simpler of two explanations of the residuals, after a search for effects that the second one may lack.

    That search only adds effects, so it is left out where the second explanation cannot be simpler.
    best: the first explanation; None if there is none. ties: whether the second one is returned if both are equally simple.
    """
    if other is None or not other.chosen:
        return best

    def wins(complexity: tuple[int, int]) -> bool:
        return best is None or complexity < best.complexity or (ties and complexity == best.complexity)

    if not wins((0, sum(not each.candidate.empirical for each in other.estimates))):
        return best
    other = _search_beside(given, other) or other
    return other if wins(other.complexity) and _within_bounds(given, other) else best


def _within_bounds(given: SearchInput, outcome: SearchOutcome) -> bool:
    """Whether a sensor model accepts the effects of an explanation."""
    return not out_of_bounds(given.measurement, outcome.estimates, outcome.residuals)


def search_at_joint_fit(given: SearchInput) -> SearchOutcome | None:
    """Search for systematic sensor errors (effects) after fitting all effects of the catalogue together.

    It serves measurements with several large errors, for which a model that is linearised without effects is inexact. The joint
    fit moves each ray to about where the real one was, so that the derivatives taken there are right. What the fitted effects
    explain is then added back to the residuals, and effects are selected anew.

    Parameters
    ----------
    given : points, residuals and candidate effects.

    Returns
    -------
    SearchOutcome or None : the selected effects; None if a fitted effect is out of bounds or too few points remain.
    """
    plain = [each for each in given.families if isinstance(each, Candidate) and not each.empirical]
    fitted = fit_jointly(given, plain)
    if fitted is None:
        return None
    measurement, at, explained = fitted
    allowed = {(family.name, family.empirical) for family in given.families}
    families = [each for each in candidate_families(measurement, at) if (each.name, each.empirical) in allowed]
    left = replace(at, value=at.value + explained)
    weighted = replace(_with_variance_refitted(given, at), value=left.value)
    search = MeanSearch(weighted, families, given.random.child("best fit"))
    together, tried = search.select()
    return SearchOutcome(together, _estimates_of(search, together), search, left, together, tried)


def fit_jointly(given: SearchInput, candidates: list[Candidate]) -> tuple[Measurement, Residuals, FloatArray] | None:
    """Fit the sizes of several systematic sensor errors (effects) together by Gauss-Newton, with the sensor's pose free.

    Parameters
    ----------
    given : points, residuals and candidate effects.
    candidates : the effects to fit, as regression terms.

    Returns
    -------
    measurement : the measurement with the effects in its model.
    residuals : its residuals of n points.
    explained : (n,) part of the observations that the effects explain to first order, in the unit of the observable (m or px).

    None instead if an effect is out of bounds or too few points remain.
    """
    measurement, at, before = given.measurement, given.part, np.inf
    widths = [each.columns.shape[1] for each in candidates]
    values = np.zeros(sum(widths))
    for _ in range(_MOST_FITS):
        after = float(np.mean((at.value / at.sigma) ** 2))
        if after > (1 - _CONVERGED_DECREASE) * before:
            break
        before = after
        precision = np.concatenate([prior_precision(each, width) for each, width in zip(candidates, widths, strict=True)])
        values = values + gauss_newton_step(at, _all_columns(candidates), precision, values)
        parts = np.split(values, np.cumsum(widths)[:-1])
        estimates = [estimate_of_size(each, part) for each, part in zip(candidates, parts, strict=True)]
        if out_of_bounds(given.measurement, estimates, at):
            return None
        measurement, found, _ = _aligned_with_estimates(given, estimates)
        at = with_added_variance(at_points_of(found, given.part), given.added)
        if _too_few_left(given, at):
            return None
        renewed = catalogue_families(measurement, at)
        candidates = [_recomputed(each, renewed) for each in candidates]
    return measurement, at, np.asarray(_all_columns(candidates) @ values)


def _too_few_left(given: SearchInput, at: Residuals) -> bool:
    """Whether too few of the points are left for a search."""
    return len(at) < thresholds().points.least_share_on_reference * len(given.part)


def _all_columns(candidates: list[Candidate]) -> FloatArray:
    """Columns of all candidates side by side."""
    return np.asarray(np.concatenate([each.columns for each in candidates], axis=1))


def _strongest_single_fits(given: SearchInput, first: MeanSearch, together: list[SelectedEffect]) -> list[_SingleFit] | None:
    """The effects that alone explain most, refitted without linearising, best first.

    Empty if no effect is strong. None where the linearised model is good enough: its error is below the gain of any selected
    effect, or only one is selected, which is not strong.
    """
    found: list[_SingleFit] = []
    tolerance = min([thresholds().mean.class_margin, *(_ABSORBED_SHARE * each.log_likelihood_ratio for each in together)])
    leading = first.leading_effects()
    for candidate in leading:
        alone = _single_fit(given, first, candidate)
        if alone is None:
            continue
        compared = alone.used | (len(together) > 1)  # several effects may rest on points that the refit of one leaves out
        linearised = first.design.log_likelihood(np.where(compared, given.part.value, 0.0), candidate)
        if not found and abs(alone.log_likelihood - linearised) < tolerance:
            return None
        found.append(alone)
    if not found:
        return None if not leading and [each.candidate.empirical for each in together] == [False] else []
    return _best_variants(given, first, found)


def _screened_single_fits(given: SearchInput, first: MeanSearch, alone: list[_SingleFit]) -> list[_SingleFit]:
    """Add fits of one effect alone that leave the least noise and are significant; of each effect the best one, best first."""
    sized = screen_effects(given.measurement, given.part, first.effect_variants(), _MOST_CONVERGED)
    more = [each for each in (_single_fit(given, first, item.candidate, item.values) for item in sized) if each is not None]
    refitted = [each for each in _best_variants(given, first, more) if each.is_significant(given, first)] if more else []
    if not refitted:
        return alone
    best: dict[str, _SingleFit] = {}
    for each in _ranked_on_common_points([*alone, *refitted], first):
        best.setdefault(each.name, each)
    return list(best.values())


def _single_fit(
    given: SearchInput, first: MeanSearch, candidate: Candidate, values: FloatArray | None = None
) -> _SingleFit | None:
    """Put one effect into the sensor model. values: (k,) its coefficients; None: those of the linearised fit."""
    (estimate,) = _estimates_of(first, [first.selected_alone(candidate)])
    return _SingleFit.of(given, first, estimate if values is None else replace(estimate, values=values))


def _best_variants(given: SearchInput, first: MeanSearch, found: list[_SingleFit]) -> list[_SingleFit]:
    """The best effects, refitted to convergence, best first.

    The best effect is also refitted for other cameras or periods, because which one it is may not show before.
    """
    ranked = sorted(found, key=lambda each: -each.log_likelihood)
    variants = {each.name: each for each in reversed(ranked)}
    likely = sorted(variants.values(), key=lambda each: -each.log_likelihood)[:_MOST_CONVERGED]
    best, *rest = _ranked_on_common_points([_converged(given, first, each) for each in likely], first)
    others = [each for each in ranked if each.name == best.name and each is not variants[best.name]][: _MOST_CONVERGED - 1]
    same = _ranked_on_common_points([best, *(_converged(given, first, each) for each in others)], first)
    return _ranked_on_common_points([same[0], *rest], first)


def _search_beside_best(given: SearchInput, plain: SearchOutcome, alone: list[_SingleFit]) -> SearchOutcome | None:
    """Repeat the search beside the best of some single fits."""
    estimate = _with_equivalence_class(alone).estimate
    return _search_beside(given, replace(plain, chosen=[estimate.chosen], estimates=[estimate]))


def _with_class_of_first(found: SearchOutcome, fits: list[_SingleFit]) -> SearchOutcome:
    """Return an explanation whose first effect is the best of some single fits, with its class among these."""
    chosen, (first, *others) = _with_equivalence_class(fits).estimate.chosen, found.estimates
    return replace(found, chosen=[chosen], estimates=[replace(first, chosen=chosen), *others])


def _search_beside_others(given: SearchInput, plain: SearchOutcome, fits: list[_SingleFit], best: SearchOutcome) -> SearchOutcome:
    """Repeat the search beside other effects that were refitted alone and may need fewer further ones; the simplest answer wins.

    Such a fit is worse than the best one by less than the further effects gain, so it may be the one that belongs to them. Its
    class holds the other fits that are as good: an error of this size is far from where the linearised search compares effects.
    """
    gained = sum(each.chosen.log_likelihood_ratio for each in best.estimates[1:])
    for other in fits[1:]:
        if fits[0].log_likelihood - other.log_likelihood > gained:
            continue
        margin = equivalence_margin(other.estimate.chosen.log_likelihood_ratio)
        near = (each.name for each in fits if each is not other and abs(each.score - other.score) < margin)
        chosen = replace(other.estimate.chosen, indistinguishable=tuple(sorted(near)))
        found = _search_beside(given, replace(plain, chosen=[chosen], estimates=[replace(other.estimate, chosen=chosen)]))
        if found is not None and found.complexity < best.complexity and _within_bounds(given, found):
            best = found
    return best


def _with_equivalence_class(converged: list[_SingleFit]) -> _SingleFit:
    """Return the best of the refitted single effects with the effects that cannot be told from it (its equivalence class).

    For effects that were not refitted, the linearised search decides. One that it could not tell from the best must score worse
    by twice the margin here, because either search has its own error.
    """
    best, *others = converged
    chosen = best.estimate.chosen
    margin, linearised = equivalence_margin(chosen.log_likelihood_ratio), set(chosen.indistinguishable)
    near = {each.name for each in others if each.score > best.score - (1 + (each.name in linearised)) * margin}
    linearised -= {each.name for each in others}
    return replace(
        best, estimate=replace(best.estimate, chosen=replace(chosen, indistinguishable=tuple(sorted(near | linearised))))
    )


def _converged(given: SearchInput, first: MeanSearch, alone: _SingleFit) -> _SingleFit:
    """Gauss-Newton steps until the log-likelihood rises by less than 1."""
    for _ in range(_MOST_ROUNDS):
        improved = alone.improved(given, first)
        if improved is None or _gain_over(improved, alone, first) < _CONVERGED_GAIN:
            break
        alone = improved
    return alone


def _search_beside(given: SearchInput, chosen: SearchOutcome) -> SearchOutcome | None:
    """Search for effects in addition to the selected ones; None if there are none, or if one is out of bounds."""
    physical = [each for each in chosen.estimates if not each.candidate.empirical]
    if not physical or out_of_bounds(given.measurement, chosen.estimates, chosen.residuals):
        return None
    again = repeat_search(given, physical, chosen.search.single_effect_ratios)
    if again is None:
        return None
    search, at, estimates, further, tried = again
    return replace(chosen, estimates=estimates, search=search, residuals=at, further=further, tried=tried)


def _estimates_of(search: MeanSearch, chosen: list[SelectedEffect]) -> list[Estimate]:
    """Refine the selected explanations jointly and return their coefficients with covariance."""
    candidates, fit = search.design.fit_refined([item.candidate for item in chosen])
    places = search.design.split_coefficients(np.arange(len(fit.coefficients)), candidates)
    return [
        Estimate(item, candidate, fit.coefficients[place], fit.covariance[np.ix_(place, place)])
        for item, candidate, place in zip(chosen, candidates, places, strict=True)
    ]


def repeat_search(
    given: SearchInput, known_effects: list[Estimate], alone: Mapping[ExplanationKey, float]
) -> tuple[MeanSearch, Residuals, list[Estimate], list[SelectedEffect], tuple[FamilyScore, ...]] | None:
    """Repeat the search with some effects in the model, whose coefficients stay free like the pose.

    Parameters
    ----------
    given : input of the searches.
    known_effects : effects to put into the model.
    alone : log-likelihood ratio of each explanation alone.

    Returns
    -------
    tuple or None : the search, its residuals, the estimates of all effects, the new explanations, and what was tried last; None
        if too few rays meet the reference with the effects.
    """
    part = given.part
    measurement, found, _ = _aligned_with_estimates(given, known_effects)
    at = with_added_variance(at_points_of(found, part), given.added)
    if _too_few_left(given, at):
        return None
    renewed = candidate_families(measurement, at)
    allowed = {(family.name, family.empirical) for family in given.families}
    names = {each.candidate.name for each in known_effects}
    others = [each for each in renewed if (each.name, each.empirical) in allowed and (each.empirical or each.name not in names)]
    known = [replace(each, candidate=_recomputed(each.candidate, renewed)) for each in known_effects]
    columns = [_free_columns(each) for each in known]
    periodic = [(PERIODIC[name], each.candidate) for each in known if (name := each.candidate.name) in PERIODIC]
    others += [harmonics(covariate, sine, last) for covariate, sine in periodic for last in HARMONIC_ORDERS]
    weighted = _with_variance_refitted(given, at)
    precision = [prior_precision(each.candidate, matrix.shape[1]) for each, matrix in zip(known, columns, strict=True)]
    search = MeanSearch(
        replace(weighted, pose_jacobian=np.concatenate([at.pose_jacobian, *columns], axis=1)),
        others,
        given.random.child("again"),
        np.concatenate([np.zeros(at.pose_jacobian.shape[1]), *precision]),
        alone,
    )
    chosen, tried = search.select()
    fit = search.design.fit_refined([item.candidate for item in chosen])[1]
    kept, start = [], at.pose_jacobian.shape[1]
    for each, matrix in zip(known, columns, strict=True):
        place = slice(start, start := start + matrix.shape[1])
        kept.append(replace(each, values=each.values + fit.coefficients[place], covariance=fit.covariance[place, place]))
    return search, at, _merge_sines_with_overtones([*kept, *_estimates_of(search, chosen)]), chosen, tried


def _with_variance_refitted(given: SearchInput, at: Residuals) -> Residuals:
    """Residuals with the noise fitted beside the effects in the model. Without these, their signatures would look like noise."""
    return with_fitted_variance(at, given.variance_at(at), fit_pose_robustly(at)[2])


def _aligned_with_estimates(given: SearchInput, effects: list[Estimate]) -> AlignedMeasurement:
    """Put some effects into the model of the measurement and estimate the pose again."""
    return aligned_with(given.measurement, [effect_from_estimate(each, given.part) for each in effects], given.part.index)


def _merge_sines_with_overtones(estimates: list[Estimate]) -> list[Estimate]:
    """Merge a named sine and its overtones into one empirical term."""
    found = list(estimates)
    for overtones in (each for each in estimates if each.candidate.form == HARMONICS):
        sine = next(each for each in estimates if PERIODIC.get(each.candidate.name) == overtones.candidate.name)
        both = np.concatenate([sine.candidate.columns, overtones.candidate.columns], axis=1)
        width = sine.candidate.columns.shape[1]
        values = np.concatenate([sine.values[:width], overtones.values])
        found = [each for each in found if each is not sine and each is not overtones]
        found.append(replace(overtones, candidate=replace(overtones.candidate, matrix=both), values=values))
    return found


def _still_present(at: Residuals, part: Residuals) -> BoolArray:
    """Return for each point of `part` whether `at` still contains it."""
    return np.isin(part.index, at.index)


def _recomputed(candidate: Candidate, families: list[Candidate | SineGrid]) -> Candidate:
    """Return the same candidate with the design columns of other rays, found among `families`."""
    key = "" if candidate.wave is None else candidate.wave.key
    chosen = {name: value for name, value in candidate.fixed.items() if name != key}
    for family in families:
        if family.name == candidate.name and not family.empirical and dict(family.fixed) == chosen:
            if isinstance(family, SineGrid):
                return family.at_period(candidate.period)
            if family.names == candidate.names:
                return family
    raise KeyError(candidate.name)


def _free_columns(found: Estimate) -> FloatArray:
    """(n, k) columns of an effect's coefficients; a sine also has that of its frequency."""
    wave = found.candidate.wave
    return found.candidate.columns if wave is None else wave.with_frequency_derivative(found.candidate.period, found.values[:2])
