"""Make the reference surface that a scan is compared with: from a mesh, a cloud, an elevation model, or one half of the scan."""

from __future__ import annotations

from collections.abc import Sequence
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
"""If the step of pulses along a line is less than this share of the step of lines, pulses are halved instead of lines."""
_FEWEST_CHORDS = 100
"""Smallest number of chords for an estimate of noise."""
_TWICE_AS_LONG, _LEAST_NOISE = 16.0, 0.1
"""Variance of smooth relief about chords that are twice as long, over that about the shorter ones; smallest share of noise in a
variance.
"""


@dataclass(frozen=True)
class Reference:
    """Reference surface with which measured points are compared.

    Attributes
    ----------
    mesh : The surface, in the frame of the measured points, m.
    error_m : Standard error of its vertices along the lines of sight, m; 0 if it is taken as exact.
    words : Description of the surface for the user.
    limits : What a comparison with it cannot show, for the user.
    rows : (k,) indices of the measured points that are compared with it, if it was made of the other ones; None: all.
    of_points : Whether it was meshed from points. Noise and relief then tilt its triangles, so that incidence angles must not
        refer to them.
    noise_is_known : Whether `error_m` is noise of the same scanner alone, without relief between the vertices.
    epsg : EPSG code of the coordinate system that an elevation model states; None: it states none, or it is another kind of file.
    """

    mesh: TriangleMesh
    error_m: float
    words: tuple[str, ...]
    limits: tuple[str, ...]
    rows: NDArray[Any] | None = None
    of_points: bool = False
    noise_is_known: bool = False
    epsg: int | None = None


@dataclass(frozen=True)
class MeasuredPointNoise:
    """Noise of the measured points of which a reference is made, found by repeated measurements instead of from their neighbours.

    Attributes
    ----------
    sigma_m : Standard deviation along the lines of sight, m.
    words : Where it comes from, for the user.
    """

    sigma_m: float
    words: str


def is_cloud(path: Path) -> bool:
    """Return whether a file contains points without triangles.

    A PLY file is opened for this; others are known by their suffix.
    """
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in SUFFIXES
    faces = read_elements(path).get("face")
    return faces is None or not faces or not len(next(iter(faces.values())))


def reference_from_file(
    path: Path, unit: str | None, position: FloatArray, rotation: FloatArray, seen_from: str = "from the scanner"
) -> Reference:
    """Read the reference surface, with which measured points are compared, from a file.

    Parameters
    ----------
    path : A mesh, a cloud or an elevation model.
    unit : Unit of its coordinates, such as "mm"; None: as the file states, or metres.
    position : (3,) place as seen from which a cloud is meshed, m, in the frame of the measured points.
    rotation : (3, 3) rotation from a frame at that place to the frame of the measured points.
    seen_from : That place in words, for the description of the reference.

    Raises
    ------
    InputError
        If the file cannot be used.
    """
    if not path.is_file():
        raise InputError(
            "there is no such file",
            where=str(path),
            allowed=f"a mesh, a cloud, a DEM, or the word {HALF}",
            remedy="give the path of an existing file, or the word half",
        )
    if path.suffix.lower() in DEMS:
        return reference_from_dem(path, unit, "--reference-unit")
    if not is_cloud(path):
        mesh, notes = read_mesh(path, unit or "m")
        words = (f"mesh {path.name}: {len(mesh.faces):,} triangles, taken as exact", *notes)
        limit = "an error of the mesh (noise, chords across curved rock, cut edges) looks like an error of the sensor"
        return Reference(mesh, 0.0, words, (limit,))
    return reference_from_scans(read_scans(path, unit, option="--reference-unit"), path, position, rotation, seen_from)


def reference_from_scans(
    scans: Sequence[RawScan],
    path: Path,
    position: FloatArray,
    rotation: FloatArray,
    seen_from: str = "from the scanner",
    noise: MeasuredPointNoise | None = None,
) -> Reference:
    """Mesh the points of scans as the reference surface with which later scans are compared.

    Parameters
    ----------
    scans : The scans, all in one frame, m.
    path : Their file or folder, for the description of the reference.
    position : (3,) place as seen from which they are meshed, m, in the same frame.
    rotation : (3, 3) rotation from a frame at that place to the frame of the scans.
    seen_from : That place in words, for the description of the reference.
    noise : Known noise of a point along the lines of sight, by the scanner of the compared points and without relief; None: it
        is estimated from the scatter of neighbouring points, which includes the relief.

    Raises
    ------
    InputError
        If no triangle is left between the points.
    """
    points = np.concatenate([scan.cloud.points for scan in scans])
    surface = triangulate_seen_points(points, position, rotation, str(path))
    said = f"cloud {path.name}: {len(points):,} points, meshed as seen {seen_from}, {len(surface.mesh.faces):,} triangles"
    words = tuple(dict.fromkeys(f"cloud {path.name}: {word}" for scan in scans for word in scan.cloud.notes))
    limits = (
        "the reference is a measurement itself: errors that both share (same scanner, same place) are invisible, and rock that "
        "moved between the two differs from an error only at its edges",
    )
    if noise is None or surface.smoothed:
        return Reference(surface.mesh, surface.error_m, (said, *words, _noise_in_words(surface)), limits, of_points=True)
    words = (said, *words, noise.words)
    return Reference(surface.mesh, noise.sigma_m, words, limits, of_points=True, noise_is_known=True)


