"""Find tiles of a stereo matcher that are shifted against each other, by the differences of neighbours on both sides of a seam.

For a checkerboard of amplitude A, the difference of two neighbouring cells is +-2 A across a seam and 0 elsewhere, whatever the
pose and the smooth error of the reference are. Every side of a tile is tried. Tiles that are each shifted by a random amount make
differences across seams larger than elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import norm, rankdata

from pipeline.change.robust import nmad
from pipeline.gap.mean.detection_power import POWER, DetectableSize
from pipeline.gap.residuals.disparity_raster import cell_numbers, raster_cell_px
from pipeline.gap.residuals.residuals import BoolArray
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray
from sensors.effects.tile_shift import TileShift

_SMALLEST_CELLS, _LARGEST_SHARE = 4.0, 0.5
"""Smallest side of a tile, cells of the raster, and largest, share of the image's width."""
_SHARE_OF_CELL = 0.25
"""Share of a cell by which the last seam of neighbouring trials differs."""
_CLIP_SIGMAS = 4.0
"""Standard deviations at which differences are clipped, because of depth steps."""
_AT_ONCE, _REFINED = 512, 201
"""Sides that are tried together, and sides that are tried around the best one."""
_LEAST_PATTERN_SHARE = 0.5
"""Least share of the variance of the jumps that a checkerboard explains, if it is named."""
_LEAST_AXIS_SIGMAS = 2.5
"""Least standardised score of the seams of either axis, so that jumps along one axis alone are no tiles."""
_FEWEST_SEAMS, _SIDE_STRIDE = 3, 2
"""Fewest seams by which tiles with unequal shifts are told from a single edge on the wall; such tiles are tried with every second
side, which moves the last seam by half a cell."""


@dataclass(frozen=True)
class TileSeams:
    """Square image tiles that a stereo matcher processed separately and shifted, neighbours in opposite directions.

    Attributes
    ----------
    tile_px, amplitude_px : side of a tile, and size of its shift (the amplitude), px.
    tile_std_px, amplitude_std_px : standard deviations of the side and of the shift, px.
    gain : log-likelihood ratio of the disparity differences across seams: tiles against no tiles.
    p_value : Gaussian p-value of the mean difference, times the number of sides that were tried (Bonferroni).
    """

    tile_px: float
    amplitude_px: float
    tile_std_px: float
    amplitude_std_px: float
    gain: float
    p_value: float


@dataclass(frozen=True)
class _SeamDifferences:
    """Differences of neighbouring cells along one axis of a raster, clipped; 0 where one is missing.

    Attributes
    ----------
    along, beside : (c,) and (r,) coordinates of the cells along the axis and across it, px.
    value, known : (r, c - 1) differences, and where both cells hold a point.
    """

    along: FloatArray
    beside: FloatArray
    value: FloatArray
    known: BoolArray

    @classmethod
    def of(cls, along: FloatArray, beside: FloatArray, raster: FloatArray) -> _SeamDifferences:
        """Compute the differences of a raster (r, c), whose cells without a point are NaN, along its rows."""
        found = np.diff(raster, axis=1)
        known = ~np.isnan(found)
        most = _CLIP_SIGMAS * nmad(found[known]) if known.any() else 0.0
        return cls(along, beside, np.where(known, np.clip(found, -most, most), 0.0), known)

    @property
    def variance(self) -> float:
        """Variance of the differences."""
        return float(np.sum(self.value**2) / max(self.known.sum(), 1))

    @cached_property
    def _cumulative(self) -> list[FloatArray]:
        """Sums (r + 1, c - 1) of the differences of the first rows of cells, px, and the numbers of those that are known."""
        sums = (np.cumsum(each, axis=0, dtype=np.float64) for each in (self.value, self.known))
        return [np.pad(each, ((1, 0), (0, 0))) for each in sums]

    def jumps(self, side: float) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
        """Sums of the differences over each row of tiles (t, c - 1), their numbers, and the numbers of the seams.

        side: side of a tile, px.
        """
        edges = np.flatnonzero(np.diff(np.floor(self.beside / side))) + 1
        rows = np.concatenate([[0], edges, [len(self.beside)]])
        sums, counts = (np.diff(each[rows], axis=0) for each in self._cumulative)
        return sums, counts, np.flatnonzero(np.diff(np.floor(self.along / side)))

    def seam_scores(self, side: float) -> FloatArray:
        """Normal score of each seam: from the rank of its mean squared jump among those of all neighbouring columns."""
        sums, counts, seams = self.jumps(side)
        square = np.divide(sums**2, counts, out=np.zeros_like(sums), where=counts > 0).sum(axis=0)
        rows = (counts > 0).sum(axis=0)
        known = rows > 0
        rank = np.zeros(len(rows))
        rank[known] = rankdata(square[known] / rows[known])
        return ndtri((rank[seams][known[seams]] - 0.5) / known.sum())

    def squared_jumps(self, side: float) -> FloatArray:
        """Squares of the jumps at the seams, px², each minus what noise contributes to it."""
        sums, counts, seams = self.jumps(side)
        at_seam = np.zeros(sums.shape[1], dtype=bool)
        at_seam[seams] = True
        known, many = counts > 0, np.maximum(counts, 1)
        noise = float(np.mean((sums**2 / many)[known & ~at_seam]))
        return np.asarray(((sums**2 / many - noise) / many)[known & at_seam])


