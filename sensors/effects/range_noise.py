"""White range noise."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class RangeNoise(Effect):
    """dR ~ N(0, sigma) per pulse; several sources of noise add in quadrature."""

    name: Literal["range_noise"] = "range_noise"
    sensor = "tls"
    stage = Stage.RANGE
    sigma_m: float = parameter("standard deviation of the range", unit="m", source="datasheets", typical=0.003, ge=0, le=10)

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        return state.with_range_error(dr.opaque(mi.Float64, self.sigma_m) * mi.Float64(state.normals(random).x))
