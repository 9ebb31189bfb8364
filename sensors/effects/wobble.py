"""Standing axis that wobbles as the scanner turns."""

from __future__ import annotations

import math
from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.device import opaque
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class Wobble(Effect):
    """dz = a sin(2 pi line / n + phase), line the scan line's number from the scan's first, one step in azimuth each."""

    name: Literal["wobble"] = "wobble"
    sensor = "tls"
    stage = Stage.AIM
    amplitude_rad: float = parameter(
        "amplitude of the zenith error", unit="rad", source="empirical", typical=5e-5, ge=-0.1, le=0.1
    )
    lines_per_cycle: float = parameter(
        "scan lines in one cycle", unit="lines", source="empirical", null=None, default=100.0, ge=1e-3, le=1e9
    )
    phase_rad: float = parameter(
        "phase at the first line", unit="rad", source="empirical", null=None, default=0.0, ge=-100, le=100
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        amplitude, wave, phase = opaque(self.amplitude_rad, 2 * math.pi / self.lines_per_cycle, self.phase_rad)
        return state.with_angle_error(zenith=amplitude * dr.sin(wave * mi.Float64(state.line) + phase))
