"""Read and write PLY meshes and point clouds; binary and ASCII are read, binary little-endian is written."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.files.atomic import writing
from pipeline.formats.point_cloud import PointCloud
from scene.common.errors import InputError
from scene.geometry.mesh import TriangleMesh
from scene.meshes.ply import Columns, header_remarks, read_elements

_CHUNK = 1_000_000
"""Records in memory at a time while writing."""
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
"""PLY's name of each NumPy type."""
_FACE_LISTS = ("vertex_indices", "vertex_index")
"""Names of the list of a face's vertices."""
_SCALAR = "scalar_"
"""Prefix of channel names. CloudCompare loads only properties with it, besides coordinates and intensity."""
_FIELDS = {"Intensity": "intensity", "GpsTime": "gps_time", "Gps_Time": "gps_time"}
"""CloudCompare's names of channels that have their own field here."""


def write_ply(path: Path, mesh: TriangleMesh) -> None:
    """Write a mesh as a PLY file.

    Vertices are double and, if the mesh has them, reflectances (albedo) are float and block labels int.
    """
    vertex = _xyz(mesh.vertices) | _present(albedo=mesh.vertex_albedo, block=mesh.vertex_block)
    face = {"vertex_indices": mesh.faces} | _present(block=mesh.face_block)
    _write(path, {"vertex": vertex, "face": face})


def write_ply_points(path: Path, cloud: PointCloud) -> None:
    """Write a point cloud as PLY: x, y, z as double, the other channels in their own type or the nearest one that PLY has.

    Channels other than intensity are named `scalar_...` for CloudCompare. Raises InputError for a channel that no type of PLY
    can hold without loss.
    """
    channels = _present(intensity=cloud.intensity, gps_time=cloud.gps_time) | cloud.extra
    names = {name: name if name == "intensity" else _SCALAR + name for name in channels}
    stored = {names[name]: _storable(column, f"{path}: {name}") for name, column in channels.items()}
    _write(path, {"vertex": _xyz(cloud.points) | stored})


def read_ply(path: Path) -> TriangleMesh:
    """Read a mesh of triangles from a PLY file, with reflectances and block labels; other properties are ignored.

    Raises InputError for a missing or damaged file, faces that are not triangles, or indices of vertices that do not exist.
    """
    elements = read_elements(path)
    vertex, face = elements.get("vertex"), elements.get("face")
    if vertex is None or face is None:
        raise InputError(
            "the file contains only points, no mesh" if face is None else "the file contains no vertices",
            where=str(path),
            remedy="give a mesh; `scarpsim surface` makes one from points",
        )
    faces = next((face[name] for name in _FACE_LISTS if name in face), None)
    if faces is None or faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(
            "the file contains faces that are not triangles",
            where=str(path),
            remedy="triangulate the mesh in a mesh editor such as MeshLab",
        )
    vertices = _points(vertex, path)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InputError(
            f"a face refers to a vertex beyond the {len(vertices):,} there are",
            where=str(path),
            remedy="copy the complete file again, or export the mesh again",
        )
    return TriangleMesh(
        vertices,
        np.ascontiguousarray(faces, dtype=np.int32),
        vertex_albedo=_column(vertex, "albedo", np.float32),
        vertex_block=_column(vertex, "block", np.int32),
        face_block=_column(face, "block", np.int32),
    )


def read_ply_points(path: Path) -> PointCloud:
    """Read a point cloud from a PLY file: its vertices with all scalar properties, by their names without `scalar_`.

    Raises InputError for a missing or damaged file.
    """
    vertex = read_elements(path, only="vertex").get("vertex")
    if vertex is None:
        raise InputError("the file contains no vertices", where=str(path), remedy="export the file again, with its points")
    names = [name for name in vertex if name not in ("x", "y", "z") and vertex[name].ndim == 1]
    extra = {_channel(name, vertex): _native(vertex[name]) for name in names}
    lists = [name for name in vertex if vertex[name].ndim != 1]
    notes = [f"its header has '{remark:.80}', which is not applied" for remark in header_remarks(path) if _PLACE.search(remark)]
    notes += [f"lists that are not read: {', '.join(lists)}"] if lists else []
    return PointCloud(
        _points(vertex, path), _column(extra, "intensity"), _column(extra, "gps_time", np.float64), _others(extra), tuple(notes)
    )


