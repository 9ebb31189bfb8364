"""Read and write LAS and LAZ files of any size in chunks, so that memory does not depend on the number of points."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from lazrs import LazrsError  # type: ignore[import-untyped]
from numpy.typing import NDArray

from pipeline.formats.files.atomic import writing
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.las_statements import flagged, stated_units
from pipeline.formats.points.laz import LazHeader, PulseChannels, StoredCloud, check_extent, check_quantisation, damaged, writer
from pipeline.formats.points.points import check_reach
from pipeline.formats.units import agreed_units
from scene.common.errors import InputError
from scene.common.regular_file import check_file
from scene.geometry.mesh import FloatArray

CHUNK = 2_000_000
"""Points in memory at a time."""
_FIELDS = (
    laspy.DecompressionSelection.XY_RETURNS_CHANNEL
    | laspy.DecompressionSelection.Z
    | laspy.DecompressionSelection.CLASSIFICATION
    | laspy.DecompressionSelection.FLAGS
)
"""Fields that are decompressed: coordinates, and what takes points out of use."""


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
        with laspy.open(path, decompression_selection=_FIELDS) as reader:
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


def write_chunks(
    path: Path, bounds: FloatArray, chunks: Iterable[tuple[FloatArray, Mapping[str, NDArray[Any]]]], header: LazHeader
) -> None:
    """Write points that may not fit into the memory to a LAZ file, chunk by chunk.

    Parameters
    ----------
    path : File to write.
    bounds : (2, 3) corners of a box about all points, m, from which the stored offset follows.
    chunks : Points (n, 3), m, with their extra dimensions by name: the same names and types in each chunk, one chunk at least.
    header : Header values.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    waiting = iter(chunks)
    first = next(waiting)
    corners = PointCloud(bounds, extra={name: np.zeros(2, values.dtype) for name, values in first[1].items()})
    stored = StoredCloud.of(corners, PulseChannels(), header)
    with writing(path) as temporary, temporary.open("wb") as file, writer(file, stored.header, compress=True) as las:
        for points, extra in itertools.chain([first], waiting):
            las.write_points(stored.with_points(PointCloud(points, extra=dict(extra))).records(slice(None)))


def _in_use(record: Any, factors: FloatArray, where: str) -> FloatArray:
    """Return the points of a chunk, m, that the file does not take out of use; records at 0 0 0 stand for no return."""
    points = np.column_stack([record.x, record.y, record.z])
    out = flagged(record)[0] | ((points[:, 0] == 0) & (points[:, 1] == 0) & (points[:, 2] == 0))
    points = (points[~out] if out.any() else points) * factors
    if len(points):
        check_reach(points, where)
    return points
