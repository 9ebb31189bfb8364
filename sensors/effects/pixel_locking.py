"""Sub-pixel estimates drawn towards whole pixels."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from scene.backend import dr
from scene.keyed_random import KeyedRandom
from sensors.device import opaque
from sensors.effects.base import Effect, Stage, parameter
from sensors.matches import Matches


class PixelLocking(Effect):
    """dd = A sin(2 pi d / n + phase), d the disparity that the matcher finds, n the reduction of the image that it matches.

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

    period_px: float | None = Field(
        None, gt=0, description="n, where another rectification's pixels are not those of this one [px]; null: the reduction"
    )
    phase_rad: float = Field(0.0, description="where another rectification's columns count from elsewhere [rad]")

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        amplitude, period, phase = opaque(self.amplitude_px, self.period_px or state.reduction, self.phase_rad)
        matched = state.disparity / period
        wave = dr.sin(2 * np.pi * (matched - dr.floor(matched)) + phase)
        return replace(state, disparity=state.disparity + amplitude * wave)
