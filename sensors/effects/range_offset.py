"""Constant range error."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import RangeEffect
from sensors.functions import Functions
from sensors.pulses import PulseGeometry


class RangeOffset(RangeEffect):
    """dR = offset: the rangefinder's zero point (Lichti 2007, A0; NIST x10)."""

    name: Literal["range_offset"] = "range_offset"
    offset_m: float = parameter("recorded minus true range", unit="m", source="Lichti 2007, A0", typical=0.003, ge=-100, le=100)

    def error(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        return p.offset_m
