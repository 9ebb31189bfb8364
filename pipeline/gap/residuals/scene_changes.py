"""Compact regions where the surface itself moved: connected points that depart together, set aside, reported.

Points that depart by more than some sigmas, to one side, and are neighbours as the sensor sees them, make up a component. By
chance, of N points of which a share p departs so far and a share c of pairs agrees in value, about

    E(m) = N a(m) p^m c^(m - 1)

components of m points come about, a(m) being the number of shapes of m cells that touch by sides or corners (fixed polyplets,
OEIS A006770). A component of which much less than one is to be expected, with all levels and both sides looked at, is a change.
It takes in what hangs together with it where the reference has an edge, and the fringe where the departure fades.

Volume of a component, the prism of each ray between both surfaces, with the solid angle dO that its point stands for:

    V = |sum (R^3 - R0^3) / 3 dO|,  to first order |sum R0^2 dR sin z daz dz|

with no departure more than the neighbours' bear out, so that an outlier in it does not count. Its standard deviation has four
parts: the noise of each ray; what the surroundings are off in common, from how much more medians of neighbours spread than white
noise makes them; the rim, of which each straight side, of sqrt(m) points, is in it or not: sqrt(4 / 12) / sqrt(m) of the volume
and, as on simulated blocks, a fifth more; and what is seen of its sides from aside.
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
from pipeline.gap.decisions import decided
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.sensor_view import NEIGHBOURS, SensorView
from pipeline.gap.residuals.standardized import group_medians, nmad_along_covariates, standardize
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray

Pairs = tuple[NDArray[np.int64], NDArray[np.int64]]

_LEVELS = (2.5, 4.0, 8.0)
"""Sigmas from which on points belong together."""
_RATIOS, _NOISE = (2.0, np.inf), 3.0
"""Two neighbours agree where one departs no more than so many times as much as the other, or so many sigmas more. Fewer agree by
chance where it is narrow; a block of five points whose depth varies is found where it is wide, if there are few outliers."""
_LOOKS = 2 * len(_LEVELS) * len(_RATIOS)
"""Either side, by each level and ratio."""
_SHAPES = np.cumsum(np.log([1, 4, 5, 5.5, 5.8, 6.006, 6.157, 6.271, 6.361, 6.433]))
"""Logarithms of a(1) to a(10) by their ratios; from there on a(m + 1) = 6.6 a(m)."""
_GROWTH = float(np.log(6.6))
_EDGE_STEPS = 3
"""Points at edges of the reference that a change may go on over."""
_LEAST_AROUND = 0.4
"""Standard deviation of medians of nine points at the least, of sigmas: 1.25 / 3 by white noise."""
_BY_WHITE = 0.418
"""Standard deviation of medians of nine standard normal values."""
_RIM, _SIDES = 0.7, 0.03
"""Shares of a volume: times one over the root of its points, and whatever they are (see above)."""
_ROUNDS = 3
_SAMPLE, _ALMOST_ALL = 4000, 5.0


@dataclass(frozen=True)
class SceneChange:
    """A region that moved. corners: (k, 3) outline of the rock that went or came, before and after, wall frame, m; volume_m3 of
    it, known to volume_std_m3; offset_m: median along the ray, positive where rock is missing."""

    corners: FloatArray
    volume_m3: float
    volume_std_m3: float
    offset_m: float

    @property
    def bounds(self) -> FloatArray:
        """(2, 3) lowest and highest, wall frame, m."""
        return np.stack([self.corners.min(axis=0), self.corners.max(axis=0)])

    def to_dict(self, frame: WallFrame) -> dict[str, Any]:
        """As gap.json holds it: the box that holds the region in the world frame."""
        world = frame.to_world(self.corners)
        return {"bbox_m": [*world.min(axis=0).tolist(), *world.max(axis=0).tolist()], "volume_m3": self.volume_m3,
                "volume_std_m3": self.volume_std_m3}  # fmt: skip


def find_scene_changes(residuals: Residuals, sight: SensorView, eligible: BoolArray) -> tuple[list[SceneChange], BoolArray]:
    """Regions that moved, and (n,) the points in or beside them.

    residuals: registered roughly; eligible: (n,) points away from depth edges, which alone bear witness. What is around a change,
    and how much residuals spread, is learned again without the changes found, until there are no more.
    """
    beside = np.zeros(len(residuals), dtype=bool)
    departure, error = np.zeros(len(residuals)), np.zeros((2, len(residuals)))
    label = np.full(len(residuals), -1)
    if eligible.sum() < NEIGHBOURS:
        return [], beside
    for _ in range(_ROUNDS):
        before = beside
        quiet = eligible & ~beside
        departure, z = standardize(residuals, sight.scaled_coordinates, quiet)
        around = sight.neighbour_median(np.where(eligible, z, 0.0))
        scatter = nmad_along_covariates(residuals, around, quiet)
        shared = np.sqrt(np.maximum(scatter**2 - _BY_WHITE**2, 0.0))
        error = np.stack([np.abs(departure / np.where(z == 0, np.inf, z)), shared * residuals.sigma]) * residuals.unit_m
        faint = around / np.maximum(scatter, _LEAST_AROUND)
        faint[np.abs(around) * residuals.sigma * residuals.unit_m < decided().changes.smallest] = 0.0
        label, limit = _components(z, faint, sight, eligible)
        members = np.flatnonzero(label >= 0)
        beside = sight.near(members, decided().changes.margin) if len(members) else np.zeros(len(residuals), dtype=bool)
        if not (beside & ~before).any():
            break
    limited = departure * np.minimum(1.0, limit / np.maximum(np.abs(z), 1e-12))
    return _measured(label, limited, error, sight), beside


def drop_duplicates(changes: list[SceneChange]) -> list[SceneChange]:
    """Without those that another scan saw too: whose middle lies in a larger one's box."""
    kept: list[SceneChange] = []
    for change in changes:
        middle = change.bounds.mean(axis=0)
        if not any((each.bounds[0] < middle).all() and (middle < each.bounds[1]).all() for each in kept):
            kept.append(change)
    return kept


