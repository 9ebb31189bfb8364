"""Find compact regions where the surface itself changed, so that they are reported and not mistaken for sensor errors.

Points whose residuals exceed some sigmas on the same side, and that are neighbours in the sensor's view, form a component. Let a
share p of N points exceed the level by chance, and a share c of pairs agree in value. The expected number of components of m
points is then about

    E(m) = N a(m) p^m c^(m - 1)

where a(m) counts the shapes of m cells that touch at sides or corners (fixed polyplets, OEIS A006770). A component is a change if
far fewer than one such component is expected over all levels and both sides. It is extended to adjoining points at edges of the
reference, and to the fringe where the residuals decline.

Its volume sums the prisms of the rays between both surfaces, with the solid angle dO of each point:

    V = |sum (R^3 - R0^3) / 3 dO|,  to first order |sum R0^2 dR sin z daz dz|

Residuals are limited to what neighbours confirm, so that an outlier does not count. The standard deviation of the volume combines
the noise of each ray; the common error of the surroundings, from how much more medians of neighbours scatter than white noise
predicts; the rim (each straight side of sqrt(m) points is inside or not: sqrt(4 / 12) / sqrt(m) of the volume, a fifth more on
simulated blocks); and the sides of the rock that are visible from an angle.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import ndtri

from pipeline.change.robust import nmad
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.sensor_view import NEIGHBOURS, SensorView
from pipeline.gap.residuals.standardized import group_medians, nmad_along_covariates, standardize
from pipeline.gap.thresholds import thresholds
from scene.common.threads import map_in_threads
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray

Pairs = NDArray[np.int64]
"""Row numbers (2, k) of the two points of k pairs of neighbours."""

_LEVELS = (2.5, 4.0, 8.0)
"""Levels in sigmas above which points form components."""
_RATIOS, _NOISE = (2.0, np.inf), 3.0
"""Two neighbours agree if one residual exceeds the other at most by such a factor, or by so many sigmas. The narrow criterion
makes chance components rarer; the wide one finds a block of five points with varying depth if there are few outliers.
"""
_SEARCHES = 2 * len(_LEVELS) * len(_RATIOS)
"""Number of searches: both sides, each level, each ratio."""
_SHAPES = np.cumsum(np.log([1, 4, 5, 5.5, 5.8, 6.006, 6.157, 6.271, 6.361, 6.433]))
"""Logarithms of a(1) to a(10), from their ratios."""
_GROWTH = float(np.log(6.6))
"""Logarithm of the ratio a(m + 1) / a(m) = 6.6 for larger m."""
_EDGE_STEPS = 3
"""Steps by which a change may be extended over edges of the reference, in points."""
_LEAST_MEDIAN_STD = 0.4
"""Smallest standard deviation of medians of nine points, in sigmas; white noise gives 1.25 / 3."""
_WHITE_MEDIAN_STD = 0.418
"""Standard deviation of medians of nine standard normal values."""
_RIM, _SIDES = 0.7, 0.03
"""Relative standard deviation of a volume: by its rim, times one over the root of its number of points, and by its sides."""
_ROUNDS = 3
"""Most rounds of the search."""
_SAMPLE, _ALMOST_ALL = 4000, 5.0
"""Points sampled to estimate correlation, and sigmas at which their residuals are clipped."""


@dataclass(frozen=True)
class SceneChange:
    """A region where the rock itself changed between the reference and the measurement, such as a rockfall.

    Attributes
    ----------
    corners : (k, 3) points on the old and on the new surface that enclose the region, wall frame, m.
    volume_m3 : Volume of the rock that is missing or was added, m³, always positive.
    volume_std_m3 : Standard deviation of the volume, m³.
    offset_m : Median change of range, m, positive where rock is missing.
    """

    corners: FloatArray
    volume_m3: float
    volume_std_m3: float
    offset_m: float

    @property
    def bounds(self) -> FloatArray:
        """(2, 3) lowest and highest coordinates of the changed region, wall frame, m."""
        return np.stack([self.corners.min(axis=0), self.corners.max(axis=0)])

    def to_dict(self, frame: WallFrame) -> dict[str, Any]:
        """Return this changed region as an entry of the result file gap.json.

        Keys: `bbox_m` (lowest x, y, z, then highest, in the world frame of the survey, m), `volume_m3`, `volume_std_m3`.

        frame: the wall frame of the measurement, which converts to the world frame.
        """
        world = frame.to_world(self.corners)
        box = [*world.min(axis=0).tolist(), *world.max(axis=0).tolist()]
        return {"bbox_m": box, "volume_m3": self.volume_m3, "volume_std_m3": self.volume_std_m3}


def find_scene_changes(residuals: Residuals, view: SensorView, eligible: BoolArray) -> tuple[list[SceneChange], BoolArray]:
    """Find regions where the rock changed between reference and measurement, so that they are not taken for sensor errors.

    Residuals are compared with the local median and scatter of the others. Both are estimated again without the regions found,
    and the search is repeated, at most three times in all.

    Parameters
    ----------
    residuals : Residuals of n points after a rough alignment.
    view : Rays and neighbours of the same points, as the sensor saw them.
    eligible : (n,) true for points away from depth steps; only these are evidence of a change.

    Returns
    -------
    The changed regions, largest volume first; and (n,) true for points in such a region or within three point spacings of one.
    """
    beside = np.zeros(len(residuals), dtype=bool)
    if eligible.sum() < NEIGHBOURS:
        return [], beside
    for _ in range(_ROUNDS):
        before = beside
        unchanged = eligible & ~beside
        departure, z = standardize(residuals, view.scaled_coordinates, unchanged)
        medians = view.neighbour_median(np.where(eligible, z, 0.0))
        scatter = nmad_along_covariates(residuals, medians, unchanged)
        shared = np.sqrt(np.maximum(scatter**2 - _WHITE_MEDIAN_STD**2, 0.0))
        error = np.stack([np.abs(departure / np.where(z == 0, np.inf, z)), shared * residuals.sigma]) * residuals.unit_m
        faint = medians / np.maximum(scatter, _LEAST_MEDIAN_STD)
        faint[np.abs(medians) * residuals.sigma * residuals.unit_m < thresholds().points.reference_error] = 0.0
        label, limit = _components(z, faint, view, eligible)
        beside = view.near(np.flatnonzero(label >= 0), thresholds().changes.margin)
        if not (beside & ~before).any():
            break
    limited = departure * np.minimum(1.0, limit / np.maximum(np.abs(z), 1e-12))
    return _measure_changes(label, limited, error, view), beside


def drop_duplicates(changes: list[SceneChange]) -> list[SceneChange]:
    """Drop changed regions that were found more than once, in several scans of the same wall.

    changes: regions, largest volume first. One is dropped if its centre lies in the bounding box of an earlier one.
    """
    kept: list[SceneChange] = []
    for change in changes:
        middle = change.bounds.mean(axis=0)
        if not any((each.bounds[0] < middle).all() and (middle < each.bounds[1]).all() for each in kept):
            kept.append(change)
    return kept


def moved_share(residuals: Residuals, view: SensorView, eligible: BoolArray) -> float:
    """Return the share of points that lie off the reference with their neighbours, to detect that much of the rock moved.

    A point counts if the median residual of it and its eight neighbours exceeds three predicted standard deviations and 2 cm
    (defaults). White noise hardly ever does this: the median's standard deviation is only 0.4 times that of a single point.

    Parameters
    ----------
    residuals : Residuals of n points after alignment.
    view : Rays and neighbours of the same points, as the sensor saw them.
    eligible : (n,) true for points that are considered.

    Returns
    -------
    The share of the eligible points, from 0 to 1.
    """
    known = np.flatnonzero(eligible & np.isfinite(residuals.value))
    if len(known) < NEIGHBOURS:
        return 0.0
    part = residuals.part(known)
    medians = view.part(known).neighbour_median(part.value / part.sigma)
    far = np.abs(medians) * part.sigma * part.unit_m > thresholds().points.reference_error
    return float(np.mean(far & (np.abs(medians) > thresholds().changes.faint_sigmas)))


def _components(z: FloatArray, faint: FloatArray, view: SensorView, eligible: BoolArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Number of the change that contains each point (n,), -1 for none, and the sigmas (n,) that its neighbours confirm.

    z: (n,) standardised residuals. faint: (n,) standardised medians of neighbours.
    """
    exceeds = np.abs(faint) > thresholds().changes.faint_sigmas
    side = np.where(exceeds, np.sign(faint), np.sign(z)) * (exceeds | (np.abs(z) > _LEVELS[0]))
    pairs, size = view.neighbour_pairs(np.flatnonzero(side)), np.abs(z)
    pairs = pairs[:, side[pairs[0]] * side[pairs[1]] > 0]
    least = max(thresholds().points.registration_outlier_sigmas, _correlated_sigmas(z, view, eligible))
    core = _faint_cores(faint, exceeds, pairs, eligible)

    def search(which: tuple[float, float, float]) -> BoolArray:
        sign, level, ratio = which
        return _significant(sign * z, level, ratio, pairs, eligible, least)

    core = np.any([core, *map_in_threads(search, product((1.0, -1.0), _LEVELS, _RATIOS))], axis=0)
    whole = _extended(core, size, pairs, eligible)
    label = _compact(_connected(whole, pairs), int(eligible.sum()))
    inside = pairs[:, whole[pairs].all(axis=0)]
    most = np.zeros(len(z))
    for one, other in (inside, inside[::-1]):
        np.maximum.at(most, one, size[other])
    return label, _agreement_limit(most, _RATIOS[0])


