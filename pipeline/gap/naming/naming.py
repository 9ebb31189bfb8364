"""Naming: effects on the mean and on the spread, from the points that selection may look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement
from pipeline.gap.decisions import decided
from pipeline.gap.mean.candidates import LINE_PATTERN, SPATIAL_NULL
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.mean.selection import FamilyScore, SelectedEffect
from pipeline.gap.naming.entries import (
    Estimate,
    Named,
    from_comb,
    from_locking,
    from_mean,
    from_spread,
    settled_with,
    with_corrections,
    within_bounds,
)
from pipeline.gap.naming.families import believes, families_of
from pipeline.gap.naming.relinearised import Explained, SearchedPoints, at_points, beyond, followed_up, noisier, undone, weighed
from pipeline.gap.other.locking import SpreadAllowed, find_locking
from pipeline.gap.other.quantization import find_comb
from pipeline.gap.other.spread import SpreadFound, SpreadTried, TimesPredicted, find_spread
from pipeline.gap.other.stereo_noise import find_nodes, told_apart
from pipeline.gap.residuals.alignment import fit_pose_robustly
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.residuals.wall_blocks import WallCells
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.angle_empirical import AngleEmpirical
from sensors.effects.base import ShowsIn
from sensors.effects.pixel_locking import PixelLocking
from sensors.effects.range_quantization import RangeQuantization
from sensors.effects.regularization_noise import RegularizationNoise

_NODES = RegularizationNoise.tag()
FREE_FORMS = ("", True)
"""Stands for all families of empirical terms."""


@dataclass(frozen=True)
class Naming:
    """What the selection leaves beside the effects: what was tried for the mean and for the spread, notes, and the standard
    deviation of the reference.

    moving: names of the effects on the mean; p_value, p_alone: of what remains beside all of them, and without any; None where
    nothing was tried; times: that they spread within cells, 1 where an effect says why; spreads: how many predicted sigmas the
    residuals spread beside the effects on the mean.
    """

    tried: tuple[FamilyScore, ...]
    spread_tried: tuple[SpreadTried, ...]
    moving: frozenset[str]
    p_value: float | None
    p_alone: float | None
    times: TimesPredicted
    notes: tuple[str, ...]
    identifiability: dict[str, Any]
    reference_sigma: float
    spreads: float

    def p_beside(self, named: Sequence[Named]) -> float | None:
        """Of what remains beside those that were kept of the effects on the mean; None where that was not drawn."""
        kept = self.moving & {item.name for item in named}
        if kept == self.moving:
            return self.p_value
        return None if kept else self.p_alone


def name_effects(
    measurement: Measurement,
    part: Residuals,
    scale: float,
    random: KeyedRandom,
    left_out: frozenset[tuple[str, bool]] = frozenset(),
    nodes: SpreadFound | None = None,
) -> tuple[list[Named], Naming]:
    """Effects on the mean and on the spread.

    What the first search finds goes into the model, the residuals are taken again against that (exactly, where the first had only
    slopes), and the search is repeated beside what was found. scale: how many predicted sigmas the residuals spread; left_out:
    families (name, empirical) whose best values lie beyond the effect's bounds; all is done again without them, with a word; or
    `FREE_FORMS`;
    nodes: noise that neighbours share, found in what a search had left: it feigns free forms, and an error of the reference that
    is larger than the true one, so that all is searched again beside it.
    """
    named: list[Named] = []
    whole, whole_scale, added = part, scale, 0.0
    comb = locking = None
    if isinstance(part, TlsResiduals) and not believes(measurement, RangeQuantization.tag()):
        comb = find_comb(part.geometry.measured_m)
    if isinstance(part, StereoResiduals) and not believes(measurement, PixelLocking.tag()):
        at = part.geometry
        allowed = SpreadAllowed(float(np.median(part.sigma)), nmad(fit_pose_robustly(part)[0]))
        locking = find_locking(at.found, at.disparity, at.tangent, at.infinity, allowed)
    if comb is not None:
        named.append(from_comb(comb, part))
        added, scale = comb.step_m**2 / 12, 1.0
    found_apart = set()
    if locking is not None:
        named.append(from_locking(locking))
        added = locking.amplitude_px**2 / 2
        found_apart.add((PixelLocking.tag(), False))
    part = noisier(part, added)
    out = left_out | found_apart
    possible = (each for each in families_of(measurement, part) if (each.name, each.empirical) not in out)
    families = [each for each in possible if not (each.empirical and FREE_FORMS in out)]
    spread, spread_tried, words = _spread(
        measurement, part, WallCells.over(part.wall_xy), fit_pose_robustly(part)[0], random, left_out
    )
    if wrong := _too_wide(measurement, spread):
        return name_effects(measurement, whole, whole_scale, random, left_out | wrong)
    if not spread and nodes is not None:
        spread = [nodes]

    def spread_at(at: Residuals) -> list[SpreadFound]:
        there = _spread(measurement, at, WallCells.over(at.wall_xy), fit_pose_robustly(at)[0], random, left_out)[0]
        if there or nodes is None:
            return there
        return [replace(nodes, variance=nodes.variance[np.isin(part.index, at.index)])]

    points = SearchedPoints(measurement, part, families, spread_at, added, random)
    first = MeanSearch(weighed(part, spread, scale), families, random)
    found = followed_up(points, first)
    physical = any(not each.empirical for each in families)
    names, cosines, survival = first.design.identifiability() if physical else ([], np.zeros((0, 0)), np.zeros(0))
    wrong = beyond(measurement, found.estimates, found.at)
    doubtful = undone(found.estimates, found.at, dict(zip(names, survival, strict=True)))
    if doubtful and not _explains_all(found):
        wrong |= doubtful
    design = found.search.design
    left = design.residuals_after([each.candidate for each in found.beside])
    if found.chosen and not wrong:
        spread, spread_tried, words = _spread(measurement, found.at, design.cells, left, random, left_out)
    if spread in ([], [nodes]) and (_NODES, False) not in left_out:
        match measurement, part, found.at:
            case StereoMeasurement(model=model), StereoResiduals(), StereoResiduals():
                nodes_left, shared = find_nodes(found.at, left, model, random)
                described = any(each.candidate.empirical for each in found.estimates)
                if nodes_left is not None and nodes is None:
                    nodes_in_all = find_nodes(part, fit_pose_robustly(part)[0], model, random)[0] if described else None
                    found_nodes = nodes_in_all or nodes_left.everywhere(len(part))
                    return name_effects(measurement, whole, whole_scale, random, left_out, found_nodes)
                kept = nodes_left or (None if described else nodes)
                spread, words = ([], words or shared) if kept is None else ([kept], words)
    if wrong := (wrong | _too_wide(measurement, spread)) - left_out:
        again, naming = name_effects(measurement, whole, whole_scale, random, left_out | wrong)
        return with_doubtful(again, found.chosen, frozenset(each.candidate.name for each in found.estimates), wrong), naming
    moving = [from_mean(each, found.at) for each in found.estimates]
    named += moving
    named += [from_spread(each, part.sensor) for each in spread]
    times = TimesPredicted(1.0, False) if spread else TimesPredicted.of(found.at, design.cells, left, random)
    said = (*_repeats(found.estimates), *_slanting(found), *_most_like(found, part))
    notes = (*part.notes, *_words(left_out), *filter(None, [words]), *said)
    p_value = found.search.goodness_of_fit_p_value(found.tried)
    alone = first.score_families(()) if moving else ()
    p_alone = first.goodness_of_fit_p_value(alone) if alone else p_value
    names_moving = frozenset(each.name for each in moving)
    table = {"names": [f"{part.sensor}.{name}" for name in names], "cosines": cosines.tolist(), "survival": survival.tolist()}
    tried = found.chosen[0].family_scores if found.chosen else found.tried
    shown = tuple(item for item in tried if not item.name.startswith(SPATIAL_NULL))
    sigma = design.reference_sigma([each.candidate for each in found.beside])
    spreads = nmad(left / found.at.sigma, 0.0)
    naming = Naming(shown, tuple(spread_tried), names_moving, p_value, p_alone, times, notes, table, sigma, spreads)
    angles = [each for each in moving if each.effect is AngleEmpirical]
    if angles and not believes(measurement, AngleEmpirical.tag()):
        return _with_angles(measurement, whole, angles, naming, random, left_out)
    return named, naming


def _explains_all(found: Explained) -> bool:
    """Whether effects of the catalogue alone were found, and no more than chance is left beside them."""
    p_value = found.search.goodness_of_fit_p_value(found.tried)
    physical = not any(each.candidate.empirical for each in found.estimates)
    return physical and p_value is not None and p_value > decided().verdict.least_p


def with_doubtful(
    named: list[Named], chosen: list[SelectedEffect], before: frozenset[str], left_out: frozenset[tuple[str, bool]]
) -> list[Named]:
    """An effect that was chosen first and is too large to be committed to stays in the class of those that would do as well: by
    slopes, or since they were not among those named with it (`before`) and stand in its place."""
    doubtful = [each for each in chosen if (each.candidate.name, False) in left_out]
    found = []
    for item in named:
        sensor, name = item.name.split(".", 1)
        instead = item.kind == "physical" and item.effect.shows_in == ShowsIn.MEAN and name not in before
        alike = {f"{sensor}.{each.candidate.name}" for each in doubtful if instead or name in each.indistinguishable}
        found.append(replace(item, alike=(*item.alike, *sorted(alike - {item.name, *item.alike}))))
    return found


def _with_angles(
    measurement: Measurement,
    whole: Residuals,
    angles: list[Named],
    first: Naming,
    random: KeyedRandom,
    left_out: frozenset[tuple[str, bool]],
) -> tuple[list[Named], Naming]:
    """All is named again with the free forms of errors of an angle in the model: slopes miss where a ray goes that turns far.

    What the second search finds of the same form is added to the first's curve.
    """
    there, found, _ = settled_with(measurement, angles, whole.index)
    at = at_points(found, whole)
    named, naming = name_effects(there, at, fit_pose_robustly(at)[2], random.child("angles"), left_out)
    joined, others = with_corrections(angles, [item for item in named if item.effect is AngleEmpirical], whole)
    rest = [item for item in named if item.effect is not AngleEmpirical]
    moving = naming.moving | {item.name for item in angles}
    again = replace(naming, tried=first.tried, moving=moving, p_alone=first.p_alone, identifiability=first.identifiability)
    return [*joined, *others, *rest], again


def _repeats(estimates: list[Estimate]) -> list[str]:
    """Words for forms that repeat after a few lines."""
    lines = [each.candidate.fixed["lines"] for each in estimates if each.candidate.form.startswith(LINE_PATTERN)]
    return [f"what is described repeats every {each} lines exactly: facets of a mirror or a read-out in blocks" for each in lines]


def _most_like(found: Explained, part: Residuals) -> list[str]:
    """Words for what remains where it is more than chance leaves, and nothing was found that says it."""
    p_value = found.search.goodness_of_fit_p_value(found.tried)
    if found.estimates or p_value is None or p_value > decided().verdict.least_p:
        return []
    best = max((item for item in found.tried if not item.name.startswith(SPATIAL_NULL)), key=lambda item: item.score)
    what = f"a change with {best.name} ({best.candidate.form})" if best.empirical else best.name
    size = 1e3 * found.search.fitted_std(best) * float(np.median(part.unit_m))
    return [
        f"what remains is most like {what}, {size:.2g} mm (standard deviation): a reference that is wrong along whole lines or "
        "columns, as in strips, looks so too, and points from another station would tell"
    ]


def _slanting(found: Explained) -> list[str]:
    """Words for waves across the wall that are larger than chance leaves, though no sensor has an axis there."""
    p_value = found.search.spatial_null_p_value(found.tried)
    if p_value is None or p_value > decided().verdict.least_p:
        return []
    return [
        f"the residuals vary slantwise across the wall more than a reference wrong by a Gaussian process would let them (p-value "
        f"{p_value:.2g}): no sensor has an axis there, so this is taken for the reference's error"
    ]


def _spread(
    measurement: Measurement,
    part: Residuals,
    cells: WallCells,
    value: FloatArray,
    random: KeyedRandom,
    left_out: frozenset[tuple[str, bool]],
) -> tuple[list[SpreadFound], list[SpreadTried], str]:
    """Effects on the spread of residuals (n,) without the mean effects found, what was tried, and words for a spread of none."""
    names = frozenset(name for name, empirical in left_out if not empirical)
    found, tried, words = find_spread(part, cells, value, random, names)
    match measurement, part:
        case StereoMeasurement(), StereoResiduals():
            found = told_apart(found, part, value, measurement.model)
    return [each for each in found if each.effect not in names], tried, words


def _too_wide(measurement: Measurement, spread: list[SpreadFound]) -> frozenset[tuple[str, bool]]:
    """Families of the spread whose values lie beyond the bounds of the effect that is to hold them."""
    entries = {each.effect: from_spread(each, measurement.sensor).entry for each in spread}
    return frozenset((name, False) for name, entry in entries.items() if not within_bounds(measurement.model, entry))


def _words(left_out: frozenset[tuple[str, bool]]) -> list[str]:
    said = (f"free forms of {name}" if empirical else name for name, empirical in sorted(left_out - {FREE_FORMS}))
    why = (
        "the best value is beyond what a config may hold, or many times the usual where the registration undoes nearly all of it "
        "and more is left than chance gives"
    )
    return [f"{what} left out: {why}" for what in said]
