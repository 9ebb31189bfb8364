"""Read the elements and properties of PLY files, binary and ASCII, as arrays."""

from __future__ import annotations

import codecs
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from scene.common.errors import InputError
from scene.common.number_rows import RowForm, read_rows, split_row
from scene.common.regular_file import bounded_lines, check_file

_LONGEST_HEADER = 65536
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

Columns = Mapping[str, NDArray[Any]]


@dataclass
class _Element:
    """One element of a PLY header.

    Attributes
    ----------
    name : str
        Such as "vertex" or "face".
    count : int
        Number of records.
    properties : dict
        Name to (type of the value, type of the list's length or "").
    """

    name: str
    count: int
    properties: dict[str, tuple[str, str]] = field(default_factory=dict)


def read_elements(path: Path, only: str = "") -> dict[str, Columns]:
    """Read the elements (tables such as "vertex" and "face") of a PLY file, a format for meshes and point clouds.

    Parameters
    ----------
    path : Path
        The file.
    only : str
        Stop after the element of this name; "" reads all.

    Returns
    -------
    dict
        For each element, its properties by name: arrays (n,), or (n, k) for lists of length k.

    Raises
    ------
    InputError
        If the file is missing or damaged, or contains lists of different lengths.
    """
    check_file(path)
    try:
        with path.open("rb") as file:
            order, elements = _header(file)
            wanted = itertools.islice(elements, _last(elements, only))
            found = {element.name: _columns(file, element, order) for element in wanted}
            if len(found) == len(elements):
                _check_end(file, elements, order)
            return found
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror})",
            where=str(path),
            remedy="give the path of an existing file that you may read",
        ) from None
    except InputError as error:  # raised by read_rows, which does not know the path
        raise InputError(
            f"the numbers of the file cannot be read: {error.what}",
            where=f"{path}, {error.where}",
            allowed=error.allowed,
            remedy=f"in the PLY file, {error.remedy}",
        ) from None
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise InputError(
            f"the file is not a whole PLY file ({error})",
            where=str(path),
            remedy="copy the complete file again, or export it again as PLY",
        ) from None


def header_remarks(path: Path) -> list[str]:
    """Return the comments in the header of a PLY file, which may state its unit or origin.

    The file must be one that `read_elements` has read without an error.
    """
    with path.open("rb") as file:
        return [" ".join(words[1:]) for words in _header_lines(file) if words[:1] in (["comment"], ["obj_info"])]


def _last(elements: list[_Element], only: str) -> int:
    """Return how many elements to read so that the one called `only` is the last; all if there is none."""
    return next((index + 1 for index, element in enumerate(elements) if element.name == only), len(elements))


def _header(file: BinaryIO) -> tuple[str, list[_Element]]:
    """Read the byte order ("" for ASCII) and the elements. The file is left at the first byte of the data."""
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
    """Yield the words of each header line. Raises ValueError if this is not a PLY header."""
    if file.readline(16).removeprefix(codecs.BOM_UTF8).strip() != b"ply":
        raise ValueError("it does not begin with 'ply'")
    while (line := file.readline(_LONGEST_HEADER)).strip() != b"end_header":
        if not line.endswith(b"\n") or file.tell() > _LONGEST_HEADER:
            raise ValueError("the header has no end")
        yield line.decode("ascii", errors="replace").split()


def _columns(file: BinaryIO, element: _Element, order: str) -> Columns:
    """Read one element as views of one array of records, and leave the file after it.

    Raises ValueError for lists of different lengths.
    """
    if not element.count or not element.properties:
        return {name: np.empty((0, 3) if counter else 0, kind) for name, (kind, counter) in element.properties.items()}
    rows = _binary_rows(file, element, order) if order else _ascii_rows(file, element)
    for name, (_, counter) in element.properties.items():
        if counter and np.any(rows[f"count {name}"] != rows[name].shape[1]):
            raise ValueError(f"{element.name} lists of different lengths, only triangles can be read")
    return {name: rows[name] for name in element.properties}


