"""Check a measurement before it is used: points must be finite, be near the reference, and fit the scan pattern.

Rays with NaN or infinity never reach the ray tracer. No check uses more than a sample of the points.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.formats.point_cloud import PointCloud
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from sensors.cameras.camera import Camera, CameraPair
from sensors.effects.base import Sensor
from sensors.signal_chain.polar import polar

Sweep = tuple[float, float, float]
"""Start, stop and step of an angle, rad."""
_SAMPLE = 20_000
"""Number of points in the sample."""
_FEWEST_HITS, _FEWEST_NEAR = 0.01, 0.25
"""Smallest share of the points whose rays meet the reference, and smallest share of these that are near it."""
_NEAR_M, _NEAR_SHARE = 1.0, {"tls": 0.02, "stereo": 0.06}
"""A point is near the reference within this distance along its ray, m, or within this share of its range if that is more: a
camera that is rotated by 4 mrad moves what is ten bases away by 4 %.
"""
_FEWEST_INSIDE = 0.5
"""Smallest share of the points within the pattern's angles."""
_PULSES_PER_POINT, _FEW_PULSES = 100.0, 1e6
"""A pattern has at most so many pulses for each point, or so many in total."""
_POINTS_PER_PULSE = 4.0
"""Largest mean number of points for each pulse; no scene gives more echoes."""
_ONE_PLACE_M = 1e-6
"""Points within this distance are at the same place, m."""
_SHORTEST_BASE_M = 1e-3
"""Shortest base of a stereo pair, m."""
_FEWEST_SEEN = 0.05
"""Smallest share of the points that both cameras see."""
_LARGEST_POWER = 1e12
"""Largest relative received power."""
_MOST_OFF = 0.05
"""Largest median deviation of given pixels, as a share of the frame's width; a registration moves points by some centimetres."""
_LEAST_SIGMA = {
    "tls": (1e-6, "m", "range_sigma_m"),
    "stereo": (2e-4, "px", "parallax_sigma_px"),
    "surface": (1e-7, "m", "point_sigma_m"),
}
"""Smallest predicted standard deviation by sensor, and of a surface without cameras; its unit, and the key that sets it."""


