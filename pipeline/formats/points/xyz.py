"""Read and write XYZ text, PTS and CSV: one point in each line, columns x y z [intensity ...], with or without column names."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.files.atomic import writing
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.column_names import SKIPPED, Column, named_columns, understood, with_stated_units
from pipeline.formats.points.text_layout import LONGEST_LINE, TextLayout, layout_of
from pipeline.formats.units import AxisUnits
from scene.common.errors import InputError
from scene.common.number_rows import RowsFound, read_rows, split_row
from scene.common.regular_file import check_file
from scene.geometry.mesh import FloatArray

_CHUNK = 200_000
"""Points in memory as text at a time while writing."""
_SAMPLE = 10_000
"""Number of rows from which columns are guessed."""
_FEWEST_ALIKE = 50
"""Number of rows from which equal numbers of decimals are no coincidence."""
_AXES = ("x", "y", "z")
_COLOURS = ["red", "green", "blue"]


def write_xyz(path: Path, cloud: PointCloud, *, decimals: int = 6) -> None:
    """Write a point cloud as text: a line of column names (after `//`, as in CloudCompare) and a line for each point.

    decimals: number of decimals of coordinates, m; other channels get as many digits as their value needs.
    """
    columns = dict(zip("xyz", cloud.points.T, strict=True))
    columns |= {"intensity": cloud.intensity, "gps_time": cloud.gps_time, **cloud.extra}
    columns = {name: column for name, column in columns.items() if column is not None}
    line = " ".join(_form(name, column, decimals) for name, column in columns.items()) + "\n"
    with writing(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as file:
        file.write(f"//{' '.join(columns)}\n")
        for start in range(0, len(cloud.points), _CHUNK):
            lists = [column[start : start + _CHUNK].tolist() for column in columns.values()]
            values = itertools.chain.from_iterable(zip(*lists, strict=True))
            file.write(line * len(lists[0]) % tuple(values))


def read_xyz(path: Path, columns: Sequence[str] = ()) -> PointCloud:
    """Read a point cloud from a text file.

    Encoding, separator, decimal mark and column names are detected (`layout_of`, `named_columns`). Without names, the first
    three columns are x, y and z, and a fourth one is the intensity. Of more columns, three with whole numbers from 0 to 255 are
    colours, and a single remaining one is the intensity; others are `column_4`, `column_5` ...

    Parameters
    ----------
    path : .xyz, .txt, .asc, .csv or .pts file.
    columns : Names of the columns, including x, y and z, instead of the file's own.

    Returns
    -------
    The points in the file's unit. `stated_units` is set if the column names state it; `notes` say what was guessed, converted
    and left out.

    Raises
    ------
    InputError
        If the file is missing, a line is not a row of numbers, a count differs from the rows, or names do not fit.
    """
    where = str(check_file(path))
    try:
        _check_lines(path)
        layout = layout_of(path)
        values, found = _values(path, layout)
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror})",
            where=where,
            remedy="give the path of an existing text file that you may read",
        ) from None
    _check_counts(len(values), layout, found, where)
    _check_end(path, layout)
    given, notes = _without_words(*_columns(layout, values, columns, where), layout, where)
    _check_present(values, given, where)
    if found.missing:
        notes = (*notes, f"{found.missing:,} values are empty or not numbers")
    if layout.form.decimal_comma:
        notes = (*notes, "commas in numbers are read as decimal marks")
    return _cloud(values, given, notes)


def _values(path: Path, layout: TextLayout) -> tuple[FloatArray, RowsFound]:
    """Return the numbers of a file, by NumPy if possible, else line by line, which can say where it is wrong."""
    form, before = layout.form, layout.form.first_line - 1
    if not form.decimal_comma and not form.words:
        try:
            options: dict[str, Any] = {"delimiter": form.separator, "skiprows": before, "encoding": layout.encoding}
            values = np.loadtxt(path, ndmin=2, comments=None, **options)
            if values.shape[1] == form.columns:
                return values, RowsFound()
        except ValueError:
            pass  # its message would be about NumPy, not about the file
    with path.open(encoding=layout.encoding, errors="replace") as file:
        return read_rows(itertools.islice(file, before, None), form, str(path))


def _check_end(path: Path, layout: TextLayout) -> None:
    """Raise InputError if the file ends within a number: its last value has fewer decimals than all values above it."""
    if layout.encoding.startswith(("utf-16", "utf-32")):
        return
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - LONGEST_LINE, 0))
        tail = file.read().decode(layout.encoding, errors="replace")
    if tail.endswith(("\n", "\r")):
        return
    mark = "," if layout.form.decimal_comma else "."
    last = [split_row(line, layout.form.separator)[-1:] for line in tail.splitlines()[1:]]
    *others, end = (len(word.partition(mark)[2]) for words in last for word in words or [""])
    if len(others) > _FEWEST_ALIKE and len(set(others)) == 1 and end < others[0]:
        raise InputError(
            f"the file ends within a number: '{last[-1][0]}', but all numbers above have {others[0]} decimals", where=str(path),
            remedy="the file was probably cut off: copy or export it again; if it is complete, add a line break at its end",
        )  # fmt: skip


def _check_counts(rows: int, layout: TextLayout, found: RowsFound, where: str) -> None:
    """Raise InputError if a count in the file differs from the number of rows after it."""
    first = rows - sum(count for _, count, _ in found.blocks)
    for stated, count, place in ((layout.stated, first, where), *((s, n, f"{where}, line {at:,}") for s, n, at in found.blocks)):
        if stated is not None and stated != count:
            raise InputError(
                f"the count states {stated:,} points, but {count:,} follow", where=place,
                remedy="the file was cut off or changed: copy or export it again, or correct or remove the line with the count",
            )  # fmt: skip


def _columns(
    layout: TextLayout, values: FloatArray, given: Sequence[str], where: str
) -> tuple[tuple[Column, ...], tuple[str, ...]]:
    """Return the columns as given, as the file names them, or as guessed, and notes."""
    count = values.shape[1]
    if given:
        columns = understood(given, "--columns")
        names = [column.name for column in columns]
        if len(names) != count or not set("xyz") <= set(names):
            raise InputError(
                f"the file has {count} columns, but --columns names {', '.join(given)}", where=where,
                allowed="a name for each column, with x, y and z among them",
                remedy="name all columns with --columns, such as x,y,z,intensity",
            )  # fmt: skip
        return with_stated_units(columns, layout, where), ()
    if count < 3:
        raise InputError(
            f"the file has {count} columns",
            where=where,
            allowed="3 columns (x y z) or more",
            remedy="export the points with at least x, y and z",
        )
    found = named_columns(layout, where)
    if found.columns:
        return found.columns, found.notes
    guessed = _guessed_names(np.delete(values, layout.form.words, axis=1))
    for index in layout.form.words:
        guessed.insert(index, f"column_{index + 1}")
    note = f"the columns have no names and were read as {', '.join(guessed)} (to change: --columns)"
    return tuple(map(Column, guessed)), (note, *found.notes)


def _without_words(
    columns: tuple[Column, ...], notes: tuple[str, ...], layout: TextLayout, where: str
) -> tuple[tuple[Column, ...], tuple[str, ...]]:
    """Remove columns that contain words instead of numbers, with notes; raise InputError if one of them is x, y or z."""
    found, said = list(columns), list(notes)
    for index in layout.form.words:
        if found[index].name in _AXES:
            raise InputError(
                f"column {index + 1}, called {found[index].name}, contains words",
                where=where,
                allowed="numbers in the columns x, y and z",
                remedy="correct the names of the columns in the file, or give the right ones with --columns",
            )
        if found[index].name != SKIPPED:
            said.append(f"column {index + 1} ({found[index].name}) contains words and is left out")
        found[index] = Column(SKIPPED)
    return tuple(found), tuple(said)


def _check_present(values: FloatArray, columns: Sequence[Column], where: str) -> None:
    """Raise InputError if a coordinate is missing in every row while others exist."""
    empty = [index for index, column in enumerate(columns) if column.name in _AXES and np.isnan(values[:, index]).all()]
    if 0 < len(empty) < 3:
        raise InputError(
            f"column {empty[0] + 1}, read as {columns[empty[0]].name}, is empty in all {len(values):,} rows",
            where=where,
            remedy="export the file again, or give the right names of the columns with --columns",
        )


def _cloud(values: FloatArray, columns: Sequence[Column], notes: tuple[str, ...]) -> PointCloud:
    """Return the cloud of a table: coordinates in the file's unit, other channels in the SI unit that the names state."""
    channels = {column.name: _in_si(values[:, index], column) for index, column in enumerate(columns) if column.name != SKIPPED}
    points = np.stack([channels.pop(name) for name in "xyz"], axis=1)
    converted = [column for column in columns if column.name not in _AXES and (column.factor != 1 or column.decibels)]
    said = tuple(f"{column.name} was converted from {column.unit}" for column in converted)
    return PointCloud(
        points, channels.pop("intensity", None), channels.pop("gps_time", None), channels, (*notes, *said), _units(columns)
    )  # fmt: skip


