"""Naming: effects on the mean and on the spread, from the points that selection may look at."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.gap import stereo_signatures, tls_signatures
from pipeline.gap.candidates import HARMONICS, PLACE, Candidate, Grid, free_forms, harmonics, places, surface_form
from pipeline.gap.cells import Cells
from pipeline.gap.entries import (
    PLANES,
    Estimate,
    Named,
    from_comb,
    from_locking,
    from_mean,
    from_spread,
    is_possible,
    typical_sizes,
    with_effects,
)
from pipeline.gap.locking import find_locking
from pipeline.gap.measurement import Measurement
from pipeline.gap.quantization import find_comb
from pipeline.gap.registration import registered, settled
from pipeline.gap.residuals import BoolArray, Residuals
from pipeline.gap.selection import Chosen, MeanSearch, Tried, precision_of
from pipeline.gap.spread import SpreadFound, SpreadTried, find_spread
from pipeline.gap.stereo_noise import told_apart
from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray
from sensors.model import StereoModel

_NOT_FREE = ("edge_step", "line", "disparity_fraction")
_LARGEST = 20.0
"""Standard deviation of an effect's size before there are data, in typical sizes."""
_PERIODIC = {"range_cyclic": "range", "row_jitter": "image_y"}
"""Sines whose overtones are looked for: an error that repeats but is no sine is not theirs."""


@dataclass(frozen=True)
class Naming:
    """What the selection leaves beside the effects: what was tried for the mean and for the spread, what remains, and the
    standard deviation of the reference."""

    tried: tuple[Tried, ...]
    spread_tried: tuple[SpreadTried, ...]
    remaining: dict[str, Any]
    identifiability: dict[str, Any]
    reference_sigma: float


def believes(measurement: Measurement, name: str) -> bool:
    """Whether the model holds an effect already."""
    return any(effect.name == name for effect in measurement.model.effects)


def families_of(measurement: Measurement, part: Residuals) -> list[Candidate | Grid]:
    """Every explanation of the mean that the fields of `part` allow, the catalogue's and free forms."""
    named = tls_signatures.mean_families(part) if part.sensor == "tls" else stereo_signatures.mean_families(part, measurement)
    lowest = {_PERIODIC[each.name]: each.frequencies[0] for each in named if isinstance(each, Grid) and each.name in _PERIODIC}
    free = [
        form
        for name, values in part.covariates.items()
        if name not in _NOT_FREE and np.ptp(values) > 0
        for form in free_forms(name, values, highest=lowest.get(name, np.inf))
    ]
    first, second = PLANES[part.sensor]
    both = surface_form(first, second, part.covariates[first], part.covariates[second])
    return [*map(_with_precision, named), *free, both, *places(part.at)]


def _with_precision(candidate: Candidate | Grid) -> Candidate | Grid:
    """With what is typical of its effect: two effects that nearly cancel each other must not do so at any size."""
    if isinstance(candidate, Grid):
        return candidate
    typical = typical_sizes(candidate.name)
    units = np.eye(len(candidate.names))
    first = next(iter(typical.values()))
    sizes = [
        typical.get(key, first) / max(abs(candidate.parameters(unit)[key]), 1e-300) if not key.startswith("phase") else first
        for key, unit in zip(candidate.names, units, strict=True)
    ]
    return replace(candidate, precision=1 / (_LARGEST * np.array(sizes)) ** 2)


