"""Range error in proportion to the range."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import RangeEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class RangeScale(RangeEffect):
    """Ranges R are wrong in proportion to their length: dR = scale 1e-6 R.

    Causes are the instrument's scale, and air temperature and pressure (about +1 ppm/K, -0.28 ppm/hPa; Lichti 2007, A1).
    """

    name: Literal["range_scale"] = "range_scale"
    means = (
        "Ranges are wrong in proportion to their length: the clock, or air of another temperature and pressure than was assumed."
    )
    act = (
        "Enter the temperature and pressure of the day in the scanner's software (1 ppm is about 1 K or 3 hPa); if it "
        "stays, have the instrument checked by its maker."
    )
    scale_ppm: float = parameter(
        "recorded over true range, less one", unit="ppm", source="Lichti 2007, A1", typical=20.0, ge=-1e5, le=1e5
    )

    def error(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return the range error (n,), m, in proportion to the range.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.scale_ppm * 1e-6 * at.range_m
