"""Read and write LAS and LAZ files of any size in chunks, so that memory does not depend on the number of points."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from lazrs import LazrsError  # type: ignore[import-untyped]
from numpy.typing import DTypeLike, NDArray

from pipeline.formats.files.atomic import writing
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.las_statements import flagged, stated_units
from pipeline.formats.points.laz import (
    POINT_FIELDS,
    LazHeader,
    PulseChannels,
    StoredCloud,
    check_extent,
    check_quantisation,
    damaged,
    writer,
)
from pipeline.formats.points.points import check_reach
from pipeline.formats.units import agreed_units
from scene.common.errors import InputError
from scene.common.regular_file import check_file
from scene.common.threads import map_in_threads
from scene.geometry.bounds import bounding_box
from scene.geometry.mesh import FloatArray

CHUNK = 2_000_000
"""Points in memory at a time."""
_FILLED_AT_ONCE = 1 << 14
"""Points whose records are filled at a time; their arrays then stay in the processor's cache."""
_SINGLE_RETURN = 0x11
"""Return number and number of returns of a pulse with one return, as point format 6 stores them."""


def count_points(path: Path) -> int:
    """Return the number of points that the header of a LAS or LAZ file states, to know whether they fit into memory.

    It is 0 for a file that is not readable as LAS or LAZ.
    """
    try:
        with laspy.open(path) as reader:
            return int(reader.header.point_count)
    except (OSError, laspy.LaspyException, LazrsError, ValueError, struct.error, MemoryError, OverflowError):
        return 0


def read_chunks(path: Path, unit: str | None = None) -> Iterator[FloatArray]:
    """Read a LAS or LAZ file that may be larger than the memory: yield its points (n, 3), m, chunk by chunk.

    Points are left out if they are flagged as withheld or synthetic, classified as noise, or at 0 0 0 (no return).

    Parameters
    ----------
    path : LAS or LAZ file.
    unit : Name of the coordinates' unit, such as "mm"; None: as the file states, or metres.

    Raises
    ------
    InputError
        For a missing, truncated or other file, impossible coordinates, and a unit that contradicts the file.
    """
    where = str(check_file(path))
    read = 0
    try:
        check_extent(path)
        with laspy.open(path, decompression_selection=POINT_FIELDS) as reader:
            check_quantisation(reader.header, path)
            factors = agreed_units(stated_units(reader.header, where)[0], unit, where).factors()
            for record in reader.chunk_iterator(CHUNK):
                read += len(record)
                yield _in_use(record, factors, where)
            stated = int(reader.header.point_count)
    except InputError:
        raise
    except (OSError, laspy.LaspyException, LazrsError, ValueError, struct.error, MemoryError, OverflowError) as error:
        raise damaged(path, error) from None
    if read < stated:
        raise InputError(
            f"the file has {read:,} of the {stated:,} points that it states",
            where=where,
            remedy="copy the complete file again, or export the points again as LAZ",
        )


class ChunkWriter:
    """Writes a LAZ file from points that are added one array after another; `chunk_writer` opens it.

    Attributes
    ----------
    scales, offsets : (3,) arrays
        Step of the stored coordinates, m, and the place from which they are counted, m.
    """

    def __init__(self, las: laspy.LasWriter) -> None:
        self.scales, self.offsets = np.asarray(las.header.scales), np.asarray(las.header.offsets)
        self._las = las
        self._records: NDArray[Any] = np.zeros(0, las.header.point_format.dtype())

    def write(self, count: int, fill: Callable[[NDArray[np.void], slice], None]) -> None:
        """Write the next points, each of which is the only return of its pulse.

        Parameters
        ----------
        count : int
            Number of points.
        fill : callable
            Fills an array of records (k,) with the k points that a slice of `range(count)` names: the coordinates "X", "Y" and
            "Z" in steps, and the extra dimensions by their names. Threads call it.
        """
        if len(self._records) < count:
            self._records = np.zeros(count, self._records.dtype)
            self._records["bit_fields"] = _SINGLE_RETURN
        records = self._records[:count]

        def filled(start: int) -> NDArray[Any]:
            part = slice(start, min(start + _FILLED_AT_ONCE, count))
            fill(records[part], part)
            return bounding_box(np.stack([records[axis][part] for axis in "XYZ"]).T)

        boxes = np.array(map_in_threads(filled, range(0, count, _FILLED_AT_ONCE)))
        self._las.point_writer.write_points(laspy.PackedPointRecord(records, self._las.header.point_format))
        self._extend_header(count, boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0))

    def _extend_header(self, count: int, low: NDArray[Any], high: NDArray[Any]) -> None:
        """Extend numbers and bounding box in the header, as laspy does, but without another look at all points."""
        header = self._las.header
        header.mins = np.minimum(header.mins, low * self.scales + self.offsets)
        header.maxs = np.maximum(header.maxs, high * self.scales + self.offsets)
        header.number_of_points_by_return[0] += count
        header.point_count += count


@contextmanager
def chunk_writer(path: Path, bounds: FloatArray, types: Mapping[str, DTypeLike], header: LazHeader) -> Iterator[ChunkWriter]:
    """Open a LAZ file for points that may not fit into the memory; it exists once the block has ended without an error.

    Parameters
    ----------
    path : File to write.
    bounds : (2, 3) corners of a box about all points, m, from which the stored offset follows.
    types : Types of the extra dimensions by name.
    header : Header values.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    corners = PointCloud(bounds, extra={name: np.zeros(2, kind) for name, kind in types.items()})
    stored = StoredCloud.of(corners, PulseChannels(), header)
    with writing(path) as temporary, temporary.open("wb") as file, writer(file, stored.header, compress=True) as las:
        yield ChunkWriter(las)


def _in_use(record: Any, factors: FloatArray, where: str) -> FloatArray:
    """Return the points of a chunk, m, that the file does not take out of use; records at 0 0 0 stand for no return."""
    points = np.column_stack([record.x, record.y, record.z])
    out = flagged(record)[0] | ((points[:, 0] == 0) & (points[:, 1] == 0) & (points[:, 2] == 0))
    points = (points[~out] if out.any() else points) * factors
    if len(points):
        check_reach(points, where)
    return points
