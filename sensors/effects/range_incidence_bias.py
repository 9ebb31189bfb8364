"""Range error that grows with the incidence angle."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class RangeIncidenceBias(Effect):
    """dR = k (1 / cos i - 1): the stretched echo of a slanting surface is timed late, or early (TLS against tracker)."""

    name: Literal["range_incidence_bias"] = "range_incidence_bias"
    sensor = "tls"
    stage = Stage.RANGE
    coefficient_m: float = parameter(
        "range error at 60 degrees of incidence", unit="m", source="TLS against laser tracker", typical=0.001, ge=-10, le=10
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        slant = 1 / mi.Float64(state.cos_incidence) - 1
        return state.with_range_error(dr.opaque(mi.Float64, self.coefficient_m) * slant)
