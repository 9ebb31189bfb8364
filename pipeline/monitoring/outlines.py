"""Compute the outlines of regions: rings around their pixels, in the wall frame and in survey coordinates."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.monitoring.events import ChangedRegion
from scene.geometry.frame import WallFrame
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

_FINER = 2
"""Each pixel is drawn as so many squared, so that outlines run a quarter of a pixel inside of the pixels' edges."""


def rings(mask: NDArray[np.bool_]) -> list[FloatArray]:
    """Return the outline of each connected part of a mask (h, w), for files of outlines.

    Each outline is a closed ring (n, 2): column and row of its corners, in pixels from the mask's top-left corner.
    """
    fine = np.kron(mask.astype(np.uint8), np.ones((_FINER, _FINER), np.uint8))
    found, _ = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    corners = [(each.reshape(-1, 2) + 0.5) / _FINER for each in found if len(each) > 2]
    return [np.concatenate([each, each[:1]]) for each in corners]


def in_survey(region: ChangedRegion, grid: Grid, heights: NDArray[np.float32], frame: WallFrame) -> list[FloatArray]:
    """Return the outlines of a changed region in survey coordinates, for files that GIS programs read.

    Parameters
    ----------
    region : ChangedRegion
        The region.
    grid : Grid
        Raster of the map in which it lies.
    heights : (h, w) array
        Heights of the reference on that raster, m.
    frame : WallFrame
        Frame of the raster.

    Returns
    -------
    list of (n, 3) arrays
        A closed ring on the reference's surface for each connected part, survey coordinates, m.
    """
    result = []
    for ring in rings(region.mask):
        column, row = ring[:, 0] + region.column, ring[:, 1] + region.row
        at = np.minimum(row.astype(int), grid.height - 1), np.minimum(column.astype(int), grid.width - 1)
        z = np.where(np.isfinite(heights[at]), heights[at], region.z_m)
        wall = np.stack([grid.x_min + column * grid.gsd, grid.y_max - row * grid.gsd, z], axis=1)
        result.append(frame.to_world(wall))
    return result
