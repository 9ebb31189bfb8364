"""A raster over the wall frame's XY plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scene.geometry.mesh import FloatArray


@dataclass(frozen=True)
class Grid:
    """Square pixels, row 0 at the top (largest y), column 0 at the left (smallest x).

    x_min, y_max: the outer corner of the top-left pixel, wall frame, m; gsd: the side of a pixel, m; width, height: pixels.
    The centre of pixel (row, column) is (x_min + (column + 0.5) gsd, y_max - (row + 0.5) gsd).
    """

    x_min: float
    y_max: float
    gsd: float
    width: int
    height: int

    @classmethod
    def over(cls, bounds: FloatArray, gsd: float) -> Grid:
        """The grid of whole pixels inside `bounds` ((2, 2 or 3) smallest and largest coordinates, m)."""
        extent = bounds[1] - bounds[0]
        width, height = (max(int(np.floor(extent[axis] / gsd + 1e-9)), 1) for axis in (0, 1))
        return cls(float(bounds[0, 0]), float(bounds[1, 1]), gsd, width, height)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of the raster's array."""
        return self.height, self.width

    def columns(self, x: FloatArray) -> FloatArray:
        """Column of each x, m, in pixels from the left edge (a pixel's centre is at k + 0.5)."""
        return (x - self.x_min) / self.gsd

    def rows(self, y: FloatArray) -> FloatArray:
        """Row of each y, m, in pixels from the top edge (a pixel's centre is at k + 0.5)."""
        return (self.y_max - y) / self.gsd
