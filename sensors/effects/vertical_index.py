"""Zero error of the vertical circle."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class VerticalIndex(Effect):
    """dz = offset, the same in both faces: the recorded zenith angle is too large by it (Lichti 2007, C0; NIST x4)."""

    name: Literal["vertical_index"] = "vertical_index"
    sensor = "tls"
    stage = Stage.AIM
    offset_rad: float = parameter(
        "recorded minus true zenith", unit="rad", source="Lichti 2007, C0", typical=1e-4, ge=-0.1, le=0.1
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        return state.with_angle_error(zenith=dr.opaque(mi.Float64, self.offset_rad))