def moved_share(residuals: Residuals, sight: SensorView, eligible: BoolArray) -> float:
    """Share of the eligible points (n,) that lie off the reference together with their neighbours, wherever and however far.

    residuals: registered. White noise moves a median of nine by 0.4 sigma; a wrong pose, where much moved, counts too.
    """
    known = np.flatnonzero(eligible & np.isfinite(residuals.value))
    if len(known) < NEIGHBOURS:
        return 0.0
    part = residuals.part(known)
    around = sight.part(known).neighbour_median(part.value / part.sigma)
    far = np.abs(around) * part.sigma * part.unit_m > decided().changes.smallest
    return float(np.mean(far & (np.abs(around) > decided().changes.moved_sigmas)))


def _components(z: FloatArray, faint: FloatArray, sight: SensorView, eligible: BoolArray) -> tuple[NDArray[np.int64], FloatArray]:
    """(n,) number of the change in which each point lies, -1 in none, and (n,) sigmas by which its neighbours bear it out.

    z: (n,) departures in sigmas; faint: (n,) the same of medians of neighbours.
    """
    spread_out = np.abs(faint) > decided().changes.faint
    side = np.where(spread_out, np.sign(faint), np.sign(z)) * (spread_out | (np.abs(z) > _LEVELS[0]))
    first, second = sight.neighbour_pairs(np.flatnonzero(side))
    together = side[first] * side[second] > 0
    pairs, size = (first[together], second[together]), np.abs(z)
    least = max(decided().changes.middle_sigmas, _correlated_sigmas(z, sight, eligible))
    core = _faint(faint, spread_out, pairs, eligible)
    for sign, level, ratio in product((1.0, -1.0), _LEVELS, _RATIOS):
        core |= _significant(sign * z, level, ratio, pairs, eligible, least)
    whole = _grown(core, size, pairs, eligible)
    label = _compact(_connected(whole, pairs), sight, int(eligible.sum()))
    inside = _kept(pairs, whole[pairs[0]] & whole[pairs[1]])
    most = np.zeros(len(z))
    for one, other in (inside, inside[::-1]):
        np.maximum.at(most, one, size[other])
    return label, _most(most, _RATIOS[0])


