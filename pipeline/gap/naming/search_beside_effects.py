"""Search for systematic errors with others in the sensor model, and fit several errors together without linearising."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.mean.candidates import Candidate, SineGrid, prior_precision
from pipeline.gap.mean.nonparametric_terms import HARMONIC_ORDERS, HARMONICS, harmonics
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.mean.selection import SelectedEffect
from pipeline.gap.naming.candidate_families import PERIODIC, candidate_families, catalogue_families
from pipeline.gap.naming.effect_screening import all_columns, estimate_of_size, gauss_newton_step
from pipeline.gap.naming.named_effects import Estimate, aligned_with, effect_from_estimate, out_of_bounds
from pipeline.gap.naming.search_outcome import SearchInput, SearchOutcome
from pipeline.gap.naming.search_residuals import with_added_variance, with_fitted_variance
from pipeline.gap.residuals.alignment import AlignedMeasurement, at_points_of, fit_pose_robustly
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray

_MOST_FITS, _CONVERGED_DECREASE = 10, 0.005
"""Most iterations of a joint fit, and the relative decrease of the mean square at which it ends where nothing else is said."""


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
    measurement, found, _ = aligned_with_estimates(given, known_effects)
    at = with_added_variance(at_points_of(found, given.part), given.added)
    if too_few_left(given, at):
        return None
    catalogue = catalogue_families(measurement, at)
    allowed = {(family.name, family.empirical) for family in given.families}
    allowed -= {(each.candidate.name, False) for each in known_effects}
    families = [each for each in candidate_families(measurement, at, catalogue) if (each.name, each.empirical) in allowed]
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


def search_at_joint_fit(given: SearchInput) -> SearchOutcome | None:
    """Search for systematic sensor errors (effects) after fitting all effects of the catalogue together.

    It serves measurements with several large errors, for which a model that is linearised without effects is inexact. The joint
    fit moves each ray to about where the real one was, so that the derivatives taken there are right. What the fitted effects
    explain is then added back to the residuals, and effects are selected anew.

    given: points, residuals and candidate effects. None is returned if the catalogue has no effects for these residuals, if a
    fitted effect is out of bounds, or if too few points remain.
    """
    plain = [each for each in given.families if isinstance(each, Candidate) and not each.empirical]
    fitted = fit_jointly(given, plain) if plain else None
    if fitted is None:
        return None
    measurement, at, explained = fitted
    allowed = {(family.name, family.empirical) for family in given.families}
    families = [each for each in candidate_families(measurement, at) if (each.name, each.empirical) in allowed]
    left = replace(at, value=at.value + explained)
    weighted = replace(with_variance_refitted(given, at), value=left.value)
    search = MeanSearch(weighted, families, given.random.child("best fit"))
    together, tried = search.select()
    return SearchOutcome(together, estimates_of(search, together), search, left, together, tried)


def fit_jointly(
    given: SearchInput, candidates: list[Candidate], least_decrease: float = _CONVERGED_DECREASE
) -> tuple[Measurement, Residuals, FloatArray] | None:
    """Fit the sizes of several systematic sensor errors (effects) together by Gauss-Newton, with the sensor's pose free.

    Parameters
    ----------
    given : points, residuals and candidate effects.
    candidates : the effects to fit, as regression terms.
    least_decrease : relative decrease of the mean squared residual, in units of the predicted variance, below which the fit ends.
        A step that increases it is dropped, except the first one, because the linearised start may be far off.

    Returns
    -------
    measurement : the measurement with the effects in its model.
    residuals : its residuals of n points.
    explained : (n,) part of the observations that the effects explain to first order, in the unit of the observable (m or px).

    None instead if an effect is out of bounds or too few points remain.
    """
    found = _JointFit.start(given, candidates)
    for number in range(_MOST_FITS):
        step = found.stepped(given)
        if step is None:
            return None
        before, after = found.mean_square_beside(step), step.mean_square_beside(found)
        if number and after > before:
            break
        found = step
        if number and after > (1 - least_decrease) * before:
            break
    return found.measurement, found.residuals, np.asarray(all_columns(found.candidates) @ found.values)


@dataclass(frozen=True)
class _JointFit:
    """Several effects together in the model.

    measurement: with them in its model; residuals: of n points; candidates: the effects as regression terms there; values: (k,)
    all their coefficients.
    """

    measurement: Measurement
    residuals: Residuals
    candidates: list[Candidate]
    values: FloatArray

    @classmethod
    def start(cls, given: SearchInput, candidates: list[Candidate]) -> _JointFit:
        """Start with effects of size zero."""
        return cls(given.measurement, given.part, candidates, np.zeros(sum(each.columns.shape[1] for each in candidates)))

    def mean_square_beside(self, other: _JointFit) -> float:
        """Mean squared residual, in units of the predicted variance, of the points that meet the reference in both fits."""
        common = np.isin(self.residuals.index, other.residuals.index)
        return float(np.mean((self.residuals.value / self.residuals.sigma)[common] ** 2))

    def stepped(self, given: SearchInput) -> _JointFit | None:
        """Change the sizes by a Gauss-Newton step; None if an effect is then out of bounds, or too few points remain."""
        values = self.values + gauss_newton_step(self.residuals, self.candidates, self.values)
        parts = np.split(values, np.cumsum([each.columns.shape[1] for each in self.candidates])[:-1])
        estimates = [estimate_of_size(each, part) for each, part in zip(self.candidates, parts, strict=True)]
        if out_of_bounds(given.measurement, estimates, self.residuals):
            return None
        measurement, found, _ = aligned_with_estimates(given, estimates)
        at = with_added_variance(at_points_of(found, given.part), given.added)
        if too_few_left(given, at):
            return None
        renewed = catalogue_families(measurement, at)
        return _JointFit(measurement, at, [recomputed(each, renewed) for each in self.candidates], values)


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
