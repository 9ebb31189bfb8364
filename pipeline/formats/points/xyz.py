"""XYZ text, PTS and CSV: one point a line, columns x y z [intensity ...], with or without a line of column names."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.files.atomic import writing
from pipeline.formats.point_cloud import PointCloud
from scene.common.errors import InputError
from scene.common.regular_file import check_file
from scene.geometry.mesh import FloatArray

_CHUNK = 200_000
"""Points in memory as text at a time while writing."""
_HEADER_LINES = 100
_LONGEST_LINE = 65_536
_COMMENT = ("#", "//")
_SAMPLE = 10_000
_COLOURS = ["red", "green", "blue"]
SKIPPED = "-"
"""A column of this name is left out."""
_SYNONYMS = {
    "e": "x", "east": "x", "easting": "x", "x_m": "x", "x[m]": "x", "n": "y", "north": "y", "northing": "y", "y_m": "y",
    "y[m]": "y", "h": "z", "height": "z", "elevation": "z", "alt": "z", "z_m": "z", "z[m]": "z", "i": "intensity",
    "reflectance": "intensity", "amplitude": "intensity", "scalar_intensity": "intensity", "r": "red", "g": "green", "b": "blue",
    "time": "gps_time", "gpstime": "gps_time", "timestamp": "gps_time",
}  # fmt: skip
"""Words that programs write above a column, in lower case, and its name here."""


@dataclass(frozen=True)
class TextTable:
    """values: (n, k); names: of the k columns; told: whether the file names them, otherwise they are guessed."""

    values: FloatArray
    names: list[str]
    told: bool


def write_xyz(path: Path, cloud: PointCloud, *, decimals: int = 6) -> None:
    """Write a line of column names (behind `//`, as CloudCompare has it) and a line per point.

    Coordinates get `decimals` places, m; the other channels as many digits as give back their value.
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
    """Read points; separators are spaces, tabs, commas or semicolons.

    columns: a name for each column, x, y and z among them; by default as `read_table` finds them. A line with nothing but a count
    is passed over. Intensity is as the file has it. Raises InputError for a missing file and lines that are not numbers.
    """
    table = read_table(path)
    names = list(columns) or table.names
    if len(names) != table.values.shape[1] or not set("xyz") <= set(names):
        raise InputError(
            f"has {table.values.shape[1]} columns, named {', '.join(names)}", where=str(path),
            allowed="a name for each, x, y and z among them", remedy="name them with --columns, as x,y,z,intensity",
        )  # fmt: skip
    channels = {name: np.ascontiguousarray(table.values[:, index]) for index, name in enumerate(names) if name != SKIPPED}
    points = np.stack([channels.pop(name) for name in "xyz"], axis=1)
    return PointCloud(points, channels.pop("intensity", None), channels.pop("gps_time", None), channels)


def read_table(path: Path) -> TextTable:
    """The numbers of a file and the names of its columns.

    Names are taken from the last line before the numbers, behind `#` or `//` or bare, and other words for them understood
    (Easting, H, Reflectance ...). Without names a fourth column is the intensity, of more whole numbers from 0 to 255 in threes
    are colours, and what is left alone beside them is the intensity; others are `column_4`, `column_5` ...
    """
    check_file(path)
    try:
        _check_lines(path)
        before, names, separator = _layout(path)
        values = np.loadtxt(path, delimiter=separator, skiprows=before, ndmin=2, comments=None, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy="check the path") from None
    except ValueError as error:
        raise InputError(f"is not XYZ text ({_plain(error)})", where=str(path), remedy="one point a line: x y z ...") from None
    if values.size == 0 or values.shape[1] < 3:
        problem = "holds no points" if values.size == 0 else f"has {values.shape[1]} columns"
        raise InputError(problem, where=str(path), remedy="one point a line: x y z ...")
    understood = [_SYNONYMS.get(name, name) for name in names]
    named = len(names) == values.shape[1] and set("xyz") <= set(understood) and len(set(understood)) == len(understood)
    return TextTable(values, understood, True) if named else TextTable(values, _guessed_names(values), False)


def _check_lines(path: Path) -> None:
    """Raise ValueError for a line so long that it cannot be one point: a reader would take it into memory as a whole."""
    with path.open("rb") as file:
        while len(part := file.read(_LONGEST_LINE)) == _LONGEST_LINE:
            if b"\n" not in part and b"\r" not in part:
                raise ValueError(f"a line of more than {_LONGEST_LINE:,} bytes")


def _layout(path: Path) -> tuple[int, list[str], str | None]:
    """Lines before the first point, column names ([] where there are none), separator (None: white space)."""
    names: list[str] = []
    with path.open(encoding="utf-8") as file:
        for number, line in enumerate(itertools.islice(file, _HEADER_LINES)):
            words = re.split(r"[\s,;]+", line.strip().lstrip("#/").strip().lower())
            if len(words) >= 3 and not line.lstrip().startswith(_COMMENT) and _is_number(words[0]):
                return number, names, next((mark for mark in ",;" if mark in line), None)
            names = words if len(words) >= 3 else names
    raise ValueError(f"no line of numbers among the first {_HEADER_LINES}")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _guessed_names(values: FloatArray) -> list[str]:
    """Names for the columns (n, k) of a file that has none."""
    count = values.shape[1]
    if count == 4:
        return [*"xyz", "intensity"]
    names = [*"xyz", *(f"column_{number}" for number in range(4, count + 1))]
    sample = values[:: max(len(values) // _SAMPLE, 1)]
    bytes_alike = [bool(np.all((column == np.rint(column)) & (column >= 0) & (column <= 255))) for column in sample.T]
    for first in (count - 3, 3):  # behind the intensity, or before it
        if 3 <= first <= count - 3 and all(bytes_alike[first : first + 3]):
            names[first : first + 3] = _COLOURS
            rest = [index for index in range(3, count) if names[index] not in _COLOURS]
            if len(rest) == 1:
                names[rest[0]] = "intensity"
            break
    return names


def _form(name: str, column: NDArray[Any], decimals: int) -> str:
    if name in ("x", "y", "z"):
        return f"%.{decimals}f"
    return "%d" if column.dtype.kind in "iub" else "%.9g" if column.dtype == np.float32 else "%.17g"


def _plain(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
