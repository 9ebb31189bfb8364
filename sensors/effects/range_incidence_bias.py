"""Range error that grows with the incidence angle."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import RangeEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry, slant


class RangeIncidenceBias(RangeEffect):
    """The range error grows with the incidence angle, because the stretched echo of an inclined surface is timed late or early.

    dR = k (1 / cos i - 1), with the coefficient k and the incidence angle i (from comparisons of scanners with laser trackers).
    """

    name: Literal["range_incidence_bias"] = "range_incidence_bias"
    means = "Ranges on slanting rock are biased: the oblique footprint stretches the echo."
    act = "Compare epochs from the same place, so that it cancels, and choose stations that face the wall."
    coefficient_m: float = parameter(
        "range error at 60 degrees of incidence", unit="m", source="TLS against laser tracker", typical=0.001, ge=-10, le=10
    )

    def error(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return the range error (n,), m, in proportion to 1 / cos i - 1.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.coefficient_m * slant(at.cos_incidence, m)
