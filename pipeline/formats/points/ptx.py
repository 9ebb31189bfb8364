"""Read PTX text (Leica): scans as grids in the scanner's frame, each with the pose of its scanner.

A scan has ten lines of header: columns, rows, the scanner's position, its three axes, and a 4 x 4 matrix for row vectors, world =
[x y z 1] M. A line `x y z intensity [r g b]` for each cell follows, column after column; `0 0 0` is a missing return.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.text_layout import encoding_of, form_of
from scene.common.errors import InputError
from scene.common.number_rows import RowForm, read_rows, split_row
from scene.common.regular_file import bounded_lines, check_file
from scene.geometry.mesh import FloatArray

_LINES_BEFORE_POINTS = 10
_LONGEST_LINE = 4096
_CHANNELS = ("red", "green", "blue")
_ALIKE_M, _ALIKE = 0.01, 1e-3
"""Positions (m) and axes up to this difference are one pose with few digits."""
_EXPORT = "copy the complete file again, or export the scans again as PTX"


@dataclass(frozen=True)
class PtxScan:
    """One laser scan of a PTX file, which stores scans as grids with the scanner's pose.

    Attributes
    ----------
    cloud : Points in the scanner's frame, m; extra channels `row` and `column` of the grid.
    position : (3,) position of the scanner in the world frame, m.
    rotation : (3, 3) scanner to world, orthonormal only to the file's digits.
    """

    cloud: PointCloud
    position: FloatArray
    rotation: FloatArray


@dataclass
class _Lines:
    """The open file and the number of lines read from it."""

    file: TextIO
    where: str
    number: int = 0

    def next(self) -> str:
        """Read the next line."""
        self.number += 1
        return self.file.readline(_LONGEST_LINE).strip()

    @property
    def here(self) -> str:
        """Place of the last line, for errors."""
        return f"{self.where}, line {self.number:,}"


def read_ptx(path: Path) -> list[PtxScan]:
    """Read all laser scans of a PTX file, without the cells of their grids that have no return.

    Raises InputError for a missing or truncated file, a grid that the lines do not fill, or a contradictory pose.
    """
    where = str(check_file(path))
    try:
        with path.open(encoding=encoding_of(path), errors="replace") as file:
            scans = list(_scans(_Lines(file, where)))
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror})",
            where=where,
            remedy="give the path of an existing PTX file that you may read",
        ) from None
    if not scans:
        raise InputError("the file has no scans", where=where, remedy="export the file again, with its points")
    if not any(len(scan.cloud.points) for scan in scans):
        raise InputError(
            "the file has no points: all cells are missing returns", where=where, remedy="export the file again, with its points"
        )
    return scans


def orthonormal(rotation: FloatArray, where: str) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the rotation that is nearest to a matrix (3, 3) read from a file, with a note if they differ by more than rounding.

    where: name of the file, for errors. Raises InputError if the matrix deviates by more than a hundredth, or is a reflection.
    """
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max()) if np.abs(rotation).max() < 2 else np.inf
    if off > 0.02 or np.linalg.det(rotation) < 0:
        raise InputError(
            "the matrix of the pose is not a rotation matrix",
            where=where,
            remedy="give the matrix with more digits; its rows must be orthonormal, and its determinant +1",
        )
    left, _, right = np.linalg.svd(rotation)
    words = (f"the rotation deviated from orthonormal by {off:.1g} and was corrected",) if off > 1e-6 else ()
    return np.asarray(left @ right), words


def _scans(lines: _Lines) -> Iterator[PtxScan]:
    """Yield the scans of the file."""
    count = 0
    while first := lines.next():
        count += 1
        columns, rows = _grid_size(first, lines, count), _grid_size(lines.next(), lines, count)
        if columns < 1 or rows < 1:
            raise InputError(
                f"the scan has a grid of {columns} x {rows} points", where=lines.here, allowed="1 x 1 or more", remedy=_EXPORT
            )
        stated = np.array([_row(lines, 3) for _ in range(4)])
        matrix = np.array([_row(lines, 4) for _ in range(4)])
        _check_pose(stated, matrix, f"{lines.where}, scan {count}")
        yield _scan(_table(lines, columns, rows, count), rows, matrix)


