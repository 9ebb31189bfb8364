"""The light on the rock: the sun's direction, by date, time and place or given, shadows cast by the wall, and an even sky.

The world frame is x east, y north, z up; azimuths count clockwise from north.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from scene.common.backend import dr, mi
from scene.common.config import Config
from scene.common.errors import InputError
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster

J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
_SHADOW_OFFSET_M = 1e-3
"""How far off the surface a shadow ray starts: a hundred times the error of a single precision ray at 100 m."""
_FAR_M = 1e4


@dataclass(frozen=True)
class SunPosition:
    """Where the sun stands: azimuth clockwise from north, elevation above the horizon as it appears (refracted), rad."""

    azimuth_rad: float
    elevation_rad: float

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector towards the sun, world frame (east, north, up)."""
        level = np.cos(self.elevation_rad)
        return np.array([level * np.sin(self.azimuth_rad), level * np.cos(self.azimuth_rad), np.sin(self.elevation_rad)])


def equatorial(days: float) -> tuple[float, float]:
    """Right ascension and declination of the sun, rad, `days` after J2000 (2000-01-01 12:00 UT).

    The Astronomical Almanac's low-precision formulas: within 0.01 deg from 1950 to 2050 (Michalsky 1988, eq. 2-7).
    """
    longitude, anomaly = np.radians(280.460 + 0.9856474 * days), np.radians(357.528 + 0.9856003 * days)
    ecliptic = longitude + np.radians(1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly))
    obliquity = np.radians(23.439 - 4e-7 * days)
    ascension = np.arctan2(np.cos(obliquity) * np.sin(ecliptic), np.cos(ecliptic))
    return float(ascension % (2 * np.pi)), float(np.arcsin(np.sin(obliquity) * np.sin(ecliptic)))


def sun_position(time: datetime, latitude_rad: float, longitude_rad: float) -> SunPosition:
    """The sun at `time` (without a time zone: UTC) and a place (north and east positive), within 0.02 deg from 1950 to 2050.

    Refraction is that of a standard atmosphere; below 15 deg of elevation it may differ by more (Michalsky 1988, Solar Energy
    40(3), with his errata of 1988).
    """
    moment = time if time.tzinfo else time.replace(tzinfo=UTC)
    days = (moment - J2000).total_seconds() / 86400
    ascension, declination = equatorial(days)
    hour = 24 * ((days + 0.5) % 1)  # UT
    sidereal = np.radians(15 * ((6.697375 + 0.0657098242 * days + hour) % 24))
    angle = sidereal + longitude_rad - ascension
    up = np.sin(latitude_rad) * np.sin(declination) + np.cos(latitude_rad) * np.cos(declination) * np.cos(angle)
    east = -np.cos(declination) * np.sin(angle)
    north = np.cos(latitude_rad) * np.sin(declination) - np.sin(latitude_rad) * np.cos(declination) * np.cos(angle)
    elevation = np.arcsin(np.clip(up, -1, 1))
    return SunPosition(float(np.arctan2(east, north) % (2 * np.pi)), float(elevation + _refraction(elevation)))


def _refraction(elevation_rad: float) -> float:
    """Atmospheric refraction, rad, of a true elevation (Michalsky 1988, 288 K, 1013.25 hPa); zero for a sun that is down."""
    degrees = np.degrees(elevation_rad)
    if degrees < -0.56:
        return 0.0
    bend = 3.51561 * (0.1594 + 0.0196 * degrees + 0.00002 * degrees**2) / (1 + 0.505 * degrees + 0.0845 * degrees**2)
    return float(np.radians(bend))


class IlluminationConfig(Config):
    """Sun and sky while the pair of photographs is taken; a time and a place go before a given direction."""

    sun_azimuth_deg: float = Field(225.0, ge=0, lt=360, description="direction of the sun, clockwise from north (world y) [deg]")
    sun_elevation_deg: float = Field(45.0, gt=0, le=90, description="height of the sun above the horizon [deg]")
    time_utc: datetime | None = Field(None, description="date and time, 2026-06-21T03:00:00; none: the sun is where it is given")
    latitude_deg: float | None = Field(
        None, ge=-90, le=90, description="of the place, north positive; needed with time_utc [deg]"
    )
    longitude_deg: float | None = Field(
        None, ge=-180, le=180, description="of the place, east positive; needed with time_utc [deg]"
    )
    sky_share: float = Field(
        0.25, ge=0, le=1, description="share of the sky in the light on a face turned to the sun; 1: overcast"
    )

    @model_validator(mode="after")
    def _time_and_place(self) -> Self:
        given = [value is not None for value in (self.time_utc, self.latitude_deg, self.longitude_deg)]
        if any(given) and not all(given):
            raise ValueError("time_utc, latitude_deg and longitude_deg are needed together")
        return self

    def sun(self) -> SunPosition:
        """Where the sun stands. Raises InputError where it is down at the given time and place."""
        if self.time_utc is None or self.latitude_deg is None or self.longitude_deg is None:
            return SunPosition(np.radians(self.sun_azimuth_deg), np.radians(self.sun_elevation_deg))
        sun = sun_position(self.time_utc, np.radians(self.latitude_deg), np.radians(self.longitude_deg))
        if sun.elevation_rad <= 0:
            raise InputError(
                f"the sun stands {np.degrees(-sun.elevation_rad):.1f} deg below the horizon",
                where="illumination.time_utc",
                remedy="give the time in UTC and the longitude east positive",
            )
        return sun

    def in_wall_frame(self, frame: WallFrame) -> Illumination:
        """The light in the frame of the scene."""
        up = frame.direction_to_wall(np.array([0.0, 0.0, 1.0]))
        return Illumination(frame.direction_to_wall(self.sun().direction), up, self.sky_share)


@dataclass(frozen=True)
class Illumination:
    """Sun and sky in the scene's frame. sun, up: (3,) unit vectors; sky_share: in the light on a face turned to the sun."""

    sun: FloatArray
    up: FloatArray
    sky_share: float

    def irradiance(self, scene: RayCaster, point: mi.Array3f64, normal: mi.Vector3f) -> mi.Float32:
        """(n,) irradiance of surface elements, relative to an open one that faces the sun.

        E = (1 - s) V max(0, n . sun) + s (1 + n . up) / 2, V: whether the sun is seen (one shadow ray), s: the sky's share. The
        sky is of even brightness and what the wall hides of it is left out, as is light from rock to rock.
        """
        sun, up = (mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in axis)) for axis in (self.sun, self.up))
        towards = mi.Array3f64(sun)
        facing = dr.dot(normal, sun)
        start = point + _SHADOW_OFFSET_M * mi.Array3f64(normal)
        lit = (facing > 0) & ~scene.occluded(start, towards, mi.Float64(_FAR_M))
        share = dr.opaque(mi.Float, self.sky_share)
        return (1 - share) * dr.select(lit, facing, 0) + share * (1 + dr.dot(normal, up)) / 2
