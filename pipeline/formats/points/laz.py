"""Read and write LAS and LAZ point clouds; written is LAS 1.4, point format 6, compressed by lazrs."""

from __future__ import annotations

import datetime
import math
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import laspy
import numpy as np
from lazrs import LazrsError  # type: ignore[import-untyped]
from numpy.typing import NDArray

from pipeline.formats.files.atomic import writing
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.las_statements import check_box, check_counts, flagged, stated_units
from scene.common.errors import InputError
from scene.common.regular_file import check_file
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

_CHUNK = 1_000_000
"""Points in memory at a time while writing; a multiple of the 50,000 points of a LAZ chunk."""
_FILLED_AT_ONCE = 1 << 15
"""Points that a thread converts at a time; their arrays then stay in the processor's cache."""
_COUNTS = 65535
"""Largest stored intensity."""
_LARGEST = 2**31 - 1
"""Largest stored coordinate."""
_USER, _FULL_SCALE_RECORD = "scarpsim", 1
_MOST_RETURNS = 15
"""Largest number of returns of a pulse."""
_SCAN_ANGLE_STEP = math.radians(0.006)
"""Step of stored scan angles, rad."""
_FURTHER = ("classification", "user_data", "point_source_id", "scanner_channel", "red", "green", "blue", "nir")
"""Fields of LAS that become channels if any point has a value above zero."""
_COPY = "copy the complete file again, or export the points again as LAS or LAZ"
EXACT_INTENSITY = "intensity_relative"
"""Extra dimension that is read as the intensity, instead of the 16-bit field."""


POINT_FIELDS = (
    laspy.DecompressionSelection.XY_RETURNS_CHANNEL
    | laspy.DecompressionSelection.Z
    | laspy.DecompressionSelection.CLASSIFICATION
    | laspy.DecompressionSelection.FLAGS
)
"""Fields from which coordinates follow: coordinates, and what takes points out of use."""
_HEADER_BYTES = 375
"""Length of a header."""
_CHUNK_SIZE_AT, _LARGEST_CHUNK, _VARIABLE_CHUNKS = 12, 10_000_000, 2**32 - 1
"""In a LAZ file: offset of the chunk size in LASzip's record, the largest accepted one, points, and the value for
variable sizes.
"""


@dataclass(frozen=True)
class PulseChannels:
    """Values of a cloud's points for which LAS has its own fields, besides intensity and time.

    Attributes
    ----------
    return_number, number_of_returns : (n,) number of the echo and of all echoes of its pulse, 1 to 15; None: 1 of 1.
    scan_angle_rad : (n,) angle of the emitted direction from straight down, rad, as in LAS (for a scanner, pi minus zenith
        angle).
    """

    return_number: NDArray[np.integer] | None = None
    number_of_returns: NDArray[np.integer] | None = None
    scan_angle_rad: FloatArray | None = None


@dataclass(frozen=True)
class LazHeader:
    """Values that are written to the header of a LAS or LAZ file.

    Attributes
    ----------
    scale_m : float
        Step of the stored coordinates, m.
    date : datetime.date
        Date of the file.
    wkt : str
        Coordinate system, if known.
    standard_time : bool
        Whether the points' times are GPS seconds since 1980-01-06 minus 1e9, as `gps_seconds` gives; else seconds from any
        moment.
    """

    scale_m: float = 1e-6
    date: datetime.date = datetime.date(2000, 1, 1)
    wkt: str = ""
    standard_time: bool = False


_PLAIN, _USUAL = PulseChannels(), LazHeader()
_GPS_START = datetime.datetime(1980, 1, 6, tzinfo=datetime.UTC)
_LEAP_SECONDS, _ADJUSTED_S = 18, 1e9
"""GPS time minus UTC since 2017, and what LAS subtracts from GPS seconds (LAS 1.4, global encoding)."""