@dataclass(frozen=True)
class _SeamTest:
    """Input of the test for shifted tiles.

    Attributes
    ----------
    axes : differences of neighbouring cells of a raster, along its rows and along its columns.
    sides : (k,) sides of a tile to try, px.
    """

    axes: tuple[_SeamDifferences, _SeamDifferences]
    sides: FloatArray

    @classmethod
    def of(cls, residuals: StereoResiduals, registered_residuals: FloatArray) -> _SeamTest | None:
        """Prepare the test; None if the points lie on no raster, or on one that is too small for tiles."""
        at = residuals.geometry
        step = raster_cell_px(at.u, at.v)
        if step is None:
            return None
        column, row = cell_numbers(at.u, step), cell_numbers(at.v, step)
        u, v = (x.min() + step * np.arange(number.max() + 1) for x, number in ((at.u, column), (at.v, row)))
        raster = np.full((len(v), len(u)), np.nan)
        raster[row, column] = registered_residuals
        axes = _SeamDifferences.of(u, v, raster), _SeamDifferences.of(v, u, raster.T)
        sides = _sides(float(max(u[-1], v[-1])), step)
        return cls(axes, sides) if len(sides) and all(each.variance for each in axes) else None

    def trials(self, sides: FloatArray) -> FloatArray:
        """(2, k) weighted sum of the signed differences across seams, and information on the amplitude, for sides (k,), px."""
        signs = [1.0 - 2.0 * (np.floor(each.along[None] / sides[:, None]) % 2) for each in self.axes]
        total, information = np.zeros(len(sides)), np.zeros(len(sides))
        for axis, along, beside in zip(self.axes, signs, reversed(signs), strict=True):
            jump = np.diff(along, axis=1)
            total += np.sum((beside @ axis.value) * jump, axis=1) / axis.variance
            information += jump**2 @ axis.known.sum(axis=0) / axis.variance
        return np.stack([total, information])