def name_effects(
    measurement: Measurement,
    part: Residuals,
    scale: float,
    random: KeyedRandom,
    left_out: frozenset[tuple[str, bool]] = frozenset(),
) -> tuple[list[Named], Naming]:
    """Effects on the mean and on the spread.

    What the first search finds goes into the model, the residuals are taken again against that (exactly, where the first had only
    slopes), and the search is repeated beside what was found. scale: how many predicted sigmas the residuals spread; left_out:
    families (name, empirical) whose best values lie beyond the effect's bounds; all is done again without them, with a word.
    """
    named: list[Named] = []
    whole, whole_scale, added = part, scale, 0.0
    tls = part.sensor == "tls"
    comb = find_comb(part.geometry.measured_m) if tls and not believes(measurement, "range_quantization") else None
    if comb is not None:
        named.append(from_comb(comb, part))
        added, scale = comb.step_m**2 / 12, 1.0
    locking = (
        None if tls or believes(measurement, "pixel_locking") else find_locking(part.geometry.found, part.geometry.disparity)
    )
    if locking is not None:
        named.append(from_locking(locking))
        added = locking.amplitude_px**2 / 2
        left_out |= {("pixel_locking", False)}
    part = _noisier(part, added)
    families = [each for each in families_of(measurement, part) if (each.name, each.empirical) not in left_out]
    spread, spread_tried = _spread(measurement, part, Cells.over(part.at), registered(part)[0], random)
    first = MeanSearch(_weighed(part, spread, scale), families, random)
    together, tried = first.select()
    # slopes miss some of a large effect, and two others then make up for it: see first what one alone, taken exactly, leaves
    single = [[first.alone()]] if sum(not each.candidate.empirical for each in together) > 1 else []
    for chosen in (*single, together):
        estimates, last, at, beside = _estimates(first, chosen), first, part, chosen
        physical = [each for each in estimates if not each.candidate.empirical]
        beyond = _beyond(measurement, estimates, at)
        if physical and not beyond:
            last, at, estimates, beside, tried = _again(measurement, part, families, physical, spread, (scale, added), random)
            if not beside:
                break
            beyond = _beyond(measurement, estimates, at)
    if beyond:
        return name_effects(measurement, whole, whole_scale, random, left_out | beyond)
    if chosen:
        spread, spread_tried = _spread(measurement, at, last.cells, last.without(beside), random)
    named += [from_mean(each, at) for each in estimates]
    named += [from_spread(each, part.sensor) for each in spread]
    names, cosines, survival = first.identifiability()
    remaining = {"p_value": last.p_value(tried[0].score) if tried else 1.0, "note": "; ".join([*part.notes, *_words(left_out)])}
    table = {"names": [f"{part.sensor}.{name}" for name in names], "cosines": cosines.tolist(), "survival": survival.tolist()}
    shown = tuple(item for item in (chosen[0].tried if chosen else tried) if not item.name.startswith(PLACE))
    return named, Naming(shown, tuple(spread_tried), remaining, table, last.reference_sigma(beside))


def _spread(
    measurement: Measurement, part: Residuals, cells: Cells, value: FloatArray, random: KeyedRandom
) -> tuple[list[SpreadFound], list[SpreadTried]]:
    """Effects on the spread of residuals (n,) without the mean effects found, and what was tried."""
    found, tried = find_spread(part, cells, value, random)
    model = measurement.model
    return (told_apart(found, part, value, model) if found and isinstance(model, StereoModel) else found), tried


def _beyond(measurement: Measurement, estimates: list[Estimate], part: Residuals) -> frozenset[tuple[str, bool]]:
    """Families whose estimate lies beyond the bounds of the effect."""
    wrong = [each for each in estimates if not is_possible(measurement.model, from_mean(each, part).entry)]
    return frozenset((each.candidate.name, each.candidate.empirical) for each in wrong)


def _words(left_out: frozenset[tuple[str, bool]]) -> list[str]:
    said = (f"free forms of {name}" if empirical else name for name, empirical in sorted(left_out))
    return [f"{what} left out: the best value is beyond what a config may hold" for what in said]


def _noisier(part: Residuals, variance: float) -> Residuals:
    return replace(part, sigma=np.sqrt(part.sigma**2 + variance)) if variance else part


def _weighed(part: Residuals, spread: list[SpreadFound], scale: float) -> Residuals:
    """With the spread that the points really have."""
    if not spread:
        return replace(part, sigma=part.sigma * scale)
    nodes = sum(each.parameters["sigma_px"] ** 2 for each in spread if each.name == "regularization_noise")
    variance, width = part.shared_noise
    sigma = np.sqrt(part.sigma**2 + sum(each.variance for each in spread))
    return replace(part, sigma=sigma, shared_noise=(variance + nodes, width))


def _estimates(search: MeanSearch, chosen: list[Chosen]) -> list[Estimate]:
    candidates, fit = search.refined([item.candidate for item in chosen])
    places = search.split(np.arange(len(fit.coefficients)), candidates)
    return [
        Estimate(item, candidate, fit.coefficients[place], fit.covariance[np.ix_(place, place)])
        for item, candidate, place in zip(chosen, candidates, places, strict=True)
    ]