_PLACE = re.compile(r"unit|feet|foot|epsg|crs|projection|offset|shift|scale|translat", re.IGNORECASE)
"""Words of comments that may state where the points are and in which unit; PLY itself has no field for it."""


def _channel(name: str, vertex: Columns) -> str:
    """Return the channel name of a property: CloudCompare's fields by their own name, unless another property has it."""
    plain = name.removeprefix(_SCALAR)
    known = _FIELDS.get(plain, plain) if name.startswith(_SCALAR) else name
    return name if known in vertex else known


def _others(extra: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the channels without their own field."""
    return {name: channel for name, channel in extra.items() if name not in ("intensity", "gps_time")}


def _xyz(points: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """Return coordinates as columns."""
    return {name: points[:, axis] for axis, name in enumerate("xyz")}


def _present(**columns: NDArray[Any] | None) -> dict[str, NDArray[Any]]:
    """Return the columns that exist."""
    return {name: column for name, column in columns.items() if column is not None}


def _points(vertex: Columns, path: Path) -> NDArray[np.float64]:
    """Return the coordinates of the vertices."""
    missing = [name for name in "xyz" if name not in vertex]
    if missing:
        raise InputError(
            f"the file has vertices without {', '.join(missing)}", where=str(path), remedy="export the file again with x, y and z"
        )
    points = np.empty((len(vertex["x"]), 3))
    for axis, name in enumerate("xyz"):
        points[:, axis] = vertex[name]
    return points


def _column(columns: Columns, name: str, dtype: Any = None) -> NDArray[Any] | None:
    """Return a column as an array; None if it does not exist."""
    return np.array(columns[name], dtype=dtype) if name in columns else None


def _native(column: NDArray[Any]) -> NDArray[Any]:
    """Return a contiguous copy in the machine's byte order."""
    return np.array(column, dtype=column.dtype.newbyteorder("="))


def _storable(column: NDArray[Any], where: str) -> NDArray[Any]:
    """Convert a column to a type that PLY has: it lacks truth values, 64-bit integers, and floats other than 32 and 64 bits."""
    if column.dtype.str[1:] in _NAMES:
        return column
    for kind in {"b": ("u1",), "f": ("f4", "f8")}.get(column.dtype.kind, ("i4", "u4", "f8")):
        with np.errstate(over="ignore"):
            stored = column.astype(kind)
        if np.array_equal(stored.astype(column.dtype), column, equal_nan=column.dtype.kind == "f"):
            return stored
    raise InputError(
        f"values of the type {column.dtype} do not fit any type of PLY", where=where, remedy="write the points as LAZ instead"
    )


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
    """Write some rows of an element."""
    block = np.empty(rows.stop - rows.start, dtype=record)
    for name, column in columns.items():
        block[name] = column[rows]
        if column.ndim == 2:
            block[f"count {name}"] = column.shape[1]
    file.write(block.data)  # ndarray.tofile would hide why a write fails


def _header_text(elements: Mapping[str, Columns]) -> str:
    """Return the header."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for element, columns in elements.items():
        lines.append(f"element {element} {len(next(iter(columns.values())))}")
        for name, column in columns.items():
            kind = _NAMES[column.dtype.str[1:]]
            lines.append(f"property {'list uchar ' if column.ndim == 2 else ''}{kind} {name}")
    return "\n".join([*lines, "end_header", ""])


def _record_type(columns: Columns) -> np.dtype[Any]:
    """Return the NumPy type of one record."""
    fields: list[Any] = []
    for name, column in columns.items():
        kind = f"<{column.dtype.str[1:]}"
        fields += [(f"count {name}", "u1"), (name, kind, column.shape[1:])] if column.ndim == 2 else [(name, kind)]
    return np.dtype(fields)
