"""Check and read files that a user names. Every read starts here, because reading a pipe or a device might never end."""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, AnyStr

from scene.common.errors import InputError

MOST_TEXT_BYTES = 512_000_000
"""Largest text file that is read into memory as a whole."""
MOST_JSON_GB = 1.7
"""Most memory, in GB, that the contents of a JSON file may take."""
READ_LIMIT = "SCARPSIM_READ_GB"
"""Environment variable that raises both limits, in GB."""


def check_file(path: Path, *, most_bytes: int | None = None, remedy: str = "", if_too_large: str = "give a smaller file") -> Path:
    """Check that a path is a regular file that can be read, before it is opened; return the path.

    Parameters
    ----------
    path : Path
        The file. It may be empty.
    most_bytes : int, optional
        Size limit; none by default.
    remedy : str
        What the message advises if the file cannot be used, after the advice to give a readable file.
    if_too_large : str
        What the message advises if the file is too large.

    Raises
    ------
    InputError
        If the path does not exist, is a folder, a pipe, a device, a loop of links or an impossible name, or if the file is too
        large.
    """
    where = str(path)
    further_advice = f"; {remedy}" if remedy else ""
    try:
        state = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a null character
        problem = getattr(error, "strerror", None) or "a null character in its name"
        raise InputError(
            f"the file cannot be read ({problem})",
            where=where,
            remedy=f"give the path of an existing file that you may read{further_advice}",
        ) from None
    if stat.S_ISDIR(state.st_mode):
        raise InputError(
            "the path cannot be read (Is a directory)",
            where=where,
            allowed="a file",
            remedy=f"give the path of a file, not of a folder{further_advice}",
        )
    if not stat.S_ISREG(state.st_mode):
        raise InputError(
            "the path is a pipe, a device or a socket",
            where=where,
            allowed="a file",
            remedy="write its output into a regular file, and give that file",
        )
    if most_bytes is not None and state.st_size > most_bytes:
        problem = f"the file has {state.st_size / 1e6:,.0f} MB"
        raise InputError(
            problem, where=where, allowed=f"up to {most_bytes / 1e6:,.0f} MB", remedy=f"the file is too large: {if_too_large}"
        )
    return path


def read_text(path: Path, *, most_bytes: int | None = None, remedy: str = "", if_too_large: str | None = None) -> str:
    """Read a UTF-8 text file.

    Parameters
    ----------
    path : Path
        The file.
    most_bytes : int, optional
        Size limit, bytes. By default 512 MB, or what the environment variable SCARPSIM_READ_GB allows if that is more.
    remedy : str
        What the message advises if the file cannot be used, after the advice to give a readable file.
    if_too_large : str, optional
        What the message advises if the file is too large; by default to give a smaller one or to raise the limit.

    Raises
    ------
    InputError
        If the file is missing, not a regular file, too large or not UTF-8.
    """
    most = max(MOST_TEXT_BYTES, int(read_limit_gb() * 1e9)) if most_bytes is None else most_bytes
    check_file(
        path,
        most_bytes=most,
        remedy=remedy,
        if_too_large=if_too_large or f"give a smaller file, or set the variable {READ_LIMIT}",
    )
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror})",
            where=str(path),
            remedy="give the path of an existing file that you may read",
        ) from None
    except UnicodeDecodeError as error:
        raise InputError(
            f"the file is no text in UTF-8 (byte {error.start:,}: {error.reason})",
            where=str(path),
            remedy="save the file as UTF-8 in a text editor, or give another file if this is no text file",
        ) from None


def read_json(path: Path, *, remedy: str = "make the file again with the command that wrote it") -> Any:
    """Read a JSON file; `remedy` is what the error message advises.

    Raises InputError if the file cannot be read or is not JSON. It also does, before reading, if the contents might take more
    memory than 1.7 GB or the limit in the environment variable SCARPSIM_READ_GB, whichever is more.
    """
    most = max(MOST_JSON_GB, read_limit_gb())
    size = check_file(path, remedy=remedy).stat().st_size
    try:
        needed = _json_gb(path, size, most)
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror})",
            where=str(path),
            remedy="give the path of an existing file that you may read",
        ) from None
    if needed > most:
        problem = f"the file is so large that reading it may take {needed:.1f} GB of memory"
        raise InputError(
            problem,
            where=str(path),
            allowed=f"up to {most:g} GB",
            remedy=f"cut the file into parts, or set the variable {READ_LIMIT}={math.ceil(1.1 * needed)}",
        )
    text = read_text(path, most_bytes=int(most * 1e9), remedy=remedy)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        problem = " ".join(str(error).split()) or "nested too deeply"
        raise InputError(f"the file is not JSON ({problem})", where=str(path), remedy=f"correct the file, or {remedy}") from None


def read_limit_gb() -> float:
    """Return how much a user allows to read from one file, GB: the environment variable SCARPSIM_READ_GB; 0 if not set.

    Raises InputError if the variable is not a number above 0.
    """
    given = os.environ.get(READ_LIMIT)
    if not given:
        return 0.0
    try:
        most = float(given)
    except ValueError:
        most = math.nan
    if not most > 0:
        raise InputError(
            f"the variable is set to '{given}'",
            where=READ_LIMIT,
            allowed="a number of gigabytes, above 0",
            remedy="set the variable to a number such as 8, or unset it",
        )
    return most


def _json_gb(path: Path, size: int, enough: float) -> float:
    """Return an upper bound on the memory that a JSON file of `size` bytes takes as bytes, text and Python values, in GB.

    Counting stops, and the bound is extrapolated, as soon as the part read so far takes more than `enough`. In CPython 3.11 a
    value and its reference take up to 72 bytes, a list 96 more, a mapping 190 more, and a key that no other mapping has 100
    more. A text with a letter beyond the first 256 code points takes up to four bytes a letter.
    """
    values, letter, read = 0, 1, 0
    with path.open("rb") as file:
        while piece := file.read(2**24):
            read += len(piece)
            letter = 1 if letter == 1 and piece.isascii() and b"\\u" not in piece else 4
            values += 72 * piece.count(b",") + 96 * piece.count(b"[") + 190 * piece.count(b"{") + 100 * piece.count(b":")
            if (2 * letter * size + values) / 1e9 > enough:
                break
    return (2 * letter * size + values * size / max(read, 1)) / 1e9


def bounded_lines(file: IO[AnyStr], count: int, longest: int = 65_536) -> Iterator[AnyStr]:
    """Yield at most `count` lines of an open file, such as those that tell its format.

    Raises ValueError for a line with more than `longest` characters (bytes of a binary file), which would fill the memory.
    """
    for _ in range(count):
        line = file.readline(longest)
        if len(line) == longest:
            raise ValueError(f"a line of more than {longest:,} bytes")
        if not line:
            return
        yield line
