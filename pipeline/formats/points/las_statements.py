"""Read what a LAS file states (coordinate system, counts, bounding box), and compare it with its points."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np

from pipeline.formats.units import AxisUnits, metres_of_epsg_unit, not_understood, understood_crs, units_of_crs
from scene.common.errors import InputError
from scene.geometry.bounds import bounding_box
from scene.geometry.mesh import FloatArray

_OUTSIDE = 0.01
"""Distance, in the file's unit, by which points may be outside of the header's bounding box, whose numbers programs round."""
_MUCH_LARGER = 1.5
"""Ratio of the header's box to the points' extent above which a note is added."""
_MODEL, _GEOGRAPHIC, _PROJECTED, _LINEAR_UNIT, _VERTICAL, _VERTICAL_UNIT = 1024, 2048, 3072, 3076, 4096, 4099
"""GeoTIFF keys: kind of the coordinates, codes of their systems, codes of their units."""
_IN_DEGREES, _GEOCENTRIC = 2, 3
"""Values of the key for the kind of coordinates."""
_USER_DEFINED = 32767
"""Code of a user-defined system or unit."""
_OLDER_COUNT_AT = 107
"""Offset of the number of points in versions up to LAS 1.3; later versions leave it 0 or repeat the number."""
_NOISE = (7, 18)
"""Classes of LAS 1.4: low and high noise."""
_PROJECT = "project the points to a coordinate system in metres, such as UTM, and export them again"


def stated_units(header: laspy.LasHeader, where: str) -> tuple[AxisUnits | None, tuple[str, ...]]:
    """Return the unit of the coordinates that a LAS or LAZ file states, or None, and notes on it.

    header: of the file, whose WKT or GeoTIFF keys are read. where: name of the file, for errors. Raises InputError for
    coordinates in degrees, or if WKT and keys state different units.
    """
    by_wkt, notes = _by_wkt(header, where)
    by_keys = _by_keys(header, where)
    if by_wkt is not None and by_keys is not None and not np.allclose(by_wkt.metres, by_keys.metres, rtol=1e-8, atol=0):
        raise InputError(
            f"the file states two units: {by_wkt.name} in {by_wkt.source}, {by_keys.name} in {by_keys.source}", where=where,
            remedy="export the file again with a coordinate system whose unit is that of the coordinates",
        )  # fmt: skip
    return by_wkt or by_keys, notes


def _records(header: laspy.LasHeader, kind: type) -> list[Any]:
    """Return the variable-length records of a kind."""
    return [record for record in (*header.vlrs, *(header.evlrs or ())) if isinstance(record, kind)]


def _by_wkt(header: laspy.LasHeader, where: str) -> tuple[AxisUnits | None, tuple[str, ...]]:
    """Return the unit by WKT, and notes."""
    for record in _records(header, laspy.vlrs.known.WktCoordinateSystemVlr):
        text = record.string.strip("\0 \n")
        if text:
            crs = understood_crs(text)
            return (None, (not_understood(text, where),)) if crs is None else (units_of_crs(crs, where), ())
    return None, ()


def _by_keys(header: laspy.LasHeader, where: str) -> AxisUnits | None:
    """Return the unit by GeoTIFF keys: codes of coordinate systems first, then codes of units."""
    keys: dict[int, int] = {}
    for record in _records(header, laspy.vlrs.known.GeoKeyDirectoryVlr):
        keys |= {key.id: key.value_offset for key in record.geo_keys if key.tiff_tag_location == 0}
    codes = {name: keys.get(name, 0) for name in (_PROJECTED, _VERTICAL)}
    known = {name: code for name, code in codes.items() if 0 < code < _USER_DEFINED}
    if keys.get(_MODEL) in (_IN_DEGREES, _GEOCENTRIC) or (keys.get(_GEOGRAPHIC) and not codes[_PROJECTED] and _MODEL not in keys):
        what = "from the Earth's centre" if keys.get(_MODEL) == _GEOCENTRIC else "in degrees"
        raise InputError(
            f"the file's GeoTIFF keys say that coordinates are {what} (geographic system {keys.get(_GEOGRAPHIC, 'none')})",
            where=where,
            allowed="projected coordinates",
            remedy=_PROJECT,
        )
    plane, height = (_of_code(known.get(name), where) for name in (_PROJECTED, _VERTICAL))
    across = _agreed(plane, keys.get(_LINEAR_UNIT), "coordinates", where)
    up = _agreed(height, keys.get(_VERTICAL_UNIT), "heights", where)
    if across is None:
        return None
    name = f"EPSG:{known[_PROJECTED]}" if _PROJECTED in known else "a system of its own"
    return AxisUnits((across, across, across if up is None else up), f"its GeoTIFF keys ({name})")


def _of_code(code: int | None, where: str) -> float | None:
    """Return the unit, m, of a projected or vertical coordinate system by its EPSG code; None if there is no such system."""
    crs = None if code is None else understood_crs(f"EPSG:{code}")
    if crs is None:
        return None
    if crs.is_vertical:
        return float(crs.axis_info[0].unit_conversion_factor)
    units = units_of_crs(crs, where)
    return None if units is None else units.metres[0]


def _agreed(by_system: float | None, unit_code: int | None, what: str, where: str) -> float | None:
    """Return the unit by the coordinate system and by the unit's own key; raise InputError if they differ."""
    by_unit = None if not unit_code or unit_code >= _USER_DEFINED else metres_of_epsg_unit(unit_code)
    if by_system is not None and by_unit is not None and not np.isclose(by_system, by_unit, rtol=1e-8, atol=0):
        units = f"{by_system:.10g} m by the coordinate system, {by_unit:.10g} m by the key of the unit itself"
        raise InputError(
            f"the file states two units of its {what} in its GeoTIFF keys: {units}",
            where=where,
            remedy="export the file again with a coordinate system whose unit is that of the coordinates",
        )
    return by_system if by_unit is None else by_unit


