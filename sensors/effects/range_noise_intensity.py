"""Range noise that decreases with the received power."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import RangeSpread
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class RangeNoiseIntensity(RangeSpread):
    """Range noise decreases with the received power I: the error dR ~ N(0, a I^exponent) is independent for each pulse.

    The exponent is about -0.5 where photon counts dominate (shot noise) and -1 where the receiver's noise dominates (thermal)
    (Wujanz et al. 2017; Schmitz et al. 2019).
    """

    name: Literal["range_noise_intensity"] = "range_noise_intensity"
    means = "Ranges scatter more where little light returns: dark or wet rock."
    act = (
        "Simulate and plan with the value found; scan dry rock, nearer, or at a lower pulse rate, which gives each "
        "pulse more energy."
    )
    told_by = "rock of another reflectance at the same range"
    needs = ("power",)
    trials = ("exponent", (-0.5, -0.75, -1.0))
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

    def sigma(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return the standard deviation of the range of each of n pulses, (n,), m.

        It is proportional to a power of the received power.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.a_m * at.power**p.exponent
