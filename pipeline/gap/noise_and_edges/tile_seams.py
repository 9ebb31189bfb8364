"""Find tiles of a stereo matcher that are shifted against each other, by the differences of neighbours on both sides of a seam.

For a checkerboard of amplitude A, the difference of two neighbouring cells is +-2 A across a seam and 0 elsewhere, whatever the
pose and the smooth error of the reference are. Every side of a tile is tried. Tiles that are each shifted by a random amount make
differences across seams larger than elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import norm, rankdata

from pipeline.change.robust import nmad
from pipeline.gap.mean.detection_power import POWER, DetectableSize
from pipeline.gap.residuals.disparity_raster import raster_cell_px
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
    """Square image tiles that were found in disparities: a stereo matcher processed them separately and shifted them.

    Neighbouring tiles are shifted in opposite directions, so their disparities differ by twice the amplitude.

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
    """Differences of neighbouring cells along one axis, 0 where one is missing.

    Attributes
    ----------
    value, known : (rows, columns) clipped differences, and where both cells hold a point.
    """

    value: FloatArray
    known: BoolArray

    @classmethod
    def of(cls, raster: FloatArray, axis: int) -> _SeamDifferences:
        """Compute them from a raster (rows, columns), NaN where there is no point."""
        found = np.diff(raster, axis=axis)
        known = ~np.isnan(found)
        most = _CLIP_SIGMAS * nmad(found[known]) if known.any() else 0.0
        return cls(np.where(known, np.clip(found, -most, most), 0.0), known)

    @property
    def variance(self) -> float:
        """Variance of the differences."""
        return float(np.sum(self.value**2) / max(self.known.sum(), 1))


