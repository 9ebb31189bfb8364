"""Define the raster over the wall frame's XY plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scene.geometry.mesh import FloatArray


@dataclass(frozen=True)
class Grid:
    """A raster of square pixels over the wall, with row 0 at the top (largest y) and column 0 at the left (smallest x).

    The centre of pixel (row, column) is (x_min + (column + 0.5) gsd, y_max - (row + 0.5) gsd).

    Attributes
    ----------
    x_min, y_max : float
        Outer corner of the top-left pixel, wall frame, m.
    gsd : float
        Side of a pixel (ground sampling distance), m.
    width, height : int
        Size in pixels.
    """

    x_min: float
    y_max: float
    gsd: float
    width: int
    height: int

    @classmethod
    def over(cls, bounds: FloatArray, gsd: float) -> Grid:
        """Make the raster of all whole pixels with side `gsd`, m, inside `bounds`.

        bounds: (2, 2) or (2, 3) array of smallest and largest coordinates, m.
        """
        extent = bounds[1] - bounds[0]
        width, height = (max(int(np.floor(extent[axis] / gsd + 1e-9)), 1) for axis in (0, 1))
        return cls(float(bounds[0, 0]), float(bounds[1, 1]), gsd, width, height)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of the raster's array."""
        return self.height, self.width

    def columns(self, x: FloatArray) -> FloatArray:
        """Convert coordinates x, m, of any shape to columns in pixels from the left edge; the centre of column k is k + 0.5."""
        return (x - self.x_min) / self.gsd

    def rows(self, y: FloatArray) -> FloatArray:
        """Convert coordinates y, m, of any shape to rows in pixels from the top edge; the centre of row k is k + 0.5."""
        return (self.y_max - y) / self.gsd
