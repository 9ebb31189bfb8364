"""PLY meshes and point clouds: binary and ASCII read, binary little-endian written."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.atomic import writing
from pipeline.formats.point_cloud import PointCloud
from scene.errors import InputError
from scene.mesh import TriangleMesh

_CHUNK = 1_000_000
"""Records in memory at a time while writing."""
_LONGEST_HEADER = 65536
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_FACE_LISTS = ("vertex_indices", "vertex_index")

Columns = Mapping[str, NDArray[Any]]


def write_ply(path: Path, mesh: TriangleMesh) -> None:
    """Write a mesh: vertices as double, albedo as float, blocks as int where the mesh has them."""
    vertex = _xyz(mesh.vertices) | _present(albedo=mesh.vertex_albedo, block=mesh.vertex_block)
    face = {"vertex_indices": mesh.faces} | _present(block=mesh.face_block)
    _write(path, {"vertex": vertex, "face": face})


def write_ply_points(path: Path, cloud: PointCloud) -> None:
    """Write a point cloud: x, y, z as double, the other channels in the type they have."""
    _write(path, {"vertex": _xyz(cloud.points) | _present(intensity=cloud.intensity, gps_time=cloud.gps_time) | cloud.extra})


def read_ply(path: Path) -> TriangleMesh:
    """Read a mesh of triangles; properties other than ours are left out.

    Raises InputError for a missing or damaged file, faces that are not triangles and indices of vertices that are not there.
    """
    elements = _read(path)
    vertex, face = elements.get("vertex"), elements.get("face")
    if vertex is None or face is None:
        raise InputError("holds no mesh, only points" if face is None else "holds no vertices", where=str(path))
    faces = next((face[name] for name in _FACE_LISTS if name in face), None)
    if faces is None or faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError("holds faces that are not triangles", where=str(path), remedy="triangulate the mesh")
    vertices = _points(vertex, path)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InputError(f"a face refers to a vertex beyond the {len(vertices):,} there are", where=str(path))
    return TriangleMesh(
        vertices,
        np.ascontiguousarray(faces, dtype=np.int32),
        vertex_albedo=_column(vertex, "albedo", np.float32),
        vertex_block=_column(vertex, "block", np.int32),
        face_block=_column(face, "block", np.int32),
    )


def read_ply_points(path: Path) -> PointCloud:
    """Read the vertices of any PLY file with all their scalar properties; raises InputError for a missing or damaged file."""
    vertex = _read(path, only="vertex").get("vertex")
    if vertex is None:
        raise InputError("holds no vertices", where=str(path))
    names = [name for name in vertex if name not in ("x", "y", "z") and vertex[name].ndim == 1]
    extra = {name: _native(vertex[name]) for name in names}
    return PointCloud(_points(vertex, path), _column(extra, "intensity"), _column(extra, "gps_time", np.float64), _others(extra))


def _others(extra: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name: channel for name, channel in extra.items() if name not in ("intensity", "gps_time")}


def _xyz(points: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    return {name: points[:, axis] for axis, name in enumerate("xyz")}


def _present(**columns: NDArray[Any] | None) -> dict[str, NDArray[Any]]:
    return {name: column for name, column in columns.items() if column is not None}


def _points(vertex: Columns, path: Path) -> NDArray[np.float64]:
    missing = [name for name in "xyz" if name not in vertex]
    if missing:
        raise InputError(f"has vertices without {', '.join(missing)}", where=str(path))
    points = np.empty((len(vertex["x"]), 3))
    for axis, name in enumerate("xyz"):
        points[:, axis] = vertex[name]
    return points


def _column(columns: Columns, name: str, dtype: Any = None) -> NDArray[Any] | None:
    return np.array(columns[name], dtype=dtype) if name in columns else None


def _native(column: NDArray[Any]) -> NDArray[Any]:
    """A contiguous copy in the machine's byte order."""
    return np.array(column, dtype=column.dtype.newbyteorder("="))


def _write(path: Path, elements: Mapping[str, Columns]) -> None:
    """Write elements; a column (n,) is a scalar property, (n, k) a list of k with a uchar count."""
    with writing(path) as temporary, temporary.open("wb") as file:
        file.write(_header_text(elements).encode("ascii"))
        for columns in elements.values():
            record = _record_type(columns)
            count = len(next(iter(columns.values())))
            for start in range(0, count, _CHUNK):
                _write_rows(file, columns, record, slice(start, min(start + _CHUNK, count)))


def _write_rows(file: BinaryIO, columns: Columns, record: np.dtype[Any], rows: slice) -> None:
    block = np.empty(rows.stop - rows.start, dtype=record)
    for name, column in columns.items():
        block[name] = column[rows]
        if column.ndim == 2:
            block[f"count {name}"] = column.shape[1]
    file.write(block.data)  # not ndarray.tofile, which hides why a write fails


def _header_text(elements: Mapping[str, Columns]) -> str:
    lines = ["ply", "format binary_little_endian 1.0"]
    for element, columns in elements.items():
        lines.append(f"element {element} {len(next(iter(columns.values())))}")
        for name, column in columns.items():
            kind = _NAMES[column.dtype.str[1:]]
            lines.append(f"property {'list uchar ' if column.ndim == 2 else ''}{kind} {name}")
    return "\n".join([*lines, "end_header", ""])


def _record_type(columns: Columns) -> np.dtype[Any]:
    fields: list[Any] = []
    for name, column in columns.items():
        kind = f"<{column.dtype.str[1:]}"
        fields += [(f"count {name}", "u1"), (name, kind, column.shape[1:])] if column.ndim == 2 else [(name, kind)]
    return np.dtype(fields)


