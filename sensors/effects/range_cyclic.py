"""Range error that repeats with the range."""

from __future__ import annotations

import math
from typing import Literal

from scene.backend import dr
from scene.keyed_random import KeyedRandom
from sensors.device import opaque
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class RangeCyclic(Effect):
    """dR = A sin(2 pi R / period + phase): crosstalk in the phase measurement (Lichti 2007, A3 and A4)."""

    name: Literal["range_cyclic"] = "range_cyclic"
    sensor = "tls"
    stage = Stage.RANGE
    amplitude_m: float = parameter(
        "amplitude of the range error", unit="m", source="Lichti 2007, A3, A4", typical=0.001, ge=-10, le=10
    )
    period_m: float = parameter(
        "range after which the error repeats", unit="m", source="Lichti 2007", null=None, default=1.2, ge=0.001, le=1e4
    )
    phase_rad: float = parameter("phase at range 0", unit="rad", source="Lichti 2007", null=None, default=0.0, ge=-100, le=100)

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        amplitude, wave, phase = opaque(self.amplitude_m, 2 * math.pi / self.period_m, self.phase_rad)
        return state.with_range_error(amplitude * dr.sin(wave * state.true_range + phase))
