"""Standing axis that wobbles as the scanner rotates."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from scene.geometry.mesh import FloatArray
from sensors.effects.base import Search, parameter
from sensors.effects.laser import AimEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class Wobble(AimEffect):
    """The standing axis wobbles as the scanner rotates, which tilts whole scan lines by a wave.

    dz = a sin(2 pi line / n + phase), with the amplitude a and n lines in a cycle. There is one line for each azimuth step.
    """

    name: Literal["wobble"] = "wobble"
    means = "The standing axis wobbles as the scanner turns: whole scan lines are tilted by a wave."
    act = "Check bearings, tribrach and tripod; if it stays, have the instrument checked by its maker."
    needs = ("line",)
    searched = Search("lines_per_cycle", along="line", shortest=4.0, cycles=2.0)
    amplitude_rad: float = parameter(
        "amplitude of the zenith error", unit="rad", source="empirical", typical=5e-5, ge=-0.1, le=0.1
    )
    lines_per_cycle: float = parameter(
        "scan lines in one cycle", unit="lines", source="empirical", null=None, default=100.0, ge=1e-3, le=1e9
    )
    phase_rad: float = parameter(
        "phase at the first line", unit="rad", source="empirical", null=None, default=0.0, ge=-100, le=100
    )

    def angles(self, at: PulseGeometry, m: Functions, p: Any) -> tuple[Any, Any]:
        """Return recorded minus true azimuth, which is zero, and zenith, a sine of the scan line; rad.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return 0.0, p.amplitude_rad * m.sin(2 * math.pi * at.line / p.lines_per_cycle + p.phase_rad)

    def argument(self, at: PulseGeometry) -> FloatArray:
        """Return the number of the scan line (n,): the quantity along which the error repeats as a sine.

        at: geometry of n pulses, as NumPy arrays.
        """
        return np.asarray(at.line, dtype=np.float64)
