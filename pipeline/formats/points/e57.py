"""Read and write E57 point clouds (ASTM E2807), scans with their grid and pose, by libE57Format (pye57).

Cartesian and spherical scans are read. Cartesian scans in double precision are written, with points in the scanner's frame and
the pose. Channels for which E57 has no field (channels of truth) are not written.
"""

from __future__ import annotations

import struct
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pye57 import libe57

from pipeline.formats.files.atomic import writing
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.units import not_understood, understood_crs, units_of_crs
from scene.common.errors import InputError
from scene.common.regular_file import check_file
from scene.geometry.mesh import FloatArray

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")
"""Fields that mark invalid records: 1, the direction is valid but not the distance; 2, nothing is."""
_INVALID_INTENSITY = "isIntensityInvalid"
_SIGNATURE, _HEADER_BYTES, _LENGTH_AT = b"ASTM-E57", 48, 16
"""First bytes of the header, its length, and the offset of the file's length in it."""
_TYPES = {
    "intensity": "f", "timeStamp": "d", "rowIndex": "q", "columnIndex": "q", "returnIndex": "q", "returnCount": "q",
    "colorRed": "H", "colorGreen": "H", "colorBlue": "H",
}  # fmt: skip
"""Type of each field."""
_NAMES = {
    "rowIndex": "row", "columnIndex": "column", "returnIndex": "return_index", "returnCount": "return_count",
    "colorRed": "red", "colorGreen": "green", "colorBlue": "blue",
}  # fmt: skip
"""E57's fields that become extra channels, and the channels' names."""
_PIECE = 1_000_000
"""Points read at a time."""
_GUIDS = uuid.UUID("7f5c9a52-9f0e-4f3c-9c2b-2f1f5e6f7c11")
"""Name space of the identifiers."""


@dataclass(frozen=True)
class E57Scan:
    """One laser scan of an E57 file.

    Attributes
    ----------
    name : Name of the scan.
    cloud : Points in the scanner's frame, m; extra channels have row and column of the scan's grid.
    position : (3,) position of the scanner in the file's frame, m.
    rotation : (3, 3) scanner to the file's frame.
    """

    name: str
    cloud: PointCloud
    position: FloatArray
    rotation: FloatArray

    @property
    def placed(self) -> PointCloud:
        """The scan's points transformed from the scanner's to the file's frame, m."""
        points = np.einsum("ij,nj->ni", self.rotation, self.cloud.points) + self.position
        return replace(self.cloud, points=points)


def write_e57(path: Path, scans: Sequence[E57Scan]) -> None:
    """Write laser scans to an E57 file; equal arguments give equal bytes.

    Extra channels `row` and `column` (integers from 0) become the scan's grid, others are left out. Raises InputError if the
    file cannot be written, ValueError for a scan without points.
    """
    with writing(path) as temporary:
        image = libe57.ImageFile(str(temporary), "w")
        try:
            data = _write_header(image)
            for number, scan in enumerate(scans):
                _write_scan(image, data, scan, number)
        finally:
            image.close()


def read_e57(path: Path) -> list[E57Scan]:
    """Read all laser scans of an E57 file, without the points that they mark as invalid.

    Raises InputError for a missing or damaged file, one without points, or a coordinate system that is not in metres.
    """
    where = str(check_file(path))
    _check_length(path)
    try:
        image = libe57.ImageFile(where, "r")
        try:
            root = image.root()
            notes = _check_metres(root, where)
            nodes = root["data3D"] if root.isDefined("data3D") else ()
            scans = [_read_scan(image, nodes[number], number, where) for number in range(len(nodes))]
        finally:
            image.close()
    except (libe57.E57Exception, RuntimeError, ValueError, KeyError) as error:
        if isinstance(error, InputError):
            raise
        problem = f"the file is damaged: its {_part_of(error)} cannot be read"
        raise InputError(problem, where=where, remedy="copy the complete file again, or export the scans again as E57") from None
    if not any(len(scan.cloud.points) for scan in scans):
        problem = (
            "the file has no scans"
            if not scans
            else "the file has no points: all records are marked as invalid, or there are none"
        )
        raise InputError(problem, where=where, remedy="export the file again, with its points")
    return [replace(scan, cloud=scan.cloud.noted(*notes)) for scan in scans]


# --- reading


def _check_length(path: Path) -> None:
    """Raise InputError for a file that is not E57, or is shorter than its header states."""
    with path.open("rb") as file:
        start = file.read(_HEADER_BYTES)
    size, where = path.stat().st_size, str(path)
    if not start.startswith(_SIGNATURE):
        start_of_file = f"begins with {start[:8]!r}, not with {_SIGNATURE!r}" if start else "is empty"
        problem = f"the file is not a complete E57 file: it {start_of_file}"
        raise InputError(problem, where=where, remedy="export the scans as E57, or give the file the suffix of its format")
    stated = struct.unpack_from("<Q", start, _LENGTH_AT)[0] if len(start) == _HEADER_BYTES else _HEADER_BYTES
    if size < stated:
        problem = f"the file is not a complete E57 file: its header states {stated:,} bytes, but it has {size:,}"
        raise InputError(
            problem, where=where, remedy="the file was cut off: copy the complete file again, or export the scans again as E57"
        )


