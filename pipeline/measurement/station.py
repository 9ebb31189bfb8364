"""Find where the scanner of a raw scan stood and its scan pattern: from the file's header, the user, or the scan lines."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.scan_geometry import ScanGeometry
from pipeline.measurement.origin import Origin, origin_from_point_order, origin_near, pattern_from
from pipeline.measurement.scans import RawScan
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, IntArray

_SURE_M = 0.05
"""An origin from the scan lines replaces a stated one if its standard deviation is below this, m, and the difference is
significant.
"""
_STATED_M = 0.002
"""A stated origin is kept if the one from the scan lines is nearer than this, m, to which surveys round."""
_ORIGIN_M = 0.02
"""If scan lines meet this near to the file's origin, m, the file is in the scanner's own frame."""


@dataclass(frozen=True)
class Station:
    """Position of the scanner of a raw scan, and the scan lines of its points.

    Attributes
    ----------
    position : (3,) position of the scanner, in the points' frame, m.
    rotation : (3, 3) rotation from the scanner's frame to the points' frame.
    sigma_m : (3,) standard deviation of the position, m, if it was checked or found by the scan lines; else None.
    geometry : Scan lines and angular steps of the points; None if the points lie on no regular grid of angles.
    words : How the position was found, for the user.
    """

    position: FloatArray
    rotation: FloatArray
    sigma_m: FloatArray | None
    geometry: ScanGeometry | None
    words: tuple[str, ...]

    @property
    def line(self) -> IntArray | None:
        """Number of each point's scan line, (n,) integers; None if no scan lines were found."""
        return None if self.geometry is None else self.geometry.line

    @property
    def pattern(self) -> dict[str, list[float]] | None:
        """The scan's nominal directions, to be written under the key `pattern` of measurement.yaml.

        The keys azimuth_rad and zenith_rad each have [start, stop, step], rad. None if the points lie on no regular grid of
        angles, or if lines do not all begin at the same zenith angle.
        """
        return self.geometry.pattern if self.geometry is not None and self.geometry.synchronous else None

    def part(self, rows: NDArray[Any]) -> Station:
        """Return the station with the scan lines of only the points that `rows` selects: indices (k,), or a mask (n,)."""
        geometry = self.geometry
        if geometry is None:
            return self
        columns = {name: getattr(geometry, name)[rows] for name in ("range_m", "azimuth", "zenith", "line", "pulse")}
        return replace(self, geometry=replace(geometry, **columns))


def find_station(scan: RawScan, position: FloatArray | None = None) -> Station:
    """Find the position of a raw scan's scanner, and the scan lines of its points.

    The position comes from the user, the file's header or the scan lines, in this order. A stated one is corrected if the scan
    lines determine it better.

    Parameters
    ----------
    scan : The raw scan.
    position : (3,) position that the user stated, in the points' frame, m; None: unknown.

    Raises
    ------
    InputError
        If nothing determines the position.
    """
    points = _in_order(scan)
    if position is not None:
        return _in_file_order(_stated_station(points, position, np.eye(3), "as given by --position"), scan)
    if scan.position is not None and scan.rotation is not None:
        return _in_file_order(_stated_station(points, scan.position, scan.rotation, "of the header"), scan)
    return _in_file_order(_unstated_station(points, scan.name), scan)


def _in_order(scan: RawScan) -> FloatArray:
    """Return the points in the order of measurement, as far as the file has times."""
    time = scan.cloud.gps_time
    return scan.cloud.points if time is None else scan.cloud.points[np.argsort(time, kind="stable")]


def _in_file_order(station: Station, scan: RawScan) -> Station:
    """Return the station with the columns of its pattern in the file's order."""
    time, geometry = scan.cloud.gps_time, station.geometry
    if time is None or geometry is None:
        return station
    back = np.argsort(np.argsort(time, kind="stable"), kind="stable")
    columns = {name: getattr(geometry, name)[back] for name in ("range_m", "azimuth", "zenith", "line", "pulse")}
    others = {name: getattr(geometry, name) for name in (
        "lines", "pulses", "rotation", "line_shape", "synchronous", "azimuth_rms", "zenith_rms")}  # fmt: skip
    return Station(station.position, station.rotation, station.sigma_m, ScanGeometry(**columns, **others), station.words)


