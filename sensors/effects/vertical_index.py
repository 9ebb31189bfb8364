"""Zero error of the vertical circle."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import AimEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class VerticalIndex(AimEffect):
    """All zenith angles are too large by the same angle, in both faces: dz = offset (Lichti 2007, C0; NIST x4).

    The faces are the two positions of the telescope or mirror in which a scanner can aim at a point.
    """

    name: Literal["vertical_index"] = "vertical_index"
    means = "All zenith angles are off by one angle: the vertical circle's zero."
    act = "Run the instrument's own index check; measuring in two faces and taking the mean cancels it."
    offset_rad: float = parameter(
        "recorded minus true zenith", unit="rad", source="Lichti 2007, C0", typical=1e-4, ge=-0.1, le=0.1
    )

    def angles(self, at: PulseGeometry, m: Functions, p: Any) -> tuple[Any, Any]:
        """Return recorded minus true azimuth, which is zero, and zenith, a constant; rad.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return 0.0, p.offset_rad
