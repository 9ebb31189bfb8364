"""Estimate how far an epoch's map is displaced, to move the outlines of the carved niches to where sensor and ICP put them.

A label is that of the carved wall's face seen along -z. The sensor's samples tell the displacement of the map: x and y of what
was recorded and registered, minus the true x and y. Averaged over cells of some hundred samples, it is smooth and free of
white noise that would fray the outlines of small niches. A pixel takes the label of the place from which it came.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.registration.register import Registration
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray
from sensors.signal_chain.observation import Observation

_CELL_M = 0.5
"""Side of the cells over which displacements are averaged, if samples are dense enough."""
_LEAST_SAMPLES = 30
"""Number of samples that a cell has on average at least."""
_OUTLIER = 6.0
"""Samples displaced by more than this many NMAD from the median belong to another surface, beyond a depth edge."""


def displacement(observations: tuple[Observation, ...], registration: Registration | None, grid: Grid) -> NDArray[np.float32]:
    """Estimate how far the errors of sensor and registration move each place of a difference map sideways.

    The labels of fallen blocks are moved by as much, so that they lie where the map shows the blocks.

    Parameters
    ----------
    observations : tuple of Observation
        What the sensor recorded, one observation for each station (set-up).
    registration : Registration, optional
        Registration that was applied to the points; None: none.
    grid : Grid
        Pixels of the map, h x w.

    Returns
    -------
    (h, w, 2) float32 array
        Displacement at each pixel: x and y in the map minus the true x and y, wall frame, m; 0 if the true places are unknown.
    """
    samples = [_samples(each, registration) for each in observations]
    place, offset = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    result = np.zeros((*grid.shape, 2), dtype=np.float32)
    if len(place) == 0:
        return result
    area = grid.width * grid.height * grid.gsd**2
    side = max(_CELL_M, np.sqrt(_LEAST_SAMPLES * area / len(place)))
    columns, rows = (int(np.ceil(size * grid.gsd / side)) for size in (grid.width, grid.height))
    column = np.clip(grid.columns(place[:, 0]) * grid.gsd / side, 0, columns - 1).astype(np.int64)
    row = np.clip(grid.rows(place[:, 1]) * grid.gsd / side, 0, rows - 1).astype(np.int64)
    cell = row * columns + column
    count = np.bincount(cell, minlength=rows * columns).reshape(rows, columns)
    x, y = ((np.arange(size) + 0.5) * grid.gsd / side - 0.5 for size in (grid.width, grid.height))
    maps = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    for axis in range(2):
        total = np.bincount(cell, offset[:, axis], rows * columns).reshape(rows, columns)
        mean = _filled(np.asarray(total, dtype=np.float64), count)
        result[..., axis] = cv2.remap(mean.astype(np.float32), *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return result


def _samples(seen: Observation, registration: Registration | None) -> tuple[FloatArray, FloatArray]:
    """Return positions (n, 2) of the samples in the map, m, and the displacement of each, without outliers."""
    if seen.offset is None:
        return np.empty((0, 2)), np.empty((0, 2))
    points, offset = seen.points[seen.valid], seen.offset[seen.valid]
    moved = points if registration is None else registration.apply(points)
    columns, near = [], np.ones(len(points), dtype=bool)
    for axis in range(2):
        column = offset[:, axis].astype(np.float64) + (moved[:, axis] - points[:, axis])
        from_median = np.abs(column - np.median(column))
        near &= from_median <= _OUTLIER * 1.4826 * np.median(from_median) + 1e-9
        columns.append(column)
    return moved[near, :2], np.stack([column[near] for column in columns], axis=1)


def _filled(total: FloatArray, count: NDArray[np.signedinteger]) -> FloatArray:
    """Return the mean of each cell; a cell with too few samples takes that of the nearest one."""
    from scipy import ndimage

    known = count >= _LEAST_SAMPLES / 3
    if not known.any():
        return np.full(total.shape, total.sum() / max(int(count.sum()), 1))
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray((total / np.maximum(count, 1))[tuple(nearest)])