def _grid_size(text: str, lines: _Lines, count: int) -> int:
    """Parse a number of columns or rows; anything else after a scan is a surplus cell."""
    if text.isdecimal():
        return int(text)
    if count > 1:
        problem = f"the file has more lines than the grid of scan {count - 1} has cells: '{text:.60}' does not begin another scan"
        raise InputError(problem, where=lines.here, remedy=_EXPORT)
    problem = f"the file begins with '{text:.60}', but a PTX file begins with its numbers of columns and rows"
    raise InputError(problem, where=lines.here, remedy="export the scans as PTX, or give the file the suffix of its format")


def _row(lines: _Lines, count: int) -> list[float]:
    """Read a header line of `count` numbers."""
    text = lines.next()
    values, _ = read_rows([text or "-"], RowForm(None, "," in text, count, lines.number), lines.where)
    return [float(value) for value in values[0]]


def _check_pose(stated: FloatArray, matrix: FloatArray, where: str) -> None:
    """Raise InputError if the scanner's position and axes (4, 3) contradict the matrix (4, 4), since the header has both.

    Some programs leave one of them at its default, origin and identity, which states nothing.
    """
    default = np.vstack([np.zeros(3), np.eye(3)])
    other = np.vstack([matrix[3, :3], matrix[:3, :3]])
    if np.array_equal(stated, default):
        return
    place, axes = np.abs(stated[0] - other[0]).max(), np.abs(stated[1:] - other[1:]).max()
    if place > _ALIKE_M or axes > _ALIKE:
        there, here = (" ".join(f"{value:.6g}" for value in each[0]) for each in (stated, other))
        raise InputError(
            f"the header states two poses of the scanner: its position is {there} in lines 3 to 6 but {here} in the matrix",
            where=where,
            allowed="the same pose in both",
            remedy="register the scans in the scanner's software, and export them again as PTX",
        )


def _table(lines: _Lines, columns: int, rows: int, count: int) -> FloatArray:
    """Return the (columns * rows, k) cells of a scan."""
    cells, start, before = columns * rows, lines.file.tell(), lines.number
    first = lines.next()
    form = form_of([first], lines.number, lines.where) if first else RowForm(None, False, 4)
    lines.file.seek(start)
    try:
        if form.decimal_comma or form.separator is not None:
            raise ValueError("not plain")
        table = np.loadtxt(bounded_lines(lines.file, cells), ndmin=2)
    except ValueError:
        lines.file.seek(start)
        form = replace(form, first_line=before + 1, counts=False)
        table, _ = read_rows(_cells(lines, cells, count), form, lines.where)
    lines.number = before + cells
    if len(table) < cells:
        raise InputError(
            f"scan {count} states {columns:,} x {rows:,} = {cells:,} cells but has {len(table):,} lines", where=lines.where,
            remedy="the file was cut off, or its numbers of columns and rows are wrong: copy the complete "
            "file again, or export the scans again as PTX",
        )  # fmt: skip
    if table.shape[1] < 4:
        raise InputError(
            f"the cells of scan {count} have {table.shape[1]} values",
            where=lines.where,
            allowed="x y z intensity, and r g b",
            remedy=_EXPORT,
        )
    return np.asarray(table, dtype=np.float64)


def _cells(lines: _Lines, cells: int, count: int) -> Iterator[str]:
    """Yield the lines of a scan's cells; a line with one number is the header of the next scan, which comes too early."""
    for number, line in enumerate(bounded_lines(lines.file, cells)):
        words = split_row(line, None)
        if len(words) == 1 and words[0].isdecimal():
            raise InputError(
                f"scan {count} states {cells:,} cells but has {number:,} lines before the next scan begins",
                where=lines.where,
                remedy=_EXPORT,
            )
        yield line


def _scan(table: FloatArray, rows: int, matrix: FloatArray) -> PtxScan:
    """Return the scan of a table of cells."""
    cell = np.flatnonzero(np.any(table[:, :3] != 0, axis=1))
    extra: dict[str, NDArray[Any]] = {"row": (cell % rows).astype(np.int32), "column": (cell // rows).astype(np.int32)}
    further = table[cell, 4:].T
    names = _CHANNELS if len(further) == len(_CHANNELS) else [f"column_{number}" for number in range(5, 5 + len(further))]
    extra |= {name: np.ascontiguousarray(values) for name, values in zip(names, further, strict=True)}
    cloud = PointCloud(table[cell, :3], intensity=table[cell, 3], extra=extra)
    missing = len(table) - len(cell)
    cloud = cloud.noted(f"{missing:,} of {len(table):,} cells without a return (0 0 0) are left out") if missing else cloud
    return PtxScan(cloud, matrix[3, :3], matrix[:3, :3].T)
