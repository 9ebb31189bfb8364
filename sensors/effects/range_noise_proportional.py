"""Range noise that grows with the range."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import RangeSpread
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class RangeNoiseProportional(RangeSpread):
    """Range noise grows with the range.

    The error dR ~ N(0, ppm 1e-6 R), with the range R, is independent for each pulse. It is the second figure of data sheets
    that state "1 mm + 10 ppm".
    """

    name: Literal["range_noise_proportional"] = "range_noise_proportional"
    means = "Ranges scatter more the farther the rock: less light returns, or the air is unsteady."
    act = "Simulate and plan with the value found; move nearer, or average several scans."
    told_by = "the same rock from another range"
    ppm: float = parameter("standard deviation per range", unit="ppm", source="datasheets", typical=20.0, ge=0, le=1e5)

    def sigma(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return the standard deviation of the range (n,), m, in proportion to the range.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.ppm * 1e-6 * at.range_m
