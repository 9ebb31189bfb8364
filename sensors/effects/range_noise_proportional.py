"""Range noise that grows with the range."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class RangeNoiseProportional(Effect):
    """dR ~ N(0, ppm R 1e-6) per pulse, the second figure of a datasheet's "1 mm + 10 ppm"."""

    name: Literal["range_noise_proportional"] = "range_noise_proportional"
    sensor = "tls"
    stage = Stage.RANGE
    ppm: float = parameter("standard deviation per range", unit="ppm", source="datasheets", typical=20.0, ge=0, le=1e5)

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        sigma = dr.opaque(mi.Float64, self.ppm * 1e-6) * state.true_range
        return state.with_range_error(sigma * mi.Float64(state.normals(random).x))
