"""Residuals against their surroundings, in units of how much residuals spread where and how they were measured."""

from __future__ import annotations

from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.change.robust import nmad
from pipeline.gap.residuals.residuals import Residuals
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

_CELLS, _WINDOW = 36, 9
"""Cells along the longer side of the view, and how many of them make up the surroundings: a quarter of the side."""
_FEWEST = 5
_BIN_POINTS, _MOST_BINS = 400, 24
_ENOUGH = 5_000
"""Points of which a bin's NMAD is known to 1.6 %."""


def standardize(residuals: Residuals, plane: FloatArray, quiet: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """(n,) residuals less their surroundings' median, in the observable's unit and in units of their spread.

    plane: (n, 2) as the sensor sees the points; quiet: (n,) points of which surroundings and spread are learned. The spread is
    the predicted one times the largest NMAD that standardised residuals have among points of like covariates, at least 1: noise
    that the model lacks, and rays that are off where the surface is steep, raise it there and not elsewhere.
    """
    departure = residuals.value - _surroundings(plane, residuals.value, quiet)
    z = departure / residuals.sigma
    return departure, z / np.maximum(nmad_along_covariates(residuals, z, quiet), 1.0)


def nmad_along_covariates(residuals: Residuals, z: FloatArray, quiet: NDArray[np.bool_]) -> FloatArray:
    """(n,) largest NMAD that z has, of quiet points, among those of about the same value of one of the covariates."""

    def along(name: str) -> FloatArray:
        order = residuals.sort_orders[name]
        return _spread_along(residuals.covariates[name], z, order[quiet[order]])

    whole = np.full(len(z), nmad(z[quiet], 0.0))
    return reduce(np.maximum, map_in_threads(along, residuals.sort_orders), whole)


def _surroundings(plane: FloatArray, value: FloatArray, quiet: NDArray[np.bool_]) -> FloatArray:
    """(n,) median of the cells' medians about each point, linear between cells."""
    low = plane.min(axis=0)
    side = float(np.ptp(plane, axis=0).max()) / _CELLS or 1.0
    shape = tuple(int(extent / side) + 1 for extent in np.ptp(plane, axis=0))
    place = (plane - low) / side
    cell = np.ravel_multi_index(tuple(np.minimum(place[:, axis].astype(np.int64), shape[axis] - 1) for axis in (0, 1)), shape)
    middle = group_medians(value[quiet], cell[quiet], int(np.prod(shape)), _FEWEST).reshape(shape)
    padded = np.pad(middle, _WINDOW // 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (_WINDOW, _WINDOW)).reshape(-1, _WINDOW**2)
    empty = np.isnan(windows).all(axis=1)
    smooth = np.full(len(windows), np.nanmedian(middle) if np.isfinite(middle).any() else np.nan)
    smooth[~empty] = np.nanmedian(windows[~empty], axis=1)
    smooth = smooth.reshape(shape)
    return np.asarray(ndimage.map_coordinates(smooth, (place - 0.5).T, order=1, mode="nearest"))


def group_medians(value: FloatArray, cell: NDArray[np.int64], count: int, fewest: int) -> FloatArray:
    """(count,) median of the values of each cell, NaN where there are too few."""
    order = np.lexsort((value, cell))
    ordered = value[order]
    sizes = np.bincount(cell, minlength=count)
    starts = np.cumsum(sizes) - sizes
    filled = sizes >= fewest
    low, high = starts[filled] + (sizes[filled] - 1) // 2, starts[filled] + sizes[filled] // 2
    found = np.full(count, np.nan)
    found[filled] = (ordered[low] + ordered[high]) / 2
    return found


def _spread_along(values: FloatArray, z: FloatArray, order: NDArray[np.int32]) -> FloatArray:
    """(n,) NMAD of z among the known points with about the same value of a covariate. order: those points by that, rising."""
    groups = np.array_split(order, int(np.clip(len(order) // _BIN_POINTS, 1, _MOST_BINS)))
    found = np.array([nmad(z[group[:: max(len(group) // _ENOUGH, 1)]], 0.0) for group in groups])
    borders = np.array([values[group[0]] for group in groups[1:]])
    return np.asarray(found[np.searchsorted(borders, values, side="right")])
