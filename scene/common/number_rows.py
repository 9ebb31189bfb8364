"""Parse rows of numbers from text line by line, with errors that say which line is wrong and why.

NumPy's own reader is faster and is tried first on plain files. This parser handles what NumPy refuses: decimal commas,
comments between rows and missing values. It also produces the error messages.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scene.common.errors import InputError

COMMENTS = ("#", "//", "%", "!")
"""Prefixes of comment lines."""
_TRAILING = re.compile(r"\s(?:#|//)")
"""Start of a comment behind the values of a row."""
_POINT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?")
_COMMA = re.compile(r"[+-]?(\d+,\d*|\d*,\d+)([eEdD][+-]?\d+)?")
_GROUPED = re.compile(r"[+-]?\d{1,3}([.,'\u2019\u00a0\u202f_ ]\d{3})+([.,]\d*)?")
_MISSING = {"", "null", "none", "na", "n/a", "nil", "nan", "+nan", "-nan", "nan(ind)", "-nan(ind)", "1.#qnan", "1.#ind"}
_INFINITE = {"inf", "+inf", "-inf", "infinity", "-infinity", "1.#inf"}
GROUPED = "are grouped by a thousands separator"
_UNGROUPED = "export the numbers without thousands separators, as 6389450.123"


@dataclass(frozen=True)
class RowForm:
    """How the rows of numbers in a text file (such as a point cloud in .xyz or .csv) are written.

    Attributes
    ----------
    separator : str or None
        Character between values; None for white space.
    decimal_comma : bool
        Whether numbers use a comma as the decimal mark.
    columns : int
        Number of values in a row.
    first_line : int
        Number of the first line within the file, from 1, for error messages.
    counts : bool
        Whether a line with a single whole number states how many rows follow.
    words : tuple of int
        Columns, from 0, that hold words instead of numbers. They are read as NaN.
    """

    separator: str | None = None
    decimal_comma: bool = False
    columns: int = 0
    first_line: int = 1
    counts: bool = False
    words: tuple[int, ...] = ()


@dataclass
class RowsFound:
    """What the parser of a text file with rows of numbers found besides the values.

    Attributes
    ----------
    missing : int
        Number of missing values.
    blocks : list of (int, int, int)
        For each block of rows whose length a line states: the stated number of rows, the actual number, and that line's number.
    """

    missing: int = 0
    blocks: list[tuple[int, int, int]] = field(default_factory=list)


def split_row(line: str, separator: str | None) -> list[str]:
    """Split a line of a text file into its values, without quotation marks and a trailing comment.

    separator: character between values; None for white space. The last value is empty if the line ends with a separator.
    """
    if "#" in line or "//" in line:
        line = _TRAILING.split(line, maxsplit=1)[0]
    if separator is not None and '"' in line:
        return [word.strip() for word in next(csv.reader([line.strip(" \r\n")], delimiter=separator, skipinitialspace=True))]
    words = line.split() if separator is None else [word.strip() for word in line.strip(" \r\n").split(separator)]
    return [word.strip("\"'") if word[:1] in "\"'" else word for word in words]


def is_number(word: str) -> bool:
    """Return whether a word of a text file is a number, to tell rows of data from headings.

    Missing and infinite values, decimal commas and grouped digits (6,389,450.1) count as numbers.
    """
    plain = word.lower()
    number = _POINT.fullmatch(word) or _COMMA.fullmatch(word) or _GROUPED.fullmatch(word)
    return bool(number) or plain.removeprefix("-") in _MISSING | _INFINITE or plain in _INFINITE


def is_grouped(word: str, *, decimal_comma: bool) -> bool:
    """Return whether a word is a number with thousands separators: 6,389,450.1, 6.389.450,1, 6'389'450 or 6 389 450.

    decimal_comma: whether numbers use a comma as the decimal mark.
    """
    if not _GROUPED.fullmatch(word):
        return False
    return not (_POINT.fullmatch(word) or (decimal_comma and _COMMA.fullmatch(word)))


def read_rows(lines: Iterable[str], form: RowForm, where: str) -> tuple[NDArray[np.float64], RowsFound]:
    """Parse the rows of a text file, such as a point cloud, into an array of numbers.

    Parameters
    ----------
    lines : iterable of str
        The lines from number `form.first_line` on. Empty lines and comments are skipped.
    form : RowForm
        How the rows are written: separator, decimal mark, number of columns and so on.
    where : str
        Name of the file in error messages.

    Returns
    -------
    array (n, columns) and RowsFound
        The values, NaN for missing ones, and what else was found.

    Raises
    ------
    InputError
        If a line is not a valid row. The message gives its number.
    """
    found = RowsFound()
    values = np.fromiter(_values(lines, form, found, where), dtype=np.float64)
    return values.reshape(-1, form.columns), found


def _values(lines: Iterable[str], form: RowForm, found: RowsFound, where: str) -> Iterator[float]:
    """Yield the values of all rows, one after the other; record missing values and blocks in `found`."""
    for number, line in enumerate(lines, start=form.first_line):
        text = line.strip()
        if not text or text.startswith(COMMENTS):
            continue
        words = split_row(line, form.separator)
        if form.counts and len(words) == 1 and words[0].isdecimal():
            found.blocks.append((int(words[0]), 0, number))
            continue
        if len(words) == form.columns + 1 and not words[-1]:
            words.pop()
        if len(words) != form.columns:
            raise _wrong_width(text, len(words), number, form, where)
        if found.blocks:
            stated, rows, at = found.blocks[-1]
            found.blocks[-1] = (stated, rows + 1, at)
        for column, word in enumerate(words, start=1):
            place = f"{where}, line {number:,}, column {column}"
            yield float("nan") if column - 1 in form.words else _value(word, form, found, place)


def _value(word: str, form: RowForm, found: RowsFound, where: str) -> float:
    """Parse one word. Raises InputError if it is not a number or uses another decimal mark than the rest of the file."""
    plain = word.lower().removeprefix("-") if "#" in word else word.lower()
    if form.decimal_comma and _COMMA.fullmatch(word):
        return float(plain.replace(",", ".").replace("d", "e"))
    if _POINT.fullmatch(word):
        if form.decimal_comma and "." in word:
            raise InputError(
                f"'{word:.40}' has a decimal point, but other numbers of the file have decimal commas",
                where=where,
                remedy="export all numbers with decimal points",
            )
        return float(plain.replace("d", "e"))
    if plain in _MISSING:
        found.missing += 1
        return float("nan")
    if plain in _INFINITE:
        return float("-inf" if plain.startswith("-") else "inf")
    raise _no_number(word, form, where)


def _no_number(word: str, form: RowForm, where: str) -> InputError:
    """Make the error for a word that is not a number."""
    if is_grouped(word, decimal_comma=form.decimal_comma):
        return InputError(f"the digits of '{word:.40}' {GROUPED}", where=where, allowed="plain numbers", remedy=_UNGROUPED)
    if _COMMA.fullmatch(word):
        return InputError(
            f"'{word:.40}' has a decimal comma, but other numbers of the file have decimal points",
            where=where,
            remedy="export all numbers with decimal points",
        )
    return InputError(
        f"'{word:.40}' is not a number",
        where=where,
        allowed="numbers, with one point in each line",
        remedy="correct or remove the line, or export the file again",
    )


def _wrong_width(text: str, value_count: int, number: int, form: RowForm, where: str) -> InputError:
    """Make the error for a row with too many or too few values."""
    return InputError(
        f"the number of values in this line is {value_count} ('{text:.60}')", where=f"{where}, line {number:,}",
        allowed=f"{form.columns} values, as in the lines before",
        remedy="correct or remove the line; if it is the last line, the file was cut off: copy or export it again",
    )  # fmt: skip
