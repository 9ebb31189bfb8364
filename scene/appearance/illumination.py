"""Light the rock: direct sun with shadows cast by the wall, and a uniform sky.

The sun's direction is given, or computed from date, time and place. The world frame is x east, y north, z up; azimuths count
clockwise from north.
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
"""Epoch from which the formulas count days."""
_SHADOW_OFFSET_M = 1e-3
"""Distance from the surface at which a shadow ray starts: a hundred times the error of a single precision ray at 100 m."""
_FAR_M = 1e4
"""Length of a shadow ray, m."""


@dataclass(frozen=True)
class SunPosition:
    """Direction of the sun in the sky, for the shadows and the shading of simulated photographs.

    Attributes
    ----------
    azimuth_rad : float
        Angle clockwise from north, rad.
    elevation_rad : float
        Angle above the horizon, rad, as seen through the refracting atmosphere.
    """

    azimuth_rad: float
    elevation_rad: float

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector from the rock towards the sun, world frame (x east, y north, z up)."""
        level = np.cos(self.elevation_rad)
        return np.array([level * np.sin(self.azimuth_rad), level * np.cos(self.azimuth_rad), np.sin(self.elevation_rad)])


def sun_coordinates(days: float) -> tuple[float, float]:
    """Compute the sun's right ascension and declination, rad, at a time, from which its place in the sky follows.

    These are the Astronomical Almanac's low-precision formulas, accurate to 0.01 deg from 1950 to 2050 (Michalsky 1988, eq.
    2-7). `days` is the time in days after J2000 (2000-01-01 12:00 UT).
    """
    longitude, anomaly = np.radians(280.460 + 0.9856474 * days), np.radians(357.528 + 0.9856003 * days)
    ecliptic = longitude + np.radians(1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly))
    obliquity = np.radians(23.439 - 4e-7 * days)
    ascension = np.arctan2(np.cos(obliquity) * np.sin(ecliptic), np.cos(ecliptic))
    return float(ascension % (2 * np.pi)), float(np.arcsin(np.sin(obliquity) * np.sin(ecliptic)))


def sun_position(time: datetime, latitude_rad: float, longitude_rad: float) -> SunPosition:
    """Compute the azimuth and the elevation of the sun at a time and a place, accurate to 0.02 deg from 1950 to 2050.

    Parameters
    ----------
    time : datetime
        Date and time; UTC if it has no time zone.
    latitude_rad, longitude_rad : float
        Geographic coordinates of the place, rad; north and east are positive.

    Notes
    -----
    Refraction is that of a standard atmosphere; below 15 deg of elevation it may differ by more than the stated accuracy
    (Michalsky 1988, Solar Energy 40(3), with his errata of 1988).
    """
    moment = time if time.tzinfo else time.replace(tzinfo=UTC)
    days = (moment - J2000).total_seconds() / 86400
    ascension, declination = sun_coordinates(days)
    hour = 24 * ((days + 0.5) % 1)  # UT
    sidereal = np.radians(15 * ((6.697375 + 0.0657098242 * days + hour) % 24))
    angle = sidereal + longitude_rad - ascension
    up = np.sin(latitude_rad) * np.sin(declination) + np.cos(latitude_rad) * np.cos(declination) * np.cos(angle)
    east = -np.cos(declination) * np.sin(angle)
    north = np.cos(latitude_rad) * np.sin(declination) - np.sin(latitude_rad) * np.cos(declination) * np.cos(angle)
    elevation = np.arcsin(np.clip(up, -1, 1))
    return SunPosition(float(np.arctan2(east, north) % (2 * np.pi)), float(elevation + _refraction(elevation)))


def _refraction(elevation_rad: float) -> float:
    """Return the atmospheric refraction, rad, at a true elevation; zero if the sun is down.

    The formula is that of Michalsky (1988), for 288 K and 1013.25 hPa.
    """
    degrees = np.degrees(elevation_rad)
    if degrees < -0.56:
        return 0.0
    bend = 3.51561 * (0.1594 + 0.0196 * degrees + 0.00002 * degrees**2) / (1 + 0.505 * degrees + 0.0845 * degrees**2)
    return float(np.radians(bend))


