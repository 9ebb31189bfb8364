"""Define the base class of effects that filter the depth map, as a matcher does with neighbouring disparities."""

from __future__ import annotations

from abc import abstractmethod

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage
from sensors.signal_chain.matches import Matches


class RasterEffect(Effect):
    """Base class of effects that filter the depth map: each disparity changes by its neighbours, without random numbers."""

    sensor = "stereo"
    stage = Stage.MATCH
    shows_in = ShowsIn.EDGES
    looks_at = "neighbours"

    @abstractmethod
    def filtered(self, disparity: FloatArray, cell_px: float, jump_px: float) -> FloatArray:
        """Return the disparities (rows, columns), px, after the effect; a subclass defines the filter.

        Parameters
        ----------
        disparity : (rows, columns) array
            Disparities, px, NaN without a match.
        cell_px : float
            Size of a cell of the depth map, px of the full-resolution frame.
        jump_px : float
            Neighbours that differ by more than this are a depth step, px.
        """

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        """Return the matches with filtered disparities, px.

        Neighbouring cells whose disparities differ by more than the side of a cell (px of the frame) are a depth step.

        state: the matched cells of the depth map before this effect. `random` is not used.
        """
        step = float(state.reduction)
        return state.with_raster(self.filtered(state.raster(), step, step))
