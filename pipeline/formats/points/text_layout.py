"""Detect how a text file of points is written: encoding, lines before the points, separator, decimal mark, counts.

All readers of points in text use this module, so that XYZ, CSV, PTS and PTX accept the same files.
"""

from __future__ import annotations

import codecs
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from scene.common.errors import InputError
from scene.common.number_rows import COMMENTS, GROUPED, RowForm, is_grouped, is_number, split_row

_HEADER_LINES = 1000
"""Largest number of lines before the points."""
_SAMPLE_LINES = 200
"""Number of rows from which the layout is detected."""
LONGEST_LINE = 65_536
"""Largest length of a line, bytes."""
_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32"), (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"),
)  # fmt: skip
"""Byte-order marks, each with the codec that removes it; that of UTF-32 begins with that of UTF-16."""
_HEAD_BYTES = 4096
"""Number of bytes from which the encoding is detected."""
_SEPARATORS = (";", "\t", "|")
_DECIMAL_COMMA = re.compile(r"[+-]?(\d+,\d*|\d*,\d+)([eE][+-]?\d+)?")
_THREE_DIGITS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
"""A number in which a comma may be a decimal mark or separate thousands."""
_GRID = ("ncols", "nrows", "xllcorner", "xllcenter")
"""Words with which the header of a grid of heights begins."""
_SEVERAL_GROUPS = re.compile(r"[+-]?\d{1,3}(,\d{3}){2}")
_FEW = 0.05
"""Share of whole numbers in a column, besides numbers with a comma, above which the comma is not a decimal mark."""
_ROWS = "one point in each line, x y z and other values, separated by spaces, tabs, commas or semicolons"


@dataclass(frozen=True)
class HeaderLine:
    """A line before the points of a text file.

    number: of the line, from 1; text: without comment marks; comment: whether it had them.
    """

    number: int
    text: str
    comment: bool


@dataclass(frozen=True)
class TextLayout:
    """How a text file of points is written.

    Attributes
    ----------
    encoding : Name of its character encoding, as Python has it.
    header : Lines before the first point that are neither empty nor a count.
    form : Separator, decimal mark and number of columns of the rows.
    stated : Number of points that a count in the header states; None without one.
    """

    encoding: str
    header: tuple[HeaderLine, ...]
    form: RowForm
    stated: int | None = None


_BINARY_KINDS = {b"LASF": ("a LAS or LAZ file", ".laz"), b"ASTM-E57": ("an E57 file", ".e57"), b"glTF": ("a glTF file", ".glb")}
"""First bytes of binary files, with their kind and suffix."""


