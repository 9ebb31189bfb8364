"""Vertical circle not centred on its axis."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr
from scene.keyed_random import KeyedRandom
from sensors.device import opaque
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class VerticalEccentricity(Effect):
    """dz = a sin(z + phase), once per turn (Lichti 2007, C2)."""

    name: Literal["vertical_eccentricity"] = "vertical_eccentricity"
    sensor = "tls"
    stage = Stage.AIM
    amplitude_rad: float = parameter(
        "amplitude of the zenith error", unit="rad", source="Lichti 2007, C2", typical=1e-4, ge=-0.1, le=0.1
    )
    phase_rad: float = parameter(
        "phase at zenith 0", unit="rad", source="Lichti 2007, C2", null=None, default=0.0, ge=-100, le=100
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        amplitude, phase = opaque(self.amplitude_rad, self.phase_rad)
        return state.with_angle_error(zenith=amplitude * dr.sin(state.zenith + phase))
