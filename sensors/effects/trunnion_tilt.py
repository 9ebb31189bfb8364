"""Trunnion axis not perpendicular to the standing axis."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import AimEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class TrunnionTilt(AimEffect):
    """The trunnion axis is not perpendicular to the standing axis, which makes the azimuth wrong in proportion to cot z.

    daz = t cot z, to first order in the angle t (Lichti 2007, B7; NIST x7). A zenith angle z beyond pi (second face) reverses
    the sign. Not valid towards the zenith, where an azimuth has no meaning.
    """

    name: Literal["trunnion_tilt"] = "trunnion_tilt"
    means = "The trunnion axis is not at right angles to the standing axis: directions are off in proportion to the height."
    act = "Run the instrument's own check; measuring in two faces and taking the mean cancels it."
    angle_rad: float = parameter(
        "recorded minus true azimuth at a zenith angle of 45 degrees",
        unit="rad",
        source="Lichti 2007, B7",
        typical=1e-4,
        ge=-0.1,
        le=0.1,
    )

    def angles(self, at: PulseGeometry, m: Functions, p: Any) -> tuple[Any, Any]:
        """Return recorded minus true azimuth and zenith, rad: the tilt times cot(zenith), and zero.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.angle_rad * m.cos(at.zenith) / m.sin(at.zenith), 0.0