@dataclass(frozen=True)
class PointFit:
    """How well measured points fit the reference surface, along the sensor's rays, to find a wrong frame or unit.

    A point is near the surface if it is at most 1 m, or the share `reach` of its range, before or behind it.

    Attributes
    ----------
    hits : Share of the points whose rays meet the reference, 0 to 1.
    near : Share of these points that are near the reference, 0 to 1.
    off_m : Median distance of these points behind the reference along the rays, m (negative: in front); NaN without hits.
    reach : Share of the range within which a point counts as near: 0.02 for a laser scanner, 0.06 for a stereo pair.
    """

    hits: float
    near: float
    off_m: float
    reach: float

    @classmethod
    def of(cls, points: FloatArray, origin: FloatArray, reference: RayCaster, sensor: Sensor) -> PointFit:
        """Compare measured points with the reference surface along their rays.

        points: (n, 3), wall frame, m. origin: (3,) where the rays start, wall frame, m. reference: the surface, ready for ray
        casting. sensor: stereo or tls (laser scanner), which decides how near points must be.
        """
        reach = _NEAR_SHARE[sensor]
        away = points[:: max(len(points) // _SAMPLE, 1)] - origin
        length = np.linalg.norm(away, axis=1)
        away, length = away[length > _ONE_PLACE_M], length[length > _ONE_PLACE_M]
        if not len(length):
            return cls(0.0, 0.0, np.nan, reach)
        distance = reference.cast(origin, away / length[:, None])[0]
        hit = np.isfinite(distance)
        off = (length - distance)[hit]
        near = np.abs(off) <= np.maximum(_NEAR_M, reach * length[hit])
        if not len(off):
            return cls(0.0, 0.0, np.nan, reach)
        return cls(float(hit.mean()), float(near.mean()), float(np.median(off)), reach)

    @property
    def good(self) -> bool:
        """Whether the points belong to the reference surface.

        They do if at least 1 % of the rays meet it, and at least 25 % of these points are near it.
        """
        return self.hits >= _FEWEST_HITS and self.near >= _FEWEST_NEAR


def check_frame(here: PointFit, other: PointFit | None, frame: str, where: str) -> None:
    """Check that measured points are in the frame (scanner or world) that measurement.yaml states.

    Raises InputError if they fit the reference only in the other frame, or if hardly any ray meets it.

    Parameters
    ----------
    here : How points and reference fit in the stated frame.
    other : How they fit in the other frame; None if there is none.
    frame : Name of the stated frame, "scanner" or "world".
    where : Name of the file, for errors.
    """
    if here.good:
        return
    if other is not None and other.good:
        fits = "world" if frame == "scanner" else "scanner"
        problem = f"the points do not fit the reference in `frame: {frame}`, but do in `frame: {fits}`"
        raise InputError(problem, where=where, remedy=f"write `frame: {fits}`")
    if here.hits < _FEWEST_HITS:
        problem = f"only {100 * here.hits:.2g} % of the points lie in directions in which the sensor sees the reference"
        raise InputError(
            problem,
            where=where,
            allowed=f"{100 * _FEWEST_HITS:g} % or more",
            remedy="correct `frame` or the sensor's position and rotation, or export points and reference "
            "in one coordinate system in metres",
        )


def check_seen(pair: CameraPair, points: FloatArray, where: str) -> float:
    """Return the share of points that both cameras of a pair see, to find cameras and points in different frames.

    points: (n, 3), m, in the pair's frame. where: name of the file, for errors. Raises InputError if the share is almost zero,
    or the pair has no base.
    """
    if pair.base_m < _SHORTEST_BASE_M:
        raise InputError(
            f"the two cameras stand {pair.base_m:.3g} m apart", where=where, allowed=f"{_SHORTEST_BASE_M:g} m or more",
            remedy="correct `position_m` of left and right, in metres",
        )  # fmt: skip
    both, front = np.ones(len(points), dtype=bool), np.ones(len(points), dtype=bool)
    for camera in (pair.left, pair.right):
        x, y, z = np.einsum("ji,nj->in", camera.rotation, points - camera.position)
        ahead = z > 0
        depth = np.where(ahead, z, 1.0)
        with np.errstate(all="ignore"):  # the distortion's polynomial, far outside the frame
            u, v = camera.pixel(x / depth, y / depth)
        front &= ahead
        both &= ahead & (u >= 0) & (v >= 0) & (u <= camera.width) & (v <= camera.height)
    if front.mean() < _FEWEST_SEEN:
        raise InputError(
            f"{100 * (1 - front.mean()):.3g} % of the points lie behind a camera", where=where,
            remedy="export cameras and points in one coordinate system; "
            "rotations must map camera (x right, y down, z forward) to world",
        )  # fmt: skip
    if both.mean() < _FEWEST_SEEN:
        raise InputError(
            f"both cameras see {100 * both.mean():.2g} % of the points", where=where,
            allowed=f"{100 * _FEWEST_SEEN:g} % or more", remedy="export cameras and points from one photogrammetric project",
        )  # fmt: skip
    return float(both.mean())


def check_pixels(left: Camera, cloud: PointCloud, where: str) -> None:
    """Check the pixels (channels pixel_x and pixel_y) that a photogrammetric cloud states for its points.

    Raises InputError if the left camera sees the points elsewhere. A cloud without pixels is accepted.

    left: the left camera. cloud: the points, in the frame of the camera's pose, m. where: name of the file, for errors.
    """
    if not {"pixel_x", "pixel_y"} <= set(cloud.extra):
        return
    x, y, z = np.einsum("ji,nj->in", left.rotation, cloud.points - left.position)
    ahead = z > 0
    u, v = left.pixel(x[ahead] / z[ahead], y[ahead] / z[ahead])
    off = float(np.median(np.hypot(cloud.extra["pixel_x"][ahead] - u, cloud.extra["pixel_y"][ahead] - v)))
    if not off <= _MOST_OFF * left.width:
        raise InputError(
            f"pixel_x and pixel_y are {off:,.0f} px from where the left camera sees the points (median)", where=where,
            allowed=f"up to {100 * _MOST_OFF:.0f} % of its width",
            remedy="give the pixels of the left picture, or leave pixel_x and pixel_y out",
        )  # fmt: skip


def check_power(cloud: PointCloud, where: str) -> PointCloud:
    """Check that a cloud's intensity, if it has one, can be a relative received power, on which errors of scanners depend.

    where: name of the file, for errors. Returns the cloud. Raises InputError for negative values, or values above 1e12.
    """
    power = cloud.intensity
    if power is None or (power.min(initial=0.0) >= 0 and power.max(initial=0.0) <= _LARGEST_POWER):
        return cloud
    raise InputError(
        f"the cloud has intensities from {power.min():.3g} to {power.max():.3g}", where=where,
        allowed=f"0 to {_LARGEST_POWER:g}, relative received power",
        remedy="convert decibels by 10^(dB / 10), or leave out the intensity; `scarpsim measurement` does this for raw files",
    )  # fmt: skip


def check_different(clouds: Mapping[str, PointCloud]) -> None:
    """Raise InputError if two epochs have the same coordinates, which real noise never gives. clouds: points by file name."""
    known: dict[bytes, str] = {}
    for name, cloud in clouds.items():
        digest = hashlib.sha256(cloud.points.tobytes()).digest()
        if digest in known:
            raise InputError(
                f"the cloud has the same points as {known[digest]}", where=name, remedy="give another file for each epoch"
            )
        known[digest] = name


def check_near_rays(here: PointFit, where: str) -> None:
    """Raise InputError if most measured points are far from the reference along their rays: they then show another wall.

    here: how points and reference fit. where: name of the file, for errors.
    """
    if here.good:
        return
    raise InputError(
        f"the points are {abs(here.off_m):.3g} m {'behind' if here.off_m > 0 else 'before'} the reference (median along rays)",
        where=where,
        allowed=f"a quarter of them within {_NEAR_M:g} m or {100 * here.reach:g} % of the range",
        remedy="correct the sensor's position, and export points and reference of the same wall in metres",
    )


def check_pulses(azimuth: Sweep, zenith: Sweep, points: int, epochs: int, where: str) -> None:
    """Raise InputError if the scan pattern in measurement.yaml has far more or far fewer pulses than points were measured.

    Parameters
    ----------
    azimuth, zenith : Start, stop and step of each angle of the pattern, rad.
    points : Number of measured points in all epochs.
    epochs : Number of scans with this pattern.
    where : Name of the file, for errors.
    """
    pulses = float(np.prod([(stop - start) // step + 1 for start, stop, step in (azimuth, zenith)]))
    most = max(_PULSES_PER_POINT * points, _FEW_PULSES)
    if points > _POINTS_PER_PULSE * pulses * epochs:
        raise InputError(
            f"'pattern' has {pulses:,.0f} pulses, too few for {points:,} points", where=where,
            allowed=f"at least one pulse for every {_POINTS_PER_PULSE:g} points of an epoch",
            remedy="correct the steps (third value of each axis, rad), or remove `pattern`",
        )  # fmt: skip
    if pulses > most:
        raise InputError(
            f"'pattern' has {pulses:.3g} pulses, too many for {points:,} points", where=where,
            allowed=f"at most {most:.3g} pulses",
            remedy="correct the steps (third value of each axis, rad), or remove `pattern`",
        )  # fmt: skip


def check_inside(points: FloatArray, azimuth: Sweep, zenith: Sweep, where: str) -> None:
    """Raise InputError if a scan pattern does not contain the measured points.

    points: (n, 3), scanner frame, m. azimuth, zenith: start, stop and step of each angle, rad. where: name of the file, for
    errors.
    """
    _, around, down = polar(points)
    turned = np.mod(around - azimuth[0] + azimuth[2], 2 * np.pi)
    inside = turned <= azimuth[1] - azimuth[0] + 2 * azimuth[2]
    inside &= (down >= zenith[0] - zenith[2]) & (down <= zenith[1] + zenith[2])
    if inside.mean() < _FEWEST_INSIDE:
        raise InputError(
            f"'pattern' contains only {100 * inside.mean():.2g} % of the points", where=where,
            allowed=f"{100 * _FEWEST_INSIDE:g} % or more",
            remedy="correct `pattern`: "
            "azimuth is atan2(y, x), zenith is measured from +z, both in the scanner frame, rad; or remove `pattern`",
        )  # fmt: skip


def check_noise(of: str, sigma: FloatArray) -> None:
    """Raise InputError if the sensor model predicts almost no noise, so that standardised residuals would be meaningless.

    of: kind of measurement: "tls" (ranges, m), "stereo" (disparities, px) or "surface" (points, m).
    sigma: (n,) predicted standard deviations, in this unit.
    """
    least, unit, key = _LEAST_SIGMA[of]
    if sigma.min(initial=np.inf) < least:
        raise InputError(
            f"the model predicts a standard deviation of {sigma.min():.2g} {unit}",
            where="model.yaml: noise",
            allowed=f"{least:g} {unit} or more",
            remedy=f"set `{key}` in the model to the sensor's standard deviation",
        )


def check_sensor(measured: Sensor, modelled: Sensor, where: str) -> None:
    """Raise InputError, naming the file `where`, if the sensor model is not of the sensor that measured."""
    if modelled != measured:
        what = f"the model is of the sensor {modelled}, but the measurement is of the sensor {measured}"
        raise InputError(what, where=where, remedy="name a model of the same sensor")
