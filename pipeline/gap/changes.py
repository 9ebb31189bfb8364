"""Compact regions where the surface itself moved: found by local contrast, set aside, reported."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.gap.residuals import Residuals
from pipeline.robust import nmad
from scene.frame import WallFrame
from scene.mesh import FloatArray

_POINTS_PER_CELL = 8.0
_SIGMAS = 4.5
_SUM_SIGMAS = 9.0
_FEWEST_CELLS = 3
_SMALLEST_M = 0.02
_MARGIN_CELLS = 2
_SURROUNDING = 21
"""Width in cells of the surroundings that a cell is compared with."""
_LARGEST_SHARE = 0.25
"""A region that takes more of the wall is no compact change."""


@dataclass(frozen=True)
class SceneChange:
    """A region that moved. bounds: (2, 3) wall frame, m; volume_m3: missing or added; offset_m: median along the ray."""

    bounds: FloatArray
    volume_m3: float
    offset_m: float

    def to_dict(self, frame: WallFrame) -> dict[str, Any]:
        """As gap.json holds it: the box that holds the region's corners in the world frame."""
        low, high = self.bounds
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        world = frame.to_world(corners)
        return {"bbox_m": [*world.min(axis=0).tolist(), *world.max(axis=0).tolist()], "volume_m3": self.volume_m3}


@dataclass(frozen=True)
class _Raster:
    """Medians of the residuals in small cells, NaN where there are too few points."""

    side: float
    shape: tuple[int, int]
    cell: NDArray[np.int64]
    median: FloatArray
    error: FloatArray


def find_changes(
    residuals: Residuals, points: FloatArray, eligible: NDArray[np.bool_]
) -> tuple[list[SceneChange], NDArray[np.bool_]]:
    """Regions that moved, and (n,) the points in or beside them.

    residuals: registered roughly; points: (n, 3) measured, wall frame; eligible: (n,) points away from depth edges. A region is a
    connected group of cells whose medians depart from their surroundings by several standard errors, all to one side.
    """
    metres = residuals.value * residuals.unit_m
    raster = _rastered(residuals, metres, eligible)
    around = _around(raster.median)
    contrast = raster.median - around
    scatter = max(nmad(contrast / raster.error, 0.0), 1.0)
    score = np.nan_to_num(contrast / (raster.error * scatter))
    found, marked = [], np.zeros(raster.shape, dtype=bool)
    for sign in (1, -1):
        strong = (sign * score > _SIGMAS) & (sign * np.nan_to_num(contrast) > _SMALLEST_M)
        groups, count = ndimage.label(strong, structure=np.ones((3, 3)))
        for number in range(1, count + 1):
            region = groups == number
            if _is_change(region, score, raster):
                found.append(_change(region, contrast, raster, residuals, points, sign))
                marked |= region
    grown = ndimage.binary_dilation(marked, structure=np.ones((3, 3)), iterations=_MARGIN_CELLS) if found else marked
    return found, grown.ravel()[raster.cell]


def _is_change(region: NDArray[np.bool_], score: FloatArray, raster: _Raster) -> bool:
    size = int(region.sum())
    whole = size < _LARGEST_SHARE * np.isfinite(raster.median).sum()
    return bool(size >= _FEWEST_CELLS and whole and np.abs(score[region]).sum() / np.sqrt(size) > _SUM_SIGMAS)


def _rastered(residuals: Residuals, metres: FloatArray, eligible: NDArray[np.bool_]) -> _Raster:
    extent = np.ptp(residuals.at, axis=0)
    side = float(np.sqrt(np.prod(extent) / max(len(metres) / _POINTS_PER_CELL, 1.0))) or 1.0
    low = residuals.at.min(axis=0)
    columns, rows = (int(extent[axis] / side) + 1 for axis in (0, 1))
    column, row = (np.floor((residuals.at[:, axis] - low[axis]) / side).astype(np.int64) for axis in (0, 1))
    cell = row * columns + column
    median, error = np.full(rows * columns, np.nan), np.full(rows * columns, np.inf)
    order = np.argsort(cell[eligible], kind="stable")
    numbers, starts = np.unique(cell[eligible][order], return_index=True)
    counts = np.diff(np.append(starts, len(order)))
    median[numbers] = _medians(metres[eligible], cell[eligible], starts, counts)
    spread = np.bincount(cell[eligible], (residuals.sigma * residuals.unit_m)[eligible], rows * columns)[numbers] / counts
    error[numbers] = 1.2533 * spread / np.sqrt(counts)
    few = numbers[counts < 3]
    median[few], error[few] = np.nan, np.inf
    return _Raster(side, (rows, columns), cell, median.reshape(rows, columns), error.reshape(rows, columns))


def _medians(values: FloatArray, cell: NDArray[np.int64], starts: NDArray[np.int64], counts: NDArray[np.int64]) -> FloatArray:
    """Median of each run of equal cells."""
    ordered = values[np.lexsort((values, cell))]
    low, high = starts + (counts - 1) // 2, starts + counts // 2
    return np.asarray((ordered[low] + ordered[high]) / 2)


def _around(median: FloatArray) -> FloatArray:
    """(rows, columns) median over each cell's surroundings."""
    filled = np.where(np.isnan(median), np.nanmedian(median), median)
    return np.asarray(ndimage.median_filter(filled, size=_SURROUNDING, mode="nearest"))


def _change(
    region: NDArray[np.bool_], contrast: FloatArray, raster: _Raster, residuals: Residuals, points: FloatArray, sign: int
) -> SceneChange:
    inside = region.ravel()[raster.cell]
    chosen = points[inside]
    depth = float(np.abs(contrast[region]).sum()) * raster.side**2
    low, high = chosen.min(axis=0), chosen.max(axis=0)
    return SceneChange(np.stack([low, high]), depth, sign * float(np.median(np.abs(contrast[region]))))
