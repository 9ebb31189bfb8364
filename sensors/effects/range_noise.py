"""White range noise."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import RangeSpread
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class RangeNoise(RangeSpread):
    """Ranges have white noise: the error dR ~ N(0, sigma) is independent for each pulse. Sources of noise add in quadrature."""

    name: Literal["range_noise"] = "range_noise"
    means = "Ranges scatter more than the model says, everywhere alike."
    act = "Simulate and plan with the value found; a slower scan or more averaging lowers it. Heat shimmer, too, looks like this."
    sigma_m: float = parameter("standard deviation of the range", unit="m", source="datasheets", typical=0.003, ge=0, le=10)

    def sigma(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return the standard deviation of the range, m, the same for all pulses.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.sigma_m
