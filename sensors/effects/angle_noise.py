"""Random pointing errors of the beam."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class AngleNoise(Effect):
    """The ray leaves in another direction than is recorded: white noise on azimuth and zenith.

    aim = nominal - n, n ~ N(0, sigma) for each angle and pulse.
    """

    name: Literal["angle_noise"] = "angle_noise"
    sensor = "tls"
    stage = Stage.AIM
    azimuth_sigma_rad: float = parameter("standard deviation in azimuth", unit="rad", source="datasheets", ge=0, le=0.1)
    zenith_sigma_rad: float = parameter("standard deviation in zenith", unit="rad", source="datasheets", ge=0, le=0.1)

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        noise = random.normals(state.index)
        azimuth_sigma, zenith_sigma = (dr.opaque(mi.Float64, sigma) for sigma in (self.azimuth_sigma_rad, self.zenith_sigma_rad))
        return replace(
            state,
            aim_azimuth=state.aim_azimuth - azimuth_sigma * mi.Float64(noise.x),
            aim_zenith=state.aim_zenith - zenith_sigma * mi.Float64(noise.y),
        )