def gps_seconds(time: datetime.datetime) -> float:
    """Return a time in UTC as LAS stores standard GPS time: seconds since 1980-01-06 minus 1e9."""
    return (time - _GPS_START).total_seconds() + _LEAP_SECONDS - _ADJUSTED_S


@dataclass(frozen=True)
class StoredCloud:
    """A point cloud prepared for writing as LAS.

    header: the file's header. cloud: the points. fields: values of the points by LAS's name. full_scale: relative power that is
    stored as the largest intensity, 65535.
    """

    header: laspy.LasHeader
    cloud: PointCloud
    fields: Mapping[str, NDArray[Any]]
    full_scale: float

    @classmethod
    def of(cls, cloud: PointCloud, pulses: PulseChannels, header: LazHeader) -> StoredCloud:
        """Prepare a point cloud for writing as LAS.

        pulses: returns and scan angles. header: values for the file's header. Raises ValueError for points that are not finite,
        or return numbers that LAS cannot store.
        """
        fields = {"bit_fields": _return_bits(pulses.return_number, pulses.number_of_returns), "gps_time": cloud.gps_time}
        if pulses.scan_angle_rad is not None:
            fields["scan_angle"] = np.rint(pulses.scan_angle_rad / _SCAN_ANGLE_STEP)
        full_scale = _full_scale(cloud.intensity)
        las = _header(cloud, header, full_scale)
        present = {name: values for name, values in fields.items() if values is not None}
        return cls(las, cloud, present | dict(cloud.extra), full_scale)

    def with_points(self, cloud: PointCloud) -> StoredCloud:
        """Prepare further points of a file that is written part by part, with the header and extra dimensions of this cloud.

        cloud: the further points, without intensity. Their time is not written.
        """
        return replace(self, cloud=cloud, fields={"bit_fields": self.fields["bit_fields"], **cloud.extra})

    def steps(self) -> NDArray[np.int64]:
        """Return the coordinates (n, 3) as LAS stores them: in steps of the header's scale from its offset."""
        return np.rint((self.cloud.points - self.header.offsets) / self.header.scales).astype(np.int64)

    def records(self, rows: slice | NDArray[np.integer]) -> laspy.ScaleAwarePointRecord:
        """Return some of the points as LAS records, ready to be written. rows: their indices or a slice."""
        places, intensity = self.cloud.points[rows], self.cloud.intensity
        intensity = None if intensity is None else intensity[rows]
        fields = {name: values if values.ndim == 0 else values[rows] for name, values in self.fields.items()}
        record = laspy.ScaleAwarePointRecord.zeros(len(places), header=self.header)

        def fill(start: int) -> None:
            part = slice(start, start + _FILLED_AT_ONCE)
            array = record.array[part]
            _fill(array, self.header, places[part])
            for name, values in fields.items():
                array[name] = values if values.ndim == 0 else values[part]
            if intensity is not None:
                array["intensity"] = np.rint(intensity[part] * (_COUNTS / self.full_scale))

        map_in_threads(fill, range(0, len(places), _FILLED_AT_ONCE))
        return record


def write_laz(path: Path, cloud: PointCloud, pulses: PulseChannels = _PLAIN, header: LazHeader = _USUAL) -> None:
    """Write a point cloud as LAZ, or as LAS if `path` ends in .las; equal arguments give equal bytes.

    Coordinates are stored relative to an offset in whole metres at the middle of the cloud. A cloud wider than 4295 m uses the
    next power of ten of the scale. Raises InputError if the file cannot be written.

    Parameters
    ----------
    path : File to write.
    cloud : Finite points. Its intensity, at least 0, is stored in 16 bits relative to the smallest power of two that no point
        exceeds, its extra channels as extra dimensions in their own type.
    pulses : Returns and scan angles; the latter are stored in steps of 0.006 degrees.
    header : Header values.
    """
    stored = StoredCloud.of(cloud, pulses, header)
    with writing(path) as temporary, temporary.open("wb") as file, writer(file, stored.header, path.suffix != ".las") as las:
        for start in range(0, len(cloud.points), _CHUNK):
            las.write_points(stored.records(slice(start, start + _CHUNK)))


