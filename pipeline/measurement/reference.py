"""The surface that a scan is compared with: a mesh, a cloud that is meshed here, or one half of the scan itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.scan_geometry import ScanGeometry
from pipeline.formats.points.points import SUFFIXES
from pipeline.formats.rasters.geotiff import read_raster
from pipeline.formats.units import AxisUnits, agreed_units
from pipeline.measurement.scans import RawScan, read_scans
from pipeline.measurement.station import Station
from pipeline.surface.raster_mesh import mesh_of_raster
from pipeline.surface.triangulation import SeenSurface, triangulate_seen_points
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.meshes.ply import read_elements
from scene.walls.imported import read_mesh

HALF = "half"
DEMS = (".tif", ".tiff")
_MUCH_FINER = 0.6
"""Pulses that lie so much closer along a line than lines do are halved instead of the lines."""
_FEWEST_CHORDS = 100
_TWICE_AS_LONG, _LEAST_NOISE = 16.0, 0.1
"""Times the variance of smooth relief about chords that are twice as long, and share of a variance that is noise in any case."""


@dataclass(frozen=True)
class Reference:
    """The surface as known, points' frame, m, with the standard error of its vertices along the rays (0: taken as exact) and what
    is to be said of it.

    rows: (k,) the points of the scan that are compared with it, None for all; of_points: made of a cloud, so that its triangles
    lean by noise and relief between points.
    """

    mesh: TriangleMesh
    error_m: float
    words: tuple[str, ...]
    limits: tuple[str, ...]
    rows: NDArray[Any] | None = None
    of_points: bool = False


def is_cloud(path: Path) -> bool:
    """Whether a file holds points without triangles."""
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in SUFFIXES
    faces = read_elements(path).get("face")
    return faces is None or not faces or not len(next(iter(faces.values())))


def from_file(
    path: Path, unit: str | None, position: FloatArray, rotation: FloatArray, seen_from: str = "from the scanner"
) -> Reference:
    """A reference out of a file, seen from `position` (3,) m with `rotation` (3, 3), `seen_from` in words; InputError where it
    cannot be used."""
    if not path.is_file():
        raise InputError("there is no such file", where=str(path), allowed=f"a mesh, a cloud, a DEM, or the word {HALF}")
    if path.suffix.lower() in DEMS:
        return from_dem(path, unit, "--reference-unit")
    if not is_cloud(path):
        mesh, notes = read_mesh(path, unit or "m")
        words = (f"mesh {path.name}: {len(mesh.faces):,} triangles, taken as exact", *notes)
        limit = "an error of the mesh (its noise, chords across curved rock, cut edges) looks like one of the sensor"
        return Reference(mesh, 0.0, words, (limit,))
    scans = read_scans(path, unit, option="--reference-unit")
    points = np.concatenate([scan.cloud.points for scan in scans])
    surface = triangulate_seen_points(points, position, rotation, str(path))
    said = f"cloud {path.name}: {len(points):,} points, meshed as seen {seen_from}, {len(surface.mesh.faces):,} triangles"
    words = tuple(dict.fromkeys(f"cloud {path.name}: {word}" for scan in scans for word in scan.cloud.notes))
    limits = (
        "the reference is a measurement itself: errors that both share (same scanner, same place) cannot be seen, and rock that "
        "moved between the two is told from errors only where it has edges",
    )
    return Reference(surface.mesh, surface.error_m, (said, *words, _of_noise(surface)), limits, of_points=True)


def from_dem(path: Path, unit: str | None = None, option: str = "--unit") -> Reference:
    """Make a surface of a raster of heights: a vertex at the centre of each pixel, two triangles between four that have data.

    unit: what the user says of coordinates and heights by `option`, None where the file's own word holds, metres where it has
    none. Raises InputError where the two contradict each other, and where the raster holds no heights or no place.
    """
    raster = read_raster(path)
    heights, place = raster.values, raster.place
    if place.grid is None:
        raise InputError("has no place: pixel scale and one tie point are needed", where=str(path), remedy="export a GeoTIFF")
    level, upright = place.linear_m, place.vertical_m
    stated = None if level is None else AxisUnits((level, level, upright or level), "its GeoTIFF keys")
    units, notes = agreed_units(stated, unit, str(path), option), list(raster.notes)
    if stated and not units.in_metres:
        notes.append(f"the file states {units.name}, which were converted to metres")
    metres = 1.0 if stated else units.metres[0]  # the grid of a file with a unit is in metres already
    up = units.metres[2] if stated else upright or metres
    grid = place.grid
    known = np.isfinite(heights)
    if not known.any() or min(heights.shape) < 2:
        raise InputError("holds no heights", where=str(path), remedy="export the elevation model again")
    mesh = mesh_of_raster(heights.astype(np.float64), grid)
    if not len(mesh.faces):
        raise InputError("has no four neighbouring pixels with heights", where=str(path), remedy="export a whole elevation model")
    mesh = mesh.with_vertices(mesh.vertices * np.array([metres, metres, up]))
    words = f"elevation model {path.name}: {int(known.sum()):,} heights every {grid.gsd * metres:.3g} m, taken as exact"
    limit = (
        "an elevation model has one height at each place: overhangs are missing, and steep faces are chords between pixels, "
        "whose error looks like one of the sensor"
    )
    return Reference(mesh, 0.0, (words, *notes), (limit,))


def half_of(scan: RawScan, station: Station) -> Reference:
    """Every other line (or pulse, where these are much finer) as the surface, with the rest to be compared with it."""
    even, what = _halves(scan, station)
    surface = triangulate_seen_points(scan.cloud.points[even], station.position, station.rotation, scan.name)
    said = f"half of the scan itself ({what}): {int(even.sum()):,} points, {len(surface.mesh.faces):,} triangles"
    limits = (
        "both halves are of one scan: nothing that changes slowly over the wall can be seen (offset, scale, index, eccentricity, "
        "incidence, cyclic error), only noise, tails, and what differs from one line or pulse to the next",
    )
    noise = None if station.geometry is None else _noise_along_lines(station.geometry, even)
    if noise is None or surface.smoothed:
        return Reference(surface.mesh, surface.error_m, (said, _of_noise(surface)), limits, np.flatnonzero(~even), of_points=True)
    told = f"along its lines points scatter by {1e3 * noise:.2g} mm, which is carried as their error"
    return Reference(surface.mesh, noise, (said, told), limits, np.flatnonzero(~even), of_points=True)


def _noise_along_lines(geometry: ScanGeometry, rows: NDArray[np.bool_]) -> float | None:
    """Robust standard deviation of a range, m, about the chord of its neighbours in a line; None without any.

    Chords twice as long are as noisy, and four times as far from relief that is smooth over them: what they scatter more is taken
    off. Relief that is rougher counts as noise, steps of depth do not.
    """
    line, pulse, distance = geometry.line[rows], geometry.pulse[rows], geometry.range_m[rows]
    order = np.lexsort((pulse, line))
    line, pulse, distance = line[order], pulse[order], distance[order]
    near, far = (_variance_about_chords(line, pulse, distance, lag, geometry.pulses.step) for lag in (1, 2))
    if near is None:
        return None
    relief = 0.0 if far is None else max(far - near, 0.0) / (_TWICE_AS_LONG - 1)
    return float(np.sqrt(max(near - relief, _LEAST_NOISE * near)))


def _variance_about_chords(
    line: NDArray[Any], pulse: NDArray[Any], distance: FloatArray, lag: int, step_rad: float
) -> float | None:
    """Of a range, m2, in lines in order, about the chord of those `lag` places before and after it; None where there are few.

    Neighbours at r1 and r3, an angle t to either side, put the one between them at 2 r1 r3 cos t / (r1 + r3).
    """
    first, middle, last = (slice(start, len(line) - 2 * lag + start) for start in (0, lag, 2 * lag))
    before, after = pulse[middle] - pulse[first], pulse[last] - pulse[middle]
    together = (line[last] == line[first]) & (before == after) & (before > 0) & (before <= 2 * lag)
    ends = distance[last] + distance[first]
    off = (distance[middle] - 2 * distance[last] * distance[first] * np.cos(after * step_rad) / ends)[together]
    return float((1.4826 * np.median(np.abs(off))) ** 2 / 1.5) if len(off) > _FEWEST_CHORDS else None


def _halves(scan: RawScan, station: Station) -> tuple[NDArray[np.bool_], str]:
    geometry = station.geometry
    if geometry is None:
        return np.arange(len(scan.cloud.points)) % 2 == 0, "every second point of the file, as no lines were found"
    if geometry.pulses.step < _MUCH_FINER * geometry.lines.step:
        return geometry.pulse % 2 == 0, "every second pulse of each line, which lie closer than lines do"
    return geometry.line % 2 == 0, "every second line"


def _of_noise(surface: SeenSurface) -> str:
    smoothed = ", vertices averaged with their neighbours as the coordinates are rounded" if surface.smoothed else ""
    return (
        f"its points scatter by {1e3 * surface.roughness_m:.2g} mm about their neighbours, {1e3 * surface.spacing_m:.2g} mm away "
        f"(noise and relief){smoothed}: {1e3 * surface.error_m:.2g} mm are carried as the error of each"
    )
