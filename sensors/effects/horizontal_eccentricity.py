"""Horizontal circle not centred on its axis."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import AimEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class HorizontalEccentricity(AimEffect):
    """The horizontal circle is not centred on its axis, which gives an azimuth error that repeats once per turn.

    daz = a sin(az + phase), with the amplitude a (Lichti 2007, B2 and B3).
    """

    name: Literal["horizontal_eccentricity"] = "horizontal_eccentricity"
    means = "The horizontal circle is not centred on its axis: azimuths are off by a wave that repeats with the turn."
    act = "Compare only scans with the same zero direction, and have the instrument checked by its maker."
    amplitude_rad: float = parameter(
        "amplitude of the azimuth error", unit="rad", source="Lichti 2007, B2, B3", typical=1e-4, ge=-0.1, le=0.1
    )
    phase_rad: float = parameter(
        "phase at azimuth 0", unit="rad", source="Lichti 2007, B2, B3", null=None, default=0.0, ge=-100, le=100
    )

    def angles(self, at: PulseGeometry, m: Functions, p: Any) -> tuple[Any, Any]:
        """Return recorded minus true azimuth, a sine of the azimuth, and zenith, which is zero; rad.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.amplitude_rad * m.sin(at.azimuth + p.phase_rad), 0.0