def read_laz(path: Path, *, only_points: bool = False) -> PointCloud:
    """Read a point cloud from a LAS or LAZ file of any version.

    The intensity is relative received power. In files that scarpsim wrote, it has the scale that they state; in others it is
    the count divided by 65535. Intensity and GPS time that are zero throughout count as not recorded. Extra channels
    `return_number` and `number_of_returns` exist if pulses have several returns, and `scan_angle_rad` (from straight down) if
    there are scan angles. Points that the file marks as withheld or noise are left out, with a note. `stated_units` of the
    cloud comes from the file's coordinate system.

    path: the file. only_points: whether to read nothing but the coordinates, which are then stored column by column; this takes
    a fifth less time. Raises InputError for a missing, truncated or other file, or a header that contradicts the points.
    """
    where = str(check_file(path))
    try:
        check_extent(path)
        las = laspy.read(path, decompression_selection=POINT_FIELDS if only_points else laspy.DecompressionSelection.all())
    except InputError:
        raise
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror or error})",
            where=where,
            remedy="give the path of an existing LAS or LAZ file that you may read",
        ) from None
    except (laspy.LaspyException, LazrsError, ValueError, struct.error, MemoryError, OverflowError) as error:
        raise damaged(path, error) from None
    if len(las.points) < las.header.point_count:
        raise InputError(
            f"the file has {len(las.points):,} of the {las.header.point_count:,} points that it states", where=where, remedy=_COPY
        )
    check_quantisation(las.header, path)
    units, notes = stated_units(las.header, where)
    cloud = PointCloud(_coordinates(las)) if only_points else _with_channels(las)
    left_out, words = flagged(las)
    notes = (*notes, *check_box(las.header, cloud.points, where), *words)
    cloud = replace(cloud, notes=notes, stated_units=units)
    return cloud.part(~left_out) if left_out.any() else cloud


def _coordinates(las: laspy.LasData) -> FloatArray:
    """Return the coordinates (n, 3), in the file's unit, stored column by column."""
    found = np.empty((3, len(las.points)))
    for start in range(0, found.shape[1], _FILLED_AT_ONCE):
        part = slice(start, start + _FILLED_AT_ONCE)
        records = las.points.array[part]
        for name, column, scale, offset in zip("XYZ", found[:, part], las.header.scales, las.header.offsets, strict=True):
            np.multiply(records[name], scale, out=column)
            column += offset
    return found.T


def _with_channels(las: laspy.LasData) -> PointCloud:
    """Return the points, in the file's unit, with all that the file records of each."""
    extra = {name: np.array(las[name]) for name in las.point_format.extra_dimension_names} | _standard_channels(las)
    counts = las.points.array["intensity"]
    intensity = counts.astype(np.float32) * np.float32(_stored_full_scale(las.header) / _COUNTS) if counts.any() else None
    timed = "gps_time" in las.point_format.dimension_names and np.any(las.points.array["gps_time"])
    return PointCloud(
        points=np.ascontiguousarray(las.xyz),
        intensity=extra.pop(EXACT_INTENSITY, intensity),
        gps_time=np.array(las.points.array["gps_time"]) if timed else None,
        extra=extra,
    )


def damaged(path: Path, error: BaseException) -> InputError:
    """Return the InputError for a LAS or LAZ file that the libraries cannot read, saying what is wrong with it.

    error: what the library raised.
    """
    with path.open("rb") as file:
        start = file.read(4)
    if start != b"LASF":
        problem = (
            f"the file is not a LAS or LAZ file: it begins with {start!r}, not with b'LASF'" if start else "the file is empty"
        )
        return InputError(
            problem, where=str(path), remedy="export the points as LAS or LAZ, or give the file the suffix of its format"
        )
    reason = f" ({error})" if type(error) is ValueError else ""
    problem = f"the file is not a complete LAS or LAZ file{reason}: what its header states is missing or damaged"
    return InputError(problem, where=str(path), remedy=_COPY)


