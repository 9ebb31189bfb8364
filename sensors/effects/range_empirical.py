"""An error of the range that no effect of the catalogue explains, as a curve of what it was seen to depend on."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.curve import curve
from sensors.device import bounded
from sensors.effects.base import Effect, Stage
from sensors.pulses import Pulses


class RangeEmpirical(Effect):
    """dR = c(x), c linear between values at even distances from low to high: empirical, found by `scarpsim gap`; not in the
    shared catalogue.

    x: range (m), azimuth, zenith or incidence (rad), the logarithm of the received power, or the share of the scan's duration.
    """

    name: Literal["range_empirical"] = "range_empirical"
    sensor = "tls"
    stage = Stage.RANGE
    covariate: Literal["range", "azimuth", "zenith", "incidence", "intensity", "time"] = Field("range", description="x")
    low: float = Field(0.0, description="x of the first value, in its unit; held below")
    high: float = Field(1.0, description="x of the last value, in its unit; held above")
    period: float = Field(0.0, ge=0, description="of x, which then counts modulo it; 0: none")
    values_m: tuple[float, ...] = Field((0.0, 0.0), min_length=2, max_length=1025, description="c from low to high [m]")

    @property
    def is_null(self) -> bool:
        return not any(self.values_m)

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        return state.with_range_error(curve(self._covariate(state), self.low, self.high, self.values_m, self.period))

    def _covariate(self, pulses: Pulses) -> mi.Float64:
        match self.covariate:
            case "range":
                return pulses.true_range
            case "azimuth":
                return pulses.azimuth
            case "zenith":
                return pulses.zenith
            case "incidence":
                return dr.acos(bounded(mi.Float64(pulses.cos_incidence), 0.0, 1.0))
            case "intensity":
                return dr.log(mi.Float64(pulses.power))
        return pulses.share
