"""PTX text (Leica): scans as grids in the scanner's frame, each with the pose of its scanner.

A scan is ten lines of header (columns, rows, the scanner's position, its three axes, a 4 x 4 matrix whose rows multiply from the
left: world = [x y z 1] M) and a line `x y z intensity [r g b]` for each cell, column after column; `0 0 0` is a missing return.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.point_cloud import PointCloud
from scene.common.errors import InputError
from scene.common.regular_file import bounded_lines, check_file
from scene.geometry.mesh import FloatArray

_LINES_BEFORE_POINTS = 10
_LONGEST_LINE = 4096


@dataclass(frozen=True)
class PtxScan:
    """One scan. cloud: points in the scanner's frame, m, with `row` and `column` of the grid as extra channels; position: (3,) m
    and rotation: (3, 3) as the file has it, scanner to world, not orthonormal beyond the file's digits."""

    cloud: PointCloud
    position: FloatArray
    rotation: FloatArray


def read_ptx(path: Path) -> list[PtxScan]:
    """Read all scans without their missing returns. Raises InputError for a missing, truncated or foreign file."""
    check_file(path)
    try:
        with path.open(encoding="ascii") as file:
            scans = list(_scans(file))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy="check the path") from None
    except (ValueError, IndexError) as error:
        problem = " ".join(str(error).split())[:200]
        raise InputError(f"is not a whole PTX file ({problem})", where=str(path), remedy="export it again") from None
    if not any(len(scan.cloud.points) for scan in scans):
        raise InputError("holds no points", where=str(path), remedy="export it again")
    return scans


def _scans(file: TextIO) -> Iterator[PtxScan]:
    while first := file.readline(_LONGEST_LINE).strip():
        header = [first, *(file.readline(_LONGEST_LINE) for _ in range(_LINES_BEFORE_POINTS - 1))]
        columns, rows = (int(line) for line in header[:2])
        if columns < 1 or rows < 1:
            raise ValueError(f"a grid of {columns} x {rows}")
        matrix = np.array([[float(word) for word in line.split()] for line in header[6:]])
        if matrix.shape != (4, 4):
            raise ValueError("no 4 x 4 matrix in the header")
        yield _scan(_table(file, columns * rows), rows, matrix)


def _table(file: TextIO, count: int) -> FloatArray:
    table = np.loadtxt(bounded_lines(file, count), ndmin=2)
    if len(table) < count or table.shape[1] < 4:
        raise ValueError(f"{len(table):,} lines of {table.shape[1]} numbers, for {count:,} cells of x y z intensity")
    return np.asarray(table, dtype=np.float64)


def _scan(table: FloatArray, rows: int, matrix: FloatArray) -> PtxScan:
    cell = np.flatnonzero(np.any(table[:, :3] != 0, axis=1))
    extra: dict[str, NDArray[Any]] = {"row": (cell % rows).astype(np.int32), "column": (cell // rows).astype(np.int32)}
    cloud = PointCloud(table[cell, :3], intensity=table[cell, 3], extra=extra)
    return PtxScan(cloud, matrix[3, :3], matrix[:3, :3].T)