def encoding_of(path: Path) -> str:
    """Detect the character encoding of a text file of points; return its name in Python.

    UTF-16 is known by its byte-order mark or its null bytes. Other files are UTF-8, or Western European if they are not valid
    UTF-8. Raises InputError for a file with null bytes that is not text.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    for start, (kind, suffix) in _BINARY_KINDS.items():
        if head.startswith(start):
            raise InputError(
                f"the file is {kind} by its first bytes, not text",
                where=str(path),
                allowed=_ROWS,
                remedy=f"give the file the suffix {suffix}",
            )
    for mark, name in _BYTE_ORDER_MARKS:
        if head.startswith(mark):
            return name
    if b"\0" not in head:
        try:
            codecs.getincrementaldecoder("utf-8")().decode(head)
        except UnicodeDecodeError:
            return "cp1252"
        return "utf-8"
    if not any(head[::2]) or not any(head[1::2]):
        return "utf-16-be" if not any(head[::2]) else "utf-16-le"
    even, odd = head[::2].count(0), head[1::2].count(0)
    if max(even, odd) > 0.8 * len(head) / 2 and min(even, odd) < 0.1 * len(head) / 2:
        return "utf-16-be" if even > odd else "utf-16-le"
    raise InputError(
        "the file contains null bytes, like binary files", where=str(path), allowed=_ROWS, remedy="export the points as text"
    )


def layout_of(path: Path) -> TextLayout:
    """Detect how a text file of points is written, by its first lines: encoding, header, separator, decimal mark.

    Raises InputError if they contain no line of numbers, or thousands separators.
    """
    encoding = encoding_of(path)
    with path.open(encoding=encoding, errors="replace") as file:
        lines = list(itertools.islice(file, _HEADER_LINES + _SAMPLE_LINES))
    _check_kind(lines, str(path))
    first = next((index for index, line in enumerate(lines[:_HEADER_LINES]) if _is_row(line)), None)
    if first is None:
        raise _no_rows(lines, str(path))
    sample = list(itertools.takewhile(_is_row, lines[first : first + _SAMPLE_LINES]))
    form = form_of(sample, first + 1, str(path))
    header, stated = _header(lines[:first])
    return TextLayout(encoding, header, form, stated)


def _check_kind(lines: Sequence[str], where: str) -> None:
    """Raise InputError for files of other kinds that also contain rows of numbers."""
    start = lines[0].strip().lower() if lines else ""
    problem, remedy = "", ""
    if start == "ply":
        problem, remedy = "the file is a PLY file by its first line", "give the file the suffix .ply"
    elif start.startswith("# .pcd"):
        problem, remedy = "the file is a PCD file by its first line", "convert it to PLY or LAS"
    elif any(line.lower().startswith(_GRID) for line in lines[:_HEADER_LINES]):
        problem = "the file is a grid of heights (ESRI ASCII), not a list of points"
        remedy = "convert it to a GeoTIFF, for example with gdal_translate, and use that as an elevation model"
    if problem:
        raise InputError(problem, where=where, allowed=_ROWS, remedy=remedy)


def form_of(sample: Sequence[str], first_line: int, where: str) -> RowForm:
    """Detect the separator and decimal mark of a text file's rows of numbers.

    sample: some of its rows. first_line: number of the first of them in the file. where: name of the file, for errors. Raises
    InputError for thousands separators.
    """
    separator, decimal_comma = _separator(sample)
    rows = [split_row(line, separator) for line in sample]
    columns = len(rows[0])
    if columns > 1 and all(len(row) == columns and not row[-1] for row in rows):  # a separator ends each line
        columns -= 1
    if separator != "," or any('"' in line for line in sample):
        commas = sum(bool(_DECIMAL_COMMA.fullmatch(word)) for row in rows for word in row)
        decimal_comma |= commas > sum("." in word and "," not in word for row in rows for word in row)
    _check_grouping(rows, decimal_comma, first_line, where)
    words = tuple(index for index in range(columns) if not any(is_number(row[index]) for row in rows if len(row) > index))
    return RowForm(separator, decimal_comma, columns, first_line, counts=True, words=words)


def _separator(sample: Sequence[str]) -> tuple[str | None, bool]:
    """Return the separator of rows, and whether commas between digits are decimal marks beside white space."""
    for mark in _SEPARATORS:
        if all(mark in line.strip(" \r\n") for line in sample):
            several = mark == "\t" and any(re.search(r"\d\s+[+-]?\d", word) for line in sample for word in split_row(line, mark))
            return (None if several else mark), False
    if not all("," in line for line in sample):
        return None, False
    apart = [split_row(line, None) for line in sample]
    if all(len(words) >= 3 for words in apart) and any(_SEVERAL_GROUPS.match(word) for words in apart for word in words):
        return None, False  # reported later as thousands separators
    if all(len(words) >= 3 and any(map(_DECIMAL_COMMA.fullmatch, words)) for words in apart):
        inside = all("," not in word or re.fullmatch(r"[^,]*\d,\d[^,]*", word) for words in apart for word in words)
        if inside:
            return None, True
    return ",", False


def _check_grouping(rows: Sequence[Sequence[str]], decimal_comma: bool, first_line: int, where: str) -> None:
    """Raise InputError for thousands separators."""
    for number, row in enumerate(rows, start=first_line):
        for word in row:
            if is_grouped(word, decimal_comma=decimal_comma):
                raise _grouped(word, number, where)
    if not decimal_comma:
        return
    for column in itertools.zip_longest(*rows, fillvalue=""):
        with_comma = [word for word in column if "," in word]
        whole = sum(word.lstrip("+-").isdecimal() for word in column)
        if with_comma and whole > _FEW * len(column) and all(map(_THREE_DIGITS.fullmatch, with_comma)):
            raise _grouped(with_comma[0], first_line, where)


def _grouped(word: str, number: int, where: str) -> InputError:
    """Return the error for thousands separators."""
    return InputError(
        f"the digits of '{word:.40}' {GROUPED}", where=f"{where}, line {number:,}", allowed="plain numbers",
        remedy="export the numbers without thousands separators, such as 6389450.123",
    )  # fmt: skip


def _is_row(line: str) -> bool:
    """Whether a line begins with three numbers, with any separators and digits, possibly after a name that no space ends."""
    text = line.strip(" \t\r\n,;|")
    if text.startswith(COMMENTS):
        return False
    mark = next((each for each in (*_SEPARATORS, ",") if each in text), None)
    words = re.split(r"[ \t,]+", text) if mark in (None, ",") else split_row(text, mark)
    starts = (0,) if mark is None else (0, 1)
    return any(len(words) >= start + 3 and all(map(_is_number, words[start : start + 3])) for start in starts)


def _is_number(word: str) -> bool:
    """Whether a word, possibly in quotes, is a number."""
    plain = word.strip("\"'")
    return bool(plain) and is_number(plain)


def _header(lines: Sequence[str]) -> tuple[tuple[HeaderLine, ...], int | None]:
    """Return the lines before the points, and a count among them."""
    header, stated = [], None
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        plain = text.lstrip("".join(COMMENTS)).strip()
        if plain.isdecimal() and not text.startswith(COMMENTS):
            stated = int(plain)
        elif plain:
            header.append(HeaderLine(number, plain, text.startswith(COMMENTS)))
    return tuple(header), stated


def _no_rows(lines: Sequence[str], where: str) -> InputError:
    """Return the error for a file without rows."""
    if not any(line.strip() for line in lines):
        return InputError(
            "the file has no points and no line of numbers", where=where, allowed=_ROWS, remedy="export the points again as text"
        )
    first = next(line.strip() for line in lines if line.strip())
    return InputError(
        f"the file has no line of numbers, at least x y z, among its first {_HEADER_LINES} lines (it begins with '{first:.60}')",
        where=where,
        allowed=_ROWS,
        remedy="use a file of points, or remove the lines before them",
    )