def _faint_cores(faint: FloatArray, exceeds: BoolArray, pairs: Pairs, eligible: BoolArray) -> BoolArray:
    """(n,) points of components of medians, one of which exceeds what noise reaches in a whole measurement."""
    label = _connected(exceeds, pairs)
    inside = label >= 0
    highest = np.zeros(int(label.max(initial=-1)) + 1)
    np.maximum.at(highest, label[inside], np.where(eligible, np.abs(faint), 0.0)[inside])
    return np.isin(label, np.flatnonzero(highest > -ndtri(thresholds().verdict.rejection_p / (2 * eligible.sum())))) & inside


def _agreeing(pairs: Pairs, size: FloatArray, ratio: float) -> Pairs:
    """The pairs whose standardised residuals (n,) agree."""
    sizes = size[pairs]
    return pairs[:, sizes.max(axis=0) <= _agreement_limit(sizes.min(axis=0), ratio)]


def _agreement_limit(size: FloatArray, ratio: float) -> FloatArray:
    """Largest standardised residuals that still agree with others."""
    return np.asarray(np.maximum(ratio * size, size + _NOISE))


def _significant(z: FloatArray, level: float, ratio: float, pairs: Pairs, eligible: BoolArray, least: float) -> BoolArray:
    """(n,) points of components above a level that are too large to be due to chance.

    The share p of points that exceed the level by chance excludes the changes, so both are found together, by iteration. `least`:
    smallest median of a component, in sigmas.
    """
    label = _connected(eligible & (z > level), _agreeing(pairs, np.abs(z), ratio))
    inside = label >= 0
    count = np.bincount(label[inside])
    middle = group_medians(z[inside], label[inside], len(count), 1)
    accepted = np.zeros(len(count), dtype=bool)
    for _ in range(len(count)):
        stray = np.sort(z[inside][~accepted[label[inside]]])
        by_chance = _log_expected(count, int(eligible.sum()), len(stray), _agreeing_share(stray, ratio))
        rare = by_chance < np.log(thresholds().verdict.rejection_p / _SEARCHES)
        again = (count >= thresholds().changes.fewest) & (middle > least) & rare
        if np.array_equal(again, accepted):
            break
        accepted = again
    return np.isin(label, np.flatnonzero(accepted)) & inside