def _check_metres(root: Any, where: str) -> tuple[str, ...]:
    """Return a note on a coordinate system that is not understood.

    Raises InputError if its unit is not the metre, which E57 requires.
    """
    text = root["coordinateMetadata"].value().strip() if root.isDefined("coordinateMetadata") else ""
    if not text:
        return ()
    crs = understood_crs(text)
    if crs is None:
        return (not_understood(text, where),)
    units = units_of_crs(crs, where)
    if units is not None and not units.in_metres:
        raise InputError(
            f"the file states {units.source}, whose unit is {units.name}, but E57 files are in metres", where=where,
            remedy="export the scans with a coordinate system in metres, or export them as LAS",
        )  # fmt: skip
    return ()


def _part_of(error: Exception) -> str:
    """Return which part of the file is damaged, from libE57Format's message."""
    text = str(error).lower()
    parts = {"checksum": "pages (a checksum does not agree)", "crc": "pages (a checksum does not agree)", "xml": "header in XML"}
    return next((part for word, part in parts.items() if word in text), "points")


def _read_scan(image: Any, node: Any, number: int, where: str) -> E57Scan:
    """Read one scan."""
    name = node["name"].value() if node.isDefined("name") else f"scan {number}"
    columns, unread = _read_columns(image, node["points"], f"{where} ({number + 1}: {name})")
    valid = np.ones(len(next(iter(columns.values()), ())), dtype=bool)
    for state in _INVALID:
        valid &= columns.pop(state) == 0 if state in columns else True
    if not valid.all():
        columns = {field: column[valid] for field, column in columns.items()}
    notes = [f"{int((~valid).sum()):,} records that the file marks as invalid are left out"] if not valid.all() else []
    notes += [f"fields that are not read: {', '.join(unread)}"] if unread else []
    cloud = PointCloud(
        points=_points(columns, where),
        intensity=_intensity(columns),
        gps_time=columns.get("timeStamp"),
        extra={label: columns[field].astype(np.int32) for field, label in _NAMES.items() if field in columns},
        notes=tuple(notes),
    )
    position, rotation = _pose(node)
    return E57Scan(name, cloud, position, rotation)


def _intensity(columns: dict[str, NDArray[Any]]) -> NDArray[Any] | None:
    """Return the intensity, NaN where the file marks it as invalid; None if all of it is."""
    intensity, invalid = columns.get("intensity"), columns.pop(_INVALID_INTENSITY, None)
    if intensity is None or invalid is None or not invalid.any():
        return intensity
    return None if invalid.all() else np.where(invalid == 0, intensity, np.float32(np.nan))


def _read_columns(image: Any, points: Any, where: str) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Read the fields of a scan's points, and the names of unknown fields.

    Points are read in pieces, so that memory is used for what exists, not for what the file claims. Raises InputError if these
    differ.
    """
    count = points.childCount()
    prototype = libe57.StructureNode(points.prototype())
    fields = {prototype[number].elementName() for number in range(prototype.childCount())}
    types = dict.fromkeys(_CARTESIAN + _SPHERICAL, "d") | dict.fromkeys((*_INVALID, _INVALID_INTENSITY), "b") | _TYPES
    unread = sorted(fields - set(types))
    piece = max(min(count, _PIECE), 0)
    columns = {name: np.empty(piece, dtype=kind) for name, kind in types.items() if name in fields}
    if count <= 0:
        return columns, unread
    pieces: list[dict[str, NDArray[Any]]] = []
    reader = points.reader(_buffers(image, columns, piece))
    while read := reader.read():
        pieces.append({name: column[:read].copy() for name, column in columns.items()})
    reader.close()
    found = sum(len(next(iter(each.values()), ())) for each in pieces)
    if found != count:
        raise InputError(
            f"the scan has {found:,} points but states {count:,}", where=where,
            remedy="copy the complete file again, or export the scans again as E57",
        )  # fmt: skip
    return {name: np.concatenate([each[name] for each in pieces]) for name in columns}, unread


def _points(columns: dict[str, NDArray[Any]], where: str) -> FloatArray:
    """Return (n, 3) Cartesian points, m; spherical ones have an elevation above the horizon instead of a zenith angle."""
    if all(name in columns for name in _CARTESIAN):
        return np.stack([columns[name] for name in _CARTESIAN], axis=1)
    if not all(name in columns for name in _SPHERICAL):
        raise InputError(
            "the scan has points without coordinates",
            where=where,
            allowed="cartesianX, Y, Z or sphericalRange, Azimuth, Elevation",
            remedy="export the file again, with its coordinates",
        )
    distance, azimuth, elevation = (columns[name] for name in _SPHERICAL)
    level = distance * np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=1)


def _pose(node: Any) -> tuple[FloatArray, FloatArray]:
    """Return position and rotation of a scan."""
    from scipy.spatial.transform import Rotation

    if not node.isDefined("pose"):
        return np.zeros(3), np.eye(3)
    pose = node["pose"]
    position, rotation = np.zeros(3), np.eye(3)
    if pose.isDefined("translation"):
        position = np.array([pose["translation"][axis].value() for axis in "xyz"])
    if pose.isDefined("rotation"):
        rotation = Rotation.from_quat([pose["rotation"][axis].value() for axis in "xyzw"]).as_matrix()
    return position, rotation


# --- writing


def _write_header(image: Any) -> Any:
    """Write the file's own fields, and return the list of scans."""
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    root = image.root()
    root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(image, f"{{{uuid.uuid5(_GUIDS, 'file')}}}"))
    root.set("versionMajor", libe57.IntegerNode(image, libe57.E57_FORMAT_MAJOR))
    root.set("versionMinor", libe57.IntegerNode(image, libe57.E57_FORMAT_MINOR))
    root.set("e57LibraryVersion", libe57.StringNode(image, libe57.E57_LIBRARY_ID))
    root.set("coordinateMetadata", libe57.StringNode(image, ""))
    data = libe57.VectorNode(image, True)
    root.set("data3D", data)
    root.set("images2D", libe57.VectorNode(image, True))
    return data


