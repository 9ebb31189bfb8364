"""Find the stable ground of difference maps, and choose the windows in which measured and simulated maps are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.change.difference import statistics
from pipeline.config.calibration import CalibrationConfig
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray, IntArray

BoolArray = NDArray[np.bool_]
_LEAST_STABLE = 0.6
"""Share of a window's pixels that must be stable and have data in every map."""
_CHANGE_NMADS = 4.0
"""Deviation, in NMADs, beyond which a cell or a pixel may be a change."""
_CHANGE_CELL_PX = 5
"""Side of a cell, pixels."""
_CHANGE_LEAST_CELLS = 3
"""Adjacent cells that make a change."""
_BACKGROUND_CELLS = 15
"""Side of the median filter that gives the background, cells."""


@dataclass(frozen=True)
class Windows:
    """k square windows of n x n pixels on a raster, in which a calibration compares measured and simulated difference maps.

    Attributes
    ----------
    grid : The raster.
    corner : (k, 2) row and column of each window's first pixel.
    side : n, pixels.
    stable : (k, n, n) true on stable ground, where nothing fell.
    """

    grid: Grid
    corner: IntArray
    side: int
    stable: BoolArray

    def cut(self, raster: NDArray[np.floating]) -> FloatArray:
        """Cut the k square windows out of a difference map.

        raster: (h, w) map. Returns (k, n, n) values in windows of n x n pixels; NaN outside stable ground.
        """
        cut = np.stack([raster[row : row + self.side, column : column + self.side] for row, column in self.corner])
        return np.where(self.stable, cut, np.nan)

    def places(self) -> tuple[FloatArray, FloatArray]:
        """Return the x and the y coordinates of all pixel centres in k windows of n x n pixels: (k, n, n) each, wall frame, m."""
        row = self.corner[:, 0, None, None] + np.arange(self.side)[None, :, None] + 0.5
        column = self.corner[:, 1, None, None] + np.arange(self.side)[None, None, :] + 0.5
        shape = (len(self.corner), self.side, self.side)
        x, y = self.grid.x_min + column * self.grid.gsd, self.grid.y_max - row * self.grid.gsd
        return np.broadcast_to(x, shape), np.broadcast_to(y, shape)

    def centres(self) -> FloatArray:
        """Return x and y of the centre of each of the k square windows: (k, 2), wall frame, m."""
        middle = self.corner + self.side / 2
        return np.stack([self.grid.x_min + middle[:, 1] * self.grid.gsd, self.grid.y_max - middle[:, 0] * self.grid.gsd], axis=1)


def stable_ground(maps: Sequence[NDArray[np.floating]]) -> BoolArray:
    """Detect stable ground, where no difference map shows a change of the wall, for a user who drew no stable areas.

    There are two signs of a change. First, the medians of squares of 5 x 5 pixels are compared with their running median
    over 15 x 15 squares: three or more adjacent squares that deviate by more than four NMADs are a change, with one square
    around them. Second, the pixels are compared with the same running median: places of at least 3 x 3 pixels that all
    deviate in one direction by more than four NMADs are a change.
    Single gross errors, and thin strips along edges, count as noise.

    Parameters
    ----------
    maps : Difference maps (h, w), m; NaN without data.

    Returns
    -------
    (h, w) mask, true on stable ground.
    """
    stable = np.ones(maps[0].shape, dtype=bool)
    for values in maps:
        cells = _cell_medians(values)
        known = ~np.isnan(cells)
        filled = np.where(known, cells, np.nanmedian(cells) if known.any() else 0.0)
        background = ndimage.median_filter(filled, _BACKGROUND_CELLS)
        stable &= ~_compact(values, background)
        departure = np.where(known, cells - background, 0.0)
        large = np.abs(departure) > _CHANGE_NMADS * statistics(departure[known]).nmad
        label, _ = ndimage.label(large)
        size = np.bincount(label.ravel())
        size[0] = 0
        changed = ndimage.binary_dilation(size[label] >= _CHANGE_LEAST_CELLS)
        pixels = np.repeat(np.repeat(changed, _CHANGE_CELL_PX, axis=0), _CHANGE_CELL_PX, axis=1)
        stable &= ~pixels[: values.shape[0], : values.shape[1]]
    return stable


