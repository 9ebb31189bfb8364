"""XYZ text: one point a line, columns x y z [intensity ...], with or without a line of column names."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.atomic import writing
from pipeline.formats.point_cloud import PointCloud
from scene.errors import InputError
from scene.regular_file import check_file

_CHUNK = 200_000
"""Points in memory as text at a time while writing."""
_HEADER_LINES = 100
_LONGEST_LINE = 65_536
_COMMENT = ("#", "//")


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


def read_xyz(path: Path) -> PointCloud:
    """Read points; separators are spaces, tabs, commas or semicolons.

    Names are taken from the last line before the numbers, behind `#` or `//` or bare; without names a fourth column is the
    intensity, if it is the last one, and others are `column_4`, `column_5` ... A line with nothing but a count is passed over.
    Intensity is as the file has it. Raises InputError for a missing file and lines that are not numbers.
    """
    check_file(path)
    try:
        _check_lines(path)
        before, names, separator = _layout(path)
        table = np.loadtxt(path, delimiter=separator, skiprows=before, ndmin=2, comments=None, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy="check the path") from None
    except ValueError as error:
        raise InputError(f"is not XYZ text ({_plain(error)})", where=str(path), remedy="one point a line: x y z ...") from None
    if table.size == 0 or table.shape[1] < 3:
        problem = "holds no points" if table.size == 0 else f"has {table.shape[1]} columns"
        raise InputError(problem, where=str(path), remedy="one point a line: x y z ...")
    names = names if len(names) == table.shape[1] and set("xyz") <= set(names) else _default_names(table.shape[1])
    columns = {name: np.ascontiguousarray(table[:, index]) for index, name in enumerate(names)}
    points = np.stack([columns.pop(name) for name in "xyz"], axis=1)
    return PointCloud(points, columns.pop("intensity", None), columns.pop("gps_time", None), columns)


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


def _default_names(count: int) -> list[str]:
    return [*"xyz", "intensity"] if count == 4 else [*"xyz", *(f"column_{number}" for number in range(4, count + 1))]


def _form(name: str, column: NDArray[Any], decimals: int) -> str:
    if name in ("x", "y", "z"):
        return f"%.{decimals}f"
    return "%d" if column.dtype.kind in "iub" else "%.9g" if column.dtype == np.float32 else "%.17g"


def _plain(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
