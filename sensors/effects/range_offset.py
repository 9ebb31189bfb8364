"""Constant range error."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class RangeOffset(Effect):
    """dR = offset: the rangefinder's zero point (Lichti 2007, A0; NIST x10)."""

    name: Literal["range_offset"] = "range_offset"
    sensor = "tls"
    stage = Stage.RANGE
    offset_m: float = parameter("recorded minus true range", unit="m", source="Lichti 2007, A0", typical=0.003, ge=-100, le=100)

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        return state.with_range_error(dr.opaque(mi.Float64, self.offset_m))
