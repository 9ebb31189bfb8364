"""Define the laser scanner's pulses as they pass along the sensor's chain."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from sensors.numerics.functions import Functions

REFERENCE_RANGE_M = 100.0
"""Received power is relative to that of a target of albedo 1 at this range, hit at normal incidence."""


_STEEPEST = 10.0
"""Upper limit of 1 / cos i (84 degrees). Published figures end at 80 degrees, and at grazing incidence the error would be
metres.
"""


def slant(cos_incidence: Any, m: Functions) -> Any:
    """Return 1 / cos i - 1 (n,), the relative stretch of the echo from an inclined surface, on which range errors depend.

    The incidence angle i is limited to 84 degrees. cos_incidence: (n,) NumPy or Dr.Jit array. m: elementary functions for it,
    `HOST` for NumPy or `DEVICE` for Dr.Jit.
    """
    return 1 / m.select(cos_incidence < 1 / _STEEPEST, 1 / _STEEPEST, cos_incidence) - 1


@dataclass(frozen=True)
class PulseGeometry:
    """The quantities that the equations of a scanner's errors use, for n pulses. None: not known.

    They are arrays (n,) of NumPy or of the ray-tracing device.

    Attributes
    ----------
    azimuth, zenith
        Recorded direction, rad.
    range_m
        True range, m.
    cos_incidence
        Cosine of the incidence angle.
    power
        Relative received power.
    line
        Number of the scan line.
    share
        Elapsed share of the scan's duration, from 0 to 1.
    by_azimuth, by_zenith
        Change of the true range with azimuth and with zenith angle of the beam, m/rad.
    """

    azimuth: Any
    zenith: Any
    range_m: Any = None
    cos_incidence: Any = None
    power: Any = None
    line: Any = None
    share: Any = None
    by_azimuth: Any = None
    by_zenith: Any = None

    def __len__(self) -> int:
        return len(self.azimuth)


@dataclass(frozen=True)
class Pulses:
    """n pulses of a scan on their way through the simulation, scanner frame; angles in rad, lengths in m.

    Arrays (n,) are lazy arrays of the ray-tracing device.

    Attributes
    ----------
    line
        Number of the scan line, from the scan's first.
    share
        Elapsed share of the scan's duration: 0 at the first pulse, 1 at the last.
    line_key, pulse_key
        Numbers of line and pulse on the instrument's own grid of steps. The pulse's random numbers depend on them, so that a
        window scanned alone gets the same numbers as within a larger scan.
    azimuth, zenith
        Nominal direction, which is the recorded one.
    aim_azimuth, aim_zenith
        Direction in which the pulse actually leaves.
    true_range
        Range of the return without any error. This and the following are None until the pulse has been traced.
    range_m
        Range recorded so far.
    cos_incidence, albedo, power, block, returned
        Cosine of the incidence angle, albedo, relative received power and block label at the hit, and whether there is a
        return.
    minimum_range
        Nearest range that the instrument records (scalar).
    """

    line: mi.UInt32
    share: mi.Float64
    line_key: mi.UInt32
    pulse_key: mi.UInt32
    azimuth: mi.Float64
    zenith: mi.Float64
    aim_azimuth: mi.Float64
    aim_zenith: mi.Float64
    true_range: mi.Float64 | None = None
    range_m: mi.Float64 | None = None
    cos_incidence: mi.Float32 | None = None
    albedo: mi.Float32 | None = None
    power: mi.Float32 | None = None
    block: mi.Int32 | None = None
    returned: mi.Bool | None = None
    minimum_range: mi.Float64 | None = None

    def normals(self, random: KeyedRandom) -> mi.Array4f:
        """Draw four independent standard normal numbers for each pulse, for noise.

        random: source of random numbers. To draw more numbers for another purpose, pass one of its children.
        """
        return random.normals(self.pulse_key, self.line_key)

    def uniforms(self, random: KeyedRandom) -> mi.Array4f:
        """Draw four independent numbers in [0, 1) for each pulse, such as to decide which returns are lost.

        random: source of random numbers. To draw more numbers for another purpose, pass one of its children.
        """
        return random.uniforms(self.pulse_key, self.line_key)

    def geometry(self) -> PulseGeometry:
        """Return the quantities that the equations of errors use, in double precision.

        Those that are known only after tracing are None before.
        """
        wide = {
            name: None if value is None else mi.Float64(value)
            for name, value in (("cos_incidence", self.cos_incidence), ("power", self.power), ("line", self.line))
        }
        return PulseGeometry(self.azimuth, self.zenith, range_m=self.true_range, share=self.share, **wide)

    def with_angle_error(self, azimuth: Any = 0.0, zenith: Any = 0.0) -> Pulses:
        """Return the pulses with a further error of the recorded direction.

        azimuth, zenith: recorded minus true angles, rad, (n,) each or a number. The recorded direction stays, so the pulse
        leaves by this much on the opposite side of it.
        """
        return replace(self, aim_azimuth=self.aim_azimuth - azimuth, aim_zenith=self.aim_zenith - zenith)

    def with_range_error(self, error: mi.Float64) -> Pulses:
        """Return the pulses with a further error (n,), m, added to the recorded range."""
        return replace(self, range_m=self.range_m + error)

    def at(self, index: mi.UInt32) -> Pulses:
        """Return some of the pulses, given their indices (k,), before they are traced."""
        own = ((field.name, getattr(self, field.name)) for field in fields(self))
        return Pulses(**{name: dr.gather(type(value), value, index) for name, value in own if value is not None})

    def evaluated(self) -> Pulses:
        """Compute the lazy arrays of the pulses and keep them in memory, for an effect that needs statistics of the scan."""
        dr.eval([value for field in fields(self) if (value := getattr(self, field.name)) is not None])
        return self


def direction(azimuth: mi.Float64, zenith: mi.Float64) -> mi.Array3f64:
    """Return the directions of beams as unit vectors 3 x (n,) in the scanner's frame.

    azimuth: (n,) angle atan2(y, x), rad. zenith: (n,) angle from +z, rad.
    """
    sin_azimuth, cos_azimuth = dr.sincos(azimuth)
    sin_zenith, cos_zenith = dr.sincos(zenith)
    return mi.Array3f64(sin_zenith * cos_azimuth, sin_zenith * sin_azimuth, cos_zenith)


def tangents(azimuth: mi.Float64, zenith: mi.Float64) -> tuple[mi.Array3f64, mi.Array3f64]:
    """Return two sets of unit vectors 3 x (n,) perpendicular to beams, towards increasing azimuth and increasing zenith.

    azimuth, zenith: (n,) directions of the beams in the scanner's frame, rad.
    """
    sin_azimuth, cos_azimuth = dr.sincos(azimuth)
    sin_zenith, cos_zenith = dr.sincos(zenith)
    rising_zenith = mi.Array3f64(cos_zenith * cos_azimuth, cos_zenith * sin_azimuth, -sin_zenith)
    return mi.Array3f64(-sin_azimuth, cos_azimuth, mi.Float64(0.0)), rising_zenith
