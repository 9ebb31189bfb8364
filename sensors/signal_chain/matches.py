"""The stereo pair's image rows and matched pixels on their way through the chain.

Effects on the matching act in this order, whatever a config's: the true disparities are fattened at their edges, then smoothed;
regularization, parallax and texture noise are added; last come the locking, which acts on the fraction that the matcher finds,
and, at its own stage, the filling of half-occluded strips.
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
    """n pixels of one camera as it exposes them, lazy device arrays (n,), px of the full-resolution frame.

    v: the row; du: recorded minus ideal column.
    """

    camera: Literal["left", "right"]
    v: mi.Float64
    du: mi.Float64


@dataclass(frozen=True)
class Matches:
    """n cells of the left depth map as lazy device arrays, all (n,); image quantities in px of the full-resolution frame.

    index: the cell's number, row by row (keys its random numbers); u, v: the cell's centre in the left image; disparity: of the
    rectified pair; matched: whether the cell has a match; block, true_depth (m, along the real left camera's axis), albedo: of
    the surface that the left camera sees there, albedo None for a wall that has none. width, height: of the frame; reduction:
    frame px per cell, so that one cell is one px of the image that is matched. tangent: of the angle between a rectified row and
    the rectified axis; infinity: disparity of a point at infinity.
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
        """(rows, columns) of the depth map."""
        return self.height // self.reduction, self.width // self.reduction

    def raster(self) -> FloatArray:
        """(rows, columns) disparities, px, NaN where there is no match, for effects that look at a cell's neighbours."""
        self._evaluate()
        return np.where(self.matched.numpy(), self.disparity.numpy(), np.nan).reshape(self.shape)

    def albedo_raster(self) -> FloatArray | None:
        """(rows, columns) albedo, NaN where there is no match; None for a wall without albedo."""
        if self.albedo is None:
            return None
        self._evaluate()
        return np.where(self.matched.numpy(), self.albedo.numpy(), np.nan).reshape(self.shape)

    def sampled(self, raster: FloatArray) -> mi.Float64:
        """(n,) the values of a (rows, columns) raster, each where its match is."""
        return on_device(mi.Float64, raster)

    def with_raster(self, disparity: FloatArray) -> Matches:
        """The same cells with these (rows, columns) disparities, px, matched where they are not NaN."""
        return replace(self, disparity=on_device(mi.Float64, disparity), matched=on_device(mi.Bool, ~np.isnan(disparity)))

    def _evaluate(self) -> None:
        """Everything that comes out of the ray tracing at once, so that no later evaluation traces the rays again."""
        dr.eval(self.disparity, self.matched, self.block, self.true_depth, self.albedo)


def bridged(disparity: FloatArray, reach: float) -> FloatArray:
    """Unmatched runs of at most `reach` cells between two matched ones of a row take the background of the two.

    disparity: (rows, columns), NaN where unmatched; the background is the smaller disparity. Runs at a row's end stay unmatched.
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
