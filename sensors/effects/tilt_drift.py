"""Tilt of the scanner that changes during the scan."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr
from scene.keyed_random import KeyedRandom
from sensors.device import opaque
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class TiltDrift(Effect):
    """Recorded directions are the true ones turned about the scanner's x and y axes by angles that grow from 0 to the rates.

    With w = s (rate_x, rate_y, 0), s the share of the scan's duration that has passed, and right-handed rotations:
    recorded - true = w x u, that is daz = -cot z (w_x cos az + w_y sin az) and dz = w_y cos az - w_x sin az. The scanner itself
    then tilts by -w. First order in the angles: 60 arcsec leave less than 0.01 mm at 100 m.
    """

    name: Literal["tilt_drift"] = "tilt_drift"
    sensor = "tls"
    stage = Stage.AIM
    rate_x_rad: float = parameter(
        "turn about the scanner's x axis over the scan",
        unit="rad per scan",
        source="set-ups without compensator",
        typical=1e-4,
        ge=-0.1,
        le=0.1,
    )
    rate_y_rad: float = parameter(
        "turn about the scanner's y axis over the scan",
        unit="rad per scan",
        source="set-ups without compensator",
        typical=1e-4,
        ge=-0.1,
        le=0.1,
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        turn_x, turn_y = (rate * state.share for rate in opaque(self.rate_x_rad, self.rate_y_rad))
        sin_azimuth, cos_azimuth = dr.sincos(state.azimuth)
        sin_zenith, cos_zenith = dr.sincos(state.zenith)
        return state.with_angle_error(
            azimuth=-cos_zenith / sin_zenith * (turn_x * cos_azimuth + turn_y * sin_azimuth),
            zenith=turn_y * cos_azimuth - turn_x * sin_azimuth,
        )
