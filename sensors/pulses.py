"""The laser scanner's pulses on their way through the chain."""

from __future__ import annotations

from dataclasses import dataclass

from scene.backend import dr, mi

REFERENCE_RANGE_M = 100.0
"""Received power is relative to a target of albedo 1, hit squarely, at this range."""


@dataclass(frozen=True)
class Pulses:
    """n pulses as lazy device arrays, all (n,), scanner frame; angles in rad, lengths in m.

    index: the pulse's number in the whole pattern (keys its random numbers); line: its scan line; azimuth, zenith: the nominal
    direction, which is the one recorded; aim_azimuth, aim_zenith: the direction in which the pulse really leaves. Once traced:
    true_range and range_m (recorded so far), cos_incidence, albedo, power (relative), block, returned.
    """

    index: mi.UInt32
    line: mi.UInt32
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


def direction(azimuth: mi.Float64, zenith: mi.Float64) -> mi.Array3f64:
    """3 x (n,) unit vectors, scanner frame: azimuth = atan2(y, x), zenith from +z."""
    sin_azimuth, cos_azimuth = dr.sincos(azimuth)
    sin_zenith, cos_zenith = dr.sincos(zenith)
    return mi.Array3f64(sin_zenith * cos_azimuth, sin_zenith * sin_azimuth, cos_zenith)