class IlluminationConfig(Config):
    """Sun and sky while the two photographs are taken; a time and a place take precedence over a given direction.

    The photographs are those of a simulated stereo pair. `sky_share` is the part of the light that comes from the sky, without
    shadows.
    """

    sun_azimuth_deg: float = Field(225.0, ge=0, lt=360, description="direction of the sun, clockwise from north (world y) [deg]")
    sun_elevation_deg: float = Field(45.0, gt=0, le=90, description="height of the sun above the horizon [deg]")
    time_utc: datetime | None = Field(None, description="date and time, 2026-06-21T03:00:00; none: use the given direction")
    latitude_deg: float | None = Field(
        None, ge=-90, le=90, description="latitude of the place, north positive; needed with time_utc [deg]"
    )
    longitude_deg: float | None = Field(
        None, ge=-180, le=180, description="longitude of the place, east positive; needed with time_utc [deg]"
    )
    sky_share: float = Field(
        0.25, ge=0, le=1, description="share of skylight in the total light on a face that points at the sun; 1: overcast"
    )

    @model_validator(mode="after")
    def _time_and_place(self) -> Self:
        given = [value is not None for value in (self.time_utc, self.latitude_deg, self.longitude_deg)]
        if any(given) and not all(given):
            raise ValueError("time_utc, latitude_deg and longitude_deg are needed together")
        return self

    def sun(self) -> SunPosition:
        """Return the direction of the sun, from the configured time and place or else the configured angles.

        Raises InputError if the sun is below the horizon at that time and place.
        """
        if self.time_utc is None or self.latitude_deg is None or self.longitude_deg is None:
            return SunPosition(np.radians(self.sun_azimuth_deg), np.radians(self.sun_elevation_deg))
        sun = sun_position(self.time_utc, np.radians(self.latitude_deg), np.radians(self.longitude_deg))
        if sun.elevation_rad <= 0:
            raise InputError(
                f"the sun stands {np.degrees(-sun.elevation_rad):.1f} deg below the horizon at this "
                "time and place, so it does not light the wall",
                where="illumination.time_utc",
                remedy="set illumination.time_utc to a time of day, in UTC, and give the longitude positive towards east",
            )
        return sun

    def in_wall_frame(self, frame: WallFrame) -> Illumination:
        """Return sun and sky as unit vectors in the wall frame, in which photographs are rendered.

        `frame` is the transform from the world frame (east, north, up) to the wall frame.
        """
        up = frame.direction_to_wall(np.array([0.0, 0.0, 1.0]))
        return Illumination(frame.direction_to_wall(self.sun().direction), up, self.sky_share)


@dataclass(frozen=True)
class Illumination:
    """Light of sun and sky on the rock, in the frame in which photographs are rendered (the wall frame).

    Attributes
    ----------
    sun, up : (3,) array
        Unit vectors towards the sun and the zenith.
    sky_share : float
        Share of skylight in the total light on a face that points at the sun, from 0 to 1.
    """

    sun: FloatArray
    up: FloatArray
    sky_share: float

    def irradiance(self, scene: RayCaster, point: mi.Array3f64, normal: mi.Vector3f) -> mi.Float32:
        """Compute the irradiance (n,) of surface elements, relative to an unshadowed one that points at the sun.

        E = (1 - s) V max(0, n . sun) + s (1 + n . up) / 2, where n is the normal, V is 1 if a shadow ray reaches the sun (else
        0) and s is the sky's share. The sky has uniform brightness. The part of it that the wall hides is not subtracted, and
        light reflected between rocks is ignored.

        Parameters
        ----------
        scene : RayCaster
            The surface that casts shadows.
        point : 3 x (n,)
            Positions of the surface elements in the scene's frame, m, on the ray-tracing device.
        normal : 3 x (n,)
            Unit normals of the surface, on the ray-tracing device.
        """
        sun, up = (mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in axis)) for axis in (self.sun, self.up))
        towards = mi.Array3f64(sun)
        facing = dr.dot(normal, sun)
        start = point + _SHADOW_OFFSET_M * mi.Array3f64(normal)
        lit = (facing > 0) & ~scene.occluded(start, towards, mi.Float64(_FAR_M))
        share = dr.opaque(mi.Float, self.sky_share)
        return (1 - share) * dr.select(lit, facing, 0) + share * (1 + dr.dot(normal, up)) / 2