def _in_si(values: FloatArray, column: Column) -> FloatArray:
    """Convert a column to SI units."""
    if column.name in _AXES:
        return values  # converted to metres by `read_placed_scans`, with the pose and the user's unit
    if column.decibels:
        return np.asarray(10 ** (values / 10))
    return np.ascontiguousarray(values) if column.factor == 1 else values * column.factor


def _units(columns: Sequence[Column]) -> AxisUnits | None:
    """Return the unit that the names of x, y and z state, or None; an axis without one has that of the first with one."""
    axes = {column.name: column for column in columns if column.name in _AXES}
    stated = [axes[name] for name in "xyz" if axes[name].unit]
    if not stated:
        return None
    x, y, z = (axes[name].factor if axes[name].unit else stated[0].factor for name in "xyz")
    return AxisUnits((x, y, z), "the names of its columns")


def _check_lines(path: Path) -> None:
    """Raise InputError for a line too long for one point, which a reader would load completely."""
    with path.open("rb") as file:
        while len(part := file.read(LONGEST_LINE)) == LONGEST_LINE:
            if b"\n" not in part and b"\r" not in part:
                raise InputError(
                    f"the file has a line of more than {LONGEST_LINE:,} bytes, so it is not a text file of points",
                    where=str(path), allowed="one point in each line",
                    remedy="give a text file of points",
                )  # fmt: skip


def _guessed_names(values: FloatArray) -> list[str]:
    """Guess the names of the columns (n, k) of a file without names."""
    count = values.shape[1]
    if count == 4:
        return [*"xyz", "intensity"]
    names = [*"xyz", *(f"column_{number}" for number in range(4, count + 1))]
    sample = values[:: max(len(values) // _SAMPLE, 1)]
    bytes_alike = [bool(np.all((column == np.rint(column)) & (column >= 0) & (column <= 255))) for column in sample.T]
    for first in (count - 3, 3):  # after the intensity, or before it
        if 3 <= first <= count - 3 and all(bytes_alike[first : first + 3]):
            names[first : first + 3] = _COLOURS
            rest = [index for index in range(3, count) if names[index] not in _COLOURS]
            if len(rest) == 1:
                names[rest[0]] = "intensity"
            break
    return names


def _form(name: str, column: NDArray[Any], decimals: int) -> str:
    """Return the format of a column."""
    if name in _AXES:
        return f"%.{decimals}f"
    return "%d" if column.dtype.kind in "iub" else "%.9g" if column.dtype == np.float32 else "%.17g"