@dataclass(frozen=True)
class _SeamTest:
    """Input of the test for shifted tiles: differences of neighbouring cells of a raster, and the sides of a tile to try.

    Attributes
    ----------
    u, v : (columns,) and (rows,) coordinates of the raster's columns and rows, px.
    across, down : differences along rows and along columns.
    sides : (k,) sides of a tile, px.
    """

    u: FloatArray
    v: FloatArray
    across: _SeamDifferences
    down: _SeamDifferences
    sides: FloatArray

    @classmethod
    def of(cls, residuals: StereoResiduals, registered_residuals: FloatArray) -> _SeamTest | None:
        """Prepare the test; None if the points lie on no raster, or on one that is too small for tiles."""
        at = residuals.geometry
        step = raster_cell_px(at.u, at.v)
        if step is None:
            return None
        (u, column), (v, row) = (_axis(x, step) for x in (at.u, at.v))
        raster = np.full((len(v), len(u)), np.nan)
        raster[row, column] = registered_residuals
        found = cls(u, v, _SeamDifferences.of(raster, 1), _SeamDifferences.of(raster, 0), _sides(u, v, step))
        return found if len(found.sides) and found.across.variance and found.down.variance else None

    def trials(self, sides: FloatArray) -> _TileTrials:
        """Evaluate sides of a tile (k,), px."""
        return _TileTrials.of(sides, self.u, self.v, self.across, self.down)


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
    trials = [test.trials(part) for part in np.array_split(sides, -(-len(sides) // _AT_ONCE))]
    coarse = max(trials, key=lambda each: abs(each.sigmas[each.best]))
    p_value = min(2 * len(sides) * float(norm.sf(abs(coarse.sigmas[coarse.best]))), 1.0)
    if p_value > thresholds().locking.significance:
        return None
    reach = 2 * float(sides[1] / sides[0] - 1)
    found = test.trials(coarse.sides[coarse.best] * np.linspace(1 - reach, 1 + reach, _REFINED))
    sigmas, information = float(found.sigmas[found.best]), float(found.information[found.best])
    near = found.sides[np.abs(found.sigmas) > abs(sigmas) - 1]
    amplitude, unequal = float(found.total[found.best]) / information, find_unequal_tiles(residuals, registered_residuals)
    if unequal is not None and (2 * amplitude) ** 2 < _LEAST_PATTERN_SHARE * unequal.jump_px**2:
        return None
    return TileSeams(
        float(near.mean()),
        amplitude,
        float(np.ptp(near) + np.diff(found.sides)[0]) / np.sqrt(12),
        float(1 / np.sqrt(information)),
        0.5 * sigmas**2,
        p_value,
    )


@dataclass(frozen=True)
class UnequalTiles:
    """Square image tiles whose disparities jump at their seams by amounts that follow no pattern.

    The catalogue has no effect for them: a matcher that processes tiles separately may shift each by another amount.

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

    Between each two neighbouring columns of the raster, each row of tiles has a mean difference, its jump. The square of each
    jump, times the number of its differences, is averaged; without tiles it has the same expectation in every column. If tiles
    are shifted, the columns at their seams rank high among all columns, and so do rows. The normal scores of the ranks (van der
    Waerden) are summed over the seams. A single edge on the wall therefore counts little. Both axes must have seams that rank
    high, because locked or rounded disparities jump along one axis only.

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
    axes = (
        _AxisJumps.of(test.u, test.v, test.across.value, test.across.known),
        _AxisJumps.of(test.v, test.u, test.down.value.T, test.down.known.T),
    )
    sides = test.sides[::_SIDE_STRIDE]
    scores = np.array([_seam_score(axes, side) for side in sides])
    side, p_value = float(sides[np.argmax(scores)]), float(len(scores) * norm.sf(scores.max()))
    if p_value > thresholds().locking.significance:
        return None
    jumps = np.concatenate([each.squared_jumps(side) for each in axes])
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
    size = needed / float(np.sqrt(test.trials(np.array([side])).information[0]))
    return DetectableSize(name, "amplitude_px", size, {"tile_px": float(side)})


@dataclass(frozen=True)
class _TileTrials:
    """Sides of a tile that were tried.

    Attributes
    ----------
    sides : (k,) sides, px.
    total, information : (k,) weighted sum of the signed differences across seams, and the information on the amplitude.
    """

    sides: FloatArray
    total: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, sides: FloatArray, u: FloatArray, v: FloatArray, across: _SeamDifferences, down: _SeamDifferences) -> _TileTrials:
        """Evaluate sides (k,) with the differences along rows and columns of a raster with coordinates u and v, px."""
        column, row = (1.0 - 2.0 * (np.floor(x[None] / sides[:, None]) % 2) for x in (u, v))
        total, information = np.zeros(len(sides)), np.zeros(len(sides))
        for along, beside, value, known, variance in (
            (column, row, across.value, across.known, across.variance),
            (row, column, down.value.T, down.known.T, down.variance),
        ):
            jump = np.diff(along, axis=1)
            total += np.sum((beside @ value) * jump, axis=1) / variance
            information += jump**2 @ known.sum(axis=0) / variance
        return cls(sides, total, information)

    @property
    def sigmas(self) -> FloatArray:
        """(k,) amplitudes over their standard deviations."""
        return np.divide(self.total, np.sqrt(self.information), out=np.zeros_like(self.total), where=self.information > 0)

    @property
    def best(self) -> int:
        """Number of the side with the most significant amplitude."""
        return int(np.argmax(np.abs(self.sigmas)))


@dataclass(frozen=True)
class _AxisJumps:
    """Sums of the differences of neighbouring cells along one axis of the raster, for the jumps between whole tiles.

    Attributes
    ----------
    along : (c,) coordinates of the cells along the axis, px.
    beside : (r,) coordinates of the cells across the axis, px.
    sums : (r + 1, c - 1) cumulative sums across the axis: row k is the sum of the differences of the first k rows of cells, px.
    counts : (r + 1, c - 1) the same for the numbers of known differences.
    """

    along: FloatArray
    beside: FloatArray
    sums: FloatArray
    counts: FloatArray

    @classmethod
    def of(cls, along: FloatArray, beside: FloatArray, value: FloatArray, known: BoolArray) -> _AxisJumps:
        """Sum the differences (r, c - 1), which are 0 where one is not known."""
        sums, counts = (np.pad(np.cumsum(each, axis=0, dtype=np.float64), ((1, 0), (0, 0))) for each in (value, known))
        return cls(along, beside, sums, counts)

    def jumps(self, side: float) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
        """Sums of the differences over each row of tiles (t, c - 1), their numbers, and the numbers of the seams.

        side: side of a tile, px.
        """
        edges = np.flatnonzero(np.diff(np.floor(self.beside / side))) + 1
        rows = np.concatenate([[0], edges, [len(self.beside)]])
        return (
            np.diff(self.sums[rows], axis=0),
            np.diff(self.counts[rows], axis=0),
            np.flatnonzero(np.diff(np.floor(self.along / side))),
        )

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


def _seam_score(axes: tuple[_AxisJumps, _AxisJumps], side: float) -> float:
    """Sum of the normal scores of all seams, standardised; 0 if there are too few, or if those of one axis do not rank high."""
    of_axes = [each.seam_scores(side) for each in axes]
    scores = np.concatenate(of_axes)
    enough = len(scores) >= _FEWEST_SEAMS and all(each.sum() > _LEAST_AXIS_SIGMAS * np.sqrt(len(each)) for each in of_axes)
    return float(scores.sum() / np.sqrt(len(scores))) if enough else 0.0


def _axis(x: FloatArray, step: float) -> tuple[FloatArray, NDArray[np.int64]]:
    """Coordinates of the raster's columns (or rows), px, and the (n,) index of each point's."""
    low = float(x.min())
    index = np.rint((x - low) / step).astype(np.int64)
    return low + step * np.arange(index.max() + 1), index


def _sides(u: FloatArray, v: FloatArray, step: float) -> FloatArray:
    """Sides of a tile to try, px. The last seam, at about `last`, moves by a part of a cell from one to the next."""
    last = float(max(u[-1], v[-1]))
    smallest, largest = _SMALLEST_CELLS * step, _LARGEST_SHARE * last
    if largest <= smallest:
        return np.empty(0)
    # side n has its last seam k n near `last`, and moves it by k dn = last / n dn
    count = int(np.ceil(np.log(largest / smallest) * last / (_SHARE_OF_CELL * step)))
    return np.geomspace(smallest, largest, count)
