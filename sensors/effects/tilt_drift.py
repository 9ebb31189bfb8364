"""Tilt of the scanner that changes during the scan."""

from __future__ import annotations

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import AimEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry


class TiltDrift(AimEffect):
    """The scanner tilts during the scan, so that directions are rotated by angles that grow from 0 to the given rates.

    w = s (rate_x, rate_y, 0) is the rotation vector, with s the elapsed share of the scan's duration. The rotations are
    right-handed about the scanner's axes. A direction u is recorded as u + w x u, that is daz = -cot z (w_x cos az + w_y sin
    az) and dz = w_y cos az - w_x sin az. The scanner itself tilts by -w. The equations are of first order in the angles: for a
    tilt of 60 arcsec their error is below 0.01 mm at 100 m.
    """

    name: Literal["tilt_drift"] = "tilt_drift"
    means = "The scanner leaned over during the scan: the tripod settled, or the sun warmed one of its legs."
    act = "Set it on rock or concrete, let it settle, shade it, keep the compensator on, and scan in less time."
    needs = ("share",)
    rate_x_rad: float = parameter(
        "turn about the scanner's x axis over the scan",
        unit="rad per scan",
        source="set-ups without compensator",
        typical=1e-4,
        ge=-0.1,
        le=0.1,
    )
    rate_y_rad: float = parameter(
        "turn about the scanner's y axis over the scan",
        unit="rad per scan",
        source="set-ups without compensator",
        typical=1e-4,
        ge=-0.1,
        le=0.1,
    )

    def angles(self, at: PulseGeometry, m: Functions, p: Any) -> tuple[Any, Any]:
        """Return recorded minus true azimuth and zenith, rad, which grow with the elapsed share of the scan.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        turn_x, turn_y = p.rate_x_rad * at.share, p.rate_y_rad * at.share
        sin_azimuth, cos_azimuth = m.sin(at.azimuth), m.cos(at.azimuth)
        azimuth = -m.cos(at.zenith) / m.sin(at.zenith) * (turn_x * cos_azimuth + turn_y * sin_azimuth)
        return azimuth, turn_y * cos_azimuth - turn_x * sin_azimuth