def reference_from_dem(path: Path, unit: str | None = None, option: str = "--unit") -> Reference:
    """Make the reference surface of a measurement from an elevation model.

    It has a vertex at the centre of each pixel, and two triangles between four pixels with data.

    Parameters
    ----------
    path : GeoTIFF of heights.
    unit : Unit of coordinates and heights, such as "ft"; None: as the file states, or metres.
    option : Command-line option that gives the unit, for errors.

    Raises
    ------
    InputError
        If `unit` contradicts the file, or the raster has no heights or no coordinates.
    """
    raster = read_raster(path)
    heights, place = raster.values, raster.place
    if place.grid is None:
        raise InputError(
            "the raster has no pixel scale and tie point, so its place is unknown",
            where=str(path),
            remedy="export the raster as a GeoTIFF, with its coordinates",
        )
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
        raise InputError(
            "the raster has no heights", where=str(path), remedy="export the elevation model again, with heights in its pixels"
        )
    mesh = mesh_of_raster(heights.astype(np.float64), grid)
    if not len(mesh.faces):
        raise InputError(
            "no four neighbouring pixels have heights",
            where=str(path),
            remedy="export an elevation model without gaps between its pixels",
        )
    mesh = mesh.with_vertices(mesh.vertices * np.array([metres, metres, up]))
    words = f"elevation model {path.name}: {int(known.sum()):,} heights every {grid.gsd * metres:.3g} m, taken as exact"
    limit = (
        "an elevation model has one height at each place: overhangs are missing, and steep faces are chords between pixels, "
        "whose error looks like an error of the sensor"
    )
    return Reference(mesh, 0.0, (words, *notes), (limit,), epsg=place.epsg)


def reference_from_half(scan: RawScan, station: Station) -> Reference:
    """Mesh one half of a laser scan as the reference for the other half, where no other reference exists.

    One half is every second scan line, or every second pulse of each line if pulses are much denser than lines.

    scan: the whole scan. station: position of the scanner, and the scan lines of the points. In the result, `rows` has the
    indices of the other half.
    """
    even, what = _halves(scan, station)
    surface = triangulate_seen_points(scan.cloud.points[even], station.position, station.rotation, scan.name)
    said = f"half of the scan itself ({what}): {int(even.sum()):,} points, {len(surface.mesh.faces):,} triangles"
    limits = (
        "both halves are of one scan: errors that vary slowly over the wall are invisible (offset, scale, index, eccentricity, "
        "incidence, cyclic error); only noise, outliers and differences between lines or pulses show",
    )
    noise = None if station.geometry is None else _noise_along_lines(station.geometry, even)
    if noise is None or surface.smoothed:
        return Reference(
            surface.mesh, surface.error_m, (said, _noise_in_words(surface)), limits, np.flatnonzero(~even), of_points=True
        )
    told = f"along its lines points scatter by {1e3 * noise:.2g} mm, which is used as their error"
    return Reference(surface.mesh, noise, (said, told), limits, np.flatnonzero(~even), of_points=True)


def _noise_along_lines(geometry: ScanGeometry, rows: NDArray[np.bool_]) -> float | None:
    """Estimate the standard deviation of a range, m, from chords between its neighbours in a line; None with too few chords.

    Chords twice as long have the same noise but four times the deviation from smooth relief; the additional scatter is
    subtracted. Rougher relief counts as noise; depth steps do not.
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
    """Return the robust variance of a range, m^2, about the chord between the points `lag` places before and after it in a line.

    Neighbours at r1 and r3, an angle t to either side, put the point between them at 2 r1 r3 cos t / (r1 + r3).

    Parameters
    ----------
    line, pulse, distance : (n,) line, pulse and range, m, of points sorted by line and pulse.
    lag : Distance of the neighbours, in points.
    step_rad : Angle between pulses, rad.

    Returns
    -------
    The variance; None if there are few chords.
    """
    first, middle, last = (slice(start, len(line) - 2 * lag + start) for start in (0, lag, 2 * lag))
    before, after = pulse[middle] - pulse[first], pulse[last] - pulse[middle]
    together = (line[last] == line[first]) & (before == after) & (before > 0) & (before <= 2 * lag)
    ends = distance[last] + distance[first]
    off = (distance[middle] - 2 * distance[last] * distance[first] * np.cos(after * step_rad) / ends)[together]
    return float((1.4826 * np.median(np.abs(off))) ** 2 / 1.5) if len(off) > _FEWEST_CHORDS else None


def _halves(scan: RawScan, station: Station) -> tuple[NDArray[np.bool_], str]:
    """Return the mask of the reference's half, and its description."""
    geometry = station.geometry
    if geometry is None:
        return np.arange(len(scan.cloud.points)) % 2 == 0, "every second point of the file, because no lines were found"
    if geometry.pulses.step < _MUCH_FINER * geometry.lines.step:
        return geometry.pulse % 2 == 0, "every second pulse of each line, as pulses are denser than lines"
    return geometry.line % 2 == 0, "every second line"


def _noise_in_words(surface: SeenSurface) -> str:
    """Describe the error of a surface made of points."""
    smoothed = ", vertices averaged with their neighbours because the coordinates are rounded" if surface.smoothed else ""
    return (
        f"its points scatter by {1e3 * surface.roughness_m:.2g} mm about their neighbours, {1e3 * surface.spacing_m:.2g} mm away "
        f"(noise and relief){smoothed}: {1e3 * surface.error_m:.2g} mm is used as the error of each"
    )
