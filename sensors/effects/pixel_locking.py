"""Sub-pixel estimates drawn towards whole pixels."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from scene.backend import dr
from scene.keyed_random import KeyedRandom
from sensors.device import opaque
from sensors.effects.base import Effect, Stage, parameter
from sensors.matches import Matches


class PixelLocking(Effect):
    """dd = A sin(2 pi frac(d / n)), d the disparity that the matcher finds, n the reduction of the image that it matches.

    n (2, 4, 8 for high, medium, low) makes d / n count the matched image's pixels. Semi-global matching has A of about 0.2 to
    0.25 px of the matched image, thus n times that here (Shimizu & Okutomi 2005). Acts last, on noise and all.
    """

    name: Literal["pixel_locking"] = "pixel_locking"
    sensor = "stereo"
    stage = Stage.MATCH
    order = 60
    amplitude_px: float = parameter(
        "largest change of the disparity", unit="px", source="Shimizu & Okutomi 2005", typical=0.8, ge=-100, le=100
    )

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        amplitude, reduction = opaque(self.amplitude_px, state.reduction)
        matched = state.disparity / reduction
        wave = dr.sin(2 * np.pi * (matched - dr.floor(matched)))
        return replace(state, disparity=state.disparity + amplitude * wave)
