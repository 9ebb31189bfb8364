"""An error of the range that no effect of the catalogue explains, as a polynomial of what it was seen to depend on."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.device import bounded, opaque
from sensors.effects.base import Effect, Stage
from sensors.pulses import Pulses

LARGEST = 4.0
"""The covariate is held at this many scales from its centre, so that the polynomial does not run away."""


class RangeEmpirical(Effect):
    """dR = sum_k c_k t^k, t = (x - centre) / scale, k from 1: empirical, found by `scarpsim gap`; not in the shared catalogue.

    x: range (m), azimuth, zenith or incidence (rad), the logarithm of the received power, or the share of the scan's duration.
    """

    name: Literal["range_empirical"] = "range_empirical"
    sensor = "tls"
    stage = Stage.RANGE
    covariate: Literal["range", "azimuth", "zenith", "incidence", "intensity", "time"] = Field("range", description="x")
    centre: float = Field(0.0, description="of x, in its unit")
    scale: float = Field(1.0, gt=0, description="of x, in its unit")
    coefficients_m: tuple[float, ...] = Field((), max_length=6, description="of t, t^2, ... [m]")

    @property
    def is_null(self) -> bool:
        return not any(self.coefficients_m)

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        centre, scale = opaque(self.centre, self.scale)
        t = bounded((self._covariate(state) - centre) / scale, -LARGEST, LARGEST)
        total = mi.Float64(0.0)
        for coefficient in reversed(opaque(*self.coefficients_m)):
            total = t * (coefficient + total)
        return state.with_range_error(total)

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