def find_tile_seams(residuals: StereoResiduals, registered_residuals: FloatArray) -> TileSeams | None:
    """Find image tiles that a stereo matcher processed separately and shifted against each other, like a checkerboard.

    The test compares the disparities of neighbouring points on both sides of possible seams. Tiles with unequal shifts agree with
    some checkerboard by chance, which explains a small share of the jumps at their seams.

    Parameters
    ----------
    residuals : disparity residuals of n points with their pixels, px.
    registered_residuals : (n,) these residuals after a robust pose fit, px.

    Returns
    -------
    TileSeams or None : the tiles; None if none are significant, if their shifts are unequal, or if the points lie on no pixel
        raster.
    """
    test = _SeamTest.of(residuals, registered_residuals)
    if test is None:
        return None
    sides = test.sides
    parts = np.array_split(sides, -(-len(sides) // _AT_ONCE))
    coarse, first = _most_significant(np.concatenate([test.trials(part) for part in parts], axis=1))
    p_value = min(2 * len(sides) * float(norm.sf(abs(coarse[first]))), 1.0)
    if p_value > thresholds().locking.significance:
        return None
    reach = 2 * float(sides[1] / sides[0] - 1)
    finer = sides[first] * np.linspace(1 - reach, 1 + reach, _REFINED)
    trials = test.trials(finer)
    sigmas, best = _most_significant(trials)
    near = finer[np.abs(sigmas) > abs(sigmas[best]) - 1]
    total, information = map(float, trials[:, best])
    amplitude, unequal = total / information, find_unequal_tiles(residuals, registered_residuals)
    if unequal is not None and (2 * amplitude) ** 2 < _LEAST_PATTERN_SHARE * unequal.jump_px**2:
        return None
    return TileSeams(
        tile_px=float(near.mean()),
        amplitude_px=amplitude,
        tile_std_px=float(np.ptp(near) + finer[1] - finer[0]) / np.sqrt(12),
        amplitude_std_px=float(1 / np.sqrt(information)),
        gain=0.5 * float(sigmas[best]) ** 2,
        p_value=p_value,
    )


@dataclass(frozen=True)
class UnequalTiles:
    """Square image tiles whose disparities jump at their seams by amounts that follow no pattern.

    The catalogue has no effect for them.

    Attributes
    ----------
    tile_px : side of a tile, px.
    jump_px : standard deviation of the jumps, px.
    p_value : p-value of the jumps, times the number of sides that were tried (Bonferroni).
    """

    tile_px: float
    jump_px: float
    p_value: float

    @property
    def note(self) -> str:
        """Description of the tiles as a sentence for the report."""
        return (
            f"the disparities jump by {self.jump_px:.2g} px (standard deviation) every {self.tile_px:.3g} px along rows and "
            f"columns (p = {self.p_value:.2g}), as if a matcher shifted each tile of the image by another amount"
        )


def find_unequal_tiles(residuals: StereoResiduals, value: FloatArray) -> UnequalTiles | None:
    """Find image tiles that a stereo matcher shifted by unequal amounts, against each other.

    Between two neighbouring columns of the raster, each row of tiles has a mean difference, its jump. The mean of the squared
    jumps, times the numbers of their differences, ranks high among all columns where tiles have a seam. The normal scores of
    the ranks (van der Waerden) are summed over the seams, so that a single edge on the wall counts little. Rows must rank high
    too, because locked or rounded disparities jump along one axis only.

    Parameters
    ----------
    residuals : disparity residuals of n points with their pixels, px.
    value : (n,) residuals after the systematic effects are removed, px.

    Returns
    -------
    UnequalTiles or None : the tiles; None if none are significant (`locking.significance`), or if the points lie on no raster.
    """
    test = _SeamTest.of(residuals, value)
    if test is None:
        return None
    sides = test.sides[::_SIDE_STRIDE]
    scores = np.array([_seam_score(test.axes, side) for side in sides])
    side, p_value = float(sides[np.argmax(scores)]), float(len(scores) * norm.sf(scores.max()))
    if p_value > thresholds().locking.significance:
        return None
    jumps = np.concatenate([each.squared_jumps(side) for each in test.axes])
    return UnequalTiles(side, float(np.sqrt(max(float(jumps.mean()), 0.0))), p_value)


def detectable_tile_shift(residuals: StereoResiduals, registered_residuals: FloatArray) -> DetectableSize:
    """Compute how far tiles would have to be shifted to be found in a measurement with a probability of 95 %.

    It holds for a side in the middle of those that are tried; smaller tiles have more seams and show sooner.

    Parameters
    ----------
    residuals : disparity residuals of n points with their pixels, px.
    registered_residuals : (n,) these residuals after a robust pose fit, px, in which no tiles were found.

    Returns
    -------
    DetectableSize : the amplitude, px; NaN with a note if the points lie on no pixel raster.
    """
    name, test = TileShift.tag(), _SeamTest.of(residuals, registered_residuals)
    if test is None:
        return DetectableSize(
            name, "", np.nan, note="the points lie on no raster of pixels, so seams between tiles cannot be seen"
        )
    side = test.sides[len(test.sides) // 2]
    needed = float(norm.isf(thresholds().locking.significance / (2 * len(test.sides)))) + float(norm.ppf(POWER))
    _, (information,) = test.trials(np.array([side]))
    size = needed / float(np.sqrt(information))
    return DetectableSize(name, "amplitude_px", size, {"tile_px": float(side)})


def _most_significant(trials: FloatArray) -> tuple[FloatArray, int]:
    """(k,) amplitudes of trials (2, k) over their standard deviations, and the index of the largest in magnitude."""
    total, information = trials
    sigmas = np.divide(total, np.sqrt(information), out=np.zeros_like(total), where=information > 0)
    return sigmas, int(np.argmax(np.abs(sigmas)))


def _seam_score(axes: tuple[_SeamDifferences, _SeamDifferences], side: float) -> float:
    """How far the jumps at the seams of tiles of one side rank above those at other lines of cells, in standard deviations.

    It is the sum of the seams' normal scores (normal quantiles of their ranks) over the root of their number; 0 if there are too
    few seams, or if those along one axis do not rank high by themselves. side: side of a tile, px.
    """
    of_axes = [each.seam_scores(side) for each in axes]
    scores = np.concatenate(of_axes)
    enough = len(scores) >= _FEWEST_SEAMS and all(each.sum() > _LEAST_AXIS_SIGMAS * np.sqrt(len(each)) for each in of_axes)
    return float(scores.sum() / np.sqrt(len(scores))) if enough else 0.0


def _sides(last: float, step: float) -> FloatArray:
    """Sides of a tile to try, px. The last seam, at about `last`, moves by a part of a cell from one to the next."""
    smallest, largest = _SMALLEST_CELLS * step, _LARGEST_SHARE * last
    if largest <= smallest:
        return np.empty(0)
    # side n has its last seam k n near `last`, and moves it by k dn = last / n dn
    count = int(np.ceil(np.log(largest / smallest) * last / (_SHARE_OF_CELL * step)))
    return np.geomspace(smallest, largest, count)