def _again(
    measurement: Measurement,
    part: Residuals,
    families: list[Candidate | Grid],
    had: list[Estimate],
    spread: list[SpreadFound],
    noise: tuple[float, float],
    random: KeyedRandom,
) -> tuple[MeanSearch, Residuals, list[Estimate], list[Chosen], tuple[Tried, ...]]:
    """The search beside effects that the model now has, whose values are free to move a little: they count as pose.

    noise: how many predicted sigmas the residuals spread, and variance to add to the predicted one. Returns the search,
    its residuals, the effects with what was found beside them, that alone, and what was tried last.
    """
    model = with_effects(measurement.model, [from_mean(each, part).entry for each in had])
    there, found, _ = settled(measurement.changed(model=model), part.index)
    at = _noisier(_at_points(found, part), noise[1])
    renewed = families_of(there, at)
    allowed = {(family.name, family.empirical) for family in families}
    names = {each.candidate.name for each in had}
    others = [each for each in renewed if (each.name, each.empirical) in allowed and (each.empirical or each.name not in names)]
    known = [replace(each, candidate=_renewed(each.candidate, renewed)) for each in had]
    columns = [_columns(each) for each in known]
    others += [harmonics(_PERIODIC[name], each.candidate) for each in known if (name := each.candidate.name) in _PERIODIC]
    weighed = _weighed(at, [replace(each, variance=each.variance[_kept(at, part)]) for each in spread], noise[0])
    precision = [precision_of(each.candidate, matrix.shape[1]) for each, matrix in zip(known, columns, strict=True)]
    search = MeanSearch(
        replace(weighed, pose=np.concatenate([at.pose, *columns], axis=1)),
        others,
        random.child("again"),
        np.concatenate([np.zeros(at.pose.shape[1]), *precision]),
    )
    chosen, tried = search.select()
    fit = search.refined([item.candidate for item in chosen])[1]
    kept, start = [], at.pose.shape[1]
    for each, matrix in zip(known, columns, strict=True):
        place = slice(start, start := start + matrix.shape[1])
        kept.append(replace(each, values=each.values + fit.coefficients[place], covariance=fit.covariance[place, place]))
    return search, at, _without_sines([*kept, *_estimates(search, chosen)]), chosen, tried


def _without_sines(estimates: list[Estimate]) -> list[Estimate]:
    """A named sine with overtones becomes one empirical term."""
    found = list(estimates)
    for overtones in (each for each in estimates if each.candidate.form == HARMONICS):
        sine = next(each for each in estimates if _PERIODIC.get(each.candidate.name) == overtones.candidate.name)
        both = np.concatenate([sine.candidate.columns, overtones.candidate.columns], axis=1)
        width = sine.candidate.columns.shape[1]
        values = np.concatenate([sine.values[:width], overtones.values])
        found = [each for each in found if each is not sine and each is not overtones]
        found.append(replace(overtones, candidate=replace(overtones.candidate, matrix=both), values=values))
    return found


def _at_points(found: Residuals, part: Residuals) -> Residuals:
    """What was found at the points of a part, where the surface is smooth there too."""
    place = np.full(int(max(found.index.max(), part.index.max())) + 1, -1)
    place[found.index[found.smooth]] = np.flatnonzero(found.smooth)
    rows = place[part.index]
    return found.part(rows[rows >= 0])


def _kept(at: Residuals, part: Residuals) -> BoolArray:
    """Which points of the part are left."""
    return np.isin(part.index, at.index)


def _renewed(candidate: Candidate, families: list[Candidate | Grid]) -> Candidate:
    """The same candidate for other rays."""
    key = "" if candidate.wave is None else candidate.wave.key
    chosen = {name: value for name, value in candidate.fixed.items() if name != key}
    for family in families:
        if family.name == candidate.name and not family.empirical and dict(family.fixed) == chosen:
            if isinstance(family, Grid):
                return family.at(candidate.period)
            if family.names == candidate.names:
                return family
    raise KeyError(candidate.name)


def _columns(found: Estimate) -> FloatArray:
    """(n, k) of its coefficients, a sine's with that of its frequency."""
    wave = found.candidate.wave
    return found.candidate.columns if wave is None else wave.with_slope(found.candidate.period, found.values[:2])
