"""Range noise that falls with the received power."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.device import opaque
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class RangeNoiseIntensity(Effect):
    """dR ~ N(0, a I^exponent) per pulse, I the received power (Wujanz et al. 2017; Schmitz et al. 2019).

    The exponent is about -0.5 where photons are counted (shot noise), -1 where the receiver's noise dominates (thermal).
    """

    name: Literal["range_noise_intensity"] = "range_noise_intensity"
    sensor = "tls"
    stage = Stage.RANGE
    a_m: float = parameter(
        "standard deviation at power 1 (albedo 1, squarely hit, 100 m)",
        unit="m",
        source="Wujanz et al. 2017",
        typical=0.001,
        ge=0,
        le=10,
    )
    exponent: float = parameter(
        "exponent of the power", unit="1", source="Wujanz et al. 2017", null=None, default=-0.5, ge=-4, le=4
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        amplitude, exponent = opaque(self.a_m, self.exponent)
        sigma = amplitude * dr.power(mi.Float64(state.power), exponent)
        return state.with_range_error(sigma * mi.Float64(state.normals(random).x))
