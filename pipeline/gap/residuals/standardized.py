"""Standardise residuals locally: subtract the median of their surroundings and divide by their actual scatter.

The search for scene changes uses this, so that neither a slowly varying error nor noisier parts of the wall look like a change.
"""

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
"""Cells along the longer side of the field of view, and cells along the side of the window that counts as surroundings: a
quarter of the view.
"""
_FEWEST = 5
"""Fewest points in a cell for its median to be used."""
_BIN_POINTS, _MOST_BINS = 400, 24
"""Smallest number of points in a bin of a covariate, and largest number of bins."""
_ENOUGH = 5_000
"""Points of a bin from which its NMAD is computed: enough for a precision of 1.6 %."""


def standardize(residuals: Residuals, view_xy: FloatArray, unchanged: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Subtract the local median from residuals and divide by their local scatter, so that a change of the rock stands out.

    The scatter is the predicted standard deviation, times a factor of at least 1. The factor is above 1 where points with a
    similar value of some covariate, such as the incidence angle, scatter more than predicted. Noise that the sensor model lacks
    thus raises the scatter only where that noise occurs.

    Parameters
    ----------
    residuals : Residuals of n points.
    view_xy : (n, 2) positions in the sensor's field of view, in units that are equal along both axes.
    unchanged : (n,) true for points where the rock did not change, from which median and scatter are estimated.

    Returns
    -------
    departure : (n,) residuals minus the local median, in the unit of the observable (m or px).
    z : (n,) `departure` divided by the scatter.
    """
    departure = residuals.value - _local_median(view_xy, residuals.value, unchanged)
    z = departure / residuals.sigma
    return departure, z / np.maximum(nmad_along_covariates(residuals, z, unchanged), 1.0)


def nmad_along_covariates(residuals: Residuals, z: FloatArray, unchanged: NDArray[np.bool_]) -> FloatArray:
    """Estimate at each of n points how much larger the residuals' scatter is than predicted.

    The points are sorted into bins of each covariate, such as range or incidence angle. The robust standard deviation (NMAD) of
    each bin is computed.

    Parameters
    ----------
    residuals : The residuals, of which only the covariates count.
    z : (n,) residuals divided by their predicted standard deviations.
    unchanged : (n,) true for points where the rock did not change, from which the NMADs are computed.

    Returns
    -------
    (n,) the largest of these NMADs of z: that over all points, and those of the point's bins of all covariates. About 1 if the
    prediction is right.
    """

    def along(name: str) -> FloatArray:
        order = residuals.sort_orders[name]
        return _nmad_along(residuals.covariates[name], z, order[unchanged[order]])

    whole = np.full(len(z), nmad(z[unchanged], 0.0))
    return reduce(np.maximum, map_in_threads(along, residuals.sort_orders), whole)


def _local_median(view_xy: FloatArray, value: FloatArray, unchanged: NDArray[np.bool_]) -> FloatArray:
    """(n,) local median: the median of the cells' medians in the window around each point, interpolated between cells."""
    low = view_xy.min(axis=0)
    side = float(np.ptp(view_xy, axis=0).max()) / _CELLS or 1.0
    shape = tuple(int(extent / side) + 1 for extent in np.ptp(view_xy, axis=0))
    place = (view_xy - low) / side
    cell = np.ravel_multi_index(tuple(place.astype(np.int64).T), shape, mode="clip")
    middle = group_medians(value[unchanged], cell[unchanged], int(np.prod(shape)), _FEWEST).reshape(shape)
    padded = np.pad(middle, _WINDOW // 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (_WINDOW, _WINDOW)).reshape(-1, _WINDOW**2)
    known = np.isfinite(windows).any(axis=1)
    smooth = np.full(len(windows), np.nanmedian(middle) if known.any() else np.nan)
    smooth[known] = np.nanmedian(windows[known], axis=1)
    return np.asarray(ndimage.map_coordinates(smooth.reshape(shape), (place - 0.5).T, order=1, mode="nearest"))


def group_medians(value: FloatArray, cell: NDArray[np.int64], count: int, fewest: int) -> FloatArray:
    """Return the median of each of `count` groups of values, such as the residuals of the points in each cell of a raster.

    cell: (n,) number of the group to which each of the values (n,) belongs, counted from 0. Groups with fewer values than
    `fewest` get NaN.
    """
    if not len(value):
        return np.full(count, np.nan)
    enough = np.bincount(cell, minlength=count) >= fewest
    return np.where(enough, ndimage.median(value, cell, np.arange(count)), np.nan)


def _nmad_along(values: FloatArray, z: FloatArray, order: NDArray[np.int32]) -> FloatArray:
    """(n,) NMAD of z among points in the same bin of a covariate. `order`: the points to use, sorted by the covariate."""
    groups = np.array_split(order, int(np.clip(len(order) // _BIN_POINTS, 1, _MOST_BINS)))
    found = np.array([nmad(z[group[:: max(len(group) // _ENOUGH, 1)]], 0.0) for group in groups])
    borders = np.array([values[group[0]] for group in groups[1:]])
    return np.asarray(found[np.searchsorted(borders, values, side="right")])