def _compact(values: NDArray[np.floating], background: FloatArray) -> BoolArray:
    """Return the mask (h, w) of patches of one sign that all exceed the limit, with a margin of two pixels.

    A patch has 3 x 3 pixels or more.
    """
    behind = np.repeat(np.repeat(background, _CHANGE_CELL_PX, axis=0), _CHANGE_CELL_PX, axis=1)
    departure = values - behind[: values.shape[0], : values.shape[1]]
    limit = _CHANGE_NMADS * statistics(departure).nmad
    changed = np.zeros(values.shape, dtype=bool)
    for sign in (1, -1):
        changed |= ndimage.binary_opening(sign * departure > limit, np.ones((3, 3), dtype=bool))
    return ndimage.binary_dilation(changed, np.ones((5, 5), dtype=bool))


def _cell_medians(values: NDArray[np.floating]) -> FloatArray:
    """Return the medians of cells of 5 x 5 pixels; NaN where fewer than half of a cell's pixels have data."""
    rows, columns = (-(-size // _CHANGE_CELL_PX) * _CHANGE_CELL_PX for size in values.shape)
    padded = np.full((rows, columns), np.nan, dtype=np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    cells = padded.reshape(rows // _CHANGE_CELL_PX, _CHANGE_CELL_PX, -1, _CHANGE_CELL_PX).swapaxes(1, 2)
    cells = np.sort(cells.reshape(*cells.shape[:2], -1), axis=2)  # NaN last
    count = (~np.isnan(cells)).sum(axis=2)
    median = np.take_along_axis(cells, np.maximum(count - 1, 0)[..., None] // 2, axis=2)[..., 0]
    return np.where(2 * count >= _CHANGE_CELL_PX**2, median, np.nan).astype(np.float64)


def choose_windows(stable: BoolArray, grid: Grid, settings: CalibrationConfig) -> Windows:
    """Choose the square windows in which a calibration compares maps, spread evenly over the stable ground.

    Candidates lie half a window apart and are at least 60 % stable. The first window is the most stable one; each next one is
    the farthest from those already chosen (Gonzalez 1985). The windows thus reach the ends of the wall, where deformations are
    largest.

    Parameters
    ----------
    stable : (h, w) true on stable ground that has data in all maps.
    grid : The raster of the maps.
    settings : Number and size of the windows.

    Raises
    ------
    InputError
        If the maps are smaller than a window, or no window is stable enough.
    """
    side = settings.window_px
    if min(grid.shape) < side:
        raise InputError(
            f"a window of {side} pixels does not fit the maps of {grid.height} x {grid.width} pixels",
            where="calibration.window_px",
            allowed=f"up to {min(grid.shape)}",
            remedy="lower calibration.window_px, or give larger maps",
        )
    total = np.pad(stable.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    row, column = (
        each.ravel() for each in np.mgrid[0 : grid.height - side + 1 : side // 2, 0 : grid.width - side + 1 : side // 2]
    )
    share = total[row + side, column + side] - total[row, column + side] - total[row + side, column] + total[row, column]
    good = share >= _LEAST_STABLE * side**2
    row, column, share = row[good], column[good], share[good]
    if len(row) == 0:
        raise InputError(
            f"no window of {side} x {side} pixels is mostly stable ground with data in all maps",
            where="calibration.stable_areas, calibration.window_px",
            remedy="draw larger stable areas, lower window_px, or give fewer maps",
        )
    chosen = [int(np.argmax(share))]
    distance = np.full(len(row), np.inf)
    while len(chosen) < settings.windows:
        last = chosen[-1]
        apart = np.maximum(np.abs(row - row[last]), np.abs(column - column[last]))  # windows that touch do not overlap
        distance = np.minimum(distance, apart)
        if distance.max() < side:
            break
        chosen.append(int(np.argmax(distance)))
    corner = np.stack([row[chosen], column[chosen]], axis=1).astype(np.int32)
    cut = np.stack([stable[r : r + side, c : c + side] for r, c in corner])
    return Windows(grid, corner, side, cut)
