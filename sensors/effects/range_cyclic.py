"""Range error that repeats with the range."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from scene.geometry.mesh import FloatArray
from sensors.effects.base import Search, parameter
from sensors.effects.laser import RangeEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class RangeCyclic(RangeEffect):
    """The range error repeats with the range, from crosstalk in the phase measurement.

    dR = A sin(2 pi R / period + phase), with the amplitude A and the range R (Lichti 2007, A3 and A4).
    """

    name: Literal["range_cyclic"] = "range_cyclic"
    means = "The range error repeats with the range: crosstalk in a phase-shift instrument, at a fraction of its wavelength."
    act = (
        "Correct the ranges by the wave that was found; a constant wave is a matter for calibration: have the "
        "instrument checked by its maker."
    )
    searched = Search("period_m", along="range", shortest=0.3, longest=15.0)
    amplitude_m: float = parameter(
        "amplitude of the range error", unit="m", source="Lichti 2007, A3, A4", typical=0.001, ge=-10, le=10
    )
    period_m: float = parameter(
        "range after which the error repeats", unit="m", source="Lichti 2007", null=None, default=1.2, ge=0.001, le=1e4
    )
    phase_rad: float = parameter("phase at range 0", unit="rad", source="Lichti 2007", null=None, default=0.0, ge=-100, le=100)

    def error(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return the range error (n,), m, a sine of the range.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.amplitude_m * m.sin(2 * math.pi * at.range_m / p.period_m + p.phase_rad)

    def argument(self, at: PulseGeometry) -> FloatArray:
        """Return the range (n,), m: the quantity along which the error repeats as a sine.

        at: geometry of n pulses, as NumPy arrays.
        """
        return np.asarray(at.range_m, dtype=np.float64)
