"""Bias of a window matcher where the surface is not parallel to the images."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter
from sensors.signal_chain.matches import Matches


class FrontoParallelBias(Effect):
    """A matcher with windows of one disparity is biased in proportion to the gradient of the disparity.

    dd = min(max(a |grad d| + b d_u, -L), L) is the bias of the disparity d, where a is `slope_px`, b is `row_px`, L is
    `limit_px`, and d_u is the change of d per column. The first term is for windows that find one disparity in the range that a
    slanted surface has within them (Bleyer et al. 2011, 1). The second is for asymmetric windows, which find the disparity of a
    place b px along the row from their centre (Kanade & Okutomi 1994). That displaces the whole surface along the row, so that
    registration removes most of it.
    """

    name: Literal["fronto_parallel_bias"] = "fronto_parallel_bias"
    means = "The matcher's windows assume one disparity: slanted parts of the wall are measured too near or too far."
    act = "Use slanted support windows or smaller ones, or view the wall from where it is less slanted."
    sensor = "stereo"
    stage = Stage.MATCH
    shows_in = ShowsIn.MEAN
    looks_at = "neighbours"
    needs = ("along_row", "along_column")
    order = 5
    sets = (("slope_px",), ("row_px",))
    trials = ("limit_px", (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0))
    slope_px: float = parameter(
        "bias per unit of the gradient's length",
        unit="px",
        source="empirical; Bleyer et al. 2011, 1",
        typical=4.0,
        ge=-1e3,
        le=1e3,
    )
    row_px: float = parameter(
        "displacement of the window along the row",
        unit="px",
        source="empirical; Kanade & Okutomi 1994",
        typical=4.0,
        ge=-1e3,
        le=1e3,
    )
    limit_px: float = parameter("largest bias", unit="px", source="empirical", null=None, default=1.0, gt=0)

    def bias(self, along_row: FloatArray, along_column: FloatArray) -> FloatArray:
        """Return the bias of a matcher's disparity, px, on a slanted surface.

        along_row, along_column: derivatives of the disparity by column u and by row v, px per px, arrays of equal shape.
        """
        linear = self.slope_px * np.hypot(along_row, along_column) + self.row_px * along_row
        return np.clip(linear, -self.limit_px, self.limit_px)

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        """Return the matches with the bias, px, added to the disparities; a cell whose neighbours have no match keeps its own.

        state: the matched cells of the depth map before this effect. `random` is not used.
        """
        disparity = state.raster()
        along_column, along_row = (_derivative(disparity, axis) / state.reduction for axis in (0, 1))
        return state.with_raster(disparity + self.bias(along_row, along_column))

    def mean(self, at: Any) -> FloatArray:
        """Return the bias of the disparity on slanted surfaces, (n,), px.

        at: geometry of n matched pixels of the stereo pair, as NumPy arrays.
        """
        return self.bias(at.along_row, at.along_column)


def _derivative(disparity: FloatArray, axis: int) -> FloatArray:
    """Central differences of a raster (rows, columns) per cell, one-sided beside a gap; 0 where both neighbours are missing."""
    gap = np.full_like(np.take(disparity, [0], axis), np.nan)
    forward = np.concatenate([np.diff(disparity, axis=axis), gap], axis=axis)
    backward = np.concatenate([gap, np.diff(disparity, axis=axis)], axis=axis)
    both = np.stack([forward, backward])
    count = np.sum(~np.isnan(both), axis=0)
    return np.asarray(np.nansum(both, axis=0) / np.maximum(count, 1))