def _log_expected(count: NDArray[np.int64], points: int, stray: int, agreeing: float) -> FloatArray:
    """Return log E(m), the logarithm of the number of components of m points expected by chance, for sizes m (k,).

    points: number of points searched. stray: how many of them exceed the level by chance. agreeing: share of pairs of values
    that agree.
    """
    shapes = _SHAPES[np.minimum(count, len(_SHAPES)) - 1] + _GROWTH * np.maximum(count - len(_SHAPES), 0)
    share = np.log(max(stray, 1) / points)
    return np.asarray(np.log(points) + shapes + count * share + (count - 1) * np.log(agreeing))


def _agreeing_share(ordered: FloatArray, ratio: float) -> float:
    """Share of pairs of values, sorted in ascending order, that agree."""
    if len(ordered) < 2:
        return 1.0
    above = np.searchsorted(ordered, _agreement_limit(ordered, ratio), side="right") - np.arange(len(ordered)) - 1
    return float(max(2 * above.sum(), 1) / (len(ordered) * (len(ordered) - 1)))


def _correlated_sigmas(z: FloatArray, view: SensorView, eligible: BoolArray) -> float:
    """Median of a component, in sigmas, that noise hardly reaches.

    It is small for white noise, and as large as that of single points for correlated noise. It follows from the scatter of means
    over a point and its neighbours.
    """
    known = np.flatnonzero(eligible)
    first, second = view.neighbour_pairs(known[:: max(len(known) // _SAMPLE, 1)])
    clipped = np.clip(z, -_ALMOST_ALL, _ALMOST_ALL)
    counts = np.bincount(first, minlength=len(z))
    total = clipped + np.bincount(first, clipped[second], len(z))
    chosen = counts >= NEIGHBOURS // 2
    if not chosen.any():
        return 0.0
    return nmad(total[chosen] / (counts[chosen] + 1)) * float(-ndtri(thresholds().verdict.rejection_p / (2 * len(known))))


def _extended(core: BoolArray, size: FloatArray, pairs: Pairs, eligible: BoolArray) -> BoolArray:
    """(n,) the cores, extended to adjoining points at edges of the reference and to the fringe where the residuals decline."""
    whole, agreeing = core.copy(), _agreeing(pairs, size, _RATIOS[0])
    for _ in range(_EDGE_STEPS):
        for one, other in (agreeing, agreeing[::-1]):
            reached = other[whole[one]]
            whole[reached[~eligible[reached]]] = True
    fringe = [other[whole[one] & (size[other] < size[one])] for one, other in (pairs, pairs[::-1])]
    whole[np.concatenate(fringe)] = True
    return whole


def _connected(chosen: BoolArray, pairs: Pairs) -> NDArray[np.int64]:
    """(n,) number of the connected component that contains each chosen point; -1 for other points."""
    rows = np.flatnonzero(chosen)
    number = np.full(len(chosen), -1)
    number[rows] = np.arange(len(rows))
    one, other = number[pairs[:, chosen[pairs].all(axis=0)]]
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(len(rows), len(rows)))
    label = np.full(len(chosen), -1)
    if len(rows):
        label[rows] = connected_components(graph, directed=False)[1]
    return label


def _compact(label: NDArray[np.int64], points: int) -> NDArray[np.int64]:
    """Labels (n,) without regions that are a large part of the wall, and no compact change."""
    size = np.bincount(label[label >= 0])
    return np.where(np.isin(label, np.flatnonzero(size < thresholds().changes.moved_share * points)), label, -1)


def _measure_changes(label: NDArray[np.int64], departure: FloatArray, error: FloatArray, view: SensorView) -> list[SceneChange]:
    """Measure the changes; largest volume first.

    error: (2, n) independent and common standard deviation of each ray's residual, m.
    """
    rows = np.flatnonzero(label >= 0)
    solid = view.solid_angles(rows)
    near, far = view.reference_m[rows], view.range_at_residual(rows, departure[rows])
    volume = (far**3 - near**3) / 3 * solid
    area = near**2 * solid
    width = 0.5 * np.sqrt(area)
    own, common = error[:, rows] * area
    surfaces = [view.points_at(rows, each) for each in (near, far)]
    found = []
    for number in np.unique(label[rows]):
        part = np.flatnonzero(label[rows] == number)
        corners = np.concatenate([_box(surface[part], width[part]) for surface in surfaces])
        moved = float(np.median((far - near)[part]))
        epochs = view.epoch[rows[part]]
        whole = abs(_mean_of_epochs(volume[part], epochs))
        each = len(part) / len(np.unique(epochs))
        white = float(np.sqrt(np.sum(own[part] ** 2))) * each / len(part)
        rim, sides = whole * _RIM / np.sqrt(each), whole * _SIDES
        std = float(np.linalg.norm([white, common[part].sum() * each / len(part), rim, sides]))
        found.append(SceneChange(corners, whole, std, moved))
    return sorted(found, key=lambda change: -change.volume_m3)


def _box(points: FloatArray, width: FloatArray) -> FloatArray:
    """(2 k, 3) points (k, 3) moved by half a cell to either side along the wall, wall frame."""
    aside = width[:, None] * np.array([1.0, 1.0, 0.0])
    return np.concatenate([points - aside, points + aside])


def _mean_of_epochs(volume: FloatArray, epoch: NDArray[np.int64]) -> float:
    """Mean over epochs of summed volumes (by point); epochs with less than half as many points as another are left out."""
    _, number, counts = np.unique(epoch, return_inverse=True, return_counts=True)
    whole = counts >= 0.5 * counts.max()
    return float(np.bincount(number, volume)[whole].mean())
