"""Where the scanner of a raw scan stood and how it scanned: from the file's header, from what was said, or from its lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.formats.measurements.scan_geometry import ScanGeometry
from pipeline.measurement.origin import Origin, from_order, near, pattern_from
from pipeline.measurement.scans import RawScan
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, IntArray

_SURE_M = 0.05
"""An origin by scan lines is taken instead of a stated one where it is known to this, and differs by more than its error."""
_STATED_M = 0.002
"""A stated origin is kept where the lines' one is nearer than this: what a survey rounds to."""
_ORIGIN_M = 0.02
"""Lines that meet so near to the file's origin belong to a file in the scanner's own frame."""


@dataclass(frozen=True)
class Station:
    """A scanner's place and pattern.

    position: (3,) m; rotation: (3, 3), scanner to the points' frame, orthonormal; sigma_m: (3,) of the position where the scan
    lines told it; geometry: the pattern that the points lie on, None where they lie on none; words: how it was found.
    """

    position: FloatArray
    rotation: FloatArray
    sigma_m: FloatArray | None
    geometry: ScanGeometry | None
    words: tuple[str, ...]

    @property
    def line(self) -> IntArray | None:
        """(n,) the scan line of each point."""
        return None if self.geometry is None else self.geometry.line

    @property
    def pattern(self) -> dict[str, list[float]] | None:
        """As measurement.yaml has it; None without one, and for lines that begin anywhere or are slanted."""
        return self.geometry.pattern if self.geometry is not None and self.geometry.synchronous else None


def find_station(scan: RawScan, position: FloatArray | None = None) -> Station:
    """The station of a scan; position: (3,) m, as said by the user. Raises InputError where nothing tells it."""
    points = _in_order(scan)
    if position is not None:
        return _restored(_stated(points, position, np.eye(3), "as given by --position"), scan)
    if scan.position is not None and scan.rotation is not None:
        return _restored(_stated(points, scan.position, scan.rotation, "of the header"), scan)
    return _restored(_found(points, scan.name), scan)


def _in_order(scan: RawScan) -> FloatArray:
    """Points in the order in which they were taken, as far as the file says."""
    time = scan.cloud.gps_time
    return scan.cloud.points if time is None else scan.cloud.points[np.argsort(time, kind="stable")]


def _restored(station: Station, scan: RawScan) -> Station:
    """The station with a pattern whose points are in the file's order again."""
    time, geometry = scan.cloud.gps_time, station.geometry
    if time is None or geometry is None:
        return station
    back = np.argsort(np.argsort(time, kind="stable"), kind="stable")
    columns = {name: getattr(geometry, name)[back] for name in ("range_m", "azimuth", "zenith", "line", "pulse")}
    others = {name: getattr(geometry, name) for name in (
        "lines", "pulses", "rotation", "line_shape", "synchronous", "azimuth_rms", "zenith_rms")}  # fmt: skip
    return Station(station.position, station.rotation, station.sigma_m, ScanGeometry(**columns, **others), station.words)


def _stated(points: FloatArray, position: FloatArray, rotation: FloatArray, source: str) -> Station:
    """A station whose place was said, moved where the scan lines know it better."""
    found = near(points, position, rotation)
    if found is None or found.sigma_m.max() > _SURE_M:  # from there the pattern is none, or bent
        found = _from_lines(points, position) or found
    if found is None:
        words = (
            f"position {_place(position)} {source}",
            "from there the points lie on no regular pattern: scan lines and missing returns cannot be told",
        )
        return Station(position, rotation, None, None, words)
    off = found.position - position
    away = float(np.linalg.norm(off))
    better = away > max(_STATED_M, 3 * float(np.linalg.norm(found.sigma_m))) and found.sigma_m.max() < _SURE_M
    kept = pattern_from(points, position, rotation) if not better else None
    if kept is not None:
        return _station(Origin(position, found.sigma_m, kept), rotation, (f"position {_place(position)} {source}",))
    moved = f"position {_place(found.position)}: the scan lines meet there, {away:.3g} m from the one {source}"
    return _station(found, rotation, (f"{moved} (± {1e3 * found.sigma_m.max():.2g} mm)",))


def _from_lines(points: FloatArray, position: FloatArray) -> Origin | None:
    """Where the lines of points in their order meet, if well known, and not farther off than the points are."""
    found = from_order(points)
    if found is None or found.sigma_m.max() > _SURE_M:
        return None
    return found if np.linalg.norm(found.position - position) < np.median(np.linalg.norm(points - position, axis=1)) else None


def _found(points: FloatArray, name: str) -> Station:
    """A station of which nothing was said: at the file's origin, or where the lines meet."""
    found = near(points, np.zeros(3), np.eye(3)) if np.abs(points).max() < 1e4 else None
    if found is not None and np.linalg.norm(found.position) < max(_ORIGIN_M, 3 * float(found.sigma_m.max())):
        off = f"the scan lines meet {1e3 * np.linalg.norm(found.position):.2g} mm from it (± {_mm(found)} mm)"
        word = f"the points lie on a regular pattern seen from the file's origin: the scanner is taken to stand there; {off}"
        kept = pattern_from(points, np.zeros(3), np.eye(3))
        found = found if kept is None else Origin(np.zeros(3), found.sigma_m, kept)
        return _station(found, np.eye(3), (word,))
    found = found or from_order(points)
    if found is None:
        raise InputError(
            "says nowhere where the scanner stood, and its scan lines do not tell", where=name,
            remedy=f"give --position X,Y,Z (m, in the points' frame), if need be to some metres; {_place(_before(points))} lies "
            "in front of them, if their wall leans back",
        )  # fmt: skip
    word = f"position {_place(found.position)} found from the scan lines (± {_mm(found)} mm)"
    return _station(found, np.eye(3), (word,))


def _station(found: Origin, rotation: FloatArray, words: tuple[str, ...]) -> Station:
    geometry = found.geometry
    lines, pulses = geometry.lines, geometry.pulses
    pattern = (
        f"pattern: {lines.count:,} lines {np.degrees(lines.step):.4g} degrees apart, up to {pulses.count:,} pulses every "
        f"{np.degrees(pulses.step):.4g} degrees"
    )
    said = [*words, pattern]
    if not geometry.synchronous:
        said.append("the lines begin anywhere or are slanted: missing returns cannot be told")
    if geometry.tilt > 1e-6:
        said.append(f"the scan's axis leans by {np.degrees(geometry.tilt):.3g} degrees; angles are counted about it")
    return Station(found.position, rotation @ geometry.rotation, found.sigma_m, geometry, tuple(said))


def _before(points: FloatArray) -> FloatArray:
    """A place as far before the middle of a wall of points (n, 3) as it is wide, on the side to which its normal looks up."""
    centre = points.mean(axis=0)
    few = points[:: max(len(points) // 20_000, 1)] - centre
    normal = np.linalg.eigh(np.einsum("ni,nj->ij", few, few))[1][:, 0]
    normal = normal if normal[2] >= 0 else -normal
    level = normal * [1.0, 1.0, 0.0]
    return centre + float(np.ptp(points, axis=0).max()) * level / max(float(np.linalg.norm(level)), 1e-9)


def _mm(found: Origin) -> str:
    return f"{1e3 * found.sigma_m.max():.2g}"


def _place(position: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in position) + ")"
