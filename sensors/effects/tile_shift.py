"""Tiles of the image that a matcher shifts against each other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter
from sensors.numerics.functions import DEVICE, HOST, DeviceParameters, Functions
from sensors.signal_chain.matches import Matches


class TileShift(Effect):
    """A matcher that works in tiles shifts neighbouring tiles against each other.

    dd = A (-1)^(i + j), with the amplitude A and the tile's column i = floor(u / n) and row j = floor(v / n), counted from the
    frame's corner; n is the side of a tile. Tiles are matched one by one to save memory (Hirschmueller 2008, 2.6); each has its
    own offset, and the seams show. This effect is the pattern with the sharpest seams: the tiles of a checkerboard.
    """

    name: Literal["tile_shift"] = "tile_shift"
    means = "The matcher worked in tiles, and neighbouring tiles lie at different depths: the map has seams in a checkerboard."
    act = "Match in larger tiles that overlap, or in one piece; compare the depth on both sides of a seam."
    sensor = "stereo"
    stage = Stage.MATCH
    shows_in = ShowsIn.MEAN
    order = 70
    amplitude_px: float = parameter(
        "shift of a tile", unit="px", source="empirical; tiles as in Hirschmueller 2008, 2.6", typical=0.3, ge=-100, le=100
    )
    tile_px: float = parameter("side of a tile", unit="px", source="empirical", null=None, default=256.0, gt=0)

    def shift(self, u: Any, v: Any, m: Functions, p: Any) -> Any:
        """Return the shift (n,), px, of the disparity in the tile in which each pixel lies.

        u, v: (n,) columns and rows in the left image, px. m: elementary functions for these arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        half = 0.5 * (m.floor(u / p.tile_px) + m.floor(v / p.tile_px))
        return p.amplitude_px * (1 - 4 * (half - m.floor(half)))

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        """Return the matches with the disparities, px, of each tile of the image shifted.

        state: the matched cells of the depth map before this effect. `random` is not used.
        """
        return replace(state, disparity=state.disparity + self.shift(state.u, state.v, DEVICE, DeviceParameters(self)))

    def mean(self, at: Any) -> FloatArray:
        """Return the shift (n,), px, of the disparity in the tile in which each pixel lies.

        at: geometry of n matched pixels of the stereo pair, as NumPy arrays.
        """
        return np.asarray(self.shift(at.u, at.v, HOST, self))
