"""Search for systematic errors with others in the sensor model, and fit several errors together without linearising."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.gap.mean.candidates import Candidate, SineGrid, prior_precision
from pipeline.gap.mean.nonparametric_terms import HARMONIC_ORDERS, HARMONICS, harmonics
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.mean.selection import SelectedEffect
from pipeline.gap.naming.candidate_families import PERIODIC, candidate_families, catalogue_families
from pipeline.gap.naming.named_effects import Estimate, aligned_with, effect_from_estimate
from pipeline.gap.naming.search_outcome import SearchInput, SearchOutcome
from pipeline.gap.naming.search_residuals import with_added_variance, with_fitted_variance
from pipeline.gap.residuals.alignment import AlignedMeasurement, at_points_of, fit_pose_robustly
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.thresholds import thresholds


def repeat_search(given: SearchInput, before: SearchOutcome, known_effects: list[Estimate]) -> SearchOutcome | None:
    """Repeat the search with some effects in the model, whose coefficients stay free like the pose.

    Parameters
    ----------
    given : input of the searches.
    before : explanation of the search before.
    known_effects : effects to put into the model.

    Returns
    -------
    SearchOutcome or None : the effects that are in the model and those that were found beside them; None if too few rays meet
        the reference with the effects.
    """
    there = _with_in_model(given, known_effects)
    if there is None:
        return None
    at, catalogue, families = there
    names = {each.candidate.name for each in known_effects}
    families = [each for each in families if each.empirical or each.name not in names]
    known = [replace(each, candidate=recomputed(each.candidate, catalogue)) for each in known_effects]
    periodic = [(PERIODIC[name], each.candidate) for each in known if (name := each.candidate.name) in PERIODIC]
    families += [harmonics(covariate, sine, last) for covariate, sine in periodic for last in HARMONIC_ORDERS]
    pose = at.pose_jacobian.shape[1]
    columns = [each.candidate.columns_with_derivative(None if each.candidate.wave is None else each.values[:2]) for each in known]
    precision = [prior_precision(each.candidate, matrix.shape[1]) for each, matrix in zip(known, columns, strict=True)]
    search = MeanSearch(
        replace(with_variance_refitted(given, at), pose_jacobian=np.concatenate([at.pose_jacobian, *columns], axis=1)),
        families,
        given.random.child("again"),
        np.concatenate([np.zeros(pose), *precision]),
        before.search.single_effect_ratios,
    )
    chosen, tried = search.select()
    fit = search.design.fit_refined([item.candidate for item in chosen])[1]
    kept, start = [], pose
    for each, matrix in zip(known, columns, strict=True):
        place = slice(start, start := start + matrix.shape[1])
        kept.append(replace(each, values=each.values + fit.coefficients[place], covariance=fit.covariance[place, place]))
    estimates = _merge_sines_with_overtones([*kept, *estimates_of(search, chosen)])
    return SearchOutcome(before.chosen, estimates, search, at, chosen, tried)


def search_at_fit(given: SearchInput, effects: list[Estimate]) -> tuple[MeanSearch, Residuals, list[Candidate]] | None:
    """Prepare a search in which the derivatives of the residuals are those of a sensor model that has some effects.

    What these explain is added back to the residuals, so that the search can select all of them again.

    Parameters
    ----------
    given : input of the searches.
    effects : effects of the catalogue, with the coefficients that they get in the model.

    Returns
    -------
    search : the search.
    left : the residuals that it explains.
    known : the effects as regression terms of this search.

    None if there are no effects, or if too few rays meet the reference with them.
    """
    there = _with_in_model(given, effects) if effects else None
    if there is None:
        return None
    at, catalogue, families = there
    known = [recomputed(each.candidate, catalogue) for each in effects]
    pairs = zip(known, effects, strict=True)
    left = replace(at, value=at.value + sum(term.columns @ each.values[: term.columns.shape[1]] for term, each in pairs))
    search = MeanSearch(replace(with_variance_refitted(given, at), value=left.value), families, given.random.child("again"))
    return search, left, known


def _with_in_model(
    given: SearchInput, effects: list[Estimate]
) -> tuple[Residuals, list[Candidate | SineGrid], list[Candidate | SineGrid]] | None:
    """Put effects into the model; None if too few rays meet the reference with them.

    Returns
    -------
    at : residuals with the effects in the model.
    catalogue : all effects of the catalogue as regression terms there.
    families : all candidates there that are to be tried.
    """
    measurement, found, _ = aligned_with_estimates(given, effects)
    at = with_added_variance(at_points_of(found, given.part), given.added)
    if too_few_left(given, at):
        return None
    catalogue = catalogue_families(measurement, at)
    allowed = {(family.name, family.empirical) for family in given.families}
    return (
        at,
        catalogue,
        [each for each in candidate_families(measurement, at, catalogue) if (each.name, each.empirical) in allowed],
    )


def estimates_of(search: MeanSearch, chosen: list[SelectedEffect]) -> list[Estimate]:
    """Fit the selected effects jointly, with the periods of sines, and return their coefficients with covariance.

    search : the search that selected the effects; chosen : these effects, which may be empirical terms.
    """
    candidates, fit = search.design.fit_refined([item.candidate for item in chosen])
    places = search.design.split_coefficients(np.arange(len(fit.coefficients)), candidates)
    return [
        Estimate(item, candidate, fit.coefficients[place], fit.covariance[np.ix_(place, place)])
        for item, candidate, place in zip(chosen, candidates, places, strict=True)
    ]


def aligned_with_estimates(given: SearchInput, effects: list[Estimate]) -> AlignedMeasurement:
    """Put some effects into the model of the measurement, and estimate the sensor's pose again.

    given : the measurement; effects : the effects, with the coefficients that they get.

    Returns
    -------
    measurement, residuals, pose : the measurement with the effects and at the new pose, residuals there, and that pose.
    """
    return aligned_with(given.measurement, [effect_from_estimate(each, given.part) for each in effects], given.part.index)


def with_variance_refitted(given: SearchInput, at: Residuals) -> Residuals:
    """Fit noise terms to residuals with effects in the model, because the patterns of effects would look like noise.

    given : holds the function that fits noise terms; at : residuals with the effects in the model.

    Returns
    -------
    The residuals with the variance of the noise terms added to the predicted one.
    """
    return with_fitted_variance(at, given.variance_at(at), fit_pose_robustly(at)[2])


def recomputed(candidate: Candidate, families: list[Candidate | SineGrid]) -> Candidate:
    """Return an effect as a regression term for other rays or another sensor model.

    candidate : the effect; of a sine, the period is kept.
    families : the effects of the catalogue for the other rays.

    Raises
    ------
    KeyError : the families do not hold the effect with the same fixed values, such as its camera.
    """
    key = "" if candidate.wave is None else candidate.wave.key
    chosen = {name: value for name, value in candidate.fixed.items() if name != key}
    for family in families:
        if family.name == candidate.name and not family.empirical and dict(family.fixed) == chosen:
            if isinstance(family, SineGrid):
                return family.at_period(candidate.period)
            if family.names == candidate.names:
                return family
    raise KeyError(candidate.name)


def too_few_left(given: SearchInput, at: Residuals) -> bool:
    """Tell whether too few of the points meet the reference for a search (threshold `points.least_share_on_reference`).

    given : the points; at : residuals of those that meet the reference.
    """
    return len(at) < thresholds().points.least_share_on_reference * len(given.part)


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
