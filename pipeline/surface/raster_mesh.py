"""Make triangles of a raster of heights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh


def mesh_of_raster(heights: NDArray[np.floating], grid: Grid) -> TriangleMesh:
    """Put a vertex at the centre of each pixel that has a height, and two triangles between four such pixels.

    Parameters
    ----------
    heights : (h, w) array
        In the unit of the grid; NaN where there is no data.
    grid : Grid
        Where the pixels lie.

    Returns
    -------
    TriangleMesh
        Counter-clockwise seen from larger heights; without triangles where no four neighbouring pixels have heights.
    """
    known = np.isfinite(heights)
    x, y = np.meshgrid(
        grid.x_min + (np.arange(grid.width) + 0.5) * grid.gsd, grid.y_max - (np.arange(grid.height) + 0.5) * grid.gsd
    )
    number = (np.cumsum(known) - 1).reshape(known.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    faces = np.concatenate([np.stack(each, axis=-1)[whole] for each in ((a, c, d), (a, d, b))]).astype(np.int32)
    return TriangleMesh(np.stack([x[known], y[known], heights[known].astype(np.float64)], axis=1), faces)