@dataclass
class _Element:
    """One element of a header. properties: name to (type of the value, type of the list's count or "")."""

    name: str
    count: int
    properties: dict[str, tuple[str, str]] = field(default_factory=dict)


def _read(path: Path, only: str = "") -> dict[str, Columns]:
    """The elements of a file, up to the one called `only`."""
    try:
        with path.open("rb") as file:
            order, elements = _header(file)
            wanted = itertools.islice(elements, _last(elements, only))
            return {element.name: _columns(file, element, order) for element in wanted}
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy="check the path") from None
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise InputError(f"is not a whole PLY file ({error})", where=str(path), remedy="export it again") from None


def _last(elements: list[_Element], only: str) -> int:
    return next((index + 1 for index, element in enumerate(elements) if element.name == only), len(elements))


def _header(file: BinaryIO) -> tuple[str, list[_Element]]:
    """Byte order ("" for ASCII) and elements; leaves the file at the first byte of the data."""
    elements: list[_Element] = []
    order = None
    for words in _header_lines(file):
        match words:
            case ["format", kind, "1.0"]:
                order = _ORDERS[kind]
            case ["element", name, count]:
                elements.append(_Element(name, int(count)))
            case ["property", "list", counter, kind, name]:
                elements[-1].properties[name] = (_TYPES[kind], _TYPES[counter])
            case ["property", kind, name]:
                elements[-1].properties[name] = (_TYPES[kind], "")
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise ValueError(f"header line '{' '.join(words)[:80]}'")
    if order is None or any(element.count < 0 for element in elements):
        raise ValueError("the header names no format" if order is None else "a negative count")
    return order, elements


def _header_lines(file: BinaryIO) -> Iterator[list[str]]:
    if file.readline(16).strip() != b"ply":
        raise ValueError("it does not begin with 'ply'")
    while (line := file.readline(_LONGEST_HEADER)).strip() != b"end_header":
        if not line.endswith(b"\n") or file.tell() > _LONGEST_HEADER:
            raise ValueError("the header has no end")
        yield line.decode("ascii", errors="replace").split()


def _columns(file: BinaryIO, element: _Element, order: str) -> Columns:
    """Read one element, views of one array of records; lists must have one length throughout. Leaves the file after it."""
    if not element.count or not element.properties:
        return {name: np.empty((0, 3) if counter else 0, kind) for name, (kind, counter) in element.properties.items()}
    rows = _binary_rows(file, element, order) if order else _ascii_rows(file, element)
    for name, (_, counter) in element.properties.items():
        if counter and np.any(rows[f"count {name}"] != rows[name].shape[1]):
            raise ValueError(f"{element.name} lists of different lengths, only triangles can be read")
    return {name: rows[name] for name in element.properties}


def _binary_rows(file: BinaryIO, element: _Element, order: str) -> NDArray[Any]:
    record = np.dtype(_fields(element, order, _binary_lengths(file, element, order)))
    left = _size(file) - file.tell()
    if element.count * record.itemsize > left:
        raise ValueError(f"{element.count:,} {element.name} records of {record.itemsize} bytes, {left:,} bytes are left")
    return np.fromfile(file, dtype=record, count=element.count)


def _binary_lengths(file: BinaryIO, element: _Element, order: str) -> dict[str, int]:
    """Length of each list in the first record; the file stays where it is."""
    start, lengths = file.tell(), {}
    for name, (kind, counter) in element.properties.items():
        if counter:
            lengths[name] = int(np.frombuffer(file.read(np.dtype(counter).itemsize), dtype=order + counter)[0])
        file.seek(lengths.get(name, 1) * np.dtype(kind).itemsize, 1)
    file.seek(start)
    return lengths


def _fields(element: _Element, order: str, lengths: Mapping[str, int]) -> list[Any]:
    fields: list[Any] = []
    for name, (kind, counter) in element.properties.items():
        if counter:
            fields += [(f"count {name}", order + counter), (name, order + kind, (lengths[name],))]
        else:
            fields.append((name, order + kind))
    return fields


def _ascii_rows(file: BinaryIO, element: _Element) -> NDArray[Any]:
    table = np.loadtxt(itertools.islice(file, element.count), ndmin=2, comments=None, encoding="ascii")
    if len(table) < element.count:
        raise ValueError(f"{len(table):,} of {element.count:,} {element.name} lines")
    lengths, column = {}, 0
    for name, (_, counter) in element.properties.items():
        if counter:
            lengths[name] = int(table[0, column])
        column += lengths.get(name, 0) + 1
    rows = np.empty(len(table), dtype=_fields(element, "<", lengths))
    return _filled(rows, table)


def _filled(rows: NDArray[Any], table: NDArray[np.float64]) -> NDArray[Any]:
    """Fill records field by field from the columns of an ASCII table; raises ValueError where there are too few or too many."""
    column = 0
    for name in rows.dtype.names or ():
        width = rows[name].shape[1] if rows[name].ndim == 2 else 1
        rows[name] = table[:, column : column + width] if rows[name].ndim == 2 else table[:, column]
        column += width
    if column != table.shape[1]:
        raise ValueError(f"{table.shape[1]} numbers a line, {column} properties")
    return rows


def _size(file: BinaryIO) -> int:
    here = file.tell()
    size = file.seek(0, 2)
    file.seek(here)
    return size
