"""The laser scanner's pulses on their way through the chain."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from sensors.numerics.functions import Functions

REFERENCE_RANGE_M = 100.0
"""Received power is relative to a target of albedo 1, hit squarely, at this range."""


_STEEPEST = 10.0
"""1 / cos i counts as no larger than this (84 degrees): published figures end at 80 degrees, and a ray that grazes a facet by
less would be off by metres."""


def slant(cos_incidence: Any, m: Functions) -> Any:
    """(n,) 1 / cos i - 1, what a slanting surface adds to the length of an echo; m: functions of host or device arrays."""
    return 1 / m.select(cos_incidence < 1 / _STEEPEST, 1 / _STEEPEST, cos_incidence) - 1


@dataclass(frozen=True)
class PulseGeometry:
    """What the equations of a laser scanner's effects look at, n pulses: (n,) arrays of the host or of the device.

    azimuth, zenith: recorded, rad; range_m: true, m; cos_incidence; power: received, relative; line: scan line; share: of the
    scan's duration; by_azimuth, by_zenith: slopes of the true range by the direction, m/rad. None: not known.
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
    """n pulses as lazy device arrays, all (n,), scanner frame; angles in rad, lengths in m.

    line: scan line, counted from the scan's first; share: of the scan's duration that has passed, 0 at the first pulse, 1 at the
    last; line_key, pulse_key: numbers of line and pulse on the instrument's own grid of steps, which key the pulse's random
    numbers, so that a window scanned alone draws those of the same window in a larger scan; azimuth, zenith: the nominal
    direction, which is the one recorded; aim_azimuth, aim_zenith: the direction in which the pulse really leaves.

    Once traced: true_range, of the return that the beam yields without any error, and range_m, recorded so far; cos_incidence,
    albedo, power (relative), block, returned; minimum_range, the nearest that the instrument records (scalar).
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
        """Four independent standard normal numbers per pulse; other four for every child of `random`."""
        return random.normals(self.pulse_key, self.line_key)

    def uniforms(self, random: KeyedRandom) -> mi.Array4f:
        """Four independent numbers in [0, 1) per pulse."""
        return random.uniforms(self.pulse_key, self.line_key)

    def geometry(self) -> PulseGeometry:
        """What equations look at, in double precision; what is not traced yet is None."""
        wide = {
            name: None if value is None else mi.Float64(value)
            for name, value in (("cos_incidence", self.cos_incidence), ("power", self.power), ("line", self.line))
        }
        return PulseGeometry(self.azimuth, self.zenith, range_m=self.true_range, share=self.share, **wide)

    def with_angle_error(self, azimuth: Any = 0.0, zenith: Any = 0.0) -> Pulses:
        """Recorded minus emitted direction grows by `azimuth` and `zenith`, rad: it leaves by as much on the other side."""
        return replace(self, aim_azimuth=self.aim_azimuth - azimuth, aim_zenith=self.aim_zenith - zenith)

    def with_range_error(self, error: mi.Float64) -> Pulses:
        """Recorded minus true range grows by `error`, m."""
        return replace(self, range_m=self.range_m + error)

    def at(self, index: mi.UInt32) -> Pulses:
        """The pulses of the given places, before they are traced."""
        own = ((field.name, getattr(self, field.name)) for field in fields(self))
        return Pulses(**{name: dr.gather(type(value), value, index) for name, value in own if value is not None})

    def evaluated(self) -> Pulses:
        """The same pulses, computed: for an effect that needs numbers of the whole scan; what follows starts from memory."""
        dr.eval([value for field in fields(self) if (value := getattr(self, field.name)) is not None])
        return self


def direction(azimuth: mi.Float64, zenith: mi.Float64) -> mi.Array3f64:
    """3 x (n,) unit vectors, scanner frame: azimuth = atan2(y, x), zenith from +z."""
    sin_azimuth, cos_azimuth = dr.sincos(azimuth)
    sin_zenith, cos_zenith = dr.sincos(zenith)
    return mi.Array3f64(sin_zenith * cos_azimuth, sin_zenith * sin_azimuth, cos_zenith)


def tangents(azimuth: mi.Float64, zenith: mi.Float64) -> tuple[mi.Array3f64, mi.Array3f64]:
    """3 x (n,) unit vectors across `direction`, towards rising azimuth and rising zenith."""
    sin_azimuth, cos_azimuth = dr.sincos(azimuth)
    sin_zenith, cos_zenith = dr.sincos(zenith)
    rising_zenith = mi.Array3f64(cos_zenith * cos_azimuth, cos_zenith * sin_azimuth, -sin_zenith)
    return mi.Array3f64(-sin_azimuth, cos_azimuth, mi.Float64(0.0)), rising_zenith
