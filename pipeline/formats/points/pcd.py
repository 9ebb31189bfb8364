"""Write PCD, the point files of the Point Cloud Library: binary, version 0.7."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.files.atomic import writing
from pipeline.formats.point_cloud import PointCloud
from scene.common.errors import InputError

_LETTERS = {"f": "F", "i": "I", "u": "U"}
"""PCD's letter for each kind of number."""
_FAR_M = 1e3
"""Size of coordinates, m, from which they are written in double precision; single precision would be worse than 0.03 mm."""


def write_pcd(path: Path, cloud: PointCloud) -> None:
    """Write a point cloud as PCD: x, y, z, m, then intensity, gps_time and the other channels by name, in their own types.

    Coordinates are float32, as PCL takes them, or float64 (read by Open3D and CloudCompare) if they are large, such as survey
    coordinates. Raises InputError for a channel that is not a number.
    """
    wide = bool(len(cloud.points)) and float(np.abs(cloud.points).max()) >= _FAR_M
    columns: dict[str, NDArray[Any]] = {
        name: column.astype("<f8" if wide else "<f4") for name, column in zip("xyz", cloud.points.T, strict=True)
    }
    channels = {"intensity": cloud.intensity, "gps_time": cloud.gps_time, **cloud.extra}
    columns |= {name: _stored(column, f"{path}: {name}") for name, column in channels.items() if column is not None}
    rows = np.empty(len(cloud.points), dtype=[(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    with writing(path) as temporary, temporary.open("wb") as file:
        file.write(_header(rows.dtype, len(rows)).encode("ascii"))
        file.write(rows.tobytes())


def _stored(column: NDArray[Any], where: str) -> NDArray[Any]:
    """Return a channel in a type of PCD."""
    if column.dtype.kind == "b":
        return column.astype("<u1")
    if column.dtype.kind not in _LETTERS or column.ndim != 1:
        raise InputError(
            f"the channel has the type {column.dtype}",
            where=where,
            allowed="one number for each point",
            remedy="leave the channel out, or write the points as LAZ",
        )
    little = column.dtype.newbyteorder("<")
    return column.astype("<f4") if column.dtype.itemsize == 2 and column.dtype.kind == "f" else column.astype(little)


def _header(kind: np.dtype[Any], count: int) -> str:
    """Return the header."""
    types = [kind[name] for name in kind.names or ()]
    return "\n".join([
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(kind.names or ())}",
        f"SIZE {' '.join(str(each.itemsize) for each in types)}",
        f"TYPE {' '.join(_LETTERS[each.kind] for each in types)}",
        f"COUNT {' '.join('1' for _ in types)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
        "",
    ])  # fmt: skip