def check_box(header: laspy.LasHeader, points: FloatArray, where: str) -> tuple[str, ...]:
    """Compare the bounding box in a LAS file's header with its points, to find files with a wrong scale or missing points.

    Returns a note if the box is much larger than the points, else nothing. A box of zeros, or with minimum above maximum, is
    ignored.

    header: of the file. points: (n, 3), in the file's unit. where: name of the file, for errors. Raises InputError if points
    are outside the box.
    """
    low, high = np.array(header.mins), np.array(header.maxs)
    if not len(points) or not np.isfinite([low, high]).all() or (low > high).any() or not (low.any() or high.any()):
        return ()
    found_low, found_high = bounding_box(points)
    single = np.spacing(np.minimum(np.maximum(np.abs(low), np.abs(high)), 1e30).astype(np.float32)).astype(float)
    reach = np.maximum(np.maximum(_OUTSIDE, single), 2 * np.array(header.scales))
    places = f"its points lie from {_place(found_low)} to {_place(found_high)}"
    places = f"a box from {_place(low)} to {_place(high)} in its header, and {places}"
    if ((found_low < low - reach) | (found_high > high + reach)).any():
        raise InputError(
            f"the file states {places}", where=where,
            remedy="its scale, offset or box is wrong: export it again, or repair the header with LAStools' lasinfo -repair_bb",
        )  # fmt: skip
    larger = np.linalg.norm(high - low) > _MUCH_LARGER * np.linalg.norm(found_high - found_low) + 1
    return (f"the file states {places}: it is part of a larger file, or its scale is wrong",) if larger else ()


def _place(values: FloatArray) -> str:
    """Format a position."""
    return f"({', '.join(f'{value:.10g}' for value in values)})"


def check_counts(header: laspy.LasHeader, path: Path) -> None:
    """Check the number of points that the header of a LAS or LAZ file states.

    path: the file. Raises InputError if the fields of older and newer versions of LAS state different numbers, or if the size
    of an uncompressed file is not that of so many points.
    """
    with path.open("rb") as file:
        (older,) = struct.unpack_from("<I", file.read(_OLDER_COUNT_AT + 4), _OLDER_COUNT_AT)
    if older and older != header.point_count:
        raise InputError(
            f"the header states {header.point_count:,} points, but {older:,} in the field of older LAS versions",
            where=str(path),
            remedy="copy the complete file again, or export the points again as LAS or LAZ",
        )
    if header.are_points_compressed or header.global_encoding.waveform_data_packets_internal:
        return
    start = header.offset_to_point_data
    later = getattr(header, "start_of_first_evlr", 0) if header.number_of_evlrs else 0
    size = (later or path.stat().st_size) - start
    room = size // header.point_format.size
    if room != header.point_count:
        raise InputError(
            f"the header states {header.point_count:,} points, but the file has room for {room:,}", where=str(path),
            remedy="the file was cut off, or its header is out of date: copy the complete file again, or "
            "export the points again as LAS or LAZ",
        )  # fmt: skip


def _any_flag(records: np.ndarray[Any, Any]) -> bool:
    """Whether any of the records (n,) may have a flag; point formats below 6 store flags together with classes."""
    name = "classification_flags" if "classification_flags" in (records.dtype.names or ()) else "raw_classification"
    return bool(records[name].any())


def flagged(las: Any) -> tuple[np.ndarray[Any, np.dtype[np.bool_]], tuple[str, ...]]:
    """Return which points a LAS file takes out of use, as a mask (n,), and notes.

    las: content of the file, as laspy reads it. Such points are flagged as withheld or synthetic, or classified as noise.
    """
    classes = np.asarray(las.classification)
    out = np.zeros(len(classes), dtype=bool)
    notes = []
    statements = {}
    if _any_flag(getattr(las, "points", las).array):
        statements["flagged as withheld"] = np.asarray(las.withheld, dtype=bool)
        statements["flagged as synthetic"] = np.asarray(las.synthetic, dtype=bool)
    if classes.any():
        statements["classified as noise"] = (classes == _NOISE[0]) | (classes == _NOISE[1])
    for what, rows in statements.items():
        if rows.all():
            notes.append(f"all points are {what} and are kept")
        elif count := int((rows & ~out).sum()):
            notes.append(f"{count:,} points {what} in the file are left out")
            out |= rows
    return out, tuple(notes)
