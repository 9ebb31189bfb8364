"""Define the stereo pair's image rows and matched pixels as they pass along the sensor's chain.

Matching effects act in a fixed order, whatever the order in a config. Edge fattening and then smoothing act on the true
disparities. Regularisation, parallax and texture noise are added next. Pixel locking is last, because it depends on the
fraction that the matcher finds. The filling of half-occluded strips has its own, later stage.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from scene.common.backend import dr, mi
from scene.geometry.mesh import FloatArray
from scene.ray_casting.upload import on_device


@dataclass(frozen=True)
class ImageRows:
    """n pixels of one camera during the exposure, for errors that displace image rows.

    Arrays (n,) are lazy arrays of the ray-tracing device, in px of the full-resolution frame.

    Attributes
    ----------
    camera : str
        "left" or "right".
    v : mi.Float64
        Row of each pixel.
    du : mi.Float64
        Recorded minus ideal column of each pixel.
    """

    camera: Literal["left", "right"]
    v: mi.Float64
    du: mi.Float64


@dataclass(frozen=True)
class Matches:
    """n cells of the left depth map with their disparities, on which errors of the matching act.

    Arrays (n,) are lazy arrays of the ray-tracing device; image quantities are in px of the full-resolution frame.

    Attributes
    ----------
    index : mi.UInt32
        Number of the cell, counted row by row; the cell's random numbers depend on it.
    u, v : mi.Float64
        Centre of the cell in the left image.
    disparity : mi.Float64
        Disparity of the rectified pair.
    matched : mi.Bool
        Whether the cell has a match.
    block : mi.Int32
        Label of the fallen block whose niche the left camera sees there; 0 is the wall.
    true_depth : mi.Float64
        Depth of that surface along the real left camera's axis, m.
    albedo : mi.Float32 or None
        Albedo of that surface; None for a wall without albedo.
    width, height : int
        Size of the frame.
    reduction : int
        Frame px per cell; one cell is one px of the image that is matched.
    tangent : mi.Float64
        Tangent of how far lines of sight in the cell's rectified row point below the rectified axis.
    infinity : float
        Disparity of a point at infinity.
    """

    index: mi.UInt32
    u: mi.Float64
    v: mi.Float64
    disparity: mi.Float64
    matched: mi.Bool
    block: mi.Int32
    true_depth: mi.Float64
    albedo: mi.Float32 | None
    width: int
    height: int
    reduction: int
    tangent: mi.Float64
    infinity: float

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the depth map to which the cells belong."""
        return self.height // self.reduction, self.width // self.reduction

    def raster(self) -> FloatArray:
        """Return the disparities of the depth map as a raster (rows, columns), px, NaN without a match.

        Effects that depend on a cell's neighbours use it.
        """
        self._evaluate()
        return np.where(self.matched.numpy(), self.disparity.numpy(), np.nan).reshape(self.shape)

    def albedo_raster(self) -> FloatArray | None:
        """Return the albedo of the rock in each cell of the depth map (rows, columns), NaN without a match.

        Returns None for a wall without albedo.
        """
        if self.albedo is None:
            return None
        self._evaluate()
        return np.where(self.matched.numpy(), self.albedo.numpy(), np.nan).reshape(self.shape)

    def sampled(self, raster: FloatArray) -> mi.Float64:
        """Read the values of a raster (rows, columns) over the depth map as a device array (n,), one per cell, row by row."""
        return on_device(mi.Float64, raster)

    def with_raster(self, disparity: FloatArray) -> Matches:
        """Return the same cells with new disparities, after an effect that works on the whole depth map.

        disparity: (rows, columns), px; cells are matched where it is not NaN.
        """
        return replace(self, disparity=on_device(mi.Float64, disparity), matched=on_device(mi.Bool, ~np.isnan(disparity)))

    def _evaluate(self) -> None:
        """Evaluate everything that the ray tracing yields at once, so that no later evaluation traces the rays again."""
        dr.eval(self.disparity, self.matched, self.block, self.true_depth, self.albedo)


def fill_gaps(disparity: FloatArray, reach: float) -> FloatArray:
    """Fill gaps between two matched cells of a row with the background's disparity, the smaller of the two.

    Gaps at the end of a row remain unmatched. Returns the new disparities (rows, columns).

    Parameters
    ----------
    disparity : (rows, columns) array
        Disparities, px, NaN where unmatched.
    reach : float
        Widest gap that is filled, cells.
    """
    rows, columns = disparity.shape
    matched, column = ~np.isnan(disparity), np.arange(columns, dtype=np.int32)
    before = np.maximum.accumulate(np.where(matched, column, -1), axis=1)
    after = np.minimum.accumulate(np.where(matched, column, columns)[:, ::-1], axis=1)[:, ::-1]
    fill = ~matched & (before >= 0) & (after < columns) & (after - before - 1 <= reach)
    row = np.broadcast_to(np.arange(rows)[:, None], disparity.shape)[fill]
    result = disparity.copy()
    result[fill] = np.minimum(disparity[row, before[fill]], disparity[row, after[fill]])
    return result
