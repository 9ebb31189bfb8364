"""Range noise that grows with the incidence angle."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class RangeNoiseIncidence(Effect):
    """dR ~ N(0, s (1 / cos i - 1)) per pulse (Soudarissanane et al. 2011)."""

    name: Literal["range_noise_incidence"] = "range_noise_incidence"
    sensor = "tls"
    stage = Stage.RANGE
    sigma_m: float = parameter(
        "standard deviation at 60 degrees of incidence", unit="m", source="Soudarissanane et al. 2011", typical=0.002, ge=0, le=10
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        sigma = dr.opaque(mi.Float64, self.sigma_m) * (1 / mi.Float64(state.cos_incidence) - 1)
        return state.with_range_error(sigma * mi.Float64(state.normals(random).x))
