"""Rows of an image displaced sideways, by a rolling shutter or vibration."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from scene.backend import dr
from scene.keyed_random import KeyedRandom
from sensors.camera import Side
from sensors.device import opaque
from sensors.effects.base import Effect, Stage, parameter
from sensors.matches import ImageRows


class RowJitter(Effect):
    """dx = A sin(2 pi row / n + phase): the recorded column of a pixel minus its ideal one; row = v, px from the frame's top.

    In the left image it changes the disparity by +dx and makes each pixel look dx px to the left of where it belongs; in the
    right image it changes the disparity by -dx at the right image's row. Two cameras that shake alike (`both`) therefore keep
    the depth but for the difference of the rows that a point has in the two images.
    """

    name: Literal["row_jitter"] = "row_jitter"
    sensor = "stereo"
    stage = Stage.EXPOSE
    camera: Side = "left"
    amplitude_px: float = parameter("largest displacement", unit="px", source="empirical", typical=0.5, ge=0, le=100)
    rows_per_cycle: float = parameter("rows per cycle", unit="px", source="empirical", null=None, default=1000.0, gt=0)
    phase_rad: float = parameter("phase at the frame's top", unit="rad", source="empirical", null=None, default=0.0)

    def evaluate(self, state: ImageRows, random: KeyedRandom) -> ImageRows:
        if self.camera not in (state.camera, "both"):
            return state
        amplitude, frequency, phase = opaque(self.amplitude_px, 2 * np.pi / self.rows_per_cycle, self.phase_rad)
        return replace(state, du=state.du + amplitude * dr.sin(frequency * state.v + phase))
