"""What a matcher does to disparities by their neighbours: a filter of the depth map."""

from __future__ import annotations

from abc import abstractmethod

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage
from sensors.signal_chain.matches import Matches


class RasterEffect(Effect):
    """A pure function of the raster of disparities."""

    sensor = "stereo"
    stage = Stage.MATCH
    shows_in = ShowsIn.EDGES
    looks_at = "neighbours"

    @abstractmethod
    def filtered(self, disparity: FloatArray, cell_px: float, jump_px: float) -> FloatArray:
        """(rows, columns) disparities afterwards, px, NaN where there is no match.

        disparity: before, px; cell_px: px of the frame per cell; jump_px: neighbours that differ by more are a depth step.
        """

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        step = float(state.reduction)
        return state.with_raster(self.filtered(state.raster(), step, step))
