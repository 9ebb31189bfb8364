"""Image rows displaced sideways, by a rolling shutter or vibration."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Side
from sensors.effects.base import Effect, Search, ShowsIn, Stage, parameter
from sensors.numerics.functions import DEVICE, HOST, DeviceParameters, Functions
from sensors.signal_chain.matches import ImageRows


class RowJitter(Effect):
    """Image rows are displaced sideways by a wave, as by a rolling shutter or vibration during the exposure.

    dx = A sin(2 pi v / n + phase) is the recorded minus the ideal column of a pixel in row v, with the amplitude A; the wave
    repeats after n rows. In the left image this changes the disparity by +dx, and each pixel sees what lies dx px to the left.
    In the right image it changes the disparity by -dx at the right image's row. If both cameras shake alike (`both`), the two
    changes cancel where a point has the same row in both images. Where its rows differ, the difference of the two displacements
    remains.
    """

    name: Literal["row_jitter"] = "row_jitter"
    means = "Rows of a picture are displaced sideways: a rolling shutter, or vibration during the exposure."
    act = "Use a mechanical or global shutter, a shorter exposure and a firm stand."
    sensor = "stereo"
    stage = Stage.EXPOSE
    shows_in = ShowsIn.MEAN
    searched = Search("rows_per_cycle", along="image_y", shortest=20.0, cycles=0.7)
    camera: Side = "left"
    amplitude_px: float = parameter("largest displacement", unit="px", source="empirical", typical=0.5, ge=0, le=100)
    rows_per_cycle: float = parameter("rows per cycle", unit="px", source="empirical", null=None, default=1000.0, gt=0)
    phase_rad: float = parameter("phase at the frame's top", unit="rad", source="empirical", null=None, default=0.0)

    def shift(self, row: Any, m: Functions, p: Any) -> Any:
        """Return by how far image rows are displaced sideways, (n,), px: recorded minus ideal column, a sine of the row.

        row: (n,) px from the top of the frame. m: elementary functions (sine, logarithm and so on) for its array, `HOST` for
        NumPy or `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.amplitude_px * m.sin(2 * math.pi * row / p.rows_per_cycle + p.phase_rad)

    def evaluate(self, state: ImageRows, random: KeyedRandom) -> ImageRows:
        """Return the pixels with their columns displaced, px, by the wave at their row, if this effect is on their camera.

        state: pixels of one camera's image before this effect. `random` is not used.
        """
        if self.camera not in (state.camera, "both"):
            return state
        return replace(state, du=state.du + self.shift(state.v, DEVICE, DeviceParameters(self)))

    def mean(self, at: Any) -> FloatArray:
        """Return the change of the disparity (n,), px: the left image's displacement minus the right one's.

        at: geometry of n matched pixels of the stereo pair, as NumPy arrays.
        """
        left = self.shift(at.v, HOST, self) if self.camera != "right" else 0.0
        right = self.shift(at.v_right, HOST, self) if self.camera != "left" else 0.0
        return np.asarray(left - right)

    def argument(self, at: Any) -> FloatArray:
        """Return the image row (n,), px from the top of the frame: the quantity along which the displacement repeats as a sine.

        It is the row in the right image if only the right camera shakes, else the row in the left image. at: geometry of n
        matched pixels of the stereo pair, as NumPy arrays.
        """
        return np.asarray(at.v_right if self.camera == "right" else at.v)
