"""Make triangles of a raster of heights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh


def mesh_of_raster(heights: NDArray[np.floating], grid: Grid) -> TriangleMesh:
    """Make a triangle mesh from a raster of heights: a vertex at each pixel's centre, two triangles between four pixels.

    Parameters
    ----------
    heights : (h, w) array
        Heights, in the unit of the grid's coordinates; NaN where there is no data, which leaves a hole.
    grid : Grid
        Size and position of the pixels.

    Returns
    -------
    TriangleMesh
        Its triangles are counter-clockwise seen from above (from larger heights). It has none if no four neighbouring pixels
        have heights.
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