def _faint(faint: FloatArray, spread_out: BoolArray, pairs: Pairs, eligible: BoolArray) -> BoolArray:
    """(n,) points of components of medians one of which no measurement shows by chance."""
    label = _connected(spread_out, pairs)
    inside = label >= 0
    highest = np.zeros(int(label.max(initial=-1)) + 1)
    np.maximum.at(highest, label[inside], np.where(eligible, np.abs(faint), 0.0)[inside])
    return np.isin(label, np.flatnonzero(highest > -ndtri(decided().changes.by_chance / (2 * eligible.sum())))) & inside


def _agreeing(pairs: Pairs, size: FloatArray, ratio: float) -> Pairs:
    """The pairs whose departures (n,) agree, in sigmas."""
    one, other = size[pairs[0]], size[pairs[1]]
    return _kept(pairs, np.maximum(one, other) <= _most(np.minimum(one, other), ratio))


def _most(size: FloatArray, ratio: float) -> FloatArray:
    """Largest departures that agree with others, in sigmas."""
    return np.asarray(np.maximum(ratio * size, size + _NOISE))


def _significant(z: FloatArray, level: float, ratio: float, pairs: Pairs, eligible: BoolArray, least: float) -> BoolArray:
    """(n,) points of components above a level of which too many to be chance hang together.

    The share p that departs by chance is what is left without the components that were found, so it is found with them. least:
    sigmas of a component's median.
    """
    label = _connected(eligible & (z > level), _agreeing(pairs, np.abs(z), ratio))
    inside = label >= 0
    count = np.bincount(label[inside])
    middle = group_medians(z[inside], label[inside], len(count), 1)
    accepted = np.zeros(len(count), dtype=bool)
    for _ in range(len(count)):
        stray = np.sort(z[inside][~accepted[label[inside]]])
        by_chance = _log_expected(count, int(eligible.sum()), len(stray), _agreeing_share(stray, ratio))
        rare = by_chance < np.log(decided().changes.by_chance / _LOOKS)
        again = (count >= decided().changes.fewest) & (middle > least) & rare
        if np.array_equal(again, accepted):
            break
        accepted = again
    return np.isin(label, np.flatnonzero(accepted)) & inside


def _log_expected(count: NDArray[np.int64], points: int, stray: int, agreeing: float) -> FloatArray:
    """log E(m) of components of m = `count` points (see above), `stray` of `points` departing by chance."""
    shapes = np.where(
        count <= len(_SHAPES),
        _SHAPES[np.minimum(count, len(_SHAPES)) - 1],
        _SHAPES[-1] + _GROWTH * (count - len(_SHAPES)),
    )
    share = np.log(max(stray, 1) / points)
    return np.asarray(np.log(points) + shapes + count * share + (count - 1) * np.log(agreeing))


def _agreeing_share(ordered: FloatArray, ratio: float) -> float:
    """Share of pairs of values, in rising order, that agree."""
    if len(ordered) < 2:
        return 1.0
    above = np.searchsorted(ordered, _most(ordered, ratio), side="right") - np.arange(len(ordered)) - 1
    return float(max(2 * above.sum(), 1) / (len(ordered) * (len(ordered) - 1)))


