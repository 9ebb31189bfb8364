"""Range noise that grows with the incidence angle."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import RangeSpread
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry, slant


class RangeNoiseIncidence(RangeSpread):
    """Range noise grows with the incidence angle.

    dR ~ N(0, sigma (1 / cos i - 1)), with the incidence angle i, independent for each pulse (Soudarissanane et al. 2011). The
    factor of sigma is 0 at normal incidence and 1 at 60 degrees.
    """

    name: Literal["range_noise_incidence"] = "range_noise_incidence"
    means = "Ranges scatter more on slanting rock."
    act = "Simulate and plan with the value found; give slanting parts a station that faces them."
    told_by = "the same rock at another angle of incidence"
    sigma_m: float = parameter(
        "standard deviation at 60 degrees of incidence", unit="m", source="Soudarissanane et al. 2011", typical=0.002, ge=0, le=10
    )

    def sigma(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return the standard deviation of the range (n,), m, in proportion to 1 / cos i - 1.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.sigma_m * slant(at.cos_incidence, m)
