"""Line of sight not perpendicular to the trunnion axis."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import AimEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class Collimation(AimEffect):
    """The line of sight is not perpendicular to the trunnion axis, which makes the azimuth wrong.

    daz = c / sin z, to first order in the angle c (Lichti 2007, B6). A zenith angle z beyond pi (second face) reverses the
    sign. Not valid towards the zenith, where an azimuth has no meaning.
    """

    name: Literal["collimation"] = "collimation"
    means = "The line of sight is not at right angles to the trunnion axis."
    act = "Run the instrument's own check; measuring in two faces and taking the mean cancels it."
    angle_rad: float = parameter(
        "recorded minus true azimuth at the horizon", unit="rad", source="Lichti 2007, B6", typical=1e-4, ge=-0.1, le=0.1
    )

    def angles(self, at: PulseGeometry, m: Functions, p: Any) -> tuple[Any, Any]:
        """Return recorded minus true azimuth and zenith, rad: the collimation error over sin(zenith), and zero.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.angle_rad / m.sin(at.zenith), 0.0