def check_quantisation(header: laspy.LasHeader, path: Path) -> None:
    """Raise InputError if scale and offset in a LAS header, which turn stored integers into coordinates, are unusable.

    path: the file, for the error.
    """
    scales, offsets = np.asarray(header.scales), np.asarray(header.offsets)
    if not (np.isfinite(scales).all() and (scales > 0).all() and np.isfinite(offsets).all()):
        raise InputError(
            f"the file has scale factors {scales.tolist()} and offsets {offsets.tolist()}",
            where=str(path),
            allowed="finite numbers, scale factors above 0",
            remedy="export the file again with scale factors above 0",
        )


def _standard_channels(las: Any) -> dict[str, NDArray[Any]]:
    """Return recorded returns, scan angles and similar fields; point formats below 6 have angles in degrees."""
    channels: dict[str, NDArray[Any]] = {}
    for field in _FURTHER:
        if field in las.point_format.dimension_names and np.any(values := np.asarray(las[field])):
            channels[field] = np.array(values)
    count = np.asarray(las["number_of_returns"], dtype=np.uint8)
    if np.any(count > 1):
        channels |= {"return_number": np.asarray(las["return_number"], dtype=np.uint8), "number_of_returns": count}
    name, step = ("scan_angle", _SCAN_ANGLE_STEP) if las.point_format.id >= 6 else ("scan_angle_rank", math.radians(1.0))
    angle = np.asarray(las[name])
    return channels | ({"scan_angle_rad": angle * step} if np.any(angle) else {})