def _binary_rows(file: BinaryIO, element: _Element, order: str) -> NDArray[Any]:
    """Read the records of one element of a binary file."""
    record = np.dtype(_fields(element, order, _binary_lengths(file, element, order)))
    left = _size(file) - file.tell()
    if element.count * record.itemsize > left:
        raise ValueError(f"{element.count:,} {element.name} records of {record.itemsize} bytes, {left:,} bytes are left")
    return np.fromfile(file, dtype=record, count=element.count)


def _binary_lengths(file: BinaryIO, element: _Element, order: str) -> dict[str, int]:
    """Return the length of each list in the first record. The file position does not change."""
    start, lengths = file.tell(), {}
    for name, (kind, counter) in element.properties.items():
        if counter:
            lengths[name] = int(np.frombuffer(file.read(np.dtype(counter).itemsize), dtype=order + counter)[0])
        file.seek(lengths.get(name, 1) * np.dtype(kind).itemsize, 1)
    file.seek(start)
    return lengths


def _fields(element: _Element, order: str, lengths: Mapping[str, int]) -> list[Any]:
    """Return the fields of the NumPy record type of an element."""
    fields: list[Any] = []
    for name, (kind, counter) in element.properties.items():
        if counter:
            fields += [(f"count {name}", order + counter), (name, order + kind, (lengths[name],))]
        else:
            fields.append((name, order + kind))
    return fields


def _ascii_rows(file: BinaryIO, element: _Element) -> NDArray[Any]:
    """Read the records of one element of an ASCII file."""
    start = file.tell()
    try:
        table = np.loadtxt(bounded_lines(file, element.count), ndmin=2, comments=None, encoding="ascii")
    except ValueError:  # NumPy's message does not say which line is wrong
        file.seek(start)
        table = _rows_by_line(file, element)
    if len(table) < element.count:
        raise ValueError(f"{len(table):,} of {element.count:,} {element.name} lines")
    lengths, column = {}, 0
    for name, (_, counter) in element.properties.items():
        if counter:
            lengths[name] = int(table[0, column])
        column += lengths.get(name, 0) + 1
    rows = np.empty(len(table), dtype=_fields(element, "<", lengths))
    return _filled(rows, table)


def _rows_by_line(file: BinaryIO, element: _Element) -> NDArray[np.float64]:
    """Read the rows line by line, with errors that name the line, counted from the element's first."""
    lines = [line.decode("ascii", errors="replace") for line in bounded_lines(file, element.count)]
    width = len(split_row(lines[0], None)) if lines else 0
    return read_rows(lines, RowForm(columns=width), f"the {element.name} lines")[0]


def _check_end(file: BinaryIO, elements: list[_Element], order: str) -> None:
    """Raise ValueError if more data follow the last element than its count states."""
    last = elements[-1] if elements else None
    if last is None:
        return
    if not order:
        more = sum(bool(line.strip()) for line in file)
        if more:
            raise ValueError(f"{last.count:,} {last.name} lines are stated, and {more:,} more follow")
        return
    size = sum(np.dtype(counter or kind).itemsize for kind, counter in last.properties.values())
    left = _size(file) - file.tell()
    if size and left >= size:
        raise ValueError(f"{last.count:,} {last.name} records are stated, and {left:,} bytes of more follow")


def _filled(rows: NDArray[Any], table: NDArray[np.float64]) -> NDArray[Any]:
    """Fill records field by field from the columns of an ASCII table. Raises ValueError if it has too few or too many columns."""
    column = 0
    for name in rows.dtype.names or ():
        width = rows[name].shape[1] if rows[name].ndim == 2 else 1
        rows[name] = table[:, column : column + width] if rows[name].ndim == 2 else table[:, column]
        column += width
    if column != table.shape[1]:
        raise ValueError(f"{table.shape[1]} numbers a line, {column} properties")
    return rows


def _size(file: BinaryIO) -> int:
    """Return the size of an open file; its position does not change."""
    here = file.tell()
    size = file.seek(0, 2)
    file.seek(here)
    return size
