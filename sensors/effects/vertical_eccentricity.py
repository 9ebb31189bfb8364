"""Vertical circle not centred on its axis."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import AimEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class VerticalEccentricity(AimEffect):
    """The vertical circle is not centred on its axis, which gives a zenith error that repeats once per turn.

    dz = a sin(z + phase), with the amplitude a (Lichti 2007, C2).
    """

    name: Literal["vertical_eccentricity"] = "vertical_eccentricity"
    means = "The vertical circle is not centred on its axis: zenith angles are off by a wave."
    act = "Measuring in two faces and taking the mean cancels it; else have the instrument checked by its maker."
    amplitude_rad: float = parameter(
        "amplitude of the zenith error", unit="rad", source="Lichti 2007, C2", typical=1e-4, ge=-0.1, le=0.1
    )
    phase_rad: float = parameter(
        "phase at zenith 0", unit="rad", source="Lichti 2007, C2", null=None, default=0.0, ge=-100, le=100
    )

    def angles(self, at: PulseGeometry, m: Functions, p: Any) -> tuple[Any, Any]:
        """Return recorded minus true azimuth, which is zero, and zenith, a sine of the zenith; rad.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return 0.0, p.amplitude_rad * m.sin(at.zenith + p.phase_rad)
