"""Line of sight not at right angles to the trunnion axis."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class Collimation(Effect):
    """daz = c / sin z, to first order in c (Lichti 2007, B6); z beyond pi, the second face, turns the sign.

    Fails towards the zenith, where an azimuth has no meaning.
    """

    name: Literal["collimation"] = "collimation"
    sensor = "tls"
    stage = Stage.AIM
    angle_rad: float = parameter(
        "recorded minus true azimuth at the horizon", unit="rad", source="Lichti 2007, B6", typical=1e-4, ge=-0.1, le=0.1
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        return state.with_angle_error(azimuth=dr.opaque(mi.Float64, self.angle_rad) / dr.sin(state.zenith))
