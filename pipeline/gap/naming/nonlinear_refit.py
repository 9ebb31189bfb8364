"""Refit strong systematic effects without linearising (Gauss-Newton), and repeat the selection beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.mean.selection import FamilyScore, ForwardSelection, SelectedEffect
from pipeline.gap.naming.candidate_families import catalogue_families
from pipeline.gap.naming.effect_screening import gauss_newton_step, screen_effects
from pipeline.gap.naming.named_effects import Estimate, out_of_bounds
from pipeline.gap.naming.search_beside_effects import (
    aligned_with_estimates,
    estimates_of,
    recomputed,
    repeat_search,
    search_at_fit,
    too_few_left,
)
from pipeline.gap.naming.search_outcome import SearchInput, SearchOutcome
from pipeline.gap.residuals.alignment import at_points_of, fit_pose_robustly
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.thresholds import equivalence_margin, thresholds
from scene.geometry.mesh import FloatArray

_MOST_CONVERGED, _MOST_ROUNDS, _CONVERGED_GAIN = 3, 8, 1.0
"""Number of effects that are refitted to convergence, largest number of iterations, and gain of log-likelihood that ends them."""
_MOST_SELECTIONS = 3, 2
"""How often a selection is repeated with new derivatives at most: without an empirical term and with one, where it helps less."""
_ABSORBED_SHARE = 0.5
"""The linearised model is inexact if its error exceeds this share of the log-likelihood ratio of any selected effect."""


@dataclass(frozen=True)
class _Refit:
    """Fit of one or more effects whose residuals come from the full sensor model, not from its derivatives.

    estimates: the effects; residuals, measurement: with them in the model, at the estimated pose; value: (n,) registered
    residuals of all points, 0 where a point is not used; used: (n,) points that are used; log_likelihood: of these points.
    """

    estimates: tuple[Estimate, ...]
    residuals: Residuals
    measurement: Measurement
    value: FloatArray
    used: BoolArray
    log_likelihood: float

    @property
    def name(self) -> str:
        """Name of the first effect."""
        return self.estimates[0].candidate.name

    @property
    def candidates(self) -> list[Candidate]:
        """The effects as regression terms of the linearised model."""
        return [each.candidate for each in self.estimates]

    @property
    def score(self) -> float:
        """Penalised log-likelihood."""
        return self.log_likelihood - sum(each.chosen.log_likelihood_ratio - each.chosen.score for each in self.estimates)

    @classmethod
    def of(cls, given: SearchInput, first: MeanSearch, estimates: Sequence[Estimate]) -> _Refit | None:
        """Put effects into the model; None if one is out of bounds, or if too few rays meet the reference with them."""
        if out_of_bounds(given.measurement, [*estimates], given.part):
            return None
        measurement, found, _ = aligned_with_estimates(given, [*estimates])
        found = found.part(np.isin(found.index, given.part.index))
        at = at_points_of(found, given.part)
        if too_few_left(given, at):
            return None
        value, kept = _registered_residuals(found, given.part)
        likelihood = first.design.log_likelihood(value, [each.candidate for each in estimates])
        return cls(tuple(estimates), at, measurement, value, kept, likelihood)

    def is_significant(self, given: SearchInput, first: MeanSearch) -> bool:
        """Tell whether the score is significant: the best of all effects reaches it by chance with p <= `mean.significance`."""
        (candidate,) = self.candidates
        linearised = first.design.log_likelihood(np.where(self.used, given.part.value, 0.0), [candidate])
        score = first.score_alone(candidate) + self.log_likelihood - linearised
        return first.p_value(score) <= thresholds().mean.significance

    def improved(self, given: SearchInput, first: MeanSearch) -> _Refit | None:
        """Return the fit after one Gauss-Newton step from the present values; None for the reasons of `of`."""
        catalogue = catalogue_families(self.measurement, self.residuals)
        terms = [recomputed(each, catalogue) for each in self.candidates]
        widths = [each.columns.shape[1] for each in terms]
        present = [each.values[:width] for each, width in zip(self.estimates, widths, strict=True)]
        changes = np.split(gauss_newton_step(self.residuals, terms, np.concatenate(present)), np.cumsum(widths)[:-1])
        changed = [
            replace(each, values=np.concatenate([values + change, each.values[len(values) :]]))
            for each, values, change in zip(self.estimates, present, changes, strict=True)
        ]
        return _Refit.of(given, first, changed)


def _on_common_points(fits: list[_Refit], first: MeanSearch) -> list[_Refit]:
    """Return the fits with their log-likelihoods on the points that all of them use, so that none gains by leaving out points."""
    common, design = np.all([each.used for each in fits], axis=0), first.design
    values = (np.where(common, each.value, 0.0) for each in fits)
    return [
        replace(each, log_likelihood=design.log_likelihood(value, each.candidates))
        for each, value in zip(fits, values, strict=True)
    ]


def _ranked_on_common_points(fits: list[_Refit], first: MeanSearch) -> list[_Refit]:
    """Return the fits with log-likelihoods on the points that all of them use, best first."""
    return sorted(_on_common_points(fits, first), key=lambda each: -each.score)


def _gain_over(later: _Refit, earlier: _Refit, first: MeanSearch) -> float:
    """Log-likelihood ratio of two fits."""
    after, before = _on_common_points([later, earlier], first)
    return after.log_likelihood - before.log_likelihood


def _one_suffices(
    given: SearchInput, first: MeanSearch, linear: SearchOutcome, one: SearchOutcome, strong: _Refit | None
) -> bool:
    """Tell whether one effect explains the residuals as well as the several that the linearised search selected.

    It must not leave a misfit where these leave none. If it is strong, it is also compared with these without linearising: what
    each further effect adds on average must not be significant.

    one: the explanation by one effect; strong: the refit of that effect, None if no effect is strong.
    """
    if len(linear.estimates) < 2 or any(each.candidate.empirical for each in linear.estimates):
        return True
    if one.leaves_more_misfit_than(linear):
        return False
    several = None if strong is None else _Refit.of(given, first, linear.estimates)
    if strong is None or several is None:
        return True
    together, alone = _on_common_points([_converged(given, first, several), strong], first)
    gain = (together.score - alone.score) / (len(together.estimates) - 1)
    return first.p_value(gain) > thresholds().mean.significance


def select_and_refit(given: SearchInput, first: MeanSearch) -> SearchOutcome:
    """Select the systematic sensor errors (effects) that explain residuals, and refit the strong ones without linearising.

    The linearised model is inexact for a large effect, and forward selection then adds spurious effects that absorb the
    linearisation error. The strongest effects are therefore refitted alone without linearising, and the selection is repeated
    beside the best one. If that still needs several effects, or if none is strong, each effect is tried alone
    (`screen_effects`). If several are needed then too, or if one explains significantly less, the selection is relinearised:
    repeated with the derivatives at the model that holds its effects.

    Parameters
    ----------
    given : points, residuals and candidate effects.
    first : the linearised search, in which residuals change in proportion to the size of each effect.

    Returns
    -------
    SearchOutcome : the explanation with the fewest empirical terms, and of these the one with the fewest effects.
    """
    together, tried = first.select()
    linear = SearchOutcome(together, estimates_of(first, together), first, given.part, together, tried)
    alone = _strongest_single_fits(given, first, together) if together else None
    if alone is None:
        return _search_beside(given, linear) or linear
    fits, beside_best = alone, _search_beside_best(given, linear, alone) if alone else None
    if beside_best is None or len(beside_best.estimates) > 1:
        screened = _screened_single_fits(given, first, alone)
        if screened and (not alone or screened[0].estimates is not alone[0].estimates):
            fits, beside_best = screened, _search_beside_best(given, linear, screened) or beside_best
    if beside_best is not None and len(beside_best.estimates) == 1:
        if _one_suffices(given, first, linear, beside_best, fits[0] if alone else None):
            return beside_best
        beside_best = None
    best = beside_best if beside_best is not None and _within_bounds(given, beside_best) else None
    best = _simpler(given, best, linear, ties=not alone)
    if best is None or best.complexity > (0, 1):
        relinearised, complete = _relinearised(given, linear)
        best = _simpler(given, best, relinearised, ties=True, complete=complete)
    return linear if best is None else best


def outline_effects(given: SearchInput, first: MeanSearch) -> list[Estimate]:
    """Fit the effects of the catalogue that a linearised search selects once more: jointly, and with the full sensor model.

    The list is empty if the sensor model does not accept their sizes, or if too few rays meet the reference with them.
    """
    estimates = [each for each in estimates_of(first, first.select()[0]) if not each.candidate.empirical]
    together = _Refit.of(given, first, estimates) if estimates else None
    return [] if together is None else [*_converged(given, first, together).estimates]


def _relinearised(given: SearchInput, linear: SearchOutcome) -> tuple[SearchOutcome, bool]:
    """Repeat a selection with derivatives taken at the model that holds its effects, until it selects the same ones again.

    This is the Gauss-Newton iteration, with the set of effects free as well as their sizes.

    Returns
    -------
    The last selection, and whether it repeats the one before: then it has searched for all effects that it may lack.
    """
    found, seen, most = linear, list[set[str]](), _MOST_SELECTIONS[linear.complexity[0] > 0]
    while (names := {each.candidate.name for each in found.estimates}) not in seen and len(seen) < most:
        seen.append(names)
        found = _selected_at_fit(given, found) or found
    return found, found is not linear and names == seen[-1]


def _selected_at_fit(given: SearchInput, found: SearchOutcome) -> SearchOutcome | None:
    """Select effects anew, with the derivatives of the residuals taken at the model that holds the effects selected before.

    What these explain is added back to the residuals, so that all effects are selected again.

    None if no effect of the catalogue was selected, if one is out of bounds, or if too few rays meet the reference.
    """
    at_fit = search_at_fit(given, _physical(found)) if _within_bounds(given, found) else None
    if at_fit is None:
        return None
    search, left, _ = at_fit
    together, tried = search.select()
    return SearchOutcome(together, estimates_of(search, together), search, left, together, tried)


def with_classes_at_fit(given: SearchInput, found: SearchOutcome) -> SearchOutcome:
    """Find the effects from which those of an explanation cannot be told (equivalence classes), with all of them in the model.

    The classes of the first search lack the effects that the second one found. Without such effects the classes stay as they are.
    They also stay if the explanation has an empirical term, or cannot be put into the model.

    given : input of the searches. found : the explanation.
    """
    if len(found.estimates) <= len(found.chosen) or any(each.candidate.empirical for each in found.estimates):
        return found
    at_fit = search_at_fit(given, found.estimates) if _within_bounds(given, found) else None
    if at_fit is None:
        return found
    search, _, known = at_fit
    members = tuple(FamilyScore(each.name, False, 0.0, 0.0, each) for each in known)
    estimates = []
    for each, item in zip(found.estimates, members, strict=True):
        refitted = ForwardSelection(search).with_equivalents(members, item, {})
        scores = {other.name: other.score for other in refitted.family_scores if not other.empirical}
        estimates.append(replace(each, chosen=_with_class(each.chosen, refitted, scores)))
    return replace(found, estimates=estimates)


def _with_class(chosen: SelectedEffect, refitted: SelectedEffect, scores: Mapping[str, float]) -> SelectedEffect:
    """Return an effect with the effects that a refit cannot tell from it (its equivalence class).

    For effects that were not refitted, the search before decides. One that this search could not tell from the effect must score
    worse by twice the margin in the refit, because either has its own error.

    chosen: the effect, with its class in the search before; refitted: the same in the refit; scores: of other effects there.
    """
    margin, before = equivalence_margin(refitted.log_likelihood_ratio), set(chosen.indistinguishable)
    near = {name for name, score in scores.items() if score > refitted.score - (1 + (name in before)) * margin}
    alike = (near | (before - set(scores))) - {chosen.candidate.name}
    return replace(chosen, indistinguishable=tuple(sorted(alike)), replacing_pair=())


def _simpler(
    given: SearchInput, best: SearchOutcome | None, other: SearchOutcome, ties: bool, complete: bool = False
) -> SearchOutcome | None:
    """Return the simpler of two explanations of the residuals, after a search for effects that the second one may lack.

    That search only adds effects, so it is left out where the second explanation cannot be simpler. One that still leaves a
    misfit, where the first leaves none, is no alternative.
    best: the first explanation; None if there is none. ties: whether the second one is returned if both are equally simple.
    complete: whether the second one lacks no effect, as was searched before.
    """
    if not other.chosen:
        return best

    def wins(complexity: tuple[int, int]) -> bool:
        return best is None or complexity < best.complexity or (ties and complexity == best.complexity)

    if not wins((0, sum(not each.candidate.empirical for each in other.estimates))):
        return best
    other = other if complete else _search_beside(given, other) or other
    if best is not None and other.leaves_more_misfit_than(best):
        return best
    return other if wins(other.complexity) and _within_bounds(given, other) else best


def _physical(outcome: SearchOutcome) -> list[Estimate]:
    """The effects of an explanation without its empirical terms."""
    return [each for each in outcome.estimates if not each.candidate.empirical]


def _within_bounds(given: SearchInput, outcome: SearchOutcome) -> bool:
    """Whether a sensor model accepts the effects of an explanation."""
    return not out_of_bounds(given.measurement, outcome.estimates, outcome.residuals)


def _strongest_single_fits(given: SearchInput, first: MeanSearch, together: list[SelectedEffect]) -> list[_Refit] | None:
    """The effects that alone explain most, refitted without linearising, best first.

    Empty if no effect is strong, or none can be put into the model. None if the linearised model is kept. Either it misjudges the
    strongest effect by less than `mean.class_margin` and less than half of the log-likelihood ratio of each selected effect. Or
    it selected a single effect of the catalogue, and no effect is strong.
    """
    found: list[_Refit] = []
    tolerance = min([thresholds().mean.class_margin, *(_ABSORBED_SHARE * each.log_likelihood_ratio for each in together)])
    leading = first.leading_effects()
    for candidate in leading:
        alone = _single_fit(given, first, candidate)
        if alone is None:
            continue
        compared = alone.used | (len(together) > 1)  # several effects may rest on points that the refit of one leaves out
        linearised = first.design.log_likelihood(np.where(compared, given.part.value, 0.0), [candidate])
        if not found and abs(alone.log_likelihood - linearised) < tolerance:
            return None
        found.append(alone)
    if not found:
        return None if not leading and [each.candidate.empirical for each in together] == [False] else []
    return _best_variants(given, first, found)


def _screened_single_fits(given: SearchInput, first: MeanSearch, alone: list[_Refit]) -> list[_Refit]:
    """Refit the effects that alone leave the smallest residuals, and add the significant ones to the given fits.

    Returns
    -------
    The best fit of each effect, the best effect first. A given fit is kept if a new one is hardly better.
    """
    sized = screen_effects(given.measurement, given.part, first.effect_variants(), _MOST_CONVERGED)
    more = [each for each in (_single_fit(given, first, item.candidate, item.values) for item in sized) if each is not None]
    refitted = [each for each in _best_variants(given, first, more) if each.is_significant(given, first)] if more else []
    if not refitted:
        return alone
    fits = _on_common_points([*alone, *refitted], first)
    best = {each.name: each for each in fits[: len(alone)]}
    for each in fits[len(alone) :]:
        if each.name not in best or each.score > best[each.name].score + _CONVERGED_GAIN:
            best[each.name] = each
    return sorted(best.values(), key=lambda each: -each.score)


def _single_fit(given: SearchInput, first: MeanSearch, candidate: Candidate, values: FloatArray | None = None) -> _Refit | None:
    """Put one effect into the sensor model. values: (k,) its coefficients; None: those of the linearised fit."""
    (estimate,) = estimates_of(first, [first.selected_alone(candidate)])
    return _Refit.of(given, first, [estimate if values is None else replace(estimate, values=values)])


def _best_variants(given: SearchInput, first: MeanSearch, found: list[_Refit]) -> list[_Refit]:
    """The best effects, refitted to convergence, best first.

    The best effect is also refitted for other cameras or choices of parameters, because which one it is may not show before.
    """
    ranked = _ranked_on_common_points(found, first)
    variants = {each.name: each for each in reversed(ranked)}
    likely = sorted(variants.values(), key=lambda each: -each.score)[:_MOST_CONVERGED]
    best, *rest = _ranked_on_common_points([_converged(given, first, each) for each in likely], first)
    others = [each for each in ranked if each.name == best.name and each is not variants[best.name]][: _MOST_CONVERGED - 1]
    same = _ranked_on_common_points([best, *(_converged(given, first, each) for each in others)], first)
    return _ranked_on_common_points([same[0], *rest], first)


def _search_beside_best(given: SearchInput, plain: SearchOutcome, alone: list[_Refit]) -> SearchOutcome | None:
    """Repeat the search beside the best of some single fits."""
    (estimate,) = _with_equivalence_class(alone).estimates
    return _search_beside(given, replace(plain, chosen=[estimate.chosen], estimates=[estimate]))


def _registered_residuals(found: Residuals, part: Residuals) -> tuple[FloatArray, BoolArray]:
    """Subtract what a robust fit of the sensor's pose explains from residuals that may lack some of the points of `part`.

    Returns
    -------
    (n,) the rest for each of the n points of `part`, outliers clipped, 0 where a point is not used; and (n,) which are used.
    """
    registered, _, noise_ratio = fit_pose_robustly(found)
    largest = thresholds().points.outlier_sigmas * noise_ratio * found.sigma
    value, used = np.zeros(len(part)), np.isin(part.index, found.index)
    value[used] = np.where(found.usable, np.clip(registered, -largest, largest), 0.0)
    used[used] = found.usable
    return value, used


def _with_equivalence_class(converged: list[_Refit]) -> _Refit:
    """Return the best of the refitted single effects, with the effects that cannot be told from it."""
    best, *others = converged
    (estimate,) = best.estimates
    chosen = estimate.chosen
    classed = _with_class(chosen, replace(chosen, score=best.score), {each.name: each.score for each in others})
    return replace(best, estimates=(replace(estimate, chosen=classed),))


def _converged(given: SearchInput, first: MeanSearch, alone: _Refit) -> _Refit:
    """Gauss-Newton steps until the log-likelihood rises by less than 1."""
    for _ in range(_MOST_ROUNDS):
        improved = alone.improved(given, first)
        if improved is None or _gain_over(improved, alone, first) < _CONVERGED_GAIN:
            break
        alone = improved
    return alone


def _search_beside(given: SearchInput, chosen: SearchOutcome) -> SearchOutcome | None:
    """Repeat the search with the selected effects of the catalogue in the sensor model.

    None if none was selected, if one is out of bounds, or if too few rays meet the reference.
    """
    physical = _physical(chosen)
    return repeat_search(given, chosen, physical) if physical and _within_bounds(given, chosen) else None