def _write_scan(image: Any, data: Any, scan: E57Scan, number: int) -> None:
    """Write one scan."""
    from scipy.spatial.transform import Rotation

    columns = _columns(scan.cloud)
    node = libe57.StructureNode(image)
    node.set("guid", libe57.StringNode(image, f"{{{uuid.uuid5(_GUIDS, f'{number} {scan.name}')}}}"))
    node.set("name", libe57.StringNode(image, scan.name))
    x, y, z, w = Rotation.from_matrix(scan.rotation).as_quat(canonical=True)
    pose = _structure(image, rotation=_structure(image, w=w, x=x, y=y, z=z), translation=_structure(image, **_xyz(scan.position)))
    node.set("pose", pose)
    node.set("cartesianBounds", _bounds(image, {axis: columns[f"cartesian{axis.upper()}"] for axis in "xyz"}))
    indices = {name.removesuffix("Index"): columns[name] for name in ("rowIndex", "columnIndex") if name in columns}
    if indices:
        node.set("indexBounds", _bounds(image, indices))
    if "intensity" in columns:
        node.set("intensityLimits", _bounds(image, {"intensity": columns["intensity"]}))
    prototype = libe57.StructureNode(image)
    for name, column in columns.items():
        prototype.set(name, _field(image, column))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    node.set("points", points)
    data.append(node)
    writer = points.writer(_buffers(image, columns, len(scan.cloud.points)))
    writer.write(len(scan.cloud.points))
    writer.close()


def _columns(cloud: PointCloud) -> dict[str, NDArray[Any]]:
    """Return the fields of the file in the types that libE57 takes."""
    if not len(cloud.points):
        raise ValueError("a scan without points cannot be written")
    present: dict[str, Any] = dict(zip(_CARTESIAN, cloud.points.T, strict=True))
    present |= {"intensity": cloud.intensity, "timeStamp": cloud.gps_time}
    present |= {name: cloud.extra.get(label) for name, label in _NAMES.items() if label in ("row", "column")}
    return {
        name: np.ascontiguousarray(column, dtype=_TYPES.get(name, "d")) for name, column in present.items() if column is not None
    }


def _field(image: Any, column: NDArray[Any]) -> Any:
    """Return the prototype of a field."""
    low, high = column.min().item(), column.max().item()
    if column.dtype.kind == "f":
        return libe57.FloatNode(image, low, libe57.E57_SINGLE if column.itemsize == 4 else libe57.E57_DOUBLE, low, high)
    return libe57.IntegerNode(image, low, low, high)


def _bounds(image: Any, columns: dict[str, NDArray[Any]]) -> Any:
    """Return the minimum and maximum of columns as a node."""
    limits = {f"{name}{end}": value for name, c in columns.items() for end, value in (("Minimum", c.min()), ("Maximum", c.max()))}
    return _structure(image, **{name: value.item() for name, value in limits.items()})


def _structure(image: Any, **values: Any) -> Any:
    """Return values as a structure node."""
    node = libe57.StructureNode(image)
    for name, value in values.items():
        kind = libe57.IntegerNode if isinstance(value, int) else libe57.FloatNode
        node.set(name, kind(image, value) if isinstance(value, int | float) else value)
    return node


def _xyz(vector: FloatArray) -> dict[str, float]:
    """Return a vector's components by axis."""
    return {axis: float(value) for axis, value in zip("xyz", vector, strict=True)}


def _buffers(image: Any, columns: dict[str, NDArray[Any]], count: int) -> Any:
    """Return buffers for reading into or writing from the columns; a buffer does not keep its column alive."""
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        buffers.append(libe57.SourceDestBuffer(image, name, column, count, True, True))
    return buffers
