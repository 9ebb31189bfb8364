"""The door for every file that a person names: it is looked at first, as a pipe or a device would be read without end."""

from __future__ import annotations

import json
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, AnyStr

from scene.errors import InputError

MOST_TEXT_BYTES = 512_000_000
"""Of a text file that is read into memory as a whole."""


def check_file(
    path: Path, *, most_bytes: int | None = None, remedy: str = "check the path", smaller: str = "give a smaller one"
) -> Path:
    """`path` itself, if it is a file with data in it or none; InputError for what is not there, a folder, a pipe, a device, a
    loop of links, a name that cannot be, and a file of more than `most_bytes`, whose remedy is `smaller`."""
    where = str(path)
    try:
        state = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a null character
        problem = getattr(error, "strerror", None) or "a null character in its name"
        raise InputError(f"cannot be read ({problem})", where=where, remedy=remedy) from None
    if stat.S_ISDIR(state.st_mode):
        raise InputError("cannot be read (Is a directory)", where=where, allowed="a file", remedy=remedy)
    if not stat.S_ISREG(state.st_mode):
        raise InputError(
            "is a pipe, a device or a socket", where=where, allowed="a file", remedy="copy what it gives into a file"
        )
    if most_bytes is not None and state.st_size > most_bytes:
        problem = f"has {state.st_size / 1e6:,.0f} MB"
        raise InputError(problem, where=where, allowed=f"up to {most_bytes / 1e6:,.0f} MB", remedy=smaller)
    return path


def read_text(
    path: Path, *, most_bytes: int = MOST_TEXT_BYTES, remedy: str = "check the path", smaller: str = "give a smaller one"
) -> str:
    """The text of a file in UTF-8; raises InputError as `check_file` does, and for other encodings."""
    check_file(path, most_bytes=most_bytes, remedy=remedy, smaller=smaller)
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy=remedy) from None
    except UnicodeDecodeError as error:
        problem = f"is no text in UTF-8 (byte {error.start:,}: {error.reason})"
        raise InputError(problem, where=str(path), remedy="save it in UTF-8, or give the file that is meant") from None


def read_json(path: Path, *, remedy: str = "make it again") -> Any:
    """The value that a JSON file holds; raises InputError as `read_text` does, and where the file is not JSON."""
    text = read_text(path, remedy=remedy)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        problem = " ".join(str(error).split()) or "nested too deeply"
        raise InputError(f"is not JSON ({problem})", where=str(path), remedy=remedy) from None


def bounded_lines(file: IO[AnyStr], count: int, longest: int = 65_536) -> Iterator[AnyStr]:
    """At most `count` lines of an open file; raises ValueError for a longer one, which would be taken into memory as a whole."""
    for _ in range(count):
        line = file.readline(longest)
        if len(line) == longest:
            raise ValueError(f"a line of more than {longest:,} bytes")
        if not line:
            return
        yield line
