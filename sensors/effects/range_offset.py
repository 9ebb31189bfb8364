"""Constant range error."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import RangeEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class RangeOffset(RangeEffect):
    """Every range is wrong by the same length, the rangefinder's zero error: dR = offset (Lichti 2007, A0; NIST x10)."""

    name: Literal["range_offset"] = "range_offset"
    means = (
        "Every range is too long or too short by the same length: an additive constant of the instrument or of its calibration."
    )
    act = (
        "Subtract the value from the ranges, or have the instrument checked by its maker. Between epochs of the same "
        "scanner at one place it cancels."
    )
    offset_m: float = parameter("recorded minus true range", unit="m", source="Lichti 2007, A0", typical=0.003, ge=-100, le=100)

    def error(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return the range error, m, the same for all pulses.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.offset_m
