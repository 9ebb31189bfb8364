"""Trunnion axis not at right angles to the standing axis."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class TrunnionTilt(Effect):
    """daz = t cot z, to first order in t (Lichti 2007, B7; NIST x7); z beyond pi, the second face, turns the sign.

    Fails towards the zenith, where an azimuth has no meaning.
    """

    name: Literal["trunnion_tilt"] = "trunnion_tilt"
    sensor = "tls"
    stage = Stage.AIM
    angle_rad: float = parameter(
        "recorded minus true azimuth at a zenith angle of 45 degrees",
        unit="rad",
        source="Lichti 2007, B7",
        typical=1e-4,
        ge=-0.1,
        le=0.1,
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        sine, cosine = dr.sincos(state.zenith)
        return state.with_angle_error(azimuth=dr.opaque(mi.Float64, self.angle_rad) * cosine / sine)
