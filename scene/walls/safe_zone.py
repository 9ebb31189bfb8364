"""Find the part of a wall where blocks may fall: a binary raster of the mesh, eroded by a margin."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray, IntArray
from scene.geometry.under_boxes import integral_image
from scene.ray_casting.raycast import RayCaster, heights

_CELLS = 2e6
"""Number of raster cells. On a wall of 70 x 45 m they measure 4 cm."""


@dataclass(frozen=True)
class SafeZone:
    """The part of the wall where blocks may be placed: away from its border and its holes.

    Attributes
    ----------
    grid : Grid
        Raster over the wall frame's xy plane.
    free : (height, width) bool array
        True for cells of the raster that a block's bounding box may cover.
    """

    grid: Grid
    free: NDArray[np.bool_]

    @cached_property
    def cells(self) -> NDArray[np.intp]:
        """Numbers of the free raster cells, counted row by row."""
        return np.flatnonzero(self.free)

    @cached_property
    def _blocked(self) -> IntArray:
        """Integral image of the cells that are not free."""
        return integral_image(~self.free)

    def sample(self, generator: np.random.Generator, size: int) -> FloatArray:
        """Draw `size` points (size, 2), x and y, wall frame, m, uniformly from the zone, as random places of blocks."""
        row, column = np.divmod(self.cells[generator.integers(len(self.cells), size=size)], self.grid.width)
        within = generator.random((2, size))
        x = self.grid.x_min + (column + within[0]) * self.grid.gsd
        y = self.grid.y_max - (row + within[1]) * self.grid.gsd
        return np.stack([x, y], axis=1)

    def holds(self, boxes: FloatArray) -> NDArray[np.bool_]:
        """Return, for each of n boxes, whether it lies wholly in the zone, so that a block may be placed there.

        boxes: (n, 2, 2) smallest and largest x and y of each, wall frame, m.
        """
        column, row = self.grid.columns(boxes[:, :, 0]), self.grid.rows(boxes[:, ::-1, 1])
        inside = (column[:, 0] >= 0) & (row[:, 0] >= 0) & (column[:, 1] < self.grid.width) & (row[:, 1] < self.grid.height)
        (x0, x1), (y0, y1) = (np.clip(np.floor(index), 0, n - 1).astype(int).T for index, n in self._axes(column, row))
        sums = self._blocked
        blocked = sums[y1 + 1, x1 + 1] - sums[y0, x1 + 1] - sums[y1 + 1, x0] + sums[y0, x0]
        return inside & (blocked == 0)

    def _axes(self, column: FloatArray, row: FloatArray) -> tuple[tuple[FloatArray, int], tuple[FloatArray, int]]:
        """Pair each axis's indices with its number of cells."""
        return (column, self.grid.width), (row, self.grid.height)


def safe_zone(caster: RayCaster, offset_m: float) -> SafeZone:
    """Find the part of a wall where blocks may be placed: farther than `offset_m`, m, from its border and its holes.

    Border and holes are those seen along -z. `caster` holds the wall in the wall frame. Raises InputError if nothing is left.
    """
    bounds = caster.mesh.bounds
    extent = bounds[1, :2] - bounds[0, :2]
    grid = Grid.over(bounds, float(np.sqrt(extent.prod() / _CELLS)))
    covered = np.pad(np.isfinite(heights(caster, grid)), 1)  # beyond the raster there is no wall
    distance = cv2.distanceTransform(covered.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    free = (covered & (distance * grid.gsd > offset_m))[1:-1, 1:-1]
    if not free.any():
        raise InputError(
            f"a margin of {offset_m:g} m leaves no room on a wall of {extent[0]:.3g} x {extent[1]:.3g} m",
            where="safe_zone_offset_m",
            remedy="choose a smaller margin, below half of the wall's shorter side",
        )
    return SafeZone(grid, free)