def _correlated_sigmas(z: FloatArray, sight: SensorView, eligible: BoolArray) -> float:
    """Departure of a component, in sigmas, that noise hardly makes: little where it is white, as much as of single points where
    neighbours share it. From how much means over a point and its neighbours spread."""
    known = np.flatnonzero(eligible)
    first, second = sight.neighbour_pairs(known[:: max(len(known) // _SAMPLE, 1)])
    clipped = np.clip(z, -_ALMOST_ALL, _ALMOST_ALL)
    counts = np.bincount(first, minlength=len(z))
    total = clipped + np.bincount(first, clipped[second], len(z))
    chosen = counts >= NEIGHBOURS // 2
    if not chosen.any():
        return 0.0
    return nmad(total[chosen] / (counts[chosen] + 1)) * float(-ndtri(decided().changes.by_chance / (2 * len(known))))


def _grown(core: BoolArray, size: FloatArray, pairs: Pairs, eligible: BoolArray) -> BoolArray:
    """(n,) the cores with what hangs together with them at edges of the reference, and the fringe where the departure fades."""
    whole, agreeing = core.copy(), _agreeing(pairs, size, _RATIOS[0])
    for _ in range(_EDGE_STEPS):
        for one, other in (agreeing, agreeing[::-1]):
            reached = other[whole[one]]
            whole[reached[~eligible[reached]]] = True
    fringe = [other[whole[one] & (size[other] < size[one])] for one, other in (pairs, pairs[::-1])]
    whole[np.concatenate(fringe)] = True
    return whole


def _connected(chosen: BoolArray, pairs: Pairs) -> NDArray[np.int64]:
    """(n,) number of the component of the chosen points in which each lies, -1 elsewhere."""
    rows = np.flatnonzero(chosen)
    number = np.full(len(chosen), -1)
    number[rows] = np.arange(len(rows))
    one, other = (number[each] for each in _kept(pairs, chosen[pairs[0]] & chosen[pairs[1]]))
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(len(rows), len(rows)))
    label = np.full(len(chosen), -1)
    if len(rows):
        label[rows] = connected_components(graph, directed=False)[1]
    return label


def _kept(pairs: Pairs, which: BoolArray) -> Pairs:
    return pairs[0][which], pairs[1][which]


def _compact(label: NDArray[np.int64], sight: SensorView, points: int) -> NDArray[np.int64]:
    """Labels (n,) without those of regions that are no compact change: a large part of the wall, or a stripe."""
    rows = np.flatnonzero(label >= 0)
    if not len(rows):
        return label
    order = rows[np.argsort(label[rows], kind="stable")]
    starts = np.flatnonzero(np.diff(label[order], prepend=-1))
    place = sight.scaled_coordinates[order]
    length = (np.maximum.reduceat(place, starts) - np.minimum.reduceat(place, starts)).max(axis=1)
    size = np.diff(np.append(starts, len(order))) / len(np.unique(sight.epoch))
    stripe = (length >= decided().changes.stripe) & (size <= 0.1 * length**2)
    compact = (size * len(np.unique(sight.epoch)) < decided().changes.largest_share * points) & ~stripe
    return np.where(np.isin(label, label[order][starts][compact]), label, -1)


def _measured(label: NDArray[np.int64], departure: FloatArray, error: FloatArray, sight: SensorView) -> list[SceneChange]:
    """The changes by their volume, the largest first. error: (2, n) of each ray's departure, and of all in common, m."""
    rows = np.flatnonzero(label >= 0)
    if not len(rows):
        return []
    solid = sight.solid_angles(rows)
    near, far = sight.reference_m[rows], sight.range_at_residual(rows, departure[rows])
    volume = (far**3 - near**3) / 3 * solid
    area = near**2 * solid
    width = 0.5 * np.sqrt(area)
    own, common = error[:, rows] * area
    surfaces = [sight.points_at(rows, each) for each in (near, far)]
    order = np.argsort(label[rows], kind="stable")
    found = []
    for part in np.split(order, np.flatnonzero(np.diff(label[rows][order])) + 1):
        corners = np.concatenate([_box(surface[part], width[part]) for surface in surfaces])
        moved = float(np.median((far - near)[part]))
        epochs = sight.epoch[rows[part]]
        whole = abs(_mean_of_epochs(volume[part], epochs))
        each = len(part) / len(np.unique(epochs))
        white = float(np.sqrt(np.sum(own[part] ** 2))) * each / len(part)
        rim, sides = whole * _RIM / np.sqrt(each), whole * _SIDES
        std = float(np.linalg.norm([white, common[part].sum() * each / len(part), rim, sides]))
        found.append(SceneChange(corners, whole, std, moved))
    return sorted(found, key=lambda change: -change.volume_m3)


def _box(points: FloatArray, width: FloatArray) -> FloatArray:
    """(2 k, 3) the points moved by half a cell to either side in the wall, x and y of the wall frame."""
    aside = width[:, None] * np.array([1.0, 1.0, 0.0])
    return np.concatenate([points - aside, points + aside])


def _mean_of_epochs(volume: FloatArray, epoch: NDArray[np.int64]) -> float:
    """Of volumes by point: the mean of the epochs' sums, without epochs that hold less than half as many points as another."""
    _, number, counts = np.unique(epoch, return_inverse=True, return_counts=True)
    whole = counts >= 0.5 * counts.max()
    return float(np.bincount(number, volume)[whole].mean())