def check_extent(path: Path) -> None:
    """Raise ValueError for a LAS or LAZ file at which the reading library would abort the process.

    That is a file cut off in its header, or with an absurd table of LAZ chunks.
    """
    with path.open("rb") as file:
        _check_records(file.read(_HEADER_BYTES), path.stat().st_size)
        file.seek(0)
        header = laspy.LasHeader.read_from(file)
        if path.stat().st_size < header.offset_to_point_data:
            raise ValueError("cut off within the header")
        check_counts(header, path)
        if not header.are_points_compressed:
            return
        chunk = _check_chunk_size(header)
        file.seek(header.offset_to_point_data)
        (table,) = struct.unpack("<q", file.read(8))
        if table < 0:  # written as a stream: the table's offset is at the end
            file.seek(-8, os.SEEK_END)
            (table,) = struct.unpack("<q", file.read(8))
        file.seek(table + 4)
        (chunks,) = struct.unpack("<I", file.read(4))
        if chunks > header.point_count or (chunk and chunks != -(-header.point_count // chunk)):
            raise ValueError(f"{chunks:,} chunks for {header.point_count:,} points")


def _check_records(start: bytes, size: int) -> None:
    """Raise ValueError for more variable-length records than fit into the file; laspy would look for each of them."""
    (count,) = struct.unpack_from("<I", start, 100)
    (extended,) = struct.unpack_from("<I", start, 243) if start[25] >= 4 and len(start) == _HEADER_BYTES else (0,)
    if 54 * count + 60 * extended > size:
        raise ValueError(f"{count + extended:,} records in {size:,} bytes")


def _check_chunk_size(header: laspy.LasHeader) -> int:
    """Return the points of a chunk, 0 if that varies or is unknown.

    Raises ValueError for chunks far larger than any program makes: lazrs would allocate a complete one, or abort.
    """
    for record in header.vlrs.get("LasZipVlr"):
        (size,) = struct.unpack_from("<I", record.record_data, _CHUNK_SIZE_AT)
        if max(header.point_count, _LARGEST_CHUNK) < size < _VARIABLE_CHUNKS:
            raise ValueError(f"chunks of {size:,} points for {header.point_count:,} points")
        return 0 if size == _VARIABLE_CHUNKS else int(size)
    return 0


def _header(cloud: PointCloud, given: LazHeader, full_scale: float) -> laspy.LasHeader:
    """Return the header of a file to write."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.generating_software, header.system_identifier, header.creation_date = "scarpsim", "scarpsim", given.date
    header.global_encoding.wkt = True  # required for point formats from 6
    if given.standard_time:
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.add_extra_dims([laspy.ExtraBytesParams(name, channel.dtype) for name, channel in cloud.extra.items()])
    for record in header.vlrs.get("ExtraBytesVlr"):
        for dimension in record.extra_bytes_structs:  # without extremes, which laspy takes from the first point of each piece
            dimension.options &= ~(dimension.MIN_BIT_MASK | dimension.MAX_BIT_MASK)
    header.scales, header.offsets = _quantisation(cloud.points, given.scale_m)
    if given.wkt:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(given.wkt))
    if cloud.intensity is not None:
        header.vlrs.append(laspy.VLR(_USER, _FULL_SCALE_RECORD, "intensity of 65535 counts", struct.pack("<d", full_scale)))
    return header


def writer(file: BinaryIO, header: laspy.LasHeader, compress: bool) -> laspy.LasWriter:
    """Return a writer of LAS records to an open file, whose bytes do not depend on the number of threads.

    header: of the file. compress: whether to write LAZ.
    """
    return laspy.LasWriter(file, header, do_compress=compress, laz_backend=laspy.LazBackend.LazrsParallel, closefd=False)


def _quantisation(points: FloatArray, scale_m: float) -> tuple[FloatArray, FloatArray]:
    """Return (3,) scales and (3,) offsets, m, with which the coordinates fit into int32."""
    if len(points) == 0:
        return np.full(3, scale_m), np.zeros(3)
    low, high = (np.array([extreme(column) for column in points.T]) for extreme in (np.min, np.max))
    if not np.isfinite(low + high).all():
        raise ValueError("points must be finite: leave out those without a return")
    offsets = np.rint((low + high) / 2)
    reach = float(np.maximum(high - offsets, offsets - low).max())
    while reach / scale_m > _LARGEST:
        scale_m *= 10
    return np.full(3, scale_m), offsets


def _fill(record: NDArray[np.void], header: laspy.LasHeader, points: FloatArray) -> None:
    """Store the coordinates of points."""
    for name, coordinate, offset, scale in zip("XYZ", points.T, header.offsets, header.scales, strict=True):
        counts = coordinate - offset
        counts /= scale
        record[name] = np.rint(counts, out=counts)


def _return_bits(number: NDArray[np.integer] | None, count: NDArray[np.integer] | None) -> NDArray[np.uint8]:
    """Return return number and number of returns in the two half-bytes of point format 6, (n,) or one for all points."""
    first, last = (np.asarray(1 if given is None else given) for given in (number, count))
    if first.size and (first.min() < 1 or np.any(first > last) or last.max() > _MOST_RETURNS):
        raise ValueError(f"return numbers run from 1 to the number of returns, at most {_MOST_RETURNS}")
    return (first + last * (_MOST_RETURNS + 1)).astype(np.uint8)


def _full_scale(intensity: NDArray[np.floating] | None) -> float:
    """Return the power stored as 65535 counts: the smallest power of two that no point exceeds."""
    brightest = float(np.max(intensity)) if intensity is not None and len(intensity) else 1.0
    return float(2.0 ** np.ceil(np.log2(brightest))) if brightest > 0 else 1.0


def _stored_full_scale(header: laspy.LasHeader) -> float:
    """Return the power of 65535 counts in a file."""
    for record in header.vlrs:
        if record.user_id == _USER and record.record_id == _FULL_SCALE_RECORD:
            return float(struct.unpack("<d", record.record_data)[0])
    return 1.0
