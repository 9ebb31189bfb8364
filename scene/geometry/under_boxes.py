"""Find the faces of a wall that lie under boxes.

A raster of the boxes and its integral image make this fast for millions of faces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray, IntArray, TriangleMesh

_MOST_CELLS = 4e6
"""Largest number of raster cells."""
_CELLS_PER_BOX = 8
"""Number of cells along the shortest side of the smallest box, if the largest number of cells allows it."""

_CHUNK = 1 << 15
"""Number of faces looked up at a time, so that intermediate arrays stay in the processor's cache."""


def faces_under_boxes(mesh: TriangleMesh, boxes: FloatArray, halo_m: float = 0.0) -> IntArray:
    """Find the faces of a wall that lie under boxes, such as those of fallen blocks, to process only this part of the wall.

    A face lies under a box if their projections on the xy plane overlap, at any height. A few faces beside the boxes, within
    one cell of the raster that the search uses, may be included.

    Parameters
    ----------
    mesh : TriangleMesh
        The wall, wall frame.
    boxes : (k, 2, 2 or 3) array
        Smallest and largest coordinates of each box, m.
    halo_m : float
        Margin added around each box, m.

    Returns
    -------
    (f,) int32 array
        Face indices, ascending.
    """
    low, high = boxes[:, 0, :2] - halo_m, boxes[:, 1, :2] + halo_m
    corner, extent = low.min(axis=0), high.max(axis=0) - low.min(axis=0)
    cell = max(float((high - low).min()) / _CELLS_PER_BOX, float(np.sqrt(extent.prod() / _MOST_CELLS)))
    shape = (extent / cell).astype(np.int64) + 3  # a rim of free cells stands for everything outside
    free = np.zeros(tuple(shape), dtype=np.int32)
    first, last = _cells(low, corner, cell, shape), _cells(high, corner, cell, shape)
    for (x0, y0), (x1, y1) in zip(first.tolist(), last.tolist(), strict=True):
        free[x0 : x1 + 1, y0 : y1 + 1] = 1
    count = integral_image(free).ravel()
    width = int(shape[1]) + 1
    x_cell, y_cell = (_cells(mesh.vertices[:, axis], corner[axis], cell, shape[axis]) for axis in (0, 1))
    found = []
    for start in range(0, len(mesh.faces), _CHUNK):
        a, b, c = mesh.faces[start : start + _CHUNK].T
        x0, x1 = _span(x_cell[a], x_cell[b], x_cell[c])
        y0, y1 = _span(y_cell[a], y_cell[b], y_cell[c])
        under = (
            count[(x1 + 1) * width + y1 + 1] - count[x0 * width + y1 + 1] - count[(x1 + 1) * width + y0] + count[x0 * width + y0]
        )
        found.append((np.flatnonzero(under) + start).astype(np.int32))
    return np.concatenate(found) if found else np.empty(0, dtype=np.int32)


def integral_image(raster: NDArray[np.generic]) -> IntArray:
    """Return the integral image (h + 1, w + 1) of a raster (h, w), from which sums over rectangles are read quickly.

    Entry (i, j) is the sum over the rows 0 to i - 1 and the columns 0 to j - 1.
    """
    sums = np.zeros((raster.shape[0] + 1, raster.shape[1] + 1), dtype=np.int32)
    np.cumsum(raster, axis=0, dtype=np.int32, out=sums[1:, 1:])
    np.cumsum(sums[1:, 1:], axis=1, out=sums[1:, 1:])
    return sums


def _cells(positions: FloatArray, corner: FloatArray, cell: float, shape: NDArray[np.int64]) -> IntArray:
    """Return cell numbers along one or both axes.

    Numbers 0 and shape - 1 stand for everything outside the boxes' common rectangle.
    """
    return np.clip(np.floor((positions - corner) / cell) + 1, 0, shape - 1).astype(np.int32)


def _span(a: IntArray, b: IntArray, c: IntArray) -> tuple[IntArray, IntArray]:
    """Return the smallest and the largest of three arrays, element by element."""
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