def _stated_station(points: FloatArray, position: FloatArray, rotation: FloatArray, source: str) -> Station:
    """Return the station of a stated position, corrected if the scan lines determine it better.

    Parameters
    ----------
    points : (n, 3) points in the order of measurement, m.
    position, rotation : The stated pose.
    source : Who stated it, in words.
    """
    found = origin_near(points, position, rotation)
    if found is None or found.sigma_m.max() > _SURE_M:  # seen from there, the pattern is missing or distorted
        found = _from_lines(points, position) or found
    if found is None:
        words = (
            f"position {_place(position)} {source}",
            "seen from there, the points lie on no regular pattern, so scan lines and missing returns are unknown",
        )
        return Station(position, rotation, None, None, words)
    off = found.position - position
    away = float(np.linalg.norm(off))
    better = away > max(_STATED_M, 3 * float(np.linalg.norm(found.sigma_m))) and found.sigma_m.max() < _SURE_M
    kept = pattern_from(points, position, rotation) if not better else None
    if kept is not None:
        return _station(Origin(position, found.sigma_m, kept), rotation, (f"position {_place(position)} {source}",))
    moved = f"position {_place(found.position)}, where the scan lines meet, {away:.3g} m from the one {source}"
    return _station(found, rotation, (f"{moved} (± {1e3 * found.sigma_m.max():.2g} mm)",))


def _from_lines(points: FloatArray, position: FloatArray) -> Origin | None:
    """Return where the scan lines meet, if it is well determined and not farther from `position` than the points are."""
    found = origin_from_point_order(points)
    if found is None or found.sigma_m.max() > _SURE_M:
        return None
    return found if np.linalg.norm(found.position - position) < np.median(np.linalg.norm(points - position, axis=1)) else None


def _unstated_station(points: FloatArray, name: str) -> Station:
    """Find a station of which nothing was stated: at the file's origin, or where the lines meet."""
    found = origin_near(points, np.zeros(3), np.eye(3)) if np.abs(points).max() < 1e4 else None
    if found is not None and np.linalg.norm(found.position) < max(_ORIGIN_M, 3 * float(found.sigma_m.max())):
        off = f"the scan lines meet {1e3 * np.linalg.norm(found.position):.2g} mm from it (± {_mm(found)} mm)"
        word = f"seen from the file's origin, the points lie on a regular pattern, so the scanner is assumed there; {off}"
        kept = pattern_from(points, np.zeros(3), np.eye(3))
        found = found if kept is None else Origin(np.zeros(3), found.sigma_m, kept)
        return _station(found, np.eye(3), (word,))
    found = found or origin_from_point_order(points)
    if found is None:
        raise InputError(
            "neither the file nor its scan lines say where the scanner stood", where=name,
            remedy=f"give --position X,Y,Z (m, in the points' frame); a few metres of error do no harm. "
            f"On a wall that leans back, {_place(_place_in_front(points))} is in front of the points",
        )  # fmt: skip
    word = f"position {_place(found.position)} found from the scan lines (± {_mm(found)} mm)"
    return _station(found, np.eye(3), (word,))


def _station(found: Origin, rotation: FloatArray, words: tuple[str, ...]) -> Station:
    """Describe a station found."""
    geometry = found.geometry
    lines, pulses = geometry.lines, geometry.pulses
    pattern = (
        f"pattern: {lines.count:,} lines {np.degrees(lines.step):.4g} degrees apart, up to {pulses.count:,} pulses every "
        f"{np.degrees(pulses.step):.4g} degrees"
    )
    said = [*words, pattern]
    if not geometry.synchronous:
        said.append("the lines begin anywhere or are slanted, so missing returns are unknown")
    if geometry.tilt > 1e-6:
        said.append(f"the scan's axis is tilted by {np.degrees(geometry.tilt):.3g} degrees; angles refer to it")
    return Station(found.position, rotation @ geometry.rotation, found.sigma_m, geometry, tuple(said))


def _place_in_front(points: FloatArray) -> FloatArray:
    """Return a place as far in front of a wall of points (n, 3) as it is wide, on the side to which its normal points up."""
    centre = points.mean(axis=0)
    few = points[:: max(len(points) // 20_000, 1)] - centre
    normal = np.linalg.eigh(np.einsum("ni,nj->ij", few, few))[1][:, 0]
    normal = normal if normal[2] >= 0 else -normal
    level = normal * [1.0, 1.0, 0.0]
    return centre + float(np.ptp(points, axis=0).max()) * level / max(float(np.linalg.norm(level)), 1e-9)


def _mm(found: Origin) -> str:
    """Format the standard deviation of an origin."""
    return f"{1e3 * found.sigma_m.max():.2g}"


def _place(position: FloatArray) -> str:
    """Format a position."""
    return "(" + ", ".join(f"{value:.3f}" for value in position) + ")"
