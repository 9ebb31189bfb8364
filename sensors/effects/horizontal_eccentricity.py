"""Horizontal circle not centred on its axis."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr
from scene.keyed_random import KeyedRandom
from sensors.device import opaque
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class HorizontalEccentricity(Effect):
    """daz = a sin(az + phase), once per turn (Lichti 2007, B2 and B3)."""

    name: Literal["horizontal_eccentricity"] = "horizontal_eccentricity"
    sensor = "tls"
    stage = Stage.AIM
    amplitude_rad: float = parameter(
        "amplitude of the azimuth error", unit="rad", source="Lichti 2007, B2, B3", typical=1e-4, ge=-0.1, le=0.1
    )
    phase_rad: float = parameter(
        "phase at azimuth 0", unit="rad", source="Lichti 2007, B2, B3", null=None, default=0.0, ge=-100, le=100
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        amplitude, phase = opaque(self.amplitude_rad, self.phase_rad)
        return state.with_angle_error(azimuth=amplitude * dr.sin(state.azimuth + phase))
